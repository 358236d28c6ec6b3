//! Search for the nearest control points, skinning and its gradient.

use crate::gpu::kernel;

kernel! {
    /// Finds the nearest control points of every listed point.
    pub struct Nearest("deform/nearest"), workgroup: [64, 1, 1],
    constants: NearestConstants {
        /// Number of control points of each point, 1 to 16.
        k: u32 = 4,
    },
    params: NearestParams {
        /// Number of points.
        rows: u32,
        /// Number of control points.
        node_count: u32,
        /// Whether `ids` lists the points; else all rows of `positions` are points.
        listed: u32,
    },
    args: NearestArgs {
        /// Rows of `positions` of the listed points.
        ids: Read<u32>,
        /// Positions of the points, three values each.
        positions: ReadVec3<f32>,
        /// Positions of the control points, three values each.
        nodes: ReadVec3<f32>,
        /// Control points of each row, nearest first.
        neighbours: Write<u32>,
    }
}

kernel! {
    /// Writes sort keys that order places by their control points.
    pub struct Keys("deform/keys"), workgroup: [64, 1, 1],
    params: KeysParams {
        /// Number of places.
        count: u32,
        /// Number of control points.
        node_count: u32,
    },
    args: KeysArgs {
        /// Control points of the places.
        neighbours: Read<u32>,
        /// Receives the control point, or the number of control points for an empty place.
        keys: Write<u32>,
        /// Receives the index of the place.
        places: Write<u32>,
    }
}

kernel! {
    /// Finds the begin of each control point's range of places.
    pub struct Starts("deform/starts"), workgroup: [64, 1, 1],
    params: StartsParams {
        /// Number of places.
        count: u32,
        /// Number of control points.
        node_count: u32,
    },
    args: StartsArgs {
        /// Sorted keys.
        keys: Read<u32>,
        /// Begin of each range, and the end of the last: one value more than there are control points.
        starts: Write<u32>,
    }
}

kernel! {
    /// Moves the dynamic Gaussians by linear blend skinning.
    pub struct Skin("deform/skin"), workgroup: [64, 1, 1],
    constants: SkinConstants {
        /// Number of control points that each Gaussian follows, 1 to 8.
        k: u32 = 4,
    },
    params: SkinParams {
        /// Number of dynamic Gaussians.
        rows: u32,
        /// First row of `transforms`.
        transforms_at: u32,
        /// Whether motion is weighted by the motion logits.
        soft: u32,
    },
    args: SkinArgs {
        /// Indices of the dynamic Gaussians.
        gaussian_from_dynamic: Read<u32>,
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
    /// Computes the gradients of [`Skin`].
    pub struct SkinBackward("deform/skin_backward"), workgroup: [64, 1, 1],
    constants: SkinConstants,
    params: SkinBackwardParams {
        /// Number of dynamic Gaussians.
        rows: u32,
        /// First row of `transforms`.
        transforms_at: u32,
        /// Whether motion is weighted by the motion logits.
        soft: u32,
        /// Weight of the sum of rigidity terms in the loss.
        rigid_scale: f32,
    },
    args: SkinBackwardArgs {
        /// Indices of the dynamic Gaussians.
        gaussian_from_dynamic: Read<u32>,
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
        /// In: gradient with respect to the moved centres. Out: with respect to the canonical ones.
        position_gradients: ReadWriteVec3<f32>,
        /// In: gradient with respect to the moved quaternions. Out: with respect to the canonical ones.
        rotation_gradients: ReadWrite<[f32; 4]>,
        /// Gradient with respect to the motion logits; accumulated where motion is soft.
        motion_gradients: ReadWrite<f32>,
        /// Contribution of each place to the gradient of its control point: two vectors.
        contributions: Write<[f32; 4]>,
    }
}

kernel! {
    /// Sums the contributions to each control point.
    pub struct Gather("deform/gather"), workgroup: [64, 1, 1],
    params: GatherParams {
        /// Number of control points.
        node_count: u32,
        /// First row of `transforms`.
        transforms_at: u32,
        /// Whether to add to the gradients instead of overwriting them.
        accumulate: u32,
    },
    args: GatherArgs {
        /// Begin of each control point's range in `place_from_sorted`, and the end of the last.
        starts: Read<u32>,
        /// Places, ordered by control point.
        place_from_sorted: Read<u32>,
        /// As [`SkinBackward`] writes them.
        contributions: Read<[f32; 4]>,
        /// Motions of the control points.
        transforms: Read<[f32; 4]>,
        /// Gradients with respect to the motions.
        transform_gradients: ReadWrite<[f32; 4]>,
        /// Gradients with respect to the logarithms of the radii.
        radius_gradients: ReadWrite<f32>,
    }
}
