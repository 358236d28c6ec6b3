//! `splat4d validate`: checks kernels against the oracle.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use clap::Args;
use serde_json::json;
use splat4d::check::{self, Case, EXPECTED};
use splat4d::gpu::{Device, DeviceKind, Request, Selector};
use splat4d::io::write_atomically;
use splat4d::vk::{self, DeviceInfo};
use splat4d::{Error, Result};

use super::common::{Answer, Common, check_room_for_drivers, say};
use super::fuzz::{self, FuzzCase};
use super::interrupt;
use super::meter::Meter;
use super::outputs::Outputs;
use super::rows::{Row, devices_json, junit, table};
use super::validate_page::{Page, Tested};
use super::values;

const AFTER_HELP: &str = "\
Every kernel runs on the device, in its variants for GPUs and for software drivers and with every
subgroup size that the driver lets it require, and is held against the CPU's f64 oracle, on ordinary and
on hard inputs, twice, with poisoned outputs between guard words. A case fails that misses its bound,
writes outside of its outputs, gives other bits the second time, or makes the validation layer speak.
\"f32 itself\" is the error of the same oracle in f32: where it misses the bound too, the device is not
to blame. Exit code 1 on any failure.

Examples:
  splat4d validate --device all
  splat4d validate --quick --validation
  splat4d validate --filter sort/ --filter render/needles --seed 7
  splat4d validate --device all --junit validate.xml
  splat4d validate --validation --report driver.html
  splat4d validate --fuzz 10000 --seed 3

JSON: cases, failed, left_out (cases that --seconds left no time for), seconds, quick, validation, devices
[{index, name, driver}], and rows, one for each case and device: {device (index), case, result (passed,
failed, known fault, fault gone), reason, seed, seconds, comparisons, worst, failures, error, messages}.
worst, and each of failures, is {output, values, bound {absolute, relative}, absolute, relative, ulp,
of_bound, at, got and expected (the two values there, as text), oracle_f32_absolute, oracle_f32_of_bound};
worst is the output nearest to its bound. bound is null where only equality counts; null also stands for what
is infinite or does not apply. With --fuzz and --case: cases (scenes judged), failed, seconds, devices, and
rows: {device, what, file} and with --fuzz scene, its number.";

/// Check every kernel of a device, or of all devices, against the oracle
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct ValidateArgs {
    /// Only one or two quick cases per kernel: under a minute on a software driver
    #[arg(long)]
    quick: bool,
    /// Only cases whose name contains this text; may be repeated
    #[arg(long, value_name = "TEXT")]
    filter: Vec<String>,
    /// Begin no further case after this many seconds
    #[arg(long, value_name = "SECONDS", conflicts_with_all = ["fuzz", "case"],
          value_parser = values::number(0.001..=values::MOST_SECONDS))]
    seconds: Option<f64>,
    /// Enable the Khronos validation layer with synchronization validation; any message is a failure
    #[arg(long)]
    validation: bool,
    /// Test this many small scenes of ordinary and invalid values instead; --seed selects them. A failing
    /// scene is minimised and written to fuzz-SEED-SCENE.json
    #[arg(long, value_name = "N", conflicts_with_all = ["quick", "filter"],
          value_parser = values::whole::<u64>(1..=1_000_000_000))]
    fuzz: Option<u64>,
    /// Test the scene of such a file again instead
    #[arg(long, value_name = "FILE", conflicts_with_all = ["quick", "filter", "fuzz"])]
    case: Option<PathBuf>,
    /// Write the results as a JUnit report too, for continuous integration: a suite for each device; a known
    /// fault of a driver is a skipped test
    #[arg(long, value_name = "FILE", conflicts_with_all = ["fuzz", "case"])]
    junit: Option<PathBuf>,
    /// Write a self-contained HTML page to attach to a bug report for a driver: device, driver, limits, machine
    /// (some environment variables too), and each failed case with the expected values, the command that
    /// repeats it and the SPIR-V modules that it ran
    #[arg(long, value_name = "FILE", conflicts_with_all = ["fuzz", "case"])]
    report: Option<PathBuf>,
}

