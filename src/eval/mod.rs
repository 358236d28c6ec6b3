//! How good a result is: images and masks against a reference, camera trajectories against a
//! reference.

mod image;
mod trajectory;

pub use image::{
    depth_relative_median, mask_iou, masked_psnr, ms_ssim, psnr, ssim, ssim_map, ssim_valid,
};
pub use trajectory::{Align, Statistics, TrajectoryErrors, compare_trajectories, match_by_time};
