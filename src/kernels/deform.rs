//! Nearest control points, skinning and its derivative.

use crate::gpu::kernel;

kernel! {
    /// The nearest nodes of every listed point. Specialisation constant 0: how many, 1 to 16.
    pub struct Nearest("deform/nearest"), workgroup: [64, 1, 1],
    params: NearestParams {
        /// Points.
        rows: u32,
        /// Nodes.
        node_count: u32,
        /// Whether `ids` name the points.
        listed: u32,
    },
    args: NearestArgs {
        /// Rows of `positions`.
        ids: Read<u32>,
        /// Three values a point.
        positions: ReadVec3<f32>,
        /// Three values a node.
        nodes: ReadVec3<f32>,
        /// Nodes of each row, nearest first.
        neighbours: Write<u32>,
    }
}

kernel! {
    /// Sort keys that order places by their nodes.
    pub struct Keys("deform/keys"), workgroup: [64, 1, 1],
    params: KeysParams {
        /// Places.
        count: u32,
        /// Nodes.
        node_count: u32,
    },
    args: KeysArgs {
        /// Nodes of the places.
        neighbours: Read<u32>,
        /// Gets the node, or the number of nodes for an empty place.
        keys: Write<u32>,
        /// Gets the place itself.
        places: Write<u32>,
    }
}

kernel! {
    /// Where each node's places begin.
    pub struct Starts("deform/starts"), workgroup: [64, 1, 1],
    params: StartsParams {
        /// Places.
        count: u32,
        /// Nodes.
        node_count: u32,
    },
    args: StartsArgs {
        /// Sorted keys.
        keys: Read<u32>,
        /// One more than there are nodes.
        starts: Write<u32>,
    }
}

kernel! {
    /// Moves the dynamic Gaussians. Specialisation constant 0: neighbours, 1 to 8.
    pub struct Skin("deform/skin"), workgroup: [64, 1, 1],
    params: SkinParams {
        /// Dynamic Gaussians.
        rows: u32,
        /// First row of `transforms`.
        transforms_at: u32,
        /// Whether motion is weighted by the motion logits.
        soft: u32,
    },
    args: SkinArgs {
        /// Which Gaussians move.
        dynamic_ids: Read<u32>,
        /// Their control points.
        neighbours: Read<u32>,
        /// Canonical centres.
        positions: ReadVec3<f32>,
        /// Canonical quaternions.
        rotations: Read<[f32; 4]>,
        /// Motion logits; not read unless soft.
        motion_logits: Read<f32>,
        /// Evidence of motion; not read unless soft.
        evidence: Read<f32>,
        /// Canonical positions of the control points.
        nodes: ReadVec3<f32>,
        /// Logarithms of their radii.
        log_radii: Read<f32>,
        /// Their motions, two vectors each.
        transforms: Read<[f32; 4]>,
        /// Canonical logits of the opacities.
        opacity_logits: Read<f32>,
        /// Centres at the time.
        moved_positions: WriteVec3<f32>,
        /// Quaternions at the time.
        moved_rotations: Write<[f32; 4]>,
        /// Logits of the opacities at the time.
        moved_opacity_logits: Write<f32>,
        /// The rigidity term of each row.
        rigidity: Write<f32>,
    }
}

kernel! {
    /// The derivative of [`Skin`]. Specialisation constant 0: neighbours, 1 to 8.
    pub struct SkinBackward("deform/skin_backward"), workgroup: [64, 1, 1],
    params: SkinBackwardParams {
        /// Dynamic Gaussians.
        rows: u32,
        /// First row of `transforms`.
        transforms_at: u32,
        /// Whether motion is weighted by the motion logits.
        soft: u32,
        /// Weight of the sum of rigidity terms in the loss.
        rigid_scale: f32,
    },
    args: SkinBackwardArgs {
        /// Which Gaussians move.
        dynamic_ids: Read<u32>,
        /// Their control points.
        neighbours: Read<u32>,
        /// Canonical centres.
        positions: ReadVec3<f32>,
        /// Canonical quaternions.
        rotations: Read<[f32; 4]>,
        /// Motion logits; not read unless soft.
        motion_logits: Read<f32>,
        /// Evidence of motion; not read unless soft.
        evidence: Read<f32>,
        /// Canonical positions of the control points.
        nodes: ReadVec3<f32>,
        /// Logarithms of their radii.
        log_radii: Read<f32>,
        /// Their motions, two vectors each.
        transforms: Read<[f32; 4]>,
        /// Gradient by the moved centres; becomes that by the canonical ones.
        position_gradients: ReadWriteVec3<f32>,
        /// Likewise for the quaternions.
        rotation_gradients: ReadWrite<[f32; 4]>,
        /// Added to where soft.
        motion_gradients: ReadWrite<f32>,
        /// What each place hands to its control point: two vectors.
        contributions: Write<[f32; 4]>,
    }
}

kernel! {
    /// Adds up contributions by control point.
    pub struct Gather("deform/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Control points.
        node_count: u32,
        /// First row of `transforms`.
        transforms_at: u32,
        /// Whether to add to what is there.
        accumulate: u32,
    },
    args: GatherArgs {
        /// Where each control point's places begin.
        starts: Read<u32>,
        /// Places in the order of their control points.
        places: Read<u32>,
        /// As [`SkinBackward`] writes them.
        contributions: Read<[f32; 4]>,
        /// Motions of the control points.
        transforms: Read<[f32; 4]>,
        /// Gradients by these.
        transform_gradients: ReadWrite<[f32; 4]>,
        /// Gradients by the logarithms of the radii.
        radius_gradients: ReadWrite<f32>,
    }
}
