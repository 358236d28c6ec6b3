//! Check cases of projection.

use super::scene::{
    Backward, Forward, Frame, UPRIGHT, compare_gradients, join, one, plain_camera, random,
    random_gradient, skew_camera,
};
use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::gaussians::{GaussianBuffers, GaussianViews};
use crate::ops::half::{HalfHarmonics, HalfShapes};
use crate::ops::render::Render;
use crate::oracle::half;
use crate::oracle::project::{Splat, project};
use crate::oracle::project_backward::{SplatGradient, project_backward};
use crate::oracle::view::{Cloud, View};
use crate::types::{Camera, Gaussians, RenderSettings};
use glam::DVec3;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "project/forward", run: forward },
    Case { id: "project/degrees", run: degrees },
    Case { id: "project/halves", run: halves },
    Case { id: "project/decisions", run: decisions },
    Case { id: "project/backward", run: backward },
];

const WIDTH: u32 = 83;
const HEIGHT: u32 = 59;

/// Relative tolerance of the α cut and the near plane for the decisions which Gaussians are drawn
/// and which tiles they overlap; within it either decision is accepted.
const BAND: f32 = 1e-4;

/// The number of tiles of each Gaussian in the oracle, with thresholds that are moved by a share of their
/// value; 0 for one that is culled.
fn tile_counts(scene: &Gaussians, camera: &Camera, by: f32) -> Vec<u32> {
    let settings = RenderSettings::default();
    let moved = RenderSettings {
        alpha_cut: settings.alpha_cut * (1.0 + by),
        near: settings.near * (1.0 + by),
        ..settings
    };
    let splats = project(&Cloud::<f64>::new(scene), &View::new(camera), &moved);
    splats.iter().map(|s| s.map_or(0, |s| s.tile_count)).collect()
}

/// Compares which Gaussians are drawn and how many tiles they overlap.
fn compare_culling(
    harness: &mut Harness,
    what: &str,
    scene: &Gaussians,
    camera: &Camera,
    out: &Forward,
) {
    let least = tile_counts(scene, camera, BAND);
    let most = tile_counts(scene, camera, -BAND);
    let within = (0..scene.len()).all(|i| {
        let count = out.tile_counts[i];
        least[i] <= count && count <= most[i] && out.visible[i] == u32::from(count > 0)
    });
    harness.holds(&format!("{what}: culling and tile counts"), within);
    let exactly = (0..scene.len()).filter(|&i| least[i] == most[i]).count();
    harness.holds(&format!("{what}: hardly any is undecided"), exactly * 100 >= scene.len() * 99);
}

/// How far a splat's mean may be off, pixels. Each coordinate in the camera's frame has the rounding of
/// three products and two sums, 4e-7 of the distance; the mean has that times focal / z, and two roundings
/// of its own.
fn mean_limits(splat: &Splat<f64>, view: &View<f64>) -> [f64; 2] {
    let tangent: [f64; 2] =
        std::array::from_fn(|k| (splat.mean[k] - view.centre[k]) / view.focal[k]);
    let slant = (1.0 + tangent[0].powi(2) + tangent[1].powi(2)).sqrt();
    [0, 1].map(|k| {
        let by_view = 4e-7 * view.focal[k] * slant * (1.0 + tangent[k].abs());
        by_view + 2e-7 * splat.mean[k].abs() + 2e-7 * view.centre[k]
    })
}

