//! The Vulkan part of `splat4d doctor`: loader, drivers, devices, and a smoke test of each device.
//!
//! What loads a driver runs in a child process, so that the report survives a driver that crashes.

use std::ffi::OsString;
use std::process::Stdio;
use std::time::Instant;

use serde_json::{Value, json};
use splat4d::check::EXPECTED;
use splat4d::error::excerpt;
use splat4d::{Error, Result, vk};

use super::child::{self, Ended};
use super::common::{bytes, say, vulkan_version};
use super::doctor::Findings;

/// Duration of a device's smoke test, seconds; the cases of [`FIRST`] run in any case.
const SMOKE_SECONDS: f64 = 5.0;
/// The cases that come before the quick ones: rendering, and two hundred training steps.
const FIRST: [&str; 2] = ["render/scene", "determinism/static_training"];

/// The loader and every device.
///
/// # Errors
/// The user has requested a stop.
pub fn vulkan(seed: u64, findings: &mut Findings) -> Result<Value> {
    const LOADER: &str = "Vulkan loader";
    let loader = match vk::loader_version() {
        Ok(version) => vulkan_version(version),
        Err(error) => {
            let (text, remedy) = parts(&error.to_string());
            findings.problem(LOADER, text, &remedy);
            return Ok(json!({ "loader": null, "error": error.to_string(), "devices": [] }));
        }
    };
    findings.ok(LOADER, format!("Vulkan {loader}"));
    let ended = answer(["devices".into()])?;
    let mut devices = match ended {
        Ok(mut found) => match found["devices"].take() {
            Value::Array(devices) => devices,
            _ => Vec::new(),
        },
        Err(failure) => {
            let (text, remedy) = match &failure {
                Failure::Said(error) => parts(error),
                Failure::Crashed(how) => (
                    format!("listing the devices crashes: {how}"),
                    "A driver or a layer is broken. Name one driver after the other in VK_DRIVER_FILES \
                     to find it, and update or remove it."
                        .into(),
                ),
            };
            findings.problem("Vulkan drivers", text, &remedy);
            return Ok(json!({ "loader": loader, "error": failure.text(), "devices": [] }));
        }
    };
    // What is missing on one device is a problem only if no other can be used.
    let usable = devices.iter().filter(|device| device["unfit"].is_null()).count();
    for device in &mut devices {
        describe(device, usable > 0, findings);
        device["smoke"] = match device["unfit"].is_null() {
            true => smoke(device, seed, findings)?,
            false => Value::Null,
        };
    }
    let is_software = |device: &Value| device["unfit"].is_null() && device["kind"] == "software";
    if usable > 0 && devices.iter().filter(|device| is_software(device)).count() == usable {
        findings.note(
            "GPU",
            "none can be used: a software driver gives the same results, slowly",
            "If the machine has a GPU, install or update its Vulkan driver.",
        );
    }
    Ok(json!({ "loader": loader, "error": null, "devices": devices }))
}

/// Reports a device, what it lacks and the known faults of its driver; adds the faults to its entry.
fn describe(device: &mut Value, others: bool, findings: &mut Findings) {
    let subject = subject(device);
    let text = |key: &str| device[key].as_str().unwrap_or_default().to_owned();
    let size = |key: &str| bytes(device[key].as_u64().unwrap_or(0));
    let what = format!(
        "{} ({}; driver {}; Vulkan {}; subgroups of {}; {})",
        text("name"),
        text("kind"),
        text("driver"),
        text("vulkan"),
        device["subgroup_size"],
        size("memory_bytes")
    );
    match device["unfit"].as_str() {
        None => findings.ok(
            &subject,
            format!("{what}; has all that the engine needs, {} free", size("free_bytes")),
        ),
        Some(why) => {
            let what = format!("{what} cannot be used: {why}");
            let remedy = "Update its driver; older devices may never have what is missing.";
            match others {
                true => findings.note(&subject, what, remedy),
                false => findings.problem(&subject, what, remedy),
            }
        }
    }
    let driver = text("driver");
    let faults: Vec<_> = EXPECTED.iter().filter(|fault| driver.contains(fault.driver)).collect();
    for fault in &faults {
        findings.note(
            &subject,
            format!("the driver is known to fail {}: {}", fault.case, fault.reason),
            "Look for a newer driver.",
        );
    }
    if faults.is_empty() && device["unfit"].is_null() {
        findings.ok(&subject, "no fault of this driver is known");
    }
    device["known_faults"] =
        faults.iter().map(|fault| json!({ "case": fault.case, "reason": fault.reason })).collect();
}

