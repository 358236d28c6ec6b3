//! What frames would show from aside: pictures to train on from where no camera was.
//!
//! A clip's cameras lie along one short path, and Gaussians that only ever have to look right from
//! there do not from anywhere else: they fit the pictures by sums of many faint ones that cancel. The
//! depth tells what a frame shows from a little aside. The frame is drawn as a mesh over its pixels,
//! which is torn where depth jumps and where one thing ends; what the frame does not see has no
//! weight.

use super::lifting::MOVING;
use super::views::TrainingView;
use crate::types::{Camera, Image, Pose};
use glam::{DQuat, DVec2, DVec3};

/// Distances of the cameras from the frames' own, in units of the frame's median depth: from a step
/// aside to about as far as a viewer goes.
const DISTANCE: (f64, f64) = (0.06, 0.3);
/// Neighbouring pixels whose inverse depths differ by more than this share, besides what their
/// surface's slope explains, lie on different surfaces.
const JUMP: f64 = 0.03;
/// A triangle of the mesh that is drawn larger than so many pixels shows too little.
const LARGEST: f64 = 3.0;
/// A frame in which less than this share of the pixels has a depth shows nothing from aside.
const LEAST_KNOWN: f64 = 0.1;

/// A pixel of a frame, before a camera aside.
#[derive(Clone, Copy)]
struct Corner {
    pixel: DVec2,
    inverse_depth: f64,
    colour: [f64; 3],
    weight: f64,
}

/// A frame as training sees it, with what tells things apart, one channel each.
#[derive(Clone, Copy)]
pub(super) struct Frame<'a> {
    /// Its picture and its camera; what has weight and a weighted disparity is shown.
    pub view: &'a TrainingView,
    /// Depth of every pixel: what is not shown hides what lies behind it.
    pub depth: &'a Image,
    /// Above [`MOVING`] on what moves.
    pub mask: &'a Image,
    /// The number of the thing that moves.
    pub owners: &'a Image,
}

/// What a frame shows from aside, with its weights and its disparity. `number` decides where from:
/// consecutive ones are spread evenly. `None` where too little of the frame's depth is known.
pub(super) fn aside(frame: Frame<'_>, number: usize) -> Option<TrainingView> {
    let disparity = frame.view.disparity.as_ref()?;
    let mut known: Vec<f32> =
        disparity.pixels.chunks_exact(2).filter(|d| d[1] > 0.0).map(|d| d[0]).collect();
    if known.is_empty() || (known.len() as f64) < LEAST_KNOWN * frame.mask.pixels.len() as f64 {
        return None;
    }
    let middle = known.len() / 2;
    let median = f64::from(*known.select_nth_unstable_by(middle, f32::total_cmp).1).recip();
    Some(Mesh { frame, disparity }.draw(&aside_from_view(number, median)))
}

/// A camera aside that looks at what the frame's looks at, at depth `depth`. Directions and distances
/// are spread evenly, and independently of each other, by the plane's low-discrepancy sequence of the
/// plastic ratio (Roberts 2018).
fn aside_from_view(number: usize, depth: f64) -> Pose {
    const STEP: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];
    let [turn, share] = STEP.map(|step| (number as f64 * step + 0.5).fract());
    let turn = std::f64::consts::TAU * turn;
    let distance = depth * (DISTANCE.0 + (DISTANCE.1 - DISTANCE.0) * share);
    let centre = distance * DVec3::new(turn.cos(), turn.sin(), 0.0);
    let towards = (DVec3::Z * depth - centre).normalize();
    Pose::new(DQuat::from_rotation_arc(DVec3::Z, towards), centre).inverse()
}

/// A frame as a mesh whose corners are its pixels.
struct Mesh<'a> {
    frame: Frame<'a>,
    disparity: &'a Image,
}

