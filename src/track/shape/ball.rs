//! Structure of a ball: its centres from its contours, its rotation from its images.
//!
//! An object whose contour is a circle in nearly all frames is a ball. The circles give the position of its centre
//! in radii ([`super::super::disc`]), and each pixel shows the point where its ray meets the sphere. Only the rotation
//! is left to be found: tracks from frame to frame give its start, and the images themselves the rest, since a rotation
//! must carry what one frame shows to what its neighbours show. So a ball that spins fast, or whose pattern is
//! plain along its stripes, has a structure where tracks alone give none.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::super::cameras::Cameras;
use super::super::disc::Disc;
use super::super::objects::Object;
use super::super::outline::Outlines;
use super::super::{pixel_gradients, quantile};
use super::Frame;
use super::joined::Piece;
use crate::geometry::se3::exp_so3;
use crate::observe::PointTrack;
use crate::observe::luminance::Luminance;
use crate::types::{Image, Intrinsics, Pose};

/// Minimum number of frames, and the minimum share of the discs that are round.
const LEAST: (usize, f64) = (8, 0.8);
/// Maximum number of consecutive frames without a disc within the structure.
const GAP: usize = 2;
/// Minimum number of tracks from a frame to the next that give the start of the rotation.
const LEAST_TRACKS: usize = 6;
/// Width of the robust kernel of these tracks, pixels.
const WIDTH: f64 = 1.0;
/// Minimum number of pixels that two frames share.
const LEAST_PIXELS: usize = 30;
/// The frames before and after whose images a frame's rotation is fitted to.
const NEIGHBOURS: usize = 3;
/// Minimum cosine of the angle between the line of sight and the surface, in both frames.
const FACING: f64 = 0.35;
/// Rounds of the rotation from a frame to the next by tracks.
const ROUNDS: usize = 10;
/// Approximate number of pixels along the ball's radius that are compared.
const FINE: f64 = 30.0;
/// Width of the image around the ball that is kept, pixels.
const MARGIN: f64 = 4.0;
/// Number of passes over all frames, and of steps for each.
const PASSES: (usize, usize) = (4, 6);
/// Width of the robust kernel of intensities, in units of their range.
const CONTRAST: f64 = 0.1;
/// Minimum share of the variance of a frame's intensities that the frame before explains, in the median.
const EXPLAINED: f64 = 0.7;
/// Maximum distance of a track from its point, pixels at a width of 320.
const BESIDE: f64 = 2.0;
/// Standard deviation of the change of its depth from frame to frame, logarithm.
const DRIFT: f64 = 0.005;

/// A ball of radius one in one frame.
#[derive(Clone, Copy)]
struct Sight {
    /// Its centre in the camera frame.
    centre: DVec3,
    /// `view_from_ball`.
    rotation: DQuat,
}

/// The structure of an object that is a ball, in the longest run of its frames that show enough of its contour;
/// `None` if it is none, or if no rotation explains its images. The unit is the ball's radius. `frames` are the
/// object's.
pub(super) fn ball(
    object: &Object,
    frames: &[Image],
    outlines: &Outlines,
    cameras: &Cameras,
) -> Option<Piece> {
    let intrinsics = &cameras.intrinsics;
    let discs = || outlines.discs.iter().flatten();
    let round = discs().filter(|disc| disc.round).count();
    if round < LEAST.0 || (round as f64) < LEAST.1 * discs().count() as f64 {
        return None;
    }
    let run = longest(&outlines.discs);
    if run.len() < LEAST.0 {
        return None;
    }
    let first = object.first + run.start;
    let mut sights = centres(&outlines.discs[run.clone()]);
    for k in 1..sights.len() {
        let pairs = pairs(&object.tracks, first + k, &sights[k - 1..=k], intrinsics);
        let step = turn(&pairs, WIDTH * sights[k].centre.z / intrinsics.fx);
        let before = if k > 1 {
            sights[k - 1].rotation * sights[k - 2].rotation.conjugate()
        } else {
            DQuat::IDENTITY
        };
        sights[k].rotation = step.unwrap_or(before) * sights[k - 1].rotation;
    }
    let views: Vec<View> = frames[run.clone()]
        .iter()
        .zip(&sights)
        .map(|(frame, sight)| View::of(frame, sight, intrinsics))
        .collect::<Option<_>>()?;
    let explained = turned_by_images(&mut sights, &views, intrinsics);
    if explained < EXPLAINED {
        return None;
    }
    let size = (f64::from(intrinsics.width) / 320.0).max(1.0);
    let points: Vec<Option<DVec3>> =
        object.tracks.iter().map(|track| point(track, first, &sights, intrinsics)).collect();
    let frame = |k: usize| {
        let sight = &sights[k];
        let relative = |(track, point): (&PointTrack, &Option<DVec3>)| {
            let at = sight.place((*point)?);
            let off = intrinsics.project(at).distance(track.at(first + k)?);
            (off < BESIDE * size).then_some(at.z / sight.centre.z)
        };
        Frame {
            depth: sight.centre.z,
            middle: intrinsics.project(sight.centre),
            relative: object.tracks.iter().zip(&points).map(relative).collect(),
            view_from_object: Some(Pose::new(sight.rotation, sight.centre)),
        }
    };
    let frames = (0..sights.len()).map(frame).collect();
    Some(Piece { run, middle: DVec3::ZERO, points, frames, drift: DRIFT })
}

