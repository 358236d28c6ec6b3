//! How good a result is: image metrics and their kin.

pub mod image;

pub use image::{
    depth_relative_median, mask_iou, masked_psnr, ms_ssim, psnr, ssim, ssim_map, ssim_valid,
};
