//! Check cases of dense optical flow: each kernel runs on the oracle's intermediate results.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::gpu::{Buffer, Groups, Kernel};
use crate::kernels::flow as kernel;
use crate::oracle::flow::{self, Equation, Level, Patch};
use crate::types::FlowSettings;
use bytemuck::Pod;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "flow/pyramid", run: pyramid },
    Case { id: "flow/start", run: start },
    Case { id: "flow/patches", run: patches },
    Case { id: "flow/refine", run: refine },
    Case { id: "flow/consistency", run: consistency },
];

/// Odd sizes, sides shorter than a patch, and a single pixel.
const SIZES: [[usize; 2]; 4] = [[61, 43], [17, 3], [3, 17], [1, 1]];

/// A pair of pyramid levels, the second slightly displaced, and an approximate flow.
struct Scene {
    width: usize,
    height: usize,
    a: Level<f64>,
    b: Level<f64>,
    flow: Vec<[f64; 2]>,
    back: Vec<[f64; 2]>,
}

impl Scene {
    fn new(h: &mut Harness, [width, height]: [usize; 2]) -> Scene {
        let phases: [f64; 4] = std::array::from_fn(|_| h.rng.random_range(0.0..6.0));
        let texture = |x: f64, y: f64| {
            let [p, q, r, s] = phases;
            0.5 + 0.2 * (0.9 * x + 0.3 * y + p).sin()
                + 0.15 * (1.1 * y - 0.4 * x + q).sin()
                + 0.1 * (0.35 * x + 0.2 * y + r).sin() * (0.27 * y + s).cos()
        };
        let image = |du: f64, dv: f64| -> Vec<f64> {
            (0..width * height)
                .map(|p| texture((p % width) as f64 - du, (p / width) as f64 - dv))
                .map(|v| f64::from(v as f32))
                .collect()
        };
        // Rounded, so that the oracle starts from what the device starts from.
        let level = |luma: Vec<f64>| Level {
            width,
            height,
            derivatives: flow::derivatives(&luma, width, height)
                .into_iter()
                .map(|d| d.map(|v| f64::from(v as f32)))
                .collect(),
            luma,
        };
        let mut near = |u: f64, v: f64| -> Vec<[f64; 2]> {
            (0..width * height)
                .map(|_| [u, v].map(|c| f64::from((c + h.rng.random_range(-0.4..0.4)) as f32)))
                .collect()
        };
        let (flow, back) = (near(1.3, -0.7), near(-1.3, 0.7));
        Scene { width, height, a: level(image(0.0, 0.0)), b: level(image(1.3, -0.7)), flow, back }
    }

    fn what(&self, output: &str) -> String {
        format!("{}×{}: {output}", self.width, self.height)
    }

    fn pixels(&self) -> usize {
        self.width * self.height
    }

    fn groups<K: Kernel>(&self) -> Groups {
        grid::<K>(self.width, self.height)
    }
}

fn grid<K: Kernel>(width: usize, height: usize) -> Groups {
    Groups::grid(width as u32, height as u32, [K::WORKGROUP[0], K::WORKGROUP[1]])
}

fn singles<const N: usize>(values: &[[f64; N]]) -> Vec<[f32; N]> {
    values.iter().map(|v| v.map(|c| c as f32)).collect()
}

fn single(values: &[f64]) -> Vec<f32> {
    values.iter().map(|v| *v as f32).collect()
}

fn upload<T: Pod>(h: &Harness, data: &[T]) -> Result<Buffer<T>> {
    h.device.upload("input", data)
}

/// Records one dispatch, submits it and reads the guarded output.
macro_rules! run {
    ($h:ident, $kernel:ident, $groups:expr, $params:expr, $len:expr,
     |$out:ident: $element:ty| $args:expr) => {{
        let mut guarded = $h.output::<$element>(kernel::$kernel::NAME, $len)?;
        let mut recorder = $h.stream.record()?;
        let $out = guarded.view_mut();
        recorder.dispatch::<kernel::$kernel>($groups, $params, $args)?;
        $h.stream.submit(recorder)?;
        $h.read(&guarded)?
    }};
}

/// A few roundings of values of order 1.
const ROUNDING: Bound = Bound { absolute: 2e-6, relative: 2e-6 };

