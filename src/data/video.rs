//! Video files, through the `ffmpeg` program.
//!
//! ffmpeg writes the frames as PPM pictures into a pipe: each carries its own size, so that rotated
//! phone videos need no case of their own, and nothing touches the disk.
//!
//! ffmpeg goes on where a video is damaged: it conceals what it cannot decode, leaves frames out and
//! ends as if all were well. What it says of that on stderr is read, and then the video is looked
//! through frame by frame (`damage`).

use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread::{JoinHandle, spawn};
use std::time::Duration;

use super::ClipOptions;
use super::clip::{foresee, hint_skip, room_for};
use super::images::resize;
use crate::types::Image;
use crate::{Error, Result};

mod damage;

/// The frames of a video.
pub struct Decoded {
    /// Number in the whole video, and picture.
    pub frames: Vec<(usize, Image)>,
    /// Width and height of the frames before they were resized.
    pub original: (u32, u32),
    /// Frames a second of the file, where `ffprobe` tells.
    pub rate: Option<f64>,
    /// Frames of the whole video; `None` where that is not known.
    pub total: Option<usize>,
    /// Frames left out because they are damaged or lost.
    pub skipped: usize,
    /// Lines to show.
    pub notes: Vec<String>,
}

/// Decodes a video with the `ffmpeg` that the system finds; see [`decode_with`].
pub fn decode(path: &Path, options: &ClipOptions, go_on: GoOn) -> Result<Decoded> {
    decode_with(OsStr::new("ffmpeg"), OsStr::new("ffprobe"), path, options, go_on)
}

/// Asked several times a second whether to go on; its error ends the work and is passed on.
pub type GoOn<'a> = &'a (dyn Fn() -> Result<()> + Sync);

/// Decodes a video with the given programs.
///
/// # Errors
/// The program is missing (the message says how to install it or do without) or cannot be started,
/// it cannot read the file (the message is its own), frames are damaged or lost (unless
/// `skip_bad`), more frames than there is memory for; those of `go_on`.
pub fn decode_with(
    ffmpeg: &OsStr,
    ffprobe: &OsStr,
    path: &Path,
    options: &ClipOptions,
    go_on: GoOn,
) -> Result<Decoded> {
    // `file:` keeps a name such as `-x.mp4` or `concat:a` from being read as something else.
    let mut input = OsString::from("file:");
    input.push(path);
    let told = Told::by(ffprobe, &input);
    let most = options.max_frames.unwrap_or(usize::MAX);
    if let (Some(count), Some((width, height))) = (told.packets, told.size) {
        let taken = count.div_ceil(options.every).min(most);
        foresee(path, taken, options.size.target(width, height))?;
    }
    let source = Source { ffmpeg, input: &input, path, options, go_on };
    let every = &mut |i: usize| Some(i * options.every);
    let mut run = source.run(options.every, options.max_frames, every)?;
    let complaint = run.said.lines().find_map(|line| told.complaint(line));
    let complaint = complaint.or(run.failed.take());
    let whole = options.every == 1 && options.max_frames.is_none();
    let mut decoded = Decoded {
        total: if whole { Some(run.frames.len()) } else { told.packets },
        original: run.original,
        rate: told.rate,
        skipped: 0,
        notes: Vec::new(),
        frames: Vec::new(),
    };
    if let Some(complaint) = complaint {
        let seen = damage::inspect(ffprobe, &input, &told, &run.said);
        decoded.total = seen.as_ref().and_then(|seen| seen.total);
        let chosen = |seen: &damage::Seen| (0..seen.whole.len()).step_by(options.every).take(most);
        let bad: Vec<usize> =
            seen.iter().flat_map(|s| chosen(s).filter(|&n| !s.whole[n])).collect();
        let harmless = seen.as_ref().is_some_and(|seen| seen.finds_all() && bad.is_empty());
        if !harmless {
            let of = seen.as_ref().map_or(0, |seen| chosen(seen).count());
            let missing = seen.as_ref().map_or(0, |seen| seen.missing);
            let (what, then) = match (bad.first(), missing) {
                (Some(first), _) => (
                    format!(
                        "{} of {of} frames are damaged or lost, the first is frame {first}",
                        bad.len()
                    ),
                    "they are left out",
                ),
                (None, 0) => (
                    "the video is damaged or cut short, and which frames that spoils is not known"
                        .to_string(),
                    "all that can be decoded is taken",
                ),
                (None, _) => ("the video is cut short".to_string(), "what is there is taken"),
            };
            let missing = match missing {
                0 => String::new(),
                n => format!("; {n} more are missing"),
            };
            if !options.skip_bad {
                let what = format!("{what}{missing} (ffmpeg: {complaint})");
                return Err(hint_skip(Error::format(path, what)));
            }
            decoded.notes.push(format!("{what}{missing}; {then} (ffmpeg: {complaint})"));
        }
        decoded.skipped = bad.len();
        if let Some(seen) = seen.filter(|seen| seen.whole.contains(&false)) {
            // Frames are missing between others, so that counting gives wrong numbers.
            drop(run.frames);
            let keep = &mut |i: usize| {
                let number = *seen.decoded.get(i)?;
                let place = number / options.every;
                let taken = seen.whole[number] && number % options.every == 0 && place < most;
                taken.then_some(number)
            };
            run = source.run(1, None, keep)?;
            if run.decoded != seen.decoded.len() {
                let what = "is so damaged that its frames cannot be told apart; extract them \
                            elsewhere and give the folder of images";
                return Err(Error::format(path, what));
            }
        }
    }
    decoded.frames = run.frames;
    Ok(decoded)
}

