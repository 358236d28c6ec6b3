//! The kernels' declarations, one file per family, and the list of all of them.
//!
//! One stem names a kernel everywhere: `glsl/sort/upsweep.comp`, `spirv/sort/upsweep.spv`,
//! [`sort::Upsweep`], `oracle::sort`, `check::sort`, `tests/sort.rs`.

pub mod indirect;
pub mod mlp;
pub mod scan;
pub mod sort;

use crate::gpu::{Kernel, KernelInfo};

/// Every kernel of the crate, family by family.
pub const ALL: &[KernelInfo] = &[
    indirect::Arguments::INFO,
    mlp::Encode::INFO,
    mlp::Forward::INFO,
    mlp::Transforms::INFO,
    mlp::Seed::INFO,
    mlp::Backward::INFO,
    mlp::Weights::INFO,
    mlp::Reduce::INFO,
    scan::Reduce::INFO,
    scan::Spine::INFO,
    scan::Downsweep::INFO,
    sort::Plan::INFO,
    sort::Count::INFO,
    sort::Scatter::INFO,
];
