//! Runs a command within limits, and checks its outcome against the rules.

use std::collections::BTreeSet;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::draw::{Drawn, INPUTS};
use crate::fixtures::files;

/// Limits of a command.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    /// Time after which the command is interrupted, which is not a fault.
    pub time: Duration,
    /// Time that it may take to end after the interrupt.
    pub grace: Duration,
    /// Limit of the address space, KiB.
    pub memory: u64,
}

/// How a command ended.
pub struct Ended {
    /// Its exit code, or the signal that ended it.
    pub how: String,
    /// Its stdout.
    pub stdout: Vec<u8>,
    /// Its stderr.
    pub stderr: Vec<u8>,
    /// Each rule that it broke.
    pub faults: Vec<String>,
}

/// Runs a command in its folder and judges it.
///
/// # Errors
/// The command cannot be started.
pub fn run(
    program: &Path,
    drawn: &Drawn,
    folder: &Path,
    bounds: &Bounds,
) -> std::io::Result<Ended> {
    let before = content(folder);
    let (status, interrupted, stdout, stderr) = finish(program, drawn, folder, bounds)?;
    let mut faults = Vec::new();
    let text = String::from_utf8_lossy(&stderr).into_owned();
    let code = status.and_then(|status| status.code());
    let how = match status {
        None => {
            let grace = bounds.grace.as_secs();
            faults.push(format!("hangs: goes on {grace} s after an interrupt"));
            "killed".to_owned()
        }
        Some(status) => match (status.code(), status.signal()) {
            (Some(code), _) => format!("exit code {code}"),
            (_, signal) => {
                faults.push(format!("ended by signal {}", signal.unwrap_or(0)));
                format!("signal {}", signal.unwrap_or(0))
            }
        },
    };
    match code {
        Some(0..=2) => {}
        Some(130) if interrupted => {}
        Some(other) => faults.push(format!("exit code {other}")),
        None => {}
    }
    if ["panicked at", "RUST_BACKTRACE", "memory allocation of"].iter().any(|p| text.contains(p)) {
        faults.push("panics or aborts".into());
    }
    if let Some(code) = code {
        faults.extend(words(code, drawn, &stdout, &text));
        // Outputs of finished jobs of a batch stay, whatever happened to the others.
        let partly = drawn.command == "batch" && has_judged(code, drawn, &stdout);
        faults.extend(left(if partly { 0 } else { code }, &before, &content(folder)));
        if code == 0 {
            faults.extend(unreadable(program, folder));
        }
    }
    Ok(Ended { how, stdout, stderr, faults })
}

type Finished = (Option<ExitStatus>, bool, Vec<u8>, Vec<u8>);

/// Runs the command to its end, with an interrupt at the time limit; returns no status if even the
/// interrupt did not end it.
fn finish(
    program: &Path,
    drawn: &Drawn,
    folder: &Path,
    bounds: &Bounds,
) -> std::io::Result<Finished> {
    // The shell limits the address space, then execs the program.
    let mut child = Command::new("sh")
        .arg("-c")
        .arg(format!("ulimit -v {}; ulimit -c 0; exec \"$@\"", bounds.memory))
        .arg("sh")
        .arg(program)
        .args(&drawn.words)
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let stdout = collect(child.stdout.take());
    let stderr = collect(child.stderr.take());
    let mut interrupted = false;
    let mut status = wait(&mut child, bounds.time)?;
    if status.is_none() {
        interrupted = true;
        Command::new("kill").args(["-INT".to_owned(), child.id().to_string()]).status()?;
        status = wait(&mut child, bounds.grace)?;
    }
    if status.is_none() {
        child.kill()?;
        child.wait()?;
    }
    let joined = |thread: std::thread::JoinHandle<Vec<u8>>| thread.join().unwrap_or_default();
    Ok((status, interrupted, joined(stdout), joined(stderr)))
}

