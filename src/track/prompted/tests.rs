//! Substitutes for a network on a synthetic clip, and a frame that shows a square.

use std::collections::BTreeMap;

use super::super::cameras::Cameras;
use super::super::masks::{Observed, segment};
use super::super::residual::triangulate_frames;
use super::super::sliding::{HEIGHT, WIDTH, map, within, working};
use super::super::{Observer, Options, Sources, track_observed};
use super::*;
use crate::data::synth::{self, SynthOptions};
use crate::eval::mask_iou;
use crate::observe::{FoundMask, SuppliedFlow, observe_flow};

/// The masks that a substitute for a network draws.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Draws {
    /// The object, a pixel too small or too large all around and with holes, among wrong masks.
    Nearly,
    /// Discs around prompts, of random sizes.
    Blobs,
    Everything,
    Nothing,
    /// Everything except the object.
    Inverted,
}

/// A source that draws from the clip's ground truth.
struct Standin<'a> {
    truth: &'a [Image],
    draws: Draws,
    /// Frames in which it was queried, and the number of queries with an initial mask.
    asked: Vec<usize>,
    begun: usize,
}

impl Standin<'_> {
    fn new(truth: &[Image], draws: Draws) -> Standin<'_> {
        Standin { truth, draws, asked: Vec::new(), begun: 0 }
    }

    /// The object that the points inside it hit.
    fn thing(&self, number: usize, query: &MaskQuery) -> Image {
        let truth = &self.truth[number];
        let width = truth.width as usize;
        let mut out = Image::new(truth.width, truth.height, 1);
        let inside = query.prompts.iter().filter(|prompt| prompt.inside);
        let hit: Vec<usize> =
            inside.map(|p| p.pixel.y as usize * width + p.pixel.x as usize).collect();
        for (region, _) in regions(&truth.pixels, width, true) {
            if hit.iter().any(|i| region.contains(i)) {
                region.into_iter().for_each(|i| out.pixels[i] = 1.0);
            }
        }
        out
    }

    fn draw(&self, number: usize, query: &MaskQuery) -> Vec<Image> {
        let thing = self.thing(number, query);
        let everything = Image { pixels: vec![1.0; thing.pixels.len()], ..thing };
        let inverted = inverse(&thing);
        match self.draws {
            Draws::Nearly => {
                let mut near = match number % 2 {
                    0 => inverse(&grown(&inverted, 1)),
                    _ => grown(&thing, 1),
                };
                for (i, value) in near.pixels.iter_mut().enumerate() {
                    let (x, y) = (i % thing.width as usize, i / thing.width as usize);
                    if (x + 3 * number) % 11 < 2 && y % 7 < 2 {
                        *value = 0.0;
                    }
                }
                vec![inverted, near, everything]
            }
            Draws::Blobs => (0..3).map(|k| blob(&thing, query, 3 * number + k)).collect(),
            Draws::Everything => vec![everything],
            Draws::Nothing => vec![inverse(&everything)],
            Draws::Inverted => vec![inverted],
        }
    }
}

impl MaskSource for Standin<'_> {
    fn masks(
        &mut self,
        number: usize,
        _frame: &Image,
        asked: &[MaskQuery],
    ) -> Result<Vec<Vec<FoundMask>>> {
        self.asked.push(number);
        self.begun += usize::from(asked.iter().any(|query| query.before.is_some()));
        let odds = |mask: Image| {
            let pixels = mask.pixels.iter().map(|value| 16.0 * value - 8.0).collect();
            FoundMask { odds: Image { pixels, ..mask }, score: 0.5 }
        };
        let drawn = |query| self.draw(number, query).into_iter().map(odds).collect();
        Ok(asked.iter().map(drawn).collect())
    }
}

fn inverse(mask: &Image) -> Image {
    Image { pixels: mask.pixels.iter().map(|value| 1.0 - value).collect(), ..*mask }
}

fn grown(mask: &Image, by: usize) -> Image {
    let pixels = mask.near(by).into_iter().map(|near| f32::from(u8::from(near))).collect();
    Image { pixels, ..*mask }
}

/// A disc near one of the prompts.
fn blob(like: &Image, query: &MaskQuery, seed: usize) -> Image {
    let mut state = seed as u32 + 1;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1 << 24)
    };
    random();
    let at = query.prompts[(random() * query.prompts.len() as f64) as usize].pixel;
    let radius = (0.03 + 0.2 * random()) * f64::from(like.width);
    let middle = at + radius * (DVec2::new(random(), random()) - 0.5);
    let inside = |i| super::centre(i, like.width as usize).distance(middle) < radius;
    let pixels = (0..like.pixels.len()).map(|i| f32::from(u8::from(inside(i)))).collect();
    Image { pixels, ..*like }
}

