//! Unseen sides (flanks) of movers: a guess at what lies behind a mover's outline.
//!
//! A frame shows the front of an object. From an offset camera its side comes into view, which no frame
//! may ever show: the roof of a car that is filmed from the pavement. An object is assumed to be two
//! thirds as thick as it is wide at that place, and its side continues behind the outline along the line
//! of sight, in the colour just inside the outline. The thickness is reduced by what the front already
//! shows by bulging, on both sides of the outline. Where the side would project over static pixels in
//! frames in which the outline itself does not, the side ends.

use super::mesh::{STILL, surface};
use crate::track::Track;
use crate::types::Image;
use glam::{DVec2, DVec3, IVec2};
use rayon::prelude::*;
use std::collections::VecDeque;
use std::f32::consts::SQRT_2;

/// Thickness of an object, in units of its width.
const THICK: f64 = 0.65;
/// Distance inside the outline of the pixel that gives the colour, pixels; nearer pixels are mixed with
/// the background.
const WITHIN: f32 = 2.0;
/// Number of frames, spread over the clip, that are checked for whether a side exists.
const WITNESSES: usize = 16;
/// Number of depths along a side at which it is checked.
const STEPS: u32 = 6;
/// Accuracy of a mask, pixels.
const MASK_ERROR: usize = 2;
/// A place does not belong to the mover if it is off the mask in this many frames, and in more than this
/// share of those that would show it. Single masks may be wrong.
const BARE: (usize, f64) = (2, 0.1);

/// The unseen side behind a pixel of an object's outline.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flank {
    /// Its extent in depth (z) behind the outline, in the unit of the depth.
    pub depth: f64,
    /// RGB.
    pub colour: [f32; 3],
    /// The direction in the image that it faces.
    outwards: DVec2,
}

/// A point on an unseen side.
pub(super) struct FlankPoint {
    pub pixel: DVec2,
    /// Its depth (z) in the frame's camera.
    pub depth: f64,
    pub colour: [f32; 3],
    /// The side's unit normal, in the camera frame.
    pub normal: DVec3,
}

/// The unseen sides behind the pixels of each frame, row by row; `None` except for pixels of outlines.
pub(super) fn flanks(track: &Track, frames: &[Image]) -> Vec<Vec<Option<Flank>>> {
    let witnesses = Witnesses::of(track);
    let of_frame = |(frame, image): (usize, &Image)| {
        let (mask, owners) = (&track.masks[frame], &track.owners[frame]);
        let surfaces: Vec<u32> =
            mask.pixels.iter().zip(&owners.pixels).map(|(m, owner)| surface(*m, *owner)).collect();
        let mut flanks = behind(&surfaces, &track.depth[frame], image, track.intrinsics.fx);
        for (i, flank) in flanks.iter_mut().enumerate() {
            if let Some(flank) = flank {
                flank.depth = witnesses.there(frame, i, flank.depth);
            }
        }
        flanks
    };
    frames.par_iter().enumerate().map(of_frame).collect()
}

/// Points on a frame's unseen sides, `spacing` pixels apart.
pub(super) fn points(
    track: &Track,
    frame: usize,
    flanks: &[Option<Flank>],
    spacing: f64,
) -> Vec<FlankPoint> {
    let depth = &track.depth[frame];
    let mut points = Vec::new();
    for (i, flank) in flanks.iter().enumerate() {
        let Some(Flank { depth: reach, colour, outwards }) = *flank else { continue };
        let pixel = middle_of(i, depth.width);
        let ray = track.intrinsics.ray(pixel);
        let z = f64::from(depth.pixels[i]);
        let across = outwards.extend(0.0);
        let normal = (across - ray * ray.dot(across) / ray.length_squared()).normalize();
        let step = spacing * z / track.intrinsics.fx;
        let places = (1..).map(|k| f64::from(k) * step).take_while(|far| *far <= reach);
        points.extend(places.map(|far| FlankPoint { pixel, depth: z + far, colour, normal }));
    }
    points
}