fn collect(pipe: Option<impl Read + Send + 'static>) -> std::thread::JoinHandle<Vec<u8>> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(pipe) = pipe {
            // Far more than any command should print.
            let _ = pipe.take(64 << 20).read_to_end(&mut bytes);
        }
        bytes
    })
}

fn wait(child: &mut Child, most: Duration) -> std::io::Result<Option<ExitStatus>> {
    let begun = Instant::now();
    while begun.elapsed() < most {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(None)
}

/// Whether a command exited with 1 because of its findings, not because of an error.
fn has_judged(code: i32, drawn: &Drawn, stdout: &[u8]) -> bool {
    let judges = ["batch", "bench", "validate"].contains(&drawn.command.as_str());
    judges && code == 1 && !stdout.is_empty()
}

/// Checks the rules for printed output.
fn words(code: i32, drawn: &Drawn, stdout: &[u8], stderr: &str) -> Vec<String> {
    let mut faults = Vec::new();
    let failed = code != 0 && !has_judged(code, drawn, stdout);
    // After `--` it would be a file name.
    let flags = drawn.words.iter().take_while(|word| *word != "--");
    let json = flags.into_iter().any(|word| word == "--json");
    let errors = stderr.lines().filter(|line| line.starts_with("error: ")).count();
    if failed && errors != 1 {
        faults.push(format!("{errors} lines begin with `error: `"));
    }
    if stderr.chars().any(|c| c.is_control() && !"\n\t".contains(c)) {
        faults.push("control characters on stderr".into());
    }
    if let Some(long) = stderr.lines().map(str::len).filter(|&length| length > 1200).max() {
        faults.push(format!("a line of {long} bytes on stderr"));
    }
    if json {
        match serde_json::from_slice::<Value>(stdout) {
            Ok(Value::Object(object)) if failed && !object.contains_key("error") => {
                faults.push("the JSON of a failure has no `error`".into());
            }
            Ok(Value::Object(_)) => {}
            _ => faults.push("stdout is not one JSON object".into()),
        }
    } else if failed && !stdout.is_empty() {
        faults.push("a failure prints on stdout".into());
    }
    faults
}

/// Checks the rules for files that are left in the folder.
fn left(code: i32, before: &BTreeSet<PathBuf>, after: &BTreeSet<PathBuf>) -> Vec<String> {
    let mut faults = Vec::new();
    let new: Vec<&PathBuf> = after.difference(before).collect();
    let partial = |path: &Path| {
        path.iter().any(|part| {
            let part = part.to_string_lossy();
            part.ends_with(".part") || part.starts_with(".splat4d-")
        })
    };
    faults.extend(
        new.iter().filter(|path| partial(path)).map(|p| format!("half a file: {}", p.display())),
    );
    // A checkpoint stays, to resume from, and complete images stay when rendering is interrupted.
    let kept = |path: &Path| path.iter().any(|p| p.to_string_lossy().ends_with(".checkpoint"));
    if matches!(code, 1 | 2) {
        let written = new.iter().filter(|path| !partial(path) && !kept(path));
        faults.extend(written.map(|p| format!("a failure leaves {}", p.display())));
    }
    let gone = before.difference(after);
    faults.extend(gone.map(|p| format!("{} is gone", p.display())));
    faults
}

/// Reports scenes that a successful command wrote and that cannot be opened.
fn unreadable(program: &Path, folder: &Path) -> Vec<String> {
    let mut faults = Vec::new();
    for path in content(&folder.join("out")) {
        if path.extension().is_some_and(|e| e == "safetensors") {
            let output = Command::new(program).arg("info").arg(&path).output();
            if !output.is_ok_and(|output| output.status.success()) {
                faults.push(format!("`info` refuses {}", path.display()));
            }
        }
    }
    faults
}

/// Every file below the command's folder, without the fixtures.
fn content(folder: &Path) -> BTreeSet<PathBuf> {
    let mut found = Vec::new();
    files(folder, &mut found);
    let inputs = folder.join(INPUTS);
    found.into_iter().filter(|path| !path.starts_with(&inputs)).collect()
}
