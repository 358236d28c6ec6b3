//! Frames as meshes over their pixels, drawn before other cameras.
//!
//! A mesh is torn where depth jumps and where one thing ends. Behind the outline of what moves its flank
//! ([`flank`](super::flank)) is drawn there.

use super::flank::Flank;
use super::lifting::MOVING;
use super::views::TrainingView;
use crate::types::{Camera, Image};
use glam::DVec2;

/// Neighbouring pixels whose inverse depths differ by more than this share, besides what their
/// surface's slope explains, lie on different surfaces.
const JUMP: f64 = 0.03;
/// A triangle of the mesh that is drawn larger than so many pixels shows too little.
const LARGEST: f64 = 3.0;
/// A pixel beside one that is nearer by this share of its inverse depth lies behind an edge: a mesh
/// ends at the middles of pixels, what it shows half a pixel farther.
const BEFORE: f64 = 0.06;
/// Nearer than this share of a pixel's depth before the frame's camera, nothing is drawn.
const NEAREST: f64 = 0.05;
/// The weight of a flank, where what is seen has 1.
const FLANK: f32 = 0.5;
/// The surface of all that stands still.
pub(super) const STILL: u32 = 0;

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
    /// What goes on behind the pixels of outlines; may be empty.
    pub flanks: &'a [Option<Flank>],
}

/// What a pixel shows.
#[derive(Clone, Copy)]
pub(super) struct Cell {
    pub inverse_depth: f64,
    /// RGB.
    pub colour: [f32; 3],
    /// 0 where the depth is not known well enough to be shown.
    pub weight: f32,
    /// [`STILL`], or the thing that moves.
    pub surface: u32,
    /// What goes on behind it if it is of an outline.
    pub flank: Option<Flank>,
}

impl Frame<'_> {
    /// `None` outside of the frame, and where there is no depth.
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

/// The cells of a frame's pixels, and of those around it.
pub(super) struct Grid {
    /// Columns and rows around the frame.
    margin: i64,
    width: usize,
    height: usize,
    /// Row by row.
    pub cells: Vec<Option<Cell>>,
}

impl Grid {
    /// What a frame shows, within a margin of cells that it does not show.
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

    /// The cell of a pixel, if the grid reaches as far.
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
        // On a plane inverse depth is linear.
        let change = |a: Cell, b: Cell| (b.inverse_depth - a.inverse_depth).abs();
        let slopes =
            [at(-1).map(|before| change(before, here)), at(2).map(|after| change(next, after))];
        let slope = slopes.into_iter().flatten().reduce(f64::min).unwrap_or(0.0);
        let nearest = here.inverse_depth.max(next.inverse_depth);
        here.surface == next.surface && change(here, next) <= JUMP * nearest + 1.5 * slope
    }
}

/// A cell before the camera that is drawn for.
#[derive(Clone, Copy)]
struct Corner {
    pixel: DVec2,
    inverse_depth: f64,
    cell: Cell,
}

/// A picture that is being drawn.
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

    /// Draws all that a camera's grid shows. What is not shown hides what lies behind it: cells
    /// without weight, triangles that are drawn too large, and what tears between movers and others.
    /// Where what stands still is torn nothing is drawn.
    pub fn draw(&mut self, camera: &Camera, grid: &Grid) {
        self.triangles(camera, grid, |canvas, corners, whole| {
            let still = corners.iter().all(|corner| corner.cell.surface == STILL);
            if whole || !still {
                canvas.fill(corners, whole);
            }
        });
    }

    /// Draws only what stands still and is shown.
    pub fn draw_still(&mut self, camera: &Camera, grid: &Grid) {
        self.triangles(camera, grid, |canvas, corners, whole| {
            let shown = |corner: &Corner| corner.cell.surface == STILL && corner.cell.weight > 0.0;
            if whole && corners.iter().all(shown) && area(&corners) < LARGEST {
                canvas.fill(corners, true);
            }
        });
    }

    /// Calls `fill` for every triangle of the mesh, with whether it is whole.
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

    /// Draws a triangle before what lies behind it; one that is torn or stretched hides, and shows nothing
    /// but the flank behind what moves.
    fn fill(&mut self, corners: [Corner; 3], whole: bool) {
        let [a, b, c] = corners.map(|corner| corner.pixel);
        let doubled = (b - a).perp_dot(c - a);
        // Seen from behind.
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

    /// Takes over from another picture before the same camera what it shows where this one shows and
    /// hides nothing.
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

    /// What has been drawn, at a time, as a picture to train on. Pixels next to what is not shown have
    /// no weight: the mesh ends within them.
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

    /// Takes the weight from pixels next to what is not shown, and behind what is nearer.
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

/// Where the flank ends that goes on from the nearest corner of a torn triangle, and what it shows.
fn flank(corners: &[Corner; 3]) -> Option<Corner> {
    let nearest = corners.iter().max_by(|a, b| a.inverse_depth.total_cmp(&b.inverse_depth))?;
    let Flank { depth, colour, .. } = nearest.cell.flank?;
    let cell = Cell { colour, weight: FLANK * nearest.cell.weight, ..nearest.cell };
    let inverse_depth = (nearest.inverse_depth.recip() + depth).recip();
    Some(Corner { inverse_depth, cell, ..*nearest })
}

/// Of a triangle, as it is drawn, in pixels.
fn area(corners: &[Corner; 3]) -> f64 {
    let [a, b, c] = corners.map(|corner| corner.pixel);
    0.5 * (b - a).perp_dot(c - a)
}
