//! Results of `validate` for a case on a device, as JSON, JUnit and text.

use std::fmt::Write;
use std::time::Duration;

use quick_junit::{NonSuccessKind, Report, TestCase, TestCaseStatus, TestSuite};
use serde_json::{Value, json};
use splat4d::check::{Expect, Finding, Outcome, Verdict, verdict};
use splat4d::vk::DeviceInfo;

/// Result of one case on one device.
pub struct Row {
    device: usize,
    outcome: Outcome,
    messages: Vec<String>,
    verdict: Verdict<'static>,
    seconds: f64,
}

/// Maximum number of failed comparisons printed per case; the JSON contains all.
const SHOWN: usize = 5;

impl Row {
    /// Makes a row from an outcome.
    pub fn new(
        info: &DeviceInfo,
        outcome: Outcome,
        messages: Vec<String>,
        seconds: f64,
        expected: &'static [Expect],
    ) -> Row {
        let verdict = verdict(&outcome, messages.is_empty(), &info.driver, expected);
        Row { device: info.index, outcome, messages, verdict, seconds }
    }

    /// Whether validation may pass with it.
    pub fn is_fine(&self) -> bool {
        self.verdict.is_fine()
    }

    /// Whether the case passed and ran no kernel, so that another device gives the same result.
    pub fn is_of_host(&self) -> bool {
        self.outcome.dispatched.is_empty() && self.outcome.passed()
    }

    /// Index of the device.
    pub fn device(&self) -> usize {
        self.device
    }

    /// What the case found.
    pub fn outcome(&self) -> &Outcome {
        &self.outcome
    }

    /// Messages of the validation layer.
    pub fn messages(&self) -> &[String] {
        &self.messages
    }

    /// The verdict in words; of a known fault, its reason.
    pub fn result(&self) -> (&'static str, Option<&str>) {
        match &self.verdict {
            Verdict::Passed => ("passed", None),
            Verdict::Failed => ("failed", None),
            Verdict::KnownFault(fault) => ("known fault", Some(fault.reason)),
            Verdict::FaultGone(fault) => ("fault gone", Some(fault.reason)),
        }
    }

    /// The comparison closest to its bound, or farthest beyond it.
    fn worst(&self) -> Option<&Finding> {
        let findings = self.outcome.findings.iter().filter(|f| f.bound.is_some() || !f.passed);
        findings.max_by(|a, b| a.worst_of_bound.total_cmp(&b.worst_of_bound))
    }

    /// The comparisons that failed.
    pub fn failures(&self) -> impl Iterator<Item = &Finding> {
        self.outcome.findings.iter().filter(|finding| !finding.passed)
    }

    /// The command that repeats the case.
    pub fn again(&self) -> String {
        let Outcome { id, seed, .. } = self.outcome;
        let layer = if self.messages.is_empty() { "" } else { " --validation" };
        format!("splat4d validate --device {} --filter {id} --seed {seed}{layer}", self.device)
    }

    /// JSON for machines.
    pub fn json(&self) -> Value {
        let (result, reason) = self.result();
        json!({
            "device": self.device,
            "case": self.outcome.id,
            "result": result,
            "reason": reason,
            "seed": self.outcome.seed,
            "seconds": self.seconds,
            "comparisons": self.outcome.findings.len(),
            "worst": self.worst().map(finding_json),
            "failures": self.failures().map(finding_json).collect::<Vec<_>>(),
            "error": self.outcome.error.as_ref().map(ToString::to_string),
            "messages": self.messages,
        })
    }

    /// A test case of a JUnit report; what the table prints of the case is its description.
    fn junit(&self, info: &DeviceInfo) -> TestCase {
        let (result, reason) = self.result();
        let mut status = match &self.verdict {
            Verdict::Passed => TestCaseStatus::success(),
            Verdict::KnownFault(_) => TestCaseStatus::skipped(),
            Verdict::Failed | Verdict::FaultGone(_) if self.outcome.error.is_some() => {
                TestCaseStatus::non_success(NonSuccessKind::Error)
            }
            Verdict::Failed | Verdict::FaultGone(_) => {
                TestCaseStatus::non_success(NonSuccessKind::Failure)
            }
        };
        if !matches!(self.verdict, Verdict::Passed) {
            status.set_message(reason.unwrap_or(result));
            status.set_description(self.text());
        }
        let mut case = TestCase::new(self.outcome.id, status);
        case.set_classname(info.name.as_str())
            .set_assertions(self.outcome.findings.len())
            .set_time(Duration::from_secs_f64(self.seconds))
            .add_property(("seed", self.outcome.seed.to_string().as_str()));
        case
    }