impl Mesh<'_> {
    fn draw(&self, aside_from_view: &Pose) -> TrainingView {
        let (width, height) = (self.frame.mask.width, self.frame.mask.height);
        let columns = i64::from(width);
        let corners: Vec<Option<Corner>> = (0..width * height)
            .map(|i| self.corner(i % width, i / width, aside_from_view))
            .collect();
        let mut canvas = Canvas {
            image: Image::new(width, height, 3),
            weights: Image::new(width, height, 1),
            inverse_depth: vec![0.0; (width * height) as usize],
        };
        for y in 0..i64::from(height) - 1 {
            for x in 0..columns - 1 {
                let corner = |dx: i64, dy: i64| corners[((y + dy) * columns + x + dx) as usize];
                let (Some(a), Some(b)) = (corner(0, 0), corner(1, 0)) else { continue };
                let (Some(c), Some(d)) = (corner(0, 1), corner(1, 1)) else { continue };
                let whole = self.together((x, y), (1, 0))
                    && self.together((x, y + 1), (1, 0))
                    && self.together((x, y), (0, 1))
                    && self.together((x + 1, y), (0, 1));
                for triangle in [[a, b, c], [b, d, c]] {
                    canvas.fill(triangle, whole);
                }
            }
        }
        canvas.trim();
        let mut disparity = Image::new(width, height, 2);
        for (i, pair) in disparity.pixels.chunks_exact_mut(2).enumerate() {
            let weight = canvas.weights.pixels[i];
            if weight > 0.0 {
                pair.copy_from_slice(&[canvas.inverse_depth[i] as f32, weight]);
            }
        }
        let camera = self.frame.view.camera;
        TrainingView {
            camera: Camera { view_from_world: *aside_from_view * camera.view_from_world, ..camera },
            time: self.frame.view.time,
            image: canvas.image,
            weights: Some(canvas.weights),
            disparity: Some(disparity),
            mask: None,
        }
    }

    /// None where the depth is not known, or lies behind the camera.
    fn corner(&self, x: u32, y: u32, aside_from_view: &Pose) -> Option<Corner> {
        let depth = f64::from(self.frame.depth.at(x, y)[0]);
        let known = f64::from(self.disparity.at(x, y)[1]);
        let shown = self.frame.view.weights.as_ref().map_or(1.0, |weights| weights.at(x, y)[0]);
        let intrinsics = &self.frame.view.camera.intrinsics;
        let ray = intrinsics.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        let point = aside_from_view.apply(ray * depth);
        let colour = self.frame.view.image.at(x, y);
        (depth > 0.0 && point.z > 0.05 * depth).then(|| Corner {
            pixel: intrinsics.project(point),
            inverse_depth: point.z.recip(),
            colour: [0, 1, 2].map(|k| f64::from(colour[k])),
            weight: known.min(1.0) * f64::from(shown),
        })
    }

    fn inverse_depth(&self, x: i64, y: i64) -> Option<f64> {
        let inside = (0..i64::from(self.frame.mask.width)).contains(&x)
            && (0..i64::from(self.frame.mask.height)).contains(&y);
        let depth = || f64::from(self.frame.depth.at(x as u32, y as u32)[0]);
        inside.then(depth).filter(|depth| *depth > 0.0).map(f64::recip)
    }

    /// Whether a pixel and its neighbour lie on one surface.
    fn together(&self, (x, y): (i64, i64), (dx, dy): (i64, i64)) -> bool {
        let at = |k: i64| self.inverse_depth(x + k * dx, y + k * dy);
        let (Some(here), Some(next)) = (at(0), at(1)) else { return false };
        // On a plane inverse depth is linear.
        let slopes = [(at(-1), Some(here)), (Some(next), at(2))];
        let slopes = slopes.into_iter().filter_map(|(a, b)| Some((b? - a?).abs()));
        let slope = slopes.reduce(f64::min).unwrap_or(0.0);
        let value = |image: &Image, k: i64| image.at((x + k * dx) as u32, (y + k * dy) as u32)[0];
        value(self.frame.owners, 0) == value(self.frame.owners, 1)
            && (value(self.frame.mask, 0) > MOVING) == (value(self.frame.mask, 1) > MOVING)
            && (next - here).abs() <= JUMP * here.max(next) + 1.5 * slope
    }
}

/// A picture that is being drawn.
struct Canvas {
    image: Image,
    weights: Image,
    inverse_depth: Vec<f64>,
}

impl Canvas {
    /// Draws a triangle of the mesh before what lies behind it; one that is torn or stretched hides and
    /// shows nothing.
    fn fill(&mut self, corners: [Corner; 3], whole: bool) {
        let [a, b, c] = corners.map(|corner| corner.pixel);
        let doubled = (b - a).perp_dot(c - a);
        // Seen from behind.
        if doubled.is_nan() || doubled <= 1e-9 {
            return;
        }
        let shown = whole && 0.5 * doubled < LARGEST;
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let range = |low: f64, high: f64, end: u32| {
            let from = (low - 0.5).ceil().clamp(0.0, f64::from(end)) as u32;
            let to = (high + 0.5).floor().clamp(0.0, f64::from(end)) as u32;
            from..to
        };
        for y in range(low.y, high.y, self.image.height) {
            for x in range(low.x, high.x, self.image.width) {
                let p = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let u = (b - p).perp_dot(c - p) / doubled;
                let v = (c - p).perp_dot(a - p) / doubled;
                let parts = [u, v, 1.0 - u - v];
                if parts.iter().any(|part| *part < 0.0) {
                    continue;
                }
                let mix = |value: &dyn Fn(&Corner) -> f64| {
                    corners.iter().zip(parts).map(|(k, part)| value(k) * part).sum::<f64>()
                };
                let i = (y * self.image.width + x) as usize;
                let inverse_depth = mix(&|k| k.inverse_depth);
                if inverse_depth <= self.inverse_depth[i] {
                    continue;
                }
                self.inverse_depth[i] = inverse_depth;
                let weight = if shown { mix(&|k| k.weight) } else { 0.0 };
                self.weights.pixels[i] = weight as f32;
                for (k, value) in self.image.at_mut(x, y).iter_mut().enumerate() {
                    *value = mix(&|corner| corner.colour[k]) as f32;
                }
            }
        }
    }

