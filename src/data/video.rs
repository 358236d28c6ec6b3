//! Video files, through the `ffmpeg` program.
//!
//! ffmpeg writes the frames as PPM images to a pipe: each image carries its size, so that rotated phone
//! videos need no special case, and nothing is written to disk.
//!
//! ffmpeg continues where a video is damaged: it conceals undecodable data, drops frames and exits with
//! success. Its messages on stderr are therefore parsed, and after a message about damage the video is
//! examined frame by frame (`damage`).

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

/// The decoded frames of a video.
pub struct Decoded {
    /// Frame number in the whole video, and image.
    pub frames: Vec<(usize, Image)>,
    /// Width and height of the frames before resizing.
    pub original: (u32, u32),
    /// Frame rate of the file in frames per second, where `ffprobe` gives it.
    pub rate: Option<f64>,
    /// Number of frames of the whole video; `None` where it is unknown.
    pub total: Option<usize>,
    /// Frames left out because they are damaged or lost.
    pub skipped: usize,
    /// The shots of the video, by frame numbers; empty where no cut was found.
    pub shots: Vec<Shot>,
    /// Index of the shot that the frames were taken from; `None` for the whole video.
    pub shot: Option<usize>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Decodes a video with the `ffmpeg` on the path; see [`decode_with`].
pub fn decode(path: &Path, options: &ClipOptions, go_on: GoOn) -> Result<Decoded> {
    decode_with(OsStr::new("ffmpeg"), OsStr::new("ffprobe"), path, options, go_on)
}

/// Cancellation callback, called several times a second; its error ends the work and is returned.
pub type GoOn<'a> = &'a (dyn Fn() -> Result<()> + Sync);

/// Decodes a video with the given programs.
///
/// # Errors
/// The program is missing (the message gives remedies) or cannot be started, it cannot read the file (the
/// message is ffmpeg's), there is no such shot, frames are damaged or lost (unless `skip_bad`), memory is
/// insufficient; errors of `go_on`.
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
    // A video that is used whole is read to its end, so that damage there is reported.
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
            // Missing frames shift the frame numbers of the shots.
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
            let (what, then) = describe(&bad, of, missing);
            if !options.skip_bad {
                let what = format!("{what} (ffmpeg: {complaint})");
                return Err(hint_skip(Error::format(path, what)));
            }
            decoded.notes.push(format!("{what}; {then} (ffmpeg: {complaint})"));
        }
        decoded.skipped = bad.len();
        if let Some(seen) = seen.filter(|seen| seen.whole.contains(&false)) {
            drop(taken.frames);
            taken = source.take_whole(&seen, range, most)?;
        }
    }
    decoded.frames = taken.frames;
    Ok(decoded)
}

