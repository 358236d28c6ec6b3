//! The motion model on the device: control points, the paths or network that move them, and skinning.

use super::deform::{Skin, SkinArgs, SkinGradients, Skinned, SoftMotion};
use super::gaussians::{GaussianBuffers, GaussianViews};
use super::mlp::{Network, NetworkScratch};
use super::path;
use crate::gpu::{Buffer, Device, Recorder, Stream, View, ViewMut};
use crate::types::{ControlPoints, DeformNet, Gaussians};
use crate::{Error, Result};

/// Inputs and outputs of the backward pass of soft motion.
pub struct SoftGradients<'a> {
    /// The same as in the forward pass.
    pub soft: SoftMotion<'a>,
    /// Gradient with respect to the motion logits of all Gaussians; accumulated.
    pub logits: ViewMut<'a, f32>,
    /// Weight of the summed rigidity terms in the loss.
    pub rigid_scale: f32,
}

/// The model that moves the control points.
pub enum Model {
    /// Paths: motions at evenly spaced key times, interpolated.
    Paths,
    /// A deformation network: its plan, and its activations of the last forward pass.
    Network(Network, NetworkScratch),
}

/// The motion model of a scene's dynamic Gaussians, on the device.
pub struct Motion {
    /// The model that moves the control points.
    pub model: Model,
    /// The model's parameters: the paths, laid out as [`ControlPoints::paths`], or the network's, laid
    /// out as [`DeformNet::parameters`].
    pub parameters: Buffer<f32>,
    /// Canonical positions of the control points, three values each.
    pub nodes: Buffer<f32>,
    /// Logarithms of their radii.
    pub log_radii: Buffer<f32>,
    /// Motions at the times of the last forward pass, two vectors per control point and time.
    pub transforms: Buffer<[f32; 4]>,
    /// Skinning.
    pub skin: Skin,
    /// Indices of the dynamic Gaussians.
    pub gaussian_from_dynamic: Buffer<u32>,
    /// Number of entries of `gaussian_from_dynamic` in use.
    pub dynamic: usize,
    times: Buffer<f32>,
    positions: Buffer<f32>,
    rotations: Buffer<[f32; 4]>,
    opacity_logits: Buffer<f32>,
    rigidity: Buffer<f32>,
}

impl Motion {
    /// Uploads control points and the model that moves them. Buffers hold up to `gaussians` Gaussians,
    /// of which each dynamic one follows `neighbours` control points; the model is evaluated at `times`
    /// times at once. [`set_dynamic`](Self::set_dynamic) selects the dynamic Gaussians.
    ///
    /// # Errors
    /// [`Error::Input`] without control points, with both paths and a network or with neither, for paths
    /// whose length does not match the control points, or for network parameters that do not match the
    /// network's shape; [`Error::OutOfMemory`]; or a failed upload.
    pub fn new(
        stream: &mut Stream,
        points: &ControlPoints,
        network: Option<&DeformNet>,
        neighbours: usize,
        gaussians: usize,
        times: usize,
    ) -> Result<Motion> {
        if points.is_empty() {
            return Err(Error::Input("motion needs at least one control point".into()));
        }
        let device: Device = stream.device().clone();
        let rows = points.len() * times;
        let (model, parameters) = match network {
            Some(network) if points.paths.is_empty() => {
                let expected = network.shape.parameters();
                if network.parameters.len() != expected {
                    return Err(Error::Input(format!(
                        "the deformation network has {} parameters, its shape asks for {expected}",
                        network.parameters.len(),
                    )));
                }
                let plan = Network::plan(&device, &network.shape)?;
                let scratch = plan.scratch(&device, rows)?;
                let parameters = device.upload("network parameters", &network.parameters)?;
                (Model::Network(plan, scratch), parameters)
            }
            None if !points.paths.is_empty() => {
                points.check_paths().map_err(Error::Input)?;
                (Model::Paths, device.upload("control paths", points.paths.as_flattened())?)
            }
            _ => {
                return Err(Error::Input(
                    "control points are moved by their paths or by a network: give one of them"
                        .into(),
                ));
            }
        };
        Ok(Motion {
            model,
            parameters,
            nodes: device.upload("control points", points.positions.as_flattened())?,
            log_radii: device.upload("control radii", &points.log_radii)?,
            transforms: device.buffer("control transforms", 2 * rows)?,
            skin: Skin::new(&device, neighbours, gaussians, points.len())?,
            gaussian_from_dynamic: device.buffer("dynamic Gaussians", gaussians)?,
            dynamic: 0,
            times: device.buffer("times", times)?,
            positions: device.buffer("moved positions", 3 * gaussians)?,
            rotations: device.buffer("moved rotations", gaussians)?,
            opacity_logits: device.buffer("moved opacities", gaussians)?,
            rigidity: device.buffer("rigidity", gaussians)?,
        })
    }

