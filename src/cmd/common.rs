//! Common code of all commands: shared options, answers, text formatting.

use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use serde_json::Value;
use splat4d::gpu::{Device, DeviceKind, Footprint, Request, Selector};
use splat4d::io::{check_limits, check_memory};
use splat4d::renderer::Renderer;
use splat4d::train::TrainingScale;
use splat4d::types::Camera;
use splat4d::{Error, Result};

use super::{interrupt, values};

/// Options of every command.
#[derive(Args)]
pub struct Common {
    /// Print exactly one JSON object on stdout, and everything else on stderr
    #[arg(long, global = true, help_heading = "Common options")]
    pub json: bool,
    /// The Vulkan device: its index, a part of its name, or a kind: best, gpu, discrete, integrated,
    /// virtual, software
    #[arg(
        long,
        global = true,
        help_heading = "Common options",
        value_name = "DEVICE",
        default_value = "best"
    )]
    pub device: String,
    /// Random seed; the same seed on the same device gives the same result
    #[arg(
        long,
        global = true,
        help_heading = "Common options",
        value_name = "NUMBER",
        default_value_t = 0,
        value_parser = values::whole::<u64>(0..=u64::MAX)
    )]
    pub seed: u64,
}

impl Common {
    /// The same options for another command of this program.
    pub fn arguments(&self) -> [OsString; 4] {
        let (device, seed) = (self.device.clone().into(), self.seed.to_string().into());
        ["--device".into(), device, "--seed".into(), seed]
    }

    /// Opens the device; prints a note about a software driver that was not requested.
    pub fn open_device(&self) -> Result<Device> {
        check_room_for_drivers()?;
        let selector = Selector::from(self.device.as_str());
        let asked = selector != Selector::Best;
        let device = Device::open(&Request { selector, ..Request::default() })?;
        let info = device.info();
        if !asked && info.kind == DeviceKind::Software {
            say(&format!(
                "note: no GPU found, {} runs on the processor; it gives the same results slowly",
                info.name
            ));
        }
        Ok(device)
    }
}

/// Number of processors, as reported by the system.
pub fn processors() -> u64 {
    std::thread::available_parallelism().map_or(1, |count| count.get() as u64)
}

/// Checks that memory suffices for the program itself and a thread for each processor. Rust aborts when a
/// small allocation fails, so a far too small limit is reported first.
pub fn check_room() -> Result<()> {
    check_limits((64 << 20) + (4 << 20) * processors(), "splat4d")
}

/// Checks that address space suffices for Vulkan drivers. Some drivers crash instead of returning an error:
/// a software driver maps a compiler, and a stack and a heap for each of up to 32 threads.
pub fn check_room_for_drivers() -> Result<()> {
    check_limits((1 << 30) + (72 << 20) * processors().min(32), "opening a Vulkan device")
}

/// Result of a command, for machines and for people.
pub struct Answer {
    /// One JSON object.
    pub json: Value,
    /// Complete lines of text.
    pub text: String,
}

/// Whether the JSON object has been printed.
static ANSWERED: AtomicBool = AtomicBool::new(false);

/// Prints the one JSON object on stdout; only the first call prints. A server prints it when it starts, and
/// reports later errors on stderr only.
pub fn print_json(value: &Value) -> std::io::Result<()> {
    if ANSWERED.swap(true, Ordering::SeqCst) {
        return Ok(());
    }
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{value}")?;
    stdout.flush()
}

/// Prints a line on stderr. Write errors are ignored.
pub fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Prints lines on stderr, each as a note.
pub fn notes(lines: &[String]) {
    lines.iter().for_each(|line| say(&format!("note: {line}")));
}

