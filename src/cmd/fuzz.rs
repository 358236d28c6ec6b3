//! `splat4d validate --fuzz` and `--case`: random scenes, and repetition of one of them.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use serde_json::json;
use splat4d::check::fuzz::{self, FuzzScene};
use splat4d::gpu::Device;
use splat4d::vk::DeviceInfo;
use splat4d::{Error, Result, io};

use super::common::{Answer, path_text, say};
use super::interrupt;
use super::meter::Meter;
use super::outputs::Outputs;
use super::rows::devices_json;

/// Number of failures after which testing of a device ends.
const ENOUGH: usize = 10;

/// Tests `count` scenes on every device; failures are minimised and written to the working folder.
pub fn run(devices: &[(DeviceInfo, Device)], count: u64, seed: u64) -> Result<(Answer, ExitCode)> {
    let case = |scene: u64| PathBuf::from(format!("fuzz-{seed}-{scene}.json"));
    Outputs::default().file(&case(count))?;
    let started = Instant::now();
    let mut meter = Meter::new("fuzz", "scenes", count * devices.len() as u64, 0);
    let (mut failures, mut judged, mut text) = (Vec::new(), 0, String::new());
    for (info, device) in devices {
        let (mut next, mut found) = (0, 0);
        while next < count && found < ENOUGH {
            let failure = fuzz::run(device, seed, next..count, &mut || {
                meter.advance();
                interrupt::check()
            })?;
            let messages = device.take_validation_messages();
            if !messages.is_empty() {
                return Err(Error::Failed(format!(
                    "the validation layer complains on {}: {}",
                    info.name,
                    messages.join("; ")
                )));
            }
            let Some(failure) = failure else {
                judged += count - next;
                break;
            };
            judged += failure.index + 1 - next;
            next = failure.index + 1;
            found += 1;
            meter.advance();
            let path = case(failure.index);
            let text_of = fuzz::file::text(&failure.scene);
            io::write_atomically(&path, |sink| sink.write_all(text_of.as_bytes()))?;
            let line = format!(
                "{}: scene {} of seed {seed}: {}; again: splat4d validate --device {} --case {}",
                info.name,
                failure.index,
                failure.what,
                info.index,
                path.display()
            );
            say(&line);
            text += &format!("{line}\n");
            failures.push(json!({
                "device": info.index,
                "scene": failure.index,
                "what": failure.what,
                "file": path_text(&path),
            }));
        }
    }
    drop(meter);
    let (failed, seconds) = (failures.len(), started.elapsed().as_secs_f64());
    text += &format!("{judged} scenes, {failed} failed, {seconds:.1} s\n");
    let infos: Vec<DeviceInfo> = devices.iter().map(|(info, _)| info.clone()).collect();
    let json = json!({
        "cases": judged,
        "failed": failed,
        "seconds": seconds,
        "devices": devices_json(&infos),
        "rows": failures,
    });
    Ok((Answer { json, text }, ExitCode::from(u8::from(failed > 0))))
}

/// The file of a failed scene.
pub struct FuzzCase {
    path: PathBuf,
    scene: FuzzScene,
}

impl FuzzCase {
    /// Reads the file.
    pub fn read(path: &Path) -> Result<FuzzCase> {
        Ok(FuzzCase { path: path.to_owned(), scene: fuzz::file::read(path)? })
    }
}

/// Tests the scene of a file on every device.
pub fn repeat(devices: &[(DeviceInfo, Device)], case: &FuzzCase) -> Result<(Answer, ExitCode)> {
    let started = Instant::now();
    let FuzzCase { path, scene } = case;
    let (mut rows, mut text, mut failed) = (Vec::new(), String::new(), 0);
    for (info, device) in devices {
        let wrong = fuzz::judge(device, &mut device.stream()?, scene)?;
        let messages = device.take_validation_messages();
        let wrong = wrong.or_else(|| messages.into_iter().next());
        failed += usize::from(wrong.is_some());
        let what = wrong.as_deref().unwrap_or("as the oracle");
        text += &format!("{}: {what}\n", info.name);
        rows.push(json!({ "device": info.index, "what": wrong, "file": path_text(path) }));
    }
    let infos: Vec<DeviceInfo> = devices.iter().map(|(info, _)| info.clone()).collect();
    let json = json!({
        "cases": rows.len(),
        "failed": failed,
        "seconds": started.elapsed().as_secs_f64(),
        "devices": devices_json(&infos),
        "rows": rows,
    });
    Ok((Answer { json, text }, ExitCode::from(u8::from(failed > 0))))
}
