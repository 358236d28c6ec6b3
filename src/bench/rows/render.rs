//! Benchmarks of the stages of rendering, forward and backward, and of the loss. A stage is timed
//! within the whole frame, by the timestamps of its dispatches.

use super::thousands;
use crate::Result;
use crate::bench::frame::{Frame, sum};
use crate::bench::job::{Entry, Job};
use crate::bench::scenes::{camera, cloud, rng};
use crate::bench::verify::Check;
use crate::check::Bound;
use crate::check::loss::LossWorkload;
use crate::gpu::Device;
use crate::ops::gaussians::SH_BAND;
use crate::oracle::project::{Splat, project};
use crate::oracle::raster::{self, Pixels};
use crate::oracle::view::{Cloud, View};
use crate::oracle::{render, scan, sort};
use crate::report::{Place, Work};
use crate::types::RenderSettings;
use rand::RngExt;

/// A stage of the frame.
#[derive(Clone, Copy, PartialEq)]
enum Stage {
    Project,
    Bin,
    Raster,
    ProjectBackward,
    RasterBackward,
}

/// Gaussians, width, height.
const SCENES: [(usize, u32, u32); 3] = [(10_000, 480, 270), (50_000, 480, 270), (50_000, 960, 540)];

/// The scene of a quick run.
const QUICK: [(usize, u32, u32); 1] = [(4000, 240, 136)];

/// Number of floats of a Gaussian of degree 3: position, scales, rotation, opacity, harmonics.
const PARAMETERS: u64 = 3 + 3 + 4 + 1 + (SH_BAND[0] + SH_BAND[1] + SH_BAND[2] + SH_BAND[3]) as u64;
/// Bytes that projection writes per splat: mean, conic, colour (4 floats each), rectangle, tile
/// count, visibility.
const SPLAT_BYTES: u64 = 3 * 16 + 8 + 4 + 4;
/// Operations per Gaussian in projection: rotation and scales to a matrix, Jacobian, covariance and
/// its inverse, sigmoid, and two per harmonic and channel.
const PROJECT_OPERATIONS: u64 = 190 + 2 * 48;
/// Operations per (pixel, splat) pair in blending: offset, power, exponential, α, weight, four
/// channels.
const BLEND_OPERATIONS: u64 = 22;
/// Operations per (pixel, splat) pair in the backward pass, with ten sums per splat.
const BLEND_BACKWARD_OPERATIONS: u64 = 62;
/// Bytes that one pass of a sort moves per pair.
const SORT_BYTES: u64 = 20;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for (id, stage) in [
        ("project/forward", Stage::Project),
        ("bin/lists", Stage::Bin),
        ("raster/forward", Stage::Raster),
        ("raster/backward", Stage::RasterBackward),
        ("project/backward", Stage::ProjectBackward),
    ] {
        let scenes: &[_] = if quick { &QUICK } else { &SCENES };
        for &(n, w, h) in scenes {
            let size = format!("{} Gaussians, {w}×{h}", thousands(n));
            all.push(Entry::new(id, size, move |d, seed| job(d, seed, (n, w, h), stage)));
        }
    }
    let images: &[(u32, u32)] = if quick { &[(240, 136)] } else { &[(480, 270), (960, 540)] };
    for &(w, h) in images {
        all.push(Entry::new("loss/photometric", format!("{w}×{h}"), move |d, seed| {
            Job::of(d, seed, |harness| LossWorkload::random(harness, w, h))
        }));
    }
    all
}

