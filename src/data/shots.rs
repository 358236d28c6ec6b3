//! Shot detection: where a clip is cut.
//!
//! Frames are compared as small grey images by the share of blocks that are found again (`likeness`),
//! independent of motion and brightness. A cut is a place where nothing of the three frames before is found
//! in the three after, while on both sides a large part of each frame is still found two or three frames
//! later. A flash, a black frame or a damaged frame is therefore no cut, because the frames around it are
//! alike. Neither is a fast pan or a folder of photographs from different places, because frames a few
//! apart are unlike everywhere. Frames without texture, as in a fade through black, and frames that repeat
//! the previous one are ignored.

use std::collections::VecDeque;
use std::path::Path;

use likeness::{Picture, likeness};

use crate::types::Image;
use crate::{Error, Result};

mod likeness;

/// Longer side of the compared images, pixels.
pub(super) const LONGEST: u32 = 96;
/// Number of frames examined on either side of a cut.
const REACH: usize = 4;
/// Number of these that are compared across the cut.
const ACROSS: usize = 3;
/// Minimum likeness of frames two or three apart within a shot, and `FACTOR`, by which it must exceed the
/// likeness across the shot's end.
const FLUENT: f32 = 0.4;
const FACTOR: f32 = 4.0;
/// Maximum likeness across a cut when a side has too few frames to measure its own.
const UNLIKE: f32 = 0.12;
/// Maximum number of consecutive repeated frames that are ignored; in a longer run the scene is static.
const REPEATS: usize = 12;
/// Minimum length of a shot, frames.
const SHORTEST: usize = 3;

/// A run of frames without a cut, by their indices in the whole clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shot {
    /// The first frame.
    pub first: usize,
    /// The last frame.
    pub last: usize,
}

impl Shot {
    /// Number of frames in the shot.
    pub fn frames(&self) -> usize {
        self.last - self.first + 1
    }
}

/// Which shot of a clip to use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ShotChoice {
    /// The longest shot; the first one of several.
    #[default]
    Longest,
    /// The shot with this index, from 0.
    Number(usize),
    /// The whole clip, with its cuts.
    Whole,
}

impl ShotChoice {
    /// Index of the chosen shot, `None` for the whole clip; `rate` in frames per second.
    ///
    /// # Errors
    /// No shot has the index.
    pub(super) fn among(
        self,
        path: &Path,
        shots: &[Shot],
        rate: Option<f64>,
    ) -> Result<Option<usize>> {
        match self {
            ShotChoice::Whole => Ok(None),
            ShotChoice::Number(number) if number < shots.len() => Ok(Some(number)),
            ShotChoice::Number(0) => Ok(None),
            ShotChoice::Number(number) if shots.is_empty() => {
                let what = format!("has no shot {number}: no cut was found, all of it is shot 0");
                Err(Error::format(path, what))
            }
            ShotChoice::Number(number) => {
                let what = format!("has no shot {number}; its shots are {}", list(shots, rate));
                Err(Error::format(path, what))
            }
            ShotChoice::Longest => {
                let numbers = (0..shots.len()).rev();
                Ok(numbers.max_by_key(|&i| shots[i].frames()))
            }
        }
    }

    /// The note about a clip with cuts, of which `shot` was taken.
    pub(super) fn note(self, shots: &[Shot], shot: Option<usize>, rate: Option<f64>) -> String {
        let list = list(shots, rate);
        let count = shots.len();
        match (shot, self) {
            (None, _) => format!(
                "the clip seems to have {count} shots: {list}; all frames are taken as one shot, \
                 unless one is chosen by its number"
            ),
            (Some(shot), ShotChoice::Longest) => format!(
                "the clip has {count} shots: {list}; shot {shot}, the longest, is taken; \
                 another can be chosen by its number"
            ),
            (Some(shot), _) => format!("the clip has {count} shots: {list}; shot {shot} is taken"),
        }
    }
}

/// A list of shots for a message, of limited length.
fn list(shots: &[Shot], rate: Option<f64>) -> String {
    const MOST: usize = 40;
    let one = |(i, shot): (usize, &Shot)| {
        let times = rate.map_or(String::new(), |rate| {
            // A frame is shown until the next one.
            let (from, to) = (shot.first as f64 / rate, (shot.last + 1) as f64 / rate);
            format!(", {from:.2} to {to:.2} s")
        });
        format!("{i} (frames {} to {}{times})", shot.first, shot.last)
    };
    let shown: Vec<String> = shots.iter().enumerate().take(MOST).map(one).collect();
    let more = match shots.len().saturating_sub(MOST) {
        0 => String::new(),
        n => format!(" and {n} more"),
    };
    shown.join(", ") + &more
}

/// Converts a small RGB image to the grey image that a [`Detector`] takes.
pub(super) fn grey(image: &Image) -> Image {
    let luminance = |rgb: &[f32]| 0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2];
    let pixels = image.pixels.chunks_exact(3).map(luminance).collect();
    Image { width: image.width, height: image.height, channels: 1, pixels }
}

