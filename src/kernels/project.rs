//! Projection of Gaussians to splats, and its gradients.

use crate::gpu::kernel;

kernel! {
    /// Culls and projects every Gaussian.
    pub struct Forward("project/forward"), workgroup: [64, 1, 1],
    constants: ForwardConstants {
        /// Whether the spherical harmonics are stored as 16-bit floats, two to a word.
        half_sh: bool = false,
        /// Whether the log scales are.
        half_scales: bool = false,
        /// Whether the rotations are.
        half_rotations: bool = false,
        /// Whether the opacity logits are.
        half_opacities: bool = false,
        /// Whether band 1 of the harmonics is evaluated.
        band1: bool = true,
        /// Whether band 2 is evaluated.
        band2: bool = true,
        /// Whether band 3 is evaluated.
        band3: bool = true,
    },
    params: ForwardParams {
        /// Number of Gaussians.
        count: u32,
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Near plane, depth in world units.
        near: f32,
        /// Dilation of the 2D covariance, pixels².
        dilation: f32,
        /// Smallest α that is blended.
        alpha_cut: f32,
        /// Clamp of the tangents in the projection's Jacobian: they may exceed those of the image's
        /// edges by (`tangent_clamp` − 1) times those of half the image.
        tangent_clamp: f32,
    },
    args: ForwardArgs {
        /// The camera, 20 floats; see [`device_camera`](crate::ops::render::device_camera).
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
        /// The factored conic (a, b, e), and the exponent's magnitude at which α falls to `alpha_cut`.
        conics: Write<[f32; 4]>,
        /// Red, green, blue.
        colours: Write<[f32; 4]>,
        /// The rectangle of tiles: the first and one past the last, x in the low half of a word, y in
        /// the high half.
        rectangles: Write<[u32; 2]>,
        /// Number of tiles that the splat overlaps; 0 for culled Gaussians, whose other outputs are not
        /// written.
        tile_counts: Write<u32>,
        /// 1 for a Gaussian that is not culled, else 0.
        visible: Write<u32>,
    }
}

kernel! {
    /// Gradients with respect to every parameter and to the camera's pose.
    pub struct Backward("project/backward"), workgroup: [64, 1, 1],
    constants: BackwardConstants {
        /// Whether band 1 of the harmonics is evaluated.
        band1: bool = true,
        /// Whether band 2 is evaluated.
        band2: bool = true,
        /// Whether band 3 is evaluated.
        band3: bool = true,
        /// Whether the pose's gradient is computed.
        with_pose: bool = true,
    },
    params: BackwardParams {
        /// Number of Gaussians.
        count: u32,
        /// Image width, pixels.
        width: u32,
        /// Image height, pixels.
        height: u32,
        /// Near plane, depth in world units.
        near: f32,
        /// Dilation of the 2D covariance, pixels².
        dilation: f32,
        /// Clamp of the tangents in the projection's Jacobian: they may exceed those of the image's
        /// edges by (`tangent_clamp` − 1) times those of half the image.
        tangent_clamp: f32,
    },
    args: BackwardArgs {
        /// The camera, 20 floats; see [`device_camera`](crate::ops::render::device_camera).
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
        /// 1 for a Gaussian that is not culled; from `project/forward`.
        visible: Read<u32>,
        /// 1 per Gaussian.
        opacity_logits: Read<f32>,
        /// From `project/forward`.
        colours: Read<[f32; 4]>,
        /// Gradients with respect to mean x, mean y (pixels), depth, opacity.
        mean_gradients: Read<[f32; 4]>,
        /// Gradients with respect to the whitened covariance: xx, xy, yy.
        covariance_gradients: Read<[f32; 4]>,
        /// Gradients with respect to red, green, blue.
        colour_gradients: Read<[f32; 4]>,
        /// 3 per Gaussian.
        position_gradients: WriteVec3<f32>,
        /// 3 per Gaussian.
        log_scale_gradients: WriteVec3<f32>,
        /// Gradients with respect to the quaternion before normalisation.
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
        /// 8 values per workgroup, of which 6 are used: translation, rotation.
        pose_partials: Write<f32>,
    }
}

kernel! {
    /// Sums the workgroups' contributions to the pose's gradient.
    pub struct Pose("project/pose"), workgroup: [64, 1, 1],
    params: PoseParams {
        /// Number of workgroups of the backward pass.
        groups: u32,
    },
    args: PoseArgs {
        /// 8 values per workgroup.
        pose_partials: Read<f32>,
        /// 6 values: translation, rotation.
        pose: Write<f32>,
    }
}
