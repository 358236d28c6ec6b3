//! Views from offset cameras: training views from viewpoints that the clip's camera did not visit.
//!
//! A clip's cameras lie along one short path. Gaussians that only have to match these views do not look
//! right from elsewhere: they fit the images by sums of many faint ones that cancel. The depth
//! determines what a frame shows from a small offset: the frame is rasterised as a mesh over its pixels
//! ([`mesh`](super::mesh)). Where that mesh is empty, other frames of the clip fill in the static scene.
//! Where these are empty as well, surfaces are extrapolated a little beyond their edges
//! ([`beyond`](super::beyond())); otherwise no view would require Gaussians there, and the borders of
//! what the clip shows would fray.

use super::beyond::beyond;
use super::mesh::{Canvas, Frame, Grid};
use super::views::TrainingView;
use crate::types::{Camera, Pose};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

/// Range of distances of the offset cameras from the frames' cameras, in units of the frame's median
/// depth: from a small step to about as far as a viewer goes.
const DISTANCE: (f64, f64) = (0.06, 0.3);
/// Share of the pixels that must have a depth; a frame with less gives no offset view.
const LEAST_KNOWN: f64 = 0.1;
/// Number of frames, spread over the clip, that fill in the static scene where a frame shows nothing.
const OTHERS: usize = 16;

/// Views of a clip's frames from offset cameras, with weights and disparities. The first n frames give
/// `count(n)` views together; consecutive views are spread evenly over directions and distances. A frame
/// with too little known depth gives none.
pub(super) fn aside(
    frames: &[Frame<'_>],
    count: impl Fn(usize) -> usize + Sync,
) -> Vec<TrainingView> {
    let every = frames.len().div_ceil(OTHERS).max(1);
    let others: Vec<Other<'_>> = frames.par_iter().step_by(every).map(Other::of).collect();
    let pictures: Vec<(usize, usize)> = (0..frames.len())
        .flat_map(|frame| (count(frame)..count(frame + 1)).map(move |number| (frame, number)))
        .collect();
    let drawn = pictures.into_par_iter().filter_map(|(frame, number)| {
        let frame = &frames[frame];
        let camera = camera_aside(frame, number)?;
        Some(draw(frame, &others, &camera).view(frame.view.time))
    });
    drawn.collect()
}

/// A frame that fills in the static scene where another one shows nothing.
struct Other<'a> {
    frame: &'a Frame<'a>,
    beyond: Grid,
}

impl<'a> Other<'a> {
    fn of(frame: &'a Frame<'a>) -> Other<'a> {
        Other { frame, beyond: beyond(frame) }
    }
}

/// Renders a frame for an offset camera.
fn draw(frame: &Frame<'_>, others: &[Other<'_>], camera: &Camera) -> Canvas {
    let mut canvas = Canvas::new(camera);
    canvas.draw(&frame.view.camera, &Grid::of(frame, 0));
    let (mut seen, mut guessed) = (Canvas::new(camera), Canvas::new(camera));
    for Other { frame, beyond } in others {
        seen.draw_still(&frame.view.camera, &Grid::of(frame, 0));
        guessed.draw_still(&frame.view.camera, beyond);
    }
    canvas.complete(&seen);
    canvas.complete(&guessed);
    canvas
}

/// The offset camera of a number for a frame; `None` if too little of the frame's depth is known.
fn camera_aside(frame: &Frame<'_>, number: usize) -> Option<Camera> {
    let camera = frame.view.camera;
    let aside_from_view = aside_from_view(number, median_depth(frame)?);
    Some(Camera { view_from_world: aside_from_view * camera.view_from_world, ..camera })
}

/// The median of a frame's known depths; `None` if too few are known.
fn median_depth(frame: &Frame<'_>) -> Option<f64> {
    let disparity = frame.view.disparity.as_ref()?;
    let mut known: Vec<f32> =
        disparity.pixels.chunks_exact(2).filter(|d| d[1] > 0.0).map(|d| d[0]).collect();
    if known.is_empty() || (known.len() as f64) < LEAST_KNOWN * frame.mask.pixels.len() as f64 {
        return None;
    }
    let middle = known.len() / 2;
    Some(f64::from(*known.select_nth_unstable_by(middle, f32::total_cmp).1).recip())
}