/// The longest run of frames without a longer gap between discs.
fn longest(discs: &[Option<Disc>]) -> Range<usize> {
    let known: Vec<usize> = (0..discs.len()).filter(|k| discs[*k].is_some()).collect();
    let runs = known.chunk_by(|a, b| b - a <= GAP + 1).map(|run| run[0]..run[run.len() - 1] + 1);
    runs.max_by_key(Range::len).unwrap_or(0..0)
}

/// The ball before its rotation is known. Without a disc its centre is between those of the frames beside.
fn centres(discs: &[Option<Disc>]) -> Vec<Sight> {
    let known = |k: &usize| discs[*k].is_some();
    let centre = |k: usize| {
        let before = (0..=k).rev().find(known).unwrap_or(k);
        let after = (k..discs.len()).find(known).unwrap_or(k);
        let at = |k: usize| discs[k].map_or(DVec3::Z, |disc| disc.centre);
        let part = (k - before) as f64 / (after - before).max(1) as f64;
        at(before).lerp(at(after), part)
    };
    (0..discs.len()).map(|k| Sight { centre: centre(k), rotation: DQuat::IDENTITY }).collect()
}

/// The colours around the ball in a frame, as smooth surfaces.
struct View {
    /// Pixel of the upper left corner.
    corner: DVec2,
    channels: [Luminance; 3],
}

impl View {
    /// `None` if the ball is not in the image.
    fn of(image: &Image, sight: &Sight, intrinsics: &Intrinsics) -> Option<View> {
        let (middle, half) = (intrinsics.project(sight.centre), sight.radius(intrinsics) + MARGIN);
        let size = DVec2::new(f64::from(image.width), f64::from(image.height));
        let corner = (middle - half).floor().clamp(DVec2::ZERO, size);
        let end = (middle + half).ceil().clamp(corner, size);
        let (width, height) = ((end.x - corner.x) as u32, (end.y - corner.y) as u32);
        if width == 0 || height == 0 {
            return None;
        }
        let (left, top) = (corner.x as u32, corner.y as u32);
        let channel = |c: usize| {
            let c = c.min(image.channels as usize - 1);
            let row = |y: u32| (left..left + width).map(move |x| image.at(x, y)[c]);
            let pixels = (top..top + height).flat_map(row).collect();
            Luminance::of(&Image { width, height, channels: 1, pixels })
        };
        Some(View { corner, channels: [channel(0), channel(1), channel(2)] })
    }

    /// Colour and gradients (per pixel) at a pixel; `None` outside of the image.
    fn at(&self, pixel: DVec2) -> Option<[(f64, DVec2); 3]> {
        let [r, g, b] = self.channels.each_ref().map(|c| c.sample(pixel - self.corner));
        Some([r?, g?, b?])
    }
}