fn compare(harness: &mut Harness, what: &str, scene: &Gaussians, camera: &Camera) -> Result<()> {
    let settings = RenderSettings::default();
    let device = harness.device.clone();
    let mut frame = Frame::new(&device, &mut harness.stream, scene, camera, 1 << 15, settings)?;
    let out = frame.forward(&mut harness.stream)?;
    compare_culling(harness, what, scene, camera, &out);
    let view = View::new(camera);
    let truth = project(&Cloud::<f64>::new(scene), &view, &settings);
    let single = project(&Cloud::<f32>::new(scene), &View::new(camera), &settings);
    let drawn: Vec<usize> = (0..scene.len())
        .filter(|&i| out.visible[i] != 0 && truth[i].is_some() && single[i].is_some())
        .collect();
    if scene.len() >= 60 {
        harness.holds(&format!("{what}: many are drawn"), 2 * drawn.len() > scene.len());
    }
    let limits: Vec<f64> =
        drawn.iter().flat_map(|&i| mean_limits(truth[i].as_ref().expect("drawn"), &view)).collect();
    let pairs =
        |at: &dyn Fn(usize) -> [f64; 2]| drawn.iter().flat_map(|&i| at(i)).collect::<Vec<f64>>();
    let device: Vec<f32> = drawn.iter().flat_map(|&i| [out.means[i][0], out.means[i][1]]).collect();
    let twin: Vec<f32> =
        drawn.iter().flat_map(|&i| single[i].as_ref().expect("drawn").mean).collect();
    let exact = pairs(&|i| truth[i].as_ref().expect("drawn").mean);
    harness.within(&format!("{what}: mean"), &device, &exact, Some(&twin), &limits);
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
    let bound = Bound { absolute: 1e-6, relative: 2e-7 };
    hold("depth", &|i| vec![out.means[i][2]], &|s| vec![s.depth], &|s| vec![s.depth], bound);
    // A driver's exponential is off by 4e-7 on the logits' range.
    let bound = Bound { absolute: 0.0, relative: 2e-6 };
    let opacity = |i: usize| vec![out.means[i][3]];
    hold("opacity", &opacity, &|s| vec![s.opacity], &|s| vec![s.opacity], bound);
    // Entries as a share of the largest: a and e differ by the needle's aspect.
    let bound = Bound { absolute: 2e-6, relative: 0.0 };
    let share = |[a, b, e]: [f64; 3]| [a, b, e].map(|x| x / (a + e));
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

/// 16-bit attributes give the same result, bit for bit, as the rounded attributes in f32; the other
/// cases check the accuracy of f32. With odd counts half of the last word is unused.
fn halves(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(WIDTH, HEIGHT);
    let mut results = Vec::new();
    for (degree, count) in [(0, 5), (1, 65), (2, 64), (3, 501)] {
        let mut scene = random(&mut harness.rng, count, degree, &camera);
        for rotation in &mut scene.rotations {
            let length = 10.0f32.powf(harness.rng.random_range(-5.0..8.0));
            *rotation = rotation.map(|x| x * length);
        }
        scene.rotations[0] = [0.0; 4];
        scene.log_scales[1] = [9e4; 3];
        let (device, stream) = (harness.device.clone(), &mut harness.stream);
        let render =
            Render::plan(&device, count, 1 << 15, WIDTH, HEIGHT, RenderSettings::default())?;
        let mut run = |views: GaussianViews<'_>| -> Result<_> {
            let mut frame = render.frame(&device)?;
            let scratch = &mut frame.scratch;
            let mut recorder = stream.record()?;
            for what in [&mut scratch.means, &mut scratch.conics, &mut scratch.colours] {
                recorder.fill(what.view_mut(), 0);
            }
            frame.forward(&mut recorder, &camera, views, Default::default())?;
            stream.submit(recorder)?;
            let scratch = &frame.scratch;
            Ok((
                stream.download(&scratch.tile_counts)?,
                [&scratch.means, &scratch.conics, &scratch.colours]
                    .map(|what| stream.download(what))
                    .into_iter()
                    .collect::<Result<Vec<_>>>()?
                    .concat(),
            ))
        };
        let own = GaussianBuffers::from_host(&mut device.stream()?, &scene)?;
        let harmonics = HalfHarmonics::from_host(&device, &scene)?;
        let shapes = HalfShapes::from_host(&device, &scene)?;
        let rounded = half::harmonics(&scene);
        for (what, kept, rounded) in [
            ("harmonics", harmonics.replace(own.views()), &rounded),
            ("shapes", shapes.replace(own.views()), &half::shapes(&scene)),
            ("both", shapes.replace(harmonics.replace(own.views())), &half::shapes(&rounded)),
        ] {
            let (tiles, splats) = run(kept)?;
            let rounded = GaussianBuffers::from_host(&mut device.stream()?, rounded)?;
            let (expected_tiles, expected) = run(rounded.views())?;
            let what = format!("degree {degree}, {what}");
            results.push((what, tiles, expected_tiles, splats, expected));
        }
    }
    for (what, tiles, expected_tiles, splats, expected) in results {
        let drawn = expected_tiles.iter().filter(|&&tiles| tiles > 0).count();
        if tiles.len() >= 60 {
            harness.holds(&format!("{what}: many are drawn"), 2 * drawn > tiles.len());
        }
        harness.exact(&format!("{what}: tiles"), &tiles, &expected_tiles);
        let words = |splats: &[[f32; 4]]| bytemuck::cast_slice::<_, u32>(splats).to_vec();
        harness.exact(&format!("{what}: splats"), &words(&splats), &words(&expected));
    }
    Ok(())
}

