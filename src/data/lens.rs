//! Lenses, and undistortion of images to a pinhole camera.
//!
//! Distortion is removed once, when an image is loaded or its lens is estimated; all later stages work on
//! pinhole images.

use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Distortion;
use super::distortion::reach;
use crate::types::{Image, Intrinsics};

/// Intrinsics of a camera with its lens distortion.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Focal lengths, principal point, image size.
    pub intrinsics: Intrinsics,
    /// The lens distortion.
    pub distortion: Distortion,
}

/// Maximum factor by which the pinhole image may be cropped relative to the lens's image.
const MOST_CROPPED: f64 = 4.0;
/// Number of sample positions along each side of an image.
const ALONG: u32 = 64;

impl Lens {
    /// Maps a pixel of a pinhole image to the lens's image.
    pub fn distort_pixel(&self, pinhole: &Intrinsics, pixel: DVec2) -> DVec2 {
        let plane = pinhole.ray(pixel).truncate();
        self.intrinsics.project(self.distortion.distort(plane).extend(1.0))
    }

    /// Maps a pixel of the lens's image to a pinhole image; `None` where the distortion folds over.
    pub fn undistort_pixel(&self, pinhole: &Intrinsics, pixel: DVec2) -> Option<DVec2> {
        let plane = self.distortion.undistort(self.intrinsics.ray(pixel).truncate())?;
        Some(pinhole.project(plane.extend(1.0)))
    }

    /// The pinhole camera of the same size and principal point whose image is fully covered by the lens's,
    /// with the shortest focal length that is not below the lens's.
    pub fn full_pinhole(&self) -> Intrinsics {
        let k = self.intrinsics;
        let size = DVec2::new(f64::from(k.width), f64::from(k.height));
        let zoomed = |zoom: f64| Intrinsics { fx: zoom * k.fx, fy: zoom * k.fy, ..k };
        let inside = |zoom: f64| {
            let pinhole = zoomed(zoom);
            let fold = self.distortion.fold(reach(&pinhole, size));
            (0..=ALONG).all(|i| {
                let t = f64::from(i) / f64::from(ALONG);
                let edges = [(t, 0.0), (t, 1.0), (0.0, t), (1.0, t)];
                edges.iter().all(|(x, y)| {
                    let pixel = DVec2::new(*x, *y) * size;
                    let at = self.distort_pixel(&pinhole, pixel);
                    let unfolded = pinhole.ray(pixel).truncate().length_squared() <= fold;
                    unfolded && at.cmpge(DVec2::splat(-1e-6)).all() && at.cmple(size + 1e-6).all()
                })
            })
        };
        if inside(1.0) {
            return k;
        }
        let (mut low, mut high) = (1.0, MOST_CROPPED);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if inside(middle) { high = middle } else { low = middle }
        }
        zoomed(high)
    }

    /// The lens for images of another size.
    pub fn resized(&self, width: u32, height: u32) -> Lens {
        Lens { intrinsics: self.intrinsics.resized(width, height), ..*self }
    }

    /// Resamples an image of the lens to a pinhole image of the same size, bilinearly. The second image
    /// (one channel) is 1 where a pixel's source lies inside the image and 0 elsewhere; `None` where all
    /// sources are inside.
    pub fn undistort(&self, image: &Image, pinhole: &Intrinsics) -> (Image, Option<Image>) {
        let (width, height) = (image.width as usize, image.height as usize);
        let channels = image.channels as usize;
        let size = DVec2::new(width as f64, height as f64);
        let fold = self.distortion.fold(reach(pinhole, size));
        let mut out = Image::new(image.width, image.height, image.channels);
        let mut valid = Image::new(image.width, image.height, 1);
        out.pixels
            .par_chunks_mut((width * channels).max(1))
            .zip(valid.pixels.par_chunks_mut(width.max(1)))
            .enumerate()
            .for_each(|(y, (row, valid))| {
                for x in 0..width {
                    let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    if pinhole.ray(pixel).truncate().length_squared() > fold {
                        continue;
                    }
                    let source = self.distort_pixel(pinhole, pixel);
                    let values = &mut row[x * channels..(x + 1) * channels];
                    if sample(image, source, values) {
                        valid[x] = 1.0;
                    }
                }
            });
        let whole = valid.pixels.iter().all(|&v| v == 1.0);
        (out, (!whole).then_some(valid))
    }
}

impl Lens {
    /// Converts flow between images of the lens to flow between pinhole images: the first two channels are
    /// vectors in pixels; further channels are resampled along. NaN where the lens's flow has no target.
    pub fn undistort_flow(&self, flow: &Image, pinhole: &Intrinsics) -> Image {
        let (width, channels) = (flow.width as usize, flow.channels as usize);
        let mut out = Image::new(flow.width, flow.height, flow.channels);
        out.pixels.par_chunks_mut(channels.max(1)).enumerate().for_each(|(i, values)| {
            let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            let distorted = self.distort_pixel(pinhole, pixel);
            let there = sample(flow, distorted, values).then(|| {
                let by = DVec2::new(f64::from(values[0]), f64::from(values[1]));
                self.undistort_pixel(pinhole, distorted + by)
            });
            match there.flatten() {
                Some(there) => {
                    let by = (there - pixel).as_vec2();
                    values[..2].copy_from_slice(&[by.x, by.y]);
                }
                None => values.fill(f32::NAN),
            }
        });
        out
    }
}

