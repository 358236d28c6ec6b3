//! Writer of `.splatv`, the format of the splaTV players for dynamic Gaussians.
//!
//! A `u32` 0x674b, the length of a JSON text, the text, and a texture of RGBA32UI, 4096 wide, four
//! texels (64 bytes) per Gaussian: position (3 f32); quaternion (w, x, y, z) and scales (halves;
//! one unused); red, green, blue, opacity (bytes); the coefficients of t, t² and t³ of the position
//! (9 halves, one unused); the quaternion's coefficient of t (4 halves); a time c and a width s
//! (halves). With t = time − c, the position is a cubic polynomial of t, the quaternion is linear
//! in t and normalised, and the opacity is multiplied by exp(−(t/s)²). The colour is that of the
//! constant harmonic. The axes are those of a PLY. The JSON text lists the texture's size and
//! initial cameras.
//!
//! A scene's motion is fitted by least squares over the times at which a Gaussian is present:
//! cubics for positions, lines for quaternions. A Gaussian that is not present all the time gets a
//! width that halves its opacity at the ends of its presence. [`Fit`] reports the error of the fit.
//!
//! Source: github.com/antimatter15/splaTV, hybrid.js of March 2024.

use std::io::Write;
use std::path::Path;

use glam::{DMat4, DVec4};
use half::f16;
use serde_json::{Value, json};

use super::{Scene, packing};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result, io};

/// The first word of a file.
const MAGIC: u32 = 0x674b;
/// Texels per row.
const WIDTH: usize = 4096;
/// Bytes per Gaussian.
const SIZE: usize = 64;
/// Maximum number of rows: the texture size that WebGL supports on most machines.
const MOST_ROWS: usize = 16_384;
/// A width s that leaves opacities unchanged.
const ALWAYS: f64 = 30_000.0;
/// Maximum number of listed cameras.
const CAMERAS: usize = 30;
/// A Gaussian with less than this fraction of its opacity counts as absent.
const FAINT: f32 = 0.02;

/// The error of the fitted motion against the scene's, over the dynamic Gaussians and the times at
/// which they are present.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fit {
    /// Number of dynamic Gaussians.
    pub moving: usize,
    /// Root mean square of the position error, scene units.
    pub position_rmse: f64,
    /// Largest position error, scene units.
    pub position_worst: f64,
    /// Root mean square distance of the positions from their temporal mean, as a reference for the
    /// error, scene units.
    pub position_spread: f64,
    /// Mean rotation error, degrees.
    pub rotation_mean: f64,
}

/// Writes a scene, atomically by rename. `posed` returns its Gaussians at a time; it is called for
/// each of the ascending `times` in order.
///
/// # Errors
/// [`Error::Input`] without Gaussians or times, or for more Gaussians than a texture holds;
/// [`Error::Shape`] if arrays differ in length; [`Error::Io`]; the errors of `posed`.
pub fn write(
    path: impl AsRef<Path>,
    scene: &Scene,
    times: &[f64],
    mut posed: impl FnMut(f64) -> Result<Gaussians>,
) -> Result<Fit> {
    let g = &scene.gaussians;
    super::file::check_lengths(g)?;
    let n = g.len();
    let rows = (4 * n).div_ceil(WIDTH);
    if n == 0 || times.is_empty() {
        return Err(Error::Input(".splatv needs Gaussians, and times to fit motion at".into()));
    }
    if rows > MOST_ROWS {
        let most = MOST_ROWS * WIDTH / 4;
        return Err(Error::Input(format!("{n} Gaussians are more than the {most} of a .splatv")));
    }
    let moves = scene.moves();
    let movers: Vec<usize> = (0..n).filter(|&i| moves && g.motion_logits[i] > 0.0).collect();
    let size = movers.len() as u64 * times.len() as u64 * size_of::<Sample>() as u64;
    io::check_memory(size, "fitting the scene's motion")?;
    let mut samples = vec![Vec::with_capacity(times.len()); movers.len()];
    for &time in times.iter().filter(|_| !movers.is_empty()) {
        let at = posed(time)?;
        for (samples, &i) in samples.iter_mut().zip(&movers) {
            samples.push(Sample {
                position: at.positions[i],
                rotation: packing::unit(at.rotations[i]),
                opacity: packing::opacity(at.opacity_logits[i]),
            });
        }
    }
    let mut tracks: Vec<Track> = (0..n).map(|i| Track::still(g, i)).collect();
    let mut sums = Sums::default();
    for (samples, &i) in samples.iter_mut().zip(&movers) {
        tracks[i] = Track::fitted(times, samples, tracks[i].opacity);
        sums.add(&tracks[i], times, samples);
    }
    let text = json!([{
        "type": "splat",
        "size": rows * WIDTH * 16,
        "texwidth": WIDTH,
        "texheight": rows,
        "cameras": cameras(scene),
    }])
    .to_string();
    let bands = sh_coefficients(g.sh_degree);
    // The most visible Gaussians come first.
    let weight = |i: &usize| g.log_scales[*i].iter().sum::<f32>() + tracks[*i].opacity.ln();
    let weights: Vec<f32> = (0..n).map(|i| weight(&i)).collect();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]).then(a.cmp(&b)));
    io::write_atomically(path, |sink| {
        sink.write_all(&MAGIC.to_le_bytes())?;
        sink.write_all(&(text.len() as u32).to_le_bytes())?;
        sink.write_all(text.as_bytes())?;
        for &i in &order {
            let colour = packing::colour(g.sh[i * bands]).map(packing::byte);
            sink.write_all(&tracks[i].texels(g.log_scales[i], colour))?;
        }
        sink.write_all(&vec![0; (rows * WIDTH * 16) - n * SIZE])
    })?;
    Ok(sums.fit(movers.len()))
}

