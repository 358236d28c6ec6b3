//! Encodes images to a video, through ffmpeg.

use std::io::{ErrorKind, Read};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use splat4d::error::excerpt;
use splat4d::{Error, Result, io};

use super::interrupt;

/// Whether an output path is a video.
pub fn is_video(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mp4"))
}

/// Checks that ffmpeg is available and runs, before long work begins.
pub fn check(path: &Path) -> Result<()> {
    run(Command::new("ffmpeg").arg("-version"), path)
}

/// Encodes `folder/0000.png` … as H.264; the video appears by rename.
pub fn encode(folder: &Path, rate: f64, output: &Path) -> Result<()> {
    const PARTIAL: &str = "whole.mp4";
    let mut command = Command::new("ffmpeg");
    command
        .args(["-nostdin", "-v", "error", "-y", "-framerate", &rate.to_string(), "-i"])
        // Run in the folder, because a % in its name would be interpreted as part of the pattern.
        .arg("%04d.png")
        .current_dir(folder)
        // Most players require even sides and chroma subsampling.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"])
        .args(["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart"])
        .arg(PARTIAL);
    run(&mut command, output)?;
    let mut whole = io::open(&folder.join(PARTIAL))?;
    io::write_atomically(output, |sink| std::io::copy(&mut whole, sink).map(drop))
}

/// Runs ffmpeg until it ends, or until the user requests a stop.
fn run(command: &mut Command, output: &Path) -> Result<()> {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    // A Ctrl-C in the terminal should reach only this program, which then ends the child.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    let mut child = command.spawn().map_err(|error| match error.kind() {
        ErrorKind::NotFound => Error::Input(format!(
            "{}: writing a video needs the program ffmpeg, which was not found. Install it \
             (Debian, Ubuntu: apt-get install ffmpeg), or name a folder to get images",
            output.display()
        )),
        _ => Error::Failed(format!("{}: ffmpeg cannot be started: {error}", output.display())),
    })?;
    let mut stderr = child.stderr.take().expect("stderr is piped");
    // Read in a thread, because a full pipe would block ffmpeg.
    let said = std::thread::spawn(move || {
        let mut said = Vec::new();
        // A read error here only shortens a message.
        let _ = stderr.read_to_end(&mut said);
        String::from_utf8_lossy(&said).into_owned()
    });
    let status = loop {
        match child.try_wait().map_err(Error::io("ffmpeg"))? {
            Some(status) => break status,
            None => std::thread::sleep(Duration::from_millis(20)),
        }
        if let Err(interrupted) = interrupt::check() {
            // It may have ended already.
            let _ = child.kill();
            let _ = child.wait();
            return Err(interrupted);
        }
    };
    if status.success() {
        return Ok(());
    }
    let said = said.join().unwrap_or_default();
    let last = said.lines().map(str::trim).rfind(|line| !line.is_empty());
    let why = last.map_or_else(|| format!("it ends with {status}"), excerpt);
    Err(Error::Failed(format!("ffmpeg cannot write {}: {why}", output.display())))
}
