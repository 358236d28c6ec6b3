//! Evaluation metrics of images, masks, camera trajectories and point tracks against a reference.

mod fit;
mod image;
mod times;
mod tracks;
mod trajectory;

pub use fit::{PoseFit, fit_pose};
pub use image::{
    depth_relative_median, mask_iou, masked_mean, masked_psnr, ms_ssim, psnr, ssim, ssim_map,
    ssim_valid,
};
pub use times::{match_by_time, nearest_by_time};
pub use tracks::{SIDE, TrackScores, WITHIN, score_tracks};
pub use trajectory::{
    Align, Comparison, Relative, Statistics, Step, TrajectoryErrors, compare_matrices,
    compare_trajectories,
};
