//! The deformation network on the device: evaluation of the control points' motions, and the gradient
//! with respect to the parameters.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::mlp::{
    Backward, BackwardArgs, BackwardParams, Encode, EncodeArgs, EncodeParams, Forward, ForwardArgs,
    ForwardParams, LoadConstants, Reduce, ReduceArgs, ReduceParams, Seed, SeedArgs, SeedParams,
    Transforms, TransformsArgs, TransformsParams, Weights, WeightsArgs, WeightsParams,
};
use crate::types::NetShape;

/// Rows in one segment of the sum over rows for the parameters' gradients; the segments are added in
/// order.
const SEGMENT: usize = 64;
/// Numbers of features and rows that one invocation computes.
const TILE: usize = 8;
const WORKGROUP: u32 = 64;

/// The planes that a layer reads and writes.
#[derive(Clone, Copy, Debug)]
struct Layer {
    inputs: usize,
    outputs: usize,
    encoded: usize,
    source: usize,
    target: usize,
    weights_at: usize,
}

/// A network's plan. Records only: it never allocates, submits or waits.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Device, Recorder};
/// use splat4d::ops::mlp::Network;
/// use splat4d::types::DeformNet;
/// # fn motions(
/// #     device: &Device, recorder: &mut Recorder, network: &DeformNet, nodes: &Buffer<f32>,
/// #     by_transforms: &Buffer<[f32; 4]>,
/// # ) -> splat4d::Result<()> {
/// let parameters = device.upload("parameters", &network.parameters)?;
/// let times = device.upload("times", &[0.0f32, 0.5])?;
/// let plan = Network::plan(device, &network.shape)?;
/// let rows = nodes.len() / 3 * times.len();
/// let mut scratch = plan.scratch(device, rows)?;
/// let mut transforms = device.buffer("motions", 2 * rows)?;
/// let (weights, points) = (parameters.view(), nodes.view());
/// plan.forward(recorder, weights, points, times.view(), transforms.view_mut(), &mut scratch)?;
///
/// let mut gradients = device.buffer("gradients", network.parameters.len())?;
/// let given = by_transforms.view();
/// plan.backward(recorder, weights, given, gradients.view_mut(), false, &mut scratch)?;
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct Network {
    shape: NetShape,
    layers: Vec<Layer>,
    /// Number of parameters.
    parameters: usize,
    planes: usize,
    /// The size of the subgroups whose invocations share their loads; `None` without sharing.
    sharing: Option<usize>,
}

/// Intermediate buffers of a [`Network`]; they keep the activations between forward and backward pass.
pub struct NetworkScratch {
    rows: usize,
    activations: Buffer<[f32; 4]>,
    deltas: Buffer<[f32; 4]>,
    partials: Buffer<f32>,
}

impl Network {
    /// Plans a network of a shape.
    ///
    /// # Errors
    /// [`Error::Input`] for a width that is no multiple of 16, no layers, or more than 24 octaves.
    pub fn plan(device: &Device, shape: &NetShape) -> Result<Network> {
        let wrong = |what: &str| Err(Error::Input(format!("deformation network: {what}")));
        if shape.width == 0 || !shape.width.is_multiple_of(16) {
            return wrong(&format!("the width is {}, it must be a multiple of 16", shape.width));
        }
        if shape.depth == 0 {
            return wrong("it needs at least one hidden layer");
        }
        if shape.position_frequencies.max(shape.time_frequencies) > 24 {
            return wrong("more than 24 octaves mean nothing in f32");
        }
        let encoding = shape.inputs();
        let (mut target, mut weights_at) = (encoding, 0);
        let mut layers: Vec<Layer> = Vec::new();
        for (inputs, outputs) in shape.layers() {
            let below = layers.last().map_or(0, |layer| layer.outputs);
            let source = layers.last().map_or(0, |layer| layer.target);
            let encoded = inputs - below;
            layers.push(Layer { inputs, outputs, encoded, source, target, weights_at });
            target += outputs;
            weights_at += (inputs + 1) * outputs;
        }
        let subgroup = device.subgroup_size() as usize;
        let shares = device.profile().shared_loads && (4..=WORKGROUP as usize).contains(&subgroup);
        Ok(Network {
            shape: *shape,
            layers,
            planes: target,
            parameters: weights_at,
            sharing: shares.then_some(subgroup),
        })
    }

