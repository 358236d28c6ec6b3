//! The distance of a mover: one scale for its path, and corrections of the path, from four sources.
//!
//! - Outline: an object keeps its size, so drift of its structure from motion shows as a change of size
//!   ([`super::outline`]).
//! - Contact: an object that touches static ground in most frames is as far away as the ground there
//!   ([`super::contact`]).
//! - Flight: the path of an object that flies is a parabola, with the same acceleration for all
//!   ([`super::ballistic`]).
//! - Smoothness: what does not fly moves smoothly by itself, and a hand-held camera does not ([`super::smooth`]).
//!   A smooth path also gives the depth in frames that show the object only in part.
//! - Occlusion: an object is nearer than what it hides. If the image border cuts off its lower end, it is a
//!   little nearer than the ground at that border.
//!
//! If supplied depth covers the object, it replaces all of these.
//!
//! Contact and smoothness each have a standard deviation and are averaged with inverse-variance weights. Where
//! they contradict each other, contact is right: it is seen, and smoothness is an assumption.
//! Without contact, the bound from occlusion takes its place. If the object is connected with another object,
//! the depth of that object replaces the bound.

use glam::{DMat3, DVec2, DVec3};

use super::ballistic::{self, Flight, Middle};
use super::cameras::Cameras;
use super::contact::{contacts, touched};
use super::lower_end::{LowerEnd, lower_end};
use super::movers::{BOUND, KNOWN};
use super::objects::Object;
use super::outline::{Outline, Outlines};
use super::path::{Estimate, Pull, bent};
use super::quantile;
use super::shape::{OFF_CENTRE, Shape};
use super::smooth::{self, Place};
use crate::types::Intrinsics;

/// Initial width of the robust kernel of the outline residuals, as a logarithm of depth.
const SIZED_FIRST: f64 = 1.6;
/// Standard deviation of an object's middle across the line of sight, pixels: first where the middle is known
/// from structure from motion or from the whole outline, then where it is not.
const MIDDLE: (f64, f64) = (0.1, 2.0);
/// Standard deviation along the line of sight, relative to the depth: first for a rigid object, then where
/// not even the outline is known.
const ALONG: (f64, f64) = (0.005, 0.1);
/// Maximum number of frames with an unknown middle across which a path is continuous. Over a longer gap the
/// object may have reversed its direction.
const GAP: usize = 2;
/// Relative standard deviation of a path's unit above which it is not used: its logarithm is no longer
/// normally distributed, and it gives little information.
const LINEAR: f64 = 0.3;
/// Standard deviation of the logarithm of a scale below which the scale counts as known.
const DECIDED: f64 = 0.2;
/// How much nearer an object without contact is than what it hides: mean and standard deviation of the
/// logarithm. Few objects fly directly in front of a wall or of the camera.
const BEFORE: (f64, f64) = (0.4, 0.3);
/// How much nearer an object that the lower image border cuts off is than the ground at that border, in the
/// frame where the two are closest: mean and standard deviation of the logarithm. The object stands on ground
/// below the image.
const CUT_OFF: (f64, f64) = (0.1, 0.15);
/// The same for an object that is connected with another one, relative to that object.
const BESIDE: (f64, f64) = (0.05, 0.12);
/// Standard deviation of the logarithm of supplied depth in one frame, and the minimum share of an object's
/// frames that must have supplied depth.
const SUPPLIED: (f64, f64) = (0.05, 0.5);
/// How far in front of an object's centre its visible surface is on average, in radii: that of a ball.
const SURFACE: f64 = 2.0 / 3.0;
/// Minimum standard deviation of a step of a path, as a logarithm of depth.
const LEAST_DRIFT: f64 = 0.002;

