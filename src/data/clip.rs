//! A clip: the frames of one video in order, with unknown cameras.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::images::{self, Orientation, Resize};
use super::shots::{self, Detector, Shot, ShotChoice};
use super::video::GoOn;
use super::{Dataset, davis, exif, layout, video};
use crate::io::check_memory;
use crate::types::Image;
use crate::{Error, Result};

/// Which part of a clip to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClipOptions {
    /// The shot to read of a clip with cuts.
    pub shot: ShotChoice,
    /// Stride of the frames, beginning with the shot's first; 1 takes all.
    pub every: usize,
    /// Maximum number of frames of the shot, after `every`.
    pub max_frames: Option<usize>,
    /// The size that frames are resized to.
    pub size: Resize,
    /// Leave out frames that are damaged or lost, with a note, instead of failing.
    pub skip_bad: bool,
}

impl Default for ClipOptions {
    fn default() -> Self {
        ClipOptions {
            shot: ShotChoice::Longest,
            every: 1,
            max_frames: None,
            size: Resize::Keep,
            skip_bad: false,
        }
    }
}

/// One frame of a clip.
#[derive(Clone, Debug)]
pub struct ClipFrame {
    /// The file's name without extension, or the frame's number in the video.
    pub name: String,
    /// Index in the whole clip, from 0: among all files of the folder or all frames of the video, including
    /// those that were not taken or are unreadable.
    pub number: usize,
    /// Time in [0, 1] in proportion to `number`: the first frame is at 0, the last at 1.
    pub time: f64,
    /// RGB in [0, 1].
    pub image: Image,
}

/// The frames of a clip: at least [`Clip::LEAST`], all of one size and, unless the whole clip was
/// requested, of one shot.
#[derive(Clone, Debug)]
pub struct Clip {
    /// The frames in order.
    pub frames: Vec<ClipFrame>,
    /// Number of frames of the whole clip, as [`ClipFrame::number`] counts them; `None` where an unknown
    /// number of frames of a damaged video is missing.
    pub total: Option<usize>,
    /// Frames that were left out because they are damaged or lost.
    pub skipped: usize,
    /// Shots of the whole clip with at least three frames; empty where no cut was found.
    pub shots: Vec<Shot>,
    /// Index of the shot that the frames were taken from; `None` for the whole clip.
    pub shot: Option<usize>,
    /// Width of every frame.
    pub width: u32,
    /// Height of every frame.
    pub height: u32,
    /// Width and height of the frames before resizing.
    pub original: (u32, u32),
    /// Frame rate of the frames that were taken, in frames per second, where the file gives it.
    pub rate: Option<f64>,
    /// Focal length in pixels of the resized frames, where EXIF data gives it.
    pub focal: Option<f64>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

impl Clip {
    /// Minimum number of frames for camera estimation: a point counts once three frames agree on it.
    pub const LEAST: usize = 3;

    /// Opens a video file (through `ffmpeg`), or a folder of images in natural order of their names. A
    /// folder without images but with a subfolder `frames` or `images` stands for that subfolder; a dataset
    /// ([`layout`]) stands for its training images in the order of their times; a DAVIS folder stands for
    /// its only clip. The whole clip is searched for cuts first, on small images of which only a few are
    /// kept.
    ///
    /// # Errors
    /// The path does not exist, or is neither a file nor a folder; a folder without images; fewer than
    /// [`Clip::LEAST`] frames; no such shot; frames of different sizes; a frame that is damaged or lost
    /// (unless `skip_bad`); insufficient memory; no `ffmpeg`. Each message names the file and a remedy.
    pub fn open(path: impl AsRef<Path>, options: &ClipOptions) -> Result<Clip> {
        Clip::open_while(path, options, &|| Ok(()))
    }