/// An observer that keeps parts, and ends the work after `left` of the source's frames.
struct Keeps {
    parts: BTreeMap<String, Vec<u8>>,
    left: usize,
}

impl Observer for Keeps {
    fn progress(&mut self, _: Stage, _: f64) -> Result<()> {
        match self.left {
            0 => Err(Error::Interrupted { checkpoint: None }),
            _ => Ok(()),
        }
    }

    fn keeps(&self) -> bool {
        true
    }

    fn keep(&mut self, part: &str, value: Vec<u8>) -> Result<()> {
        self.left -= usize::from(part.contains("prompted"));
        self.parts.insert(part.into(), value);
        Ok(())
    }

    fn kept(&mut self, part: &str) -> Result<Option<Vec<u8>>> {
        Ok(self.parts.get(part).cloned())
    }
}

/// A small clip whose flow has small errors.
fn clip(name: &str, frames: usize, (width, height): (u32, u32)) -> (synth::Clip, SuppliedFlow) {
    let size = SynthOptions { frames, width, height, seed: 3 };
    let width = width as usize;
    let clip = synth::clip(name, &size).unwrap();
    let bent = |(k, flow): (usize, &Image)| {
        let mut out = flow.clone();
        for (i, v) in out.pixels.chunks_exact_mut(2).enumerate() {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            v[0] += 0.2 * (0.31 * x + 0.17 * y + k as f32).sin();
            v[1] += 0.2 * (0.23 * y - 0.29 * x + 2.0 * k as f32).cos();
        }
        out
    };
    let all = |fields: &[Image]| fields.iter().enumerate().map(bent).collect();
    let flow = SuppliedFlow::new(all(&clip.flow_forward), all(&clip.flow_backward)).unwrap();
    (clip, flow)
}

/// Judges the clip's pixels against its true cameras, and makes the masks from that.
fn judged<T>(
    clip: &synth::Clip,
    mut flow: SuppliedFlow,
    then: impl FnOnce(&Judged, &[Image]) -> T,
) -> T {
    let flow = observe_flow(&clip.frames, &mut flow, &mut |_| Ok(())).unwrap();
    let cameras = &Cameras::known(clip.intrinsics, clip.view_from_world.clone());
    working(|work| {
        let seen = triangulate_frames(cameras, &flow, work, "test", 0.0..0.5).unwrap();
        let observed = Observed { frames: &clip.frames, cameras, flow: &flow, seen: &seen };
        let judged = Judged::new(observed, None, work, "test", 0.5..0.6).unwrap();
        let masks = judged.segment(None, work, "test", 0.6..0.7).unwrap();
        assert_eq!(masks, segment(observed, None, work, "test", 0.5..0.7).unwrap());
        then(&judged, &masks)
    })
}

fn iou(masks: &[Image], truth: &[Image]) -> f64 {
    let all = masks.iter().zip(truth).map(|(mask, truth)| mask_iou(mask, truth).unwrap());
    all.sum::<f64>() / truth.len() as f64
}

#[test]
fn good_masks_help_and_wrong_ones_do_no_harm() {
    let (clip, flow) = clip("walk", 8, (160, 90));
    judged(&clip, flow, |judged, masks| {
        let before = iou(masks, &clip.masks);
        let with = |draws| {
            let mut source = Standin::new(&clip.masks, draws);
            let (said, fused) = working(|work| {
                let said = ask(judged, masks, None, &mut source, work, "test").unwrap();
                let fused = judged.segment(Some(&said.odds), work, "test", 0.7..0.8).unwrap();
                (said, fused)
            });
            assert!(source.asked.len() > 5, "{draws:?}: {:?}", source.asked);
            let after = iou(&fused, &clip.masks);
            eprintln!("{draws:?}: {} accepted, IoU {before:.3} to {after:.3}", said.accepted);
            (said.accepted, after, source.begun)
        };
        let (accepted, after, begun) = with(Draws::Nearly);
        assert!(accepted > 4 && begun > 2, "{accepted} {begun}");
        assert!(after > before + 0.005, "{before} {after}");
        for draws in [Draws::Blobs, Draws::Everything, Draws::Nothing, Draws::Inverted] {
            let (accepted, after, _) = with(draws);
            assert!(after > before - 0.02, "{draws:?}: {before} {after}");
            assert!(draws == Draws::Blobs || accepted == 0, "{draws:?}: {accepted}");
        }
    });
}