/// The static world from the camera of one frame, including the parts that movers hide.
#[derive(Clone, Copy)]
pub(super) struct Behind<'a> {
    /// Inverse depth.
    pub inverse: &'a [f32],
    /// The confidence of the inverse depth; see [`super::Track::depth_confidence`].
    pub confidence: &'a [f32],
    /// The ground of the whole clip, if it was found: its inverse depth at the pixel (x, y) is the dot product
    /// with (x, y, 1).
    pub ground: Option<DVec3>,
}

/// The estimated distance of an object.
pub(super) struct Distance {
    /// Logarithm of the depth of the object's middle, frame by frame, up to an additive constant.
    path: Vec<f64>,
    /// That constant.
    scale: Scale,
}

/// The source of the scale of a path.
enum Scale {
    /// The scale is known from contact with the static world or from supplied depth.
    Known(Estimate),
    /// The object is at an unknown distance in front of what it hides.
    Bounded { before: Estimate, smooth: Option<Estimate> },
}

impl Distance {
    /// The distance from supplied depth. `supplied` is the logarithm of the middle's depth, frame by frame.
    /// Returns `None` if it is known in too few frames.
    pub fn supplied(shape: &Shape, supplied: &[Option<f64>]) -> Option<Distance> {
        let n = shape.frames.len();
        let offsets: Vec<f64> = supplied
            .iter()
            .zip(&shape.frames)
            .filter_map(|(supplied, frame)| Some((*supplied)? - frame.depth.ln()))
            .collect();
        if offsets.is_empty() || (offsets.len() as f64) < SUPPLIED.1 * n as f64 {
            return None;
        }
        let deviation = SUPPLIED.0 / (offsets.len() as f64).sqrt();
        let offset = quantile(offsets, 0.5);
        let path: Vec<f64> = shape.frames.iter().map(|f| f.depth.ln() + offset).collect();
        let target = |s: &Option<f64>| Some(Estimate { value: (*s)?, deviation: SUPPLIED.0 });
        let targets: Vec<Option<Estimate>> = supplied.iter().map(target).collect();
        let steps = steps(shape);
        let pull = Pull { first_width: SIZED_FIRST / SUPPLIED.0, power: 1 };
        let path = bent(&path, &path, &targets, pull, &steps);
        Some(Distance { path, scale: Scale::Known(Estimate { value: 0.0, deviation }) })
    }

    /// Whether the distance is known well enough for the confidence [`KNOWN`].
    pub fn is_known(&self) -> bool {
        self.scale().1 == KNOWN
    }

    /// The depth of the middle in the world's unit, frame by frame, and its confidence.
    pub fn depths(&self) -> (Vec<f64>, f32) {
        let (scale, confidence) = self.scale();
        (self.path.iter().map(|x| (x + scale.value).exp()).collect(), confidence)
    }

    fn scale(&self) -> (Estimate, f32) {
        match &self.scale {
            Scale::Known(scale) => (*scale, KNOWN),
            Scale::Bounded { before, smooth } => {
                let scale = smooth.map_or(*before, |smooth| before.and(smooth));
                (scale, if scale.deviation < DECIDED { KNOWN } else { BOUND })
            }
        }
    }

    /// Assumes that the object is about as deep as another object that it is connected with; this replaces
    /// the bound from occlusion. `first` and `other_first` are the frames in which the two objects are first
    /// seen.
    pub fn depend_on(&mut self, first: usize, (other, other_first): (&Distance, usize)) {
        let (scale, _) = other.scale();
        let off: Vec<f64> = self
            .path
            .iter()
            .enumerate()
            .filter_map(|(k, own)| {
                let there = other.path.get((first + k).checked_sub(other_first)?)?;
                Some(there + scale.value - own)
            })
            .collect();
        if let (Scale::Bounded { before, .. }, false) = (&mut self.scale, off.is_empty()) {
            let deviation = BESIDE.1.hypot(scale.deviation);
            *before = Estimate { value: quantile(off, 0.5) - BESIDE.0, deviation };
        }
    }
}

