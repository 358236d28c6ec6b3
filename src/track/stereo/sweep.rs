//! The matching cost of each pixel against the other frames on each of a set of planes.
//!
//! A plane sweep (Collins 1996): for each plane the other frames are warped into this one, and the patches
//! around each pixel are compared by normalised correlation. Only the better half of the frames counts,
//! because the point may be hidden in the others.

use glam::{DVec2, DVec3};

use super::super::cameras::Cameras;
use super::patch::{self, RADIUS, neighbours};
use super::views::{self, View};
use crate::types::Image;

/// Lower bound of the noise of a pixel's luminance.
const NOISE: f32 = 0.01;
/// The cost of a patch that does not match at all.
const WORST: f32 = 100.0;
/// Maximum extra cost of the levels away from a preferred one.
const UNLIKE: usize = 6;

/// The planes of a sweep, which are parallel to each other.
pub(super) struct Planes {
    /// The inverse depth of plane `l` at a pixel is `levels[l]` times the dot product of `base` with the
    /// pixel's ray.
    pub base: DVec3,
    pub levels: Vec<f64>,
}

impl Planes {
    /// Planes that face the camera, at these inverse depths.
    pub fn facing(levels: Vec<f64>) -> Planes {
        Planes { base: DVec3::Z, levels }
    }
}

/// The cost volume: costs per pixel and level, levels contiguous.
pub(super) struct Volume {
    pub width: usize,
    pub height: usize,
    pub levels: usize,
    pub costs: Vec<u8>,
}

impl Volume {
    pub fn of(&self, i: usize) -> &[u8] {
        &self.costs[i * self.levels..][..self.levels]
    }

    /// Adds a small cost to all levels away from one, which then wins where the image is blank.
    pub fn prefer(&mut self, i: usize, level: usize) {
        for (l, cost) in self.costs[i * self.levels..][..self.levels].iter_mut().enumerate() {
            *cost += l.abs_diff(level).min(UNLIKE) as u8;
        }
    }
}

/// A frame's luminance, NaN where a mover is.
pub(super) fn luminance(frame: &Image, mask: &[bool]) -> Vec<f32> {
    let channels = frame.channels as usize;
    let mean = |p: &[f32]| p.iter().sum::<f32>() / channels as f32;
    let shown = |(p, moves): (&[f32], &bool)| if *moves { f32::NAN } else { mean(p) };
    frame.pixels.chunks_exact(channels).zip(mask).map(shown).collect()
}

/// The peak memory in bytes for sweeping a frame of `pixels` pixels and selecting its levels.
pub(super) fn memory(pixels: usize) -> usize {
    let costs_and_sums = views::LEVELS * (size_of::<u8>() + size_of::<i16>());
    let lists = 2 * neighbours().len() + views::VIEWS + 2;
    pixels * (costs_and_sums + lists * size_of::<f32>())
}

/// The cost volume of a frame, from the luminances of [`luminance`]. Where the frame itself is NaN, every
/// level has the same cost.
pub(super) fn volume(
    image: &Image,
    pictures: &[Vec<f32>],
    cameras: &Cameras,
    frame: usize,
    views: &[View],
    planes: &Planes,
) -> Volume {
    let levels = &planes.levels;
    let k = &cameras.intrinsics;
    let (width, height) = (k.width as usize, k.height as usize);
    let n = width * height;
    let own = Patches::of(image, &pictures[frame]);
    let mut costs = vec![0u8; n * levels.len()];
    let mut drawn = vec![0.0f32; n];
    let mut compared = vec![vec![0.0f32; n]; views.len()];
    for (l, &level) in levels.iter().enumerate() {
        for (view, out) in views.iter().zip(&mut compared) {
            draw(&pictures[view.frame], cameras, view, planes.base * level, &mut drawn);
            own.compare(&drawn, out);
        }
        better_half(&mut compared);
        for i in 0..n {
            let sum: f32 = compared[..views.len().div_ceil(2)].iter().map(|c| c[i]).sum();
            let mean = sum / views.len().div_ceil(2) as f32;
            costs[i * levels.len() + l] = (mean * WORST + 0.5) as u8;
        }
    }
    Volume { width, height, levels: levels.len(), costs }
}

