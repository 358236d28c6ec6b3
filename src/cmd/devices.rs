//! `splat4d devices`.

use std::fmt::Write;

use clap::Args;
use serde_json::json;
use splat4d::Result;
use splat4d::vk::{self, DeviceKind};

use super::common::{Answer, bytes};

const AFTER_HELP: &str = "\
Example:
  splat4d devices

JSON: devices: [{index, name, kind, driver, vulkan, subgroup_size, memory_bytes}]";

/// List the Vulkan devices that --device can name
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct DevicesArgs {}

/// Runs the command.
pub fn run(_: &DevicesArgs) -> Result<Answer> {
    let (mut text, mut list) = (String::new(), Vec::new());
    for device in vk::enumerate()? {
        let kind = match device.kind {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Virtual => "virtual",
            DeviceKind::Software => "software",
            DeviceKind::Other => "other",
        };
        // Packed by Vulkan as variant (3 bits), major (7), minor (10), patch (12).
        let version = device.api_version;
        let (major, minor, patch) = (version >> 22 & 0x7f, version >> 12 & 0x3ff, version & 0xfff);
        let vulkan = format!("{major}.{minor}.{patch}");
        let memory = bytes(device.memory_bytes);
        let _ = writeln!(
            text,
            "{}  {} ({kind}; {}; Vulkan {vulkan}; subgroups of {}; {memory})",
            device.index, device.name, device.driver, device.subgroup_size
        );
        list.push(json!({
            "index": device.index,
            "name": device.name,
            "kind": kind,
            "driver": device.driver,
            "vulkan": vulkan,
            "subgroup_size": device.subgroup_size,
            "memory_bytes": device.memory_bytes,
        }));
    }
    Ok(Answer { json: json!({ "devices": list }), text })
}
