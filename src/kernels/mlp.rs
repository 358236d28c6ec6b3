//! The deformation network, forward and backward.
//!
//! Activations and gradients are stored as *planes*: a plane is one feature of all rows, as `stride4`
//! vectors of four rows each. Rows are (control point, time) pairs, padded to a multiple of eight at
//! least. With the constant `shared`, the invocations of a subgroup share loads of values that all of
//! them need.

use crate::gpu::kernel;

kernel! {
    /// Computes the positional encodings of position and time.
    pub struct Encode("mlp/encode"), workgroup: [64, 1, 1],
    params: EncodeParams {
        /// Number of control points.
        node_count: u32,
        /// Number of rows: control points × times.
        rows: u32,
        /// Number of rows with padding.
        stride: u32,
        /// Number of octaves of the position's encoding.
        position_frequencies: u32,
        /// Number of octaves of the time's encoding.
        time_frequencies: u32,
        /// Lowest frequency of the position's encoding.
        position_lowest: f32,
    },
    args: EncodeArgs {
        /// Canonical positions, three values each.
        nodes: ReadVec3<f32>,
        /// Times in [0, 1].
        times: Read<f32>,
        /// Receives the encodings in its first planes.
        activations: Write<[f32; 4]>,
    }
}

kernel! {
    /// Evaluates one layer.
    pub struct Forward("mlp/forward"), workgroup: [64, 1, 1],
    constants: LoadConstants {
        /// Whether the invocations of a subgroup share loads; all of them must need the same values.
        shared: bool = false,
    },
    params: ForwardParams {
        /// Number of vectors of four rows.
        stride4: u32,
        /// Number of inputs of the layer.
        inputs: u32,
        /// Number of outputs of the layer.
        outputs: u32,
        /// Number of leading inputs that are encodings, from plane 0 on.
        encoded: u32,
        /// First plane of the other inputs.
        source: u32,
        /// First plane of the outputs.
        target: u32,
        /// Index of the layer's first parameter.
        weights_at: u32,
        /// Whether a ReLU follows.
        relu: u32,
    },
    args: ForwardArgs {
        /// All parameters.
        parameters: Read<f32>,
        /// All planes.
        activations: ReadWrite<[f32; 4]>,
    }
}

kernel! {
    /// Converts the outputs of the last layer to motions of control points.
    pub struct Transforms("mlp/transforms"), workgroup: [64, 1, 1],
    params: TransformsParams {
        /// Number of rows without padding.
        rows: u32,
        /// Number of rows with padding.
        stride: u32,
        /// First plane of the last layer's outputs.
        head: u32,
    },
    args: TransformsArgs {
        /// All planes.
        activations: Read<[f32; 4]>,
        /// Two vectors a row: translation and padding; rotation.
        transforms: Write<[f32; 4]>,
    }
}

kernel! {
    /// Converts the gradient with respect to the motions to the gradient with respect to the last
    /// layer's outputs.
    pub struct Seed("mlp/seed"), workgroup: [64, 1, 1],
    params: SeedParams {
        /// Number of rows without padding.
        rows: u32,
        /// Number of rows with padding.
        stride: u32,
        /// First plane to write.
        target: u32,
    },
    args: SeedArgs {
        /// Gradient with respect to the motions, two vectors a row.
        transform_gradients: Read<[f32; 4]>,
        /// Receives seven planes.
        deltas: Write<[f32; 4]>,
    }
}

kernel! {
    /// Propagates the gradient of one layer to the layer below.
    pub struct Backward("mlp/backward"), workgroup: [64, 1, 1],
    constants: LoadConstants,
    params: BackwardParams {
        /// Number of vectors of four rows.
        stride4: u32,
        /// Number of inputs of the layer.
        inputs: u32,
        /// Number of outputs of the layer.
        outputs: u32,
        /// Number of leading inputs that are encodings and get no gradient.
        encoded: u32,
        /// First plane of the layer below.
        activated: u32,
        /// First plane of this layer's gradient.
        source: u32,
        /// First plane of the layer below's gradient.
        target: u32,
        /// Index of the layer's first parameter.
        weights_at: u32,
    },
    args: BackwardArgs {
        /// All parameters.
        parameters: Read<f32>,
        /// All planes of the forward pass.
        activations: Read<[f32; 4]>,
        /// Planes of gradients.
        deltas: ReadWrite<[f32; 4]>,
    }
}

kernel! {
    /// Computes the gradients of one layer's parameters for each segment of the rows.
    pub struct Weights("mlp/weights"), workgroup: [64, 1, 1],
    constants: LoadConstants,
    params: WeightsParams {
        /// Number of vectors of four rows.
        stride4: u32,
        /// Number of inputs of the layer.
        inputs: u32,
        /// Number of outputs of the layer.
        outputs: u32,
        /// Number of leading inputs that are encodings.
        encoded: u32,
        /// First plane of the other inputs.
        source: u32,
        /// First plane of the layer's gradient.
        delta: u32,
        /// Number of vectors of four rows in a segment.
        segment4: u32,
    },
    args: WeightsArgs {
        /// All planes of the forward pass.
        activations: Read<[f32; 4]>,
        /// Planes of gradients.
        deltas: Read<[f32; 4]>,
        /// Gradients of each segment, `[outputs][inputs + 1]`.
        partials: Write<f32>,
    }
}

kernel! {
    /// Sums the gradients over the segments.
    pub struct Reduce("mlp/reduce"), workgroup: [64, 1, 1],
    params: ReduceParams {
        /// Number of inputs of the layer.
        inputs: u32,
        /// Number of outputs of the layer.
        outputs: u32,
        /// Number of segments.
        segments: u32,
        /// Index of the layer's first parameter.
        weights_at: u32,
        /// Whether to add to the gradients instead of overwriting them.
        accumulate: u32,
    },
    args: ReduceArgs {
        /// The gradients of the segments, as [`Weights`] writes them.
        partials: Read<f32>,
        /// Laid out as the parameters.
        gradients: ReadWrite<f32>,
    }
}