fn job(
    device: &Device,
    seed: u64,
    (n, width, height): (usize, u32, u32),
    stage: Stage,
) -> Result<Job> {
    let (settings, camera) = (RenderSettings::default(), camera(width, height));
    let scene = cloud(seed, n, 3, &camera);
    let mut frame = Frame::new(device, &scene, &camera, settings)?;
    let mut check = Check::new();
    let (gaussians, view) = (Cloud::<f64>::new(&scene), View::new(&camera));
    let pixels = u64::from(width) * u64::from(height);
    let (n, m) = (n as u64, frame.counts.intersections as u64);
    let visible = frame.counts.visible as u64;
    let blended = frame.blended()?;
    let work = match stage {
        Stage::Project => {
            check_projection(&mut check, &mut frame, &project(&gaussians, &view, &settings))?;
            Work { bytes: n * (4 * PARAMETERS + SPLAT_BYTES), operations: n * PROJECT_OPERATIONS }
        }
        Stage::Bin => {
            check_lists(&mut check, &mut frame)?;
            let tile_bits =
                u64::from(32 - (width.div_ceil(16) * height.div_ceil(16)).leading_zeros());
            // Depth: four passes; tiles: as many as their number has bytes.
            let sorted = SORT_BYTES * (4 * visible + tile_bits.div_ceil(8) * m);
            Work {
                bytes: sorted + n * 40 + m * 16,
                operations: 2 * (4 * visible + tile_bits.div_ceil(8) * m) + 4 * n,
            }
        }
        Stage::Raster => {
            check_image(&mut check, &mut frame, &settings)?;
            // Every listed splat once per tile, every pixel once.
            Work { bytes: m * (8 + 48) + pixels * 24, operations: blended * BLEND_OPERATIONS }
        }
        Stage::RasterBackward | Stage::ProjectBackward => {
            check_gradients(&mut check, &mut frame, seed, (&gaussians, &view), &settings)?;
            match stage {
                Stage::RasterBackward => Work {
                    bytes: m * (8 + 48 + 2 * 40) + pixels * 44 + visible * 48,
                    operations: blended * BLEND_BACKWARD_OPERATIONS,
                },
                _ => Work {
                    bytes: n * (8 * PARAMETERS + 48 + 36),
                    operations: n * 3 * PROJECT_OPERATIONS,
                },
            }
        }
    };
    let backward = matches!(stage, Stage::RasterBackward | Stage::ProjectBackward);
    Ok(Job {
        accuracy: check.accuracy(),
        work,
        place: Place::Device,
        reset: None,
        execute: Box::new(move || {
            let times =
                if backward { frame.profile_backward()? } else { frame.profile_forward()? };
            let belongs = |kernel: &str| match stage {
                Stage::Project => kernel == "project/forward",
                Stage::Raster => kernel == "raster/forward",
                Stage::Bin => kernel != "project/forward" && kernel != "raster/forward",
                Stage::RasterBackward => kernel.starts_with("raster/"),
                Stage::ProjectBackward => kernel.starts_with("project/"),
            };
            Ok(sum(&times, belongs))
        }),
    })
}

/// Compares the values of splats that device and oracle both draw; the sets of drawn splats may
/// differ by one in a thousand.
fn check_projection(
    check: &mut Check,
    frame: &mut Frame,
    truth: &[Option<Splat<f64>>],
) -> Result<()> {
    let splats = frame.listed()?.splats;
    let differ = splats.iter().zip(truth).filter(|(a, b)| a.is_some() != b.is_some()).count();
    let few = differ * 1000 <= splats.len();
    check.exact("who is drawn", &[few], &[true]);
    let both: Vec<(&Splat<f64>, &Splat<f64>)> =
        splats.iter().zip(truth).filter_map(|(a, b)| Some((a.as_ref()?, b.as_ref()?))).collect();
    let mut hold = |name: &str, values: &dyn Fn(&Splat<f64>) -> Vec<f64>, bound: Bound| {
        let device: Vec<f32> = both.iter().flat_map(|(a, _)| values(a)).map(|v| v as f32).collect();
        let exact: Vec<f64> = both.iter().flat_map(|(_, b)| values(b)).collect();
        check.close(name, &device, &exact, bound);
    };
    // Rounding of coordinates up to 6, times the focal length over the depth.
    let width = f64::from(frame.size()[0]);
    hold("means", &|s| s.mean.to_vec(), Bound { absolute: 4e-6 * width, relative: 2e-6 });
    let trace = |s: &Splat<f64>| vec![s.conic[0] + s.conic[2]];
    hold("conics", &trace, Bound { absolute: 0.0, relative: 3e-5 });
    hold("colours", &|s| s.colour.to_vec(), Bound { absolute: 5e-6, relative: 0.0 });
    Ok(())
}

/// Compares the tile lists exactly, given the splats that the device has projected.
fn check_lists(check: &mut Check, frame: &mut Frame) -> Result<()> {
    let listed = frame.listed()?;
    let drawn: Vec<u32> =
        (0..listed.visible.len() as u32).filter(|&i| listed.visible[i as usize] != 0).collect();
    let depth = |i: u32| listed.splats[i as usize].as_ref().map_or(0.0, |s| s.depth) as f32;
    let keys: Vec<u32> = drawn.iter().map(|&i| depth(i).to_bits()).collect();
    let order = sort::by_bits(&keys, &drawn, 0..32).1;
    check.exact("order", &listed.bins.splat_from_rank, &order);
    let counts: Vec<u32> = order.iter().map(|&i| listed.tile_counts[i as usize]).collect();
    check.exact("first intersections", &listed.bins.emitted_from_rank, &scan::exclusive(&counts));
    let [tiles, owners] = &listed.emitted;
    let whose: Vec<u32> = order
        .iter()
        .zip(&counts)
        .flat_map(|(&splat, &count)| std::iter::repeat_n(splat, count as usize))
        .collect();
    check.exact("whose", owners, &whose);
    let numbers: Vec<u32> = (0..tiles.len() as u32).collect();
    let (sorted, places) = sort::by_bits(tiles, &numbers, 0..32);
    let splats: Vec<u32> = places.iter().map(|&at| owners[at as usize]).collect();
    check.exact("tiles", &listed.bins.tiles, &sorted);
    check.exact("lists", &listed.bins.splat_from_sorted, &splats);
    let [columns, rows] = listed.bins.grid;
    let ranges: Vec<[u32; 2]> = (0..columns * rows)
        .map(|tile| {
            let begin = sorted.partition_point(|&t| t < tile) as u32;
            let end = sorted.partition_point(|&t| t <= tile) as u32;
            if begin == end { [0, 0] } else { [begin, end] }
        })
        .collect();
    check.exact("ranges", &listed.bins.ranges, &ranges);
    Ok(())
}