/// Warps another frame into this one as if everything were on one plane; NaN outside. The plane's inverse
/// depth at a pixel is the dot product of `plane` with the pixel's ray.
fn draw(picture: &[f32], cameras: &Cameras, view: &View, plane: DVec3, out: &mut [f32]) {
    let k = &cameras.intrinsics;
    let (width, height) = (k.width as usize, k.height as usize);
    let (rotation, t) = (view.view_from_frame.rotation, view.view_from_frame.translation);
    // The homogeneous coordinates are affine in the pixel.
    let at = |x: f64, y: f64| {
        let ray = k.ray(DVec2::new(x, y));
        let p = rotation * ray + t * plane.dot(ray);
        [k.fx * p.x + (k.cx - 0.5) * p.z, k.fy * p.y + (k.cy - 0.5) * p.z, p.z]
    };
    let origin = at(0.5, 0.5);
    let [by_x, by_y] = [at(1.5, 0.5), at(0.5, 1.5)];
    let slope = |b: [f64; 3]| [0, 1, 2].map(|c| (b[c] - origin[c]) as f32);
    let (by_x, by_y, origin) = (slope(by_x), slope(by_y), origin.map(|v| v as f32));
    let (last_x, last_y) = ((width - 1) as f32, (height - 1) as f32);
    for y in 0..height {
        let down = y as f32;
        let row: [f32; 3] =
            [origin[0] + down * by_y[0], origin[1] + down * by_y[1], origin[2] + down * by_y[2]];
        for (x, out) in out[y * width..][..width].iter_mut().enumerate() {
            let right = x as f32;
            let depth = row[2] + right * by_x[2];
            let inverse = depth.recip();
            let u = (row[0] + right * by_x[0]) * inverse;
            let v = (row[1] + right * by_x[1]) * inverse;
            // `inside` is also false if a coordinate is NaN.
            let inside = depth > 1e-3 && u >= 0.0 && v >= 0.0 && u < last_x && v < last_y;
            if !inside {
                *out = f32::NAN;
                continue;
            }
            let (x0, y0) = (u as i32 as usize, v as i32 as usize);
            let (a, b) = (u - x0 as f32, v - y0 as f32);
            let i = y0 * width + x0;
            let four = &picture[i..][..width + 2];
            let top = four[0] + a * (four[1] - four[0]);
            let bottom = four[width] + a * (four[width + 1] - four[width]);
            *out = top + b * (bottom - top);
        }
    }
}

/// The patches of a frame. Each pixel's neighbours are weighted by the similarity of their colour, so that a
/// patch ends where another surface begins.
struct Patches {
    width: usize,
    height: usize,
    /// Per neighbour, then per pixel: in `shares` its share of the patch; in `values` that share times the
    /// difference of its luminance from the patch's mean. The shares of a pixel sum to one.
    shares: Vec<Vec<f32>>,
    values: Vec<Vec<f32>>,
    variance: Vec<f32>,
}

impl Patches {
    fn of(frame: &Image, picture: &[f32]) -> Patches {
        let (width, height) = (frame.width as usize, frame.height as usize);
        let n = width * height;
        let neighbours = neighbours();
        let mut shares = vec![vec![f32::NAN; n]; neighbours.len()];
        let mut values = shares.clone();
        let mut variance = vec![f32::NAN; n];
        for y in RADIUS..height - RADIUS {
            for x in RADIUS..width - RADIUS {
                let i = y * width + x;
                let at = |(dx, dy): (isize, isize)| i.wrapping_add_signed(dy * width as isize + dx);
                let (mut total, mut mean) = (0.0, 0.0);
                for (k, by) in neighbours.iter().enumerate() {
                    let weight = patch::weight(frame, i, at(*by));
                    shares[k][i] = weight;
                    total += weight;
                    mean += weight * picture[at(*by)];
                }
                mean /= total;
                let mut square = 0.0;
                for (k, by) in neighbours.iter().enumerate() {
                    shares[k][i] /= total;
                    let beyond = picture[at(*by)] - mean;
                    values[k][i] = shares[k][i] * beyond;
                    square += values[k][i] * beyond;
                }
                variance[i] = square;
            }
        }
        Patches { width, height, shares, values, variance }
    }

