//! Scenes shared by the renderer's cases, and a frame on the device with complete readback.

use super::Harness;
use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Recorder, Stream};
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::{self, FrameGradients, PixelBuffers, PixelGradients, Render};
use crate::oracle::bin::{Bins, bin};
use crate::oracle::project::Splat;
use crate::oracle::project_backward::SplatGradient;
use crate::oracle::raster::Pixels;
use crate::oracle::tiles::{TileRect, grid, power};
use crate::oracle::view::Cloud;
use crate::types::{Camera, Gaussians, Intrinsics, Pose, RenderSettings, sh_coefficients};
use bytemuck::Pod;
use glam::{DQuat, DVec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// The identity rotation.
pub const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 0.0];
/// Number of further elements in every buffer, which the op must not access.
const SLACK: usize = 64;
const POISON: u32 = 0xffff_ffff;

/// A camera at the origin that looks along z.
pub fn plain_camera(focal: f64, width: u32, height: u32) -> Camera {
    Camera {
        intrinsics: Intrinsics::centred(focal, width, height),
        view_from_world: Pose::IDENTITY,
    }
}

/// A general camera: rotated, translated, with an off-centre principal point and two focal lengths.
pub fn skew_camera(width: u32, height: u32) -> Camera {
    let (w, h) = (f64::from(width), f64::from(height));
    Camera {
        intrinsics: Intrinsics {
            fx: 0.9 * w,
            fy: 0.97 * w,
            cx: 0.46 * w,
            cy: 0.53 * h,
            width,
            height,
        },
        view_from_world: Pose::new(
            DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.4, 0.2),
            DVec3::new(0.2, -0.3, 0.5),
        ),
    }
}

/// Gaussians in and around the camera's field of view; some nearer than the near plane, behind the
/// camera, beside the image, or too transparent to draw.
pub fn random(rng: &mut ChaCha8Rng, count: usize, degree: u32, camera: &Camera) -> Gaussians {
    let world_from_view = camera.view_from_world.inverse();
    let mut out = Gaussians { sh_degree: degree, ..Gaussians::default() };
    for index in 0..count {
        let spread = if index % 5 == 0 { 1.5 } else { 0.6 };
        let z = if index % 17 == 0 {
            rng.random_range(-1.0..0.5)
        } else {
            rng.random_range(1.5f64..6.0)
        };
        let at = DVec3::new(
            z * rng.random_range(-spread..spread),
            z * rng.random_range(-spread..spread) * 0.7,
            z,
        );
        out.positions.push(world_from_view.apply(at).as_vec3().to_array());
        let size = if index % 11 == 0 { -0.5 } else { -2.6 };
        out.log_scales.push(std::array::from_fn(|_| size + rng.random_range(-1.2f32..0.6)));
        out.rotations.push(std::array::from_fn(|_| rng.random_range(-1.5f32..1.5)));
        out.opacity_logits.push(rng.random_range(-6.5f32..5.0));
        for _ in 0..sh_coefficients(degree) {
            out.sh.push(std::array::from_fn(|_| rng.random_range(-0.6f32..0.6)));
        }
    }
    out
}

/// One Gaussian of degree 0.
pub fn one(position: [f32; 3], log_scale: [f32; 3], rotation: [f32; 4], logit: f32) -> Gaussians {
    Gaussians {
        positions: vec![position],
        log_scales: vec![log_scale],
        rotations: vec![rotation],
        opacity_logits: vec![logit],
        sh_degree: 0,
        sh: vec![[0.4, 0.1, -0.2]],
        motion_logits: Vec::new(),
    }
}

/// Joins several scenes of degree 0.
pub fn join(parts: &[Gaussians]) -> Gaussians {
    let mut all = Gaussians::default();
    for part in parts {
        all.positions.extend(&part.positions);
        all.log_scales.extend(&part.log_scales);
        all.rotations.extend(&part.rotations);
        all.opacity_logits.extend(&part.opacity_logits);
        all.sh.extend(&part.sh);
    }
    all
}

