//! The pictures on the device, and a renderer for each of their sizes.

use crate::Result;
use crate::gpu::Device;
use crate::ops::loss::{KnownDisparity, Loss, LossScratch, Photograph};
use crate::ops::render::{BackwardScratch, PixelBuffers, PixelGradients, Render, RenderScratch};
use crate::types::{Camera, RenderSettings};
use std::collections::BTreeMap;

/// A picture to train on, on the device.
pub(super) struct DeviceView {
    pub(super) camera: Camera,
    pub(super) time: f64,
    pub(super) photograph: Photograph,
    pub(super) disparity: Option<KnownDisparity>,
}

/// Everything that rendering and comparing pictures of one size needs.
pub(super) struct Studio {
    pub(super) render: Render,
    pub(super) scratch: RenderScratch,
    pub(super) backward: BackwardScratch,
    pub(super) pixels: PixelBuffers,
    pub(super) pixel_gradients: PixelGradients,
    pub(super) loss: Loss,
    pub(super) loss_scratch: LossScratch,
}

impl Studio {
    fn new(
        device: &Device,
        gaussians: usize,
        intersections: usize,
        size: (u32, u32),
        settings: RenderSettings,
    ) -> Result<Studio> {
        let render = Render::plan(device, gaussians, intersections, size.0, size.1, settings)?;
        let loss = Loss::plan(size.0, size.1);
        Ok(Studio {
            scratch: render.scratch(device)?,
            backward: render.backward_scratch(device)?,
            pixels: render.pixels(device)?,
            pixel_gradients: render.pixel_gradients(device)?,
            loss_scratch: loss.scratch(device)?,
            loss,
            render,
        })
    }
}

/// The studios by size of picture.
pub(super) struct Studios {
    by_size: BTreeMap<(u32, u32), Studio>,
    gaussians: usize,
    settings: RenderSettings,
}

impl Studios {
    pub(super) fn new(gaussians: usize, settings: RenderSettings) -> Studios {
        Studios { by_size: BTreeMap::new(), gaussians, settings }
    }

    /// The studio for a size; made at first use, with room for a few intersections per Gaussian.
    pub(super) fn for_size(&mut self, device: &Device, size: (u32, u32)) -> Result<&mut Studio> {
        if !self.by_size.contains_key(&size) {
            let room = (self.gaussians * 4).max(1 << 14);
            self.insert(device, size, room)?;
        }
        Ok(self.by_size.get_mut(&size).expect("made above"))
    }

    /// Room for intersections by size of picture.
    pub(super) fn rooms(&self) -> Vec<((u32, u32), usize)> {
        let room = |studio: &Studio| studio.render.intersection_capacity();
        self.by_size.iter().map(|(&size, studio)| (size, room(studio))).collect()
    }

    /// Makes the studio for a size, with this much room for intersections.
    pub(super) fn reserve(&mut self, device: &Device, size: (u32, u32), room: usize) -> Result<()> {
        self.insert(device, size, room)
    }

    /// Makes a studio anew with more room for intersections. What the old one holds lives on until
    /// the device is done with it.
    pub(super) fn grow(&mut self, device: &Device, size: (u32, u32), needed: usize) -> Result<()> {
        self.by_size.remove(&size);
        self.insert(device, size, needed + needed / 2)
    }

    fn insert(&mut self, device: &Device, size: (u32, u32), room: usize) -> Result<()> {
        let studio = Studio::new(device, self.gaussians, room, size, self.settings)?;
        self.by_size.insert(size, studio);
        Ok(())
    }
}
