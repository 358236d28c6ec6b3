//! Check cases of nearest control points and skinning.

use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::deform::{Skin, SkinArgs, SkinGradients, Skinned, SoftMotion};
use crate::ops::neighbours::Neighbours;
use crate::oracle::{Real, deform};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "deform/nearest", run: nearest },
    Case { id: "deform/hard_motion", run: hard_motion },
    Case { id: "deform/soft_motion", run: soft_motion },
    Case { id: "deform/central_differences", run: central_differences },
    Case { id: "deform/underflow", run: underflow },
    Case { id: "deform/degenerate", run: degenerate },
    Case { id: "deform/far", run: far },
    Case { id: "deform/still", run: still },
    Case { id: "deform/repeat", run: repeat },
];

/// Neighbour lists and their transpose, on a lattice with many ties, which must be broken as in the
/// oracle.
fn nearest(h: &mut Harness) -> Result<()> {
    for (points, nodes, k) in [(300, 40, 3), (65, 1, 4), (10, 0, 2), (0, 5, 3), (1000, 300, 16)] {
        let mut lattice = |count: usize| -> Vec<f32> {
            (0..3 * count).map(|_| h.rng.random_range(-3i32..4) as f32).collect()
        };
        let (mut positions, mut centres) = (lattice(points), lattice(nodes));
        // A point that is not finite has no neighbours and is no neighbour.
        if points > 10 {
            positions[4] = f32::NAN;
            centres[0] = f32::INFINITY;
        }
        let ids: Vec<u32> = (0..points as u32).filter(|i| i % 5 != 2).collect();
        let mut lists = Neighbours::new(&h.device, k, points, nodes)?;
        let position_buffer = h.device.upload("positions", &positions)?;
        let node_buffer = h.device.upload("nodes", &centres)?;
        let id_buffer = h.device.upload("ids", &ids)?;
        let mut found = h.output::<u32>("neighbours", ids.len() * k)?;
        let mut starts = h.output::<u32>("starts", nodes + 1)?;
        let mut places = h.output::<u32>("places", ids.len() * k)?;
        let mut recorder = h.stream.record()?;
        let id_view = Some(id_buffer.view());
        lists.refresh(&mut recorder, id_view, position_buffer.view(), node_buffer.view())?;
        recorder.copy(lists.neighbours(), found.view_mut());
        recorder.copy(lists.starts(), starts.view_mut());
        recorder.copy(lists.place_from_sorted(), places.view_mut());
        h.stream.submit(recorder)?;
        let listed: Vec<[f32; 3]> = ids.iter().map(|&i| triple(&positions, i as usize)).collect();
        let all: Vec<[f32; 3]> = (0..nodes).map(|i| triple(&centres, i)).collect();
        let truth = deform::nearest(&listed, &all, k);
        let mut by_node: Vec<u32> = (0..truth.len() as u32).collect();
        by_node.sort_by_key(|&place| truth[place as usize]);
        let begins: Vec<u32> = (0..=nodes as u32)
            .map(|node| truth.iter().filter(|&&n| n < node).count() as u32)
            .collect();
        let device = (h.read(&found)?, h.read(&starts)?, h.read(&places)?);
        h.exact("neighbours", &device.0, &truth);
        h.exact("starts", &device.1, &begins);
        h.exact("places", &device.2, &by_node);
    }
    Ok(())
}

fn triple(values: &[f32], i: usize) -> [f32; 3] {
    [values[3 * i], values[3 * i + 1], values[3 * i + 2]]
}

/// A skinning scene with its incoming gradients.
#[derive(Clone)]
struct Scene {
    positions: Vec<[f32; 3]>,
    rotations: Vec<[f32; 4]>,
    opacity_logits: Vec<f32>,
    logits: Vec<f32>,
    evidence: Vec<f32>,
    ids: Vec<u32>,
    nodes: Vec<[f32; 3]>,
    log_radii: Vec<f32>,
    transforms: Vec<[f32; 8]>,
    by_position: Vec<[f32; 3]>,
    by_rotation: Vec<[f32; 4]>,
    k: usize,
    soft: bool,
    rigid_scale: f32,
}

fn random<const N: usize>(h: &mut Harness) -> [f32; N] {
    std::array::from_fn(|_| h.rng.random_range(-1.0f32..1.0))
}

/// A scene in the oracle's number type.
struct Numbers<R> {
    neighbours: Vec<u32>,
    positions: Vec<[R; 3]>,
    rotations: Vec<[R; 4]>,
    opacity_logits: Vec<R>,
    logits: Vec<R>,
    evidence: Vec<R>,
    nodes: Vec<[R; 3]>,
    log_radii: Vec<R>,
    transforms: Vec<[R; 8]>,
    by_position: Vec<[R; 3]>,
    by_rotation: Vec<[R; 4]>,
}