/// Turns the ball in each frame to what the frames beside it show. Returns the share of the variance of a frame's
/// intensities that the frame before explains, in the median.
fn turned_by_images(sights: &mut [Sight], views: &[View], intrinsics: &Intrinsics) -> f64 {
    let shown: Vec<Vec<Shown>> =
        sights.iter().zip(views).map(|(sight, view)| sight.shown(view, intrinsics)).collect();
    for pass in 0..PASSES.0 {
        for k in 1..sights.len() {
            let start = k.saturating_sub(if pass == 0 { 1 } else { NEIGHBOURS });
            // In the first pass the frames after it are not yet turned.
            let end = if pass == 0 { k } else { (k + NEIGHBOURS + 1).min(sights.len()) };
            for _ in 0..PASSES.1 {
                let (mut information, mut right) = (DMat3::IDENTITY * 1e-9, DVec3::ZERO);
                for other in (start..end).filter(|other| *other != k) {
                    let pair = (&sights[k], &sights[other]);
                    let (a, b, _) = carried(&shown[k], pair, &views[other], intrinsics);
                    (information, right) = (information + a, right + b);
                }
                let step = information.inverse() * right;
                sights[k].rotation = (exp_so3(step) * sights[k].rotation).normalize();
            }
        }
    }
    let explained =
        |k: usize| carried(&shown[k], (&sights[k], &sights[k - 1]), &views[k - 1], intrinsics).2;
    quantile((1..sights.len()).map(explained).collect(), 0.5)
}

/// A pixel of the ball: the direction from its centre in the camera frame, and the colour.
struct Shown {
    direction: DVec3,
    colour: [f64; 3],
}

/// The normal equations of a small rotation of the first ball in its camera frame, so that the second one's image shows
/// what the first one shows, and the share of the variance of the first image that the second explains.
fn carried(
    shown: &[Shown],
    (own, other): (&Sight, &Sight),
    view: &View,
    intrinsics: &Intrinsics,
) -> (DMat3, DVec3, f64) {
    let other_from_own = DMat3::from_quat(other.rotation * own.rotation.conjugate());
    let own_from_other = other_from_own.transpose();
    let mut rows: Vec<([f64; 3], [f64; 3], [DVec3; 3])> = Vec::new();
    for Shown { direction, colour } in shown {
        let arm = other_from_own * *direction;
        let at = other.centre + arm;
        if -arm.dot(at) < FACING * at.length() {
            continue;
        }
        let Some(there) = view.at(intrinsics.project(at)) else { continue };
        let [x, y] = pixel_gradients(intrinsics, at).map(|gradient| own_from_other * gradient);
        // Turning the first ball by ω moves the direction n in the second one's frame by −A (ω × n).
        let slope = there.map(|(_, slope)| (x * slope.x + y * slope.y).cross(*direction));
        rows.push((*colour, there.map(|(colour, _)| colour), slope));
    }
    let (mut information, mut right, mut left, mut all) = (DMat3::ZERO, DVec3::ZERO, 0.0, 0.0);
    if rows.len() < LEAST_PIXELS {
        return (information, right, 0.0);
    }
    for c in 0..3 {
        // The light on the ball may change as a whole.
        let brighter = quantile(rows.iter().map(|(a, b, _)| a[c] - b[c]).collect(), 0.5);
        let mean = rows.iter().map(|(a, _, _)| a[c]).sum::<f64>() / rows.len() as f64;
        for (a, b, slope) in &rows {
            let off = a[c] - b[c] - brighter;
            let weight = (1.0 + (off / CONTRAST).powi(2)).recip();
            let slope = slope[c];
            information +=
                DMat3::from_cols(slope * slope.x, slope * slope.y, slope * slope.z) * weight;
            right += slope * (off * weight);
            left += off.abs().min(CONTRAST).powi(2);
            all += (a[c] - mean).powi(2);
        }
    }
    (information, right, 1.0 - left / all.max(1e-12))
}

/// The directions from the ball's centre to the points that both of two consecutive frames see, in the camera
/// frames, and their weights. `frame` is the second one's.
fn pairs(
    tracks: &[PointTrack],
    frame: usize,
    sights: &[Sight],
    intrinsics: &Intrinsics,
) -> Vec<(DVec3, DVec3, f64)> {
    let pair = |track: &PointTrack| {
        let (before, after) = (track.at(frame - 1)?, track.at(frame)?);
        let (a, b) = (sights[0].met(before, intrinsics), sights[1].met(after, intrinsics));
        Some((a.0, b.0, (a.1 * b.1).powi(2)))
    };
    tracks.iter().filter_map(pair).collect()
}

