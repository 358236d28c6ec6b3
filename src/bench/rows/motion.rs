//! Benchmarks of the motion model: nearest control points, skinning, the deformation network,
//! rigidity.

use super::{NARROW, sizes, thousands};
use crate::Result;
use crate::bench::job::{Entry, Job};
use crate::bench::scenes::{camera, cloud, control_points, rng};
use crate::bench::verify::Check;
use crate::check::Bound;
use crate::check::arap::ArapWorkload;
use crate::check::mlp::{MlpWorkload, Pass, Problem};
use crate::gpu::{Buffer, Device};
use crate::ops::deform::{Skin, SkinArgs, SkinGradients, Skinned};
use crate::oracle::deform;
use crate::report::{Place, Work};
use crate::types::NetShape;
use rand::RngExt;
use std::cell::RefCell;
use std::rc::Rc;

/// Number of control points that a Gaussian follows.
const FOLLOWED: usize = 4;
/// Number of control points in the skinning rows.
const NODES: usize = 512;
pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for n in sizes(quick, &[10_000usize, 100_000]) {
        let size = format!("{} Gaussians, {NODES} nodes", thousands(n));
        all.push(Entry::new("deform/nearest", size.clone(), move |d, s| nearest(d, s, n)));
        all.push(Entry::new("deform/skin", size.clone(), move |d, s| skin(d, s, n, false)));
        all.push(Entry::new("deform/skin_backward", size, move |d, s| skin(d, s, n, true)));
    }
    let of = |most| Bound { absolute: most, relative: 1e-6 };
    for (name, shape, rows, bounds) in sizes(
        quick,
        &[
            // As the cases `mlp/narrow` and `mlp/paper`; a gradient is a sum over the rows.
            ("64 wide", NARROW, 512, [of(1e-6), of(8e-5)]),
            ("64 wide", NARROW, 1536, [of(1e-6), of(2.4e-4)]),
            ("256 wide", NetShape::PAPER, 512, [of(6e-6), of(4.6e-4)]),
        ],
    ) {
        let size = format!("{name}, {} layers, {rows} rows", shape.depth);
        for (id, pass) in [("mlp/forward", Pass::Forward), ("mlp/backward", Pass::Backward)] {
            all.push(Entry::new(id, size.clone(), move |d, seed| {
                Job::of(d, seed, |h| {
                    let problem = Problem::new(h, shape, rows, 1);
                    MlpWorkload::new(h, problem, pass, bounds)
                })
            }));
        }
    }
    for nodes in sizes(quick, &[512usize, 2048]) {
        all.push(Entry::new("arap/energy", format!("{nodes} nodes, 10 edges"), move |d, seed| {
            Job::of(d, seed, |h| ArapWorkload::random(h, nodes, 10))
        }));
    }
    all
}

/// Gaussians that all follow moving control points, on the host and on the device.
struct Scene {
    positions: Vec<[f32; 3]>,
    rotations: Vec<[f32; 4]>,
    opacity_logits: Vec<f32>,
    nodes: Vec<[f32; 3]>,
    log_radii: Vec<f32>,
    transforms: Vec<[f32; 8]>,
    ids: Buffer<u32>,
    position_buffer: Buffer<f32>,
    rotation_buffer: Buffer<[f32; 4]>,
    node_buffer: Buffer<f32>,
    radius_buffer: Buffer<f32>,
    opacity_buffer: Buffer<f32>,
    transform_buffer: Buffer<[f32; 4]>,
}

impl Scene {
    fn new(device: &Device, seed: u64, n: usize) -> Result<Scene> {
        let camera = camera(480, 270);
        let gaussians = cloud(seed, n, 0, &camera);
        let points = control_points(seed, NODES, &camera);
        let mut rng = rng(seed + 3);
        let transforms: Vec<[f32; 8]> = (0..NODES)
            .map(|_| {
                let mut t: [f32; 8] = std::array::from_fn(|_| rng.random_range(-0.3f32..0.3));
                t[4] += 1.0;
                t
            })
            .collect();
        let halves: Vec<[f32; 4]> = bytemuck::cast_slice(&transforms).to_vec();
        Ok(Scene {
            ids: device.upload("dynamic ids", &(0..n as u32).collect::<Vec<_>>())?,
            position_buffer: device.upload("positions", gaussians.positions.as_flattened())?,
            rotation_buffer: device.upload("rotations", &gaussians.rotations)?,
            opacity_buffer: device.upload("opacity logits", &gaussians.opacity_logits)?,
            node_buffer: device.upload("nodes", points.positions.as_flattened())?,
            radius_buffer: device.upload("log radii", &points.log_radii)?,
            transform_buffer: device.upload("transforms", &halves)?,
            positions: gaussians.positions,
            rotations: gaussians.rotations,
            opacity_logits: gaussians.opacity_logits,
            nodes: points.positions,
            log_radii: points.log_radii,
            transforms,
        })
    }