/// The damage of a video of which `of` frames are taken: what is damaged, and what is done about it if the
/// user wants the rest.
fn describe(bad: &[usize], of: usize, missing: usize) -> (String, &'static str) {
    let (what, then) = match (bad.first(), missing) {
        (Some(first), _) => (
            format!("{} of {of} frames are damaged or lost, the first is frame {first}", bad.len()),
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
    (what + &missing, then)
}

/// Size and length of a video, from `ffprobe`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Extent {
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// Number of frames.
    pub frames: usize,
}

/// Size and length of a video, without decoding.
///
/// # Errors
/// [`Error::Format`] where `ffprobe` does not give them, or is missing.
pub fn extent(path: &Path) -> Result<Extent> {
    // Only regular files are accepted.
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

/// Decodes the frames of a video with the given ascending numbers, and passes each to `each` with its
/// number. All frames up to the last of them are decoded.
///
/// # Errors
/// [`Error::Format`] where the video is damaged or has fewer frames; the errors of [`decode_with`] about
/// the program; errors of `each`.
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

/// A file name for ffmpeg: the prefix `file:` keeps names such as `-x.mp4` or `concat:a` from being
/// interpreted as options or protocols.
fn input(path: &Path) -> OsString {
    let mut input = OsString::from("file:");
    input.push(path);
    input
}

/// The message when a damaged video is rejected.
const UNTELLABLE: &str = "is so damaged that its frames cannot be told apart; extract them elsewhere \
                          and give the folder of images";

/// A child process that is killed when its handle is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // The process may have ended already; it must be waited for to be removed from the process table.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a program in its own process group, so that a Ctrl-C in the terminal reaches only this process,
/// which then ends the child.
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

/// Maximum size of the messages that are kept, bytes.
const SAID: u64 = 1 << 20;

/// Reads a program's messages in a thread; a full pipe would block the program.
fn listen(from: impl Read + Send + 'static) -> JoinHandle<String> {
    spawn(move || {
        let mut text = Vec::new();
        let mut from = from;
        // A read error here only shortens a message.
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

/// Selection of a video's frames: a first frame and a stride.
struct Select {
    first: usize,
    every: usize,
}

/// Frames that were kept with their numbers, their original size, and the run that produced them.
struct Taken {
    frames: Vec<(usize, Image)>,
    original: (u32, u32),
    run: Run,
}

/// Result of one run of ffmpeg.
struct Run {
    /// Number of frames that ffmpeg wrote.
    decoded: usize,
    /// The messages on stderr, each line with its level.
    said: String,
    /// Reason for a failure, if any.
    failed: Option<String>,
}

/// Callback for each image that ffmpeg writes, with its index.
type Each<'a> = &'a mut dyn FnMut(usize, Image) -> Result<()>;

impl Source<'_> {
    /// The shots of the whole video, by indices of the frames that ffmpeg writes; empty where no cut was
    /// found. Only small images are read, and a few kept.
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

    /// Takes a limited number of frames: those for which `keep` returns a number, given the index of the
    /// frame that ffmpeg writes.
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

    /// Takes at most `most` frames of a range of a damaged video, without those that are not intact.
    fn take_whole(&self, seen: &damage::Seen, range: Shot, most: usize) -> Result<Taken> {
        let every = self.options.every;
        let keep = &mut |i: usize| {
            let number = *seen.decoded.get(i)?;
            let place = number.checked_sub(range.first)?;
            let inside = number <= range.last && place / every < most;
            let kept = seen.whole[number] && inside && place % every == 0;
            kept.then_some(number)
        };
        // Missing frames shift the frame numbers, so that counting gives wrong ones: all frames are decoded.
        let taken = self.take(&Select { first: 0, every: 1 }, None, keep)?;
        if taken.run.decoded != seen.decoded.len() {
            return Err(Error::format(self.path, UNTELLABLE));
        }
        Ok(taken)
    }

    /// Runs ffmpeg with a filter and passes on at most `most` images.
    fn run(&self, filter: &str, most: Option<usize>, each: Each) -> Result<Run> {
        // Frames must come out as they are stored. The option for this was renamed in ffmpeg 5.1, and each
        // name is unknown to some version in use.
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
        // With one thread the messages about damage are deterministic.
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
        // A short queue, so that images are not held in memory twice.
        let (sender, pictures) = sync_channel(2);
        let reader = spawn(move || {
            let mut from = BufReader::with_capacity(1 << 20, stdout);
            // The receiver is gone once the work has been cancelled.
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
            // Otherwise it would block on the full pipe; it may also have ended already.
            let _ = child.0.kill();
        }
        let status = child.0.wait().map_err(Error::io(self.path))?;
        let said = said.join().unwrap_or_default();
        // A join error could only come from a panic of the thread.
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

    /// Passes on the images as they arrive, and counts them.
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

/// The reason for ffmpeg's failure: its last error message.
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

/// Reads an 8-bit binary PPM as ffmpeg writes it; `None` at the end.
fn read_ppm(from: &mut impl BufRead) -> std::io::Result<Option<Image>> {
    if from.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let odd = || std::io::Error::other("ffmpeg gave something else than a PPM image");
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

/// Properties of a video from `ffprobe`; empty where it is missing or fails.
#[derive(Debug, Default)]
struct Told {
    /// Frames per second.
    rate: Option<f64>,
    /// Width and height before rotation.
    size: Option<(u32, u32)>,
    /// Number of compressed packets in the file, usually one per frame.
    packets: Option<usize>,
    /// Number of frames that the file declares.
    announced: Option<usize>,
    /// Index of the video stream.
    index: usize,
    /// Codecs of the other streams.
    others: Vec<String>,
    /// The container format, by ffmpeg's name.
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

    /// Whether a message of ffmpeg reports a damaged container instead of a damaged frame; an unknown
    /// number of frames may then be missing.
    fn of_container(&self, line: &str) -> bool {
        let at = line.strip_prefix('[').and_then(|line| line.split_once(" @ "));
        at.is_some_and(|(name, _)| name == self.container) && self.complaint(line).is_some()
    }

    /// A message of ffmpeg about damage to the video, without the parts that differ between runs.
    fn complaint(&self, line: &str) -> Option<String> {
        let grave = ["[error]", "[fatal]", "[panic]"].iter().any(|level| line.contains(level));
        // ffmpeg reports a corrupt frame only as a warning.
        let corrupt = line.contains("[warning]") && line.to_ascii_lowercase().contains("corrupt");
        // Damage to metadata that cameras write next to the frame; some cameras always cause it.
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

/// The stream that a message of ffmpeg refers to.
fn stream(line: &str) -> Option<usize> {
    let after = line.split("stream").nth(1)?.trim_start_matches([' ', '=', '#']);
    let after = after.strip_prefix("0:").unwrap_or(after);
    let digits = after.split(|c: char| !c.is_ascii_digit()).next()?;
    digits.parse().ok()
}

/// Runs `ffprobe` with JSON output.
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
