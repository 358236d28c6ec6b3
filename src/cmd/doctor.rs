//! `splat4d doctor`: checks the machine, the drivers and the programs that splat4d uses, for a bug report.

use std::fmt::Write;
use std::process::ExitCode;

use clap::Args;
use serde_json::{Value, json};
use splat4d::Result;

use super::common::{Answer, Common, say};
use super::{doctor_machine, doctor_vulkan};

const AFTER_HELP: &str = "\
Each line is marked ok, note or problem; below a note or a problem stands what to do. Drivers are tested
in processes of their own, so that one that crashes is reported too. The smoke test of each usable device
renders, trains, and runs quick cases of `validate` for about five seconds. Exit code 1 with any problem.

Attach the output to a bug report. It names folders and the values of some environment variables.

Example:
  splat4d doctor

JSON: program {version, features, debug (whether it is a debug build)}, system {os, version,
kernel, arch, processor, cores, memory_bytes, available_bytes}, folders [{use, path, free_bytes}],
environment (variables that are set, with their values), vulkan {loader (version), error, devices}, where
each device has the keys of `devices`, known_faults [{case, reason}] and smoke {cases, failed (names),
known_faults (names), left_out, seconds, error}, or null if it cannot be used; ffmpeg {version, ffprobe
(its version), h264 (whether libx264 is in it)}, onnxruntime {library, version, build, error}, findings
[{mark (ok, note, problem), subject, text, remedy (or null)}] as in the text, problems (their number).
null stands for what is missing or unknown";

/// Check drivers, programs and the machine, for a bug report
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct DoctorArgs {}

/// Severity of a finding.
#[derive(Clone, Copy, PartialEq)]
enum Mark {
    Ok,
    Note,
    Problem,
}

impl Mark {
    fn name(self) -> &'static str {
        match self {
            Mark::Ok => "ok",
            Mark::Note => "note",
            Mark::Problem => "problem",
        }
    }
}

/// A line of the report.
struct Finding {
    mark: Mark,
    subject: String,
    text: String,
    remedy: Option<String>,
}

/// The findings so far.
#[derive(Default)]
pub struct Findings(Vec<Finding>);

impl Findings {
    /// Something in order.
    pub fn ok(&mut self, subject: &str, text: impl Into<String>) {
        self.add(Mark::Ok, subject, text.into(), None);
    }

    /// Something that limits or changes what the program does, without being wrong.
    pub fn note(&mut self, subject: &str, text: impl Into<String>, remedy: &str) {
        self.add(Mark::Note, subject, text.into(), Some(remedy.to_owned()));
    }

    /// Something that keeps the program from working.
    pub fn problem(&mut self, subject: &str, text: impl Into<String>, remedy: &str) {
        self.add(Mark::Problem, subject, text.into(), Some(remedy.to_owned()));
    }

    fn add(&mut self, mark: Mark, subject: &str, text: String, remedy: Option<String>) {
        self.0.push(Finding { mark, subject: subject.to_owned(), text, remedy });
    }

    /// Subjects and texts, for a page.
    pub fn facts(&self) -> Vec<(&str, String)> {
        self.0.iter().map(|finding| (finding.subject.as_str(), finding.text.clone())).collect()
    }

    fn problems(&self) -> usize {
        self.0.iter().filter(|finding| finding.mark == Mark::Problem).count()
    }

    fn text(&self) -> String {
        let mut text = String::new();
        for Finding { mark, subject, text: what, remedy } in &self.0 {
            let _ = writeln!(text, "{:<9}{subject}: {what}", mark.name());
            if let Some(remedy) = remedy {
                let _ = writeln!(text, "{:<9}{remedy}", "");
            }
        }
        let problems = match self.problems() {
            0 => "no problem was found".to_owned(),
            1 => "1 problem was found".to_owned(),
            count => format!("{count} problems were found"),
        };
        text + &problems + "\n"
    }

    fn json(&self) -> Value {
        let finding = |f: &Finding| {
            json!({
                "mark": f.mark.name(),
                "subject": f.subject,
                "text": f.text,
                "remedy": f.remedy,
            })
        };
        self.0.iter().map(finding).collect()
    }
}

/// Runs the command. The exit code tells whether a problem was found.
pub fn run(common: &Common) -> Result<(Answer, ExitCode)> {
    let mut findings = Findings::default();
    let program = doctor_machine::program(&mut findings);
    let system = doctor_machine::system(&mut findings);
    let folders = doctor_machine::folders(&mut findings);
    let environment = doctor_machine::environment(&mut findings);
    let ffmpeg = doctor_machine::ffmpeg(&mut findings);
    let onnxruntime = doctor_machine::onnxruntime(&mut findings);
    say("drivers are tested; this takes about five seconds a device");
    let vulkan = doctor_vulkan::vulkan(common.seed, &mut findings)?;
    let problems = findings.problems();
    let json = json!({
        "program": program,
        "system": system,
        "folders": folders,
        "environment": environment,
        "vulkan": vulkan,
        "ffmpeg": ffmpeg,
        "onnxruntime": onnxruntime,
        "findings": findings.json(),
        "problems": problems,
    });
    Ok((Answer { json, text: findings.text() }, ExitCode::from(u8::from(problems > 0))))
}