/// The state of a Gaussian at one time.
#[derive(Clone, Copy, Debug)]
struct Sample {
    position: [f32; 3],
    rotation: [f32; 4],
    opacity: f32,
}

/// A Gaussian's motion in the format's parameters.
#[derive(Clone, Copy, Debug)]
struct Track {
    centre: f64,
    width: f64,
    opacity: f32,
    /// Coefficients of 1, t, t², t³.
    position: [DVec4; 3],
    /// Coefficients of 1 and t.
    rotation: [[f64; 2]; 4],
}

impl Track {
    fn still(g: &Gaussians, i: usize) -> Track {
        Track {
            centre: 0.5,
            width: ALWAYS,
            opacity: packing::opacity(g.opacity_logits[i]),
            position: g.positions[i].map(|v| DVec4::new(f64::from(v), 0.0, 0.0, 0.0)),
            rotation: packing::unit(g.rotations[i]).map(|v| [f64::from(v), 0.0]),
        }
    }

    /// Flips the samples' quaternions into one hemisphere.
    fn fitted(times: &[f64], samples: &mut [Sample], opacity: f32) -> Track {
        for k in 1..samples.len() {
            let before = samples[k - 1].rotation;
            let dot: f32 = before.iter().zip(&samples[k].rotation).map(|(a, b)| a * b).sum();
            if dot < 0.0 {
                samples[k].rotation = samples[k].rotation.map(|v| -v);
            }
        }
        let is_there = |sample: &Sample| sample.opacity > FAINT * opacity;
        let there: Vec<(f64, &Sample)> =
            times.iter().copied().zip(&*samples).filter(|(_, sample)| is_there(sample)).collect();
        let (Some((first, _)), Some((last, _))) = (there.first(), there.last()) else {
            // The Gaussian is never visible.
            let still = samples[0];
            return Track {
                centre: 0.5,
                width: ALWAYS,
                opacity: 0.0,
                position: still.position.map(|v| DVec4::new(f64::from(v), 0.0, 0.0, 0.0)),
                rotation: still.rotation.map(|v| [f64::from(v), 0.0]),
            };
        };
        let always = there.len() == samples.len();
        let (centre, width) = match always {
            true => (0.5, ALWAYS),
            false => {
                // The interval is extended by half a step at either end, where the opacity falls to
                // one half.
                let step = 1.0 / (times.len().max(2) - 1) as f64;
                (0.5 * (first + last), 0.5 * (last - first + step) / 2f64.ln().sqrt())
            }
        };
        let moments: Vec<f64> = there.iter().map(|(time, _)| time - centre).collect();
        let (cubic, line) = (Fitter::new(&moments, 4), Fitter::new(&moments, 2));
        let of = |fitter: &Fitter, value: &dyn Fn(&Sample) -> f32| {
            fitter.coefficients(there.iter().map(|(_, sample)| f64::from(value(sample))))
        };
        Track {
            centre,
            width,
            opacity,
            position: std::array::from_fn(|c| of(&cubic, &|s| s.position[c])),
            rotation: std::array::from_fn(|c| {
                let line = of(&line, &|s| s.rotation[c]);
                [line.x, line.y]
            }),
        }
    }

