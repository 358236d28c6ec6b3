//! The engine's own keypoints and descriptors: the scale-invariant feature transform (Lowe 2004), with
//! descriptors compared by the Hellinger distance (RootSIFT, Arandjelović and Zisserman 2012).
//!
//! Keypoints are extrema of the difference of Gaussians over position and scale, refined by a quadric. Each
//! has one or more dominant gradient directions, and a descriptor made of gradient histograms of 4 × 4
//! cells. Small frames are doubled first, which finds three times as many points.

use std::f32::consts::TAU;

use glam::{DVec2, Mat3, Vec3};

use super::features::{FeatureSource, Features, Rule};
use crate::Result;
use crate::types::Image;

/// Frames whose longer side has at most this many pixels are doubled.
const SMALL: u32 = 800;
/// Scales per octave.
const SCALES: usize = 3;
/// Blur of an octave's first image, and assumed blur of a frame as filmed, pixels.
const FIRST: f32 = 1.6;
const FILMED: f32 = 0.5;
/// Minimum side of an octave.
const LEAST_SIDE: usize = 16;
/// Minimum contrast of an extremum, as a difference of two scales with values in [0, 1].
const CONTRAST: f32 = 0.02 / SCALES as f32;
/// Ratio of curvatures above which a point lies on an edge.
const EDGE: f32 = 12.0;
/// Maximum number of refinement steps.
const STEPS: usize = 5;
/// Bins of a direction histogram, its radius in scales, and the share of the highest peak above which
/// another peak also counts.
const DIRECTIONS: usize = 36;
const DIRECTION_REACH: f32 = 1.5;
const PEAK: f32 = 0.8;
/// Cells along a side of the window, direction bins of each, and cell size in scales.
const CELLS: usize = 4;
const BINS: usize = 8;
const CELL: f32 = 3.0;
/// Upper bound of one bin's contribution to a descriptor.
const MOST: f32 = 0.2;
/// Maximum number of points per frame; those with the most contrast are kept.
const POINTS: usize = 1200;
/// Standard deviation of a point along each axis, pixels. Between images 42° apart, half of the points lay
/// within 0.12 pixels of their epipolar lines.
const NOISE: f32 = 0.3;
/// Ratio test: largest ratio of the angle to the best match and the angle to the second-best.
const RATIO: f32 = 0.85;

/// The engine's own keypoint source; it runs on the CPU.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sift;

impl FeatureSource for Sift {
    fn features(&mut self, _number: usize, frame: &Image) -> Result<Features> {
        Ok(sift(frame))
    }
}

/// Keypoints of a frame with one or three channels; empty where it is smaller than 16 pixels or has no
/// content.
pub fn sift(frame: &Image) -> Features {
    let mut found = Features { noise: NOISE, rule: Rule::Ratio(RATIO), ..Features::default() };
    let small = frame.width.max(frame.height) <= SMALL;
    let (mut picture, mut blur) = (Plane::of(frame), FILMED);
    if small {
        (picture, blur) = (picture.doubled(), 2.0 * FILMED);
    }
    let scale = if small { 0.5 } else { 1.0 };
    let mut points: Vec<(f32, DVec2, Vec<f32>)> = Vec::new();
    let mut octave_scale: f64 = scale;
    picture = picture.blurred((FIRST * FIRST - blur * blur).sqrt());
    while picture.width.min(picture.height) >= LEAST_SIDE {
        let octave = Octave::new(picture);
        for point in octave.extrema() {
            let level = &octave.levels[point.level];
            for direction in level.directions(&point) {
                let at = DVec2::new(f64::from(point.x), f64::from(point.y)) + 0.5;
                let described = level.descriptor(&point, direction);
                points.push((point.contrast, at * octave_scale, described));
            }
        }
        picture = octave.levels[SCALES].halved();
        octave_scale *= 2.0;
    }
    // The sort is stable: equal points keep their order.
    points.sort_by(|a, b| b.0.total_cmp(&a.0));
    for (_, pixel, described) in points.into_iter().take(POINTS) {
        found.pixels.push(pixel);
        found.descriptors.extend(described);
    }
    found
}

/// A one-channel image.
#[derive(Clone)]
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

