//! The photometric loss and its gradient to the rendered image.

use crate::gpu::kernel;

kernel! {
    /// SSIM's window along columns.
    pub struct Columns("loss/columns"), workgroup: [64, 1, 1],
    params: ColumnsParams {
        /// Image width, pixels.
        width: i32,
        /// Image height, pixels.
        height: i32,
        /// Pixels that an invocation walks over.
        run: i32,
        /// Background.
        background_red: f32,
        /// Background.
        background_green: f32,
        /// Background.
        background_blue: f32,
    },
    args: ColumnsArgs {
        /// The rendered image.
        rgba: Read<[f32; 4]>,
        /// Packed 8-bit red, green, blue, weight.
        reference: Read<u32>,
        /// x, y, x² + y², x·y of the first channel.
        windowed_reds: Write<[f32; 4]>,
        /// Of the second.
        windowed_greens: Write<[f32; 4]>,
        /// Of the third.
        windowed_blues: Write<[f32; 4]>,
    }
}

kernel! {
    /// SSIM's window along rows, the map's sum, and its derivatives windowed along rows, of one
    /// channel.
    pub struct Ssim("loss/ssim"), workgroup: [64, 1, 1],
    params: SsimParams {
        /// Image width, pixels.
        width: i32,
        /// Image height, pixels.
        height: i32,
        /// Pixels that an invocation walks over.
        run: i32,
        /// Where the workgroups' sums go.
        partials_at: i32,
    },
    args: SsimArgs {
        /// x, y, x² + y², x·y, windowed along columns.
        windowed: Read<[f32; 4]>,
        /// Packed 8-bit red, green, blue, weight.
        reference: Read<u32>,
        /// By the windowed x, x², x·y.
        derivatives: Write<[f32; 3]>,
        /// Weighted sum of the map per workgroup.
        partials: Write<f32>,
    }
}

kernel! {
    /// The derivatives' window along columns, and the gradient of L1 + D-SSIM.
    pub struct Gradient("loss/gradient"), workgroup: [64, 1, 1],
    params: GradientParams {
        /// Image width, pixels.
        width: i32,
        /// Image height, pixels.
        height: i32,
        /// Pixels that an invocation walks over.
        run: i32,
        /// Background.
        background_red: f32,
        /// Background.
        background_green: f32,
        /// Background.
        background_blue: f32,
        /// Share of L1 over 3 · sum of weights.
        l1_factor: f32,
        /// Share of D-SSIM over 3 · sum of weights.
        ssim_factor: f32,
    },
    args: GradientArgs {
        /// The rendered image.
        rgba: Read<[f32; 4]>,
        /// Packed 8-bit red, green, blue, weight.
        reference: Read<u32>,
        /// Derivatives of the first channel by x, x², x·y, windowed along rows.
        by_reds: Read<[f32; 3]>,
        /// Of the second.
        by_greens: Read<[f32; 3]>,
        /// Of the third.
        by_blues: Read<[f32; 3]>,
        /// By colour and alpha.
        rgba_gradient: Write<[f32; 4]>,
        /// Weighted sum of the absolute differences per workgroup.
        partials: Write<f32>,
    }
}

kernel! {
    /// The depth term.
    pub struct Depth("loss/depth"), workgroup: [64, 1, 1],
    params: DepthParams {
        /// Number of pixels.
        pixels: u32,
        /// The term's factor over the sum of weights.
        factor: f32,
        /// Pixels less opaque than this are left out.
        least_alpha: f32,
    },
    args: DepthArgs {
        /// The rendered image.
        rgba: Read<[f32; 4]>,
        /// The rendered depth.
        depth: Read<f32>,
        /// Known disparity and weight.
        known: Read<[f32; 2]>,
        /// Alpha's is added to.
        rgba_gradient: ReadWrite<[f32; 4]>,
        /// By depth.
        depth_gradient: Write<f32>,
        /// Weighted sum per workgroup.
        partials: Write<f32>,
    }
}

kernel! {
    /// Adds up the workgroups' sums of one term.
    pub struct Total("loss/total"), workgroup: [64, 1, 1],
    params: TotalParams {
        /// Number of partial sums.
        count: u32,
        /// Where the total goes.
        slot: u32,
    },
    args: TotalArgs {
        /// One per workgroup.
        partials: Read<f32>,
        /// One per term.
        totals: ReadWrite<f32>,
    }
}