/// A frame with texture, and the frames after it that repeat it.
struct Telling {
    first: usize,
    last: usize,
    picture: Picture,
    /// Share of the previous frame that is found in it.
    follows: f32,
}

/// Streaming cut detector; it keeps a few frames.
#[derive(Default)]
pub(super) struct Detector {
    frames: usize,
    recent: VecDeque<Telling>,
    /// Index, among the recent frames, of the frame after the last examined place.
    next: usize,
    /// The last frame before each cut and the first after it.
    cuts: Vec<(usize, usize)>,
}

impl Detector {
    /// Takes the next frame's small grey image; `None` for an unreadable frame.
    pub(super) fn push(&mut self, picture: Option<&Image>) {
        let number = self.frames;
        self.frames += 1;
        let Some(picture) = picture.map(Picture::of).filter(Picture::is_telling) else { return };
        let mut follows = 1.0;
        if let Some(before) = self.recent.back_mut() {
            if number - before.first <= REPEATS && picture.repeats(&before.picture) {
                before.last = number;
                return;
            }
            follows = likeness(&before.picture, &picture);
        }
        self.recent.push_back(Telling { first: number, last: number, picture, follows });
        while self.next + REACH < self.recent.len() {
            self.look();
        }
    }

    /// All shots in order; empty where no cut was found.
    pub(super) fn finish(mut self) -> Vec<Shot> {
        while self.next + 1 < self.recent.len() {
            self.look();
        }
        let firsts = std::iter::once(0).chain(self.cuts.iter().map(|cut| cut.1));
        let lasts = self.cuts.iter().map(|cut| cut.0).chain([self.frames.saturating_sub(1)]);
        let shots = firsts.zip(lasts).map(|(first, last)| Shot { first, last });
        if self.cuts.is_empty() {
            return Vec::new();
        }
        shots.filter(|shot| shot.frames() >= SHORTEST).collect()
    }

    /// Examines the next possible cut.
    fn look(&mut self) {
        let at = self.next;
        let is_cut = self.is_cut(at);
        if is_cut {
            self.cuts.push((self.recent[at].last, self.recent[at + 1].first));
        }
        self.next += 1;
        let gone = if is_cut { at + 1 } else { (at + 2).saturating_sub(REACH) };
        self.recent.drain(..gone);
        self.next -= gone;
    }

    /// Whether the clip is cut after one of the recent frames.
    fn is_cut(&self, at: usize) -> bool {
        // The likeness is at most 1.
        if FACTOR * self.recent[at + 1].follows > 1.0 {
            return false;
        }
        let picture = |i: usize| &self.recent[i].picture;
        let before: Vec<&Picture> = ((at + 1).saturating_sub(REACH)..=at).map(picture).collect();
        let end = (at + 1 + REACH).min(self.recent.len());
        let after: Vec<&Picture> = (at + 1..end).map(picture).collect();
        let mut across = 0.0f32;
        for a in before.iter().rev().take(ACROSS) {
            for b in after.iter().take(ACROSS) {
                across = across.max(likeness(a, b));
                if FACTOR * across > 1.0 {
                    return false;
                }
            }
        }
        let least = FLUENT.max(FACTOR * across);
        let few = before.len().min(after.len()) < SHORTEST;
        (!few || across <= UNLIKE) && fluency(&before) >= least && fluency(&after) >= least
    }
}