/// The unseen sides of a frame as estimated from that frame alone.
fn behind(surfaces: &[u32], depth: &Image, image: &Image, fx: f64) -> Vec<Option<Flank>> {
    let size = IVec2::new(depth.width as i32, depth.height as i32);
    if surfaces.iter().all(|surface| *surface == STILL) {
        return vec![None; surfaces.len()];
    }
    let distance = distances(surfaces, size);
    let middle = middles(surfaces, &distance, size);
    let flank = |i: usize| {
        let z = f64::from(depth.pixels[i]);
        if surfaces[i] == STILL || z <= 0.0 {
            return None;
        }
        let here = pixel(i, size);
        let hides = |across: &IVec2| {
            let next = index(here + *across, size);
            next.is_some_and(|j| surfaces[j] != surfaces[i] && f64::from(depth.pixels[j]) > z)
        };
        let sides = [(1, 0), (-1, 0), (0, 1), (0, -1)].map(IVec2::from);
        let outwards: IVec2 = sides.into_iter().filter(hides).sum();
        let outwards = outwards.as_dvec2().try_normalize()?;
        let width = 2.0 * f64::from(distance[middle[i]]) * z / fx;
        let shown = (z - f64::from(depth.pixels[middle[i]])).max(0.0);
        let inwards = (pixel(middle[i], size) - here).as_vec2();
        let within = here + inwards.clamp_length_max(WITHIN).round().as_ivec2();
        let colour = image.at(within.x as u32, within.y as u32);
        let colour = [colour[0], colour[1], colour[2]];
        Some(Flank { depth: (THICK * width - 2.0 * shown).max(0.0), colour, outwards })
    };
    (0..surfaces.len()).map(flank).collect()
}

/// The frames that are checked for whether sides exist.
struct Witnesses<'a> {
    track: &'a Track,
    witnesses: Vec<Witness>,
}

struct Witness {
    frame: usize,
    /// For each pixel, whether it is within one pixel of a mover (`beside`), and within the accuracy of
    /// masks (`near`).
    beside: Vec<bool>,
    near: Vec<bool>,
}