/// The rotation that maps the first direction of each pair to the second; `None` if there are too few. `width` is
/// that of the robust kernel.
fn turn(pairs: &[(DVec3, DVec3, f64)], width: f64) -> Option<DQuat> {
    if pairs.len() < LEAST_TRACKS {
        return None;
    }
    let mut rotation = DQuat::IDENTITY;
    for round in 0..ROUNDS {
        let width = width * f64::max(1.0, 16.0 * 0.5f64.powi(round as i32));
        let (mut information, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (from, to, weight) in pairs {
            let turned = rotation * *from;
            let weight = weight / (1.0 + (turned.distance(*to) / width).powi(2));
            let outer = DMat3::from_cols(turned * turned.x, turned * turned.y, turned * turned.z);
            information += (DMat3::IDENTITY - outer) * weight;
            right += turned.cross(*to) * weight;
        }
        information += DMat3::IDENTITY * 1e-12;
        rotation = exp_so3(information.inverse() * right) * rotation;
    }
    rotation.is_finite().then_some(rotation)
}

/// The point of a track on the sphere, in the ball's frame; `None` if it was never seen away from the limb.
fn point(
    track: &PointTrack,
    first: usize,
    sights: &[Sight],
    intrinsics: &Intrinsics,
) -> Option<DVec3> {
    let seen = |(k, sight): (usize, &Sight)| {
        let (direction, facing) = sight.met(track.at(first + k)?, intrinsics);
        Some(sight.rotation.conjugate() * direction * facing.powi(2))
    };
    let sum: DVec3 = sights.iter().enumerate().filter_map(seen).sum();
    (sum.length() > 1e-3).then(|| sum.normalize())
}

impl Sight {
    /// The direction from the centre to the point where a pixel's ray meets the sphere, in the camera frame, and
    /// the cosine of its angle to the ray. A ray that misses the sphere gets the nearest point and zero.
    fn met(&self, pixel: DVec2, intrinsics: &Intrinsics) -> (DVec3, f64) {
        let ray = intrinsics.ray(pixel).normalize();
        let along = ray.dot(self.centre);
        let inside = along * along - self.centre.length_squared() + 1.0;
        let direction = (ray * (along - inside.max(0.0).sqrt()) - self.centre).normalize();
        (direction, if inside > 0.0 { -direction.dot(ray) } else { 0.0 })
    }

    /// A point of the ball in the camera frame.
    fn place(&self, point: DVec3) -> DVec3 {
        self.centre + self.rotation * point
    }

    /// The radius in the image, pixels; the ball is seen larger beside the middle of the image.
    fn radius(&self, intrinsics: &Intrinsics) -> f64 {
        let widening = self.centre.length() / self.centre.z;
        widening.powi(2) * intrinsics.fx / (self.centre.length_squared() - 1.0).max(0.1).sqrt()
    }

    /// Pixels of the ball that face the camera.
    fn shown(&self, view: &View, intrinsics: &Intrinsics) -> Vec<Shown> {
        let (middle, radius) = (intrinsics.project(self.centre), self.radius(intrinsics));
        let step = (radius / FINE).max(1.0);
        let steps = (radius / step).ceil() as i32;
        let mut out = Vec::new();
        for y in -steps..=steps {
            for x in -steps..=steps {
                let pixel = middle + step * DVec2::new(f64::from(x), f64::from(y));
                let (direction, facing) = self.met(pixel, intrinsics);
                let colour = view.at(pixel).filter(|_| facing > FACING);
                let shown = colour.map(|c| Shown { direction, colour: c.map(|(c, _)| c) });
                out.extend(shown);
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAMES: usize = 16;
    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 300.0, fy: 300.0, cx: 160.0, cy: 90.0, width: 320, height: 180 };

    /// The pose of a ball of radius .3 that flies past and spins by .25 radians per frame.
    fn pose(k: usize) -> Pose {
        let t = k as f64;
        let axis = DVec3::new(0.3, 1.0, 0.2).normalize();
        let centre = DVec3::new(0.05 * t - 0.4, 0.2 - 0.03 * t, 3.0 - 0.03 * t);
        Pose::new(DQuat::from_axis_angle(axis, 0.25 * t), centre)
    }

    /// The frames, the object and its discs. `colour` is that of a direction in the ball's frame, in a frame. Tracks
    /// fall short of the ball's rotation by a tenth.
    fn flight(colour: impl Fn(usize, DVec3) -> f64) -> (Vec<Image>, Object, Outlines) {
        let sight = |k: usize| {
            let Pose { rotation, translation } = pose(k);
            Sight { centre: translation / 0.3, rotation }
        };
        let image = |k: usize| {
            let sight = sight(k);
            let pixel = |i: usize| {
                let pixel = DVec2::new((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5);
                let (direction, facing) = sight.met(pixel, &INTRINSICS);
                let red = match facing > 0.0 {
                    true => colour(k, sight.rotation.conjugate() * direction) as f32,
                    false => 0.4,
                };
                [red, 0.5 * red, 0.3]
            };
            let pixels = (0..320 * 180).flat_map(pixel).collect();
            Image { width: 320, height: 180, channels: 3, pixels }
        };
        let track = |i: usize| {
            let (first, place) = (i % 12, (i / 12) as f64);
            let start = sight(first);
            let off = DVec2::from_angle(2.4 * place) * (3.0 + 1.2 * place);
            let (direction, _) = start.met(INTRINSICS.project(start.centre) + off, &INTRINSICS);
            let at = |k: usize| {
                let turned = (0.9 * 0.25 * k as f64, DVec3::new(0.3, 1.0, 0.2).normalize());
                let direction = DQuat::from_axis_angle(turned.1, turned.0) * direction;
                INTRINSICS.project(sight(first + k).centre + direction)
            };
            PointTrack::followed(first, (0..4).map(at).collect(), vec![0.1; 4])
        };
        let disc = |k: usize| {
            let off = 0.004 * DVec3::new((2.1 * k as f64).sin(), (3.7 * k as f64).cos(), 0.0);
            // In one frame too little of it is seen.
            (k != 7).then_some(Disc { centre: sight(k).centre + off, round: true })
        };
        let tracks = (0..144).map(track).collect();
        let object = Object { tracks, first: 0, end: FRAMES };
        let outlines =
            Outlines { discs: (0..FRAMES).map(disc).collect(), ..Outlines::unknown(FRAMES) };
        ((0..FRAMES).map(image).collect(), object, outlines)
    }

    fn cameras() -> Cameras {
        Cameras::known(INTRINSICS, vec![Pose::IDENTITY; FRAMES])
    }

    /// Spots all over a ball.
    fn spots(_: usize, at: DVec3) -> f64 {
        0.5 + 0.2 * (7.0 * at.x).sin() * (6.0 * at.y + 1.0).cos() + 0.2 * (8.0 * at.z).sin()
    }

    #[test]
    fn the_images_of_a_ball_show_its_rotation() {
        let (frames, object, outlines) = flight(spots);
        let found = ball(&object, &frames, &outlines, &cameras()).unwrap();
        assert_eq!(found.run, 0..FRAMES);
        let view = |k: usize| found.frames[k].view_from_object.unwrap();
        for k in 0..FRAMES - 1 {
            let step = view(k + 1).rotation * view(k).rotation.conjugate();
            let truth = pose(k + 1).rotation * pose(k).rotation.conjugate();
            assert!(step.angle_between(truth) < 0.02, "{k}: {}", step.angle_between(truth));
        }
        for k in 0..FRAMES {
            let ratio = view(k).translation.z * 0.3 / pose(k).translation.z;
            assert!((ratio - 1.0).abs() < 0.01, "{k}: {ratio}");
        }
        let relative = found.frames[5].relative.iter().flatten();
        assert!(relative.clone().count() > 20 && relative.clone().all(|r| *r < 1.0));
    }

    #[test]
    fn what_is_no_ball_has_no_such_structure() {
        let (frames, object, mut outlines) = flight(spots);
        // Contours that are no circles.
        for disc in outlines.discs.iter_mut().step_by(3).flatten() {
            disc.round = false;
        }
        assert!(ball(&object, &frames, &outlines, &cameras()).is_none());
        // A ball of which hardly a contour is seen.
        let (_, _, mut outlines) = flight(spots);
        outlines.discs[6..].fill(None);
        assert!(ball(&object, &frames, &outlines, &cameras()).is_none());
        // A surface that boils: no rotation carries a frame to the next.
        let (frames, object, outlines) = flight(|k, at| spots(0, at + 3.7 * k as f64));
        assert!(ball(&object, &frames, &outlines, &cameras()).is_none());
    }
}