/// A scene on the device with all buffers for rendering. All outputs of a pass are poisoned before
/// it; elements beyond the op's sizes must still be poison after it.
pub struct Frame {
    /// The frame, with longer buffers than planned for.
    pub inner: render::Frame<FrameGradients>,
    /// The camera.
    pub camera: Camera,
    /// The scene.
    pub gaussians: GaussianBuffers,
    /// Gradients with respect to the parameters.
    pub gradients: GaussianBuffers,
    /// Whether the backward pass computes the pose's gradient.
    pub with_pose: bool,
    capacity: usize,
}

/// The results of the forward pass, read back from the device.
#[derive(Clone, Debug, PartialEq)]
pub struct Forward {
    /// Mean x, mean y, depth, opacity.
    pub means: Vec<[f32; 4]>,
    /// The conic's factor (a, b, e), and the power at the cut.
    pub conics: Vec<[f32; 4]>,
    /// Colours.
    pub colours: Vec<[f32; 4]>,
    /// First tile and one past the last tile, packed.
    pub rectangles: Vec<[u32; 2]>,
    /// Number of overlapped tiles, by Gaussian.
    pub tile_counts: Vec<u32>,
    /// 1 for a visible Gaussian.
    pub visible: Vec<u32>,
    /// Numbers of visible Gaussians and of intersections, including those beyond the capacity.
    pub counts: [u32; 2],
    /// Whether all intersections fitted.
    pub fits: bool,
    /// Gaussian indices, sorted by depth.
    pub splat_from_rank: Vec<u32>,
    /// Index of the first intersection, by depth rank.
    pub emitted_from_rank: Vec<u32>,
    /// Tile by intersection, as emitted.
    pub tiles: Vec<u32>,
    /// Gaussian by intersection, as emitted.
    pub splat_from_emitted: Vec<u32>,
    /// Tiles, sorted.
    pub sorted_tiles: Vec<u32>,
    /// Intersections, sorted.
    pub emitted_from_sorted: Vec<u32>,
    /// Begin and end by tile.
    pub ranges: Vec<[u32; 2]>,
    /// Premultiplied colour and alpha.
    pub rgba: Vec<[f32; 4]>,
    /// Depth.
    pub depth: Vec<f32>,
}

/// The results of the backward pass, read back from the device.
#[derive(Clone, Debug, PartialEq)]
pub struct Backward {
    /// Gradients with respect to the parameters.
    pub gaussians: Gaussians,
    /// Gradient with respect to the pose: translation, rotation.
    pub pose: Vec<f32>,
    /// Gradients with respect to the splats; those of culled Gaussians are zero.
    pub splats: Vec<SplatGradient<f32>>,
}

fn poison<T: Pod>(recorder: &mut Recorder, buffers: &mut [&mut Buffer<T>]) {
    for buffer in buffers {
        recorder.fill(buffer.view_mut(), POISON);
    }
}

/// Reads the first `len` elements; fails if an element after them is no longer poison.
fn read<T: Pod>(stream: &mut Stream, buffer: &Buffer<T>, len: usize) -> Result<Vec<T>> {
    let mut all = stream.download(buffer)?;
    let tail = bytemuck::cast_slice::<T, u8>(&all[len.min(all.len())..]);
    if tail.iter().any(|&byte| byte != 0xff) {
        return Err(Error::Failed(format!(
            "{}: a kernel wrote behind its {len} elements",
            buffer.label()
        )));
    }
    all.truncate(len);
    Ok(all)
}

