//! Declarations of the kernels, one file per family, and the list of all kernels.
//!
//! One stem names a kernel everywhere: `glsl/sort/scatter.comp`, `spirv/sort/scatter.spv`,
//! `kernels::sort::Scatter`, `oracle::sort`, `check::sort`, `tests/sort.rs`.

pub mod adam;
pub mod arap;
pub mod bin;
pub mod deform;
pub mod density;
pub mod flow;
pub mod indirect;
pub mod loss;
pub mod mask;
pub mod mlp;
pub mod path;
pub mod project;
pub mod raster;
pub mod roofline;
pub mod scan;
pub mod sort;
pub mod texel;

use crate::gpu::{Kernel, KernelInfo};

/// Every kernel of the crate, family by family.
pub const ALL: &[KernelInfo] = &[
    adam::Step::INFO,
    arap::Fit::INFO,
    arap::Gather::INFO,
    adam::Gate::INFO,
    roofline::Copy::INFO,
    roofline::Fma::INFO,
    deform::Nearest::INFO,
    deform::Keys::INFO,
    deform::Starts::INFO,
    deform::Skin::INFO,
    deform::SkinBackward::INFO,
    deform::Gather::INFO,
    density::Weigh::INFO,
    density::Slots::INFO,
    density::Draw::INFO,
    density::Shrink::INFO,
    density::Copy::INFO,
    density::Zero::INFO,
    density::Jitter::INFO,
    density::Decide::INFO,
    density::Layout::INFO,
    density::Gather::INFO,
    density::Parts::INFO,
    density::Accumulate::INFO,
    density::Regularise::INFO,
    density::Reset::INFO,
    flow::Luma::INFO,
    flow::Halve::INFO,
    flow::Derivatives::INFO,
    flow::Census::INFO,
    flow::Path::INFO,
    flow::Cheapest::INFO,
    flow::Upsample::INFO,
    flow::Search::INFO,
    flow::Propagate::INFO,
    flow::Densify::INFO,
    flow::Trust::INFO,
    flow::Linearise::INFO,
    flow::Slopes::INFO,
    flow::Slant::INFO,
    flow::Relax::INFO,
    flow::Median::INFO,
    flow::Confidence::INFO,
    indirect::Arguments::INFO,
    project::Forward::INFO,
    project::Backward::INFO,
    project::Pose::INFO,
    bin::Compact::INFO,
    bin::Counts::INFO,
    bin::Emit::INFO,
    bin::Ranges::INFO,
    bin::Fits::INFO,
    raster::Forward::INFO,
    raster::ForwardShared::INFO,
    raster::Backward::INFO,
    raster::BackwardNarrow::INFO,
    raster::Gather::INFO,
    loss::Columns::INFO,
    loss::Ssim::INFO,
    loss::Gradient::INFO,
    loss::Depth::INFO,
    loss::Total::INFO,
    mask::Paint::INFO,
    mask::Compare::INFO,
    mask::Vote::INFO,
    mlp::Encode::INFO,
    mlp::Forward::INFO,
    mlp::Transforms::INFO,
    mlp::Seed::INFO,
    mlp::Backward::INFO,
    mlp::Weights::INFO,
    mlp::Reduce::INFO,
    path::Evaluate::INFO,
    path::Gather::INFO,
    scan::Single::INFO,
    scan::Reduce::INFO,
    scan::Spine::INFO,
    scan::Downsweep::INFO,
    sort::Plan::INFO,
    sort::Count::INFO,
    sort::Scatter::INFO,
    texel::Unorm8::INFO,
    texel::Half::INFO,
];
