//! `splat4d devices`: lists the Vulkan devices.

use std::fmt::Write;

use clap::Args;
use serde_json::json;
use splat4d::Result;
use splat4d::gpu::{Device, Request, Selector};
use splat4d::renderer::RenderScale;
use splat4d::scene::Scene;
use splat4d::train::{PictureKind, TrainSettings, TrainingScale};
use splat4d::types::{Gaussians, Tuning};
use splat4d::vk::{self, DeviceKind};

use super::common::{Answer, bytes, check_room_for_drivers, thousands, vulkan_version};

/// Image size that the largest scenes are predicted for.
const SIZE: (u32, u32) = (1920, 1080);
/// Number of training images that they are predicted for.
const PICTURES: usize = 100;

const AFTER_HELP: &str = "\
The largest scene is what the free memory and the largest binding allow: still, with harmonics of
degree 3, rendered at 1920×1080, or trained on a hundred images of that size, with room for four
tiles per Gaussian. Devices below Vulkan 1.3 come last; --device does not find them.

Example:
  splat4d devices

JSON: devices: [{index, name, kind, driver, vulkan, subgroup_size, memory_bytes, free_bytes,
binding_bytes, most_gaussians {render, train}, missing [what the engine needs and it lacks], unfit (why
it cannot run, or null)}]";

/// List the Vulkan devices, and what fits on each
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct DevicesArgs {}

/// Runs the command.
pub fn run(_: &DevicesArgs) -> Result<Answer> {
    check_room_for_drivers()?;
    let (mut text, mut list) = (String::new(), Vec::new());
    for vk::Candidate { info: device, missing } in vk::candidates()? {
        let kind = match device.kind {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Virtual => "virtual",
            DeviceKind::Software => "software",
            DeviceKind::Other => "other",
        };
        let vulkan = vulkan_version(device.api_version);
        let memory = bytes(device.memory_bytes);
        let _ = writeln!(
            text,
            "{}  {} ({kind}; {}; Vulkan {vulkan}; subgroups of {}; {memory})",
            device.index, device.name, device.driver, device.subgroup_size
        );
        let mut facts = json!({
            "index": device.index,
            "name": device.name,
            "kind": kind,
            "driver": device.driver,
            "vulkan": vulkan,
            "subgroup_size": device.subgroup_size,
            "memory_bytes": device.memory_bytes,
            "missing": missing,
        });
        let request = Request { selector: Selector::Index(device.index), ..Request::default() };
        let opened = match missing.is_empty() {
            true => Device::open(&request).map_err(|error| error.to_string()),
            false => Err(format!("it lacks {}", missing.join(", "))),
        };
        match opened {
            Ok(device) => {
                let (render, train) = most_gaussians(&device);
                let (free, binding) = (device.free_memory(), device.limits().storage_range);
                let _ = writeln!(
                    text,
                    "   {} free, bindings of up to {}: renders {} Gaussians at {}×{}, trains {}",
                    bytes(free),
                    bytes(binding),
                    thousands(render),
                    SIZE.0,
                    SIZE.1,
                    thousands(train)
                );
                facts["free_bytes"] = json!(free);
                facts["binding_bytes"] = json!(binding);
                facts["most_gaussians"] = json!({ "render": render, "train": train });
                facts["unfit"] = json!(null);
            }
            Err(error) => {
                let _ = writeln!(text, "   cannot be used: {error}");
                facts["unfit"] = json!(error);
            }
        }
        list.push(facts);
    }
    Ok(Answer { json: json!({ "devices": list }), text })
}

/// The largest numbers of Gaussians that fit on a device for rendering and for training.
fn most_gaussians(device: &Device) -> (usize, usize) {
    let scene = Scene::of(Gaussians { sh_degree: 3, ..Gaussians::default() });
    let render = RenderScale::new(&scene, SIZE, &Tuning::default());
    let kind = PictureKind { width: SIZE.0, height: SIZE.1, disparity: false, mask: false };
    let train = TrainingScale {
        pictures: [(kind, PICTURES)].into(),
        gaussians: 1,
        intersections: 0,
        motion: None,
        settings: TrainSettings::default(),
    };
    (render.most_gaussians(device), train.most_gaussians(device))
}
