//! Pictures to a video, through ffmpeg.

use std::path::Path;
use std::process::{Command, Stdio};

use splat4d::error::excerpt;
use splat4d::{Error, Result, io};

/// Whether an output is to be a video.
pub fn is_video(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mp4"))
}

/// That ffmpeg is there, before long work begins.
pub fn check(path: &Path) -> Result<()> {
    let found = Command::new("ffmpeg").arg("-version").stdin(Stdio::null()).output();
    found.map(drop).map_err(|_| {
        Error::Input(format!(
            "{}: writing a video needs the program ffmpeg, which was not found. Install it \
             (Debian, Ubuntu: apt-get install ffmpeg), or name a folder to get pictures",
            path.display()
        ))
    })
}

/// Encodes `folder/0000.png` … as H.264; the video appears by rename.
pub fn encode(folder: &Path, rate: f64, output: &Path) -> Result<()> {
    const PARTIAL: &str = "whole.mp4";
    let done = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-y", "-framerate", &rate.to_string(), "-i"])
        // In the folder: in its name a % would be taken for a part of the pattern.
        .arg("%04d.png")
        .current_dir(folder)
        // Players want even sides and subsampled colour.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"])
        .args(["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart"])
        .arg(PARTIAL)
        .stdin(Stdio::null())
        .output()
        .map_err(Error::io("ffmpeg"))?;
    if !done.status.success() {
        let said = String::from_utf8_lossy(&done.stderr);
        let last = said.lines().map(str::trim).rfind(|line| !line.is_empty());
        let why = last.map_or("it gives no reason".into(), excerpt);
        return Err(Error::Failed(format!("ffmpeg cannot write {}: {why}", output.display())));
    }
    let partial = folder.join(PARTIAL);
    let mut whole = splat4d::io::open(&partial)?;
    io::write_atomically(output, |sink| std::io::copy(&mut whole, sink).map(drop))
}
