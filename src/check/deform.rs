//! Check cases of nearest control points and skinning.

use super::{Bound, Case, Guarded, Harness, Pass, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Device, Recorder};
use crate::ops::deform::{Skin, SkinArgs, SkinGradients, Skinned, SoftMotion};
use crate::ops::neighbours::Neighbours;
use crate::oracle::{Real, deform};
use crate::types::Work;
use rand::RngExt;
use std::collections::HashSet;

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

/// Neighbour lists and their transpose.
pub(crate) struct NearestWorkload {
    /// The points, those that `ids` names.
    points: Vec<[f32; 3]>,
    centres: Vec<[f32; 3]>,
    k: usize,
    lists: Neighbours,
    position_buffer: Buffer<f32>,
    node_buffer: Buffer<f32>,
    id_buffer: Buffer<u32>,
}

impl NearestWorkload {
    /// Uploads positions, of which `ids` takes part, and control points.
    fn new(
        h: &mut Harness,
        positions: &[[f32; 3]],
        ids: &[u32],
        centres: Vec<[f32; 3]>,
        k: usize,
    ) -> Result<NearestWorkload> {
        Ok(NearestWorkload {
            lists: Neighbours::new(&h.device, k, positions.len(), centres.len())?,
            position_buffer: h.device.upload("positions", positions.as_flattened())?,
            node_buffer: h.device.upload("nodes", centres.as_flattened())?,
            id_buffer: h.device.upload("ids", ids)?,
            points: ids.iter().map(|&i| positions[i as usize]).collect(),
            centres,
            k,
        })
    }

    /// The four nearest of `nodes` random control points for each of `count` random points.
    #[cfg(feature = "bench")]
    pub(crate) fn random(h: &mut Harness, count: usize, nodes: usize) -> Result<NearestWorkload> {
        let positions: Vec<_> = (0..count).map(|_| random(h)).collect();
        let centres = (0..nodes).map(|_| random(h)).collect();
        let ids: Vec<u32> = (0..count as u32).collect();
        NearestWorkload::new(h, &positions, &ids, centres, 4)
    }
}

impl Workload for NearestWorkload {
    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let ids = Some(self.id_buffer.view());
        self.lists.refresh(recorder, ids, self.position_buffer.view(), self.node_buffer.view())
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let truth = deform::nearest(&self.points, &self.centres, self.k);
        let mut by_node: Vec<u32> = (0..truth.len() as u32).collect();
        by_node.sort_by_key(|&place| truth[place as usize]);
        let sorted: Vec<u32> = by_node.iter().map(|&place| truth[place as usize]).collect();
        let begins: Vec<u32> = (0..=self.centres.len() as u32)
            .map(|node| sorted.partition_point(|&n| n < node) as u32)
            .collect();
        let device = h.read_view(self.lists.neighbours())?;
        h.exact("neighbours", &device, &truth);
        let device = h.read_view(self.lists.starts())?;
        h.exact("starts", &device, &begins);
        let device = h.read_view(self.lists.place_from_sorted())?;
        h.exact("places", &device, &by_node);
        Ok(())
    }

    /// Every point against every control point: differences, squares, a comparison. The lists are written,
    /// and sorted by control point.
    fn work(&self) -> Work {
        let (points, nodes) = (self.points.len(), self.centres.len());
        Work {
            bytes: (12 * points + 12 * nodes + 3 * 8 * self.k * points) as u64,
            operations: (9 * points * nodes) as u64,
        }
    }
}