fn pyramid(h: &mut Harness) -> Result<()> {
    for [w, height] in SIZES {
        let scene = Scene::new(h, [w, height]);
        let (n, width) = (scene.pixels(), w as i32);
        for channels in 1..=4usize {
            // Values outside [0, 1], and NaN.
            let mut pixels: Vec<f32> =
                (0..n * channels).map(|_| h.rng.random_range(-0.3f32..1.3)).collect();
            pixels[0] = f32::NAN;
            pixels[n * channels - 1] = f32::INFINITY;
            let wide: Vec<f64> = pixels.iter().map(|v| f64::from(*v)).collect();
            let input = upload(h, &pixels)?;
            let params = kernel::LumaParams { count: n as u32, channels: channels as u32 };
            let groups = Groups::linear(n, 64, h.device.limits())?;
            let luma = run!(h, Luma, groups, params, n, |luma: f32| kernel::LumaArgs {
                pixels: input.view(),
                luma
            });
            let truth = flow::luminance(&wide, channels);
            h.close(&scene.what("luma"), &luma, &truth, None, ROUNDING);
        }
        let height = height as i32;
        let luma = upload(h, &single(&scene.a.luma))?;
        let (hw, hh) = (w.div_ceil(2), scene.height.div_ceil(2));
        let halved = run!(
            h,
            Halve,
            grid::<kernel::Halve>(hw, hh),
            kernel::HalveParams { width, height },
            hw * hh,
            |halved: f32| kernel::HalveArgs { luma: luma.view(), halved }
        );
        let truth = flow::halve(&scene.a.luma, w, scene.height);
        h.close(&scene.what("halved"), &halved, &truth, None, ROUNDING);
        let derivatives = run!(
            h,
            Derivatives,
            scene.groups::<kernel::Derivatives>(),
            kernel::DerivativesParams { width, height },
            5 * n,
            |derivatives: f32| kernel::DerivativesArgs { luma: luma.view(), derivatives }
        );
        let truth = flow::derivatives(&scene.a.luma, w, scene.height);
        h.close(&scene.what("derivatives"), &derivatives, truth.as_flattened(), None, ROUNDING);
    }
    Ok(())
}

fn start(h: &mut Harness) -> Result<()> {
    for size in SIZES {
        let s = Scene::new(h, size);
        let (n, width, height) = (s.pixels(), s.width as i32, s.height as i32);
        let mut census = Vec::new();
        for level in [&s.a, &s.b] {
            let luma = upload(h, &single(&level.luma))?;
            let got = run!(
                h,
                Census,
                s.groups::<kernel::Census>(),
                kernel::CensusParams { width, height },
                n,
                |census: u32| kernel::CensusArgs { luma: luma.view(), census }
            );
            h.exact(&s.what("census"), &got, &flow::census(&level.luma, s.width, s.height));
            census.push(got);
        }
        volumes(h, &s, &census)?;
        upsampled(h, &s)?;
    }
    Ok(())
}

/// The matching costs of all displacements, and the cheapest displacement.
fn volumes(h: &mut Harness, s: &Scene, census: &[Vec<u32>]) -> Result<()> {
    let (n, width, height) = (s.pixels(), s.width as i32, s.height as i32);
    let buffers = [upload(h, &census[0])?, upload(h, &census[1])?];
    // The largest window, and windows with fewer displacements than a workgroup has
    // invocations.
    for radius in [16usize, 1, 0] {
        let labels = (2 * radius + 1) * (2 * radius + 1);
        let mut volume = h.output::<u32>("flow volume", n * labels)?;
        let mut truth = vec![0; n * labels];
        let (small_step, large_step) = (3, 20);
        for path in 0..4 {
            let lines = if path < 2 { s.height } else { s.width };
            let mut recorder = h.stream.record()?;
            recorder.dispatch::<kernel::Path>(
                Groups::linear(lines, 1, h.device.limits())?,
                kernel::PathParams {
                    width,
                    height,
                    radius: radius as i32,
                    path: path as u32,
                    small_step,
                    large_step,
                },
                kernel::PathArgs {
                    census_a: buffers[0].view(),
                    census_b: buffers[1].view(),
                    volume: volume.view_mut(),
                },
            )?;
            h.stream.submit(recorder)?;
            flow::accumulate(
                &census[0],
                &census[1],
                [s.width, s.height],
                radius,
                path,
                [small_step, large_step],
                &mut truth,
            );
        }
        let got = h.read(&volume)?;
        h.exact(&s.what(&format!("volume of radius {radius}")), &got, &truth);
        let volume = upload(h, &truth)?;
        let params = kernel::CheapestParams { count: n as u32, radius: radius as i32 };
        let groups = Groups::linear(n, 64, h.device.limits())?;
        let got = run!(h, Cheapest, groups, params, n, |flow: [f32; 2]| {
            kernel::CheapestArgs { volume: volume.view(), flow }
        });
        h.exact(&s.what("cheapest"), &got, &flow::cheapest::<f32>(&truth, radius));
    }
    Ok(())
}

