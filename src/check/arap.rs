//! Check cases of the as-rigid-as-possible energy.

use super::{Bound, Case, Guarded, Harness, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Recorder};
use crate::ops::arap::{Arap, ArapArgs, ArapSettings};
use crate::oracle::rotation::{apply, matrix, unit};
use crate::oracle::{Real, arap, deform};
use crate::types::Work;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "arap/random", run: random },
    Case { id: "arap/central_differences", run: central_differences },
    Case { id: "arap/rigid", run: rigid },
    Case { id: "arap/degenerate", run: degenerate },
    Case { id: "arap/scales", run: scales },
];

const SETTINGS: ArapSettings = ArapSettings { always: 3, reach: 0.8, weight: 0.5 };

type Points = Vec<[f32; 3]>;

/// Control points with their translations at both times.
struct Scene {
    nodes: Points,
    log_radii: Vec<f32>,
    first: Points,
    second: Points,
    k: usize,
    /// Initial value of the gradient buffers, to which the op adds.
    base: f32,
}

impl Scene {
    /// The edges, and the positions of the points at both times.
    fn numbers<R: Real>(&self) -> (arap::Edges<R>, [Vec<[R; 3]>; 2]) {
        let at = |translations: Option<&Points>| -> Vec<[R; 3]> {
            let zero = vec![[0.0; 3]; self.nodes.len()];
            let moved = self.nodes.iter().zip(translations.unwrap_or(&zero));
            moved
                .map(|(p, t)| {
                    std::array::from_fn(|c| R::of(f64::from(p[c])) + R::of(f64::from(t[c])))
                })
                .collect()
        };
        let places = self.k + 1;
        let nearest = deform::nearest(&self.nodes, &self.nodes, places);
        let log_radii: Vec<R> = self.log_radii.iter().map(|&r| R::of(f64::from(r))).collect();
        let reach = R::of(f64::from(SETTINGS.reach));
        let always = SETTINGS.always as usize;
        let edges = arap::edges(&at(None), &log_radii, &nearest, places, always, reach);
        (edges, [at(Some(&self.first)), at(Some(&self.second))])
    }

    fn oracle<R: Real>(&self) -> (Vec<R>, Vec<[R; 8]>) {
        let (edges, [first, second]) = self.numbers::<R>();
        let result = arap::energy(&edges, &first, &second);
        let weight = R::of(f64::from(SETTINGS.weight));
        let energies = result.energies.iter().map(|&e| e * weight).collect();
        let rows = result.by_a.iter().chain(&result.by_b);
        let gradients = rows.map(|g| {
            let mut row = [R::of(f64::from(self.base)); 8];
            for c in 0..3 {
                row[c] += g[c] * weight;
            }
            row
        });
        (energies, gradients.collect())
    }

    fn run(self, h: &mut Harness, bound: Bound) -> Result<()> {
        let mut workload = ArapWorkload::new(h, self, bound)?;
        h.execute(&mut workload)
    }
}

/// The energies of control points, and their gradients.
pub(crate) struct ArapWorkload {
    scene: Scene,
    bound: Bound,
    op: Arap,
    nodes: Buffer<f32>,
    log_radii: Buffer<f32>,
    transforms: Buffer<[f32; 4]>,
    base: Buffer<[f32; 4]>,
    energies: Guarded<f32>,
    /// 8 for each point at the first time, then at the second.
    gradients: Guarded<[f32; 4]>,
}

impl ArapWorkload {
    fn new(h: &mut Harness, scene: Scene, bound: Bound) -> Result<ArapWorkload> {
        let count = scene.nodes.len();
        let translations = scene.first.iter().chain(&scene.second);
        let halves: Vec<[f32; 4]> =
            translations.flat_map(|t| [[t[0], t[1], t[2], 0.0], [1.0, 0.0, 0.0, 0.0]]).collect();
        Ok(ArapWorkload {
            op: Arap::new(&h.device, scene.k, count)?,
            nodes: h.device.upload("nodes", scene.nodes.as_flattened())?,
            log_radii: h.device.upload("log radii", &scene.log_radii)?,
            transforms: h.device.upload("transforms", &halves)?,
            base: h.device.upload("base", &vec![[scene.base; 4]; 4 * count])?,
            energies: h.output("energies", count)?,
            gradients: h.output("transform gradients", 4 * count)?,
            scene,
            bound,
        })
    }

