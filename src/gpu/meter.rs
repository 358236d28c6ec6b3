//! How long a device works.

use super::stream::KernelTime;

/// What a meter takes the time of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detail {
    /// Whole submissions.
    Submissions,
    /// Each dispatch besides, which costs some time of its own.
    Dispatches,
}

/// What a meter has seen.
#[derive(Clone, Debug)]
pub struct Meter {
    pub(super) detail: Detail,
    /// From the begin to the end of each submission, added up.
    pub nanoseconds: f64,
    /// Dispatch by dispatch, in order; empty where only submissions were asked for.
    pub kernels: Vec<KernelTime>,
}

impl Meter {
    pub(super) fn new(detail: Detail) -> Meter {
        Meter { detail, nanoseconds: 0.0, kernels: Vec::new() }
    }
}
