//! Lays out a dataset with cameras and a split (its own, or by cameras) as a clip without poses and the
//! ground truth for `eval`. With it, scenes are evaluated with unknown poses, from test cameras that were
//! calibrated together with the input's.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::{Dataset, Resize, View, write_mask, write_png};
use splat4d::types::Camera;
use splat4d::{Error, Result, io};

use super::interrupt;

/// The file that records the source of a clip.
const MARKER: &str = "source.json";
/// Number of images in memory at a time. A video is decoded from its beginning for each such group.
const AT_A_TIME: usize = 32;

/// The dataset to lay out.
pub struct Source {
    pub dataset: PathBuf,
    /// Maximum length of the longer side of test images, and of training images from a video.
    pub size: Option<u32>,
    /// Training and test cameras; `None` if the dataset has its own split.
    pub cameras: Option<Cameras>,
}

/// Names of the cameras of a dataset with several static ones.
#[derive(Clone)]
pub struct Cameras {
    pub train: String,
    pub test: BTreeSet<String>,
}

/// Locations of the parts of a staged dataset.
pub struct Staged {
    clip: PathBuf,
    /// The training images, in the order of time.
    pub frames: PathBuf,
    /// Their cameras, the test images with theirs, and the covisibility masks of the test images.
    pub truth: PathBuf,
}

impl Staged {
    /// Locations in a folder, which need not exist yet.
    pub fn within(folder: &Path) -> Staged {
        let clip = folder.join("clip");
        Staged { frames: clip.join("frames"), truth: clip.join("truth"), clip }
    }

    /// Lays out a dataset, unless this has been done already; returns whether it was done. Training images
    /// that are files are kept unchanged, including lens distortion; test images are undistorted.
    ///
    /// # Errors
    /// The dataset cannot be read, has no split, or has training images with equal times; the folder cannot
    /// be written, or has other contents.
    pub fn lay_out(&self, source: &Source) -> Result<bool> {
        let marker = self.clip.join(MARKER);
        let told = source.json();
        if marker.is_file() {
            if io::read_json(&marker)? == told {
                return Ok(false);
            }
            // The marker shows that the folder was written by this command, for another dataset or other
            // options.
            fs::remove_dir_all(&self.clip).map_err(Error::io(&self.clip))?;
        }
        io::write_folder(&self.clip, &["frames", "truth", MARKER], |clip| {
            source.write(clip)?;
            io::write_json(clip.join(MARKER), &told)
        })?;
        Ok(true)
    }
}

impl Source {
    fn json(&self) -> Value {
        let Source { dataset, size, cameras } = self;
        let [train, test] = match cameras {
            Some(Cameras { train, test }) => [json!(train), json!(test)],
            None => [Value::Null, Value::Null],
        };
        json!({ "dataset": dataset.to_string_lossy(), "size": size, "train": train, "test": test })
    }

    fn write(&self, clip: &Path) -> Result<()> {
        let set = Dataset::open(&self.dataset)?;
        let (train, test) = self.split(&set)?;
        let laid = self.train(&set, &train, &clip.join("frames"))?;
        let held_out = clip.join("truth/held_out");
        let tests = self.test(&set, &test, &held_out)?;
        laid.write(&clip.join("truth"))?;
        tests.write(&held_out)
    }

    /// Training frames in the order of time, and test frames.
    fn split(&self, set: &Dataset) -> Result<(Vec<usize>, Vec<usize>)> {
        let (mut train, test) = match &self.cameras {
            None => set.split(0),
            Some(cameras) => {
                let of = |is: &dyn Fn(&str) -> bool| -> Vec<usize> {
                    let frames = set.frames.iter().enumerate();
                    frames.filter(|(_, frame)| is(camera(&frame.name))).map(|(i, _)| i).collect()
                };
                (of(&|name| name == cameras.train), of(&|name| cameras.test.contains(name)))
            }
        };
        train.sort_by(|&a, &b| set.frames[a].time.total_cmp(&set.frames[b].time));
        let bad = |what: String| Err(Error::format(&self.dataset, what));
        if train.len() < 2 || test.is_empty() {
            let what = "has no split into training and test images, or fewer than two to train on";
            return bad(what.into());
        }
        let frames = |pair: &[usize]| [pair[0], pair[1]].map(|i| &set.frames[i]);
        match train.windows(2).map(frames).find(|[a, b]| a.time == b.time) {
            Some([a, b]) => bad(format!(
                "{} and {} were taken at one time; a clip is of one camera",
                a.name, b.name
            )),
            None => Ok((train, test)),
        }
    }