/// Shows a note about a training with non-finite gradients, and adds it to `all`.
pub fn note_broken_gradients(trained: &Value, all: &mut Vec<String>) {
    let count = trained["broken_gradients"].as_u64().unwrap_or(0);
    if count == 0 {
        return;
    }
    let note = format!(
        "{count} gradients were not a number or infinite and were left out; look for cameras that do not \
         fit their images, or check the driver with `splat4d validate`"
    );
    notes(std::slice::from_ref(&note));
    all.push(note);
}

/// A path as a JSON string; invalid Unicode is replaced.
pub fn path_text(path: &Path) -> Value {
    path.to_string_lossy().into()
}

/// Maximum number of images whose (splat, tile) pairs are counted in advance.
const MOST_COUNTED: usize = 64;

/// The maximum number of (splat, tile) pairs over some images, given by `at`; of many images, an even
/// selection is counted.
pub fn most_pairs(
    renderer: &mut Renderer,
    pictures: usize,
    at: impl Fn(usize) -> (Camera, f64),
) -> Result<usize> {
    let counted = pictures.min(MOST_COUNTED);
    let mut most = 0;
    for i in 0..counted {
        interrupt::check()?;
        let (camera, time) = at(i * pictures / counted);
        most = most.max(renderer.count(&camera, time)?);
    }
    if counted < pictures {
        // The images in between may have slightly more.
        most = most.saturating_add(most / 4);
    }
    Ok(usize::try_from(most).unwrap_or(usize::MAX))
}

/// A training in words, for [`foresee`]; growth may stay below the maximum for which memory is reserved.
pub fn training(scale: &TrainingScale) -> String {
    let (reached, most) = (scale.reached(), scale.settings.max_gaussians);
    let text = format!("training up to {} Gaussians", thousands(reached));
    match most > reached {
        true => format!("{text} with --max-gaussians {}", thousands(most)),
        false => text,
    }
}

/// Prints and returns the predicted device memory of some work; an error where it does not fit, with the
/// largest number of Gaussians that would, if any, and the option to change.
pub fn foresee(
    device: &Device,
    what: &str,
    footprint: Result<Footprint>,
    most_gaussians: impl FnOnce() -> usize,
    turn: &str,
) -> Result<u64> {
    let name = &device.info().name;
    match footprint.and_then(|taken| taken.fits(device).map(|()| taken)) {
        Ok(taken) => {
            if device.info().kind == DeviceKind::Software {
                // A software device uses the machine's memory.
                check_memory(taken.bytes, what)?;
            }
            let free = bytes(device.free_memory());
            say(&format!("{what} takes {} of the {free} that {name} has free", bytes(taken.bytes)));
            Ok(taken.bytes)
        }
        Err(error @ (Error::RangeLimit { .. } | Error::TooLarge { .. })) => {
            let would = match most_gaussians() {
                0 => turn.to_owned(),
                most => format!("{} Gaussians would fit: {turn}", thousands(most)),
            };
            Err(Error::Input(format!("{what} does not fit on {name}: {error}; {would}")))
        }
        Err(other) => Err(other),
    }
}

/// `1234567` as `1,234,567`.
pub fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// A byte count in the largest unit that gives a number above 1.
pub fn bytes(count: u64) -> String {
    let units = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = count as f64;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < units.len() {
        value /= 1024.0;
        unit += 1;
    }
    if unit == 0 { format!("{count} B") } else { format!("{value:.1} {}", units[unit]) }
}

/// A version in Vulkan's packed encoding: variant (3 bits), major (7), minor (10), patch (12).
pub fn vulkan_version(packed: u32) -> String {
    format!("{}.{}.{}", packed >> 22 & 0x7f, packed >> 12 & 0x3ff, packed & 0xfff)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_for_people() {
        assert_eq!(thousands(0), "0");
        assert_eq!(thousands(999), "999");
        assert_eq!(thousands(1_234_567), "1,234,567");
        assert_eq!(bytes(512), "512 B");
        assert_eq!(bytes(1536), "1.5 KiB");
        assert_eq!(bytes(3 << 30), "3.0 GiB");
    }
}
