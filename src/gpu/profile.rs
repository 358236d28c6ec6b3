//! The choice among the variants of kernels.

use crate::vk::DeviceKind;

/// The variants of kernels that suit a kind of device, and the sizes in which it takes work. Every
/// profile gives right results on every device; it decides what is fast. Ops take it from the device
/// when they are planned. The sizes were measured.
///
/// The subgroup size is no part of it: it is the device's, whatever the profile
/// ([`Device::subgroup_size`](super::Device::subgroup_size)).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Profile {
    name: &'static str,
    /// Number of invocations that occupy the device.
    pub(crate) occupancy: usize,
    /// Largest number of values that a single workgroup scans faster than four dispatches do.
    pub(crate) single_scan: usize,
    /// Length of the shortest run of keys that an invocation sorts. Shorter ones would spend more time
    /// on counters than on keys.
    pub(crate) least_run: usize,
    /// Largest number of such runs. More would not occupy the device better.
    pub(crate) most_runs: usize,
    /// Whether an invocation that sorts has its counters in a private array instead of shared memory.
    pub(crate) own_counters: bool,
    /// Whether lanes that blend exchange values by shuffles instead of broadcasts and ballots.
    pub(crate) shuffles: bool,
    /// Whether workgroups are interleaved so that costly ones are distributed over all cores.
    pub(crate) spread: bool,
    /// Whether 8 invocations instead of 32 compute the gradients of a tile.
    pub(crate) narrow_tiles: bool,
    /// Whether the invocations of a subgroup share loads of values that all of them need.
    pub(crate) shared_loads: bool,
}

impl Profile {
    /// For GPUs.
    pub const GPU: Profile = Profile {
        name: "gpu",
        occupancy: 1 << 16,
        single_scan: 8192,
        least_run: 256,
        most_runs: 16_384,
        own_counters: false,
        shuffles: false,
        spread: false,
        narrow_tiles: false,
        shared_loads: false,
    };

    /// For software drivers. There a dispatch costs as much as scanning thousands of values. The lanes
    /// of a subgroup that sort write to neighbouring places; the shorter their runs, the more of these
    /// places share a cache line. More runs than these make a table of counters that costs more than
    /// that gains.
    pub const SOFTWARE: Profile = Profile {
        name: "software",
        occupancy: 1 << 10,
        single_scan: 131_072,
        least_run: 1024,
        most_runs: 512,
        own_counters: true,
        shuffles: true,
        spread: true,
        narrow_tiles: true,
        shared_loads: true,
    };

    /// Every profile. The check cases run under each.
    pub const ALL: [Profile; 2] = [Profile::GPU, Profile::SOFTWARE];

    /// The profile of a kind of device.
    pub fn of(kind: DeviceKind) -> Profile {
        match kind {
            DeviceKind::Software => Profile::SOFTWARE,
            DeviceKind::Discrete
            | DeviceKind::Integrated
            | DeviceKind::Virtual
            | DeviceKind::Other => Profile::GPU,
        }
    }

    /// `gpu` or `software`.
    pub fn name(&self) -> &'static str {
        self.name
    }
}
