//! The training views on the device, and the frame resources for each of their sizes.

use super::settings::TrainSettings;
use super::views::TrainingView;
use crate::gpu::{Buffer, Device, Rehearsal};
use crate::ops::loss::{KnownDisparity, Loss, LossScratch, Reference};
use crate::ops::render::{Frame, FrameGradients, Render};
use crate::types::{Camera, RasterKind, RenderSettings};
use crate::{Error, Result};
use std::collections::BTreeMap;

/// A training view on the device.
pub(super) struct DeviceView {
    pub(super) camera: Camera,
    pub(super) time: f64,
    pub(super) reference: Reference,
    pub(super) disparity: Option<KnownDisparity>,
    pub(super) mask: Option<Buffer<f32>>,
    /// The view takes part in one of this many rounds.
    pub(super) every: u32,
}

impl DeviceView {
    /// Uploads a training view.
    pub(super) fn new(device: &Device, view: &TrainingView) -> Result<DeviceView> {
        let k = view.camera.intrinsics;
        if (k.width, k.height) != (view.image.width, view.image.height) {
            return Err(Error::Shape {
                op: "training view",
                arg: "camera",
                expected: format!("{}×{} pixels", view.image.width, view.image.height),
                actual: (k.width * k.height) as usize,
            });
        }
        let disparity = match &view.disparity {
            None => None,
            Some(known) => {
                if known.pixels.len() != 2 * view.image.pixels.len() / 3 {
                    return Err(Error::Shape {
                        op: "training view",
                        arg: "disparity",
                        expected: format!("{}", 2 * view.image.pixels.len() / 3),
                        actual: known.pixels.len(),
                    });
                }
                Some(KnownDisparity::new(device, bytemuck::cast_slice(&known.pixels))?)
            }
        };
        let mask = match &view.mask {
            None => None,
            Some(mask) if mask.pixels.len() == view.image.pixels.len() / 3 => {
                Some(device.upload("motion mask", &mask.pixels)?)
            }
            Some(mask) => {
                return Err(Error::Shape {
                    op: "training view",
                    arg: "mask",
                    expected: format!("{}", view.image.pixels.len() / 3),
                    actual: mask.pixels.len(),
                });
            }
        };
        Ok(DeviceView {
            camera: view.camera,
            time: view.time,
            reference: Reference::new(device, &view.image, view.weights.as_ref())?,
            disparity,
            mask,
            every: view.every,
        })
    }
}

/// Frame resources: everything that rendering images of one size and comparing them with references
/// needs.
pub(super) struct FrameResources {
    pub(super) frame: Frame<FrameGradients>,
    pub(super) loss: Loss,
    pub(super) loss_scratch: LossScratch,
}

impl FrameResources {
    fn new(
        device: &Device,
        gaussians: usize,
        intersections: usize,
        size: (u32, u32),
        (settings, depth_bits, raster): How,
    ) -> Result<FrameResources> {
        let render = Render::plan(device, gaussians, intersections, size.0, size.1, settings)?
            .with_depth_bits(device, depth_bits)?
            .with_raster(raster);
        let loss = Loss::plan(device, size.0, size.1);
        Ok(FrameResources {
            frame: render.differentiable(device)?,
            loss_scratch: loss.scratch(device)?,
            loss,
        })
    }
}

/// Frame resources by image size.
pub(super) struct FramePool {
    by_size: BTreeMap<(u32, u32), FrameResources>,
    capacity: Capacity,
    how: How,
}

/// The capacity of a trainer's buffers.
#[derive(Clone, Copy)]
pub(super) struct Capacity {
    pub(super) gaussians: usize,
    /// Initial capacity for (splat, tile) pairs of a frame.
    intersections: usize,
}

