//! Measures how long a device works.

use super::stream::KernelTime;

/// What a meter times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detail {
    /// Whole submissions.
    Submissions,
    /// Whole submissions and each dispatch; the extra timestamps cost some device time.
    Dispatches,
}

/// The measurements of a meter.
#[derive(Clone, Debug)]
pub struct Meter {
    pub(super) detail: Detail,
    /// Sum over the submissions of the time from start to end, ns.
    pub nanoseconds: f64,
    /// The time of each dispatch, in order; empty with [`Detail::Submissions`].
    pub kernels: Vec<KernelTime>,
}

impl Meter {
    pub(super) fn new(detail: Detail) -> Meter {
        Meter { detail, nanoseconds: 0.0, kernels: Vec::new() }
    }
}