impl Frame {
    /// Uploads a scene, with capacity for `capacity` intersections.
    pub fn new(
        device: &Device,
        stream: &mut Stream,
        scene: &Gaussians,
        camera: &Camera,
        capacity: usize,
        settings: RenderSettings,
    ) -> Result<Frame> {
        let (n, k) = (scene.len(), camera.intrinsics);
        let render = Render::plan(device, n, capacity, k.width, k.height, settings)?;
        let larger =
            Render::plan(device, n + SLACK, capacity + SLACK, k.width, k.height, settings)?;
        let mut inner = larger.differentiable(device)?;
        let area = k.width as usize * k.height as usize + SLACK;
        inner.plan = render;
        inner.pixels = PixelBuffers {
            width: k.width,
            height: k.height,
            rgba: device.buffer("rendered rgba", area)?,
            depth: device.buffer("rendered depth", area)?,
            last: device.buffer("last intersections", area)?,
        };
        inner.gradients.pixels = PixelGradients {
            rgba: device.buffer("rgba gradient", area)?,
            depth: device.buffer("depth gradient", area)?,
        };
        Ok(Frame {
            inner,
            gaussians: GaussianBuffers::from_host(stream, scene)?,
            gradients: GaussianBuffers::new(device, n + SLACK, scene.sh_degree)?,
            with_pose: true,
            camera: *camera,
            capacity,
        })
    }

    fn area(&self) -> usize {
        self.inner.pixels.width as usize * self.inner.pixels.height as usize
    }

    /// Renders and reads everything back.
    pub fn forward(&mut self, stream: &mut Stream) -> Result<Forward> {
        let mut recorder = stream.record()?;
        let (s, p) = (&mut self.inner.scratch, &mut self.inner.pixels);
        let r = &mut recorder;
        poison(r, &mut [&mut s.means, &mut s.conics, &mut s.colours, &mut p.rgba]);
        poison(r, &mut [&mut s.rectangles, &mut s.ranges]);
        poison(r, &mut [&mut p.depth]);
        poison(
            r,
            &mut [&mut s.tile_counts, &mut s.visible, &mut s.visible_from_splat, &mut s.keys],
        );
        poison(
            r,
            &mut [
                &mut s.splat_from_visible,
                &mut s.sorted_keys,
                &mut s.splat_from_rank,
                &mut s.rank_counts,
            ],
        );
        poison(
            r,
            &mut [
                &mut s.emitted_from_rank,
                &mut s.tiles,
                &mut s.emitted,
                &mut s.splat_from_emitted,
            ],
        );
        poison(
            r,
            &mut [&mut s.sorted_tiles, &mut s.emitted_from_sorted, &mut s.counts, &mut p.last],
        );
        poison(r, &mut [&mut s.fits]);
        self.inner.forward(r, &self.camera, self.gaussians.views(), Default::default())?;
        stream.submit(recorder)?;
        let counts = self.inner.counts(stream)?;
        let (n, area) = (self.gaussians.len, self.area());
        let m = counts.intersections.min(self.capacity);
        let (s, p) = (&self.inner.scratch, &self.inner.pixels);
        for buffer in [&s.visible_from_splat, &s.rank_counts] {
            read(stream, buffer, n)?;
        }
        for buffer in [&s.keys, &s.splat_from_visible, &s.sorted_keys] {
            read(stream, buffer, counts.visible)?;
        }
        read(stream, &s.emitted, m)?;
        read(stream, &p.last, area)?;
        Ok(Forward {
            means: read(stream, &s.means, n)?,
            conics: read(stream, &s.conics, n)?,
            colours: read(stream, &s.colours, n)?,
            rectangles: read(stream, &s.rectangles, n)?,
            tile_counts: read(stream, &s.tile_counts, n)?,
            visible: read(stream, &s.visible, n)?,
            counts: [counts.visible as u32, counts.intersections as u32],
            fits: stream.download(&s.fits)? == [1],
            splat_from_rank: read(stream, &s.splat_from_rank, counts.visible)?,
            emitted_from_rank: read(stream, &s.emitted_from_rank, n)?,
            tiles: read(stream, &s.tiles, m)?,
            splat_from_emitted: read(stream, &s.splat_from_emitted, m)?,
            sorted_tiles: read(stream, &s.sorted_tiles, m)?,
            emitted_from_sorted: read(stream, &s.emitted_from_sorted, m)?,
            ranges: stream.download(&s.ranges)?,
            rgba: read(stream, &p.rgba, area)?,
            depth: read(stream, &p.depth, area)?,
        })
    }