/// A process of ours that ends with what waits for it.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may be gone already; a child that is not waited for would stay in the process table.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a program that is not hit by a Ctrl-C in the terminal: this process hears that and says
/// what becomes of its own.
fn start(command: &mut Command, path: &Path) -> Result<Running> {
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    let name = command.get_program().to_os_string();
    command.spawn().map(Running).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::Input(format!(
            "{}: reading a video needs the program ffmpeg, which was not found. Install it \
             (Debian, Ubuntu: apt-get install ffmpeg), or extract the frames elsewhere and give \
             the folder of images",
            path.display()
        )),
        _ => {
            Error::Failed(format!("{}: {} cannot be started: {e}", path.display(), name.display()))
        }
    })
}

/// How much of what a program says is kept.
const SAID: u64 = 1 << 20;

/// Reads what a program says beside its output: a full pipe of messages would stop it.
fn listen(from: impl Read + Send + 'static) -> JoinHandle<String> {
    spawn(move || {
        let mut text = Vec::new();
        let mut from = from;
        // What cannot be read here only shortens a message.
        let _ = from.by_ref().take(SAID).read_to_end(&mut text);
        let _ = std::io::copy(&mut from, &mut std::io::sink());
        String::from_utf8_lossy(&text).into_owned()
    })
}

/// A video and how to read it.
struct Source<'a> {
    ffmpeg: &'a OsStr,
    input: &'a OsStr,
    path: &'a Path,
    options: &'a ClipOptions,
    go_on: GoOn<'a>,
}

/// Frames that were kept with their numbers, how many there were in all, and their size.
type Taken = (Vec<(usize, Image)>, usize, (u32, u32));

/// What one run of ffmpeg gave.
struct Run {
    /// Those that were kept, with their numbers.
    frames: Vec<(usize, Image)>,
    /// Those that ffmpeg wrote.
    decoded: usize,
    original: (u32, u32),
    /// On stderr, each line with its level.
    said: String,
    /// Why it ended early, if it did.
    failed: Option<String>,
}