    /// Text for people: a line, with the failures below it.
    fn text(&self) -> String {
        let (result, reason) = self.result();
        let mut text = format!("  {:<44} {result:<11} {:>6.1} s", self.outcome.id, self.seconds);
        match self.worst() {
            Some(f) => {
                let ulp = f.worst_ulp.map_or("-".to_owned(), |ulp| format!("{ulp:.1}"));
                let own =
                    f.oracle_f32_of_bound.map_or("-".to_owned(), |share| format!("{share:.3}"));
                let _ = write!(
                    text,
                    "  {:>9.2e} {:>9.2e} {ulp:>9} {:>8.3} {own:>10}",
                    f.worst_absolute, f.worst_relative, f.worst_of_bound
                );
            }
            None => text += &format!("  {:>9}", "exact"),
        }
        text += "\n";
        let mut line = |what: String| text += &format!("      {what}\n");
        reason.into_iter().for_each(|reason| line(format!("expected: {reason}")));
        self.outcome.error.iter().for_each(|error| line(format!("error: {error}")));
        self.messages.iter().for_each(|message| line(format!("validation layer: {message}")));
        self.failures().take(SHOWN).for_each(|finding| line(blame(finding)));
        let more = self.failures().count().saturating_sub(SHOWN);
        if more > 0 {
            line(format!("and {more} more"));
        }
        if !self.is_fine() {
            line(format!("again: {}", self.again()));
        }
        text
    }
}

/// The deviation of an output from the oracle, and whether plain f32 arithmetic stays within the bound.
fn blame(f: &Finding) -> String {
    let Some(bound) = f.bound else {
        return format!(
            "{}: differs at {} of {}: {} instead of {}",
            f.output, f.worst_at, f.count, f.got, f.expected
        );
    };
    let own = match f.oracle_f32_of_bound {
        Some(share) if share <= 1.0 => "; f32 itself stays within it",
        Some(_) => "; f32 itself misses it too",
        None => "",
    };
    format!(
        "{}: off by {:.3e} ({:.3e} of the truth), {:.3} times the bound of {:e} + {:e} of the truth, \
         at {} of {}: {} instead of {}{own}",
        f.output,
        f.worst_absolute,
        f.worst_relative,
        f.worst_of_bound,
        bound.absolute,
        bound.relative,
        f.worst_at,
        f.count,
        f.got,
        f.expected
    )
}

fn finding_json(f: &Finding) -> Value {
    let bound = f.bound.map(|b| json!({ "absolute": b.absolute, "relative": b.relative }));
    json!({
        "output": f.output,
        "values": f.count,
        "bound": bound,
        "absolute": f.worst_absolute,
        "relative": f.worst_relative,
        "ulp": f.worst_ulp,
        "of_bound": f.worst_of_bound,
        "at": f.worst_at,
        "got": f.got,
        "expected": f.expected,
        "oracle_f32_absolute": f.oracle_f32_absolute,
        "oracle_f32_of_bound": f.oracle_f32_of_bound,
    })
}

/// All rows, grouped by device.
pub fn table(devices: &[DeviceInfo], rows: &[Row]) -> String {
    let mut text = String::new();
    for info in devices {
        let _ = writeln!(text, "{}  {} ({})", info.index, info.name, info.driver);
        let _ = writeln!(
            text,
            "  {:<44} {:<11} {:>8}  {:>9} {:>9} {:>9} {:>8} {:>10}",
            "case", "result", "time", "absolute", "relative", "ulp", "of bound", "f32 itself"
        );
        rows.iter().filter(|row| row.device == info.index).for_each(|row| text += &row.text());
    }
    text
}

/// All rows as a JUnit report: a suite for each device, a test case for each case. A known fault of the
/// driver is a skipped test; one that no longer shows is a failure.
pub fn junit(devices: &[DeviceInfo], rows: &[Row]) -> Report {
    let mut report = Report::new("splat4d validate");
    for info in devices {
        let mut suite = TestSuite::new(format!("{} ({})", info.name, info.driver));
        let mut time = Duration::ZERO;
        for row in rows.iter().filter(|row| row.device == info.index) {
            let case = row.junit(info);
            time += case.time.unwrap_or_default();
            suite.add_test_case(case);
        }
        suite.set_time(time);
        report.add_test_suite(suite);
    }
    report
}

/// The devices as JSON.
pub fn devices_json(devices: &[DeviceInfo]) -> Value {
    let one = |info: &DeviceInfo| json!({ "index": info.index, "name": info.name, "driver": info.driver });
    devices.iter().map(one).collect()
}