    /// Differentiates the frame just rendered and reads everything back.
    pub fn backward(&mut self, stream: &mut Stream, gradient: &Pixels<f32>) -> Result<Backward> {
        let rgba: Vec<[f32; 4]> = gradient
            .rgb
            .iter()
            .zip(&gradient.alpha)
            .map(|(rgb, &alpha)| [rgb[0], rgb[1], rgb[2], alpha])
            .collect();
        let by_pixel = &mut self.inner.gradients.pixels;
        stream.upload(&mut by_pixel.rgba, &rgba)?;
        stream.upload(&mut by_pixel.depth, &gradient.depth)?;
        let mut recorder = stream.record()?;
        let (b, g, r) = (&mut self.inner.gradients, &mut self.gradients, &mut recorder);
        poison(r, &mut [&mut b.slots_a, &mut b.slots_b, &mut b.means, &mut b.covariances]);
        poison(r, &mut [&mut b.colours, &mut g.rotations]);
        poison(r, &mut [&mut b.slots_c]);
        poison(r, &mut [&mut b.pose_partials, &mut b.pose]);
        poison(r, &mut [&mut g.positions, &mut g.log_scales, &mut g.opacity_logits]);
        for band in &mut g.sh {
            poison(r, &mut [band]);
        }
        self.inner.backward(r, self.gaussians.views(), Default::default(), g, self.with_pose)?;
        stream.submit(recorder)?;
        let n = self.gaussians.len;
        let m = self.inner.counts(stream)?.intersections.min(self.capacity);
        let (b, g) = (&self.inner.gradients, &self.gradients);
        read(stream, &b.slots_a, m)?;
        read(stream, &b.slots_b, m)?;
        read(stream, &b.slots_c, m)?;
        let partials = if self.with_pose { 8 * n.div_ceil(64) } else { 0 };
        read(stream, &b.pose_partials, partials)?;
        read(stream, &g.positions, 3 * n)?;
        read(stream, &g.log_scales, 3 * n)?;
        read(stream, &g.rotations, n)?;
        read(stream, &g.opacity_logits, n)?;
        for (band, floats) in g.sh.iter().zip(crate::ops::gaussians::SH_BAND) {
            read(stream, band, (floats * n).min(band.len()))?;
        }
        let visible = read(stream, &self.inner.scratch.visible, n)?;
        let means = read(stream, &b.means, n)?;
        let covariances = read(stream, &b.covariances, n)?;
        let colours = read(stream, &b.colours, n)?;
        let splats = (0..n).filter(|&i| visible[i] != 0).map(|i| {
            let ([x, y, depth, opacity], [a, b, c, _], [red, green, blue, _]) =
                (means[i], covariances[i], colours[i]);
            let (mean, covariance) = ([x, y], [a, b, c]);
            (i, SplatGradient { mean, covariance, opacity, depth, colour: [red, green, blue] })
        });
        let mut by_index = vec![SplatGradient::default(); n];
        splats.for_each(|(i, splat)| by_index[i] = splat);
        Ok(Backward {
            gaussians: g.download(stream)?,
            pose: stream.download(&b.pose)?,
            splats: by_index,
        })
    }
}

impl Forward {
    /// The device's splats in the oracle's type, so that later kernels are checked on their actual
    /// input.
    pub fn splats(&self) -> Vec<Option<Splat<f64>>> {
        let wide = f64::from;
        (0..self.visible.len())
            .map(|i| {
                (self.visible[i] != 0).then(|| {
                    let ([x, y, depth, opacity], [a, b, c, _]) = (self.means[i], self.conics[i]);
                    let [first, last] = self.rectangles[i];
                    Splat {
                        mean: [wide(x), wide(y)],
                        conic: [wide(a), wide(b), wide(c)],
                        opacity: wide(opacity),
                        depth: wide(depth),
                        colour: std::array::from_fn(|k| wide(self.colours[i][k])),
                        rect: TileRect {
                            min: [first & 0xffff, first >> 16],
                            max: [last & 0xffff, last >> 16],
                        },
                        tile_count: self.tile_counts[i],
                    }
                })
            })
            .collect()
    }