    fn train(&self, set: &Dataset, train: &[usize], folder: &Path) -> Result<Listing> {
        fs::create_dir_all(folder).map_err(Error::io(folder))?;
        let mut listing = Listing::default();
        if train.iter().any(|&i| set.frames[i].number.is_some()) {
            self.each(set, train, |place, _, view| {
                let name = format!("{place:04}.png");
                write_png(folder.join(&name), &view.image)?;
                listing.add(view.time, view.camera, format!("../frames/{name}"));
                Ok(())
            })?;
            return Ok(listing);
        }
        for (place, frame) in train.iter().map(|&i| &set.frames[i]).enumerate() {
            interrupt::check()?;
            let extension = frame.path.extension().unwrap_or_default().to_string_lossy();
            let name = format!("{place:04}.{extension}");
            link(&frame.path, &folder.join(&name))?;
            listing.add(frame.time, frame.camera, format!("../frames/{name}"));
        }
        Ok(listing)
    }

    fn test(&self, set: &Dataset, test: &[usize], folder: &Path) -> Result<Listing> {
        let mut listing = Listing::default();
        self.each(set, test, |place, index, view| {
            // One folder per camera, which `eval` averages over.
            let of = if self.cameras.is_some() { camera(&view.name) } else { "test" };
            let file = format!("{of}/{place:04}.png");
            let path = folder.join(&file);
            fs::create_dir_all(folder.join(of)).map_err(Error::io(&path))?;
            write_png(path, &view.image)?;
            if let Some(mask) = set.frames[index].load_covisible(self.resize())? {
                let path = folder.join("covisible").join(&file);
                fs::create_dir_all(folder.join("covisible").join(of)).map_err(Error::io(&path))?;
                write_mask(path, &mask)?;
            }
            listing.add(view.time, view.camera, file);
            Ok(())
        })?;
        Ok(listing)
    }

    /// Passes some frames of the dataset one by one, decoded: the position among the indices, the index,
    /// the view.
    fn each(
        &self,
        set: &Dataset,
        indices: &[usize],
        mut of: impl FnMut(usize, usize, &View) -> Result<()>,
    ) -> Result<()> {
        for (group, indices) in indices.chunks(AT_A_TIME).enumerate() {
            interrupt::check()?;
            let views = set.load(indices, self.resize())?;
            for (i, (view, index)) in views.iter().zip(indices).enumerate() {
                of(group * AT_A_TIME + i, *index, view)?;
            }
        }
        Ok(())
    }

    fn resize(&self) -> Resize {
        self.size.map_or(Resize::Keep, Resize::Longest)
    }
}

/// Cameras with the files of their images.
#[derive(Default)]
struct Listing {
    cameras: Vec<TimedCamera>,
    files: Vec<String>,
}

impl Listing {
    fn add(&mut self, time: f64, camera: Camera, file: String) {
        self.cameras.push(TimedCamera { time, camera });
        self.files.push(file);
    }

    fn write(&self, folder: &Path) -> Result<()> {
        fs::create_dir_all(folder).map_err(Error::io(folder))?;
        transforms::write(folder.join("transforms.json"), &self.cameras, &self.files, None)
    }
}

/// The camera of a frame: `cam05` for `cam05/0003`.
fn camera(frame: &str) -> &str {
    frame.split_once('/').map_or(frame, |(camera, _)| camera)
}

/// Links a file under another name, without a copy where the file system supports it.
fn link(from: &Path, to: &Path) -> Result<()> {
    fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(drop)).map_err(Error::io(to))
}