impl Source<'_> {
    /// Runs ffmpeg and keeps the frames that `keep` gives a number to, asked with their places among
    /// those that ffmpeg writes.
    fn run(
        &self,
        every: usize,
        most: Option<usize>,
        keep: &mut dyn FnMut(usize) -> Option<usize>,
    ) -> Result<Run> {
        // Frames are to come out as they went in. The option for that changed its name with ffmpeg
        // 5.1, and each name is unknown to some version in use.
        match self.run_timed(every, most, keep, ["-fps_mode", "passthrough"]) {
            Err(Error::Format { what, .. }) if what.contains("'fps_mode'") => {
                self.run_timed(every, most, keep, ["-vsync", "0"])
            }
            other => other,
        }
    }

    fn run_timed(
        &self,
        every: usize,
        most: Option<usize>,
        keep: &mut dyn FnMut(usize) -> Option<usize>,
        timing: [&str; 2],
    ) -> Result<Run> {
        let mut command = Command::new(self.ffmpeg);
        command.args(["-nostdin", "-v", "level+warning"]);
        // Several threads race for what they say of damage; one always says the same.
        command.args(["-threads", "1", "-i"]).arg(self.input);
        command.args(["-map", "0:v:0", "-vf"]);
        command.arg(format!("select=not(mod(n\\,{every}))"));
        command.args(timing);
        if let Some(most) = most {
            command.args(["-frames:v", &most.to_string()]);
        }
        command.args(["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = start(&mut command, self.path)?;
        let said = listen(child.0.stderr.take().expect("stderr is piped"));
        let stdout = child.0.stdout.take().expect("stdout is piped");
        // Few at a time, so that what is read does not lie in memory twice.
        let (sender, pictures) = sync_channel(2);
        let reader = spawn(move || {
            let mut from = BufReader::with_capacity(1 << 20, stdout);
            // Nobody receives any more once the work has been given up.
            while let Some(picture) = read_ppm(&mut from).transpose() {
                let failed = picture.is_err();
                if sender.send(picture).is_err() || failed {
                    break;
                }
            }
        });
        let taken = self.take(&pictures, keep);
        drop(pictures);
        if taken.is_err() {
            // It would wait for ever for someone to read on; it may also be gone already.
            let _ = child.0.kill();
        }
        let status = child.0.wait().map_err(Error::io(self.path))?;
        let said = said.join().unwrap_or_default();
        // Only a panic of its own could end it otherwise.
        let _ = reader.join();
        let (frames, decoded, original) = taken?;
        let failed = (!status.success()).then(|| reason(&said));
        match failed {
            Some(why) if decoded == 0 => {
                let what = format!("ffmpeg cannot read it as a video: {why}");
                Err(Error::format(self.path, what))
            }
            failed => Ok(Run { frames, decoded, original, said, failed }),
        }
    }

    /// Takes the pictures as they come.
    fn take(
        &self,
        pictures: &Receiver<std::io::Result<Image>>,
        keep: &mut dyn FnMut(usize) -> Option<usize>,
    ) -> Result<Taken> {
        let (mut frames, mut decoded) = (Vec::new(), 0);
        let mut original = None;
        loop {
            (self.go_on)()?;
            let image = match pictures.recv_timeout(Duration::from_millis(100)) {
                Ok(picture) => picture.map_err(Error::io(self.path))?,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            let size = (image.width, image.height);
            if *original.get_or_insert(size) != size {
                let what = format!("frame {decoded} has another size than the first");
                return Err(Error::format(self.path, what));
            }
            if let Some(number) = keep(decoded) {
                let (width, height) = self.options.size.target(size.0, size.1);
                room_for(self.path, frames.len(), (width, height))?;
                frames.push((number, resize(&image, width, height)));
            }
            decoded += 1;
        }
        Ok((frames, decoded, original.unwrap_or_default()))
    }
}

/// Why ffmpeg failed: the last that it said of errors.
fn reason(said: &str) -> String {
    let lines: Vec<&str> = said
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.contains("[warning]"))
        .collect();
    let message = match lines[..] {
        [] => "it gives no reason".to_string(),
        [.., before, last] => format!("{before}; {last}"),
        [only] => only.to_string(),
    };
    message.replace("[error] ", "").replace("[fatal] ", "")
}

/// Reads a binary PPM of 8 bits as ffmpeg writes it; `None` at the end.
fn read_ppm(from: &mut impl BufRead) -> std::io::Result<Option<Image>> {
    if from.fill_buf()?.is_empty() {
        return Ok(None);
    }
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
            Ok(Some(Image { width, height, channels: 3, pixels }))
        }
        _ => Err(odd()),
    }
}

/// What `ffprobe` tells of a video; nothing where it is missing or does not know.
#[derive(Debug, Default)]
struct Told {
    /// Frames a second.
    rate: Option<f64>,
    /// Width and height, not turned.
    size: Option<(u32, u32)>,
    /// Pictures that the file holds, compressed; as a rule one for each frame.
    packets: Option<usize>,
    /// Frames that the file says it has.
    announced: Option<usize>,
    /// The video's number among the streams.
    index: usize,
    /// Codecs of the streams that are no video.
    others: Vec<String>,
    /// The container, by ffmpeg's name.
    container: String,
}