/// Likeness of frames two or more apart; with fewer than three frames, of those available.
fn fluency(frames: &[&Picture]) -> f32 {
    let apart = 2.min(frames.len() - 1);
    let later = |i: usize| frames[i + apart..].iter().map(move |b| likeness(frames[i], b));
    (0..frames.len() - apart).flat_map(later).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A part of an endless wall with patches of about 6 and 12 pixels, seen from `left`.
    fn view(wall: u32, left: f32) -> Image {
        let (width, height) = (96, 54);
        let patch = |x: i32, y: i32, of: u32| {
            let mut hash =
                (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77);
            hash ^= (wall * 2 + of).wrapping_mul(0xc2b2_ae3d);
            hash = (hash ^ (hash >> 15)).wrapping_mul(0x2c1b_3c6d);
            ((hash ^ (hash >> 13)) & 0xffff) as f32 / 65535.0
        };
        let smooth = |x: f32, y: f32, of: u32| {
            let (u, v) = (x.floor(), y.floor());
            let at = |i: i32, j: i32| patch(u as i32 + i, v as i32 + j, of);
            let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
            let upper = mix(at(0, 0), at(1, 0), x - u);
            mix(upper, mix(at(0, 1), at(1, 1), x - u), y - v)
        };
        let mut image = Image::new(width, height, 1);
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (x as f32 + left, y as f32);
                let value = 0.5 * smooth(u / 6.0, v / 6.0, 0) + 0.5 * smooth(u / 12.0, v / 12.0, 1);
                image.at_mut(x, y)[0] = value;
            }
        }
        image
    }

    /// A shot along a wall, at `speed` pixels per frame.
    fn shot(wall: u32, frames: usize, speed: f32) -> Vec<Image> {
        (0..frames).map(|i| view(wall, speed * i as f32)).collect()
    }

    fn lit(image: &Image, gain: f32) -> Image {
        let pixels = image.pixels.iter().map(|v| (v * gain).min(1.0)).collect();
        Image { pixels, ..*image }
    }

    fn found(frames: &[Image]) -> Vec<(usize, usize)> {
        let mut detector = Detector::default();
        frames.iter().for_each(|frame| detector.push(Some(frame)));
        detector.finish().iter().map(|shot| (shot.first, shot.last)).collect()
    }

    #[test]
    fn cuts_are_found_where_they_are() {
        let (a, b, c) = (shot(1, 9, 2.0), shot(2, 6, -3.0), shot(3, 7, 0.0));
        let together = [a.clone(), b, c].concat();
        assert_eq!(found(&together), [(0, 8), (9, 14), (15, 21)]);
        // The light fades out, and in again in another shot.
        let dark = |(i, frame): (usize, &Image)| lit(frame, 1.0 - i as f32 / 8.0);
        let out: Vec<Image> = a.iter().enumerate().map(dark).collect();
        let on: Vec<Image> = shot(2, 9, 2.0).iter().rev().enumerate().map(dark).rev().collect();
        let shots = found(&[out, vec![lit(&a[0], 0.0); 5], on].concat());
        assert!(shots.len() == 2 && shots[0].1 <= 8 && shots[1].0 >= 14, "{shots:?}");
        // Repeated frames count once.
        let held: Vec<Image> = together.iter().flat_map(|f| [f.clone(), f.clone()]).collect();
        assert_eq!(found(&held), [(0, 17), (18, 29), (30, 43)]);
        // A shot that is too short is dropped.
        let end = [shot(1, 9, 2.0), shot(2, 2, 2.0), shot(3, 9, 2.0)].concat();
        assert!(found(&end).iter().all(|shot| *shot == (0, 8) || *shot == (11, 19)));
    }

    #[test]
    fn one_shot_is_not_cut() {
        let whole = shot(1, 16, 2.0);
        let with = |change: &dyn Fn(&mut Vec<Image>)| {
            let mut frames = whole.clone();
            change(&mut frames);
            assert_eq!(found(&frames), []);
        };
        with(&|_| ());
        // A flash, black frames, an unrelated frame, a gap.
        with(&|frames| frames[7] = lit(&frames[7], 3.0));
        with(&|frames| frames[7..9].iter_mut().for_each(|frame| *frame = lit(frame, 0.0)));
        with(&|frames| frames[4..12].iter_mut().for_each(|frame| *frame = lit(frame, 0.0)));
        with(&|frames| frames[7] = view(2, 0.0));
        with(&|frames| drop(frames.drain(6..9)));
        with(&|frames| frames[7..].iter_mut().for_each(|frame| *frame = lit(frame, 0.7)));
        // A camera that suddenly turns fast, and one that always does.
        let turn = |i: usize| if i < 6 { 0.0 } else { 40.0 * (i - 5).min(6) as f32 };
        assert_eq!(found(&(0..18).map(|i| view(1, turn(i))).collect::<Vec<_>>()), []);
        assert_eq!(found(&shot(1, 12, 30.0)), []);
        // A sequence of unrelated places: there is no continuous shot that could be cut.
        assert_eq!(found(&(0..12).map(|i| view(i, 0.0)).collect::<Vec<_>>()), []);
        assert_eq!(found(&[]), []);
        assert_eq!(found(&vec![Image::new(96, 54, 1); 9]), []);
        assert_eq!(found(&vec![Image::new(9, 5, 1); 9]), []);
    }

    #[test]
    fn the_shot_asked_for_is_taken() {
        let shot = |first, last| Shot { first, last };
        let shots = [shot(0, 9), shot(10, 39), shot(42, 71), shot(72, 80)];
        let among = |choice: ShotChoice, shots: &[Shot]| {
            choice.among(Path::new("film.mp4"), shots, Some(10.0)).map_err(|e| e.to_string())
        };
        assert_eq!(among(ShotChoice::Longest, &shots), Ok(Some(1)));
        assert_eq!(among(ShotChoice::Longest, &[]), Ok(None));
        assert_eq!(among(ShotChoice::Whole, &shots), Ok(None));
        assert_eq!(among(ShotChoice::Number(3), &shots), Ok(Some(3)));
        assert_eq!(among(ShotChoice::Number(0), &[]), Ok(None));
        let message = among(ShotChoice::Number(4), &shots).unwrap_err();
        for part in ["film.mp4", "no shot 4", "0 (frames 0 to 9, 0.00 to 1.00 s), 1 (frames 10"] {
            assert!(message.contains(part), "{message}");
        }
        let message = among(ShotChoice::Number(1), &[]).unwrap_err();
        assert!(message.contains("no cut was found"), "{message}");
        let many: Vec<Shot> = (0..100).map(|i| shot(3 * i, 3 * i + 2)).collect();
        assert!(list(&many, None).ends_with("39 (frames 117 to 119) and 60 more"));
    }
}