/// Compares the image, given the splats and lists that the device has made.
fn check_image(check: &mut Check, frame: &mut Frame, settings: &RenderSettings) -> Result<()> {
    let listed = frame.listed()?;
    let [width, height] = frame.size();
    let truth = raster::forward(&listed.splats, &listed.bins, settings, width, height);
    image(check, "image", &frame.image()?, &truth);
    Ok(())
}

/// Rounding can decide whether a splat at the α cut of 1/255, with a colour of up to 2, contributes
/// to a pixel. One pixel in a hundred may differ by that.
pub(in crate::bench) fn image(
    check: &mut Check,
    output: &str,
    device: &[[f32; 4]],
    truth: &Pixels<f64>,
) {
    let exact: Vec<f64> = truth
        .rgb
        .iter()
        .zip(&truth.alpha)
        .flat_map(|(rgb, &alpha)| [rgb[0], rgb[1], rgb[2], alpha])
        .collect();
    let tight = Bound { absolute: 1e-4, relative: 0.0 };
    let flipped = Bound { absolute: 2e-2, relative: 0.0 };
    check.mostly(output, device.as_flattened(), &exact, tight, 0.01, flipped);
}

/// Compares the gradients of a random linear function of the image, given the device's tile lists.
fn check_gradients(
    check: &mut Check,
    frame: &mut Frame,
    seed: u64,
    (cloud, view): (&Cloud<f64>, &View<f64>),
    settings: &RenderSettings,
) -> Result<()> {
    let listed = frame.listed()?;
    let [width, height] = frame.size();
    let count = width as usize * height as usize;
    let mut rng = rng(seed + 7);
    let rgba: Vec<[f32; 4]> =
        (0..count).map(|_| std::array::from_fn(|_| rng.random_range(-1.0f32..1.0))).collect();
    let depth: Vec<f32> = (0..count).map(|_| rng.random_range(-0.2f32..0.2)).collect();
    frame.set_gradient(&rgba, &depth)?;
    frame.profile_backward()?;
    let got = frame.gradients()?;
    let wide = f64::from;
    let gradient = Pixels {
        rgb: rgba.iter().map(|v| [wide(v[0]), wide(v[1]), wide(v[2])]).collect(),
        alpha: rgba.iter().map(|v| wide(v[3])).collect(),
        depth: depth.iter().map(|&v| wide(v)).collect(),
    };
    let pixels = raster::forward(&listed.splats, &listed.bins, settings, width, height);
    let rendered = render::Rendered { splats: listed.splats, bins: listed.bins, pixels };
    let (truth, _, _) = render::backward(cloud, view, settings, &rendered, &gradient);
    gradients(check, &got, &truth);
    Ok(())
}

/// Sums over pixels cancel, so bounds are relative to the largest gradient. Where the decision in a
/// pixel differs, the gradients of all splats in it change.
fn gradients(check: &mut Check, got: &crate::types::Gaussians, truth: &Cloud<f64>) {
    let mut hold = |name: &str, device: &[f32], truth: &[f64]| {
        let largest = truth.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let tight = Bound { absolute: 1e-5 * largest, relative: 1e-3 };
        let flipped = Bound { absolute: 0.05 * largest, relative: 0.05 };
        check.mostly(name, device, truth, tight, 0.02, flipped);
    };
    hold("position gradients", got.positions.as_flattened(), truth.positions.as_flattened());
    hold("scale gradients", got.log_scales.as_flattened(), truth.log_scales.as_flattened());
    hold("rotation gradients", got.rotations.as_flattened(), truth.rotations.as_flattened());
    hold("opacity gradients", &got.opacity_logits, &truth.opacity_logits);
    hold("harmonics' gradients", got.sh.as_flattened(), truth.sh.as_flattened());
}