    /// [`Clip::open`] with cancellation: `go_on` is called several times a second, and its error ends the
    /// work.
    pub fn open_while(path: impl AsRef<Path>, options: &ClipOptions, go_on: GoOn) -> Result<Clip> {
        let path = path.as_ref();
        if options.every == 0 || options.max_frames.is_some_and(|most| most < Clip::LEAST) {
            let least = Clip::LEAST;
            let what = format!("take every 1st frame or more, and at least {least} frames");
            return Err(Error::Input(what));
        }
        let found = std::fs::metadata(path).map_err(Error::io(path))?;
        if found.is_dir() {
            return open_folder(path, options, go_on);
        }
        if !found.is_file() {
            // Opening a pipe would block until a writer appears.
            let what = "is neither a file nor a folder; give a video file or a folder of images";
            return Err(Error::format(path, what));
        }
        if images::has_image_extension(path) {
            return Err(too_few(path, 1, options, 0));
        }
        let decoded = video::decode(path, options, go_on)?;
        let named = |(number, image)| (format!("{number:05}"), number, image);
        let frames = decoded.frames.into_iter().map(named).collect();
        let mut clip = assemble(path, frames, options, decoded.skipped)?;
        clip.original = decoded.original;
        clip.rate = decoded.rate.map(|rate| rate / options.every as f64);
        clip.total = decoded.total;
        clip.notes = decoded.notes;
        clip.cut(decoded.shots, decoded.shot, decoded.rate, options);
        Ok(clip)
    }

    /// The image files that a folder stands for: its own images; else those of its subfolder `frames` or
    /// `images`; else DAVIS's only clip; else a dataset's training images in the order of their times.
    /// Empty where it holds none.
    ///
    /// # Errors
    /// The folder cannot be read; it holds several clips; the dataset is damaged, or its images are not
    /// those of one camera.
    pub fn files(folder: &Path) -> Result<Vec<PathBuf>> {
        let mut files = images::list(folder)?;
        for inner in ["frames", "images"] {
            let inner = folder.join(inner);
            if files.is_empty() && inner.is_dir() {
                files = images::list(&inner)?;
            }
        }
        if files.is_empty() && davis::is_root(folder) {
            return images::list(&davis::only_clip(folder)?);
        }
        if files.is_empty() && layout::recognise(folder).is_some() {
            let set = Dataset::open(folder)?;
            return set.as_clip().map_err(|what| Error::format(folder, what));
        }
        Ok(files)
    }

