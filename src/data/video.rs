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
use super::shots::{Detector, LONGEST, Shot, grey};
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
    /// The shots of the video, by the numbers of their frames; empty where no cut was found.
    pub shots: Vec<Shot>,
    /// Which of them the frames were taken from; `None` where it was all of the video.
    pub shot: Option<usize>,
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
/// it cannot read the file (the message is its own), no such shot, frames are damaged or lost
/// (unless `skip_bad`), more frames than there is memory for; those of `go_on`.
pub fn decode_with(
    ffmpeg: &OsStr,
    ffprobe: &OsStr,
    path: &Path,
    options: &ClipOptions,
    go_on: GoOn,
) -> Result<Decoded> {
    let input = input(path);
    let told = Told::by(ffprobe, &input);
    let most = options.max_frames.unwrap_or(usize::MAX);
    let source = Source { ffmpeg, input: &input, path, options, go_on };
    let (shots, scan) = source.shots()?;
    let shot = options.shot.among(path, &shots, told.rate)?;
    let all = Shot { first: 0, last: scan.decoded.saturating_sub(1) };
    let range = shot.map_or(all, |shot| shots[shot]);
    if let Some((width, height)) = told.size {
        let taken = range.frames().div_ceil(options.every).min(most);
        foresee(path, taken, options.size.target(width, height))?;
    }
    let select = Select { first: range.first, every: options.every };
    // All of a video is read to its end: what is damaged there is told.
    let count = shot.map(|_| range.frames().div_ceil(options.every).min(most));
    let number = &mut |i: usize| Some(range.first + i * options.every);
    let mut taken = source.take(&select, count.or(options.max_frames), number)?;
    let complaint = |run: &Run| run.said.lines().find_map(|line| told.complaint(line));
    let total = if complaint(&scan).is_none() { Some(scan.decoded) } else { told.packets };
    let complaint = complaint(&taken.run).or(taken.run.failed.take());
    let mut decoded = Decoded {
        total,
        original: taken.original,
        rate: told.rate,
        skipped: 0,
        shots,
        shot,
        notes: Vec::new(),
        frames: Vec::new(),
    };
    if let Some(complaint) = complaint {
        let seen = damage::inspect(ffprobe, &input, &told, &taken.run.said);
        decoded.total = seen.as_ref().and_then(|seen| seen.total);
        let mut range = all;
        if let Some(seen) = &seen {
            // Frames are missing between others, so that shots have other numbers.
            if scan.decoded != seen.decoded.len() && shot.is_some() {
                return Err(Error::format(path, UNTELLABLE));
            }
            let number = |place: usize| seen.decoded.get(place).copied().unwrap_or(place);
            for shot in &mut decoded.shots {
                *shot = Shot { first: number(shot.first), last: number(shot.last) };
            }
            range.last = seen.whole.len().saturating_sub(1);
        }
        let range = shot.map_or(range, |shot| decoded.shots[shot]);
        let chosen = |seen: &damage::Seen| {
            let end = seen.whole.len().min(range.last + 1);
            (range.first..end).step_by(options.every).take(most)
        };
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
            drop(taken.frames);
            let keep = &mut |i: usize| {
                let number = *seen.decoded.get(i)?;
                let place = number.checked_sub(range.first)?;
                let inside = number <= range.last && place / options.every < most;
                let kept = seen.whole[number] && inside && place % options.every == 0;
                kept.then_some(number)
            };
            taken = source.take(&Select { first: 0, every: 1 }, None, keep)?;
            if taken.run.decoded != seen.decoded.len() {
                return Err(Error::format(path, UNTELLABLE));
            }
        }
    }
    decoded.frames = taken.frames;
    Ok(decoded)
}

/// A video's size and length, as `ffprobe` tells them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Extent {
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// Frames.
    pub frames: usize,
}

/// How large and how long a video is; nothing is decoded.
///
/// # Errors
/// [`Error::Format`] where `ffprobe` does not know, or is missing.
pub fn extent(path: &Path) -> Result<Extent> {
    // Only a regular file is an input.
    crate::io::open(path)?;
    let told = Told::by(OsStr::new("ffprobe"), &input(path));
    match (told.size, told.packets) {
        (Some(size), Some(frames)) => Ok(Extent { size, frames }),
        _ => Err(Error::format(
            path,
            "ffprobe, which comes with ffmpeg, is missing or cannot read it as a video; install \
             ffmpeg, or extract the frames into a folder of the video's name",
        )),
    }
}

/// Decodes some frames of a video, those of the given numbers, which ascend; each is handed over with
/// its number. What lies before the last of them is decoded as well.
///
/// # Errors
/// [`Error::Format`] where the video is damaged or has fewer frames; those of [`decode_with`] about the
/// program; those of `each`.
pub fn frames(
    path: &Path,
    numbers: &[usize],
    each: &mut dyn FnMut(usize, Image) -> Result<()>,
) -> Result<()> {
    let (Some(&first), Some(&last)) = (numbers.first(), numbers.last()) else { return Ok(()) };
    crate::io::open(path)?;
    let input = input(path);
    let options = ClipOptions::default();
    let go_on = &|| Ok(());
    let source =
        Source { ffmpeg: OsStr::new("ffmpeg"), input: &input, path, options: &options, go_on };
    let filter = format!("select=between(n\\,{first}\\,{last})");
    let mut next = 0;
    let run = source.run(&filter, Some(last + 1 - first), &mut |place, image| {
        if numbers.get(next) == Some(&(first + place)) {
            next += 1;
            each(first + place, image)?;
        }
        Ok(())
    })?;
    let told = Told::by(OsStr::new("ffprobe"), &input);
    let complaint = run.said.lines().find_map(|line| told.complaint(line)).or(run.failed);
    match (complaint, numbers.get(next)) {
        (None, None) => Ok(()),
        (None, Some(number)) => Err(Error::format(path, format!("has no frame {number}"))),
        (Some(complaint), _) => Err(Error::format(
            path,
            format!(
                "is damaged (ffmpeg: {complaint}); fetch it anew, or extract its frames into a folder \
                 of the video's name"
            ),
        )),
    }
}

