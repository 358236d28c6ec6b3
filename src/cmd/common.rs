//! What all commands share: their common flags, what they answer, words for people.

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

/// The flags that every command takes.
#[derive(Args)]
pub struct Common {
    /// Print exactly one JSON object on stdout, everything else on stderr
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
    /// Decides everything random; the same seed on the same device gives the same result
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
    /// The same flags for another command of this program.
    pub fn arguments(&self) -> [OsString; 4] {
        let (device, seed) = (self.device.clone().into(), self.seed.to_string().into());
        ["--device".into(), device, "--seed".into(), seed]
    }

    /// Opens the device; a software driver that was not asked for is pointed out.
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

/// Number of processors, as far as the system tells.
fn processors() -> u64 {
    std::thread::available_parallelism().map_or(1, |count| count.get() as u64)
}

/// That there is room for the program itself and a thread for each processor. Rust ends a program that
/// cannot have a few bytes, so that what is far too little is told first.
pub fn check_room() -> Result<()> {
    check_limits((64 << 20) + (4 << 20) * processors(), "splat4d")
}

/// That there is address space for Vulkan drivers. Of what they cannot have some make faults instead of
/// errors: a software driver maps a compiler, and a stack and a heap for each of up to 32 threads.
pub fn check_room_for_drivers() -> Result<()> {
    check_limits((1 << 30) + (72 << 20) * processors().min(32), "opening a Vulkan device")
}

/// What a command found out: for machines, and for people.
pub struct Answer {
    /// One object.
    pub json: Value,
    /// Whole lines.
    pub text: String,
}

/// Whether a machine has its object.
static ANSWERED: AtomicBool = AtomicBool::new(false);

/// A machine's one object on stdout: the first. What serves gives it when it begins to, and what is wrong
/// later stands on stderr alone.
pub fn print_json(value: &Value) -> std::io::Result<()> {
    if ANSWERED.swap(true, Ordering::SeqCst) {
        return Ok(());
    }
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{value}")?;
    stdout.flush()
}

/// A line on stderr. Nobody listening is no error.
pub fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Lines on stderr, each as a note.
pub fn notes(lines: &[String]) {
    lines.iter().for_each(|line| say(&format!("note: {line}")));
}

/// What is to be said where a training had gradients that were not finite.
pub fn broken_gradients(trained: &Value) -> Option<String> {
    let count = trained["broken_gradients"].as_u64().filter(|count| *count > 0)?;
    Some(format!(
        "{count} gradients were not a number or infinite and were left out; look for cameras that do not \
         fit their pictures, or check the driver with `splat4d validate`"
    ))
}

/// A path as JSON holds it: as text, in which what is not Unicode is replaced.
pub fn path_text(path: &Path) -> Value {
    path.to_string_lossy().into()
}

/// Pictures whose (splat, tile) pairs are counted beforehand, at most.
const MOST_COUNTED: usize = 64;

/// The most (splat, tile) pairs of some pictures, which `at` gives; of many, those of an even choice.
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
        // Those between may have some more.
        most = most.saturating_add(most / 4);
    }
    Ok(usize::try_from(most).unwrap_or(usize::MAX))
}

/// A training in words, for [`foresee`]: growth may not reach the most that there is room for.
pub fn training(scale: &TrainingScale) -> String {
    let (reached, most) = (scale.reached(), scale.settings.max_gaussians);
    let text = format!("training up to {} Gaussians", thousands(reached));
    match most > reached {
        true => format!("{text} with --max-gaussians {}", thousands(most)),
        false => text,
    }
}

/// Says how much device memory some work will take, and gives it; an error where it does not fit, with
/// the most Gaussians that would, where there are any, and what to turn.
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
                // Its memory is the machine's.
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

/// Bytes in the largest unit that leaves a number above 1.
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