impl<R: Real> Numbers<R> {
    fn skin<'a>(&'a self, scene: &'a Scene) -> deform::Skin<'a, R> {
        deform::Skin {
            positions: &self.positions,
            rotations: &self.rotations,
            opacity_logits: &self.opacity_logits,
            motion_logits: &self.logits,
            evidence: &self.evidence,
            gaussian_from_dynamic: &scene.ids,
            neighbours: &self.neighbours,
            k: scene.k,
            nodes: &self.nodes,
            log_radii: &self.log_radii,
            transforms: &self.transforms,
            soft: scene.soft,
        }
    }
}

impl Numbers<f64> {
    /// The scalar loss whose gradient the backward pass computes.
    fn loss(&self, scene: &Scene) -> f64 {
        let out = deform::forward(&self.skin(scene));
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(out.positions.as_flattened(), self.by_position.as_flattened())
            + dot(out.rotations.as_flattened(), self.by_rotation.as_flattened())
            + f64::from(scene.rigid_scale) * out.rigidity.iter().sum::<f64>()
    }
}

impl Scene {
    fn new(h: &mut Harness, count: usize, nodes: usize, k: usize, soft: bool) -> Scene {
        Scene {
            positions: (0..count).map(|_| random(h)).collect(),
            rotations: (0..count).map(|_| random(h)).collect(),
            opacity_logits: (0..count).map(|_| 3.0 * random::<1>(h)[0]).collect(),
            logits: (0..count).map(|_| 3.0 * random::<1>(h)[0]).collect(),
            evidence: (0..count).map(|_| 0.5 + 0.5 * random::<1>(h)[0]).collect(),
            ids: (0..count as u32).filter(|i| i % 4 != 1).collect(),
            nodes: (0..nodes).map(|_| random(h)).collect(),
            log_radii: (0..nodes).map(|_| -0.7 + 0.3 * random::<1>(h)[0]).collect(),
            transforms: (0..nodes)
                .map(|_| {
                    let mut t = random::<8>(h);
                    // Norms of rotations near 1, so that the bounds measure the kernel.
                    t[4] += 2.0;
                    t
                })
                .collect(),
            by_position: (0..count).map(|_| random(h)).collect(),
            by_rotation: (0..count).map(|_| random(h)).collect(),
            k,
            soft,
            rigid_scale: 0.3,
        }
    }

    /// The scene in the oracle's number type.
    fn real<R: Real>(&self) -> Numbers<R> {
        fn rows<R: Real, const N: usize>(values: &[[f32; N]]) -> Vec<[R; N]> {
            values.iter().map(|v| v.map(|c| R::of(f64::from(c)))).collect()
        }
        let flat =
            |values: &[f32]| -> Vec<R> { values.iter().map(|&c| R::of(f64::from(c))).collect() };
        // Neighbours found in f32 as on the device, so that ties do not matter.
        let listed: Vec<_> = self.ids.iter().map(|&j| self.positions[j as usize]).collect();
        Numbers {
            neighbours: deform::nearest(&listed, &self.nodes, self.k),
            positions: rows(&self.positions),
            rotations: rows(&self.rotations),
            opacity_logits: flat(&self.opacity_logits),
            logits: flat(&self.logits),
            evidence: flat(&self.evidence),
            nodes: rows(&self.nodes),
            log_radii: flat(&self.log_radii),
            transforms: rows(&self.transforms),
            by_position: rows(&self.by_position),
            by_rotation: rows(&self.by_rotation),
        }
    }

    fn oracle<R: Real>(&self) -> (deform::Skinned<R>, deform::SkinGradients<R>) {
        let numbers = self.real::<R>();
        let skin = numbers.skin(self);
        let gradients = deform::backward(
            &skin,
            &numbers.by_position,
            &numbers.by_rotation,
            R::of(f64::from(self.rigid_scale)),
        );
        (deform::forward(&skin), gradients)
    }