impl Told {
    fn by(ffprobe: &OsStr, input: &OsStr) -> Told {
        let entries = "format=format_name:stream=index,codec_type,codec_name,width,height,\
                       avg_frame_rate,nb_frames,nb_read_packets";
        let arguments = ["-count_packets", "-show_entries", entries, "-of", "json"];
        let all = probe(ffprobe, input, &arguments).unwrap_or_default();
        let container = all["format"]["format_name"].as_str().unwrap_or_default().to_string();
        let mut told = Told { container, ..Told::default() };
        let (mut first, mut codec) = (true, "");
        for stream in all["streams"].as_array().into_iter().flatten() {
            let text = |key: &str| stream[key].as_str().unwrap_or_default();
            let count = |key: &str| text(key).parse::<usize>().ok().filter(|&n| n > 0);
            if text("codec_type") != "video" {
                told.others.push(text("codec_name").to_string());
            } else if std::mem::take(&mut first) {
                let number = |key: &str| stream[key].as_u64().and_then(|n| u32::try_from(n).ok());
                let ratio = text("avg_frame_rate").split_once('/');
                let rate =
                    ratio.and_then(|(n, d)| Some(n.parse::<f64>().ok()? / d.parse::<f64>().ok()?));
                told.rate = rate.filter(|rate| rate.is_finite() && *rate > 0.0);
                told.size = number("width").zip(number("height"));
                told.packets = count("nb_read_packets");
                told.announced = count("nb_frames");
                told.index = number("index").unwrap_or(0) as usize;
                codec = text("codec_name");
            }
        }
        told.others.retain(|other| !other.is_empty() && other != codec);
        told
    }

    /// Whether a line of ffmpeg's says that the container is damaged, not a picture in it: frames
    /// may then be missing without a trace.
    fn of_container(&self, line: &str) -> bool {
        let at = line.strip_prefix('[').and_then(|line| line.split_once(" @ "));
        at.is_some_and(|(name, _)| name == self.container) && self.complaint(line).is_some()
    }

    /// A line of ffmpeg's that speaks of damage to the video, without what differs from run to run.
    fn complaint(&self, line: &str) -> Option<String> {
        let grave = ["[error]", "[fatal]", "[panic]"].iter().any(|level| line.contains(level));
        // That a picture is corrupt is only a warning to ffmpeg.
        let corrupt = line.contains("[warning]") && line.to_ascii_lowercase().contains("corrupt");
        // Damage to what a camera writes beside the picture; some cameras always do.
        let beside = ["APP fields", "SEI type"].iter().any(|what| line.contains(what));
        let (context, text) = match line.strip_prefix('[').and_then(|l| l.split_once("] ")) {
            Some((context, text)) if context.contains(" @ ") => (context, text),
            _ => ("", line),
        };
        let of_other = self.others.iter().any(|codec| context.starts_with(codec.as_str()))
            || stream(text).is_some_and(|index| index != self.index);
        let text = text.split_once("] ").map_or(text, |(_, text)| text);
        ((grave || corrupt) && !beside && !of_other).then(|| text.trim().to_string())
    }
}

/// The stream that a line of ffmpeg's speaks of.
fn stream(line: &str) -> Option<usize> {
    let after = line.split("stream").nth(1)?.trim_start_matches([' ', '=', '#']);
    let after = after.strip_prefix("0:").unwrap_or(after);
    let digits = after.split(|c: char| !c.is_ascii_digit()).next()?;
    digits.parse().ok()
}

/// Asks `ffprobe` for JSON.
fn probe(ffprobe: &OsStr, input: &OsStr, arguments: &[&str]) -> Option<serde_json::Value> {
    let mut command = Command::new(ffprobe);
    command.args(["-v", "error"]).args(arguments).arg(input);
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let output = command.stdin(Stdio::null()).output().ok()?;
    serde_json::from_slice(&output.stdout).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_damage_to_the_video_counts() {
        let told = Told { others: vec!["aac".into()], ..Told::default() };
        let text = |line: &str| told.complaint(line);
        assert_eq!(
            text("[h264 @ 0x56] [error] cabac decode failed").as_deref(),
            Some("cabac decode failed")
        );
        assert_eq!(
            text("[warning] file:a.mp4: corrupt decoded frame in stream 0").as_deref(),
            Some("file:a.mp4: corrupt decoded frame in stream 0")
        );
        assert_eq!(
            text("[error] Error while decoding stream #0:0: Invalid data").as_deref(),
            Some("Error while decoding stream #0:0: Invalid data")
        );
        for fine in [
            "",
            "[swscaler @ 0x56] [warning] deprecated pixel format used",
            "[aac @ 0x56] [error] channel element 0.0 is not allocated",
            "[mpegts @ 0x56] [warning] Packet corrupt (stream = 1, dts = 306000).",
            "[error] Error while decoding stream #0:1: Invalid data",
            "[mjpeg @ 0x56] [error] unable to decode APP fields: Invalid data",
        ] {
            assert_eq!(text(fine), None, "{fine}");
        }
    }
}