fn upsampled(h: &mut Harness, s: &Scene) -> Result<()> {
    let (width, height) = (s.width as i32, s.height as i32);
    let coarse = upload(h, &singles(&s.flow))?;
    for fine in [[2 * s.width, 2 * s.height], [2 * s.width - 1, 2 * s.height - 1]] {
        let got = run!(
            h,
            Upsample,
            grid::<kernel::Upsample>(fine[0], fine[1]),
            kernel::UpsampleParams {
                coarse_width: width,
                coarse_height: height,
                width: fine[0] as i32,
                height: fine[1] as i32,
            },
            fine[0] * fine[1],
            |flow: [f32; 2]| kernel::UpsampleArgs { coarse: coarse.view(), flow }
        );
        let truth = flow::upsample(&s.flow, s.width, s.height, fine[0], fine[1]);
        let (got, truth) = (got.as_flattened(), truth.as_flattened());
        h.close(&s.what("upsampled"), got, truth, None, ROUNDING);
    }
    Ok(())
}

/// Compares displacement, brightness shift and slope of patches with the oracle's. Rounding can
/// decide which candidate wins, so one patch in a hundred may differ, but no patch may fit much
/// worse.
fn compare_patches(h: &mut Harness, what: &str, got: &[[f32; 4]], truth: &[Patch<f64>]) {
    let (mut strays, mut worse) = (0, 0);
    for (pair, truth) in got.chunks_exact(2).zip(truth) {
        let [u, v, shift, cost] = pair[0].map(f64::from);
        let near = |a: f64, b: f64| (a - b).abs() < 2e-3;
        let same = near(u, truth.flow[0])
            && near(v, truth.flow[1])
            && near(shift, truth.shift)
            && (0..4).all(|k| near(f64::from(pair[1][k]), truth.slope[k]));
        strays += usize::from(!same);
        // NaN counts as worse.
        worse += usize::from(cost.is_nan() || cost > 1.2 * truth.cost + 1e-6);
    }
    let allowed = truth.len().div_ceil(100);
    h.holds(&format!("{what}: {strays} of {} stray", truth.len()), strays <= allowed);
    h.holds(&format!("{what}: {worse} fit worse"), worse <= allowed);
}

fn pack(patches: &[Patch<f64>]) -> Vec<[f32; 4]> {
    patches
        .iter()
        .flat_map(|p| [[p.flow[0], p.flow[1], p.shift, p.cost], p.slope])
        .map(|v| v.map(|c| c as f32))
        .collect()
}

/// A pair of levels on the device.
struct Levels {
    luma: [Buffer<f32>; 2],
    derivatives: [Buffer<f32>; 2],
}

impl Levels {
    fn of(h: &Harness, s: &Scene) -> Result<Levels> {
        let derivatives =
            |level: &Level<f64>| upload(h, singles(&level.derivatives).as_flattened());
        Ok(Levels {
            luma: [upload(h, &single(&s.a.luma))?, upload(h, &single(&s.b.luma))?],
            derivatives: [derivatives(&s.a)?, derivatives(&s.b)?],
        })
    }
}

fn patches(h: &mut Harness) -> Result<()> {
    for size in SIZES {
        let s = Scene::new(h, size);
        let levels = Levels::of(h, &s)?;
        let mut truth = searched(h, &s, &levels)?;
        for pass in 0..2 {
            truth = propagated(h, &s, &levels, &truth, pass)?;
        }
        densified(h, &s, &levels, &truth)?;
    }
    Ok(())
}