    /// Grows the capacity to at least `gaussians` Gaussians. Call [`set_dynamic`](Self::set_dynamic) and
    /// [`refresh`](Self::refresh) afterwards.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn reserve(&mut self, device: &Device, gaussians: usize) -> Result<()> {
        if gaussians <= self.rotations.len() {
            return Ok(());
        }
        let (k, nodes) = (self.skin.neighbours().k(), self.log_radii.len());
        self.skin = Skin::new(device, k, gaussians, nodes)?;
        self.gaussian_from_dynamic = device.buffer("dynamic Gaussians", gaussians)?;
        self.dynamic = 0;
        self.positions = device.buffer("moved positions", 3 * gaussians)?;
        self.rotations = device.buffer("moved rotations", gaussians)?;
        self.opacity_logits = device.buffer("moved opacities", gaussians)?;
        self.rigidity = device.buffer("rigidity", gaussians)?;
        Ok(())
    }

    /// Selects the dynamic Gaussians: those whose motion logit is above `least`, which is 0 unless
    /// motion is soft.
    ///
    /// # Errors
    /// [`Error::Shape`] where the Gaussians exceed the capacity, or a failed upload.
    pub fn set_dynamic(
        &mut self,
        stream: &mut Stream,
        motion_logits: &[f32],
        least: f32,
    ) -> Result<()> {
        let ids: Vec<u32> =
            (0..).zip(motion_logits).filter(|(_, m)| **m > least).map(|(i, _)| i).collect();
        stream.upload(&mut self.gaussian_from_dynamic, &ids)?;
        self.dynamic = ids.len();
        Ok(())
    }

    /// Records the search for the control points that each dynamic Gaussian follows; needed once,
    /// and again when Gaussians or control points have moved in the canonical frame. The dispatches
    /// of [`Skin::refresh`](super::deform::Skin::refresh).
    ///
    /// # Errors
    /// As for [`Recorder::dispatch`].
    pub fn refresh(&mut self, recorder: &mut Recorder, positions: View<'_, f32>) -> Result<()> {
        let ids = self.gaussian_from_dynamic.range(0..self.dynamic);
        self.skin.refresh(recorder, ids, positions, self.nodes.view())
    }

    /// Records the Gaussians' positions, rotations and opacities at the first of some times in [0, 1]
    /// ([`moved`](Self::moved) gives them), and the control points' motions at all of these times.
    /// Without `soft`, every listed Gaussian moves fully. The dispatches are those of [`path::evaluate`]
    /// or of the network's forward pass, then those of [`Skin::forward`](super::deform::Skin::forward).
    ///
    /// # Errors
    /// [`Error::Shape`] for another number of times than planned; else as for
    /// [`Recorder::dispatch`].
    pub fn forward(
        &mut self,
        recorder: &mut Recorder,
        gaussians: &GaussianViews<'_>,
        times: &[f32],
        soft: Option<SoftMotion<'_>>,
    ) -> Result<()> {
        recorder.update(self.times.view_mut(), times)?;
        let (parameters, times) = (self.parameters.view(), self.times.view());
        let transforms = self.transforms.view_mut();
        match &mut self.model {
            Model::Paths => {
                path::evaluate(recorder, self.log_radii.len(), parameters, times, transforms)?;
            }
            Model::Network(plan, scratch) => {
                let nodes = self.nodes.view();
                plan.forward(recorder, parameters, nodes, times, transforms, scratch)?;
            }
        }
        let n = gaussians.len;
        self.skin.forward(
            recorder,
            skin_args(
                &self.gaussian_from_dynamic,
                self.dynamic,
                &self.nodes,
                &self.log_radii,
                &self.transforms,
                gaussians,
                soft,
            ),
            Skinned {
                positions: self.positions.range_mut(0..3 * n),
                rotations: self.rotations.range_mut(0..n),
                opacity_logits: self.opacity_logits.range_mut(0..n),
                rigidity: self.rigidity.range_mut(0..self.dynamic),
            },
        )
    }

    /// Records the backward pass of the last [`forward`](Self::forward)'s skinning. On input,
    /// `gradients` holds the gradients with respect to the moved Gaussians; on output, those with
    /// respect to the canonical ones. The gradients with respect to the motions at the first time and to
    /// the radii are overwritten. `soft` must agree with the forward pass.
    ///
    /// # Errors
    /// As for [`Skin::backward`].
    pub fn skin_backward(
        &mut self,
        recorder: &mut Recorder,
        gaussians: &GaussianViews<'_>,
        gradients: &mut GaussianBuffers,
        transform_gradients: ViewMut<'_, [f32; 4]>,
        radius_gradients: ViewMut<'_, f32>,
        soft: Option<SoftGradients<'_>>,
    ) -> Result<()> {
        let n = gaussians.len;
        let args = skin_args(
            &self.gaussian_from_dynamic,
            self.dynamic,
            &self.nodes,
            &self.log_radii,
            &self.transforms,
            gaussians,
            soft.as_ref().map(|soft| soft.soft),
        );
        // Without soft motion, the kernel does not touch the motion gradients.
        let (motion_logits, rigid_scale) = match soft {
            Some(soft) => (soft.logits, soft.rigid_scale),
            None => (self.rigidity.view_mut(), 0.0),
        };
        let gradients = SkinGradients {
            positions: gradients.positions.range_mut(0..3 * n),
            rotations: gradients.rotations.range_mut(0..n),
            motion_logits,
            transforms: transform_gradients,
            log_radii: radius_gradients,
            accumulate: false,
            rigid_scale,
        };
        self.skin.backward(recorder, args, gradients)
    }

    /// Records the gradient with respect to the model's parameters, from the gradient with respect to
    /// the control points' motions at all times of the last [`forward`](Self::forward).
    ///
    /// # Errors
    /// As for [`path::gather`] and [`Network::backward`].
    pub fn model_backward(
        &mut self,
        recorder: &mut Recorder,
        transform_gradients: View<'_, [f32; 4]>,
        gradients: ViewMut<'_, f32>,
    ) -> Result<()> {
        match &mut self.model {
            Model::Paths => {
                let (nodes, times) = (self.log_radii.len(), self.times.view());
                path::gather(recorder, nodes, times, transform_gradients, gradients)
            }
            Model::Network(plan, scratch) => {
                let parameters = self.parameters.view();
                plan.backward(recorder, parameters, transform_gradients, gradients, false, scratch)
            }
        }
    }

    /// Replaces positions, rotations and opacities of downloaded Gaussians by those of the last
    /// [`forward`](Self::forward).
    ///
    /// # Errors
    /// A failed submission.
    pub(crate) fn download_moved(&self, stream: &mut Stream, into: &mut Gaussians) -> Result<()> {
        let n = into.len();
        let positions = stream.download(&self.positions)?;
        into.positions.copy_from_slice(&bytemuck::cast_slice(&positions)[..n]);
        into.rotations.copy_from_slice(&stream.download(&self.rotations)?[..n]);
        into.opacity_logits.copy_from_slice(&stream.download(&self.opacity_logits)?[..n]);
        Ok(())
    }

    /// The Gaussians as the last [`forward`](Self::forward) moved them.
    pub fn moved<'a>(&'a self, gaussians: GaussianViews<'a>) -> GaussianViews<'a> {
        let n = gaussians.len;
        gaussians.moved(
            self.positions.range(0..3 * n),
            self.rotations.range(0..n),
            self.opacity_logits.range(0..n),
        )
    }
}

fn skin_args<'a>(
    gaussian_from_dynamic: &'a Buffer<u32>,
    dynamic: usize,
    nodes: &'a Buffer<f32>,
    log_radii: &'a Buffer<f32>,
    transforms: &'a Buffer<[f32; 4]>,
    gaussians: &GaussianViews<'a>,
    soft: Option<SoftMotion<'a>>,
) -> SkinArgs<'a> {
    SkinArgs {
        gaussian_from_dynamic: gaussian_from_dynamic.range(0..dynamic),
        positions: gaussians.positions,
        rotations: gaussians.rotations,
        opacity_logits: gaussians.opacity_logits,
        nodes: nodes.view(),
        log_radii: log_radii.view(),
        transforms: transforms.view(),
        time: 0,
        soft,
    }
}