/// An extremum over position and scale.
struct Point {
    /// Index of the octave's image with the nearest blur.
    level: usize,
    /// Position in the octave's pixels, with the first pixel's centre at 0.
    x: f32,
    y: f32,
    /// Blur in the octave's pixels.
    blur: f32,
    contrast: f32,
}

impl Plane {
    fn of(frame: &Image) -> Plane {
        let channels = frame.channels as usize;
        let value = |pixel: &[f32]| match pixel {
            [r, g, b, ..] => 0.299 * r + 0.587 * g + 0.114 * b,
            _ => pixel[0],
        };
        let values = frame.pixels.chunks_exact(channels.max(1)).map(value);
        // Values that are not finite count as no content.
        let values = values.map(|v| if v.is_finite() { v } else { 0.0 }).collect();
        Plane { width: frame.width as usize, height: frame.height as usize, values }
    }

    fn at(&self, x: usize, y: usize) -> f32 {
        self.values[y * self.width + x]
    }

    /// Doubles the size bilinearly, keeping pixel centres in place.
    fn doubled(&self) -> Plane {
        let (width, height) = (2 * self.width, 2 * self.height);
        let place = |i: usize, side: usize| {
            let at = (0.5 * i as f32 - 0.25).clamp(0.0, side.saturating_sub(1) as f32);
            let low = at as usize;
            (low, (low + 1).min(side - 1), at - low as f32)
        };
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            let (above, below, v) = place(y, self.height);
            for x in 0..width {
                let (left, right, u) = place(x, self.width);
                let row = |y: usize| (1.0 - u) * self.at(left, y) + u * self.at(right, y);
                values.push((1.0 - v) * row(above) + v * row(below));
            }
        }
        Plane { width, height, values }
    }

    /// Halves the size with the mean of four pixels, which keeps pixel centres in place.
    fn halved(&self) -> Plane {
        let (width, height) = (self.width / 2, self.height / 2);
        let mean = |x: usize, y: usize| {
            let rows = [2 * y, 2 * y + 1].map(|y| self.at(2 * x, y) + self.at(2 * x + 1, y));
            0.25 * (rows[0] + rows[1])
        };
        let values = (0..height).flat_map(|y| (0..width).map(move |x| mean(x, y))).collect();
        Plane { width, height, values }
    }

    /// Gaussian blur; border values are repeated outside.
    fn blurred(&self, deviation: f32) -> Plane {
        let radius = (4.0 * deviation).ceil() as usize;
        let weight = |i: usize| (-0.5 * (i as f32 / deviation).powi(2)).exp();
        let sum: f32 = (0..=radius).map(|i| if i == 0 { 1.0 } else { 2.0 * weight(i) }).sum();
        let weights: Vec<f32> = (0..=radius).map(|i| weight(i) / sum).collect();
        let (width, height) = (self.width, self.height);
        let mut across = vec![0.0f32; width * height];
        let mut padded = vec![0.0f32; width + 2 * radius];
        for y in 0..height {
            let row = &self.values[y * width..][..width];
            padded[..radius].fill(row[0]);
            padded[radius..radius + width].copy_from_slice(row);
            padded[radius + width..].fill(row[width - 1]);
            let out = &mut across[y * width..][..width];
            for (i, w) in weights.iter().enumerate() {
                for (x, out) in out.iter_mut().enumerate() {
                    let pair = padded[x + radius - i] + padded[x + radius + i];
                    *out += w * if i == 0 { 0.5 * pair } else { pair };
                }
            }
        }
        let mut values = vec![0.0f32; width * height];
        for y in 0..height {
            let out = &mut values[y * width..][..width];
            for (i, w) in weights.iter().enumerate() {
                let rows = [y.saturating_sub(i), (y + i).min(height - 1)];
                let [above, below] = rows.map(|row| &across[row * width..][..width]);
                for ((out, a), b) in out.iter_mut().zip(above).zip(below) {
                    *out += w * if i == 0 { *a } else { a + b };
                }
            }
        }
        Plane { width, height, values }
    }

    fn gradient(&self, x: usize, y: usize) -> (f32, f32) {
        (self.at(x + 1, y) - self.at(x - 1, y), self.at(x, y + 1) - self.at(x, y - 1))
    }

    /// The pixels within a radius of a point that have neighbours on all sides.
    fn about(&self, point: &Point, radius: f32) -> impl Iterator<Item = (usize, usize)> + use<> {
        let range = |at: f32, side: usize| {
            let low = (at - radius).round().max(1.0) as usize;
            low..((at + radius).round().max(0.0) as usize + 1).min(side.saturating_sub(1))
        };
        let (xs, ys) = (range(point.x, self.width), range(point.y, self.height));
        ys.flat_map(move |y| xs.clone().map(move |x| (x, y)))
    }

    /// Dominant gradient directions around a point, radians.
    fn directions(&self, point: &Point) -> Vec<f32> {
        let deviation = DIRECTION_REACH * point.blur;
        let mut histogram = [0.0f32; DIRECTIONS];
        for (x, y) in self.about(point, 3.0 * deviation) {
            let (dx, dy) = (x as f32 - point.x, y as f32 - point.y);
            let (gx, gy) = self.gradient(x, y);
            let near = (-0.5 * (dx * dx + dy * dy) / (deviation * deviation)).exp();
            let bin = gy.atan2(gx).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
            histogram[bin.round() as usize % DIRECTIONS] += near * gx.hypot(gy);
        }
        let around = |h: &[f32; DIRECTIONS], i: usize, by: usize| h[(i + by) % DIRECTIONS];
        for _ in 0..2 {
            let before = histogram;
            for (i, value) in histogram.iter_mut().enumerate() {
                let sides = around(&before, i, DIRECTIONS - 1) + around(&before, i, 1);
                *value = 0.25 * sides + 0.5 * before[i];
            }
        }
        let highest = histogram.iter().copied().fold(0.0, f32::max);
        let peak = |i: usize| {
            let (left, right) = (around(&histogram, i, DIRECTIONS - 1), around(&histogram, i, 1));
            let here = histogram[i];
            let is_peak = here > left && here >= right && here >= PEAK * highest;
            let shift = 0.5 * (left - right) / (left - 2.0 * here + right).min(-f32::MIN_POSITIVE);
            is_peak.then(|| (i as f32 + shift) / DIRECTIONS as f32 * TAU)
        };
        (0..DIRECTIONS).filter_map(peak).collect()
    }

    /// Square roots of the normalised gradient histograms of the cells around a point.
    fn descriptor(&self, point: &Point, direction: f32) -> Vec<f32> {
        let cell = CELL * point.blur;
        let (sin, cos) = direction.sin_cos();
        let half = CELLS as f32 / 2.0;
        let radius = cell * std::f32::consts::SQRT_2 * (half + 0.5);
        let mut cells = [[[0.0f32; BINS]; CELLS]; CELLS];
        for (x, y) in self.about(point, radius) {
            let (dx, dy) = (x as f32 - point.x, y as f32 - point.y);
            // In cells, along the point's own axes, from the centre of the window.
            let u = (cos * dx + sin * dy) / cell;
            let v = (cos * dy - sin * dx) / cell;
            let (column, row) = (u + half - 0.5, v + half - 0.5);
            let within = -1.0..CELLS as f32;
            if !(within.contains(&column) && within.contains(&row)) {
                continue;
            }
            let (gx, gy) = self.gradient(x, y);
            let near = (-0.5 * (u * u + v * v) / (half * half)).exp();
            let bin = (gy.atan2(gx) - direction).rem_euclid(TAU) / TAU * BINS as f32;
            let strength = near * gx.hypot(gy);
            // Trilinear distribution over adjacent cells and directions.
            let [(c, cu), (r, rv), (b, bw)] = [column, row, bin].map(|at| {
                let low = at.floor();
                (low as i32, at - low)
            });
            for (row, share) in [(r, 1.0 - rv), (r + 1, rv)] {
                for (column, shared) in [(c, 1.0 - cu), (c + 1, cu)] {
                    let side = 0..CELLS as i32;
                    if !(side.contains(&row) && side.contains(&column)) {
                        continue;
                    }
                    let bins = &mut cells[row as usize][column as usize];
                    let part = strength * share * shared;
                    bins[b as usize % BINS] += part * (1.0 - bw);
                    bins[(b as usize + 1) % BINS] += part * bw;
                }
            }
        }
        let mut values = cells.as_flattened().as_flattened().to_vec();
        let length = values.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
        values.iter_mut().for_each(|v| *v = (*v / length).min(MOST));
        let sum = values.iter().sum::<f32>().max(f32::MIN_POSITIVE);
        values.iter_mut().for_each(|v| *v = (*v / sum).sqrt());
        values
    }
}