    fn position_at(&self, time: f64) -> [f64; 3] {
        let t = time - self.centre;
        self.position.map(|c| c.dot(DVec4::new(1.0, t, t * t, t * t * t)))
    }

    fn rotation_at(&self, time: f64) -> [f64; 4] {
        let q = self.rotation.map(|[a, b]| a + b * (time - self.centre));
        let length = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
        q.map(|v| v / length)
    }

    fn texels(&self, log_scales: [f32; 3], [red, green, blue]: [u8; 3]) -> [u8; SIZE] {
        let mut bytes = Vec::with_capacity(SIZE);
        let half = |v: f64| {
            let most = f64::from(f16::MAX);
            f16::from_f64(v.clamp(-most, most)).to_le_bytes()
        };
        for c in self.position {
            bytes.extend((c.x as f32).to_le_bytes());
        }
        let [x, y, z] = self.position;
        bytes.extend(self.rotation.map(|q| half(q[0])).as_flattened());
        bytes.extend(log_scales.map(|s| half(f64::from(s.exp()))).as_flattened());
        bytes.extend(half(0.0));
        bytes.extend([red, green, blue, packing::byte(self.opacity)]);
        let motion = [x.y, y.y, z.y, x.z, y.z, z.z, x.w, y.w, z.w, 0.0];
        bytes.extend(motion.map(half).as_flattened());
        bytes.extend(self.rotation.map(|q| half(q[1])).as_flattened());
        bytes.extend([half(self.centre), half(self.width)].as_flattened());
        bytes.try_into().expect("64 bytes")
    }
}

/// Least-squares fits of polynomials at fixed times.
struct Fitter<'a> {
    moments: &'a [f64],
    parameters: usize,
    inverse: DMat4,
}

impl Fitter<'_> {
    /// A fitter of polynomials with at most `most` coefficients, and no more than there are times.
    fn new(moments: &[f64], most: usize) -> Fitter<'_> {
        let parameters = most.min(moments.len());
        let mut normal = DMat4::IDENTITY;
        for a in 0..parameters {
            for b in 0..parameters {
                let sum: f64 = moments.iter().map(|t| t.powi((a + b) as i32)).sum();
                // The small term only keeps the matrix regular.
                normal.col_mut(a)[b] = if a == b { sum + 1e-12 } else { sum };
            }
        }
        Fitter { moments, parameters, inverse: normal.inverse() }
    }

    fn coefficients(&self, values: impl Iterator<Item = f64>) -> DVec4 {
        let mut right = DVec4::ZERO;
        for (t, value) in self.moments.iter().zip(values) {
            for a in 0..self.parameters {
                right[a] += t.powi(a as i32) * value;
            }
        }
        self.inverse * right
    }
}

/// Accumulated sums for [`Fit`].
#[derive(Default)]
struct Sums {
    count: usize,
    position: f64,
    spread: f64,
    worst: f64,
    angle: f64,
}

impl Sums {
    fn add(&mut self, track: &Track, times: &[f64], samples: &[Sample]) {
        let there = |s: &&Sample| s.opacity > FAINT * track.opacity && track.opacity > 0.0;
        let seen: Vec<(f64, &Sample)> =
            times.iter().copied().zip(samples).filter(|(_, s)| there(s)).collect();
        let count = seen.len().max(1) as f64;
        let mean: [f64; 3] = std::array::from_fn(|c| {
            seen.iter().map(|(_, s)| f64::from(s.position[c])).sum::<f64>() / count
        });
        for (time, sample) in seen {
            let squared = |from: [f64; 3]| -> f64 {
                (0..3).map(|c| (from[c] - f64::from(sample.position[c])).powi(2)).sum()
            };
            let apart = squared(track.position_at(time));
            self.position += apart;
            self.worst = self.worst.max(apart.sqrt());
            self.spread += squared(mean);
            let q = track.rotation_at(time);
            let dot: f64 = q.iter().zip(sample.rotation).map(|(a, b)| a * f64::from(b)).sum();
            self.angle += 2.0 * dot.abs().min(1.0).acos().to_degrees();
            self.count += 1;
        }
    }