#[test]
fn an_interrupted_run_asks_for_the_rest_alone() {
    let (clip, flow) = clip("walk", 6, (120, 68));
    judged(&clip, flow, |judged, masks| {
        let mut source = Standin::new(&clip.masks, Draws::Nearly);
        let whole = working(|work| ask(judged, masks, None, &mut source, work, "test").unwrap());
        let frames = source.asked;
        let mut observer = Keeps { parts: BTreeMap::new(), left: 3 };
        let mut source = Standin::new(&clip.masks, Draws::Nearly);
        let ended = ask(judged, masks, None, &mut source, &mut Work::new(&mut observer), "test");
        assert!(matches!(ended, Err(Error::Interrupted { .. })));
        observer.left = usize::MAX;
        let mut rest = Standin::new(&clip.masks, Draws::Nearly);
        let work = &mut Work::new(&mut observer);
        let resumed = ask(judged, masks, None, &mut rest, work, "test").unwrap();
        assert_eq!((resumed.odds, resumed.accepted), (whole.odds, whole.accepted));
        assert!(!source.asked.is_empty() && !rest.asked.is_empty());
        assert_eq!([source.asked, rest.asked].concat(), frames);
    });
}

#[test]
fn what_the_user_supplies_wins() {
    let (clip, flow) = clip("rigid", 8, (120, 68));
    let run = |masks: Option<Vec<Image>>| {
        let options = Options {
            masks,
            lens: false,
            stereo: false,
            lift: false,
            rounds: 1,
            ..Options::default()
        };
        let mut source = Standin::new(&clip.masks, Draws::Nearly);
        let sources = Sources { flow: &mut flow.clone(), masks: Some(&mut source), features: None };
        let mut observer = Keeps { parts: BTreeMap::new(), left: usize::MAX };
        let track = track_observed(&clip.frames, &options, sources, &mut observer).unwrap();
        let note = track.quality.notes.into_iter().find(|note| note.starts_with("masks: "));
        (source.asked, note.unwrap())
    };
    let (asked, note) = run(Some(clip.masks.clone()));
    assert!(asked.is_empty() && note.contains("supplied"), "{asked:?} {note}");
    let (asked, note) = run(None);
    assert_eq!((asked.len(), &*note), (8, "masks: the network's accepted in 8 of 8 frames"));
}

/// A square of 20 × 20 pixels that moves, with the most certain motion in its left half, and undecided pixels
/// to its right.
pub(super) fn square(p: DVec2) -> bool {
    within(p, (20.0, 10.0), (40.0, 30.0))
}

fn odds(p: DVec2) -> f32 {
    match (square(p), p.x) {
        (true, x) if x < 30.0 => 3.0,
        (true, _) => 1.0,
        (false, 40.0..46.0) => 0.0,
        (false, _) => -2.0,
    }
}

pub(super) fn mask(of: impl Fn(DVec2) -> bool) -> Image {
    map(|p| if of(p) { 8.0 } else { -8.0 })
}

/// Runs with a frame that shows the square.
pub(super) fn with_square<T>(then: impl FnOnce(&Frame) -> T) -> T {
    let picture = Image::new(WIDTH, HEIGHT, 3);
    let moves = map(|p| f32::from(u8::from(square(p))));
    then(&Frame::new(0, &picture, map(odds).pixels, &moves))
}

#[test]
fn masks_that_are_none_are_refused() {
    struct Wrong(Vec<Vec<FoundMask>>);
    impl MaskSource for Wrong {
        fn masks(&mut self, _: usize, _: &Image, _: &[MaskQuery]) -> Result<Vec<Vec<FoundMask>>> {
            Ok(self.0.clone())
        }
    }
    let found = |odds, score| vec![vec![FoundMask { odds, score }]];
    let cases = [
        (Vec::new(), "asked for frame 0: 0 answers to 1 questions"),
        (found(Image::new(8, HEIGHT, 1), 0.0), "a mask is 8×40 with 1 channels"),
        (found(map(|_| f32::NAN), 0.0), "not a number"),
        (found(map(|_| 0.0), f32::NAN), "not a number"),
    ];
    for (answers, expected) in cases {
        let error = with_square(|frame| frame.ask(&mut Wrong(answers), &[]).err().unwrap());
        assert!(error.to_string().contains(expected), "{error}");
    }
}