/// Images of one size with increasing blur, and the differences of neighbouring ones.
struct Octave {
    levels: Vec<Plane>,
    differences: Vec<Plane>,
}

impl Octave {
    /// Builds the octave from an image with the first blur.
    fn new(first: Plane) -> Octave {
        let factor = 2f32.powf(1.0 / SCALES as f32);
        let mut levels = vec![first];
        for k in 1..SCALES + 3 {
            let before = FIRST * factor.powi(k as i32 - 1);
            let more = before * (factor * factor - 1.0).sqrt();
            levels.push(levels[k - 1].blurred(more));
        }
        let difference = |pair: &[Plane]| {
            let values = pair[0].values.iter().zip(&pair[1].values).map(|(a, b)| b - a).collect();
            Plane { values, ..pair[0] }
        };
        let differences = levels.windows(2).map(difference).collect();
        Octave { levels, differences }
    }

    fn extrema(&self) -> Vec<Point> {
        let (width, height) = (self.levels[0].width, self.levels[0].height);
        let mut found = Vec::new();
        for level in 1..=SCALES {
            for y in 1..height - 1 {
                for x in 1..width - 1 {
                    let value = self.differences[level].at(x, y);
                    // Refinement may still raise the value.
                    if value.abs() > 0.8 * CONTRAST && self.is_extreme(level, x, y) {
                        found.extend(self.refined(level, x, y));
                    }
                }
            }
        }
        found
    }