    /// One minus the correlation with another frame's patches, from 0 to 1; 1 where either is unknown.
    fn compare(&self, other: &[f32], out: &mut [f32]) {
        out.fill(1.0);
        let n = self.width - 2 * RADIUS;
        let mut sums = [(); 3].map(|()| vec![0.0f32; n]);
        for y in RADIUS..self.height - RADIUS {
            let first = y * self.width + RADIUS;
            let [sum, square, product] = &mut sums;
            for list in [&mut *sum, &mut *square, &mut *product] {
                list.fill(0.0);
            }
            let (sum, square, product) = (&mut sum[..n], &mut square[..n], &mut product[..n]);
            for (k, (dx, dy)) in neighbours().into_iter().enumerate() {
                let there = first.wrapping_add_signed(dy * self.width as isize + dx);
                let (b, share) = (&other[there..][..n], &self.shares[k][first..][..n]);
                let value = &self.values[k][first..][..n];
                for x in 0..n {
                    let weighted = share[x] * b[x];
                    sum[x] += weighted;
                    square[x] += weighted * b[x];
                    product[x] += value[x] * b[x];
                }
            }
            let (out, own) = (&mut out[first..][..n], &self.variance[first..][..n]);
            for x in 0..n {
                let variance = (square[x] - sum[x] * sum[x]).max(0.0);
                let noise = NOISE * NOISE;
                let scale = ((variance + noise) * (own[x] + noise)).sqrt();
                let cost = 1.0 - product[x] / scale;
                // A cost of NaN also becomes one.
                out[x] = if cost < 1.0 { cost.max(0.0) } else { 1.0 };
            }
        }
    }
}

/// Moves the smaller half of the values at every pixel to the first half of the lists.
fn better_half(lists: &mut [Vec<f32>]) {
    let n = lists.len();
    for last in (n.div_ceil(2)..n).rev() {
        for k in 0..last {
            let (a, b) = lists.split_at_mut(k + 1);
            for (x, y) in a[k].iter_mut().zip(&mut b[0]) {
                let (low, high) = (x.min(*y), x.max(*y));
                (*x, *y) = (low, high);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::sliding;
    use super::*;

    #[test]
    fn the_right_level_costs_least_and_movers_say_nothing() {
        let frames = sliding::painted();
        let cameras = sliding::cameras(sliding::STEP);
        let still = vec![false; frames[0].pixels.len() / 3];
        let mut pictures: Vec<Vec<f32>> = frames.iter().map(|f| luminance(f, &still)).collect();
        let views = views::views(&cameras, 2);
        let levels: Vec<f64> = (1..12).map(|l| 0.05 * f64::from(l)).collect();
        let planes = Planes::facing(levels);
        let right =
            planes.levels.iter().position(|l| (l * sliding::WALL - 1.0).abs() < 1e-9).unwrap();
        let middle = 20 * sliding::WIDTH as usize + 32;
        let found = volume(&frames[2], &pictures, &cameras, 2, &views, &planes);
        let costs = found.of(middle);
        assert!(costs[right] < 5, "{costs:?}");
        for (l, cost) in costs.iter().enumerate() {
            assert!(l.abs_diff(right) < 2 || *cost > costs[right] + 20, "{l}: {costs:?}");
        }
        pictures[2] = luminance(&frames[2], &vec![true; still.len()]);
        let found = volume(&frames[2], &pictures, &cameras, 2, &views, &planes);
        assert!(found.costs.iter().all(|cost| *cost == 100));
    }

    #[test]
    fn the_smaller_half_comes_first() {
        let mut lists: Vec<Vec<f32>> = [5.0, 1.0, 4.0, 2.0, 3.0].map(|v| vec![v, 6.0 - v]).to_vec();
        better_half(&mut lists);
        for i in 0..2 {
            let mut half: Vec<f32> = lists[..3].iter().map(|list| list[i]).collect();
            half.sort_by(f32::total_cmp);
            assert_eq!(half, [1.0, 2.0, 3.0]);
        }
    }
}