    /// The network's shape.
    pub fn shape(&self) -> &NetShape {
        &self.shape
    }

    /// Allocates the intermediate buffers for `rows` rows (number of control points × number of times).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn scratch(&self, device: &Device, rows: usize) -> Result<NetworkScratch> {
        let stride = self.stride(rows);
        let stride4 = stride / 4;
        let widest = (self.shape.width as usize).max(NetShape::OUTPUTS);
        let largest = self.layers.iter().map(|l| l.outputs * (l.inputs + 1)).max().unwrap_or(0);
        Ok(NetworkScratch {
            rows,
            activations: device.buffer("network activations", self.planes * stride4)?,
            deltas: device.buffer("network gradients", 2 * widest * stride4)?,
            partials: device.buffer("network partials", stride.div_ceil(SEGMENT) * largest)?,
        })
    }

    /// Records the motions of every control point at every time: `mlp/encode`, `mlp/forward` for each
    /// layer, `mlp/transforms`. Row `time · nodes + node` of `transforms` (two vectors) receives the
    /// translation and padding, then the rotation `[1, 0, 0, 0] + δ`, not normalised.
    ///
    /// `nodes` holds three values for each control point.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree with each other or with the scratch.
    pub fn forward(
        &self,
        recorder: &mut Recorder,
        parameters: View<'_, f32>,
        nodes: View<'_, f32>,
        times: View<'_, f32>,
        transforms: ViewMut<'_, [f32; 4]>,
        scratch: &mut NetworkScratch,
    ) -> Result<()> {
        let node_count = nodes.len() / 3;
        let rows = node_count * times.len();
        check("nodes", nodes.len(), 3 * node_count)?;
        check("parameters", parameters.len(), self.parameters)?;
        check("transforms", transforms.len(), 2 * rows)?;
        check("scratch rows", scratch.rows, rows)?;
        let limits = *recorder.device().limits();
        let stride = self.stride(rows);
        check("scratch activations", scratch.activations.len(), self.planes * (stride / 4))?;
        let octaves = self.shape.position_frequencies.max(self.shape.time_frequencies) as usize;
        recorder.dispatch::<Encode>(
            Groups::linear(stride * (octaves + 1), WORKGROUP, &limits)?,
            EncodeParams {
                node_count: node_count as u32,
                rows: rows as u32,
                stride: stride as u32,
                position_frequencies: self.shape.position_frequencies,
                time_frequencies: self.shape.time_frequencies,
                position_lowest: 2f32.powi(self.shape.position_octave),
            },
            EncodeArgs { nodes, times, activations: scratch.activations.view_mut() },
        )?;
        let tiles = stride / TILE;
        let shared_weights = self.shared(tiles);
        for (index, layer) in self.layers.iter().enumerate() {
            recorder.dispatch_specialised::<Forward>(
                LoadConstants { shared: shared_weights },
                Groups::linear(tiles * layer.outputs.div_ceil(TILE), WORKGROUP, &limits)?,
                ForwardParams {
                    stride4: (stride / 4) as u32,
                    inputs: layer.inputs as u32,
                    outputs: layer.outputs as u32,
                    encoded: layer.encoded as u32,
                    source: layer.source as u32,
                    target: layer.target as u32,
                    weights_at: layer.weights_at as u32,
                    relu: u32::from(index + 1 < self.layers.len()),
                },
                ForwardArgs { parameters, activations: scratch.activations.view_mut() },
            )?;
        }
        recorder.dispatch::<Transforms>(
            Groups::linear(rows, WORKGROUP, &limits)?,
            TransformsParams {
                rows: rows as u32,
                stride: stride as u32,
                head: (self.planes - NetShape::OUTPUTS) as u32,
            },
            TransformsArgs { activations: scratch.activations.view(), transforms },
        )
    }

    /// Records the gradient with respect to the parameters, after [`forward`](Self::forward) with the
    /// same scratch: `mlp/seed`; for each layer from the last `mlp/weights`, `mlp/reduce` and, except
    /// for the first layer, `mlp/backward`. `gradients` is laid out as the parameters. With `accumulate`
    /// the gradient is added to it, else it is overwritten.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree with each other or with the scratch.
    pub fn backward(
        &self,
        recorder: &mut Recorder,
        parameters: View<'_, f32>,
        transform_gradients: View<'_, [f32; 4]>,
        mut gradients: ViewMut<'_, f32>,
        accumulate: bool,
        scratch: &mut NetworkScratch,
    ) -> Result<()> {
        let rows = scratch.rows;
        check("parameters", parameters.len(), self.parameters)?;
        check("gradients", gradients.len(), self.parameters)?;
        check("transform gradients", transform_gradients.len(), 2 * rows)?;
        let limits = *recorder.device().limits();
        let stride = self.stride(rows);
        let widest = (self.shape.width as usize).max(NetShape::OUTPUTS);
        check("scratch gradients", scratch.deltas.len(), 2 * widest * (stride / 4))?;
        // The gradients of two layers are live at the same time; the deltas alternate between two
        // places.
        let (mut here, mut below) = (0, widest);
        recorder.dispatch::<Seed>(
            Groups::linear(stride, WORKGROUP, &limits)?,
            SeedParams { rows: rows as u32, stride: stride as u32, target: here as u32 },
            SeedArgs { transform_gradients, deltas: scratch.deltas.view_mut() },
        )?;
        let segments = stride.div_ceil(SEGMENT);
        for (index, layer) in self.layers.iter().enumerate().rev() {
            let tiles = layer.outputs.div_ceil(TILE);
            let of_rows = tiles * (layer.inputs + 1).div_ceil(TILE);
            let shared_inputs = self.shared(tiles);
            recorder.dispatch_specialised::<Weights>(
                LoadConstants { shared: shared_inputs },
                Groups::linear(of_rows * segments, WORKGROUP, &limits)?,
                WeightsParams {
                    stride4: (stride / 4) as u32,
                    inputs: layer.inputs as u32,
                    outputs: layer.outputs as u32,
                    encoded: layer.encoded as u32,
                    source: layer.source as u32,
                    delta: here as u32,
                    segment4: (SEGMENT / 4) as u32,
                },
                WeightsArgs {
                    activations: scratch.activations.view(),
                    deltas: scratch.deltas.view(),
                    partials: scratch.partials.view_mut(),
                },
            )?;
            recorder.dispatch::<Reduce>(
                Groups::linear(layer.outputs * (layer.inputs + 1), WORKGROUP, &limits)?,
                ReduceParams {
                    inputs: layer.inputs as u32,
                    outputs: layer.outputs as u32,
                    segments: segments as u32,
                    weights_at: layer.weights_at as u32,
                    accumulate: u32::from(accumulate),
                },
                ReduceArgs { partials: scratch.partials.view(), gradients: gradients.reborrow() },
            )?;
            if index == 0 {
                break;
            }
            let tiles = stride / TILE;
            let of_features = tiles * (layer.inputs - layer.encoded).div_ceil(TILE);
            let shared_weights = self.shared(tiles);
            recorder.dispatch_specialised::<Backward>(
                LoadConstants { shared: shared_weights },
                Groups::linear(of_features, WORKGROUP, &limits)?,
                BackwardParams {
                    stride4: (stride / 4) as u32,
                    inputs: layer.inputs as u32,
                    outputs: layer.outputs as u32,
                    encoded: layer.encoded as u32,
                    activated: layer.source as u32,
                    source: here as u32,
                    target: below as u32,
                    weights_at: layer.weights_at as u32,
                },
                BackwardArgs {
                    parameters,
                    activations: scratch.activations.view(),
                    deltas: scratch.deltas.view_mut(),
                },
            )?;
            std::mem::swap(&mut here, &mut below);
        }
        Ok(())
    }

    /// Number of rows with padding: whole tiles, and with sharing as many as fill whole subgroups.
    fn stride(&self, rows: usize) -> usize {
        rows.next_multiple_of(TILE * self.sharing.unwrap_or(1))
    }

    /// Whether a subgroup may share loads where every `tiles` consecutive invocations need the same
    /// values.
    fn shared(&self, tiles: usize) -> bool {
        self.sharing.is_some_and(|subgroup| tiles.is_multiple_of(subgroup))
    }
}

fn check(arg: &'static str, actual: usize, expected: usize) -> Result<()> {
    if actual == expected {
        return Ok(());
    }
    Err(Error::Shape { op: "deformation network", arg, expected: expected.to_string(), actual })
}