    /// The device's results, in the order of the comparisons of [`run`](Self::run).
    fn device(&self, h: &mut Harness) -> Result<[Vec<f32>; 9]> {
        let (count, nodes) = (self.positions.len(), self.nodes.len());
        let device = h.device.clone();
        let positions = device.upload("positions", self.positions.as_flattened())?;
        let rotations = device.upload("rotations", &self.rotations)?;
        let opacity_logits = device.upload("opacity logits", &self.opacity_logits)?;
        let logits = device.upload("motion logits", &self.logits)?;
        let evidence = device.upload("evidence", &self.evidence)?;
        let ids = device.upload("dynamic ids", &self.ids)?;
        let node_buffer = device.upload("nodes", self.nodes.as_flattened())?;
        let log_radii = device.upload("log radii", &self.log_radii)?;
        // The second of two times; the first must not be read.
        let mut halves = vec![[f32::NAN; 4]; 2 * nodes];
        halves.extend(
            self.transforms
                .iter()
                .flat_map(|t| [[t[0], t[1], t[2], t[3]], [t[4], t[5], t[6], t[7]]]),
        );
        let transforms = device.upload("transforms", &halves)?;
        let by_position = device.upload("position gradients", self.by_position.as_flattened())?;
        let by_rotation = device.upload("rotation gradients", &self.by_rotation)?;
        let zeros = device.upload("zeros", &vec![0.0f32; count])?;

        let mut moved = h.output::<f32>("moved positions", 3 * count)?;
        let mut turned = h.output::<[f32; 4]>("moved rotations", count)?;
        let mut faded = h.output::<f32>("moved opacities", count)?;
        let mut rigidity = h.output::<f32>("rigidity", self.ids.len())?;
        let mut gradients = h.output::<f32>("position gradients", 3 * count)?;
        let mut rotation_gradients = h.output::<[f32; 4]>("rotation gradients", count)?;
        let mut motion_gradients = h.output::<f32>("motion gradients", count)?;
        let mut transform_gradients = h.output::<[f32; 4]>("transform gradients", 4 * nodes)?;
        let mut radius_gradients = h.output::<f32>("radius gradients", nodes)?;

        let mut skin = Skin::new(&device, self.k, self.ids.len(), nodes)?;
        let mut recorder = h.stream.record()?;
        skin.refresh(&mut recorder, ids.view(), positions.view(), node_buffer.view())?;
        let args = SkinArgs {
            gaussian_from_dynamic: ids.view(),
            positions: positions.view(),
            rotations: rotations.view(),
            opacity_logits: opacity_logits.view(),
            nodes: node_buffer.view(),
            log_radii: log_radii.view(),
            transforms: transforms.view(),
            time: 1,
            soft: self
                .soft
                .then(|| SoftMotion { logits: logits.view(), evidence: evidence.view() }),
        };
        skin.forward(
            &mut recorder,
            args,
            Skinned {
                positions: moved.view_mut(),
                rotations: turned.view_mut(),
                opacity_logits: faded.view_mut(),
                rigidity: rigidity.view_mut(),
            },
        )?;
        recorder.copy(by_position.view(), gradients.view_mut());
        recorder.copy(by_rotation.view(), rotation_gradients.view_mut());
        recorder.copy(zeros.view(), motion_gradients.view_mut());
        skin.backward(
            &mut recorder,
            args,
            SkinGradients {
                positions: gradients.view_mut(),
                rotations: rotation_gradients.view_mut(),
                motion_logits: motion_gradients.view_mut(),
                transforms: transform_gradients.view_mut(),
                log_radii: radius_gradients.view_mut(),
                accumulate: false,
                rigid_scale: self.rigid_scale,
            },
        )?;
        h.stream.submit(recorder)?;
        Ok([
            h.read(&moved)?,
            h.read(&turned)?.concat(),
            h.read(&faded)?,
            h.read(&rigidity)?,
            h.read(&gradients)?,
            h.read(&rotation_gradients)?.concat(),
            h.read(&motion_gradients)?,
            h.read(&transform_gradients)?.concat(),
            h.read(&radius_gradients)?,
        ])
    }

