//! Options for the frames of a clip, and their size.

use std::path::Path;

use clap::Args;
use serde_json::{Value, json};
use splat4d::Result;
use splat4d::data::{Clip, ClipOptions, Resize, Shot, ShotChoice};

use super::common::notes;
use super::{interrupt, values};

/// Options of commands that take a clip.
#[derive(Args)]
pub struct ClipArgs {
    /// Use this shot of a clip with cuts, numbered from 0 as in the notes [default: the longest; the whole
    /// clip if data is supplied for each of its frames]
    #[arg(long, value_name = "N",
          value_parser = values::whole::<usize>(0..=values::MOST_PICTURES))]
    pub shot: Option<usize>,
    /// Use every N-th frame of the shot
    #[arg(long, value_name = "N", default_value_t = 1,
          value_parser = values::whole::<usize>(1..=values::MOST_PICTURES))]
    pub every: usize,
    /// Use at most this many frames of the shot
    #[arg(long, value_name = "N",
          value_parser = values::whole::<usize>(Clip::LEAST as u64..=values::MOST_PICTURES))]
    pub max_frames: Option<usize>,
    /// Downscale frames so that their longer side has at most this many pixels [default: by device and
    /// quality; standard 640, on a software driver 320]
    #[arg(long, value_name = "LONGEST",
          value_parser = values::whole::<u32>(16..=values::MOST_PIXELS))]
    size: Option<u32>,
    /// Downscale frames to this width instead; narrower ones are unchanged
    #[arg(long, value_name = "PIXELS", conflicts_with = "size",
          value_parser = values::whole::<u32>(16..=values::MOST_PIXELS))]
    width: Option<u32>,
    /// Skip frames that are damaged or lost, with a note
    #[arg(long)]
    skip_bad: bool,
}

impl ClipArgs {
    /// Reads the frames of one shot, at the `usual` size unless another is requested. If the user supplies
    /// data `for_each` frame, the whole clip is read unless a shot is requested.
    pub fn open(&self, path: &Path, usual: Resize, for_each: bool) -> Result<Clip> {
        let size = match (self.width, self.size) {
            (Some(width), _) => Resize::Width(width),
            (None, Some(longest)) => Resize::Longest(longest),
            _ => usual,
        };
        let shot = match self.shot {
            Some(number) => ShotChoice::Number(number),
            None if for_each => ShotChoice::Whole,
            None => ShotChoice::Longest,
        };
        let options = ClipOptions {
            shot,
            every: self.every,
            max_frames: self.max_frames,
            size,
            skip_bad: self.skip_bad,
        };
        let clip = Clip::open_while(path, &options, &interrupt::check)?;
        notes(&clip.notes);
        Ok(clip)
    }
}

/// JSON of shots for reports: the first and the last frame of each.
pub fn shots_json(shots: &[Shot]) -> Value {
    shots.iter().map(|shot| json!([shot.first, shot.last])).collect()
}
