//! Check cases of the deformation network.

use super::{Bound, Case, Guarded, Harness, Pass, Workload};
use crate::error::Result;
use crate::gpu::{Buffer, Recorder};
use crate::ops::mlp::{Network, NetworkScratch};
use crate::oracle::{Real, mlp};
use crate::types::{DeformNet, NetShape, Work};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "mlp/narrow", run: narrow },
    Case { id: "mlp/paper", run: paper },
    Case { id: "mlp/central_differences", run: central_differences },
    Case { id: "mlp/shapes", run: shapes },
    Case { id: "mlp/accumulate", run: accumulate },
    Case { id: "mlp/encoding", run: encoding },
];

/// A network small enough for a software driver.
pub(crate) const NARROW: NetShape = NetShape {
    depth: 6,
    width: 64,
    skip: 3,
    position_frequencies: 10,
    time_frequencies: 6,
    ..NetShape::PAPER
};

/// Bounds of the motions and of the gradients. A gradient is a sum over the rows, and so is its error.
fn bounds(shape: &NetShape, rows: usize) -> [Bound; 2] {
    let (values, slopes, least_rows) = if shape.width <= NARROW.width {
        // Measured 2.2e-7 and, over 200 rows, 6.5e-6.
        (1e-6, 3e-5, 200)
    } else {
        // Measured 1.4e-6 and, over 67 rows, 1.3e-5.
        (6e-6, 6e-5, 67)
    };
    let share = rows.max(least_rows) as f64 / least_rows as f64;
    [values, slopes * share].map(|absolute| Bound { absolute, relative: 1e-6 })
}

/// A network with its inputs.
#[derive(Clone)]
struct Problem {
    shape: NetShape,
    parameters: Vec<f32>,
    nodes: Vec<f32>,
    times: Vec<f32>,
    gradients: Vec<[f32; 8]>,
}

impl Problem {
    /// Random inputs for a network of this shape.
    fn new(h: &mut Harness, shape: NetShape, nodes: usize, times: usize) -> Problem {
        // A head and biases of ordinary size: with the initial ones the outputs are close to zero.
        let parameters = DeformNet::random(shape, 3)
            .parameters
            .iter()
            .map(|p| p + h.rng.random_range(-0.05f32..0.05))
            .collect();
        Problem {
            shape,
            parameters,
            nodes: (0..3 * nodes).map(|_| h.rng.random_range(-1.5f32..1.5)).collect(),
            times: (0..times).map(|_| h.rng.random_range(0.0f32..1.0)).collect(),
            gradients: (0..nodes * times)
                .map(|_| std::array::from_fn(|_| h.rng.random_range(-1.0f32..1.0)))
                .collect(),
        }
    }

    /// The motions, and for a backward pass the gradients of the parameters, which else are empty.
    fn oracle<R: Real>(&self, pass: Pass) -> (Vec<R>, Vec<R>) {
        let real = |v: f32| R::of(f64::from(v));
        let parameters: Vec<R> = self.parameters.iter().copied().map(real).collect();
        let queries: Vec<[R; 4]> = self
            .times
            .iter()
            .flat_map(|&t| self.nodes.chunks(3).map(move |p| [p[0], p[1], p[2], t].map(real)))
            .collect();
        let forward = mlp::forward(&self.shape, &parameters, &queries);
        let transforms = forward.outputs.iter().flat_map(|&o| mlp::transform(o)).collect();
        if pass == Pass::Forward {
            return (transforms, Vec::new());
        }
        let by_output: Vec<[R; 7]> = self
            .gradients
            .iter()
            .map(|&[x, y, z, _, w, i, j, k]| [x, y, z, w, i, j, k].map(real))
            .collect();
        (transforms, mlp::backward(&self.shape, &parameters, &forward, &by_output))
    }

    /// The motions, and the gradients of the parameters, added up `repeats` times.
    fn device(&self, h: &mut Harness, repeats: usize) -> Result<(Vec<f32>, Vec<f32>)> {
        let mut workload = MlpWorkload::new(h, self.clone(), Pass::Backward, [Bound::ZERO; 2])?;
        let mut recorder = h.stream.record()?;
        workload.forward(&mut recorder)?;
        for repeat in 0..repeats {
            workload.backward(&mut recorder, repeat > 0)?;
        }
        h.stream.submit(recorder)?;
        Ok((h.read(&workload.transforms)?.concat(), h.read(&workload.gradients)?))
    }

    /// Runs both passes and compares.
    fn run(self, h: &mut Harness, bounds: [Bound; 2]) -> Result<()> {
        let mut workload = MlpWorkload::new(h, self, Pass::Backward, bounds)?;
        h.execute(&mut workload)
    }
}