impl ValidateArgs {
    /// The options for the page, by name.
    fn described(&self, seed: u64, left_out: usize) -> [(&'static str, String); 4] {
        let cases = if self.quick { "quick" } else { "all" };
        let cases = match self.filter.is_empty() {
            true => cases.to_owned(),
            false => format!("{cases} with {} in their name", self.filter.join(" or ")),
        };
        let layer = if self.validation { "on" } else { "off" };
        [
            ("Cases", cases),
            ("Left out for lack of time", left_out.to_string()),
            ("Seed", seed.to_string()),
            ("Validation layer", layer.to_owned()),
        ]
    }
}

/// Runs the command. The exit code indicates whether all cases passed; an error means that this could not
/// be determined.
pub fn run(args: &ValidateArgs, common: &Common) -> Result<(Answer, ExitCode)> {
    // Read before opening devices, so that a missing file is reported first.
    let case = args.case.as_deref().map(FuzzCase::read).transpose()?;
    let outputs = args.junit.iter().chain(&args.report);
    outputs.into_iter().try_fold(Outputs::default(), |outputs, file| outputs.file(file))?;
    check_room_for_drivers()?;
    let infos = devices(common)?;
    if args.fuzz.is_some() || args.case.is_some() {
        let open = |info: &DeviceInfo| Ok((info.clone(), open(info, args.validation)?));
        let devices = infos.iter().map(open).collect::<Result<Vec<_>>>()?;
        return match &case {
            Some(case) => fuzz::repeat(&devices, case),
            None => fuzz::run(&devices, args.fuzz.unwrap_or(0), common.seed),
        };
    }
    let started = Instant::now();
    let cases = chosen(args)?;
    let mut meter = Meter::new("validate", "cases", (cases.len() * infos.len()) as u64, 0);
    let (mut tested, mut rows, mut left_out) = (Vec::new(), Vec::new(), 0);
    // Cases of the host run once, whatever the number of devices.
    let mut of_host = BTreeSet::new();
    for info in &infos {
        let device = open(info, args.validation)?;
        tested.push(Tested::of(&device));
        let mut bench = Bench { info, validation: args.validation, device: Some(device) };
        for case in &cases {
            interrupt::check()?;
            if of_host.contains(case.id) {
                continue;
            }
            if args.seconds.is_some_and(|most| started.elapsed().as_secs_f64() >= most) {
                left_out += 1;
                continue;
            }
            meter.message(case.id.to_owned());
            let row = bench.row(case, common.seed)?;
            if !row.is_fine() {
                say(&format!("{}: {} failed", info.name, case.id));
            }
            if row.is_of_host() {
                of_host.insert(case.id);
            }
            rows.push(row);
            meter.advance();
        }
    }
    drop(meter);
    if let Some(file) = &args.junit {
        let report = junit(&infos, &rows);
        write_atomically(file, |sink| report.serialize(sink).map_err(std::io::Error::other))?;
    }
    if let Some(file) = &args.report {
        let options = args.described(common.seed, left_out);
        let html = Page { devices: &tested, rows: &rows, options: &options }.html()?;
        write_atomically(file, |sink| sink.write_all(html.as_bytes()))?;
    }
    let failed = rows.iter().filter(|row| !row.is_fine()).count();
    let seconds = started.elapsed().as_secs_f64();
    let mut text = table(&infos, &rows);
    text += &format!("{} cases, {failed} failed, {seconds:.1} s\n", rows.len());
    if left_out > 0 {
        text += &format!("{left_out} cases were left out after {seconds:.1} s\n");
    }
    let json = json!({
        "cases": rows.len(),
        "failed": failed,
        "left_out": left_out,
        "seconds": seconds,
        "quick": args.quick,
        "validation": args.validation,
        "devices": devices_json(&infos),
        "rows": rows.iter().map(Row::json).collect::<Vec<_>>(),
    });
    Ok((Answer { json, text }, ExitCode::from(u8::from(failed > 0))))
}

fn chosen(args: &ValidateArgs) -> Result<Vec<&'static Case>> {
    let wanted = |case: &&Case| {
        (!args.quick || check::QUICK.contains(&case.id))
            && (args.filter.is_empty() || args.filter.iter().any(|part| case.id.contains(part)))
    };
    let cases: Vec<&Case> =
        check::ALL.iter().flat_map(|cases| cases.iter()).filter(wanted).collect();
    if cases.is_empty() {
        let families: Vec<_> =
            check::ALL.iter().filter_map(|cases| cases[0].id.split('/').next()).collect();
        return Err(Error::Input(format!(
            "no case is called so; a name is FAMILY/CASE, the families are {}",
            families.join(", ")
        )));
    }
    Ok(cases)
}

/// The devices that `--device` selects; `all` selects every one that the loader reports.
fn devices(common: &Common) -> Result<Vec<DeviceInfo>> {
    if common.device == "all" {
        return vk::enumerate();
    }
    let selector = Selector::from(common.device.as_str());
    let asked = selector != Selector::Best;
    let info = Device::open(&Request { selector, ..Request::default() })?.info().clone();
    if !asked && info.kind == DeviceKind::Software {
        say(&format!("note: no GPU found, {} is validated", info.name));
    }
    Ok(vec![info])
}

fn open(info: &DeviceInfo, validation: bool) -> Result<Device> {
    let selector = Selector::Index(info.index);
    Device::open(&Request { selector, validation, ..Request::default() })
}

/// A device under test; it is reopened after a case has lost it.
struct Bench<'a> {
    info: &'a DeviceInfo,
    validation: bool,
    device: Option<Device>,
}

impl Bench<'_> {
    fn row(&mut self, case: &Case, seed: u64) -> Result<Row> {
        let started = Instant::now();
        let device = match self.device.take() {
            Some(device) => device,
            None => open(self.info, self.validation)?,
        };
        let outcome = check::run(case, &device, seed);
        let messages = device.take_validation_messages();
        if !matches!(outcome.error, Some(Error::DeviceLost { .. })) {
            self.device = Some(device);
        }
        let seconds = started.elapsed().as_secs_f64();
        Ok(Row::new(self.info, outcome, messages, seconds, EXPECTED))
    }
}