    /// Stores the shots, and adds a note where there are any.
    fn cut(
        &mut self,
        shots: Vec<Shot>,
        shot: Option<usize>,
        rate: Option<f64>,
        options: &ClipOptions,
    ) {
        if !shots.is_empty() {
            self.notes.push(options.shot.note(&shots, shot, rate));
        }
        (self.shots, self.shot) = (shots, shot);
    }
}

fn too_few(path: &Path, frames: usize, options: &ClipOptions, skipped: usize) -> Error {
    let has = match frames {
        0 => "has no frames".to_string(),
        1 => "has one frame only".to_string(),
        n => format!("has {n} frames only"),
    };
    let left_out = match skipped {
        0 => String::new(),
        n => format!(" besides {n} that cannot be read"),
    };
    let what =
        if options.every > 1 { " (of those taken; take more with a smaller step)" } else { "" };
    let least = Clip::LEAST;
    Error::format(
        path,
        format!(
            "{has}{left_out}{what}; a reconstruction needs a moving camera's video, {least} frames \
             at least"
        ),
    )
}

/// Size of a frame in memory, bytes.
fn frame_bytes((width, height): (u32, u32)) -> u64 {
    (u64::from(width) * u64::from(height)).saturating_mul(12)
}

/// Checks that a number of frames fits in memory.
pub(super) fn foresee(path: &Path, frames: usize, size: (u32, u32)) -> Result<()> {
    let what = format!("{}: a clip of {frames} frames of {}×{}", path.display(), size.0, size.1);
    check_memory((frames as u64).saturating_mul(frame_bytes(size)), &what).map_err(hint_less)
}

/// Checks that one more frame fits in memory, with a reserve for other concurrent work; used for clips
/// whose length is only known after reading.
pub(super) fn room_for(path: &Path, frames: usize, size: (u32, u32)) -> Result<()> {
    const SPARE: u64 = 64 << 20;
    let what = format!("{}: frame {frames} of {}×{}", path.display(), size.0, size.1);
    check_memory(frame_bytes(size).saturating_add(SPARE), &what).map_err(hint_less)
}

/// Adds a remedy to the error about a clip that is too large.
fn hint_less(error: Error) -> Error {
    match error {
        Error::Input(what) => Error::Input(format!(
            "{what}: take every n-th frame, only the first ones (max_frames), or smaller ones (size)"
        )),
        other => other,
    }
}

fn assemble(
    path: &Path,
    frames: Vec<(String, usize, Image)>,
    options: &ClipOptions,
    skipped: usize,
) -> Result<Clip> {
    if frames.len() < Clip::LEAST {
        return Err(too_few(path, frames.len(), options, skipped));
    }
    let first = frames[0].1;
    let last = (frames[frames.len() - 1].1 - first) as f64;
    let (width, height) = (frames[0].2.width, frames[0].2.height);
    let frames = frames
        .into_iter()
        .map(|(name, number, image)| ClipFrame {
            name,
            number,
            time: (number - first) as f64 / last,
            image,
        })
        .collect();
    Ok(Clip {
        frames,
        total: None,
        skipped,
        shots: Vec::new(),
        shot: None,
        width,
        height,
        original: (width, height),
        rate: None,
        focal: None,
        notes: Vec::new(),
    })
}

fn open_folder(folder: &Path, options: &ClipOptions, go_on: GoOn) -> Result<Clip> {
    let files = Clip::files(folder)?;
    if files.is_empty() {
        let known = images::EXTENSIONS.join(", ");
        return Err(Error::format(folder, format!("holds no images ({known})")));
    }
    let total = files.len();
    if total < Clip::LEAST {
        return Err(too_few(folder, total, options, 0));
    }
    let shots = find_shots(&files, go_on)?;
    let shot = options.shot.among(folder, &shots, None)?;
    let range = shot.map_or(Shot { first: 0, last: total - 1 }, |shot| shots[shot]);
    // Only the frames that are taken are checked for damage.
    let files: Vec<_> = files
        .into_iter()
        .enumerate()
        .take(range.last + 1)
        .skip(range.first)
        .step_by(options.every)
        .take(options.max_frames.unwrap_or(usize::MAX))
        .collect();
    if files.len() < Clip::LEAST {
        return Err(too_few(folder, files.len(), options, 0));
    }
    let header = |file: &Path| images::dimensions(file, Orientation::Upright).ok();
    let size = files.iter().find_map(|(_, file)| header(file)).unwrap_or_default();
    foresee(folder, files.len(), options.size.target(size.0, size.1))?;
    let read = |(_, file): &(usize, PathBuf)| {
        go_on()?;
        let image = images::decode_rgb(file, [0.0; 3], Orientation::Upright)?;
        let size = (image.width, image.height);
        let (width, height) = options.size.target(size.0, size.1);
        Ok((size, images::resize(&image, width, height)))
    };
    let at_a_time = images::at_a_time(size);
    let decoded: Vec<_> = files
        .chunks(at_a_time)
        .flat_map(|files| files.par_iter().map(read).collect::<Vec<_>>())
        .collect();
    let FolderFrames { frames, first, bad } = collect(decoded, &files, options.skip_bad)?;
    let mut clip = assemble(folder, frames, options, bad.len())?;
    clip.total = Some(total);
    clip.cut(shots, shot, None, options);
    clip.notes.extend(images::large_note(size));
    if let Some(name) = bad.first() {
        let (n, all) = (bad.len(), files.len());
        clip.notes.push(format!("skipped {n} of {all} images that cannot be read ({name} …)"));
    }
    if let Some((file, (width, height))) = first {
        clip.original = (width, height);
        let scale = f64::from(clip.width) / f64::from(width);
        clip.focal = exif::focal(file, width, height).map(|focal| focal * scale);
    }
    Ok(clip)
}

/// The frames of a folder.
struct FolderFrames<'a> {
    /// Name, index in the whole clip, and image.
    frames: Vec<(String, usize, Image)>,
    /// The first that could be read, with its size before resizing.
    first: Option<(&'a Path, (u32, u32))>,
    /// Names of the files that cannot be read.
    bad: Vec<String>,
}

/// Sorts what was read of `files` (size before resizing, resized image) into frames and unreadable files.
fn collect(
    decoded: Vec<Result<((u32, u32), Image)>>,
    files: &[(usize, PathBuf)],
    skip_bad: bool,
) -> Result<FolderFrames<'_>> {
    let named = |name: Option<&OsStr>| name.unwrap_or_default().to_string_lossy().into_owned();
    let (mut frames, mut first, mut bad) = (Vec::new(), None, Vec::new());
    for (result, (number, file)) in decoded.into_iter().zip(files) {
        match result {
            Ok((size, image)) => {
                let (of, expected) = *first.get_or_insert((file.as_path(), size));
                if size != expected {
                    return Err(Error::format(
                        file,
                        format!(
                            "is {}×{}, but {} is {}×{}; all frames must have one size",
                            size.0,
                            size.1,
                            named(of.file_name()),
                            expected.0,
                            expected.1
                        ),
                    ));
                }
                frames.push((named(file.file_stem()), *number, image));
            }
            // Only errors of the file itself may be skipped.
            Err(error @ (Error::Io { .. } | Error::Format { .. })) if !skip_bad => {
                return Err(hint_skip(error));
            }
            Err(Error::Io { .. } | Error::Format { .. }) => bad.push(named(file.file_name())),
            Err(other) => return Err(other),
        }
    }
    Ok(FolderFrames { frames, first, bad })
}