    fn run(&self, h: &mut Harness, values: Bound, slopes: Bound) -> Result<()> {
        let nodes = self.nodes.len();
        let device = self.device(h)?;
        let [
            moved,
            turned,
            faded,
            rigidity,
            by_position,
            by_rotation,
            by_logit,
            by_transform,
            by_radius,
        ] = device;
        let (truth, by_truth) = self.oracle::<f64>();
        let (twin, by_twin) = self.oracle::<f32>();
        let (t, w) = (truth.positions.as_flattened(), twin.positions.as_flattened());
        h.close("moved positions", &moved, t, Some(w), values);
        h.holds("static centres stay", self.statics_are(&moved, &self.positions));
        let (t, w) = (truth.rotations.as_flattened(), twin.rotations.as_flattened());
        h.close("moved rotations", &turned, t, Some(w), values);
        h.holds("static rotations stay", self.statics_are(&turned, &self.rotations));
        h.close(
            "moved opacities",
            &faded,
            &truth.opacity_logits,
            Some(&twin.opacity_logits),
            values,
        );
        let given: Vec<[f32; 1]> = self.opacity_logits.iter().map(|&o| [o]).collect();
        h.holds("static opacities stay", self.statics_are(&faded, &given));
        h.holds("none becomes more opaque", faded.iter().zip(&given).all(|(now, o)| *now <= o[0]));
        h.close("rigidity", &rigidity, &truth.rigidity, Some(&twin.rigidity), values);
        h.holds("hard motion is not rigid", self.soft || rigidity.iter().all(|&r| r == 0.0));

        let (t, w) = (by_truth.positions.as_flattened(), by_twin.positions.as_flattened());
        h.close("gradient by position", &by_position, t, Some(w), slopes);
        h.holds("static gradients pass", self.statics_are(&by_position, &self.by_position));
        let (t, w) = (by_truth.rotations.as_flattened(), by_twin.rotations.as_flattened());
        h.close("gradient by rotation", &by_rotation, t, Some(w), slopes);
        let (t, w) = (&by_truth.motion_logits, &by_twin.motion_logits);
        h.close("gradient by motion logit", &by_logit, t, Some(w), slopes);
        let (other, own) = by_transform.split_at(8 * nodes);
        let untouched = other.iter().all(|v| v.to_bits() == u32::MAX);
        h.holds("the other time's gradient is untouched", untouched);
        let (t, w) = (by_truth.transforms.as_flattened(), by_twin.transforms.as_flattened());
        h.close("gradient by transform", own, t, Some(w), slopes);
        let (t, w) = (&by_truth.log_radii, &by_twin.log_radii);
        let limits = self.radius_limits(t, slopes);
        h.within("gradient by log-radius", &by_radius, t, Some(w), &limits);
        Ok(())
    }

    /// Exponents of about 1e5 change by 0.01 with the last place of a position, and so do the
    /// gradients with respect to the radii. Each limit is therefore the bound plus the change of
    /// the true value.
    fn radius_limits(&self, truth: &[f64], bound: Bound) -> Vec<f64> {
        let mut limits: Vec<f64> =
            truth.iter().map(|t| bound.absolute + bound.relative * t.abs()).collect();
        for turn in 0..4 {
            let mut numbers = self.real::<f64>();
            for (i, v) in numbers.positions.as_flattened_mut().iter_mut().enumerate() {
                *v *= if (i >> turn) & 1 == 0 { 1.0 + 1.2e-7 } else { 1.0 - 1.2e-7 };
            }
            let scale = f64::from(self.rigid_scale);
            let moved = deform::backward(
                &numbers.skin(self),
                &numbers.by_position,
                &numbers.by_rotation,
                scale,
            );
            for (k, limit) in limits.iter_mut().enumerate() {
                let difference = (moved.log_radii[k] - truth[k]).abs();
                *limit += if difference.is_finite() { difference } else { 0.0 };
            }
        }
        limits
    }

    /// Whether every static Gaussian's values are the given ones, bit for bit.
    fn statics_are<const N: usize>(&self, device: &[f32], given: &[[f32; N]]) -> bool {
        (0..given.len())
            .filter(|&j| !self.ids.contains(&(j as u32)))
            .all(|j| (0..N).all(|c| device[N * j + c].to_bits() == given[j][c].to_bits()))
    }
}

// The bounds are about five times the errors measured on lavapipe, since drivers may fuse and
// reorder operations.
const VALUES: Bound = Bound { absolute: 2e-6, relative: 1e-6 };
const SLOPES: Bound = Bound { absolute: 1e-5, relative: 1e-5 };

fn hard_motion(h: &mut Harness) -> Result<()> {
    for (count, nodes, k) in [(1000, 50, 4), (257, 12, 3), (64, 2, 4), (70, 9, 1), (90, 20, 8)] {
        let scene = Scene::new(h, count, nodes, k, false);
        scene.run(h, VALUES, SLOPES)?;
    }
    Ok(())
}

fn soft_motion(h: &mut Harness) -> Result<()> {
    let scene = Scene::new(h, 700, 40, 4, true);
    scene.run(h, VALUES, SLOPES)
}

