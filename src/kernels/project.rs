//! Projection of Gaussians to splats, and its gradients.

use crate::gpu::kernel;

kernel! {
    /// Culls and projects every Gaussian. Specialisation constants, 1 for what is kept as 16-bit
    /// floats, two to a word: 0 the spherical harmonics, 1 log scales and opacity logits, 2 rotations;
    /// 3, 4, 5: whether the harmonics have the bands 1, 2, 3.
    pub struct Forward("project/forward"), workgroup: [64, 1, 1],
    params: ForwardParams {
        /// Number of Gaussians.
        count: u32,
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Near plane.
        near: f32,
        /// Dilation of the 2D covariance, pixels².
        dilation: f32,
        /// Least α that counts.
        alpha_cut: f32,
        /// Clamp of the Jacobian's tangents, half fields of view.
        tangent_clamp: f32,
    },
    args: ForwardArgs {
        /// The camera, 20 floats.
        camera: Read<f32>,
        /// 3 per Gaussian.
        positions: ReadVec3<f32>,
        /// 3 per Gaussian.
        log_scales: ReadVec3<f32>,
        /// w, x, y, z.
        rotations: Read<[f32; 4]>,
        /// 1 per Gaussian.
        opacity_logits: Read<f32>,
        /// 3 per Gaussian.
        sh0: ReadVec3<f32>,
        /// 9 per Gaussian; read with band 1.
        sh1: ReadVec3<f32>,
        /// 15 per Gaussian; read with band 2.
        sh2: ReadVec3<f32>,
        /// 21 per Gaussian; read with band 3.
        sh3: ReadVec3<f32>,
        /// Mean x, mean y, depth, opacity.
        means: Write<[f32; 4]>,
        /// The conic factored (a, b, e), and the power at which α falls to the cut.
        conics: Write<[f32; 4]>,
        /// Red, green, blue.
        colours: Write<[f32; 4]>,
        /// First and last + 1 tile, x in the low half.
        rectangles: Write<[u32; 2]>,
        /// Tiles reached; 0 for culled ones, whose other outputs stay as they were.
        tile_counts: Write<u32>,
        /// 1 for what is not culled.
        visible: Write<u32>,
    }
}

kernel! {
    /// Gradients to every parameter and to the camera's pose. Specialisation constants: 0, 1, 2 whether
    /// the harmonics have the bands 1, 2, 3; 3 whether the pose's gradient is wanted.
    pub struct Backward("project/backward"), workgroup: [64, 1, 1],
    params: BackwardParams {
        /// Number of Gaussians.
        count: u32,
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Near plane.
        near: f32,
        /// Dilation of the 2D covariance, pixels².
        dilation: f32,
        /// Clamp of the Jacobian's tangents, half fields of view.
        tangent_clamp: f32,
    },
    args: BackwardArgs {
        /// The camera, 20 floats.
        camera: Read<f32>,
        /// 3 per Gaussian.
        positions: ReadVec3<f32>,
        /// 3 per Gaussian.
        log_scales: ReadVec3<f32>,
        /// w, x, y, z.
        rotations: Read<[f32; 4]>,
        /// 9 per Gaussian.
        sh1: ReadVec3<f32>,
        /// 15 per Gaussian.
        sh2: ReadVec3<f32>,
        /// 21 per Gaussian.
        sh3: ReadVec3<f32>,
        /// From the forward pass.
        visible: Read<u32>,
        /// 1 per Gaussian.
        opacity_logits: Read<f32>,
        /// From the forward pass.
        colours: Read<[f32; 4]>,
        /// By mean x, mean y, depth, opacity.
        mean_gradients: Read<[f32; 4]>,
        /// By the whitened covariance: xx, xy, yy.
        covariance_gradients: Read<[f32; 4]>,
        /// By red, green, blue.
        colour_gradients: Read<[f32; 4]>,
        /// 3 per Gaussian.
        position_gradients: WriteVec3<f32>,
        /// 3 per Gaussian.
        log_scale_gradients: WriteVec3<f32>,
        /// By the raw quaternion.
        rotation_gradients: Write<[f32; 4]>,
        /// 1 per Gaussian.
        opacity_gradients: Write<f32>,
        /// 3 per Gaussian.
        sh0_gradients: WriteVec3<f32>,
        /// 9 per Gaussian.
        sh1_gradients: WriteVec3<f32>,
        /// 15 per Gaussian.
        sh2_gradients: WriteVec3<f32>,
        /// 21 per Gaussian.
        sh3_gradients: WriteVec3<f32>,
        /// 8 per workgroup, 6 used: translation, rotation.
        pose_partials: Write<f32>,
    }
}

kernel! {
    /// Adds up the pose's gradient.
    pub struct Pose("project/pose"), workgroup: [64, 1, 1],
    params: PoseParams {
        /// Workgroups of the backward pass.
        groups: u32,
    },
    args: PoseArgs {
        /// 8 per workgroup.
        pose_partials: Read<f32>,
        /// 6: translation, rotation.
        pose: Write<f32>,
    }
}
