//! Checks of the available host memory before large allocations.
//!
//! A system that overcommits memory kills a program that uses too much, without an error. Large
//! sizes are therefore checked first.

use std::fs;
use std::path::Path;

use crate::{Error, Result};

/// Bytes of memory that this process can still allocate: the minimum of the machine's available
/// memory, the remainder of its control groups' limits, and the remainder of its own limits
/// (`ulimit -v`, `ulimit -d`). `None` if the system does not report it.
pub fn available_memory() -> Option<u64> {
    let machine = text("/proc/meminfo").and_then(|text| machine(&text));
    let limits = address_space();
    let groups = text("/proc/self/cgroup").and_then(|text| grouped(&text));
    [machine, limits, groups].into_iter().flatten().min()
}

/// Checks that `bytes` of memory are available for `what`, which begins the message: `reading a.mp4
/// needs …`. The check passes if the system does not report its memory.
///
/// # Errors
/// [`Error::Input`] with both numbers.
pub fn check_memory(bytes: u64, what: &str) -> Result<()> {
    match available_memory() {
        Some(available) if bytes > available => Err(Error::Input(format!(
            "{what} needs {} of memory, {} are available; make it smaller or free memory",
            gibibytes(bytes),
            gibibytes(available)
        ))),
        _ => Ok(()),
    }
}

/// Bytes left under this process's own limits (`ulimit -v`, `ulimit -d`); `None` without limits.
fn address_space() -> Option<u64> {
    let (limits, status) = text("/proc/self/limits").zip(text("/proc/self/status"))?;
    limited(&limits, &status)
}

/// Checks that this process's own limits leave `bytes` for `what`, which begins the message. Unlike
/// [`check_memory`] it also suits memory that is reserved and mostly unused, such as thread stacks.
///
/// # Errors
/// [`Error::Input`] with both numbers.
pub fn check_limits(bytes: u64, what: &str) -> Result<()> {
    match address_space() {
        Some(left) if bytes > left => Err(Error::Input(format!(
            "{what} needs {} of address space, this process's limits leave {}; raise them \
             (ulimit -v, ulimit -d)",
            gibibytes(bytes),
            gibibytes(left)
        ))),
        _ => Ok(()),
    }
}

/// A number of bytes as text, for messages.
pub(crate) fn gibibytes(bytes: u64) -> String {
    const MEBI: f64 = (1 << 20) as f64;
    let mebi = bytes as f64 / MEBI;
    if mebi < 10_240.0 { format!("{mebi:.1} MiB") } else { format!("{:.1} GiB", mebi / 1024.0) }
}

fn text(path: impl AsRef<Path>) -> Option<String> {
    fs::read_to_string(path).ok()
}

/// The number after `key` in a text of lines `key number …`.
fn field(text: &str, key: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    line.split_ascii_whitespace().next()?.parse().ok()
}

/// Available bytes by `/proc/meminfo`, free swap included.
fn machine(meminfo: &str) -> Option<u64> {
    let available = field(meminfo, "MemAvailable:")?;
    let swap = field(meminfo, "SwapFree:").unwrap_or(0);
    Some(available.saturating_add(swap).saturating_mul(1024))
}

/// Bytes left under the limits of `/proc/self/limits`, given the usage in `/proc/self/status`.
fn limited(limits: &str, status: &str) -> Option<u64> {
    let left = |limit: &str, used: &str| {
        // "unlimited" does not parse as a number.
        let limit = field(limits, limit)?;
        Some(limit.saturating_sub(field(status, used)?.saturating_mul(1024)))
    };
    let left = [left("Max address space", "VmSize:"), left("Max data size", "VmData:")];
    left.into_iter().flatten().min()
}

