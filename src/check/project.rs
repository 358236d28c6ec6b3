//! Projection against the oracle.

use super::scene::{Frame, compare_gradients, random, random_gradient, skew_camera};
use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::gaussians::{GaussianBuffers, HalfHarmonics};
use crate::ops::render::Render;
use crate::oracle::project::{Splat, project};
use crate::oracle::project_backward::{SplatGradient, project_backward};
use crate::oracle::sh;
use crate::oracle::view::{Cloud, View};
use crate::types::{Camera, Gaussians, RenderSettings};

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "project/forward", kernels: &["project/forward"], run: forward },
    Case { id: "project/degrees", kernels: &["project/forward"], run: degrees },
    Case { id: "project/half_harmonics", kernels: &["project/forward"], run: half_harmonics },
    Case { id: "project/backward", kernels: &["project/backward", "project/pose"], run: backward },
];

const WIDTH: u32 = 83;
const HEIGHT: u32 = 59;

/// Which Gaussians are drawn and how many tiles they reach, with a cut and a near plane moved by
/// this share: between the two lies what rounding may decide either way.
const BAND: f32 = 1e-4;

fn compare(harness: &mut Harness, what: &str, scene: &Gaussians, camera: &Camera) -> Result<()> {
    let settings = RenderSettings::default();
    let device = harness.device.clone();
    let mut frame = Frame::new(&device, &mut harness.stream, scene, camera, 1 << 15, settings)?;
    let out = frame.forward(&mut harness.stream)?;
    let cloud = Cloud::<f64>::new(scene);
    let view = View::new(camera);
    let truth = project(&cloud, &view, &settings);
    let moved = |by: f32| RenderSettings {
        alpha_cut: settings.alpha_cut * (1.0 + by),
        near: settings.near * (1.0 + by),
        ..settings
    };
    let tiles = |splats: Vec<Option<Splat<f64>>>| -> Vec<u32> {
        splats.iter().map(|s| s.map_or(0, |s| s.tile_count)).collect()
    };
    let least = tiles(project(&cloud, &view, &moved(BAND)));
    let most = tiles(project(&cloud, &view, &moved(-BAND)));
    let within = (0..scene.len()).all(|i| {
        let count = out.tile_counts[i];
        least[i] <= count && count <= most[i] && out.visible[i] == u32::from(count > 0)
    });
    harness.holds(&format!("{what}: culling and tile counts"), within);
    let exactly = (0..scene.len()).filter(|&i| least[i] == most[i]).count();
    harness.holds(&format!("{what}: hardly any hangs"), exactly * 100 >= scene.len() * 99);

    let single = project(&Cloud::<f32>::new(scene), &View::new(camera), &settings);
    let drawn: Vec<usize> = (0..scene.len())
        .filter(|&i| out.visible[i] != 0 && truth[i].is_some() && single[i].is_some())
        .collect();
    harness.holds(&format!("{what}: many are drawn"), 2 * drawn.len() + 1 > scene.len());
    let mut hold = |name: &str,
                    device: &dyn Fn(usize) -> Vec<f32>,
                    exact: &dyn Fn(&Splat<f64>) -> Vec<f64>,
                    narrow: &dyn Fn(&Splat<f32>) -> Vec<f32>,
                    bound: Bound| {
        let device: Vec<f32> = drawn.iter().flat_map(|&i| device(i)).collect();
        let exact: Vec<f64> =
            drawn.iter().flat_map(|&i| exact(truth[i].as_ref().expect("drawn"))).collect();
        let narrow: Vec<f32> =
            drawn.iter().flat_map(|&i| narrow(single[i].as_ref().expect("drawn"))).collect();
        harness.close(&format!("{what}: {name}"), &device, &exact, Some(&narrow), bound);
    };
    // Coordinates carry 5e-7 (three products of numbers up to 6); the mean has that times focal / z,
    // and z goes down to the near plane.
    let bound = Bound { absolute: 2e-4, relative: 2e-6 };
    hold("mean", &|i| out.means[i][..2].to_vec(), &|s| s.mean.into(), &|s| s.mean.into(), bound);
    let bound = Bound { absolute: 1e-6, relative: 2e-7 };
    hold("depth", &|i| vec![out.means[i][2]], &|s| vec![s.depth], &|s| vec![s.depth], bound);
    // A driver's exponential is off by 4e-7 on the logits' range.
    let bound = Bound { absolute: 0.0, relative: 2e-6 };
    let opacity = |i: usize| vec![out.means[i][3]];
    hold("opacity", &opacity, &|s| vec![s.opacity], &|s| vec![s.opacity], bound);
    // Entries as a share of the largest: A and C differ by the needle's aspect squared.
    let bound = Bound { absolute: 2e-6, relative: 0.0 };
    let share = |conic: [f64; 3]| conic.map(|x| x / (conic[0] + conic[2]));
    let device_share = |i: usize| {
        let [a, b, c, _] = out.conics[i];
        share([a, b, c].map(f64::from)).map(|x| x as f32).to_vec()
    };
    hold(
        "conic's shape",
        &device_share,
        &|s| share(s.conic).into(),
        &|s| share(s.conic.map(f64::from)).map(|x| x as f32).into(),
        bound,
    );
    let bound = Bound { absolute: 0.0, relative: 1e-5 };
    let size = |i: usize| vec![out.conics[i][0] + out.conics[i][2]];
    let trace = |s: &Splat<f32>| vec![s.conic[0] + s.conic[2]];
    hold("conic's size", &size, &|s| vec![s.conic[0] + s.conic[2]], &trace, bound);
    // Sixteen terms of up to 1; the direction carries 1e-7, and more close to the camera.
    let bound = Bound { absolute: 3e-6, relative: 0.0 };
    let colour = |i: usize| out.colours[i][..3].to_vec();
    hold("colour", &colour, &|s| s.colour.into(), &|s| s.colour.into(), bound);
    let bound = Bound { absolute: 2e-6, relative: 0.0 };
    let limit = |i: usize| vec![out.conics[i][3]];
    hold("reach", &limit, &|s| vec![s.reach(&settings)], &|s| vec![s.reach(&settings)], bound);
    Ok(())
}