/// On a lattice with many ties, which must be broken as in the oracle.
fn nearest(h: &mut Harness) -> Result<()> {
    for (points, nodes, k) in [(300, 40, 3), (65, 1, 4), (10, 0, 2), (0, 5, 3), (1000, 300, 16)] {
        let mut lattice = |count: usize| -> Vec<[f32; 3]> {
            let mut axis = || h.rng.random_range(-3i32..4) as f32;
            (0..count).map(|_| [axis(), axis(), axis()]).collect()
        };
        let (mut positions, mut centres) = (lattice(points), lattice(nodes));
        // A point that is not finite has no neighbours and is no neighbour.
        if points > 10 {
            positions[1][1] = f32::NAN;
            centres[0][0] = f32::INFINITY;
        }
        let ids: Vec<u32> = (0..points as u32).filter(|i| i % 5 != 2).collect();
        let mut workload = NearestWorkload::new(h, &positions, &ids, centres, k)?;
        h.execute_on(&format!("{points} points, {nodes} nodes"), &mut workload)?;
    }
    Ok(())
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

    fn slopes(&self, scene: &Scene) -> deform::SkinGradients<R> {
        let rigid_scale = R::of(f64::from(scene.rigid_scale));
        deform::backward(&self.skin(scene), &self.by_position, &self.by_rotation, rigid_scale)
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

    /// The neighbours of the dynamic Gaussians, found in f32 as on the device, so that ties do not matter.
    fn neighbours(&self) -> Vec<u32> {
        let listed: Vec<_> = self.ids.iter().map(|&j| self.positions[j as usize]).collect();
        deform::nearest(&listed, &self.nodes, self.k)
    }

    /// The scene in the oracle's number type.
    fn real<R: Real>(&self, neighbours: &[u32]) -> Numbers<R> {
        fn rows<R: Real, const N: usize>(values: &[[f32; N]]) -> Vec<[R; N]> {
            values.iter().map(|v| v.map(|c| R::of(f64::from(c)))).collect()
        }
        let flat =
            |values: &[f32]| -> Vec<R> { values.iter().map(|&c| R::of(f64::from(c))).collect() };
        Numbers {
            neighbours: neighbours.to_vec(),
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

    /// The device's results of both passes.
    fn device(&self, h: &mut Harness) -> Result<[Vec<f32>; 9]> {
        let mut workload = SkinWorkload::new(h, self.clone(), Pass::Backward, [Bound::ZERO; 2])?;
        let mut recorder = h.stream.record()?;
        workload.record_before(&mut recorder)?;
        workload.record_inputs(&mut recorder)?;
        workload.record(&mut recorder)?;
        h.stream.submit(recorder)?;
        let [moved, turned, faded, rigidity] = workload.read_values(h)?;
        let [position, rotation, logit, transform, radius] = workload.read_slopes(h)?;
        Ok([moved, turned, faded, rigidity, position, rotation, logit, transform, radius])
    }

    /// Runs both passes and compares.
    fn run(self, h: &mut Harness, values: Bound, slopes: Bound) -> Result<()> {
        let mut workload = SkinWorkload::new(h, self, Pass::Backward, [values, slopes])?;
        h.execute(&mut workload)
    }

    /// Exponents of about 1e5 change by 0.01 with the last place of a position, and so do the
    /// gradients with respect to the radii. Each limit is therefore the bound plus the change of
    /// the true value.
    fn radius_limits(&self, neighbours: &[u32], truth: &[f64], bound: Bound) -> Vec<f64> {
        let mut limits: Vec<f64> =
            truth.iter().map(|t| bound.absolute + bound.relative * t.abs()).collect();
        for turn in 0..4 {
            let mut numbers = self.real::<f64>(neighbours);
            for (i, v) in numbers.positions.as_flattened_mut().iter_mut().enumerate() {
                *v *= if (i >> turn) & 1 == 0 { 1.0 + 1.2e-7 } else { 1.0 - 1.2e-7 };
            }
            let moved = numbers.slopes(self);
            for (k, limit) in limits.iter_mut().enumerate() {
                let difference = (moved.log_radii[k] - truth[k]).abs();
                *limit += if difference.is_finite() { difference } else { 0.0 };
            }
        }
        limits
    }

    /// Whether every static Gaussian's values are the given ones, bit for bit.
    fn statics_are<const N: usize>(&self, device: &[f32], given: &[[f32; N]]) -> bool {
        let dynamic: HashSet<u32> = self.ids.iter().copied().collect();
        (0..given.len())
            .filter(|&j| !dynamic.contains(&(j as u32)))
            .all(|j| (0..N).all(|c| device[N * j + c].to_bits() == given[j][c].to_bits()))
    }
}

/// A scene on the device.
struct SkinInputs {
    positions: Buffer<f32>,
    rotations: Buffer<[f32; 4]>,
    opacity_logits: Buffer<f32>,
    logits: Buffer<f32>,
    evidence: Buffer<f32>,
    ids: Buffer<u32>,
    nodes: Buffer<f32>,
    log_radii: Buffer<f32>,
    transforms: Buffer<[f32; 4]>,
    soft: bool,
}

impl SkinInputs {
    fn new(device: &Device, scene: &Scene) -> Result<SkinInputs> {
        // The second of two times; the first must not be read.
        let mut halves = vec![[f32::NAN; 4]; 2 * scene.nodes.len()];
        halves.extend(
            scene
                .transforms
                .iter()
                .flat_map(|t| [[t[0], t[1], t[2], t[3]], [t[4], t[5], t[6], t[7]]]),
        );
        Ok(SkinInputs {
            positions: device.upload("positions", scene.positions.as_flattened())?,
            rotations: device.upload("rotations", &scene.rotations)?,
            opacity_logits: device.upload("opacity logits", &scene.opacity_logits)?,
            logits: device.upload("motion logits", &scene.logits)?,
            evidence: device.upload("evidence", &scene.evidence)?,
            ids: device.upload("dynamic ids", &scene.ids)?,
            nodes: device.upload("nodes", scene.nodes.as_flattened())?,
            log_radii: device.upload("log radii", &scene.log_radii)?,
            transforms: device.upload("transforms", &halves)?,
            soft: scene.soft,
        })
    }

    fn args(&self) -> SkinArgs<'_> {
        let soft = || SoftMotion { logits: self.logits.view(), evidence: self.evidence.view() };
        SkinArgs {
            gaussian_from_dynamic: self.ids.view(),
            positions: self.positions.view(),
            rotations: self.rotations.view(),
            opacity_logits: self.opacity_logits.view(),
            nodes: self.nodes.view(),
            log_radii: self.log_radii.view(),
            transforms: self.transforms.view(),
            time: 1,
            soft: self.soft.then(soft),
        }
    }
}

/// A pass of skinning; the forward pass runs before a backward one.
pub(crate) struct SkinWorkload {
    scene: Scene,
    pass: Pass,
    /// Of the moved values and of the gradients.
    bounds: [Bound; 2],
    op: Skin,
    inputs: SkinInputs,
    by_position: Buffer<f32>,
    by_rotation: Buffer<[f32; 4]>,
    zeros: Buffer<f32>,
    moved: Guarded<f32>,
    turned: Guarded<[f32; 4]>,
    faded: Guarded<f32>,
    rigidity: Guarded<f32>,
    position_gradients: Guarded<f32>,
    rotation_gradients: Guarded<[f32; 4]>,
    motion_gradients: Guarded<f32>,
    transform_gradients: Guarded<[f32; 4]>,
    radius_gradients: Guarded<f32>,
}

impl SkinWorkload {
    /// Uploads a scene.
    fn new(h: &mut Harness, scene: Scene, pass: Pass, bounds: [Bound; 2]) -> Result<SkinWorkload> {
        let (count, nodes) = (scene.positions.len(), scene.nodes.len());
        let device = h.device.clone();
        Ok(SkinWorkload {
            op: Skin::new(&device, scene.k, scene.ids.len(), nodes)?,
            inputs: SkinInputs::new(&device, &scene)?,
            by_position: device
                .upload("gradients by position", scene.by_position.as_flattened())?,
            by_rotation: device.upload("gradients by rotation", &scene.by_rotation)?,
            zeros: device.upload("zeros", &vec![0.0f32; count])?,
            moved: h.output("moved positions", 3 * count)?,
            turned: h.output("moved rotations", count)?,
            faded: h.output("moved opacities", count)?,
            rigidity: h.output("rigidity", scene.ids.len())?,
            position_gradients: h.output("position gradients", 3 * count)?,
            rotation_gradients: h.output("rotation gradients", count)?,
            motion_gradients: h.output("motion gradients", count)?,
            transform_gradients: h.output("transform gradients", 4 * nodes)?,
            radius_gradients: h.output("radius gradients", nodes)?,
            scene,
            pass,
            bounds,
        })
    }

    /// Hard motion of `count` random Gaussians, of which three in four follow four of `nodes` random
    /// control points each.
    #[cfg(feature = "bench")]
    pub(crate) fn random(
        h: &mut Harness,
        count: usize,
        nodes: usize,
        pass: Pass,
    ) -> Result<SkinWorkload> {
        let scene = Scene::new(h, count, nodes, 4, false);
        // A control point's gradient is a sum over the Gaussians that follow it, in the cases about 60.
        let followers = (scene.ids.len() * scene.k) as f64 / nodes as f64;
        let absolute = SLOPES.absolute * (followers / 60.0).max(1.0);
        SkinWorkload::new(h, scene, pass, [VALUES, Bound { absolute, ..SLOPES }])
    }

    fn forward(&mut self, recorder: &mut Recorder) -> Result<()> {
        let out = Skinned {
            positions: self.moved.view_mut(),
            rotations: self.turned.view_mut(),
            opacity_logits: self.faded.view_mut(),
            rigidity: self.rigidity.view_mut(),
        };
        self.op.forward(recorder, self.inputs.args(), out)
    }

    /// Moved positions, rotations and opacities, and the rigidity.
    fn read_values(&self, h: &mut Harness) -> Result<[Vec<f32>; 4]> {
        Ok([
            h.read(&self.moved)?,
            h.read(&self.turned)?.concat(),
            h.read(&self.faded)?,
            h.read(&self.rigidity)?,
        ])
    }

    /// The gradients with respect to positions, rotations, motion logits, transforms and log-radii.
    fn read_slopes(&self, h: &mut Harness) -> Result<[Vec<f32>; 5]> {
        Ok([
            h.read(&self.position_gradients)?,
            h.read(&self.rotation_gradients)?.concat(),
            h.read(&self.motion_gradients)?,
            h.read(&self.transform_gradients)?.concat(),
            h.read(&self.radius_gradients)?,
        ])
    }

    fn compare_values(&self, h: &mut Harness, neighbours: &[u32]) -> Result<()> {
        let (scene, bound) = (&self.scene, self.bounds[0]);
        let [moved, turned, faded, rigidity] = self.read_values(h)?;
        let truth = deform::forward(&scene.real::<f64>(neighbours).skin(scene));
        let twin = deform::forward(&scene.real::<f32>(neighbours).skin(scene));
        let (t, w) = (truth.positions.as_flattened(), twin.positions.as_flattened());
        h.close("moved positions", &moved, t, Some(w), bound);
        h.holds("static centres stay", scene.statics_are(&moved, &scene.positions));
        let (t, w) = (truth.rotations.as_flattened(), twin.rotations.as_flattened());
        h.close("moved rotations", &turned, t, Some(w), bound);
        h.holds("static rotations stay", scene.statics_are(&turned, &scene.rotations));
        let (t, w) = (&truth.opacity_logits, &twin.opacity_logits);
        h.close("moved opacities", &faded, t, Some(w), bound);
        let given: Vec<[f32; 1]> = scene.opacity_logits.iter().map(|&o| [o]).collect();
        h.holds("static opacities stay", scene.statics_are(&faded, &given));
        h.holds("none becomes more opaque", faded.iter().zip(&given).all(|(now, o)| *now <= o[0]));
        h.close("rigidity", &rigidity, &truth.rigidity, Some(&twin.rigidity), bound);
        h.holds("hard motion is not rigid", scene.soft || rigidity.iter().all(|&r| r == 0.0));
        Ok(())
    }

    fn compare_slopes(&self, h: &mut Harness, neighbours: &[u32]) -> Result<()> {
        let (scene, bound) = (&self.scene, self.bounds[1]);
        let [by_position, by_rotation, by_logit, by_transform, by_radius] = self.read_slopes(h)?;
        let (exact, single) = (scene.real::<f64>(neighbours), scene.real::<f32>(neighbours));
        let truth = exact.slopes(scene);
        let twin = single.slopes(scene);
        let (t, w) = (truth.positions.as_flattened(), twin.positions.as_flattened());
        h.close("gradient by position", &by_position, t, Some(w), bound);
        h.holds("static gradients pass", scene.statics_are(&by_position, &scene.by_position));
        let (t, w) = (truth.rotations.as_flattened(), twin.rotations.as_flattened());
        h.close("gradient by rotation", &by_rotation, t, Some(w), bound);
        let (t, w) = (&truth.motion_logits, &twin.motion_logits);
        h.close("gradient by motion logit", &by_logit, t, Some(w), bound);
        let (other, own) = by_transform.split_at(8 * scene.nodes.len());
        let untouched = other.iter().all(|v| v.to_bits() == u32::MAX);
        h.holds("the other time's gradient is untouched", untouched);
        let (t, w) = (truth.transforms.as_flattened(), twin.transforms.as_flattened());
        h.close("gradient by transform", own, t, Some(w), bound);
        let (t, w) = (&truth.log_radii, &twin.log_radii);
        let limits = scene.radius_limits(neighbours, t, bound);
        h.within("gradient by log-radius", &by_radius, t, Some(w), &limits);
        Ok(())
    }
}

impl Workload for SkinWorkload {
    fn record_before(&mut self, recorder: &mut Recorder) -> Result<()> {
        let a = self.inputs.args();
        self.op.refresh(recorder, a.gaussian_from_dynamic, a.positions, a.nodes)?;
        match self.pass {
            Pass::Forward => Ok(()),
            Pass::Backward => self.forward(recorder),
        }
    }

    /// The backward pass turns the gradients of the moved values into those of the canonical ones in place.
    fn record_inputs(&mut self, recorder: &mut Recorder) -> Result<()> {
        recorder.copy(self.by_position.view(), self.position_gradients.view_mut());
        recorder.copy(self.by_rotation.view(), self.rotation_gradients.view_mut());
        recorder.copy(self.zeros.view(), self.motion_gradients.view_mut());
        Ok(())
    }

    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        if self.pass == Pass::Forward {
            return self.forward(recorder);
        }
        let gradients = SkinGradients {
            positions: self.position_gradients.view_mut(),
            rotations: self.rotation_gradients.view_mut(),
            motion_logits: self.motion_gradients.view_mut(),
            transforms: self.transform_gradients.view_mut(),
            log_radii: self.radius_gradients.view_mut(),
            accumulate: false,
            rigid_scale: self.scene.rigid_scale,
        };
        self.op.backward(recorder, self.inputs.args(), gradients)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let neighbours = self.scene.neighbours();
        self.compare_values(h, &neighbours)?;
        match self.pass {
            Pass::Forward => Ok(()),
            Pass::Backward => self.compare_slopes(h, &neighbours),
        }
    }

    /// Positions, quaternions and opacities in and out, the lists; a turn, a shift and a weight per
    /// neighbour. Backward, the contributions of each neighbour are written and gathered.
    fn work(&self) -> Work {
        let count = self.scene.ids.len() as u64;
        let followed = count * self.scene.k as u64;
        match self.pass {
            Pass::Forward => {
                Work { bytes: count * (32 + 32 + 28) + followed * 4, operations: followed * 90 }
            }
            Pass::Backward => {
                Work { bytes: count * 112 + followed * (4 + 64 + 4), operations: followed * 260 }
            }
        }
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
        let mut numbers = scene.real::<f64>(&scene.neighbours());
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
