//! The deformation network.
//!
//! Activations and gradients are *planes*: one feature of all rows, `stride4` vectors of four rows.
//! Rows are (control point, time) pairs, padded to a multiple of eight at least. With specialisation
//! constant 0 set, the invocations of a subgroup load for each other what all of them need.

use crate::gpu::kernel;

kernel! {
    /// Positional encodings.
    pub struct Encode("mlp/encode"), workgroup: [64, 1, 1],
    params: EncodeParams {
        /// Control points.
        node_count: u32,
        /// Control points times times.
        rows: u32,
        /// Rows with padding.
        stride: u32,
        /// Octaves of the position.
        position_frequencies: u32,
        /// Octaves of the time.
        time_frequencies: u32,
        /// The position's lowest frequency.
        position_lowest: f32,
    },
    args: EncodeArgs {
        /// Canonical positions, three values each.
        nodes: ReadVec3<f32>,
        /// Times.
        times: Read<f32>,
        /// Gets the encodings in its first planes.
        activations: Write<[f32; 4]>,
    }
}

kernel! {
    /// One layer forward.
    pub struct Forward("mlp/forward"), workgroup: [64, 1, 1],
    params: ForwardParams {
        /// Vectors of rows.
        stride4: u32,
        /// Inputs of the layer.
        inputs: u32,
        /// Its outputs.
        outputs: u32,
        /// Leading inputs that are encodings, from plane 0 on.
        encoded: u32,
        /// First plane of the other inputs.
        source: u32,
        /// First plane of the outputs.
        target: u32,
        /// Where the layer's parameters begin.
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
    /// The head's values as motions of control points.
    pub struct Transforms("mlp/transforms"), workgroup: [64, 1, 1],
    params: TransformsParams {
        /// Rows without padding.
        rows: u32,
        /// Rows with padding.
        stride: u32,
        /// First plane of the head.
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
    /// The gradients of motions as the head's gradient.
    pub struct Seed("mlp/seed"), workgroup: [64, 1, 1],
    params: SeedParams {
        /// Rows without padding.
        rows: u32,
        /// Rows with padding.
        stride: u32,
        /// First plane to write.
        target: u32,
    },
    args: SeedArgs {
        /// Two vectors a row.
        transform_gradients: Read<[f32; 4]>,
        /// Gets seven planes.
        deltas: Write<[f32; 4]>,
    }
}

kernel! {
    /// One layer backward, to the layer below.
    pub struct Backward("mlp/backward"), workgroup: [64, 1, 1],
    params: BackwardParams {
        /// Vectors of rows.
        stride4: u32,
        /// Inputs of the layer.
        inputs: u32,
        /// Its outputs.
        outputs: u32,
        /// Leading inputs that no gradient reaches.
        encoded: u32,
        /// First plane of the layer below.
        activated: u32,
        /// First plane of this layer's gradient.
        source: u32,
        /// First plane of the layer below's gradient.
        target: u32,
        /// Where the layer's parameters begin.
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
    /// Gradients of one layer's parameters, by segments of the rows.
    pub struct Weights("mlp/weights"), workgroup: [64, 1, 1],
    params: WeightsParams {
        /// Vectors of rows.
        stride4: u32,
        /// Inputs of the layer.
        inputs: u32,
        /// Its outputs.
        outputs: u32,
        /// Leading inputs that are encodings.
        encoded: u32,
        /// First plane of the other inputs.
        source: u32,
        /// First plane of the layer's gradient.
        delta: u32,
        /// Vectors of rows in a segment.
        segment4: u32,
    },
    args: WeightsArgs {
        /// All planes of the forward pass.
        activations: Read<[f32; 4]>,
        /// Planes of gradients.
        deltas: Read<[f32; 4]>,
        /// Segment by segment `[outputs][inputs + 1]`.
        partials: Write<f32>,
    }
}

kernel! {
    /// Adds the segments.
    pub struct Reduce("mlp/reduce"), workgroup: [64, 1, 1],
    params: ReduceParams {
        /// Inputs of the layer.
        inputs: u32,
        /// Its outputs.
        outputs: u32,
        /// Segments.
        segments: u32,
        /// Where the layer's parameters begin.
        weights_at: u32,
        /// Whether to add to what is there.
        accumulate: u32,
    },
    args: ReduceArgs {
        /// As [`Weights`] writes them.
        partials: Read<f32>,
        /// Laid out as the parameters.
        gradients: ReadWrite<f32>,
    }
}