    /// Control points in a cube that move at random, with `k` edges each.
    pub(crate) fn random(h: &mut Harness, count: usize, k: usize) -> Result<ArapWorkload> {
        let scene = Scene {
            nodes: cloud(h, count, 1.0),
            log_radii: (0..count).map(|_| h.rng.random_range(-1.0f32..0.0)).collect(),
            first: cloud(h, count, 0.2),
            second: cloud(h, count, 0.2),
            k,
            base: 0.0,
        };
        ArapWorkload::new(h, scene, bound(count))
    }
}

impl Workload for ArapWorkload {
    fn record_before(&mut self, recorder: &mut Recorder) -> Result<()> {
        recorder.copy(self.base.view(), self.gradients.view_mut());
        self.op.refresh(recorder, self.nodes.view())
    }

    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        let args = ArapArgs {
            nodes: self.nodes.view(),
            log_radii: self.log_radii.view(),
            transforms: self.transforms.view(),
            times: [0, 1],
            energies: self.energies.view_mut(),
            transform_gradients: self.gradients.view_mut(),
        };
        self.op.record(recorder, &SETTINGS, args)
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let (truth, by_truth) = self.scene.oracle::<f64>();
        let (twin, by_twin) = self.scene.oracle::<f32>();
        let (energies, gradients) = (h.read(&self.energies)?, h.read(&self.gradients)?.concat());
        h.close("energies", &energies, &truth, Some(&twin), self.bound);
        let (t, w) = (by_truth.as_flattened(), by_twin.as_flattened());
        h.close("gradients", &gradients, t, Some(w), self.bound);
        Ok(())
    }

    /// Per control point a 3×3 rotation by Jacobi sweeps; per edge outer products and two gradients.
    fn work(&self) -> Work {
        let nodes = self.scene.nodes.len() as u64;
        let edges = nodes * self.scene.k as u64;
        Work { bytes: edges * (4 + 24 + 24 + 24), operations: edges * 60 + nodes * 800 }
    }
}

fn cloud(h: &mut Harness, count: usize, size: f32) -> Points {
    (0..count).map(|_| std::array::from_fn(|_| h.rng.random_range(-size..size))).collect()
}

/// Energies and gradients are means over the control points: a residual's few roundings of an edge
/// of length 1 or so, times 2 · weight / count, for each of its edges.
fn bound(count: usize) -> Bound {
    Bound { absolute: 3e-6 / count.max(1) as f64, relative: 3e-6 }
}

fn random(h: &mut Harness) -> Result<()> {
    for (count, k) in [(100, 10), (65, 4), (5, 10), (300, 15), (2, 3), (1, 3), (0, 3)] {
        let mut workload = ArapWorkload::random(h, count, k)?;
        h.execute(&mut workload)?;
    }
    Ok(())
}

/// The device's gradients against differences of the oracle's energy, whose rotations are fitted anew
/// at every step.
fn central_differences(h: &mut Harness) -> Result<()> {
    const STEP: f64 = 1e-6;
    let count = 20;
    let mut workload = ArapWorkload::random(h, count, 6)?;
    let mut recorder = h.stream.record()?;
    workload.record_before(&mut recorder)?;
    workload.record(&mut recorder)?;
    h.stream.submit(recorder)?;
    let gradients = h.read(&workload.gradients)?.concat();
    let (edges, mut points) = workload.scene.numbers::<f64>();
    let weight = f64::from(SETTINGS.weight);
    let (mut device, mut slopes) = (Vec::new(), Vec::new());
    for (time, i, c) in (0..2 * count * 3).map(|n| (n / 3 / count, n / 3 % count, n % 3)) {
        let start = points[time][i][c];
        let mut at = |x: f64| {
            points[time][i][c] = x;
            weight * arap::energy(&edges, &points[0], &points[1]).energies.iter().sum::<f64>()
        };
        slopes.push((at(start + STEP) - at(start - STEP)) / (2.0 * STEP));
        points[time][i][c] = start;
        device.push(gradients[8 * (time * count + i) + c]);
    }
    h.close("gradients", &device, &slopes, None, bound(count));
    Ok(())
}

