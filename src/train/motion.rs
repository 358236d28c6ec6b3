//! Training of the motion model: the control points' paths or the deformation network, and the radii.

use super::control::{Followers, revise};
use super::settings::{ControlSettings, MotionSettings, exponential};
use crate::Result;
use crate::gpu::{Buffer, Recorder, Stream, View};
use crate::ops::adam::{Adam, AdamArgs};
use crate::ops::arap::{Arap, ArapArgs, ArapSettings};
use crate::ops::deform::SoftMotion;
use crate::ops::gaussians::{GaussianBuffers, GaussianViews};
use crate::ops::motion::{Model, Motion, SoftGradients};
use crate::ops::path;
use crate::types::{AdamSettings, ControlPoints, DeformNet};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// The initial motion model of a training.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct MotionStart {
    /// Control points in the canonical frame.
    pub points: ControlPoints,
    /// The network; `None` where the control points have paths.
    pub network: Option<DeformNet>,
    /// Number of control points that a dynamic Gaussian follows.
    pub neighbours: usize,
}

/// The optimiser's first and second moments of the paths or network, and of the radii.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct MotionMoments {
    model: [Vec<f32>; 2],
    radii: [Vec<f32>; 2],
}

/// The dynamic Gaussians, and the control points that each of them follows; refreshed at intervals.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Following {
    ids: Vec<u32>,
    neighbours: Vec<u32>,
}

/// Number of times of a step: the view's time, and the two times of the as-rigid-as-possible energy.
const TIMES: usize = 3;
/// Half the width of the interval around the view's time from which these two times are drawn.
const ARAP_WINDOW: f64 = 0.05;

/// Changes an array of rows of `width` values for each of `before` control points: keeps those of `kept`
/// and appends zeros for new ones, `count` in all.
fn resized(all: &[f32], width: usize, before: usize, kept: &[usize], count: usize) -> Vec<f32> {
    let mut out = Vec::new();
    for row in all.chunks_exact(width * before) {
        kept.iter().for_each(|&n| out.extend_from_slice(&row[width * n..width * (n + 1)]));
        out.resize(out.len() + width * (count - kept.len()), 0.0);
    }
    out
}

/// The motion model with gradients and optimiser state.
pub(super) struct MotionTrainer {
    pub(super) motion: Motion,
    settings: MotionSettings,
    /// The network's shape; `None` with paths.
    shape: Option<crate::types::NetShape>,
    adam: Adam,
    parameters: State,
    radii: State,
    transform_gradients: Buffer<[f32; 4]>,
    arap: Arap,
    energies: Buffer<f32>,
}

/// Gradient and moments of one array.
struct State {
    gradients: Buffer<f32>,
    first: Buffer<f32>,
    second: Buffer<f32>,
}

impl State {
    fn new(stream: &Stream, label: &str, len: usize) -> Result<State> {
        let device = stream.device();
        let zeros = vec![0.0f32; len];
        Ok(State {
            gradients: device.buffer(&format!("{label} gradients"), len)?,
            first: device.upload(&format!("{label} first moments"), &zeros)?,
            second: device.upload(&format!("{label} second moments"), &zeros)?,
        })
    }

    fn step(
        &mut self,
        recorder: &mut Recorder,
        adam: &mut Adam,
        rate: f64,
        step: u32,
        parameters: &mut Buffer<f32>,
        fits: View<'_, u32>,
    ) -> Result<()> {
        // The array is a single row, so that a frame that did not fit changes nothing.
        let visible = Some((parameters.len(), fits));
        adam.record(
            recorder,
            &AdamSettings { rate, step: step + 1, ..AdamSettings::default() },
            AdamArgs {
                gradients: self.gradients.view(),
                parameters: parameters.view_mut(),
                first: self.first.view_mut(),
                second: self.second.view_mut(),
                visible,
            },
        )
    }
}

impl MotionTrainer {
    /// Uploads a motion model, for up to `capacity` Gaussians.
    pub(super) fn new(
        stream: &mut Stream,
        start: &MotionStart,
        settings: MotionSettings,
        capacity: usize,
    ) -> Result<MotionTrainer> {
        let nodes = start.points.len();
        let k = start.neighbours.min(nodes);
        let network = start.network.as_ref();
        let motion = Motion::new(stream, &start.points, network, k, capacity, TIMES)?;
        let device = stream.device().clone();
        let mut arap =
            Arap::new(&device, settings.arap_edges.min(nodes.saturating_sub(1)).max(1), nodes)?;
        let mut recorder = stream.record()?;
        arap.refresh(&mut recorder, motion.nodes.view())?;
        stream.submit(recorder)?;
        Ok(MotionTrainer {
            parameters: State::new(stream, "motion", motion.parameters.len())?,
            radii: State::new(stream, "radius", nodes)?,
            transform_gradients: device.buffer("transform gradients", 2 * nodes * TIMES)?,
            energies: device.buffer("rigidity energies", nodes)?,
            adam: Adam::new(&device)?,
            shape: network.map(|network| network.shape),
            arap,
            motion,
            settings,
        })
    }