impl<'a> Witnesses<'a> {
    fn of(track: &'a Track) -> Witnesses<'a> {
        let every = track.masks.len().div_ceil(WITNESSES).max(1);
        let witness = |frame: usize| {
            let mask = &track.masks[frame];
            Witness { frame, beside: mask.near(1), near: mask.near(MASK_ERROR) }
        };
        let frames = (0..track.masks.len()).into_par_iter().step_by(every);
        Witnesses { track, witnesses: frames.map(witness).collect() }
    }

    /// The length of the side behind a frame's pixel that other frames do not contradict, among frames
    /// that show the outline itself on a mover.
    fn there(&self, frame: usize, i: usize, depth: f64) -> f64 {
        let track = self.track;
        let ray = track.intrinsics.ray(middle_of(i, track.depth[frame].width));
        let z = f64::from(track.depth[frame].pixels[i]);
        let world_from_view = track.view_from_world[frame].inverse();
        let owner = track.owners[frame].pixels[i] as usize;
        let at = |behind: f64, other: usize| {
            let point = world_from_view.apply(ray * (z + behind));
            self.seen(track.scaffold.carry(owner, point, frame, other)?.0, other)
        };
        let agrees = |witness: &&Witness| {
            let outline = (witness.frame != frame).then(|| at(0.0, witness.frame)).flatten();
            outline.is_some_and(|(i, _)| witness.beside[i])
        };
        let agreeing: Vec<&Witness> = self.witnesses.iter().filter(agrees).collect();
        let bare = |witness: &&Witness, behind: f64| {
            let (i, hidden) = at(behind, witness.frame)?;
            (witness.near[i] || !hidden).then(|| !witness.near[i])
        };
        let so_far = |step: u32| depth * f64::from(step) / f64::from(STEPS);
        let first_bare = (1..=STEPS).find(|step| {
            let told = agreeing.iter().filter_map(|witness| bare(witness, so_far(*step)));
            let (bare, told) = told.fold((0, 0), |(n, of), bare| (n + usize::from(bare), of + 1));
            bare >= BARE.0 && bare as f64 > BARE.1 * f64::from(told)
        });
        so_far(first_bare.map_or(STEPS, |step| step - 1))
    }

    /// The index of the pixel in which a frame would show a point, and whether a nearer surface hides
    /// the point there.
    fn seen(&self, point: DVec3, frame: usize) -> Option<(usize, bool)> {
        let (intrinsics, depth) = (&self.track.intrinsics, &self.track.depth[frame]);
        let point = self.track.view_from_world[frame].apply(point);
        let at = intrinsics.project(point).floor();
        let size = DVec2::new(depth.width.into(), depth.height.into());
        let inside = point.z > 0.0 && at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all();
        inside.then(|| {
            let i = at.y as usize * depth.width as usize + at.x as usize;
            (i, f64::from(depth.pixels[i]) < point.z)
        })
    }
}

/// The distance of each pixel from the nearest one of another surface, in pixels, along steps to the
/// eight neighbours. Objects are taken to continue over the border of the image.
fn distances(surfaces: &[u32], size: IVec2) -> Vec<f32> {
    const BEFORE: [((i32, i32), f32); 4] =
        [((-1, 0), 1.0), ((-1, -1), SQRT_2), ((0, -1), 1.0), ((1, -1), SQRT_2)];
    let mut distance = vec![f32::INFINITY; surfaces.len()];
    let mut update = |i: usize, sign: i32| {
        for (across, step) in BEFORE {
            let next = index(pixel(i, size) + sign * IVec2::from(across), size);
            let through = |j: usize| if surfaces[j] == surfaces[i] { distance[j] } else { 0.0 };
            if let Some(far) = next.map(|j| through(j) + step) {
                distance[i] = distance[i].min(far);
            }
        }
    };
    (0..surfaces.len()).for_each(|i| update(i, 1));
    (0..surfaces.len()).rev().for_each(|i| update(i, -1));
    distance
}

/// For each pixel of a mover, the centre of the largest disc within its surface that contains the pixel;
/// for a pixel in a corner that no disc contains, that of an adjacent pixel.
fn middles(surfaces: &[u32], distance: &[f32], size: IVec2) -> Vec<usize> {
    let square = |reach: i32| {
        (-reach..=reach).flat_map(move |y| (-reach..=reach).map(move |x| IVec2::new(x, y)))
    };
    let mut middle: Vec<Option<usize>> = vec![None; surfaces.len()];
    for (i, surface) in surfaces.iter().enumerate().filter(|(_, surface)| **surface != STILL) {
        let (here, radius) = (pixel(i, size), distance[i]);
        let mut beside = square(1).filter_map(|across| index(here + across, size));
        if !radius.is_finite() || beside.any(|j| distance[j] > radius) {
            continue;
        }
        for across in square(radius.ceil() as i32) {
            let Some(j) = index(here + across, size) else { continue };
            let covered = across.as_vec2().length() < radius && surfaces[j] == *surface;
            if covered && middle[j].is_none_or(|before| radius > distance[before]) {
                middle[j] = Some(i);
            }
        }
    }
    let mut reached: VecDeque<usize> =
        (0..surfaces.len()).filter(|i| middle[*i].is_some()).collect();
    while let Some(i) = reached.pop_front() {
        for j in square(1).filter_map(|across| index(pixel(i, size) + across, size)) {
            if middle[j].is_none() && surfaces[j] == surfaces[i] {
                middle[j] = middle[i];
                reached.push_back(j);
            }
        }
    }
    middle.iter().enumerate().map(|(i, middle)| middle.unwrap_or(i)).collect()
}

fn pixel(i: usize, size: IVec2) -> IVec2 {
    IVec2::new(i as i32 % size.x, i as i32 / size.x)
}

fn index(pixel: IVec2, size: IVec2) -> Option<usize> {
    let inside = pixel.cmpge(IVec2::ZERO).all() && pixel.cmplt(size).all();
    inside.then(|| (pixel.y * size.x + pixel.x) as usize)
}

/// The centre of a pixel, by its index.
fn middle_of(i: usize, width: u32) -> DVec2 {
    DVec2::new((i as u32 % width) as f64 + 0.5, (i as u32 / width) as f64 + 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observe::Exposure;
    use crate::track::scaffold::{Node, Scaffold};
    use crate::track::{FocalSource, Quality, Told};
    use crate::train::mesh::{Canvas, Frame, Grid};
    use crate::train::views::TrainingView;
    use crate::types::{Camera, Intrinsics, Pose};
    use glam::DQuat;

    const SIZE: (u32, u32) = (96, 64);
    const FOCAL: f64 = 100.0;
    /// Depth of the wall, depth of the middle of the mover before it, and half the mover's width and
    /// height.
    const WALL: f32 = 4.0;
    const DEPTH: f64 = 2.0;
    const HALF: (f64, f64) = (0.4, 0.2);

    fn intrinsics() -> Intrinsics {
        Intrinsics::centred(FOCAL, SIZE.0, SIZE.1)
    }

    fn image(channels: u32) -> Image {
        Image::new(SIZE.0, SIZE.1, channels)
    }

    /// The depth of a mover that bulges by `bulge` over its outline, before the wall.
    fn bulging(bulge: f64) -> (Image, Vec<u32>) {
        let (mut depth, mut surfaces) = (image(1), Vec::new());
        for (i, z) in depth.pixels.iter_mut().enumerate() {
            let ray = intrinsics().ray(middle_of(i, SIZE.0)) * DEPTH;
            let (x, y) = (ray.x.abs() / HALF.0, ray.y.abs() / HALF.1);
            let inside = x < 1.0 && y < 1.0;
            let round = (1.0 - y * y).max(0.0).sqrt();
            *z = if inside { (DEPTH - bulge * round) as f32 } else { WALL };
            surfaces.push(if inside { 3 } else { STILL });
        }
        (depth, surfaces)
    }

    /// An image whose mover has a border of another colour, one pixel wide, as masks have.
    fn picture(surfaces: &[u32]) -> Image {
        let distance = distances(surfaces, IVec2::new(SIZE.0 as i32, SIZE.1 as i32));
        let mut image = image(3);
        for (i, colour) in image.pixels.chunks_exact_mut(3).enumerate() {
            let inside = surfaces[i] != STILL && distance[i] > 1.0;
            colour.copy_from_slice(&if inside { [0.8, 0.2, 0.1] } else { [0.2, 0.2, 0.2] });
        }
        image
    }

    #[test]
    fn a_card_is_as_thick_as_its_narrower_side_and_a_bulge_less() {
        let depths = [0.0, 0.1, 0.3].map(|bulge| {
            let (depth, surfaces) = bulging(bulge);
            let flanks = behind(&surfaces, &depth, &picture(&surfaces), FOCAL);
            for (i, flank) in flanks.iter().enumerate() {
                let (x, y) = (i as u32 % SIZE.0, i as u32 / SIZE.0);
                let beside = || [i - 1, i + 1, i - SIZE.0 as usize, i + SIZE.0 as usize];
                let outline =
                    surfaces[i] != STILL && beside().iter().any(|j| surfaces[*j] == STILL);
                assert_eq!(flank.is_some(), outline, "{x}, {y}");
                if let Some(flank) = flank {
                    assert_eq!(flank.colour, [0.8, 0.2, 0.1], "{x}, {y}");
                }
            }
            // The upper side's middle, row 22.
            let top = flanks[22 * SIZE.0 as usize + 48].unwrap();
            assert_eq!(top.outwards, DVec2::NEG_Y);
            top.depth
        });
        let flat = THICK * 2.0 * HALF.1;
        // At the middle of the row, half a pixel inside the outline, it bulges by 0.31 of the maximum.
        let expected = [flat, flat - 2.0 * 0.69 * 0.1, 0.0];
        for (found, expected) in depths.into_iter().zip(expected) {
            assert!((found - expected).abs() < 0.01, "{depths:?}");
        }
    }

    #[test]
    fn what_stands_before_a_mover_and_the_border_have_no_flank() {
        let (mut depth, mut surfaces) = bulging(0.0);
        for i in 0..surfaces.len() {
            let (x, y) = (i as u32 % SIZE.0, i as u32 / SIZE.0);
            // A post stands before its left half; its right half continues to the border.
            if x < 40 {
                (depth.pixels[i], surfaces[i]) = (1.0, STILL);
            } else if (22..42).contains(&y) {
                (depth.pixels[i], surfaces[i]) = (DEPTH as f32, 3);
            }
        }
        let flanks = behind(&surfaces, &depth, &picture(&surfaces), FOCAL);
        for row in 24..40 {
            assert!(flanks[row * SIZE.0 as usize + 40].is_none(), "beside the post");
            assert!(flanks[row * SIZE.0 as usize + 95].is_none(), "at the border");
        }
        assert!(flanks[22 * SIZE.0 as usize + 70].is_some(), "above");
        let still = vec![STILL; surfaces.len()];
        assert!(behind(&still, &depth, &image(3), FOCAL).iter().all(Option::is_none));
        let all = vec![3; surfaces.len()];
        assert!(behind(&all, &depth, &image(3), FOCAL).iter().all(Option::is_none));
    }

    #[test]
    fn from_above_the_upper_flank_comes_into_view() {
        let (depth, surfaces) = bulging(0.0);
        let picture = picture(&surfaces);
        let flanks = behind(&surfaces, &depth, &picture, FOCAL);
        let mut mask = image(1);
        let moves = surfaces.iter().map(|surface| f32::from(u8::from(*surface != STILL)));
        mask.pixels.iter_mut().zip(moves).for_each(|(pixel, moves)| *pixel = moves);
        let known = depth.pixels.iter().flat_map(|z| [z.recip(), 1.0]).collect();
        let camera = Camera { intrinsics: intrinsics(), view_from_world: Pose::IDENTITY };
        let view = TrainingView {
            camera,
            time: 0.0,
            image: picture,
            weights: None,
            disparity: Some(Image { pixels: known, ..image(2) }),
            mask: None,
            every: 1,
        };
        let from = |height: f64, flanks: &[Option<Flank>]| {
            let view_from_world = Pose::new(DQuat::IDENTITY, DVec3::Y * height);
            let frame = Frame { view: &view, depth: &depth, mask: &mask, owners: &mask, flanks };
            let mut canvas = Canvas::new(&Camera { view_from_world, ..camera });
            canvas.draw(&camera, &Grid::of(&frame, 0));
            canvas.view(0.0)
        };
        let (above, bare) = (from(0.5, &flanks), from(0.5, &[]));
        let shown = |view: &TrainingView, row: u32| {
            let weight = view.weights.as_ref().unwrap().at(48, row)[0];
            (weight, view.image.at(48, row)[0], view.disparity.as_ref().unwrap().at(48, row)[0])
        };
        // The front ends at row 47, the side, 0.26 deep, at row 44.1; nothing is known above it.
        for row in [45, 46] {
            let (weight, red, disparity) = shown(&above, row);
            assert_eq!((weight, red), (0.5, 0.8), "row {row}");
            assert!((1.0 / 2.26..1.0 / 2.0).contains(&disparity), "row {row}: {disparity}");
            assert_eq!(shown(&bare, row).0, 0.0, "row {row}");
        }
        for view in [&above, &bare] {
            assert_eq!(shown(view, 41).0, 0.0);
            assert_eq!(shown(view, 55), (1.0, 0.8, 0.5));
        }
    }

    /// A box of some thickness that turns by `by` in each of nine frames about the middle of its front,
    /// as a static camera shows it.
    fn turning(thickness: f64, by: f64) -> (Track, Vec<Image>) {
        let frames = 9;
        let turn = |frame: usize| DQuat::from_rotation_y(by * frame as f64);
        let pose = |frame: usize| Pose::new(turn(frame), DVec3::Z * DEPTH);
        let mut masks = vec![image(1); frames];
        let mut depth = vec![image(1); frames];
        for frame in 0..frames {
            depth[frame].pixels.fill(WALL);
            let steps = |n: i32| (-n..=n).map(move |k| f64::from(k) / f64::from(n));
            for (u, v) in steps(100).flat_map(|u| steps(50).map(move |v| (u, v))) {
                for w in steps(20).map(|w| 0.5 + 0.5 * w) {
                    let point = DVec3::new(u * HALF.0, v * HALF.1, w * thickness);
                    let seen = pose(frame).apply(point);
                    let at = intrinsics().project(seen);
                    let (x, y) = (at.x as u32, at.y as u32);
                    masks[frame].at_mut(x, y)[0] = 1.0;
                    let z = &mut depth[frame].at_mut(x, y)[0];
                    *z = z.min(seen.z as f32);
                }
            }
        }
        let node = Node {
            owner: 1,
            world_from_node: (0..frames).map(pose).collect(),
            spacing: 0.5,
            alive: 0..frames,
        };
        let track = Track {
            intrinsics: intrinsics(),
            view_from_world: vec![Pose::IDENTITY; frames],
            owners: masks.clone(),
            depth_confidence: vec![image(1); frames],
            movers: Vec::new(),
            shadows: vec![image(2); frames],
            scaffold: Scaffold { nodes: vec![node], canonical: 0 },
            exposure: Exposure::default(),
            points: Vec::new(),
            tracks: Vec::new(),
            lens: None,
            unit: 1.0,
            quality: Quality {
                tripod: true,
                turns: false,
                inlier_share: 1.0,
                reprojection_rms: 0.0,
                parallax_deg: 0.0,
                focal_source: FocalSource::Given,
                focal_std: 0.0,
                dynamic_share: 0.1,
                doubtful_frames: Vec::new(),
                per_frame: Vec::new(),
                tracks: 0,
                motions: Vec::new(),
                static_motion: None,
                told: Told::default(),
                notes: Vec::new(),
            },
            masks,
            depth,
        };
        (track, vec![image(3); frames])
    }

    #[test]
    fn a_flank_ends_where_other_frames_show_what_stands_behind_it() {
        let depth = |thickness: f64, by: f64| {
            let (track, frames) = turning(thickness, by);
            let flanks = flanks(&track, &frames);
            // The left side's middle in the first frame.
            let row = 32 * SIZE.0 as usize;
            let left = flanks[0][row..row + 48].iter().flatten().next().unwrap();
            for point in points(&track, 0, &flanks[0], 2.0) {
                let ray = track.intrinsics.ray(point.pixel);
                assert!(point.normal.dot(ray).abs() < 1e-9 && point.normal.is_normalized());
                assert!(
                    point.depth > DEPTH - 1e-6 && point.depth < DEPTH + THICK * 2.0 * HALF.1 + 0.05
                );
            }
            left.depth
        };
        let guess = depth(0.12, 0.0);
        assert!((guess - THICK * 2.0 * HALF.1).abs() < 0.05, "{guess}");
        // The found thickness is accurate to two pixels and a step.
        let error = 0.04 + guess / f64::from(STEPS);
        for thickness in [0.02, 0.12, 0.2] {
            let found = depth(thickness, -0.17);
            assert!(
                (thickness - error..thickness + error).contains(&found),
                "{thickness}: {found}"
            );
        }
        let whole = depth(0.5, -0.17);
        assert!((whole - guess).abs() < 1e-9, "{whole}");
    }
}