impl Capacity {
    /// The capacity for a training that begins with `first` Gaussians. The pairs are proportional to the
    /// largest permitted number of Gaussians rather than to the number that growth can reach: which
    /// steps are repeated depends on this capacity.
    pub(super) fn of(settings: &TrainSettings, first: usize) -> Capacity {
        let most = settings.max_gaussians.max(first);
        let intersections = most.saturating_mul(4).max(1 << 14);
        Capacity { gaussians: settings.reachable(first), intersections }
    }

    /// Whether a frame with this many (splat, tile) pairs fits.
    pub(super) fn holds(&self, intersections: usize) -> bool {
        intersections <= self.intersections
    }

    /// The capacity after a frame with this many (splat, tile) pairs.
    pub(super) fn after(self, intersections: usize) -> Capacity {
        match self.holds(intersections) {
            true => self,
            false => Capacity { intersections: grown(intersections), ..self },
        }
    }
}

/// The new capacity after a frame needed `needed` (splat, tile) pairs: half as many again.
fn grown(needed: usize) -> usize {
    needed.saturating_add(needed / 2)
}

/// Settings of projection and blending, number of depth bits for sorting, blending kernel.
type How = (RenderSettings, u32, RasterKind);

impl FramePool {
    pub(super) fn new(capacity: Capacity, settings: &TrainSettings) -> FramePool {
        let how = (settings.render, settings.depth_bits, settings.raster);
        FramePool { by_size: BTreeMap::new(), capacity, how }
    }

    /// The frame resources for an image size, in pixels. They are allocated at the first use, with the
    /// initial capacity for intersections.
    pub(super) fn for_size(
        &mut self,
        device: &Device,
        size: (u32, u32),
    ) -> Result<&mut FrameResources> {
        if !self.by_size.contains_key(&size) {
            self.insert(device, size, self.capacity.intersections)?;
        }
        Ok(self.by_size.get_mut(&size).expect("made above"))
    }

    /// The capacity for intersections of each image size.
    pub(super) fn capacities(&self) -> Vec<((u32, u32), usize)> {
        let capacity = |all: &FrameResources| all.frame.plan().intersection_capacity();
        self.by_size.iter().map(|(&size, resources)| (size, capacity(resources))).collect()
    }

    /// Allocates the frame resources for a size, with this capacity for intersections.
    pub(super) fn reserve(
        &mut self,
        device: &Device,
        size: (u32, u32),
        capacity: usize,
    ) -> Result<()> {
        self.insert(device, size, capacity)
    }

    /// Replaces frame resources by ones with a larger capacity for intersections, if the memory
    /// suffices. The old buffers are freed once the device has finished with them.
    pub(super) fn grow(&mut self, device: &Device, size: (u32, u32), needed: usize) -> Result<()> {
        self.by_size.remove(&size);
        let capacity = grown(needed);
        // Checked beforehand, since systems grant more memory than they have.
        Rehearsal::of(device, |rehearsal| {
            FrameResources::new(
                rehearsal.device(),
                self.capacity.gaussians,
                capacity,
                size,
                self.how,
            )
            .map(drop)
        })?
        .fits(device)?;
        self.insert(device, size, capacity)
    }

    /// In a rehearsal, allocates the additional resources that exist while the frame resources grow from
    /// a smaller capacity: for a moment both the old and the new ones are present.
    pub(super) fn rehearse_growth(&self, device: &Device, first: Capacity) -> Result<()> {
        let sizes = self.by_size.keys();
        let largest = sizes.max_by_key(|(width, height)| u64::from(*width) * u64::from(*height));
        match largest {
            Some(&size) if first.intersections < self.capacity.intersections => {
                let Capacity { gaussians, intersections } = first;
                FrameResources::new(device, gaussians, intersections, size, self.how).map(drop)
            }
            _ => Ok(()),
        }
    }

    fn insert(&mut self, device: &Device, size: (u32, u32), capacity: usize) -> Result<()> {
        let resources =
            FrameResources::new(device, self.capacity.gaussians, capacity, size, self.how)?;
        self.by_size.insert(size, resources);
        Ok(())
    }
}