    /// Runs a round of adding and removing control points, from the followers' statistics (two values
    /// for each Gaussian). Returns how many were added and how many removed. If it changed any,
    /// [`set_dynamic`](Self::set_dynamic) must follow.
    pub(super) fn revise(
        &mut self,
        stream: &mut Stream,
        settings: &ControlSettings,
        gaussians: &GaussianBuffers,
        statistics: &[f32],
    ) -> Result<(usize, usize)> {
        let dynamic = self.motion.dynamic;
        if dynamic == 0 {
            return Ok((0, 0));
        }
        let lists = self.motion.skin.neighbours();
        let (k, found) = (lists.k(), lists.neighbours());
        let mut neighbours = stream.device().readback::<u32>(found.len())?;
        let mut recorder = stream.record()?;
        recorder.read_back(found, &neighbours);
        let ticket = stream.submit(recorder)?;
        stream.wait(ticket)?;
        let ids = stream.download(&self.motion.gaussian_from_dynamic)?;
        let centres = stream.download(&gaussians.positions)?;
        let (mut positions, mut pulls) = (Vec::new(), Vec::new());
        for &id in &ids[..dynamic] {
            let id = id as usize;
            positions.push([centres[3 * id], centres[3 * id + 1], centres[3 * id + 2]]);
            let (sum, views) = (f64::from(statistics[2 * id]), f64::from(statistics[2 * id + 1]));
            pulls.push(if views > 0.0 { sum / views } else { 0.0 });
        }
        let (points, network) = self.download(stream)?;
        let neighbours = neighbours.read()?;
        let followers = Followers { positions: &positions, neighbours: &neighbours, pulls: &pulls };
        let revision = revise(&points, &followers, settings);
        let removed = points.len() - revision.kept.len();
        if revision.added.is_empty() && removed == 0 {
            return Ok((0, 0));
        }
        let left = revision.apply(&points);
        let moments = self.moments(stream)?;
        let (kept, count) = (&revision.kept, left.len());
        let capacity = self.motion.gaussian_from_dynamic.len();
        let start = MotionStart { points: left, network, neighbours: k };
        let mut fresh = MotionTrainer::new(stream, &start, self.settings, capacity)?;
        let resized = |width: usize, all: Vec<f32>| resized(&all, width, points.len(), kept, count);
        let moments = MotionMoments {
            // A network does not depend on the number of control points; the paths do.
            model: match self.motion.model {
                Model::Paths => moments.model.map(|all| resized(path::VALUES, all)),
                Model::Network(..) => moments.model,
            },
            radii: moments.radii.map(|all| resized(1, all)),
        };
        fresh.set_moments(stream, &moments)?;
        *self = fresh;
        Ok((revision.added.len(), removed))
    }

    /// In a rehearsal, allocates what a revision allocates in addition.
    pub(super) fn rehearse_revision(&self, stream: &mut Stream, start: &MotionStart) -> Result<()> {
        let found = self.motion.skin.neighbours().neighbours();
        let _neighbours = stream.device().readback::<u32>(found.len())?;
        stream.prepare_download(&self.motion.gaussian_from_dynamic)?;
        let capacity = self.motion.gaussian_from_dynamic.len();
        MotionTrainer::new(stream, start, self.settings, capacity).map(drop)
    }

    /// Sets the dynamic Gaussians, those whose logit is above `least`, and finds the control points that
    /// they follow.
    pub(super) fn set_dynamic(
        &mut self,
        stream: &mut Stream,
        motion_logits: &[f32],
        least: f32,
        gaussians: &GaussianBuffers,
    ) -> Result<()> {
        self.motion.set_dynamic(stream, motion_logits, least)?;
        let mut recorder = stream.record()?;
        self.motion.refresh(&mut recorder, gaussians.views().positions)?;
        stream.submit(recorder)?;
        Ok(())
    }

    /// Waits and reads the result of [`set_dynamic`](Self::set_dynamic).
    pub(super) fn following(&self, stream: &mut Stream) -> Result<Following> {
        let mut ids = stream.download(&self.motion.gaussian_from_dynamic)?;
        ids.truncate(self.motion.dynamic);
        Ok(Following { ids, neighbours: self.motion.skin.neighbours().download(stream)? })
    }

    /// Restores a saved result of [`set_dynamic`](Self::set_dynamic).
    pub(super) fn set_following(
        &mut self,
        stream: &mut Stream,
        following: &Following,
    ) -> Result<()> {
        stream.upload(&mut self.motion.gaussian_from_dynamic, &following.ids)?;
        self.motion.dynamic = following.ids.len();
        let nodes = self.motion.log_radii.len();
        self.motion.skin.neighbours_mut().restore(stream, &following.neighbours, nodes)
    }