/// The pose of an offset camera that looks at the same point as the frame's camera, at depth `depth`.
/// Directions and distances are spread evenly, and independently of each other, by the two-dimensional
/// low-discrepancy sequence of the plastic ratio (Roberts 2018).
fn aside_from_view(number: usize, depth: f64) -> Pose {
    const STEP: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];
    let [turn, share] = STEP.map(|step| (number as f64 * step + 0.5).fract());
    let turn = std::f64::consts::TAU * turn;
    let distance = depth * (DISTANCE.0 + (DISTANCE.1 - DISTANCE.0) * share);
    let centre = distance * DVec3::new(turn.cos(), turn.sin(), 0.0);
    let towards = (DVec3::Z * depth - centre).normalize();
    Pose::new(DQuat::from_rotation_arc(DVec3::Z, towards), centre).inverse()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Image, Intrinsics};
    use glam::DVec2;

    const SIZE: (u32, u32) = (64, 48);
    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, width: SIZE.0, height: SIZE.1 };
    /// Depths of a wall and of a card before it.
    const WALL: f64 = 4.0;
    const CARD: f64 = 2.0;

    /// Colour of a point on the wall, and of one on the card.
    fn colour(point: DVec3, card: bool) -> [f32; 3] {
        let wave = 0.5 + 0.3 * (2.0 * point.x).sin() * (1.7 * point.y).cos();
        [wave as f32, 0.3, f32::from(u8::from(card))]
    }

    /// What a camera sees: image and depth.
    fn seen(camera: &Camera) -> (Image, Image) {
        let (mut image, mut depth) = (Image::new(64, 48, 3), Image::new(64, 48, 1));
        let world_from_view = camera.view_from_world.inverse();
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let ray = INTRINSICS.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                let direction = world_from_view.rotation * ray;
                let hit = |z: f64| {
                    let along = (z - world_from_view.translation.z) / direction.z;
                    (world_from_view.translation + along * direction, along)
                };
                let (on_card, near) = hit(CARD);
                let (on_wall, far) = hit(WALL);
                let card = on_card.x.abs() < 0.4 && on_card.y.abs() < 0.5;
                let (point, z) = if card { (on_card, near) } else { (on_wall, far) };
                image.at_mut(x, y).copy_from_slice(&colour(point, card));
                depth.at_mut(x, y)[0] = z as f32;
            }
        }
        (image, depth)
    }

    fn view(camera: Camera, known: impl Fn(u32, u32) -> f32) -> (TrainingView, Image) {
        let (image, depth) = seen(&camera);
        let mut disparity = Image::new(64, 48, 2);
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let pair = [depth.at(x, y)[0].recip(), known(x, y)];
                disparity.at_mut(x, y).copy_from_slice(&pair);
            }
        }
        let (disparity, time) = (Some(disparity), 0.25);
        (
            TrainingView { camera, time, image, weights: None, disparity, mask: None, every: 1 },
            depth,
        )
    }

    /// A camera, `right` units to the right of the middle.
    fn camera(right: f64) -> Camera {
        let view_from_world = Pose::new(DQuat::IDENTITY, DVec3::X * -right);
        Camera { intrinsics: INTRINSICS, view_from_world }
    }

    /// The offset view of the first frame, filled in from all frames.
    fn drawn(views: &[(TrainingView, Image)], number: usize) -> TrainingView {
        let still = Image::new(64, 48, 1);
        let frame =
            |(view, depth)| Frame { view, depth, mask: &still, owners: &still, flanks: &[] };
        let frames: Vec<Frame<'_>> =
            views.iter().map(|(view, depth)| frame((view, depth))).collect();
        let others: Vec<Other<'_>> = frames.iter().map(Other::of).collect();
        draw(&frames[0], &others, &camera_aside(&frames[0], number).unwrap()).view(0.25)
    }

    /// Counts of an offset view's pixels that frames show and of the wrong ones among them, then the
    /// same for guessed pixels, which are compared by depth only.
    fn judge(drawn: &TrainingView) -> [(u32, u32); 2] {
        let (image, depth) = seen(&drawn.camera);
        let (weights, disparity) =
            (drawn.weights.as_ref().unwrap(), drawn.disparity.as_ref().unwrap());
        let mut counts = [(0, 0); 2];
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let weight = weights.at(x, y)[0];
                if weight == 0.0 {
                    assert_eq!(disparity.at(x, y), [0.0, 0.0]);
                    continue;
                }
                let z = depth.at(x, y)[0] * disparity.at(x, y)[0];
                let pairs = drawn.image.at(x, y).iter().zip(image.at(x, y));
                let far = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                let guessed = weight < 0.95;
                let wrong = (z - 1.0).abs() > 0.01 || (far > 0.03 && !guessed);
                let count = &mut counts[usize::from(guessed)];
                *count = (count.0 + 1, count.1 + u32::from(wrong));
            }
        }
        counts
    }

    #[test]
    fn it_shows_what_a_camera_there_sees() {
        let views = [view(camera(0.0), |_, _| 1.0)];
        for number in 0..8 {
            let drawn = drawn(&views, number);
            let off = drawn.camera.centre().length() / WALL;
            assert!((DISTANCE.0..=DISTANCE.1).contains(&off), "{off}");
            let [(shown, wrong), (guessed, off)] = judge(&drawn);
            // The card's edges are accurate to one pixel.
            assert!(shown > 1500 && wrong * 50 < shown, "{number}: {wrong} of {shown}");
            assert!(guessed > 30 && off * 10 < guessed, "{number}: {off} of {guessed} guessed");
        }
    }

    #[test]
    fn other_frames_tell_what_one_does_not_show() {
        let alone = [view(camera(0.0), |_, _| 1.0)];
        let all = [0.0, -0.8, 0.8].map(|right| view(camera(right), |_, _| 1.0));
        for number in 0..8 {
            let [(shown, _), _] = judge(&drawn(&alone, number));
            let [(more, wrong), _] = judge(&drawn(&all, number));
            assert!(more > shown + 30, "{number}: {more}, alone {shown}");
            assert!(wrong * 50 < more, "{number}: {wrong} of {more}");
        }
    }

    #[test]
    fn what_is_not_known_is_not_shown_and_hides() {
        // The card's depth is unknown.
        let (_, depth) = view(camera(0.0), |_, _| 1.0);
        let on_wall = |x: u32, y: u32| f32::from(u8::from(depth.at(x, y)[0] > 3.0));
        let drawn = drawn(&[view(camera(0.0), on_wall)], 3);
        let (_, there) = seen(&drawn.camera);
        let weights = drawn.weights.unwrap();
        let hidden =
            there.pixels.iter().zip(&weights.pixels).filter(|(z, w)| **z < 3.0 && **w > 0.0);
        assert!(hidden.count() < 8, "the wall shows through the card");
        let (view, depth) = view(camera(0.0), |x, _| f32::from(u8::from(x < 4)));
        let still = Image::new(64, 48, 1);
        let frame = Frame { view: &view, depth: &depth, mask: &still, owners: &still, flanks: &[] };
        assert!(aside(&[frame], |frames| frames).is_empty());
    }
}
