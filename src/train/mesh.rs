//! Frames as meshes over their pixels, rasterised for other cameras.
//!
//! A mesh is torn where the depth jumps and where an object ends. Behind the outline of a mover its
//! unseen side ([`flank`](super::flank)) is drawn there.

use super::flank::Flank;
use super::lifting::MOVING;
use super::views::TrainingView;
use crate::types::{Camera, Image};
use glam::DVec2;

/// Relative difference of neighbouring pixels' inverse depths, beyond what their surface's slope
/// explains, above which the pixels lie on different surfaces.
const JUMP: f64 = 0.03;
/// Largest area of a projected triangle that is shown, pixels.
const LARGEST: f64 = 3.0;
/// A pixel next to one whose inverse depth is larger by this share lies behind an edge. A mesh ends at
/// pixel centres, but the surface that it shows extends half a pixel farther.
const BEFORE: f64 = 0.06;
/// Near limit, as a share of a pixel's depth in its own frame; nothing nearer is drawn.
const NEAREST: f64 = 0.05;
/// The weight of an unseen side; observed pixels have 1.
const FLANK: f32 = 0.5;
/// The surface index of everything static.
pub(super) const STILL: u32 = 0;

/// A frame as training sees it, with images of one channel each that separate objects.
#[derive(Clone, Copy)]
pub(super) struct Frame<'a> {
    /// Its image and camera; pixels with a weight and a weighted disparity are shown.
    pub view: &'a TrainingView,
    /// Depth of every pixel; pixels that are not shown still hide what lies behind them.
    pub depth: &'a Image,
    /// Motion mask: above [`MOVING`] on movers.
    pub mask: &'a Image,
    /// The index of the mover.
    pub owners: &'a Image,
    /// The unseen sides behind the pixels of outlines; may be empty.
    pub flanks: &'a [Option<Flank>],
}

/// The content of a pixel.
#[derive(Clone, Copy)]
pub(super) struct Cell {
    pub inverse_depth: f64,
    /// RGB.
    pub colour: [f32; 3],
    /// 0 where the depth is not accurate enough to be shown.
    pub weight: f32,
    /// [`STILL`], or the index of the mover's surface.
    pub surface: u32,
    /// The unseen side behind it, if the pixel is on an outline.
    pub flank: Option<Flank>,
}

impl Frame<'_> {
    /// The cell of a pixel; `None` outside of the frame, and where there is no depth.
    fn cell(&self, (x, y): (i64, i64)) -> Option<Cell> {
        let inside = |v: i64, end: u32| u32::try_from(v).ok().filter(|v| *v < end);
        let (x, y) = (inside(x, self.depth.width)?, inside(y, self.depth.height)?);
        let depth = f64::from(self.depth.at(x, y)[0]);
        let known = self.view.disparity.as_ref().map_or(0.0, |disparity| disparity.at(x, y)[1]);
        let shown = self.view.weights.as_ref().map_or(1.0, |weights| weights.at(x, y)[0]);
        let colour = self.view.image.at(x, y);
        let i = (y * self.depth.width + x) as usize;
        (depth > 0.0).then(|| Cell {
            inverse_depth: depth.recip(),
            colour: [colour[0], colour[1], colour[2]],
            weight: known.min(1.0) * shown,
            surface: surface(self.mask.pixels[i], self.owners.pixels[i]),
            flank: self.flanks.get(i).copied().flatten(),
        })
    }
}

/// The surface that a pixel shows, by its mask and its owner.
pub(super) fn surface(mask: f32, owner: f32) -> u32 {
    2 * owner as u32 + u32::from(mask > MOVING)
}

/// The cells of a frame's pixels, and of a margin around them.
pub(super) struct Grid {
    /// Width of the margin around the frame, cells.
    margin: i64,
    width: usize,
    height: usize,
    /// Row by row.
    pub cells: Vec<Option<Cell>>,
}

impl Grid {
    /// The cells of a frame, within a margin of empty cells.
    pub fn of(frame: &Frame<'_>, margin: u32) -> Grid {
        let [width, height] =
            [frame.depth.width, frame.depth.height].map(|size| (size + 2 * margin) as usize);
        let mut grid = Grid { margin: i64::from(margin), width, height, cells: Vec::new() };
        grid.cells = (0..width * height).map(|i| frame.cell(grid.pixel(i))).collect();
        grid
    }

