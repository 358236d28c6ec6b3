//! Draws frames at a steady rate from a moving camera, and times how long the host thread spends on each.

use crate::Result;
use crate::scene;
use crate::stage::Stage;
use std::fmt;
use std::time::{Duration, Instant};

/// Maximum number of frames in flight. The host waits for the device only to keep this limit.
const IN_FLIGHT: usize = 2;

/// The timings, one entry per frame.
pub struct Report {
    rate: u32,
    calls: [(&'static str, Vec<Duration>); 5],
    waits: Vec<Duration>,
    late: usize,
}

/// Draws `frames` frames, each at its time: `rate` is in Hz.
pub fn run(stage: &mut Stage, frames: u32, rate: u32) -> Result<Report> {
    let (mut record, mut retire, mut both) = (Vec::new(), Vec::new(), Vec::new());
    let (mut encode, mut submit) = (Vec::new(), Vec::new());
    let mut waits = Vec::new();
    let mut late = 0;
    let start = Instant::now();
    for frame in 0..frames {
        let due = start + Duration::from_secs(1) * frame / rate;
        match due.checked_duration_since(Instant::now()) {
            Some(rest) => std::thread::sleep(rest),
            None => late += usize::from(frame > 0),
        }
        let settled = stage.settle(IN_FLIGHT - 1)?;
        let time = stage.draw(&scene::camera(frame))?;
        waits.push(settled.wait);
        retire.push(settled.retire);
        record.push(time.record);
        encode.push(time.encode);
        submit.push(time.submit);
        both.push(time.record + time.submit);
        if settled.cut > 0 {
            println!("frame {frame}: an earlier one had too little room, made by now");
        }
    }
    // The last frame is checked and saved afterwards, so it must be complete.
    stage.draw_whole(&scene::camera(frames - 1))?;
    let calls = [
        ("splat4d: record", record),
        ("splat4d: retire", retire),
        ("wgpu: submit", submit),
        ("record + submit", both),
        ("wgpu: encode", encode),
    ];
    Ok(Report { rate, calls, waits, late })
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let frames = self.waits.len();
        writeln!(f, "{frames} frames at {} Hz, at most {IN_FLIGHT} in flight", self.rate)?;
        writeln!(f, "on the host's thread, ms    median   longest")?;
        for (call, times) in &self.calls {
            let mut sorted = times.clone();
            sorted.sort_unstable();
            let (median, longest) = (sorted[sorted.len() / 2], sorted[sorted.len() - 1]);
            let ms = |time: Duration| time.as_secs_f64() * 1e3;
            writeln!(f, "{call:<24} {:>9.3} {:>9.3}", ms(median), ms(longest))?;
        }
        let waited = self.waits.iter().filter(|wait| **wait > Duration::from_millis(1)).count();
        let longest = self.waits.iter().max().copied().unwrap_or_default().as_secs_f64() * 1e3;
        writeln!(
            f,
            "the host waited for the device before {waited} frames, {longest:.1} ms at most; {} \
             began late",
            self.late
        )
    }
}