/// The search for each patch, without guesses and with them; returns the oracle's patches.
fn searched(h: &mut Harness, s: &Scene, levels: &Levels) -> Result<Vec<Patch<f64>>> {
    let settings = FlowSettings::default();
    let FlowSettings { search_steps, noise, .. } = settings;
    let (width, height) = (s.width as i32, s.height as i32);
    let start_flow = vec![[0.0; 2]; s.pixels()];
    let start = upload(h, &singles(&start_flow))?;
    // A guess for an image twice as large, with invalid entries.
    let mut guess = flow::upsample(&s.flow, s.width, s.height, 2 * s.width, 2 * s.height);
    guess.iter_mut().step_by(7).for_each(|f| *f = [f64::NAN; 2]);
    let guess_buffer = upload(h, &singles(&guess))?;
    let (nx, ny) = (flow::patch_grid(s.width), flow::patch_grid(s.height));
    let mut truth = Vec::new();
    for guided in [false, true] {
        let at_half = (guess.as_slice(), 2 * s.width, 2 * s.height, 1);
        truth = flow::search(&s.a, &s.b, &start_flow, guided.then_some(at_half), &settings);
        let got = run!(
            h,
            Search,
            grid::<kernel::Search>(nx, ny),
            kernel::SearchParams {
                width,
                height,
                search_steps,
                noise,
                guess_width: if guided { 2 * width } else { 0 },
                guess_height: if guided { 2 * height } else { 0 },
                guess_scale: 2.0,
            },
            2 * nx * ny,
            |patches: [f32; 4]| kernel::SearchArgs {
                luma_a: levels.luma[0].view(),
                luma_b: levels.luma[1].view(),
                derivatives_a: levels.derivatives[0].view(),
                start: start.view(),
                guess: guess_buffer.view(),
                patches,
            }
        );
        compare_patches(h, &s.what("search"), &got, &truth);
    }
    Ok(truth)
}

/// One pass of propagation; returns the oracle's patches after it.
fn propagated(
    h: &mut Harness,
    s: &Scene,
    levels: &Levels,
    given: &[Patch<f64>],
    pass: u32,
) -> Result<Vec<Patch<f64>>> {
    let settings = FlowSettings::default();
    let FlowSettings { search_steps, noise, .. } = settings;
    let patches = upload(h, &pack(given))?;
    let (nx, ny) = (flow::patch_grid(s.width), flow::patch_grid(s.height));
    let truth = flow::propagate(&s.a, &s.b, given, pass, &settings);
    let got = run!(
        h,
        Propagate,
        grid::<kernel::Propagate>(nx, ny),
        kernel::PropagateParams {
            width: s.width as i32,
            height: s.height as i32,
            search_steps,
            noise,
            reach: 1 + pass as i32,
        },
        2 * nx * ny,
        |spread: [f32; 4]| kernel::PropagateArgs {
            luma_a: levels.luma[0].view(),
            luma_b: levels.luma[1].view(),
            derivatives_a: levels.derivatives[0].view(),
            patches: patches.view(),
            spread,
        }
    );
    compare_patches(h, &s.what("propagate"), &got, &truth);
    Ok(truth)
}

fn densified(h: &mut Harness, s: &Scene, levels: &Levels, given: &[Patch<f64>]) -> Result<()> {
    let patches = upload(h, &pack(given))?;
    let got = run!(
        h,
        Densify,
        s.groups::<kernel::Densify>(),
        kernel::DensifyParams { width: s.width as i32, height: s.height as i32 },
        s.pixels(),
        |flow: [f32; 2]| kernel::DensifyArgs {
            luma_a: levels.luma[0].view(),
            luma_b: levels.luma[1].view(),
            patches: patches.view(),
            flow,
        }
    );
    let dense = flow::densify(&s.a, &s.b, given);
    // The weights' differences of nearly equal luminances carry few digits.
    let bound = Bound { absolute: 2e-4, relative: 2e-5 };
    h.close(&s.what("dense"), got.as_flattened(), dense.as_flattened(), None, bound);
    Ok(())
}