    /// The device's tile lists in the oracle's type.
    pub fn bins(&self, width: u32, height: u32) -> Bins {
        Bins {
            grid: grid(width, height),
            splat_from_rank: self.splat_from_rank.clone(),
            emitted_from_rank: self.emitted_from_rank[..self.splat_from_rank.len()].to_vec(),
            tiles: self.sorted_tiles.clone(),
            splat_from_sorted: (self.emitted_from_sorted.iter())
                .map(|&at| self.splat_from_emitted[at as usize])
                .collect(),
            ranges: self.ranges.clone(),
        }
    }
}

/// Converts splats to f32.
pub fn as_f32(splats: &[Option<Splat<f64>>]) -> Vec<Option<Splat<f32>>> {
    let of = |x: f64| x as f32;
    let one = |s: &Splat<f64>| Splat {
        mean: s.mean.map(of),
        conic: s.conic.map(of),
        opacity: of(s.opacity),
        depth: of(s.depth),
        colour: s.colour.map(of),
        rect: s.rect,
        tile_count: s.tile_count,
    };
    splats.iter().map(|s| s.as_ref().map(one)).collect()
}

/// The tile lists with every splat's extent slightly enlarged: whether a splat within `band` of the
/// cut is listed depends on rounding.
fn wide_lists(
    splats: &[Option<Splat<f64>>],
    settings: &RenderSettings,
    width: u32,
    height: u32,
    band: f64,
) -> Bins {
    let settings =
        RenderSettings { alpha_cut: settings.alpha_cut * (1.0 - band as f32), ..*settings };
    let everywhere = TileRect { min: [0, 0], max: grid(width, height) };
    let widened = |splat: &Splat<f64>| {
        let mut splat = Splat { rect: everywhere, ..*splat };
        splat.tile_count = splat.tiles(&settings, width, height).count() as u32;
        splat
    };
    let splats: Vec<_> = splats.par_iter().map(|s| s.as_ref().map(widened)).collect();
    bin(&splats, &settings, width, height)
}

/// For each pixel, the maximum change of its colour that depends on decisions (cut, cap, stop)
/// within `band` of their threshold, relative to the threshold. Rounding may change such a
/// decision. The change is in units of a colour, and zero for most pixels.
pub fn flip_ranges(
    splats: &[Option<Splat<f64>>],
    settings: &RenderSettings,
    width: u32,
    height: u32,
    band: f64,
) -> Vec<f64> {
    let bins = wide_lists(splats, settings, width, height, band);
    let near = |value: f64, threshold: f32| {
        (value / f64::from(threshold) - 1.0).abs() < band || value.is_nan()
    };
    let mut out = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let [begin, end] = bins.ranges[(y / 16 * bins.grid[0] + x / 16) as usize];
            let (mut transmittance, mut flip_range) = (1.0, 0.0);
            for &index in &bins.splat_from_sorted[begin as usize..end as usize] {
                let Some(splat) = &splats[index as usize] else { continue };
                let (dx, dy) =
                    (f64::from(x) + 0.5 - splat.mean[0], f64::from(y) + 0.5 - splat.mean[1]);
                let full = splat.opacity * (-power(splat.conic, dx, dy)).exp();
                if near(full, settings.alpha_cut) || near(full, settings.alpha_cap) {
                    // The splat may be blended or not: this changes its own colour and the light
                    // from the splats behind.
                    flip_range += 2.0 * transmittance * f64::from(settings.alpha_cut);
                }
                if full < f64::from(settings.alpha_cut) {
                    continue;
                }
                let behind = transmittance * (1.0 - full.min(f64::from(settings.alpha_cap)));
                if near(behind, settings.transmittance_stop) {
                    flip_range += transmittance;
                }
                if behind <= f64::from(settings.transmittance_stop) {
                    break;
                }
                transmittance = behind;
            }
            out.push(flip_range);
        }
    }
    out
}