    fn fit(&self, moving: usize) -> Fit {
        let count = self.count.max(1) as f64;
        Fit {
            moving,
            position_rmse: (self.position / count).sqrt(),
            position_worst: self.worst,
            position_spread: (self.spread / count).sqrt(),
            rotation_mean: self.angle / count,
        }
    }
}

/// A selection of the scene's cameras, in the JSON layout of the original 3DGS code; without
/// cameras, one camera that sees the whole scene.
fn cameras(scene: &Scene) -> Value {
    let listed = |id: usize, camera: &crate::types::Camera| {
        let (k, world) = (&camera.intrinsics, camera.view_from_world.inverse());
        let rotation = glam::DMat3::from_quat(world.rotation).transpose().to_cols_array_2d();
        json!({
            "id": id, "img_name": format!("{id:05}"), "width": k.width, "height": k.height,
            "position": world.translation.to_array(), "rotation": rotation,
            "fx": k.fx, "fy": k.fy,
        })
    };
    let step = scene.cameras.len().div_ceil(CAMERAS).max(1);
    let some: Vec<Value> = scene
        .cameras
        .iter()
        .step_by(step)
        .enumerate()
        .map(|(id, known)| listed(id, &known.camera))
        .collect();
    if !some.is_empty() {
        return json!(some);
    }
    let positions = &scene.gaussians.positions;
    let fold = |start: f32, with: fn(f32, f32) -> f32| -> [f64; 3] {
        std::array::from_fn(|c| f64::from(positions.iter().map(|p| p[c]).fold(start, with)))
    };
    let low = glam::DVec3::from(fold(f32::INFINITY, f32::min));
    let high = glam::DVec3::from(fold(f32::NEG_INFINITY, f32::max));
    let centre = low.midpoint(high) - 1.5 * (high - low).length() * glam::DVec3::Z;
    let camera = crate::types::Camera {
        intrinsics: crate::types::Intrinsics::centred(800.0, 960, 720),
        view_from_world: crate::types::Pose {
            rotation: glam::DQuat::IDENTITY,
            translation: -centre,
        },
    };
    json!([listed(0, &camera)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cubics_are_fitted_exactly_and_absence_makes_a_width() {
        let times: Vec<f64> = (0..12).map(|i| f64::from(i) / 11.0).collect();
        let at = |t: f64| [1.0 + 2.0 * t - t * t, t * t * t, 0.5 - t].map(|v| v as f32);
        let mut samples: Vec<Sample> = times
            .iter()
            .map(|&t| Sample {
                position: at(t),
                rotation: packing::unit([1.0, 0.2 * t as f32, 0.0, 0.0]),
                opacity: 0.8,
            })
            .collect();
        let track = Track::fitted(&times, &mut samples, 0.8);
        let mut sums = Sums::default();
        sums.add(&track, &times, &samples);
        let fit = sums.fit(1);
        assert!(fit.position_worst < 1e-6 && fit.rotation_mean < 0.1, "{fit:?}");
        assert!(fit.position_spread > 0.3);
        assert_eq!((track.centre, track.width), (0.5, ALWAYS));
        for (sample, time) in samples.iter_mut().zip(&times) {
            sample.opacity = if *time > 0.5 { 1e-9 } else { 0.8 };
        }
        let track = Track::fitted(&times, &mut samples, 0.8);
        let there = |time: f64| (-((time - track.centre) / track.width).powi(2)).exp();
        assert!((there(0.5) - 0.5).abs() < 0.01 && there(0.25) > 0.98 && there(1.0) < 0.01);
        samples.iter_mut().for_each(|sample| sample.opacity = 1e-9);
        assert_eq!(Track::fitted(&times, &mut samples, 0.8).opacity, 0.0);
    }
}