    /// The pixel of a cell.
    pub fn pixel(&self, i: usize) -> (i64, i64) {
        ((i % self.width) as i64 - self.margin, (i / self.width) as i64 - self.margin)
    }

    /// The index of a pixel's cell; `None` outside of the grid.
    pub fn index(&self, (x, y): (i64, i64)) -> Option<usize> {
        let inside =
            |v: i64, end: usize| usize::try_from(v + self.margin).ok().filter(|v| *v < end);
        Some(inside(y, self.height)? * self.width + inside(x, self.width)?)
    }

    fn at(&self, pixel: (i64, i64)) -> Option<Cell> {
        self.cells[self.index(pixel)?]
    }

    /// Whether a pixel and its neighbour lie on one surface.
    fn together(&self, (x, y): (i64, i64), (dx, dy): (i64, i64)) -> bool {
        let at = |k: i64| self.at((x + k * dx, y + k * dy));
        let (Some(here), Some(next)) = (at(0), at(1)) else { return false };
        // On a plane, the inverse depth is linear.
        let change = |a: Cell, b: Cell| (b.inverse_depth - a.inverse_depth).abs();
        let slopes =
            [at(-1).map(|before| change(before, here)), at(2).map(|after| change(next, after))];
        let slope = slopes.into_iter().flatten().reduce(f64::min).unwrap_or(0.0);
        let nearest = here.inverse_depth.max(next.inverse_depth);
        here.surface == next.surface && change(here, next) <= JUMP * nearest + 1.5 * slope
    }
}

/// A cell, projected into the camera that is rendered.
#[derive(Clone, Copy)]
struct Corner {
    pixel: DVec2,
    inverse_depth: f64,
    cell: Cell,
}

/// An image that is being rendered.
pub(super) struct Canvas {
    camera: Camera,
    image: Image,
    weights: Image,
    /// 0 where nothing has been drawn.
    inverse_depth: Vec<f64>,
}

impl Canvas {
    pub fn new(camera: &Camera) -> Canvas {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        Canvas {
            camera: *camera,
            image: Image::new(width, height, 3),
            weights: Image::new(width, height, 1),
            inverse_depth: vec![0.0; (width * height) as usize],
        }
    }

    /// Draws a camera's grid. Parts that are not shown still hide what lies behind them: cells without
    /// weight, triangles that are projected too large, and tears between movers and other surfaces.
    /// Nothing is drawn at tears within the static scene.
    pub fn draw(&mut self, camera: &Camera, grid: &Grid) {
        self.triangles(camera, grid, |canvas, corners, whole| {
            let still = corners.iter().all(|corner| corner.cell.surface == STILL);
            if whole || !still {
                canvas.fill(corners, whole);
            }
        });
    }

    /// Draws only the shown parts of the static scene.
    pub fn draw_still(&mut self, camera: &Camera, grid: &Grid) {
        self.triangles(camera, grid, |canvas, corners, whole| {
            let shown = |corner: &Corner| corner.cell.surface == STILL && corner.cell.weight > 0.0;
            if whole && corners.iter().all(shown) && area(&corners) < LARGEST {
                canvas.fill(corners, true);
            }
        });
    }

    /// Calls `fill` for every triangle of the mesh, and passes whether it is whole rather than torn.
    fn triangles(
        &mut self,
        camera: &Camera,
        grid: &Grid,
        fill: impl Fn(&mut Canvas, [Corner; 3], bool),
    ) {
        let here_from_there = self.camera.view_from_world * camera.view_from_world.inverse();
        let corner = |i: usize| {
            let cell = grid.cells[i]?;
            let (x, y) = grid.pixel(i);
            let depth = cell.inverse_depth.recip();
            let ray = camera.intrinsics.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            let point = here_from_there.apply(ray * depth);
            let pixel = self.camera.intrinsics.project(point);
            let inverse_depth = point.z.recip();
            (point.z > NEAREST * depth).then_some(Corner { pixel, inverse_depth, cell })
        };
        let corners: Vec<Option<Corner>> = (0..grid.cells.len()).map(corner).collect();
        for (i, a) in corners.iter().enumerate() {
            let (x, y) = grid.pixel(i);
            let next = |dx: i64, dy: i64| corners[grid.index((x + dx, y + dy))?];
            let (Some(a), Some(b)) = (*a, next(1, 0)) else { continue };
            let (Some(c), Some(d)) = (next(0, 1), next(1, 1)) else { continue };
            let whole = grid.together((x, y), (1, 0))
                && grid.together((x, y + 1), (1, 0))
                && grid.together((x, y), (0, 1))
                && grid.together((x + 1, y), (0, 1));
            for triangle in [[a, b, c], [b, d, c]] {
                fill(self, triangle, whole);
            }
        }
    }