    fn args(&self) -> SkinArgs<'_> {
        SkinArgs {
            gaussian_from_dynamic: self.ids.view(),
            positions: self.position_buffer.view(),
            rotations: self.rotation_buffer.view(),
            opacity_logits: self.opacity_buffer.view(),
            nodes: self.node_buffer.view(),
            log_radii: self.radius_buffer.view(),
            transforms: self.transform_buffer.view(),
            time: 0,
            soft: None,
        }
    }
}

fn nearest(device: &Device, seed: u64, n: usize) -> Result<Job> {
    let scene = Scene::new(device, seed, n)?;
    let mut skin = Skin::new(device, FOLLOWED, n, NODES)?;
    let mut stream = device.stream()?;
    let mut found = device.buffer::<u32>("neighbours", FOLLOWED * n)?;
    let mut recorder = stream.record()?;
    let a = scene.args();
    skin.refresh(&mut recorder, a.gaussian_from_dynamic, a.positions, a.nodes)?;
    recorder.copy(skin.neighbours().neighbours(), found.view_mut());
    stream.submit(recorder)?;
    let mut check = Check::new();
    let truth = deform::nearest(&scene.positions, &scene.nodes, FOLLOWED);
    check.exact("neighbours", &stream.download(&found)?, &truth);
    // Every Gaussian against every control point: differences, squares, a comparison.
    let pairs = (n * NODES) as u64;
    let work =
        Work { bytes: (n * 12 + NODES * 12 + 3 * n * FOLLOWED * 8) as u64, operations: 9 * pairs };
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        let a = scene.args();
        skin.refresh(recorder, a.gaussian_from_dynamic, a.positions, a.nodes)
    })
}