/// A half turn with a translation has zero energy, and so has no motion.
fn rigid(h: &mut Harness) -> Result<()> {
    let nodes = cloud(h, 80, 1.0);
    for q in [[0.0f64, 0.6, 0.8, 0.0], [0.3, -0.5, 0.2, 0.9], [1.0, 0.0, 0.0, 0.0]] {
        let turn = matrix(unit(q).map_or([1.0, 0.0, 0.0, 0.0], |(u, _)| u));
        let second = nodes.iter().map(|p| {
            let moved = apply(turn, p.map(f64::from));
            std::array::from_fn(|c| (moved[c] - f64::from(p[c]) + 0.25) as f32)
        });
        let scene = Scene {
            second: second.collect(),
            first: vec![[0.0; 3]; 80],
            log_radii: vec![-0.5; 80],
            nodes: nodes.clone(),
            k: 10,
            base: 1.0,
        };
        // Near 1 the resolution of f32 is 1.2e-7.
        scene.run(h, Bound { absolute: 3e-7, relative: 0.0 })?;
    }
    Ok(())
}

/// Collinear and coplanar points, one point, a collapse, a reflection, and radii for which all
/// weights vanish.
fn degenerate(h: &mut Harness) -> Result<()> {
    let line: Points = (0..20).map(|i| [i as f32 * 0.125, 0.0, 0.0]).collect();
    let plane: Points =
        (0..25).map(|i| [(i % 5) as f32 * 0.2, (i / 5) as f32 * 0.25, 0.0]).collect();
    let same: Points = vec![[0.5; 3]; 12];
    for nodes in [line, plane, same] {
        let count = nodes.len();
        let back: Points = nodes.iter().map(|p| p.map(|c| -c)).collect();
        let zero: Points = vec![[0.0; 3]; count];
        for (first, second) in [(&zero, &zero), (&zero, &back), (&back, &zero)] {
            for log_radius in [-0.5, -60.0, f32::NAN] {
                let scene = Scene {
                    nodes: nodes.clone(),
                    log_radii: vec![log_radius; count],
                    first: first.clone(),
                    second: second.clone(),
                    k: 6,
                    base: 0.0,
                };
                scene.run(h, bound(count))?;
            }
        }
    }
    // A reflection of a full neighbourhood is not a rotation; the best fit is unique.
    let nodes = cloud(h, 60, 1.0);
    let second: Points = nodes.iter().map(|p| [-2.0 * p[0], 0.0, 0.0]).collect();
    let first = vec![[0.0; 3]; 60];
    let scene = Scene { nodes, log_radii: vec![0.0; 60], first, second, k: 12, base: 0.0 };
    scene.run(h, Bound { absolute: 1e-7, relative: 1e-5 })
}

/// Very small and very large scenes: the fit must not depend on the unit.
fn scales(h: &mut Harness) -> Result<()> {
    for size in [1e-12f32, 1e-4, 1e4] {
        let scene = Scene {
            nodes: cloud(h, 60, size),
            log_radii: vec![size.ln(); 60],
            first: cloud(h, 60, 0.2 * size),
            second: cloud(h, 60, 0.2 * size),
            k: 8,
            base: 0.0,
        };
        let absolute = f64::from(size) * 1e-8;
        scene.run(h, Bound { absolute, relative: 1e-5 })?;
    }
    Ok(())
}