    /// Draws a triangle with a depth test. A torn or stretched one hides what lies behind it and shows
    /// only the unseen side behind a mover.
    fn fill(&mut self, corners: [Corner; 3], whole: bool) {
        let [a, b, c] = corners.map(|corner| corner.pixel);
        let doubled = (b - a).perp_dot(c - a);
        // The triangle is seen from behind.
        if doubled.is_nan() || doubled <= 1e-9 {
            return;
        }
        let shown = whole && area(&corners) < LARGEST;
        let flank = if whole { None } else { flank(&corners) };
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
                if let Some(end) = flank.filter(|end| inverse_depth > end.inverse_depth) {
                    self.weights.pixels[i] = end.cell.weight;
                    self.image.at_mut(x, y).copy_from_slice(&end.cell.colour);
                    continue;
                }
                let weight = if shown { mix(&|k| f64::from(k.cell.weight)) } else { 0.0 };
                self.weights.pixels[i] = weight as f32;
                for (k, value) in self.image.at_mut(x, y).iter_mut().enumerate() {
                    *value = mix(&|corner| f64::from(corner.cell.colour[k])) as f32;
                }
            }
        }
    }

    /// Fills pixels in which nothing has been drawn, shown or hidden, from another canvas of the same
    /// camera.
    pub fn complete(&mut self, other: &Canvas) {
        for (i, inverse_depth) in self.inverse_depth.iter_mut().enumerate() {
            if *inverse_depth == 0.0 {
                *inverse_depth = other.inverse_depth[i];
                self.weights.pixels[i] = other.weights.pixels[i];
                let colour = 3 * i..3 * i + 3;
                self.image.pixels[colour.clone()].copy_from_slice(&other.image.pixels[colour]);
            }
        }
    }

    /// Converts the canvas to a training view at `time`. Pixels next to pixels that are not shown get no
    /// weight, since the mesh ends within them.
    pub fn view(mut self, time: f64) -> TrainingView {
        self.trim();
        let (width, height) = (self.image.width, self.image.height);
        let mut disparity = Image::new(width, height, 2);
        for (i, pair) in disparity.pixels.chunks_exact_mut(2).enumerate() {
            let weight = self.weights.pixels[i];
            if weight > 0.0 {
                pair.copy_from_slice(&[self.inverse_depth[i] as f32, weight]);
            }
        }
        TrainingView {
            camera: self.camera,
            time,
            image: self.image,
            weights: Some(self.weights),
            disparity: Some(disparity),
            mask: None,
            every: 1,
        }
    }

    /// Sets the weight to 0 for pixels next to ones that are not shown, and for pixels next to a nearer
    /// surface.
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
            let ends = |j: usize| {
                let before = (1.0 - BEFORE) * self.inverse_depth[j] > self.inverse_depth[i];
                weights[j] <= 0.0 || before
            };
            if beside.into_iter().flatten().any(ends) {
                self.weights.pixels[i] = 0.0;
            }
        }
    }
}

/// The end of the unseen side that continues from the nearest corner of a torn triangle, with its colour
/// and weight.
fn flank(corners: &[Corner; 3]) -> Option<Corner> {
    let nearest = corners.iter().max_by(|a, b| a.inverse_depth.total_cmp(&b.inverse_depth))?;
    let Flank { depth, colour, .. } = nearest.cell.flank?;
    let cell = Cell { colour, weight: FLANK * nearest.cell.weight, ..nearest.cell };
    let inverse_depth = (nearest.inverse_depth.recip() + depth).recip();
    Some(Corner { inverse_depth, cell, ..*nearest })
}

/// The area of a projected triangle, pixels.
fn area(corners: &[Corner; 3]) -> f64 {
    let [a, b, c] = corners.map(|corner| corner.pixel);
    0.5 * (b - a).perp_dot(c - a)
}