/// The device's gradients against differences of the oracle's forward pass. Positions are left out,
/// since their gradient is defined with constant weights.
fn central_differences(h: &mut Harness) -> Result<()> {
    const STEP: f64 = 1e-6;
    for soft in [false, true] {
        let scene = Scene::new(h, 30, 6, 4, soft);
        let [.., by_rotation, by_logit, by_transform, by_radius] = scene.device(h)?;
        let mut numbers = scene.real::<f64>();
        let mut slope = |at: &dyn Fn(&mut Numbers<f64>) -> &mut f64| {
            let start = *at(&mut numbers);
            let mut value = |x: f64| {
                *at(&mut numbers) = x;
                numbers.loss(&scene)
            };
            let difference = value(start + STEP) - value(start - STEP);
            *at(&mut numbers) = start;
            difference / (2.0 * STEP)
        };
        let (nodes, count) = (scene.nodes.len(), scene.positions.len());
        let transforms: Vec<f64> =
            (0..8 * nodes).map(|i| slope(&|n| &mut n.transforms[i / 8][i % 8])).collect();
        let radii: Vec<f64> = (0..nodes).map(|i| slope(&|n| &mut n.log_radii[i])).collect();
        let rotations: Vec<f64> =
            (0..4 * count).map(|i| slope(&|n| &mut n.rotations[i / 4][i % 4])).collect();
        let logits: Vec<f64> = (0..count).map(|i| slope(&|n| &mut n.logits[i])).collect();
        let what = |name: &str| format!("soft {soft}: by {name}");
        h.close(&what("transform"), &by_transform[8 * nodes..], &transforms, None, SLOPES);
        h.close(&what("log-radius"), &by_radius, &radii, None, SLOPES);
        h.close(&what("rotation"), &by_rotation, &rotations, None, SLOPES);
        h.close(&what("motion logit"), &by_logit, &logits, None, SLOPES);
    }
    Ok(())
}

/// Radii so small that all weights underflow in f32, and some exponents are infinite.
fn underflow(h: &mut Harness) -> Result<()> {
    for log_radius in [-6.0, -50.0, f32::NEG_INFINITY, f32::NAN, 50.0] {
        let mut scene = Scene::new(h, 200, 20, 3, true);
        scene.log_radii.fill(log_radius);
        scene.run(h, VALUES, SLOPES)?;
    }
    Ok(())
}

/// Coincident control points, antipodal, zero and non-finite rotations, Gaussians without control
/// points and non-finite ones.
fn degenerate(h: &mut Harness) -> Result<()> {
    for soft in [false, true] {
        let mut scene = Scene::new(h, 60, 6, 4, soft);
        scene.nodes = vec![scene.positions[0]; 6];
        scene.transforms[0] = [0.1, 0.0, 0.0, 0.0, 1.0, 0.5, 0.0, 0.0];
        scene.transforms[1] = [0.1, 0.0, 0.0, 0.0, -1.0, -0.5, 0.0, 0.0];
        scene.transforms[2] = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        scene.transforms[3][6] = f32::NAN;
        scene.rotations[0] = [0.0; 4];
        scene.rotations[2] = [f32::NAN, 1.0, 0.0, 0.0];
        scene.rotations[3] = [f32::INFINITY, 1.0, 0.0, 0.0];
        // Soft motion: 2.9e-5 with respect to the log-radius, whose slopes grow with the squared
        // distance over ρ².
        scene.run(h, VALUES, Bound { absolute: 1e-4, relative: 1e-4 })?;
    }
    for (count, nodes) in [(20, 0), (0, 3), (1, 1)] {
        Scene::new(h, count, nodes, 4, false).run(h, VALUES, SLOPES)?;
    }
    Ok(())
}

/// A scene a million units from the origin, with coordinates that f32 represents exactly there.
fn far(h: &mut Harness) -> Result<()> {
    let mut scene = Scene::new(h, 100, 20, 4, false);
    for p in scene.positions.iter_mut().chain(&mut scene.nodes) {
        *p = p.map(|c| (c * 8.0).round() / 8.0 + 1e6);
    }
    // The sum rounds to the spacing of f32 near 1e6, which is 0.0625.
    scene.run(h, Bound { absolute: 0.07, relative: 0.0 }, SLOPES)
}

/// The identity motion leaves all values unchanged, bit for bit.
fn still(h: &mut Harness) -> Result<()> {
    let mut scene = Scene::new(h, 100, 20, 4, false);
    scene.transforms.fill([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
    scene.run(h, Bound { absolute: 0.0, relative: 0.0 }, SLOPES)
}

/// The same input twice gives the same bits, sums over thousands of Gaussians included.
fn repeat(h: &mut Harness) -> Result<()> {
    let scene = Scene::new(h, 20_000, 7, 4, true);
    let bits = |outputs: [Vec<f32>; 9]| outputs.map(|o| o.into_iter().map(f32::to_bits).collect());
    let first: [Vec<u32>; 9] = bits(scene.device(h)?);
    let second = bits(scene.device(h)?);
    for (first, second) in first.iter().zip(&second) {
        h.exact("bits of two runs", first, second);
    }
    Ok(())
}