/// Splats on the near plane, with an opacity at the cut, and with the edge of their extent on a
/// tile border. Outside a narrow band decisions must equal the oracle's; within it not all may
/// differ.
fn decisions(harness: &mut Harness) -> Result<()> {
    let settings = RenderSettings::default();
    let camera = skew_camera(WIDTH, HEIGHT);
    let world_from_view = camera.view_from_world.inverse();
    let cut = settings.alpha_cut / (1.0 - settings.alpha_cut);
    let away = |rng: &mut rand_chacha::ChaCha8Rng| -> f32 {
        let size = 10.0f32.powf(rng.random_range(-8.0..-3.0));
        if rng.random() { size } else { -size }
    };
    let (mut near, mut faint, mut edges) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..600 {
        let rng = &mut harness.rng;
        let z = f64::from(settings.near) * (1.0 + f64::from(away(rng)));
        let at = world_from_view.apply(DVec3::new(0.0, 0.0, z)).as_vec3().to_array();
        near.push(one(at, [-7.0; 3], UPRIGHT, 2.0));
        let at = world_from_view.apply(DVec3::new(0.1, 0.1, 3.0)).as_vec3().to_array();
        faint.push(one(at, [0.5; 3], UPRIGHT, cut.ln() + away(rng)));
        // A round splat on the axis of a plain camera whose extent ends at the next tile's first
        // pixel.
        let scale = rng.random_range(-3.0f32..-1.0);
        let splat = one([0.0, 0.0, 2.0], [scale; 3], UPRIGHT, 2.0);
        let plain = plain_camera(60.0, 96, 96);
        let seen = project(&Cloud::<f64>::new(&splat), &View::new(&plain), &settings);
        let seen = seen[0].expect("in the middle of the image");
        let extent = seen.reach(&settings).sqrt() / seen.conic[0];
        let x = (64.5 - extent + f64::from(away(rng)) - 48.0) * 2.0 / 60.0;
        // At the height of a row of pixel centres.
        edges.push(one([x as f32, 1.0 / 60.0, 2.0], [scale; 3], UPRIGHT, 2.0));
    }
    // The depth's last place at a distance of 1; a driver's exponential; the extent's few places.
    for (what, parts, camera, band) in [
        ("near plane", near, camera, 2e-5),
        ("alpha cut", faint, camera, 4e-6),
        ("tile edges", edges, plain_camera(60.0, 96, 96), 1e-5),
    ] {
        let scene = join(&parts);
        let device = harness.device.clone();
        let mut frame =
            Frame::new(&device, &mut harness.stream, &scene, &camera, 1 << 15, settings)?;
        let out = frame.forward(&mut harness.stream)?;
        let [least, truth, most] = [band, 0.0, -band].map(|by| tile_counts(&scene, &camera, by));
        let device = &out.tile_counts;
        let decided = (0..scene.len()).all(|i| least[i] <= device[i] && device[i] <= most[i]);
        harness.holds(&format!("{what}: as the oracle outside of the band"), decided);
        let undecided = (0..scene.len()).filter(|&i| least[i] != most[i]).count();
        let flips = (0..scene.len()).filter(|&i| device[i] != truth[i]).count();
        harness.holds(
            &format!("{what}: some are undecided"),
            undecided > 0 && 2 * undecided < scene.len() + 300,
        );
        harness.holds(&format!("{what}: {flips} of {undecided} flip"), 2 * flips <= undecided);
        harness.note(device);
    }
    Ok(())
}

/// The backward pass, given the splat gradients that the device itself has summed; with the pose's
/// gradient and without.
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
            &super::scene::as_f32(&splats),
            &out.splats,
        );
        frame.with_pose = false;
        let without = frame.backward(&mut harness.stream, &gradient)?;
        let untouched = without.pose.iter().all(|v| v.to_bits() == u32::MAX);
        harness.holds(&format!("degree {degree}: no pose was asked for"), untouched);
        let without = Backward { pose: out.pose.clone(), ..without };
        for (what, out) in [("", out), (", without the pose", without)] {
            // Measured: a tenth of it at most, the oracle in f32 the same.
            compare_gradients(
                harness,
                &format!("degree {degree}{what}"),
                &out,
                (&exact, &exact_view.twist),
                (&single, &single_view.twist),
                4e-6,
                4e-5,
            );
        }
    }
    Ok(())
}

fn widen(g: &SplatGradient<f32>) -> SplatGradient<f64> {
    SplatGradient {
        mean: g.mean.map(f64::from),
        covariance: g.covariance.map(f64::from),
        opacity: f64::from(g.opacity),
        depth: f64::from(g.depth),
        colour: g.colour.map(f64::from),
    }
}