    fn is_extreme(&self, level: usize, x: usize, y: usize) -> bool {
        let value = self.differences[level].at(x, y);
        let around = (level - 1..=level + 1).flat_map(|l| {
            (y - 1..=y + 1).flat_map(move |v| (x - 1..=x + 1).map(move |u| (l, u, v)))
        });
        let mut others = around.filter(|other| *other != (level, x, y));
        let at = |(l, u, v): (usize, usize, usize)| self.differences[l].at(u, v);
        match value > 0.0 {
            true => others.all(|other| at(other) < value),
            false => others.all(|other| at(other) > value),
        }
    }

    /// Extremum of the quadric through an extremal pixel's neighbours; `None` where it has too little
    /// contrast, lies on an edge, or moves away.
    fn refined(&self, mut level: usize, mut x: usize, mut y: usize) -> Option<Point> {
        let (width, height) = (self.levels[0].width, self.levels[0].height);
        for _ in 0..STEPS {
            let at = |dx: i32, dy: i32, dl: i32| {
                let place = |at: usize, by: i32| at.saturating_add_signed(by as isize);
                self.differences[place(level, dl)].at(place(x, dx), place(y, dy))
            };
            let here = at(0, 0, 0);
            let half = |a: f32, b: f32| 0.5 * (a - b);
            let slope = Vec3::new(
                half(at(1, 0, 0), at(-1, 0, 0)),
                half(at(0, 1, 0), at(0, -1, 0)),
                half(at(0, 0, 1), at(0, 0, -1)),
            );
            let bend = |a: f32, b: f32| a - 2.0 * here + b;
            let twist = |a: f32, b: f32, c: f32, d: f32| 0.25 * (a - b - c + d);
            let xx = bend(at(1, 0, 0), at(-1, 0, 0));
            let yy = bend(at(0, 1, 0), at(0, -1, 0));
            let ll = bend(at(0, 0, 1), at(0, 0, -1));
            let xy = twist(at(1, 1, 0), at(-1, 1, 0), at(1, -1, 0), at(-1, -1, 0));
            let xl = twist(at(1, 0, 1), at(-1, 0, 1), at(1, 0, -1), at(-1, 0, -1));
            let yl = twist(at(0, 1, 1), at(0, -1, 1), at(0, 1, -1), at(0, -1, -1));
            let quadric = Mat3::from_cols(
                Vec3::new(xx, xy, xl),
                Vec3::new(xy, yy, yl),
                Vec3::new(xl, yl, ll),
            );
            let offset = -(quadric.inverse() * slope);
            if !offset.is_finite() {
                return None;
            }
            if offset.abs().max_element() < 0.5 {
                let contrast = (here + 0.5 * slope.dot(offset)).abs();
                let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
                let on_edge = determinant <= 0.0
                    || trace * trace * EDGE >= (EDGE + 1.0).powi(2) * determinant;
                return (contrast >= CONTRAST && !on_edge).then(|| {
                    let scale = level as f32 + offset.z;
                    Point {
                        level: (scale.round() as usize).clamp(1, SCALES),
                        x: x as f32 + offset.x,
                        y: y as f32 + offset.y,
                        blur: FIRST * 2f32.powf(scale / SCALES as f32),
                        contrast,
                    }
                });
            }
            let step = |at: usize, by: f32, most: usize| {
                let to = at as f32 + by.round();
                (1.0..=most as f32).contains(&to).then_some(to as usize)
            };
            x = step(x, offset.x, width - 2)?;
            y = step(y, offset.y, height - 2)?;
            level = step(level, offset.z, SCALES)?;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observe::features::mutual;
    use glam::DMat2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Blobs of all sizes, seen in an image whose pixels are mapped to them by `place`.
    fn picture(place: impl Fn(DVec2) -> DVec2) -> Image {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let blobs: Vec<(DVec2, f64, f64)> = (0..700)
            .map(|_| {
                let middle = [420.0, 340.0].map(|side| rng.random_range(-60.0..side - 60.0));
                (middle.into(), rng.random_range(2.0..8.0), rng.random_range(-0.4..0.4))
            })
            .collect();
        let light = |at: DVec2| {
            let of = |(middle, size, light): &(DVec2, f64, f64)| {
                light * (-0.5 * (at - *middle).length_squared() / (size * size)).exp()
            };
            (0.5 + blobs.iter().map(of).sum::<f64>()).clamp(0.0, 1.0) as f32
        };
        let (width, height) = (300, 220);
        let at = |i: u32| DVec2::new(f64::from(i % width), f64::from(i / width)) + 0.5;
        let pixels = (0..width * height).map(|i| light(place(at(i)))).collect();
        Image { width, height, channels: 1, pixels }
    }

    #[test]
    fn points_are_found_again_turned_and_smaller() {
        let first = sift(&picture(|at| at));
        assert!(first.pixels.len() > 100, "{}", first.pixels.len());
        let lengths = first.descriptors.chunks_exact(CELLS * CELLS * BINS);
        assert_eq!(lengths.len(), first.pixels.len());
        for one in lengths {
            assert!((one.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-4);
        }
        let middle = DVec2::new(150.0, 110.0);
        for (degrees, factor) in [(10.0f64, 1.0), (70.0, 1.0), (40.0, 1.6), (200.0, 0.8)] {
            let turn = DMat2::from_angle(degrees.to_radians()) * factor;
            let second = sift(&picture(|at| middle + turn * (at - middle)));
            let matches = mutual(&first, &second);
            let off = |(i, j): &(usize, usize)| {
                first.pixels[*i].distance(middle + turn * (second.pixels[*j] - middle))
            };
            let right = matches.iter().filter(|found| off(found) < 1.0).count();
            assert!(
                matches.len() >= 40 && right * 20 >= matches.len() * 19,
                "{degrees}°, ×{factor}: {right} of {} are right",
                matches.len()
            );
            let mut all: Vec<f64> = matches.iter().map(off).collect();
            all.sort_by(f64::total_cmp);
            assert!(all[all.len() / 2] < 0.2, "half within {} pixels", all[all.len() / 2]);
        }
    }

    #[test]
    fn where_nothing_is_there_is_no_point() {
        for (width, height) in [(1, 1), (3, 200), (64, 64)] {
            assert!(sift(&Image::new(width, height, 3)).pixels.is_empty());
        }
        let mut edge = Image::new(64, 64, 1);
        (0..64).for_each(|y| (20..64).for_each(|x| edge.at_mut(x, y)[0] = 1.0));
        assert!(sift(&edge).pixels.is_empty(), "an edge has no place along itself");
        edge.pixels.fill(f32::NAN);
        assert!(sift(&edge).pixels.is_empty());
    }
}