/// Samples bilinearly at a pixel position (centres at +0.5); in the outermost half pixel the edge value is
/// repeated. Returns false and writes nothing where the position lies outside the image.
fn sample(image: &Image, at: DVec2, out: &mut [f32]) -> bool {
    let (width, height) = (image.width as f64, image.height as f64);
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x <= width && at.y <= height) {
        return false;
    }
    let x = (at.x - 0.5).clamp(0.0, width - 1.0);
    let y = (at.y - 0.5).clamp(0.0, height - 1.0);
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = ((x - x0) as f32, (y - y0) as f32);
    let (x0, y0) = (x0 as u32, y0 as u32);
    let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
    let (a, b) = (image.at(x0, y0), image.at(x1, y0));
    let (c, d) = (image.at(x0, y1), image.at(x1, y1));
    for (i, value) in out.iter_mut().enumerate() {
        let upper = a[i] + (b[i] - a[i]) * fx;
        let lower = c[i] + (d[i] - c[i]) * fx;
        *value = upper + (lower - upper) * fy;
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lens(k1: f64) -> Lens {
        let distortion = Distortion { radial: [k1, 0.0, 0.0, 0.0], ..Default::default() };
        Lens { intrinsics: Intrinsics::centred(150.0, 160, 120), distortion }
    }

    #[test]
    fn a_pinholes_picture_is_full_pinhole() {
        // Barrel distortion adds surroundings, so that the full pinhole image is covered.
        assert_eq!(lens(-0.1).full_pinhole(), lens(-0.1).intrinsics);
        let distorted = lens(0.1);
        let pinhole = distorted.full_pinhole();
        let zoom = pinhole.fx / 150.0;
        assert!(zoom > 1.01 && zoom < 1.1, "{zoom}");
        let white = Image { pixels: vec![1.0; 160 * 120], ..Image::new(160, 120, 1) };
        let (picture, valid) = distorted.undistort(&white, &pinhole);
        assert!(valid.is_none() && picture.pixels.iter().all(|p| *p == 1.0));
        assert!(distorted.undistort(&white, &distorted.intrinsics).1.is_some());
    }

    #[test]
    fn flow_is_undistorted() {
        // A constant pinhole flow, as the lens sees it.
        let lens = lens(-0.15);
        let pinhole = lens.full_pinhole();
        let by = DVec2::new(6.0, -3.0);
        let mut flow = Image::new(160, 120, 3);
        for y in 0..120 {
            for x in 0..160 {
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let from = lens.undistort_pixel(&pinhole, pixel).unwrap();
                let moved = (lens.distort_pixel(&pinhole, from + by) - pixel).as_vec2();
                flow.at_mut(x, y).copy_from_slice(&[moved.x, moved.y, 0.5]);
            }
        }
        let undistorted = lens.undistort_flow(&flow, &pinhole);
        for (x, y) in [(2, 2), (80, 60), (150, 30), (40, 110)] {
            let [u, v, kept] = undistorted.at(x, y) else { panic!("three channels") };
            assert!((f64::from(*u) - by.x).hypot(f64::from(*v) - by.y) < 2e-3, "{u} {v}");
            assert_eq!(*kept, 0.5);
        }
    }

    #[test]
    fn distorting_and_undistorting_are_each_others_inverse() {
        let radial = [0.1, -0.05, 0.01, 0.0];
        let distortion = Distortion { radial, tangential: [0.002, -0.003] };
        for lens in [lens(-0.2), lens(0.15), Lens { distortion, ..lens(0.0) }] {
            let pinhole = lens.full_pinhole();
            for pixel in [DVec2::new(3.0, 4.0), DVec2::new(80.0, 60.0), DVec2::new(155.0, 20.0)] {
                let back =
                    lens.undistort_pixel(&pinhole, lens.distort_pixel(&pinhole, pixel)).unwrap();
                assert!(back.distance(pixel) < 1e-9, "{pixel} {back}");
            }
        }
        // At k1 = −2 the mapping folds over at 0.41 in the plane of unit depth, which maps to 0.27.
        let k = Intrinsics::centred(150.0, 160, 120);
        assert!(lens(-2.0).undistort_pixel(&k, DVec2::new(80.0 + 0.4 * 150.0, 60.0)).is_none());
        assert!(lens(-2.0).undistort_pixel(&k, DVec2::new(80.0 + 0.2 * 150.0, 60.0)).is_some());
    }
}