    /// Records the moved Gaussians at `time`, in [0, 1].
    pub(super) fn forward(
        &mut self,
        recorder: &mut Recorder,
        gaussians: &GaussianViews<'_>,
        time: f64,
        soft: Option<SoftMotion<'_>>,
        rng: &mut ChaCha8Rng,
    ) -> Result<()> {
        let mut near = || (time + ARAP_WINDOW * rng.random_range(-1.0..1.0)).clamp(0.0, 1.0) as f32;
        let times = [time as f32, near(), near()];
        self.motion.forward(recorder, gaussians, &times, soft)
    }

    /// Records the gradients of the motion model. On input, `gradients` holds the gradients with respect
    /// to the moved Gaussians; on output, those with respect to the canonical ones.
    pub(super) fn backward(
        &mut self,
        recorder: &mut Recorder,
        gaussians: &GaussianViews<'_>,
        gradients: &mut GaussianBuffers,
        soft: Option<SoftGradients<'_>>,
    ) -> Result<()> {
        let settings = self.settings;
        recorder.fill(self.transform_gradients.view_mut(), 0);
        self.motion.skin_backward(
            recorder,
            gaussians,
            gradients,
            self.transform_gradients.view_mut(),
            self.radii.gradients.view_mut(),
            soft,
        )?;
        if settings.arap_weight > 0.0 && self.energies.len() > 1 {
            self.arap.record(
                recorder,
                &ArapSettings { weight: settings.arap_weight as f32, ..ArapSettings::default() },
                ArapArgs {
                    nodes: self.motion.nodes.view(),
                    log_radii: self.motion.log_radii.view(),
                    transforms: self.motion.transforms.view(),
                    times: [1, 2],
                    energies: self.energies.view_mut(),
                    transform_gradients: self.transform_gradients.view_mut(),
                },
            )?;
        }
        let (given, gradients) = (&self.transform_gradients, &mut self.parameters.gradients);
        self.motion.model_backward(recorder, given.view(), gradients.view_mut())
    }

    /// Records the update by these gradients.
    pub(super) fn update(
        &mut self,
        recorder: &mut Recorder,
        step: u32,
        steps: u32,
        fits: View<'_, u32>,
    ) -> Result<()> {
        let settings = self.settings;
        let rate = exponential(settings.rate, settings.rate_last, step, steps);
        let model_rate = match self.motion.model {
            Model::Paths => exponential(settings.path_rate, settings.path_rate_last, step, steps),
            Model::Network(..) => rate,
        };
        let adam = &mut self.adam;
        let parameters = &mut self.motion.parameters;
        self.parameters.step(recorder, adam, model_rate, step, parameters, fits)?;
        self.radii.step(recorder, adam, rate, step, &mut self.motion.log_radii, fits)
    }

    /// Waits, and counts the gradients that were not finite and were skipped.
    pub(super) fn broken(&self, stream: &mut Stream) -> Result<u64> {
        self.adam.broken(stream)
    }

    /// Gradients of the last backward pass with respect to the parameters of the paths or the network,
    /// and to the logarithms of the radii.
    pub(super) fn gradients(&self) -> (&Buffer<f32>, &Buffer<f32>) {
        (&self.parameters.gradients, &self.radii.gradients)
    }

    /// Waits and reads the optimiser's state.
    pub(super) fn moments(&self, stream: &mut Stream) -> Result<MotionMoments> {
        let mut both = |state: &State| -> Result<[Vec<f32>; 2]> {
            Ok([stream.download(&state.first)?, stream.download(&state.second)?])
        };
        Ok(MotionMoments { model: both(&self.parameters)?, radii: both(&self.radii)? })
    }

    /// Restores the optimiser's state.
    pub(super) fn set_moments(
        &mut self,
        stream: &mut Stream,
        moments: &MotionMoments,
    ) -> Result<()> {
        for (state, [first, second]) in
            [(&mut self.parameters, &moments.model), (&mut self.radii, &moments.radii)]
        {
            stream.upload(&mut state.first, first)?;
            stream.upload(&mut state.second, second)?;
        }
        Ok(())
    }

    /// Waits and reads the control points, and the network if the model is one.
    pub(super) fn download(&self, stream: &mut Stream) -> Result<MotionNow> {
        let parameters = stream.download(&self.motion.parameters)?;
        let (paths, network) = match self.shape {
            Some(shape) => (Vec::new(), Some(DeformNet { shape, parameters })),
            None => (bytemuck::cast_slice(&parameters).to_vec(), None),
        };
        let points = ControlPoints {
            positions: bytemuck::cast_slice(&stream.download(&self.motion.nodes)?).to_vec(),
            log_radii: stream.download(&self.motion.log_radii)?,
            paths,
        };
        Ok((points, network))
    }
}

/// Control points, and the network where they have no paths.
pub type MotionNow = (ControlPoints, Option<DeformNet>);