fn refine(h: &mut Harness) -> Result<()> {
    let t = FlowSettings::default();
    for size in SIZES {
        let s = Scene::new(h, size);
        let (n, width, height) = (s.pixels(), s.width as i32, s.height as i32);
        let Levels { luma, derivatives } = Levels::of(h, &s)?;
        let trust: Vec<f64> =
            (0..n).map(|_| f64::from(h.rng.random_range(0.001f32..1.0))).collect();
        let (flow, trusts) = (upload(h, &singles(&s.flow))?, upload(h, &single(&trust))?);
        let slopes: Vec<[f64; 4]> =
            (0..n).map(|_| [0; 4].map(|_| f64::from(h.rng.random_range(-0.1f32..0.1)))).collect();
        let slope = upload(h, &singles(&slopes))?;
        let mut matrices = h.output::<[f32; 4]>("flow/linearise matrices", n)?;
        let mut sides = h.output::<[f32; 2]>("flow/linearise sides", n)?;
        let mut recorder = h.stream.record()?;
        recorder.dispatch::<kernel::Linearise>(
            s.groups::<kernel::Linearise>(),
            kernel::LineariseParams {
                width,
                height,
                brightness: t.brightness,
                gradient: t.gradient,
                smoothness: t.smoothness,
                edge: t.edge,
                noise: t.noise,
                kink: t.kink,
            },
            kernel::LineariseArgs {
                luma_a: luma[0].view(),
                luma_b: luma[1].view(),
                derivatives_a: derivatives[0].view(),
                derivatives_b: derivatives[1].view(),
                flow: flow.view(),
                trust: trusts.view(),
                slopes: slope.view(),
                matrices: matrices.view_mut(),
                sides: sides.view_mut(),
            },
        )?;
        h.stream.submit(recorder)?;
        let (matrices, sides) = (h.read(&matrices)?, h.read(&sides)?);
        let mut equations = flow::linearise(&s.a, &s.b, &s.flow, &trust, &slopes, t.smoothness, &t);
        let truth_m: Vec<f64> = equations.iter().flat_map(|e| [e.a, e.b, e.c, e.pull]).collect();
        let truth_s: Vec<f64> = equations.iter().flat_map(|e| [e.r, e.s]).collect();
        // Entries reach 1/kink = 20; where noise² rules the normalisation, roundings of the
        // gradients show.
        let bound = Bound { absolute: 2e-3, relative: 1e-3 };
        h.close(&s.what("matrices"), matrices.as_flattened(), &truth_m, None, bound);
        h.close(&s.what("sides"), sides.as_flattened(), &truth_s, None, bound);
        sloped(h, &s, &trust)?;
        slanted(h, &s, &mut equations, &slopes)?;
        relaxed(h, &s, &equations, &t)?;
        let got = run!(
            h,
            Median,
            s.groups::<kernel::Median>(),
            kernel::MedianParams { width, height },
            n,
            |filtered: [f32; 2]| kernel::MedianArgs { flow: flow.view(), filtered }
        );
        h.exact(&s.what("median"), &got, &singles(&flow::median(&s.flow, s.width, s.height)));
    }
    Ok(())
}

/// The slopes of the flow.
fn sloped(h: &mut Harness, s: &Scene, trust: &[f64]) -> Result<()> {
    let (flow, trusts) = (upload(h, &singles(&s.flow))?, upload(h, &single(trust))?);
    let got = run!(
        h,
        Slopes,
        s.groups::<kernel::Slopes>(),
        kernel::SlopesParams { width: s.width as i32, height: s.height as i32 },
        s.pixels(),
        |slopes: [f32; 4]| kernel::SlopesArgs { flow: flow.view(), trust: trusts.view(), slopes }
    );
    let truth = flow::slopes(&s.flow, trust, s.width, s.height);
    // The moments are centred by a difference.
    let bound = Bound { absolute: 1e-6, relative: 1e-4 };
    h.close(&s.what("slopes"), got.as_flattened(), truth.as_flattened(), None, bound);
    Ok(())
}

