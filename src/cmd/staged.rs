//! A dataset with cameras and a split of its own, laid out as a clip without poses and the truth that `eval` holds
//! the result against: how scenes whose poses are unknown are measured from test cameras that were calibrated
//! together with the input's.

use std::fs;
use std::path::{Path, PathBuf};

use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{Dataset, Frame, Resize, write_mask, write_png};
use splat4d::{Error, Result};

use super::interrupt;

/// Where the parts of a staged dataset lie.
pub struct Staged {
    /// The training pictures, in the order of time.
    pub frames: PathBuf,
    /// Their cameras, the test pictures with theirs, and what the training pictures saw of these.
    pub truth: PathBuf,
}

impl Staged {
    /// In a folder, which need not exist yet.
    pub fn within(folder: &Path) -> Staged {
        Staged { frames: folder.join("clip/frames"), truth: folder.join("clip/truth") }
    }

    /// Lays a dataset out, unless it lies there already. Training pictures stay as they are, with their lens's
    /// distortion; test pictures are undistorted, at their own size.
    ///
    /// # Errors
    /// The dataset cannot be read, has no split, has training pictures of one time or in a video; the folder
    /// cannot be written.
    pub fn lay_out(&self, dataset: &Path) -> Result<()> {
        // It is written last.
        let last = self.truth.join("held_out/transforms.json");
        if last.is_file() {
            return Ok(());
        }
        let set = Dataset::open(dataset)?;
        let (mut train, test) = set.split(0);
        train.sort_by(|&a, &b| set.frames[a].time.total_cmp(&set.frames[b].time));
        check(dataset, &set, &train, &test)?;
        let held_out = self.truth.join("held_out");
        for folder in [&self.frames, &held_out.join("test"), &held_out.join("covisible/test")] {
            fs::create_dir_all(folder).map_err(Error::io(folder))?;
        }
        let (mut cameras, mut files) = (Vec::new(), Vec::new());
        for (i, frame) in train.iter().map(|&i| &set.frames[i]).enumerate() {
            interrupt::check()?;
            let extension = frame.path.extension().unwrap_or_default().to_string_lossy();
            let name = format!("{i:04}.{extension}");
            link(&frame.path, &self.frames.join(&name))?;
            cameras.push(timed(frame));
            files.push(format!("../frames/{name}"));
        }
        transforms::write(self.truth.join("transforms.json"), &cameras, &files, None)?;
        let (mut cameras, mut files) = (Vec::new(), Vec::new());
        for (i, frame) in test.iter().map(|&i| &set.frames[i]).enumerate() {
            interrupt::check()?;
            let file = format!("test/{i:04}.png");
            write_png(held_out.join(&file), &frame.load(set.background, Resize::Keep)?.image)?;
            if let Some(mask) = frame.load_covisible(Resize::Keep)? {
                write_mask(held_out.join("covisible").join(&file), &mask)?;
            }
            cameras.push(timed(frame));
            files.push(file);
        }
        transforms::write(last, &cameras, &files, None)
    }
}

/// That it has what is trained on and what is tested with, and one camera's clip in it.
fn check(path: &Path, set: &Dataset, train: &[usize], test: &[usize]) -> Result<()> {
    let bad = |what: String| Err(Error::format(path, what));
    if train.len() < 2 || test.is_empty() {
        let what = "has no split into training and test pictures, or fewer than two to train on";
        return bad(what.into());
    }
    let frames = |pair: &[usize]| [pair[0], pair[1]].map(|i| &set.frames[i]);
    if let Some([a, b]) = train.windows(2).map(frames).find(|[a, b]| a.time == b.time) {
        return bad(format!(
            "{} and {} were taken at one time; a clip is of one camera",
            a.name, b.name
        ));
    }
    match train.iter().map(|&i| &set.frames[i]).find(|frame| frame.number.is_some()) {
        Some(frame) => bad(format!("{} lies in a video; extract its frames first", frame.name)),
        None => Ok(()),
    }
}

fn timed(frame: &Frame) -> TimedCamera {
    TimedCamera { time: frame.time, camera: frame.camera }
}

/// The same file under another name, without a copy where the file system allows it.
fn link(from: &Path, to: &Path) -> Result<()> {
    if to.exists() {
        return Ok(());
    }
    fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(drop)).map_err(Error::io(to))
}