/// Bytes left in the control groups of `/proc/self/cgroup`, of version 1 and 2.
fn grouped(groups: &str) -> Option<u64> {
    let of_line = |line: &str| {
        let mut parts = line.splitn(3, ':').skip(1);
        let (controllers, path) = (parts.next()?, parts.next()?);
        let names = if controllers.is_empty() {
            Names {
                limit: "memory.max",
                used: "memory.current",
                cache: ["inactive_file ", "active_file "],
            }
        } else if controllers.split(',').any(|name| name == "memory") {
            Names {
                limit: "memory.limit_in_bytes",
                used: "memory.usage_in_bytes",
                cache: ["total_inactive_file ", "total_active_file "],
            }
        } else {
            return None;
        };
        let root = Path::new(if controllers.is_empty() {
            "/sys/fs/cgroup"
        } else {
            "/sys/fs/cgroup/memory"
        });
        // Every parent group has its own limit. Inside a container the path may be visible to the
        // host only; the container's group is the root then.
        let inner = root.join(path.trim_start_matches('/'));
        inner
            .ancestors()
            .take_while(|at| at.starts_with(root))
            .filter_map(|at| names.left(at))
            .min()
    };
    groups.lines().filter_map(of_line).min()
}

/// The file and field names of one version of control groups.
struct Names {
    limit: &'static str,
    used: &'static str,
    cache: [&'static str; 2],
}

impl Names {
    /// Bytes left in one group; `None` if it sets no limit.
    fn left(&self, group: &Path) -> Option<u64> {
        let number = |name: &str| text(group.join(name))?.trim().parse::<u64>().ok();
        let (limit, used) = (number(self.limit)?, number(self.used)?);
        // The page cache counts as used, but the kernel reclaims it on demand.
        let stat = text(group.join("memory.stat")).unwrap_or_default();
        let cache: u64 = self.cache.iter().filter_map(|key| field(&stat, key)).sum();
        Some(limit.saturating_sub(used.saturating_sub(cache)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_system_says() {
        let meminfo = "MemTotal: 24 kB\nMemFree: 7 kB\nMemAvailable:   22 kB\nSwapFree: 3 kB\n";
        assert_eq!(machine(meminfo), Some(25 * 1024));
        assert_eq!(machine("MemTotal: 24 kB\n"), None);
        let limits = |space: &str, data: &str| {
            format!(
                "Limit                     Soft Limit           Hard Limit           Units     \n\
                 Max data size             {data}            unlimited            bytes     \n\
                 Max address space         {space}            unlimited            bytes     \n"
            )
        };
        let status = "Name:\tsplat4d\nVmSize:\t      10 kB\nVmData:\t       4 kB\n";
        assert_eq!(limited(&limits("unlimited", "unlimited"), status), None);
        assert_eq!(limited(&limits("20480", "unlimited"), status), Some(10240));
        assert_eq!(limited(&limits("20480", "5120"), status), Some(1024));
        assert_eq!(limited(&limits("1", "unlimited"), status), Some(0));
        assert_eq!(grouped("1:cpu:/\n"), None);
    }

    #[test]
    fn what_a_control_group_leaves() {
        let group = tempfile::tempdir().unwrap();
        let names = Names { limit: "memory.max", used: "memory.current", cache: ["in ", "out "] };
        let put = |name: &str, text: &str| fs::write(group.path().join(name), text).unwrap();
        put("memory.current", "1000\n");
        put("memory.max", "max\n");
        assert_eq!(names.left(group.path()), None);
        put("memory.max", "1500\n");
        assert_eq!(names.left(group.path()), Some(500));
        put("memory.stat", "in 300\nout 200\nother 9\n");
        assert_eq!(names.left(group.path()), Some(1000));
    }

    #[test]
    fn too_much_is_an_error_with_both_numbers() {
        let Some(available) = available_memory() else { return };
        assert!(available > 0);
        assert!(check_memory(1, "a byte").is_ok());
        let message = check_memory(u64::MAX, "reading a.mp4").unwrap_err().to_string();
        assert!(
            message.starts_with("reading a.mp4 needs 17179869184.0 GiB of memory, "),
            "{message}"
        );
        assert!(message.contains("are available"), "{message}");
    }
}