/// The right-hand sides with the differences that slopes predict; `equations` receives the oracle's.
fn slanted(
    h: &mut Harness,
    s: &Scene,
    equations: &mut [Equation<f64>],
    slopes: &[[f64; 4]],
) -> Result<()> {
    let matrices: Vec<_> = equations.iter().map(|e| [e.a, e.b, e.c, e.pull]).collect();
    let sides: Vec<_> = equations.iter().map(|e| [e.r, e.s]).collect();
    let (matrices, sides) = (upload(h, &singles(&matrices))?, upload(h, &singles(&sides))?);
    let slope = upload(h, &singles(slopes))?;
    let mut guarded = h.output::<[f32; 2]>("flow/slant", s.pixels())?;
    let mut recorder = h.stream.record()?;
    recorder.copy(sides.view(), guarded.view_mut());
    recorder.dispatch::<kernel::Slant>(
        s.groups::<kernel::Slant>(),
        kernel::SlantParams { width: s.width as i32, height: s.height as i32 },
        kernel::SlantArgs {
            matrices: matrices.view(),
            slopes: slope.view(),
            sides: guarded.view_mut(),
        },
    )?;
    h.stream.submit(recorder)?;
    let got = h.read(&guarded)?;
    flow::slant(equations, slopes, s.width, s.height);
    let truth: Vec<f64> = equations.iter().flat_map(|e| [e.r, e.s]).collect();
    // Rounded inputs of up to some tens.
    let bound = Bound { absolute: 2e-5, relative: 1e-5 };
    h.close(&s.what("slanted"), got.as_flattened(), &truth, None, bound);
    Ok(())
}

/// Both colours, twice.
fn relaxed(
    h: &mut Harness,
    s: &Scene,
    equations: &[Equation<f64>],
    t: &FlowSettings,
) -> Result<()> {
    let (width, height) = (s.width as i32, s.height as i32);
    let matrices: Vec<_> = equations.iter().map(|e| [e.a, e.b, e.c, e.pull]).collect();
    let sides: Vec<_> = equations.iter().map(|e| [e.r, e.s]).collect();
    let (matrices, sides) = (upload(h, &singles(&matrices))?, upload(h, &singles(&sides))?);
    let input = upload(h, &singles(&s.flow))?;
    let mut guarded = h.output::<[f32; 2]>("flow/relax", s.pixels())?;
    let mut recorder = h.stream.record()?;
    recorder.copy(input.view(), guarded.view_mut());
    let mut truth = s.flow.clone();
    for half_sweep in 0..4 {
        let colour = half_sweep % 2;
        recorder.dispatch::<kernel::Relax>(
            grid::<kernel::Relax>(s.width.div_ceil(2), s.height),
            kernel::RelaxParams { width, height, colour, relaxation: t.relaxation },
            kernel::RelaxArgs {
                matrices: matrices.view(),
                sides: sides.view(),
                flow: guarded.view_mut(),
            },
        )?;
        flow::relax(&mut truth, equations, s.width, s.height, colour as usize, t);
    }
    h.stream.submit(recorder)?;
    let got = h.read(&guarded)?;
    // The right-hand sides are rounded to f32, and weakly constrained pixels amplify that.
    let bound = Bound { absolute: 2e-4, relative: 1e-4 };
    h.close(&s.what("relaxed"), got.as_flattened(), truth.as_flattened(), None, bound);
    Ok(())
}

fn consistency(h: &mut Harness) -> Result<()> {
    for size in SIZES {
        let s = Scene::new(h, size);
        let (n, width, height) = (s.pixels(), s.width as i32, s.height as i32);
        let luma = [upload(h, &single(&s.a.luma))?, upload(h, &single(&s.b.luma))?];
        let (there, back) = (upload(h, &singles(&s.flow))?, upload(h, &singles(&s.back))?);
        let got = run!(
            h,
            Trust,
            s.groups::<kernel::Trust>(),
            kernel::TrustParams { width, height },
            n,
            |trust: f32| kernel::TrustArgs { forward: there.view(), backward: back.view(), trust }
        );
        let truth = flow::trust(&s.flow, &s.back, s.width, s.height);
        // The square of a ratio of up to some tens.
        let bound = Bound { absolute: 1e-5, relative: 1e-5 };
        h.close(&s.what("trust"), &got, &truth, None, bound);
        let got = run!(
            h,
            Confidence,
            s.groups::<kernel::Confidence>(),
            kernel::ConfidenceParams { width, height },
            n,
            |confidence: f32| kernel::ConfidenceArgs {
                luma_a: luma[0].view(),
                luma_b: luma[1].view(),
                forward: there.view(),
                backward: back.view(),
                confidence,
            }
        );
        let truth = flow::confidence(&s.a, &s.b, &s.flow, &s.back);
        // A variance of 25 differences of luminances, over a floor of 4e-4.
        let bound = Bound { absolute: 2e-5, relative: 1e-4 };
        h.close(&s.what("confidence"), &got, &truth, None, bound);
    }
    Ok(())
}