fn skin(device: &Device, seed: u64, n: usize, backward: bool) -> Result<Job> {
    let scene = Scene::new(device, seed, n)?;
    let mut rng = rng(seed + 4);
    let mut random =
        |len: usize| -> Vec<f32> { (0..len).map(|_| rng.random_range(-1.0f32..1.0)).collect() };
    let (by_position, by_rotation) = (random(3 * n), random(4 * n));
    let by_rotation: Vec<[f32; 4]> = bytemuck::cast_slice(&by_rotation).to_vec();
    let mut op = Skin::new(device, FOLLOWED, n, NODES)?;
    let mut moved = device.buffer::<f32>("moved positions", 3 * n)?;
    let mut turned = device.buffer::<[f32; 4]>("moved rotations", n)?;
    let mut faded = device.buffer::<f32>("moved opacities", n)?;
    let mut rigidity = device.buffer::<f32>("rigidity", n)?;
    let mut position_gradients = device.upload("position gradients", &by_position)?;
    let mut rotation_gradients = device.upload("rotation gradients", &by_rotation)?;
    let mut motion_gradients = device.upload("motion gradients", &vec![0.0f32; n])?;
    let mut transform_gradients = device.buffer::<[f32; 4]>("transform gradients", 2 * NODES)?;
    let mut radius_gradients = device.buffer::<f32>("radius gradients", NODES)?;
    macro_rules! outputs {
        () => {
            Skinned {
                positions: moved.view_mut(),
                rotations: turned.view_mut(),
                opacity_logits: faded.view_mut(),
                rigidity: rigidity.view_mut(),
            }
        };
    }
    macro_rules! gradients {
        () => {
            SkinGradients {
                positions: position_gradients.view_mut(),
                rotations: rotation_gradients.view_mut(),
                motion_logits: motion_gradients.view_mut(),
                transforms: transform_gradients.view_mut(),
                log_radii: radius_gradients.view_mut(),
                accumulate: false,
                rigid_scale: 0.0,
            }
        };
    }
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    let a = scene.args();
    op.refresh(&mut recorder, a.gaussian_from_dynamic, a.positions, a.nodes)?;
    op.forward(&mut recorder, a, outputs!())?;
    op.backward(&mut recorder, a, gradients!())?;
    stream.submit(recorder)?;

    fn wide<const N: usize>(values: &[[f32; N]]) -> Vec<[f64; N]> {
        values.iter().map(|v| v.map(f64::from)).collect()
    }
    let (positions, rotations) = (wide(&scene.positions), wide(&scene.rotations));
    let (nodes, transforms) = (wide(&scene.nodes), wide(&scene.transforms));
    let flat = |values: &[f32]| -> Vec<f64> { values.iter().map(|&v| f64::from(v)).collect() };
    let (log_radii, opacity_logits) = (flat(&scene.log_radii), flat(&scene.opacity_logits));
    let neighbours = deform::nearest(&scene.positions, &scene.nodes, FOLLOWED);
    let (zeros, ids) = (vec![0.0f64; n], (0..n as u32).collect::<Vec<_>>());
    let truth = deform::Skin {
        positions: &positions,
        rotations: &rotations,
        opacity_logits: &opacity_logits,
        motion_logits: &zeros,
        evidence: &zeros,
        gaussian_from_dynamic: &ids,
        neighbours: &neighbours,
        k: FOLLOWED,
        nodes: &nodes,
        log_radii: &log_radii,
        transforms: &transforms,
        soft: false,
    };
    let mut check = Check::new();
    if backward {
        let by: Vec<[f64; 3]> = wide(bytemuck::cast_slice(&by_position));
        let exact = deform::backward(&truth, &by, &wide(&by_rotation), 0.0);
        let mut hold = |name: &str, device: &[f32], exact: &[f64]| {
            let largest = exact.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let bound = Bound { absolute: 1e-5 * largest, relative: 1e-4 };
            check.close(name, device, exact, bound);
        };
        let got = stream.download(&position_gradients)?;
        hold("gradient by position", &got, exact.positions.as_flattened());
        let got = stream.download(&transform_gradients)?.into_flattened();
        hold("gradient by transform", &got, exact.transforms.as_flattened());
        let got = stream.download(&radius_gradients)?;
        hold("gradient by radius", &got, &exact.log_radii);
    } else {
        let exact = deform::forward(&truth);
        // Coordinates of up to 6.
        let bound = Bound { absolute: 1e-5, relative: 2e-6 };
        let got = stream.download(&moved)?;
        check.close("moved positions", &got, exact.positions.as_flattened(), bound);
        let got = stream.download(&turned)?.into_flattened();
        check.close("moved rotations", &got, exact.rotations.as_flattened(), bound);
        let got = stream.download(&faded)?;
        check.close("moved opacities", &got, &exact.opacity_logits, bound);
    }
    let n = n as u64;
    let followed = n * FOLLOWED as u64;
    // Positions, quaternions and opacities in and out, the lists; a turn, a shift and a weight per
    // neighbour.
    let mut work = Work { bytes: n * (32 + 32 + 28) + followed * 4, operations: followed * 90 };
    if backward {
        // Contributions of each neighbour are written and gathered.
        work = Work { bytes: n * 112 + followed * (4 + 64 + 4), operations: followed * 260 };
        // The gradients change in place: each execution starts from fresh ones.
        let (positions, rotations) = (by_position, by_rotation);
        let (mut upload, mut stream) = (device.stream()?, device.stream()?);
        let state = Rc::new(RefCell::new((position_gradients, rotation_gradients)));
        let again = state.clone();
        return Ok(Job {
            accuracy: check.accuracy(),
            work,
            place: Place::Device,
            reset: Some(Box::new(move || {
                let (p, r) = &mut *again.borrow_mut();
                upload.upload(p, &positions)?;
                upload.upload(r, &rotations)
            })),
            execute: Box::new(move || {
                let (p, r) = &mut *state.borrow_mut();
                let mut recorder = stream.record()?;
                let gradients = SkinGradients {
                    positions: p.view_mut(),
                    rotations: r.view_mut(),
                    motion_logits: motion_gradients.view_mut(),
                    transforms: transform_gradients.view_mut(),
                    log_radii: radius_gradients.view_mut(),
                    accumulate: false,
                    rigid_scale: 0.0,
                };
                op.backward(&mut recorder, scene.args(), gradients)?;
                let ticket = stream.submit(recorder)?;
                stream.wait(ticket)?;
                Ok(None)
            }),
        });
    }
    Job::recorded(device, check.accuracy(), work, move |recorder| {
        op.forward(recorder, scene.args(), outputs!())
    })
}