/// Runs the smoke test on a device.
fn smoke(device: &Value, seed: u64, findings: &mut Findings) -> Result<Value> {
    let subject = subject(device);
    let index = device["index"].to_string();
    say(&format!("{subject} is tested"));
    let started = Instant::now();
    let validate = |options: &[&str]| {
        let seed = seed.to_string();
        let words = ["validate", "--device", &index, "--seed", &seed];
        answer(words.iter().chain(options).map(OsString::from).collect::<Vec<_>>())
    };
    let mut ended = vec![validate(&["--filter", FIRST[0], "--filter", FIRST[1]])?];
    let left = SMOKE_SECONDS - started.elapsed().as_secs_f64();
    if ended[0].is_ok() && left > 0.5 {
        ended.push(validate(&["--quick", "--seconds", &left.to_string()])?);
    }
    let seconds = started.elapsed().as_secs_f64();
    let failure = ended.iter().find_map(|ended| ended.as_ref().err().map(Failure::text));
    let answers: Vec<&Value> = ended.iter().flatten().collect();
    let rows: Vec<&Value> =
        answers.iter().flat_map(|answer| answer["rows"].as_array()).flatten().collect();
    let named = |result: fn(&Value) -> bool| -> Vec<&str> {
        rows.iter()
            .filter(|row| result(&row["result"]))
            .flat_map(|row| row["case"].as_str())
            .collect()
    };
    let failed = named(|result| result == "failed" || result == "fault gone");
    let known = named(|result| result == "known fault");
    let left_out: u64 = answers.iter().flat_map(|answer| answer["left_out"].as_u64()).sum();
    let more = format!(
        "Update the driver. Attach the page that `splat4d validate --device {index} --report bug.html` \
         writes to the report."
    );
    let subject = format!("{subject}, smoke test");
    if let Some(failure) = &failure {
        findings.problem(&subject, failure.clone(), &more);
    }
    let ran = format!("{} cases in {seconds:.1} s", rows.len());
    if !failed.is_empty() {
        findings.problem(&subject, format!("of {ran} failed {}", failed.join(", ")), &more);
    } else if failure.is_none() {
        let known = match known.len() {
            0 => String::new(),
            count => format!(", {count} of them with a known fault"),
        };
        findings.ok(&subject, format!("{ran} passed, rendering and training among them{known}"));
    }
    Ok(json!({
        "cases": rows.len(),
        "failed": failed,
        "known_faults": known,
        "left_out": left_out,
        "seconds": seconds,
        "error": failure,
    }))
}

fn subject(device: &Value) -> String {
    format!("device {}", device["index"])
}

/// Why a child process gave no answer.
enum Failure {
    /// It reported an error.
    Said(String),
    /// It ended otherwise: how, with its last message.
    Crashed(String),
}

impl Failure {
    fn text(&self) -> String {
        match self {
            Failure::Said(error) => error.clone(),
            Failure::Crashed(how) => format!("the process crashed: {how}"),
        }
    }
}

/// Runs a command of this program as a child, and returns its JSON object unless that is an error.
fn answer(
    words: impl IntoIterator<Item = OsString>,
) -> Result<std::result::Result<Value, Failure>> {
    let words = words.into_iter().chain(["--json".into()]);
    let Ended { status, answer, messages } = match child::end_of(words, Stdio::piped()) {
        Ok(ended) => ended,
        Err(interrupted @ Error::Interrupted { .. }) => return Err(interrupted),
        Err(error) => return Ok(Err(Failure::Said(error.to_string()))),
    };
    if let Some(error) = answer["error"].as_str() {
        return Ok(Err(Failure::Said(error.to_owned())));
    }
    if answer.is_object() {
        return Ok(Ok(answer));
    }
    let last = messages.lines().map(str::trim).rfind(|line| !line.is_empty());
    let last =
        last.map_or_else(String::new, |line| format!("; its last message is {}", excerpt(line)));
    Ok(Err(Failure::Crashed(format!("{status}{last}"))))
}

/// An error of the engine, split into what is wrong and what to do.
fn parts(error: &str) -> (String, String) {
    match error.split_once("; ") {
        Some((what, remedy)) => (what.to_owned(), format!("To do: {remedy}.")),
        None => (error.to_owned(), "`splat4d devices` repeats it.".to_owned()),
    }
}