fn forward(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(WIDTH, HEIGHT);
    for count in [2, 63, 64, 65, 3000] {
        let scene = random(&mut harness.rng, count, 3, &camera);
        compare(harness, &format!("{count} Gaussians"), &scene, &camera)?;
    }
    Ok(())
}

fn degrees(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(WIDTH, HEIGHT);
    for degree in 0..3 {
        let scene = random(&mut harness.rng, 500, degree, &camera);
        compare(harness, &format!("degree {degree}"), &scene, &camera)?;
    }
    Ok(())
}

/// Harmonics in 16 bits give the colours of rounded coefficients, and change nothing else. Odd
/// numbers leave half of the last word empty.
fn half_harmonics(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(WIDTH, HEIGHT);
    let settings = RenderSettings::default();
    for (degree, count) in [(0, 5), (1, 65), (2, 64), (3, 501)] {
        let scene = random(&mut harness.rng, count, degree, &camera);
        let device = harness.device.clone();
        let stream = &mut harness.stream;
        let buffers = GaussianBuffers::from_host(stream, &scene)?;
        let half = HalfHarmonics::from_host(&device, &scene)?;
        let render = Render::plan(&device, count, 1 << 15, WIDTH, HEIGHT, settings)?;
        let mut run = |views| -> Result<_> {
            let (mut scratch, mut pixels) = (render.scratch(&device)?, render.pixels(&device)?);
            let mut recorder = stream.record()?;
            recorder.fill(scratch.means.view_mut(), 0);
            render.forward(&mut recorder, &camera, views, &mut scratch, &mut pixels)?;
            stream.submit(recorder)?;
            let visible = stream.download(&scratch.visible)?;
            let means = stream.download(&scratch.means)?;
            Ok((stream.download(&scratch.colours)?, visible, means))
        };
        let (_, visible, means) = run(buffers.views())?;
        let (colours, visible_half, means_half) = run(half.replace(buffers.views()))?;
        let mut cloud = Cloud::<f64>::new(&scene);
        cloud.sh = sh::halves(&cloud.sh);
        let mut narrow = Cloud::<f32>::new(&scene);
        narrow.sh = sh::halves(&narrow.sh);
        let truth = project(&cloud, &View::new(&camera), &settings);
        let single = project(&narrow, &View::new(&camera), &settings);
        let drawn: Vec<usize> = (0..count)
            .filter(|&i| visible[i] != 0 && truth[i].is_some() && single[i].is_some())
            .collect();
        let what = format!("degree {degree}");
        harness.exact(&format!("{what}: visible"), &visible_half, &visible);
        harness.exact(&format!("{what}: means"), &means_half, &means);
        let device: Vec<f32> = drawn.iter().flat_map(|&i| colours[i][..3].to_vec()).collect();
        let exact: Vec<f64> = drawn.iter().flat_map(|&i| truth[i].expect("drawn").colour).collect();
        let twin: Vec<f32> = drawn.iter().flat_map(|&i| single[i].expect("drawn").colour).collect();
        // As for harmonics in f32.
        let bound = Bound { absolute: 3e-6, relative: 0.0 };
        harness.close(&format!("{what}: colour"), &device, &exact, Some(&twin), bound);
    }
    Ok(())
}

/// Given the splats' gradients as the device itself has gathered them.
fn backward(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(WIDTH, HEIGHT);
    let settings = RenderSettings::default();
    for (degree, count) in [(0, 65), (1, 300), (2, 300), (3, 2000)] {
        let scene = random(&mut harness.rng, count, degree, &camera);
        let device = harness.device.clone();
        let mut frame =
            Frame::new(&device, &mut harness.stream, &scene, &camera, 1 << 15, settings)?;
        let splats = frame.forward(&mut harness.stream)?.splats();
        let gradient = random_gradient(&mut harness.rng, &vec![false; (WIDTH * HEIGHT) as usize]);
        let out = frame.backward(&mut harness.stream, &gradient)?;
        let wide: Vec<_> = out.splats.iter().map(widen).collect();
        let (exact, exact_view) =
            project_backward(&Cloud::new(&scene), &View::new(&camera), &settings, &splats, &wide);
        let (single, single_view) = project_backward(
            &Cloud::<f32>::new(&scene),
            &View::new(&camera),
            &settings,
            &super::scene::narrow(&splats),
            &out.splats,
        );
        // Measured: a tenth of it at most, the oracle in f32 the same.
        compare_gradients(
            harness,
            &format!("degree {degree}"),
            &out,
            (&exact, &exact_view.twist),
            (&single, &single_view.twist),
            4e-6,
            4e-5,
        );
    }
    Ok(())
}

fn widen(g: &SplatGradient<f32>) -> SplatGradient<f64> {
    SplatGradient {
        mean: g.mean.map(f64::from),
        conic: g.conic.map(f64::from),
        opacity: f64::from(g.opacity),
        depth: f64::from(g.depth),
        colour: g.colour.map(f64::from),
    }
}
