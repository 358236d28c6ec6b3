//! Video files, through the `ffmpeg` program.
//!
//! ffmpeg writes the frames as PPM pictures into a pipe: each carries its own size, so that rotated
//! phone videos need no case of their own, and nothing touches the disk.

use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};

use super::ClipOptions;
use super::images::resize;
use crate::types::Image;
use crate::{Error, Result};

/// The frames of a video.
pub struct Decoded {
    /// Number in the video and picture.
    pub frames: Vec<(String, Image)>,
    /// Width and height of the frames before they were resized.
    pub original: (u32, u32),
    /// Frames a second of the file, where `ffprobe` tells.
    pub rate: Option<f64>,
}

/// Decodes a video with the `ffmpeg` that the system finds.
pub fn decode(path: &Path, options: &ClipOptions) -> Result<Decoded> {
    decode_with(OsStr::new("ffmpeg"), OsStr::new("ffprobe"), path, options)
}

/// Decodes a video with the given programs.
///
/// # Errors
/// The program is missing (the message says how to install it or do without), or it cannot read the
/// file (the message is its own).
pub fn decode_with(
    ffmpeg: &OsStr,
    ffprobe: &OsStr,
    path: &Path,
    options: &ClipOptions,
) -> Result<Decoded> {
    // `file:` keeps a name such as `-x.mp4` or `concat:a` from being read as something else.
    let mut input = OsString::from("file:");
    input.push(path);
    // Frames are to come out as they went in. The option for that changed its name with ffmpeg 5.1,
    // and each name is unknown to some version in use.
    let (frames, original) = match run(ffmpeg, &input, path, options, ["-fps_mode", "passthrough"])
    {
        Err(Error::Format { what, .. }) if what.contains("'fps_mode'") => {
            run(ffmpeg, &input, path, options, ["-vsync", "0"])
        }
        other => other,
    }?;
    Ok(Decoded { frames, original, rate: rate(ffprobe, &input) })
}

/// Names and pictures, and the size that they had.
type Frames = (Vec<(String, Image)>, (u32, u32));

/// Runs ffmpeg once and takes the frames that it writes.
fn run(
    ffmpeg: &OsStr,
    input: &OsStr,
    path: &Path,
    options: &ClipOptions,
    timing: [&str; 2],
) -> Result<Frames> {
    let mut command = Command::new(ffmpeg);
    command.args(["-nostdin", "-v", "error", "-i"]).arg(input);
    command.args(["-map", "0:v:0", "-vf"]);
    command.arg(format!("select=not(mod(n\\,{}))", options.every));
    command.args(timing);
    if let Some(most) = options.max_frames {
        command.args(["-frames:v", &most.to_string()]);
    }
    command.args(["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::Input(format!(
            "{}: reading a video needs the program ffmpeg, which was not found. Install it \
             (Debian, Ubuntu: apt-get install ffmpeg), or extract the frames elsewhere and give \
             the folder of images",
            path.display()
        )),
        _ => Error::Failed(format!("{} could not be started: {e}", ffmpeg.display())),
    })?;
    let mut errors = child.stderr.take().expect("stderr is piped");
    // Read beside the frames: a full pipe of messages would stop ffmpeg.
    let errors = std::thread::spawn(move || {
        let mut text = Vec::new();
        // What cannot be read here only shortens a message.
        let _ = errors.read_to_end(&mut text);
        String::from_utf8_lossy(&text).into_owned()
    });
    let stdout = child.stdout.take().expect("stdout is piped");
    let frames = read_frames(path, &mut BufReader::with_capacity(1 << 20, stdout), options);
    if frames.is_err() {
        // Nobody reads on, so that it would wait forever; it may also be gone already.
        let _ = child.kill();
    }
    let status = child.wait().map_err(Error::io(path))?;
    let errors = errors.join().unwrap_or_default();
    let frames = frames?;
    if !status.success() {
        let lines: Vec<&str> = errors.lines().map(str::trim).filter(|l| !l.is_empty()).collect();
        let message = match lines[..] {
            [] => "it gives no reason".to_string(),
            [.., before, last] => format!("{before}; {last}"),
            [only] => only.to_string(),
        };
        return Err(Error::format(path, format!("ffmpeg cannot read it as a video: {message}")));
    }
    Ok(frames)
}

fn read_frames(path: &Path, from: &mut impl BufRead, options: &ClipOptions) -> Result<Frames> {
    let mut frames = Vec::new();
    let mut original = (0, 0);
    while !from.fill_buf().map_err(Error::io(path))?.is_empty() {
        let image = read_ppm(from).map_err(Error::io(path))?;
        original = (image.width, image.height);
        let (width, height) = options.size.target(image.width, image.height);
        let name = format!("{:05}", frames.len() * options.every);
        frames.push((name, resize(&image, width, height)));
        let (first, last) = (&frames[0].1, &frames[frames.len() - 1].1);
        if (first.width, first.height) != (last.width, last.height) {
            let what = format!("frame {} has another size than the first", frames.len() - 1);
            return Err(Error::format(path, what));
        }
    }
    Ok((frames, original))
}

/// Reads a binary PPM of 8 bits as ffmpeg writes it.
fn read_ppm(from: &mut impl BufRead) -> std::io::Result<Image> {
    let odd = || std::io::Error::other("ffmpeg gave something else than a PPM picture");
    let mut words = Vec::new();
    while words.len() < 4 {
        let mut line = Vec::new();
        if from.by_ref().take(64).read_until(b'\n', &mut line)? == 0 {
            return Err(odd());
        }
        let line = String::from_utf8(line).map_err(|_| odd())?;
        words.extend(line.split_ascii_whitespace().map(str::to_string));
    }
    let number = |word: &str| word.parse::<u32>().ok().filter(|&n| n > 0 && n < 1 << 16);
    match (words[0].as_str(), number(&words[1]), number(&words[2]), words[3].as_str()) {
        ("P6", Some(width), Some(height), "255") => {
            let mut bytes = vec![0; width as usize * height as usize * 3];
            from.read_exact(&mut bytes)?;
            let pixels = bytes.iter().map(|&b| f32::from(b) / 255.0).collect();
            Ok(Image { width, height, channels: 3, pixels })
        }
        _ => Err(odd()),
    }
}

/// Frames a second; `None` where `ffprobe` is missing or does not know.
fn rate(ffprobe: &OsStr, input: &OsStr) -> Option<f64> {
    let output = Command::new(ffprobe)
        .args(["-v", "error", "-select_streams", "v:0", "-show_entries"])
        .args(["stream=avg_frame_rate", "-of", "default=nw=1:nk=1"])
        .arg(input)
        .stdin(Stdio::null())
        .output()
        .ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    let (over, under) = text.trim().split_once('/')?;
    let rate = over.parse::<f64>().ok()? / under.parse::<f64>().ok()?;
    (rate.is_finite() && rate > 0.0).then_some(rate)
}