/// What is observed of an object, without its distance.
pub(super) struct Observed {
    /// The object's first frame.
    first: usize,
    /// Its state frame by frame.
    seen: Vec<Seen>,
    /// Standard deviation of each step of its path, logarithm.
    steps: Vec<f64>,
    lower_ends: Vec<Option<LowerEnd>>,
    /// The logarithm of its depth that follows from contact with the ground, frame by frame.
    contacts: Vec<Option<Estimate>>,
    /// The logarithm of the depth of what it hides, frame by frame.
    hidden: Vec<Option<f64>>,
}

impl Observed {
    /// Observes an object. `owners` and `behind` hold one entry per frame of the clip.
    pub fn new(
        index: usize,
        object: &Object,
        shape: &Shape,
        intrinsics: &Intrinsics,
        owners: &[Vec<Option<u16>>],
        behind: &[Behind<'_>],
    ) -> Observed {
        let frames = object.first..object.first + shape.frames.len();
        let (owners, behind) = (&owners[frames.clone()], &behind[frames]);
        let width = intrinsics.width as usize;
        let Outlines { frames: outlines, deviation: outline_deviation, .. } =
            Outlines::new(index as u16, owners, behind, intrinsics);
        let steps = steps(shape);
        let depths = {
            let path: Vec<f64> = shape.frames.iter().map(|f| f.depth.ln()).collect();
            let sizes: Vec<Option<f64>> = outlines.iter().map(|o| Some((*o)?.depth.ln())).collect();
            sized(path, &sizes, outline_deviation, &steps)
        };
        let middles = middles(shape, &outlines);
        let radius = {
            let radius = |(owners, depth): (&Vec<Option<u16>>, &f64)| {
                let pixels = owners.iter().filter(|owner| **owner == Some(index as u16)).count();
                (pixels as f64 / std::f64::consts::PI).sqrt() * depth.exp()
            };
            quantile(owners.iter().zip(&depths).map(radius).collect(), 0.5) / intrinsics.fx
        };
        let lower_ends: Vec<Option<LowerEnd>> = owners
            .iter()
            .zip(behind)
            .map(|(owners, behind)| lower_end(index, owners, *behind, width))
            .collect();
        let contacts = contacts(object, shape, &lower_ends, &middles);
        let centred = shape.off_centre < OFF_CENTRE.0;
        let seen = |k: usize| {
            let pose = shape.frames[k].view_from_object;
            let turned = pose.map_or(DMat3::ZERO, |pose| DMat3::from_quat(pose.rotation));
            let known = match (pose, outlines[k]) {
                (Some(_), _) if shape.rigid => Some(ALONG.0),
                (_, Some(_)) => Some(outline_deviation),
                (Some(_), None) => Some(ALONG.1),
                (None, None) => None,
            };
            let off_centre = turned * (radius * shape.off_centre);
            let structured = pose.is_some();
            let (depth, middle) = (depths[k], middles[k]);
            let centre = match centred {
                true => known.map(|_| Centre { pixel: middle, structured }),
                false => outlines[k].map(|o| Centre { pixel: o.middle, structured: false }),
            };
            Seen { depth, middle, centre, structured, known, radius, off_centre }
        };
        let seen: Vec<Seen> = (0..depths.len()).map(seen).collect();
        let hidden =
            |(owners, behind): (&Vec<Option<u16>>, &Behind<'_>)| hidden(index, owners, *behind);
        let hidden = owners.iter().zip(behind).map(hidden).collect();
        Observed { first: object.first, seen, steps, lower_ends, contacts, hidden }
    }

    /// The path of the object's centre, in the frames in which it is known.
    pub fn path(&self) -> ballistic::Path {
        let mut before = None;
        let known =
            self.seen.iter().enumerate().filter_map(|(k, seen)| Some((k, seen, seen.centre?)));
        let middles = known
            .map(|(k, &Seen { depth, .. }, Centre { pixel, structured })| {
                let since = before.replace(k).unwrap_or(k);
                let drift = self.steps[since..k].iter().map(|step| step * step).sum::<f64>().sqrt();
                Middle { frame: self.first + k, pixel, structured, depth, drift }
            })
            .collect();
        ballistic::Path { frames: self.first..self.first + self.seen.len(), middles }
    }

    /// Estimates the distance without regard to connected objects. `flight` is the object's, if it flies.
    pub fn distance(&self, cameras: &Cameras, flight: Option<&Flight>) -> Distance {
        let observed: Vec<f64> = self.seen.iter().map(|seen| seen.depth).collect();
        let touching = touched(&observed, &self.contacts, &self.lower_ends, &self.steps)
            .map(|(_, touching)| touching);
        let agrees = |smooth: &Smoothness| touching.is_none_or(|t| smooth.scale.agrees_with(t));
        let flown = flight.map(|flight| self.flown(flight)).filter(agrees);
        let smoothed = flown.or_else(|| smoothness(&self.seen, cameras, self.first, touching));
        let smooth = smoothed.as_ref().map(|s| s.scale);
        let path: Vec<f64> = match smoothed.map(|smoothed| smoothed.farther) {
            Some(farther) => observed.iter().zip(farther).map(|(path, by)| path + by).collect(),
            None => observed.clone(),
        };
        if let Some((bent, touching)) =
            touched(&path, &self.contacts, &self.lower_ends, &self.steps)
        {
            let both = smooth.map_or(touching, |smooth| touching.and(smooth));
            let scale = Estimate { value: both.value - touching.value, ..both };
            return Distance { path: bent, scale: Scale::Known(scale) };
        }
        let bounded = bounded(&path, &self.hidden, &self.lower_ends);
        let is_behind =
            |smooth: Estimate| smooth.value - smooth.deviation >= bounded.usual + BEFORE.1;
        if smooth.is_some_and(is_behind) {
            // A scale that puts the path far behind what the object hides is wrong, and so are the corrections
            // of the path that come with it.
            let before = self::bounded(&observed, &self.hidden, &self.lower_ends).before;
            return Distance { path: observed, scale: Scale::Bounded { before, smooth: None } };
        }
        Distance { path, scale: Scale::Bounded { before: bounded.before, smooth } }
    }

    /// What a flight tells of the path. Before and after it the path goes on as observed. The depth of an object
    /// without a structure is that of the surface that is seen, which is in front of the centre that flies.
    fn flown(&self, flight: &Flight) -> Smoothness {
        let off = |frame: usize| {
            let frame = frame.clamp(flight.frames.start, flight.frames.end - 1);
            let Seen { depth, structured, radius, .. } = self.seen[frame - self.first];
            let before = if structured { 0.0 } else { (SURFACE * radius / depth.exp()).min(0.5) };
            flight.depths[frame - flight.frames.start].ln() + (-before).ln_1p() - depth
        };
        let value = quantile(flight.frames.clone().map(off).collect(), 0.5);
        let farther = (0..self.seen.len()).map(|k| off(self.first + k) - value).collect();
        Smoothness { scale: Estimate { value, deviation: flight.deviation }, farther }
    }
}

/// The logarithm of the depth of what an object hides in a frame, at its near side. `None` if the object is
/// absent.
fn hidden(index: usize, owners: &[Option<u16>], behind: Behind<'_>) -> Option<f64> {
    let own = owners.iter().zip(behind.inverse);
    let hidden: Vec<f64> = own
        .filter(|(owner, _)| **owner == Some(index as u16))
        .map(|(_, inverse)| f64::from(*inverse))
        .collect();
    (!hidden.is_empty()).then(|| -quantile(hidden, 0.8).max(1e-3).ln())
}

/// The scale of a path without contact, from what the object hides.
struct Bounded {
    /// The estimate.
    before: Estimate,
    /// The scale with which the object is as deep as what it hides, in the usual frame.
    usual: f64,
}

/// The scale of a path whose object is nearer than what it hides (`hidden`, logarithm) in nearly every frame.
fn bounded(path: &[f64], hidden: &[Option<f64>], lower_ends: &[Option<LowerEnd>]) -> Bounded {
    let bounds: Vec<f64> =
        hidden.iter().zip(path).filter_map(|(hidden, depth)| Some((*hidden)? - depth)).collect();
    let usual = quantile(bounds.clone(), 0.5);
    let bound = quantile(bounds, 0.1);
    let cut_off: Vec<f64> = lower_ends
        .iter()
        .zip(path)
        .filter_map(|(end, path)| match end {
            Some(LowerEnd::CutOff(ground)) => Some(ground.ln() - path),
            _ => None,
        })
        .collect();
    let below = match 2 * cut_off.len() > path.len() {
        true => quantile(cut_off, 0.1),
        false => f64::INFINITY,
    };
    let before = match below - CUT_OFF.0 < bound - BEFORE.0 + BEFORE.1 {
        true => Estimate { value: below - CUT_OFF.0, deviation: CUT_OFF.1 },
        false => Estimate { value: bound - BEFORE.0, deviation: BEFORE.1 },
    };
    Bounded { before, usual }
}

/// Standard deviation of each step of an object's path, logarithm.
fn steps(shape: &Shape) -> Vec<f64> {
    shape.drift.iter().map(|drift| drift.max(LEAST_DRIFT)).collect()
}

/// The pixel of an object's middle, frame by frame. In frames where its structure from motion does not hold,
/// this is the middle of its outline, corrected by the offset between the two middles in the nearest frame
/// that has both.
fn middles(shape: &Shape, outlines: &[Option<Outline>]) -> Vec<DVec2> {
    let n = outlines.len();
    let structured = |k: usize| shape.frames[k].view_from_object.is_some();
    let both: Vec<usize> = (0..n).filter(|k| structured(*k) && outlines[*k].is_some()).collect();
    let place = |k: usize| {
        let middle = shape.frames[k].middle;
        let Some(outline) = outlines[k].filter(|_| !structured(k)) else { return middle };
        let nearest = both.iter().min_by_key(|b| b.abs_diff(k));
        let off = nearest.and_then(|b| Some(shape.frames[*b].middle - outlines[*b]?.middle));
        outline.middle + off.unwrap_or(DVec2::ZERO)
    };
    (0..n).map(place).collect()
}

/// The image of an object's centre: its middle, if that is the centre; otherwise the middle of its outline, which is
/// nearer to it than the middle of the points that are seen, and does not move as these change.
#[derive(Clone, Copy)]
struct Centre {
    pixel: DVec2,
    /// Whether it follows from the object's structure.
    structured: bool,
}

/// The state of an object in one frame, up to scale.
struct Seen {
    /// Logarithm of the object's depth.
    depth: f64,
    middle: DVec2,
    /// Its centre, if it is known.
    centre: Option<Centre>,
    /// Whether structure from motion holds in the frame.
    structured: bool,
    /// Standard deviation of the depth as a logarithm, in frames where the middle is known.
    known: Option<f64>,
    /// The object's radius, in the unit of its depth.
    radius: f64,
    /// The rotation from the object's frame to the camera frame times the standard deviation of the offset between
    /// the centre of mass and the middle; zero where the rotation is unknown.
    off_centre: DMat3,
}

/// What the smoothness of a path tells.
struct Smoothness {
    /// The scale that makes the path smoothest.
    scale: Estimate,
    /// The change of the logarithm of depth along it, frame by frame, at the scale that follows from the path
    /// and from contact, if it is known from there.
    farther: Vec<f64>,
}

/// The scale and the changes of a path that make it smoothest; `None` if the path does not determine the
/// scale, or if contact contradicts it. `first` is the object's first frame, `touching` the scale from contact.
fn smoothness(
    path: &[Seen],
    cameras: &Cameras,
    first: usize,
    touching: Option<Estimate>,
) -> Option<Smoothness> {
    let touching_inverse = touching.map(|Estimate { value, deviation }| {
        let inverse = (-value).exp();
        Estimate { value: inverse, deviation: deviation * inverse }
    });
    let known: Vec<Option<f64>> = path.iter().map(|seen| seen.known).collect();
    let begins = known.iter().position(Option::is_some)?;
    let ends = known.iter().rposition(Option::is_some)?;
    // An object that enters or leaves the image is seen only in part. If the direction of gravity is known,
    // its path is extrapolated through these frames.
    let goes_on = |k: usize| cameras.ground.is_some() && !(begins..=ends).contains(&k);
    let place = |(k, seen): (usize, &Seen)| {
        let world_from_view = cameras.poses[first + k].inverse();
        let depth = seen.depth.exp();
        let relative = cameras.intrinsics.ray(seen.middle) * depth;
        let rotation = DMat3::from_quat(world_from_view.rotation);
        let pixels = |pixels: f64| pixels * depth / cameras.intrinsics.fx;
        let (across, along) = match seen.known {
            Some(along) => (pixels(MIDDLE.0), along),
            None if goes_on(k) => (seen.radius, 1.0),
            None => (pixels(MIDDLE.1), ALONG.1),
        };
        Place {
            relative: rotation * relative,
            centre: world_from_view.translation,
            across,
            along: along * depth,
            off_centre: rotation * seen.off_centre,
        }
    };
    let places: Vec<Place> = path.iter().enumerate().map(place).collect();
    // A longer gap in which the middle is unknown splits the path into separate paths.
    let unknown = unknown_for(&known);
    let frames: Vec<usize> =
        (0..places.len()).filter(|k| unknown[*k] <= GAP || goes_on(*k)).collect();
    let (mut sum, mut information) = (0.0, 0.0);
    let mut farther = vec![0.0; places.len()];
    for run in frames.chunk_by(|a, b| a + 1 == *b) {
        let run = run[0]..run[0] + run.len();
        let places = &places[run.clone()];
        let Some(found) = smooth::smoothest(places, cameras.up(), touching_inverse) else {
            continue;
        };
        let weight = found.unit.deviation.powi(-2);
        (sum, information) = (sum + weight * found.unit.inverse, information + weight);
        if let Some(by) = found.farther {
            farther[run].copy_from_slice(&by);
        }
    }
    let (inverse, deviation) = (sum / information, information.powf(-0.5));
    let scale = Estimate { value: -inverse.ln(), deviation: deviation / inverse };
    let holds = inverse > 0.0 && scale.deviation < LINEAR;
    let agrees = touching.is_none_or(|touching| scale.agrees_with(touching));
    (holds && agrees).then_some(Smoothness { scale, farther })
}

/// For each frame in which the middle is unknown, the length in frames of the gap that contains it; 0
/// elsewhere.
fn unknown_for(known: &[Option<f64>]) -> Vec<usize> {
    let mut out = vec![0; known.len()];
    let mut start = 0;
    for k in 0..=known.len() {
        if k == known.len() || known[k].is_some() {
            out[start..k].fill(k - start);
            start = k + 1;
        }
    }
    out
}

/// The path corrected by the depths that follow from the outlines' sizes, which are known up to one factor.
fn sized(path: Vec<f64>, sizes: &[Option<f64>], deviation: f64, steps: &[f64]) -> Vec<f64> {
    let off: Vec<f64> = sizes.iter().zip(&path).filter_map(|(s, p)| Some((*s)? - p)).collect();
    if off.len() < 3 {
        return path;
    }
    let unit = quantile(off, 0.5);
    let target = |size: &Option<f64>| Some(Estimate { value: (*size)? - unit, deviation });
    let targets: Vec<Option<Estimate>> = sizes.iter().map(target).collect();
    let pull = Pull { first_width: SIZED_FIRST / deviation, power: 1 };
    bent(&path, &path, &targets, pull, steps)
}

#[cfg(test)]
mod tests {
    use super::super::stereo::Ground;
    use super::*;
    use crate::types::Pose;
    use glam::DQuat;

    #[test]
    fn a_flight_gives_the_depths_and_the_path_goes_on_as_observed() {
        let intrinsics = Intrinsics::centred(300.0, 320, 180);
        let cameras = Cameras::known(intrinsics, vec![Pose::IDENTITY; 12]);
        let seen = |k: usize| Seen {
            depth: 0.1 * k as f64,
            middle: DVec2::ZERO,
            structured: true,
            known: Some(ALONG.0),
            radius: 0.1,
            off_centre: DMat3::ZERO,
            centre: None,
        };
        let observed = Observed {
            first: 2,
            seen: (0..8).map(seen).collect(),
            steps: vec![0.01; 7],
            lower_ends: vec![None; 8],
            contacts: vec![None; 8],
            hidden: vec![Some(3.0); 8],
        };
        let flight =
            |deviation: f64| Flight { frames: 4..7, depths: vec![1.5, 1.6, 1.8], deviation };
        let (depths, confidence) = observed.distance(&cameras, Some(&flight(1e-6))).depths();
        assert_eq!(confidence, KNOWN);
        let expected = |k: usize| match k {
            0..2 => 1.5 * (0.1 * (k as f64 - 2.0)).exp(),
            2..5 => [1.5, 1.6, 1.8][k - 2],
            _ => 1.8 * (0.1 * (k as f64 - 4.0)).exp(),
        };
        for (k, depth) in depths.iter().enumerate() {
            assert!((depth / expected(k) - 1.0).abs() < 1e-6, "{k}: {depth} {}", expected(k));
        }
        // Far behind what it hides, it does not fly.
        let hidden = vec![Some(-1.0); 8];
        let behind = Observed { hidden, ..observed };
        let (depths, confidence) = behind.distance(&cameras, Some(&flight(0.05))).depths();
        assert!(confidence == BOUND && depths[3] < 0.4, "{depths:?}");
    }

    #[test]
    fn gaps_are_as_long_as_the_frames_that_are_not_known() {
        let known = [1, 0, 1, 0, 0, 0, 1, 0].map(|known| (known == 1).then_some(0.1));
        assert_eq!(unknown_for(&known), [0, 1, 0, 3, 3, 3, 0, 1]);
    }

    #[test]
    fn a_fall_tells_the_depth_where_only_a_part_is_seen() {
        // A ball flies towards a hand-held camera that also moves forward and back. In the last four frames
        // only a part of the ball is in the image, so its observed depth is wrong by 20 %.
        let intrinsics = Intrinsics::centred(400.0, 640, 480);
        let wave = |t: f64, k: f64, phase: f64| (k * t + phase).sin();
        let centre = |t: f64| {
            let shake = DVec3::new(wave(t, 0.9, 0.3), wave(t, 1.3, 1.0), wave(t, 0.7, 2.0));
            DVec3::new(0.02 * t, 0.0, 0.0) + 0.04 * shake
        };
        let ball = |t: f64| DVec3::new(0.03 * t, 0.004 * (t - 12.0).powi(2), 5.0 - 0.08 * t);
        let unit = 2.0;
        let poses = (0..28).map(|t| Pose::new(DQuat::IDENTITY, -centre(f64::from(t)))).collect();
        let mut cameras = Cameras::known(intrinsics, poses);
        let depth = |t: usize| (ball(t as f64) - centre(t as f64)).z;
        let seen: Vec<Seen> = (0..28)
            .map(|t| {
                let at = ball(t as f64) - centre(t as f64);
                let part = t >= 24;
                let middle = intrinsics.project(at);
                Seen {
                    depth: (unit * at.z * if part { 1.2 } else { 1.0 }).ln(),
                    middle: middle + if part { DVec2::new(4.0, 0.0) } else { DVec2::ZERO },
                    structured: true,
                    known: (!part).then_some(ALONG.0),
                    radius: 0.2 * unit,
                    off_centre: DMat3::ZERO,
                    centre: None,
                }
            })
            .collect();
        let error = |cameras: &Cameras| -> f64 {
            let Smoothness { scale, farther, .. } = smoothness(&seen, cameras, 0, None).unwrap();
            let found = |t: usize| seen[t].depth + farther[t] + scale.value;
            (24..28).map(|t| (found(t) - depth(t).ln()).abs()).fold(0.0, f64::max)
        };
        let without = error(&cameras);
        cameras.ground = Some(Ground::known(DVec3::NEG_Y, -2.0));
        let with = error(&cameras);
        assert!(with < 0.03 && without > 0.1, "{with} {without}");
        // It does not count against a contact that it contradicts.
        let beside = |contact: f64| {
            let contact = Estimate { value: contact - unit.ln(), deviation: 0.03 };
            smoothness(&seen, &cameras, 0, Some(contact))
        };
        assert!(beside(0.0).is_some() && beside(0.3).is_none());
    }

    #[test]
    fn a_drifting_path_keeps_the_size() {
        // The path drifts by 0.25 in the 5 steps with a large deviation; the outlines' sizes are noisy, and
        // one is wrong.
        let truth = |k: usize| 0.02 * k as f64;
        let drift = |k: usize| 0.05 * k.clamp(8, 13) as f64;
        let path: Vec<f64> = (0..20).map(|k| truth(k) + drift(k)).collect();
        let sizes: Vec<Option<f64>> = (0..20)
            .map(|k| match k {
                3 | 7 => None,
                12 => Some(truth(k) - 0.7),
                _ => Some(2.0 + truth(k) + 0.04 * (2.1 * k as f64).sin()),
            })
            .collect();
        let steps: Vec<f64> =
            (0..19).map(|k| if (8..13).contains(&k) { 0.06 } else { 0.005 }).collect();
        let found = sized(path.clone(), &sizes, 0.1, &steps);
        let change = |p: &[f64]| (p[19] - p[0] - truth(19)).abs();
        assert!(change(&path) > 0.24 && change(&found) < 0.06, "{}", change(&found));
        // Without outlines the path does not change. A path without drift is not changed by the noise of the
        // outlines.
        assert_eq!(sized(path.clone(), &[None; 20], 0.1, &steps), path);
        let steady: Vec<f64> = (0..20).map(truth).collect();
        let found = sized(steady.clone(), &sizes, 0.1, &[0.002; 19]);
        assert!(change(&found) < 0.02, "{}", change(&found));
    }

    #[test]
    fn what_is_connected_with_another_is_about_as_far() {
        let bounded = |value: f64, smooth: Option<f64>| {
            let smooth = smooth.map(|value| Estimate { value, deviation: 0.01 });
            let before = Estimate { value, deviation: 0.3 };
            let path = vec![0.1, 0.2, 0.3];
            Distance { path, scale: Scale::Bounded { before, smooth } }
        };
        let known = bounded(1.0, Some(1.5));
        assert!(known.is_known() && !bounded(1.0, None).is_known());
        // The object's second frame is the other object's first.
        let mut own = bounded(-2.0, None);
        own.depend_on(4, (&known, 5));
        assert!(own.is_known());
        let (depths, (there, _)) = (own.depths().0, known.depths());
        assert!((depths[1] / there[0]).ln().abs() < 0.11 && depths[1] < there[1], "{depths:?}");
        // A bounded object does not make another one known; an object never seen at the same time has no
        // effect.
        let mut own = bounded(-2.0, None);
        own.depend_on(4, (&bounded(1.0, None), 5));
        assert!(!own.is_known() && own.depths().0[0] > 2.0);
        let mut own = bounded(-2.0, None);
        own.depend_on(4, (&known, 9));
        assert_eq!(own.depths(), bounded(-2.0, None).depths());
    }
}
