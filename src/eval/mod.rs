//! How good a result is: image metrics and their kin.

pub mod image;

pub use image::{
    depth_relative_median, mask_iou, masked_psnr, ms_ssim, psnr, ssim, ssim_map, ssim_valid,
};
//! How good a result is: camera trajectories against a reference.

mod trajectory;

pub use trajectory::{Align, Statistics, TrajectoryErrors, compare_trajectories, match_by_time};
