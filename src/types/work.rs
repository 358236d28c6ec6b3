//! The work of an op.

#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// Data volume and arithmetic of one execution, counted from the actual data: every input and every output
/// of a dispatch once; an addition, a multiplication or a transcendental is one operation. In integer work
/// such as a sort, an operation is one step on one key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Work {
    /// Bytes read and written.
    pub bytes: u64,
    /// Operations.
    pub operations: u64,
}
