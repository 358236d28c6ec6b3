//! The photometric loss and its gradient with respect to the rendered image.

use crate::gpu::kernel;

kernel! {
    /// Applies SSIM's window along columns.
    pub struct Columns("loss/columns"), workgroup: [64, 1, 1],
    params: ColumnsParams {
        /// Image width, pixels.
        width: i32,
        /// Image height, pixels.
        height: i32,
        /// Number of pixels in an invocation's run.
        run: i32,
        /// Red of the background.
        background_red: f32,
        /// Green of the background.
        background_green: f32,
        /// Blue of the background.
        background_blue: f32,
    },
    args: ColumnsArgs {
        /// The rendered image.
        rgba: Read<[f32; 4]>,
        /// Packed 8-bit red, green, blue, weight.
        reference: Read<u32>,
        /// Windowed x, y, x² + y², x·y of red (x: rendered, y: reference).
        windowed_reds: Write<[f32; 4]>,
        /// The same of green.
        windowed_greens: Write<[f32; 4]>,
        /// The same of blue.
        windowed_blues: Write<[f32; 4]>,
    }
}

kernel! {
    /// For one channel: applies SSIM's window along rows, sums the SSIM map, and applies the window
    /// along rows to the map's derivatives.
    pub struct Ssim("loss/ssim"), workgroup: [64, 1, 1],
    params: SsimParams {
        /// Image width, pixels.
        width: i32,
        /// Image height, pixels.
        height: i32,
        /// Number of pixels in an invocation's run.
        run: i32,
        /// Index in `partials` of the first workgroup's sum.
        partials_at: i32,
    },
    args: SsimArgs {
        /// x, y, x² + y², x·y, windowed along columns.
        windowed: Read<[f32; 4]>,
        /// Packed 8-bit red, green, blue, weight.
        reference: Read<u32>,
        /// Derivatives with respect to the windowed x, x², x·y.
        derivatives: Write<[f32; 3]>,
        /// Weighted sum of the SSIM map per workgroup.
        partials: Write<f32>,
    }
}

kernel! {
    /// Applies the window along columns to the derivatives, and computes the gradient of L1 + D-SSIM.
    pub struct Gradient("loss/gradient"), workgroup: [64, 1, 1],
    params: GradientParams {
        /// Image width, pixels.
        width: i32,
        /// Image height, pixels.
        height: i32,
        /// Number of pixels in an invocation's run.
        run: i32,
        /// Red of the background.
        background_red: f32,
        /// Green of the background.
        background_green: f32,
        /// Blue of the background.
        background_blue: f32,
        /// Share of L1, divided by 3 · sum of weights.
        l1_factor: f32,
        /// Share of D-SSIM, divided by 3 · sum of weights.
        ssim_factor: f32,
    },
    args: GradientArgs {
        /// The rendered image.
        rgba: Read<[f32; 4]>,
        /// Packed 8-bit red, green, blue, weight.
        reference: Read<u32>,
        /// Derivatives of red with respect to x, x², x·y, windowed along rows.
        by_reds: Read<[f32; 3]>,
        /// The same of green.
        by_greens: Read<[f32; 3]>,
        /// The same of blue.
        by_blues: Read<[f32; 3]>,
        /// Gradient with respect to premultiplied colour and alpha.
        rgba_gradient: Write<[f32; 4]>,
        /// Weighted sum of the absolute differences per workgroup.
        partials: Write<f32>,
    }
}

kernel! {
    /// Computes the depth term and its gradient.
    pub struct Depth("loss/depth"), workgroup: [64, 1, 1],
    params: DepthParams {
        /// Number of pixels.
        pixels: u32,
        /// The term's factor, divided by the sum of weights.
        factor: f32,
        /// Pixels with a smaller alpha are left out.
        least_alpha: f32,
    },
    args: DepthArgs {
        /// The rendered image.
        rgba: Read<[f32; 4]>,
        /// The rendered depth.
        depth: Read<f32>,
        /// Known disparity and weight.
        known: Read<[f32; 2]>,
        /// Gradient with respect to the image; the part of alpha is accumulated.
        rgba_gradient: ReadWrite<[f32; 4]>,
        /// Gradient with respect to depth.
        depth_gradient: Write<f32>,
        /// Weighted sum of the absolute differences per workgroup.
        partials: Write<f32>,
    }
}

kernel! {
    /// Sums the workgroups' sums of one term.
    pub struct Total("loss/total"), workgroup: [64, 1, 1],
    params: TotalParams {
        /// Number of partial sums.
        count: u32,
        /// Index in `totals`.
        slot: u32,
    },
    args: TotalArgs {
        /// The workgroups' sums.
        partials: Read<f32>,
        /// One total per term.
        totals: ReadWrite<f32>,
    }
}