/// A pass over a network; the forward pass runs before a backward one.
pub(crate) struct MlpWorkload {
    problem: Problem,
    pass: Pass,
    /// Of the motions and of the gradients. They are about five times the errors measured on lavapipe,
    /// since drivers may reorder sums or fuse products; the oracle in f32 has errors of the same size.
    bounds: [Bound; 2],
    network: Network,
    scratch: NetworkScratch,
    parameters: Buffer<f32>,
    nodes: Buffer<f32>,
    times: Buffer<f32>,
    by_transform: Buffer<[f32; 4]>,
    transforms: Guarded<[f32; 4]>,
    gradients: Guarded<f32>,
}

impl MlpWorkload {
    /// Uploads a problem.
    fn new(
        h: &mut Harness,
        problem: Problem,
        pass: Pass,
        bounds: [Bound; 2],
    ) -> Result<MlpWorkload> {
        let network = Network::plan(&h.device, &problem.shape)?;
        let rows = problem.gradients.len();
        let halves: &[[f32; 4]] = bytemuck::cast_slice(&problem.gradients);
        Ok(MlpWorkload {
            scratch: network.scratch(&h.device, rows)?,
            network,
            parameters: h.device.upload("parameters", &problem.parameters)?,
            nodes: h.device.upload("nodes", &problem.nodes)?,
            times: h.device.upload("times", &problem.times)?,
            by_transform: h.device.upload("transform gradients", halves)?,
            transforms: h.output("transforms", 2 * rows)?,
            gradients: h.output("parameter gradients", problem.parameters.len())?,
            problem,
            pass,
            bounds,
        })
    }

    /// A pass over `rows` random control points, at one time.
    #[cfg(feature = "bench")]
    pub(crate) fn random(
        h: &mut Harness,
        shape: NetShape,
        rows: usize,
        pass: Pass,
    ) -> Result<MlpWorkload> {
        let problem = Problem::new(h, shape, rows, 1);
        MlpWorkload::new(h, problem, pass, bounds(&shape, rows))
    }

    fn forward(&mut self, recorder: &mut Recorder) -> Result<()> {
        self.network.forward(
            recorder,
            self.parameters.view(),
            self.nodes.view(),
            self.times.view(),
            self.transforms.view_mut(),
            &mut self.scratch,
        )
    }

    fn backward(&mut self, recorder: &mut Recorder, accumulate: bool) -> Result<()> {
        self.network.backward(
            recorder,
            self.parameters.view(),
            self.by_transform.view(),
            self.gradients.view_mut(),
            accumulate,
            &mut self.scratch,
        )
    }
}

impl Workload for MlpWorkload {
    fn record_before(&mut self, recorder: &mut Recorder) -> Result<()> {
        match self.pass {
            Pass::Forward => Ok(()),
            Pass::Backward => self.forward(recorder),
        }
    }

    fn record(&mut self, recorder: &mut Recorder) -> Result<()> {
        match self.pass {
            Pass::Forward => self.forward(recorder),
            Pass::Backward => self.backward(recorder, false),
        }
    }

    fn compare(&self, h: &mut Harness) -> Result<()> {
        let (truth, by_truth) = self.problem.oracle::<f64>(self.pass);
        let (twin, by_twin) = self.problem.oracle::<f32>(self.pass);
        let transforms = h.read(&self.transforms)?.concat();
        h.close("transforms", &transforms, &truth, Some(&twin), self.bounds[0]);
        if self.pass == Pass::Backward {
            let device = h.read(&self.gradients)?;
            h.close("parameter gradients", &device, &by_truth, Some(&by_twin), self.bounds[1]);
        }
        Ok(())
    }

    /// A multiplication and an addition per weight and row. The backward pass has a product for the layer
    /// below and one for the weights.
    fn work(&self) -> Work {
        let layers = self.problem.shape.layers();
        let products: usize = layers.iter().map(|(inputs, outputs)| inputs * outputs).sum();
        let activations: usize = layers.iter().map(|(inputs, outputs)| inputs + outputs).sum();
        let rows = self.problem.gradients.len();
        let times_over = if self.pass == Pass::Backward { 2 } else { 1 };
        let values = rows * activations + self.problem.parameters.len();
        Work {
            bytes: times_over * 4 * values as u64,
            operations: times_over * 2 * (rows * products) as u64,
        }
    }
}

fn narrow(h: &mut Harness) -> Result<()> {
    Problem::new(h, NARROW, 100, 2).run(h, bounds(&NARROW, 200))
}

fn paper(h: &mut Harness) -> Result<()> {
    Problem::new(h, NetShape::PAPER, 67, 1).run(h, bounds(&NetShape::PAPER, 67))
}

