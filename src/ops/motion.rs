//! Control points, the deformation network and skinning together: where a scene's Gaussians are at
//! a time.

use super::deform::{Skin, SkinArgs, Skinned};
use super::gaussians::GaussianViews;
use super::mlp::{Network, NetworkScratch};
use crate::gpu::{Buffer, Device, Recorder, Stream, View};
use crate::types::{ControlPoints, DeformNet};
use crate::{Error, Result};

/// What moves a scene's dynamic Gaussians, on the device.
pub struct Motion {
    /// The network's plan.
    pub network: Network,
    /// Its parameters, laid out as [`DeformNet::parameters`].
    pub parameters: Buffer<f32>,
    /// Canonical positions of the control points, three values each.
    pub nodes: Buffer<f32>,
    /// Logarithms of their radii.
    pub log_radii: Buffer<f32>,
    /// Motions at the last time, two vectors per control point.
    pub transforms: Buffer<[f32; 4]>,
    /// Skinning.
    pub skin: Skin,
    /// The Gaussians that move.
    pub dynamic_ids: Buffer<u32>,
    /// The network's activations at the last time.
    pub network_scratch: NetworkScratch,
    times: Buffer<f32>,
    positions: Buffer<f32>,
    rotations: Buffer<[f32; 4]>,
    rigidity: Buffer<f32>,
}

impl Motion {
    /// Control points and network on the device, for `gaussians` Gaussians of which `dynamic_ids`
    /// move, each following `neighbours` control points.
    ///
    /// # Errors
    /// [`Error::Input`] without control points or for a network that does not fit its shape;
    /// [`Error::OutOfMemory`]; or a failed upload.
    pub fn new(
        stream: &mut Stream,
        points: &ControlPoints,
        network: &DeformNet,
        neighbours: usize,
        gaussians: usize,
        dynamic_ids: &[u32],
    ) -> Result<Motion> {
        if points.is_empty() {
            return Err(Error::Input("motion needs at least one control point".into()));
        }
        if network.parameters.len() != network.shape.parameters() {
            return Err(Error::Input(format!(
                "the deformation network has {} parameters, its shape asks for {}",
                network.parameters.len(),
                network.shape.parameters()
            )));
        }
        let device: Device = stream.device().clone();
        let plan = Network::new(&network.shape)?;
        Ok(Motion {
            parameters: device.upload("network parameters", &network.parameters)?,
            nodes: device.upload("control points", points.positions.as_flattened())?,
            log_radii: device.upload("control radii", &points.log_radii)?,
            transforms: device.buffer("control transforms", 2 * points.len())?,
            skin: Skin::new(&device, neighbours, dynamic_ids.len(), points.len())?,
            dynamic_ids: device.upload("dynamic Gaussians", dynamic_ids)?,
            network_scratch: plan.scratch(&device, points.len())?,
            times: device.buffer("time", 1)?,
            positions: device.buffer("moved positions", 3 * gaussians)?,
            rotations: device.buffer("moved rotations", gaussians)?,
            rigidity: device.buffer("rigidity", dynamic_ids.len())?,
            network: plan,
        })
    }

    /// Records the search for the control points that each dynamic Gaussian follows; needed once,
    /// and again when Gaussians or control points have moved in the canonical frame.
    ///
    /// # Errors
    /// As for [`Recorder::dispatch`].
    pub fn refresh(&mut self, recorder: &mut Recorder, positions: View<'_, f32>) -> Result<()> {
        self.skin.refresh(recorder, self.dynamic_ids.view(), positions, self.nodes.view())
    }

    /// Records where the Gaussians are at a time in [0, 1]; [`moved`](Self::moved) gives them.
    ///
    /// # Errors
    /// [`Error::Shape`] for another number of Gaussians than planned; else as for
    /// [`Recorder::dispatch`].
    pub fn forward(
        &mut self,
        recorder: &mut Recorder,
        gaussians: &GaussianViews<'_>,
        time: f64,
    ) -> Result<()> {
        recorder.update(self.times.view_mut(), &[time as f32])?;
        self.network.forward(
            recorder,
            self.parameters.view(),
            self.nodes.view(),
            self.times.view(),
            self.transforms.view_mut(),
            &mut self.network_scratch,
        )?;
        self.skin.forward(
            recorder,
            SkinArgs {
                dynamic_ids: self.dynamic_ids.view(),
                positions: gaussians.positions,
                rotations: gaussians.rotations,
                nodes: self.nodes.view(),
                log_radii: self.log_radii.view(),
                transforms: self.transforms.view(),
                time: 0,
                soft: None,
            },
            Skinned {
                positions: self.positions.view_mut(),
                rotations: self.rotations.view_mut(),
                rigidity: self.rigidity.view_mut(),
            },
        )
    }

    /// The Gaussians where the last [`forward`](Self::forward) put them.
    pub fn moved<'a>(&'a self, gaussians: GaussianViews<'a>) -> GaussianViews<'a> {
        gaussians.moved(self.positions.view(), self.rotations.view())
    }
}