/// The shots of a folder's images. Unreadable files are ignored here; they are reported if they are taken.
fn find_shots(files: &[PathBuf], go_on: GoOn) -> Result<Vec<Shot>> {
    let header = |file: &PathBuf| images::dimensions(file, Orientation::Upright).ok();
    let at_a_time = images::at_a_time(files.iter().find_map(header).unwrap_or_default());
    let small = |file: &PathBuf| -> Result<Option<Image>> {
        go_on()?;
        let image = images::decode_rgb(file, [0.0; 3], Orientation::Upright).ok();
        Ok(image.map(|image| {
            let (width, height) = Resize::Longest(shots::LONGEST).target(image.width, image.height);
            shots::grey(&images::resize(&image, width, height))
        }))
    };
    let mut detector = Detector::default();
    for files in files.chunks(at_a_time) {
        let pictures: Vec<_> = files.par_iter().map(small).collect();
        for picture in pictures {
            detector.push(picture?.as_ref());
        }
    }
    Ok(detector.finish())
}

/// Adds a remedy to the error about a damaged frame.
pub(super) fn hint_skip(error: Error) -> Error {
    let hint = "skip_bad leaves such frames out";
    match error {
        Error::Format { path, what } => Error::Format { path, what: format!("{what}; {hint}") },
        Error::Io { path, source } => {
            Error::Format { path, what: format!("cannot be read: {source}; {hint}") }
        }
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clips_too_long_for_memory_are_told() {
        if crate::io::available_memory().is_none() {
            return;
        }
        let path = Path::new("long.mp4");
        assert!(foresee(path, 3, (64, 64)).is_ok() && room_for(path, 7, (64, 64)).is_ok());
        let text = foresee(path, 12_000_000, (3840, 2160)).unwrap_err().to_string();
        for part in ["long.mp4", "12000000 frames of 3840×2160", "1112365.7 GiB", "max_frames"] {
            assert!(text.contains(part), "{part} is not in: {text}");
        }
        assert!(room_for(path, 7, (u32::MAX, u32::MAX)).is_err());
    }
}