/// The pixels that depend on a decision within `band` of its threshold.
pub fn contested(
    splats: &[Option<Splat<f64>>],
    settings: &RenderSettings,
    width: u32,
    height: u32,
    band: f64,
) -> Vec<bool> {
    let flip_ranges = flip_ranges(splats, settings, width, height, band);
    flip_ranges.into_iter().map(|flip_range| flip_range > 0.0).collect()
}

/// A random gradient with respect to the pixels, zero where `zero` is set.
pub fn random_gradient(rng: &mut ChaCha8Rng, zero: &[bool]) -> Pixels<f32> {
    let mut out = Pixels::zeros(zero.len());
    for (i, &zero) in zero.iter().enumerate() {
        if !zero {
            out.rgb[i] = std::array::from_fn(|_| rng.random_range(-1.0f32..1.0));
            out.alpha[i] = rng.random_range(-1.0f32..1.0);
            out.depth[i] = rng.random_range(-0.2f32..0.2);
        }
    }
    out
}

/// Converts pixels to f64.
pub fn widen(pixels: &Pixels<f32>) -> Pixels<f64> {
    Pixels {
        rgb: pixels.rgb.iter().map(|v| v.map(f64::from)).collect(),
        alpha: pixels.alpha.iter().map(|&v| f64::from(v)).collect(),
        depth: pixels.depth.iter().map(|&v| f64::from(v)).collect(),
    }
}

/// Whether every number of the device's results is finite, culled splats excepted.
pub fn all_finite(forward: &Forward, backward: Option<&Backward>) -> bool {
    let image = forward.rgba.as_flattened().iter().chain(&forward.depth);
    let forward_finite = image.copied().all(f32::is_finite);
    forward_finite
        && backward.is_none_or(|b| {
            let g = &b.gaussians;
            let rows = g.positions.as_flattened().iter().chain(g.log_scales.as_flattened());
            let rows = rows.chain(g.rotations.as_flattened()).chain(&g.opacity_logits);
            rows.chain(g.sh.as_flattened()).chain(&b.pose).all(|v| v.is_finite())
        })
}

/// Compares the gradients with respect to the parameters and the pose with the oracle's. `absolute`
/// is relative to each parameter's largest gradient: sums over pixels cancel, so a bound relative
/// to each value would be too strict.
pub fn compare_gradients(
    harness: &mut Harness,
    what: &str,
    device: &Backward,
    truth: (&Cloud<f64>, &[f64; 6]),
    single: (&Cloud<f32>, &[f32; 6]),
    absolute: f64,
    relative: f64,
) {
    let (g, (cloud, twist), (cloud_32, twist_32)) = (&device.gaussians, truth, single);
    let mut hold = |name: &str, device: &[f32], truth: &[f64], single: &[f32]| {
        let largest = truth.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let bound = super::Bound { absolute: absolute * largest + 1e-30, relative };
        harness.close(&format!("{what}: {name}"), device, truth, Some(single), bound);
    };
    let flat = |v: &[[f32; 3]]| v.as_flattened().to_vec();
    let wide = |v: &[[f64; 3]]| v.as_flattened().to_vec();
    hold("positions", &flat(&g.positions), &wide(&cloud.positions), &flat(&cloud_32.positions));
    hold("log scales", &flat(&g.log_scales), &wide(&cloud.log_scales), &flat(&cloud_32.log_scales));
    hold(
        "rotations",
        g.rotations.as_flattened(),
        cloud.rotations.as_flattened(),
        cloud_32.rotations.as_flattened(),
    );
    hold("opacity", &g.opacity_logits, &cloud.opacity_logits, &cloud_32.opacity_logits);
    hold("sh", &flat(&g.sh), &wide(&cloud.sh), &flat(&cloud_32.sh));
    hold("pose", &device.pose, twist, twist_32);
}