    /// Takes the weight from pixels next to what is not shown: the mesh ends within them.
    fn trim(&mut self) {
        let (width, height) = (self.weights.width as usize, self.weights.height as usize);
        let weights = self.weights.pixels.clone();
        for i in 0..weights.len() {
            let (x, y) = (i % width, i / width);
            let beside = [
                (x > 0).then(|| i - 1),
                (x + 1 < width).then(|| i + 1),
                (y > 0).then(|| i - width),
                (y + 1 < height).then(|| i + width),
            ];
            if beside.into_iter().flatten().any(|j| weights[j] <= 0.0) {
                self.weights.pixels[i] = 0.0;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Intrinsics;

    const SIZE: (u32, u32) = (64, 48);
    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, width: SIZE.0, height: SIZE.1 };
    /// A card stands before a wall.
    const WALL: f64 = 4.0;
    const CARD: f64 = 2.0;

    /// Colour of a point on the wall, and of one on the card.
    fn colour(point: DVec3, card: bool) -> [f32; 3] {
        let wave = 0.5 + 0.3 * (2.0 * point.x).sin() * (1.7 * point.y).cos();
        [wave as f32, 0.3, f32::from(u8::from(card))]
    }

    /// What a camera sees: picture and depth.
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
        (TrainingView { camera, time, image, weights: None, disparity, mask: None }, depth)
    }

    fn drawn(view: &TrainingView, depth: &Image, number: usize) -> Option<TrainingView> {
        let nothing = Image::new(64, 48, 1);
        aside(Frame { view, depth, mask: &nothing, owners: &nothing }, number)
    }

    #[test]
    fn it_shows_what_a_camera_there_sees() {
        let camera = Camera { intrinsics: INTRINSICS, view_from_world: Pose::IDENTITY };
        let (view, depth) = view(camera, |_, _| 1.0);
        for number in 0..8 {
            let drawn = drawn(&view, &depth, number).unwrap();
            let off = drawn.camera.centre().length() / WALL;
            assert!((DISTANCE.0..=DISTANCE.1).contains(&off), "{off}");
            let (image, depth) = seen(&drawn.camera);
            let (weights, disparity) = (drawn.weights.unwrap(), drawn.disparity.unwrap());
            let (mut shown, mut wrong) = (0, 0);
            for y in 0..SIZE.1 {
                for x in 0..SIZE.0 {
                    if weights.at(x, y)[0] == 0.0 {
                        assert_eq!(disparity.at(x, y), [0.0, 0.0]);
                        continue;
                    }
                    shown += 1;
                    let z = depth.at(x, y)[0] * disparity.at(x, y)[0];
                    let pairs = drawn.image.at(x, y).iter().zip(image.at(x, y));
                    let far = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                    wrong += u32::from((z - 1.0).abs() > 0.01 || far > 0.03);
                }
            }
            // The card's edges are known to a pixel.
            assert!(shown > 1500 && wrong * 50 < shown, "{number}: {wrong} of {shown}");
        }
    }

    #[test]
    fn what_is_not_known_is_not_shown_and_hides() {
        let camera = Camera { intrinsics: INTRINSICS, view_from_world: Pose::IDENTITY };
        // Of the card nothing is known.
        let (_, depth) = view(camera, |_, _| 1.0);
        let on_wall = |x: u32, y: u32| f32::from(u8::from(depth.at(x, y)[0] > 3.0));
        let (partly, depth) = view(camera, on_wall);
        let drawn = drawn(&partly, &depth, 3).unwrap();
        let (_, there) = seen(&drawn.camera);
        let weights = drawn.weights.unwrap();
        let hidden =
            there.pixels.iter().zip(&weights.pixels).filter(|(z, w)| **z < 3.0 && **w > 0.0);
        assert!(hidden.count() < 8, "the wall shows through the card");
        let (blind, depth) = view(camera, |x, _| f32::from(u8::from(x < 4)));
        assert!(super::tests::drawn(&blind, &depth, 3).is_none());
    }
}