/// The device's gradients against differences of the oracle's forward pass, for parameters of every
/// layer.
fn central_differences(h: &mut Harness) -> Result<()> {
    const STEP: f64 = 1e-6;
    let shape = NetShape {
        depth: 4,
        width: 16,
        skip: 1,
        position_frequencies: 3,
        time_frequencies: 2,
        ..NetShape::PAPER
    };
    let problem = Problem::new(h, shape, 7, 2);
    let (_, by_parameter) = problem.device(h, 1)?;
    let wide = |values: &[f32]| -> Vec<f64> { values.iter().map(|&v| f64::from(v)).collect() };
    let queries: Vec<[f64; 4]> = problem
        .times
        .iter()
        .flat_map(|&t| problem.nodes.chunks(3).map(move |p| [p[0], p[1], p[2], t].map(f64::from)))
        .collect();
    let mut parameters = wide(&problem.parameters);
    let value = |parameters: &[f64]| -> f64 {
        let outputs = mlp::forward(&shape, parameters, &queries).outputs;
        let moved = outputs.iter().flat_map(|&o| mlp::transform(o));
        moved.zip(problem.gradients.as_flattened()).map(|(a, &b)| a * f64::from(b)).sum()
    };
    let chosen: Vec<usize> = (0..parameters.len()).step_by(7).collect();
    let mut slopes = Vec::new();
    for &i in &chosen {
        let start = parameters[i];
        let mut at = |x: f64| {
            parameters[i] = x;
            value(&parameters)
        };
        slopes.push((at(start + STEP) - at(start - STEP)) / (2.0 * STEP));
        parameters[i] = start;
    }
    let device: Vec<f32> = chosen.iter().map(|&i| by_parameter[i]).collect();
    let bound = Bound { absolute: 2e-5, relative: 2e-6 };
    h.close("parameter gradients", &device, &slopes, None, bound);
    Ok(())
}

/// Unusual shapes: one row, one layer, no octaves, a skip into the head, and no skip.
fn shapes(h: &mut Harness) -> Result<()> {
    let base = NetShape {
        depth: 3,
        width: 16,
        skip: 0,
        position_frequencies: 3,
        time_frequencies: 1,
        ..NetShape::PAPER
    };
    for (shape, nodes, times) in [
        (base, 1, 1),
        (NetShape { depth: 1, skip: 9, ..base }, 9, 1),
        (NetShape { skip: 2, position_frequencies: 0, time_frequencies: 4, ..base }, 5, 3),
        (NetShape { width: 48, skip: u32::MAX, ..base }, 64, 1),
        (NetShape { position_octave: 3, ..base }, 7, 2),
        (NetShape { position_octave: -20, ..base }, 7, 2),
        (base, 0, 1),
    ] {
        let problem = Problem::new(h, shape, nodes, times);
        // Measured 1.1e-7 and 2.8e-6.
        problem.run(
            h,
            [Bound { absolute: 1e-6, relative: 1e-6 }, Bound { absolute: 2e-5, relative: 1e-6 }],
        )?;
    }
    Ok(())
}

/// Adding a gradient to itself doubles it, bit for bit.
fn accumulate(h: &mut Harness) -> Result<()> {
    let problem = Problem::new(h, NARROW, 20, 1);
    let (_, once) = problem.device(h, 1)?;
    let (_, twice) = problem.device(h, 2)?;
    let doubled: Vec<f32> = once.iter().map(|g| 2.0 * g).collect();
    h.exact("parameter gradients", &twice, &doubled);
    Ok(())
}

/// A network that passes its encodings through, to compare them one by one, at large arguments too.
fn encoding(h: &mut Harness) -> Result<()> {
    let shape = NetShape {
        depth: 1,
        width: 96,
        skip: 9,
        position_frequencies: 10,
        time_frequencies: 10,
        ..NetShape::PAPER
    };
    let inputs = shape.inputs();
    for (first, sign) in [0, 7, 14, 21, 28, 35, 42, 49, 56, 63, 70, 77]
        .into_iter()
        .flat_map(|first| [(first, 1.0), (first, -1.0)])
    {
        // Unit o passes input o (or its negative, which the ReLU would cut), the head seven of them.
        let mut problem = Problem::new(h, shape, 50, 1);
        problem.parameters.fill(0.0);
        for o in 0..inputs {
            problem.parameters[o * inputs + o] = sign;
        }
        let head = (inputs + 1) * 96;
        for o in 0..7 {
            problem.parameters[head + o * 96 + first + o] = 1.0;
        }
        // Measured 1.2e-7: f32's rounding around 1, twice where the rotation's 1 is added.
        let bounds = [Bound { absolute: 4e-7, relative: 0.0 }, Bound::ZERO];
        let mut workload = MlpWorkload::new(h, problem, Pass::Forward, bounds)?;
        h.execute(&mut workload)?;
    }
    Ok(())
}