/// A file's name for ffmpeg: `file:` keeps one such as `-x.mp4` or `concat:a` from being read as
/// something else.
fn input(path: &Path) -> OsString {
    let mut input = OsString::from("file:");
    input.push(path);
    input
}

/// Why a damaged video is given up.
const UNTELLABLE: &str = "is so damaged that its frames cannot be told apart; extract them elsewhere \
                          and give the folder of images";

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

/// The frames of a video that are asked for: every so-manieth, from one on.
struct Select {
    first: usize,
    every: usize,
}

/// Frames that were kept with their numbers, the size that they had, and the run that gave them.
struct Taken {
    frames: Vec<(usize, Image)>,
    original: (u32, u32),
    run: Run,
}

/// What one run of ffmpeg came to.
struct Run {
    /// Frames that ffmpeg wrote.
    decoded: usize,
    /// On stderr, each line with its level.
    said: String,
    /// Why it ended early, if it did.
    failed: Option<String>,
}

/// Gets each picture that ffmpeg writes, with its place among them.
type Each<'a> = &'a mut dyn FnMut(usize, Image) -> Result<()>;

impl Source<'_> {
    /// The shots of the whole video, by the places of their frames among those that ffmpeg writes;
    /// empty where no cut was found. Only small pictures are read, and a few kept.
    fn shots(&self) -> Result<(Vec<Shot>, Run)> {
        let filter = format!(
            "scale=w=min({LONGEST}\\,iw):h=min({LONGEST}\\,ih):\
             force_original_aspect_ratio=decrease:flags=area"
        );
        let mut detector = Detector::default();
        let run = self.run(&filter, None, &mut |_, image| {
            detector.push(Some(&grey(&image)));
            Ok(())
        })?;
        Ok((detector.finish(), run))
    }

    /// Takes at most so many frames, those that `keep` gives a number to, asked with their places among
    /// those that ffmpeg writes.
    fn take(
        &self,
        select: &Select,
        most: Option<usize>,
        keep: &mut dyn FnMut(usize) -> Option<usize>,
    ) -> Result<Taken> {
        let Select { first, every } = select;
        let filter = format!("select=gte(n\\,{first})*not(mod(n-{first}\\,{every}))");
        let (mut frames, mut original) = (Vec::new(), None);
        let run = self.run(&filter, most, &mut |place, image| {
            let size = (image.width, image.height);
            if *original.get_or_insert(size) != size {
                let what = format!("frame {place} has another size than the first");
                return Err(Error::format(self.path, what));
            }
            if let Some(number) = keep(place) {
                let (width, height) = self.options.size.target(size.0, size.1);
                room_for(self.path, frames.len(), (width, height))?;
                frames.push((number, resize(&image, width, height)));
            }
            Ok(())
        })?;
        Ok(Taken { frames, original: original.unwrap_or_default(), run })
    }

    /// Runs ffmpeg and hands over the pictures that come through its filter, at most so many.
    fn run(&self, filter: &str, most: Option<usize>, each: Each) -> Result<Run> {
        // Frames are to come out as they went in. The option for that changed its name with ffmpeg
        // 5.1, and each name is unknown to some version in use.
        match self.run_timed(filter, most, each, ["-fps_mode", "passthrough"]) {
            Err(Error::Format { what, .. }) if what.contains("'fps_mode'") => {
                self.run_timed(filter, most, each, ["-vsync", "0"])
            }
            other => other,
        }
    }

    fn run_timed(
        &self,
        filter: &str,
        most: Option<usize>,
        each: Each,
        timing: [&str; 2],
    ) -> Result<Run> {
        let mut command = Command::new(self.ffmpeg);
        command.args(["-nostdin", "-v", "level+warning"]);
        // Several threads race for what they say of damage; one always says the same.
        command.args(["-threads", "1", "-i"]).arg(self.input);
        command.args(["-map", "0:v:0", "-vf", filter]);
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
        let decoded = self.receive(&pictures, each);
        drop(pictures);
        if decoded.is_err() {
            // It would wait for ever for someone to read on; it may also be gone already.
            let _ = child.0.kill();
        }
        let status = child.0.wait().map_err(Error::io(self.path))?;
        let said = said.join().unwrap_or_default();
        // Only a panic of its own could end it otherwise.
        let _ = reader.join();
        let decoded = decoded?;
        let failed = (!status.success()).then(|| reason(&said));
        match failed {
            Some(why) if decoded == 0 => {
                let what = format!("ffmpeg cannot read it as a video: {why}");
                Err(Error::format(self.path, what))
            }
            failed => Ok(Run { decoded, said, failed }),
        }
    }

    /// Hands over the pictures as they come, and counts them.
    fn receive(&self, pictures: &Receiver<std::io::Result<Image>>, each: Each) -> Result<usize> {
        let mut decoded = 0;
        loop {
            (self.go_on)()?;
            let image = match pictures.recv_timeout(Duration::from_millis(100)) {
                Ok(picture) => picture.map_err(Error::io(self.path))?,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            each(decoded, image)?;
            decoded += 1;
        }
        Ok(decoded)
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
