//! How much memory the machine has left, asked before much of it is taken.
//!
//! A system that promises more memory than it has ends a program that takes it without an error.
//! So large sizes are checked first.

use std::fs;
use std::path::Path;

use crate::{Error, Result};

/// Bytes of memory that this process can still take: the least of what the machine has, what the
/// control groups it runs in allow, and what its own limits (`ulimit -v`, `ulimit -d`) leave. `None`
/// where the system does not tell.
pub fn available_memory() -> Option<u64> {
    let machine = text("/proc/meminfo").and_then(|text| machine(&text));
    let limits = address_space();
    let groups = text("/proc/self/cgroup").and_then(|text| grouped(&text));
    [machine, limits, groups].into_iter().flatten().min()
}

/// That `bytes` of memory can be had for `what`, which begins the message: `reading a.mp4 needs …`.
/// Where the system does not tell what it has, everything can.
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

/// Bytes that this process's own limits (`ulimit -v`, `ulimit -d`) leave; `None` where it has none.
fn address_space() -> Option<u64> {
    let (limits, status) = text("/proc/self/limits").zip(text("/proc/self/status"))?;
    limited(&limits, &status)
}

/// That this process's own limits leave `bytes` for `what`, which begins the message. Unlike
/// [`check_memory`] this also suits what is reserved and mostly never used, such as the stacks of
/// threads.
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

/// Bytes in words, for messages.
pub(crate) fn gibibytes(bytes: u64) -> String {
    const MEBI: f64 = (1 << 20) as f64;
    let mebi = bytes as f64 / MEBI;
    if mebi < 10_240.0 { format!("{mebi:.1} MiB") } else { format!("{:.1} GiB", mebi / 1024.0) }
}

fn text(path: impl AsRef<Path>) -> Option<String> {
    fs::read_to_string(path).ok()
}

/// The number after `key` in lines of `key number …`.
fn field(text: &str, key: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    line.split_ascii_whitespace().next()?.parse().ok()
}

/// What `/proc/meminfo` leaves. Free swap counts: only beyond it does memory run out.
fn machine(meminfo: &str) -> Option<u64> {
    let available = field(meminfo, "MemAvailable:")?;
    let swap = field(meminfo, "SwapFree:").unwrap_or(0);
    Some(available.saturating_add(swap).saturating_mul(1024))
}

/// What `/proc/self/limits` leaves to a process of `/proc/self/status`.
fn limited(limits: &str, status: &str) -> Option<u64> {
    let left = |limit: &str, used: &str| {
        // "unlimited" is no number.
        let limit = field(limits, limit)?;
        Some(limit.saturating_sub(field(status, used)?.saturating_mul(1024)))
    };
    let left = [left("Max address space", "VmSize:"), left("Max data size", "VmData:")];
    left.into_iter().flatten().min()
}

/// What the groups of `/proc/self/cgroup` leave, those of version 1 and 2.
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
        // Every group above has a limit of its own. Inside a container the path may be one that
        // only the host sees; its own group then is the root.
        let inner = root.join(path.trim_start_matches('/'));
        inner
            .ancestors()
            .take_while(|at| at.starts_with(root))
            .filter_map(|at| names.left(at))
            .min()
    };
    groups.lines().filter_map(of_line).min()
}

/// What a version of control groups calls its files and fields.
struct Names {
    limit: &'static str,
    used: &'static str,
    cache: [&'static str; 2],
}

impl Names {
    /// What one group leaves; `None` where it sets no limit.
    fn left(&self, group: &Path) -> Option<u64> {
        let number = |name: &str| text(group.join(name))?.trim().parse::<u64>().ok();
        let (limit, used) = (number(self.limit)?, number(self.used)?);
        // Cached files count as used, and are given up when memory is wanted.
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
