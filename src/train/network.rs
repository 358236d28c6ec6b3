//! The deformation network's start: fitted to known trajectories.

use crate::gpu::{Buffer, Device, Stream};
use crate::ops::adam::{Adam, AdamArgs};
use crate::ops::mlp::{Network, NetworkScratch};
use crate::types::{AdamSettings, ControlPoints, DeformNet};
use crate::{Error, Result};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Times in one step of the fit.
const BATCH: usize = 4;

/// The translations that a network is to give.
#[derive(Clone, Copy, Debug)]
pub struct Translations<'a> {
    /// In [0, 1].
    pub times: &'a [f64],
    /// `targets[point][time]`, from the canonical position.
    pub targets: &'a [Vec<[f32; 3]>],
}

/// All that the next step of a [`TranslationFit`] depends on, besides what is fitted to what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TranslationFitState {
    step: u32,
    parameters: Vec<f32>,
    /// First and second.
    moments: [Vec<f32>; 2],
    rng: ChaCha8Rng,
    error: f64,
}

impl TranslationFitState {
    /// The state before the first step.
    pub fn begin(network: &DeformNet, seed: u64) -> TranslationFitState {
        let zeros = vec![0.0f32; network.parameters.len()];
        TranslationFitState {
            step: 0,
            parameters: network.parameters.clone(),
            moments: [zeros.clone(), zeros],
            rng: ChaCha8Rng::seed_from_u64(seed),
            error: 0.0,
        }
    }

    /// Steps done.
    pub fn step(&self) -> u32 {
        self.step
    }
}

/// Fits a network's translations to those of control points, step by step.
pub struct TranslationFit<'a> {
    goal: Translations<'a>,
    steps: u32,
    step: u32,
    rng: ChaCha8Rng,
    /// A running mean of the squared error: single batches differ with the times they drew.
    error: f64,
    nodes: usize,
    plan: Network,
    scratch: NetworkScratch,
    adam: Adam,
    stream: Stream,
    positions: Buffer<f32>,
    parameters: Buffer<f32>,
    gradients: Buffer<f32>,
    first: Buffer<f32>,
    second: Buffer<f32>,
    times: Buffer<f32>,
    transforms: Buffer<[f32; 4]>,
    by_transforms: Buffer<[f32; 4]>,
}

impl<'a> TranslationFit<'a> {
    /// A fit of `steps` steps that goes on from a state of the same goal.
    ///
    /// # Errors
    /// [`Error::Input`] for a state of another network; out of memory, or a failed submission.
    pub fn new(
        device: &Device,
        network: &DeformNet,
        points: &ControlPoints,
        goal: Translations<'a>,
        steps: u32,
        state: &TranslationFitState,
    ) -> Result<TranslationFit<'a>> {
        let count = network.parameters.len();
        let [first, second] = &state.moments;
        if [&state.parameters, first, second].iter().any(|values| values.len() != count) {
            return Err(Error::Input("the state to resume from is of another network".into()));
        }
        let nodes = points.len();
        let rows = nodes * BATCH;
        let plan = Network::new(&network.shape)?;
        Ok(TranslationFit {
            goal,
            steps,
            step: state.step,
            rng: state.rng.clone(),
            error: state.error,
            nodes,
            scratch: plan.scratch(device, rows)?,
            plan,
            adam: Adam::new(device)?,
            stream: device.stream()?,
            positions: device.upload("control points", points.positions.as_flattened())?,
            parameters: device.upload("network parameters", &state.parameters)?,
            gradients: device.upload("network gradients", &vec![0.0f32; count])?,
            first: device.upload("first moments", first)?,
            second: device.upload("second moments", second)?,
            times: device.buffer("times", BATCH)?,
            transforms: device.buffer("transforms", 2 * rows)?,
            by_transforms: device.buffer("transform gradients", 2 * rows)?,
        })
    }

    /// Steps done.
    pub fn steps_done(&self) -> u32 {
        self.step
    }

    /// One step.
    ///
    /// # Errors
    /// A failed submission.
    pub fn step(&mut self) -> Result<()> {
        let (nodes, rows) = (self.nodes, self.nodes * BATCH);
        let Translations { times, targets } = self.goal;
        let chosen: [usize; BATCH] = std::array::from_fn(|_| self.rng.random_range(0..times.len()));
        let mut recorder = self.stream.record()?;
        recorder.update(self.times.view_mut(), &chosen.map(|t| times[t] as f32))?;
        self.plan.forward(
            &mut recorder,
            self.parameters.view(),
            self.positions.view(),
            self.times.view(),
            self.transforms.view_mut(),
            &mut self.scratch,
        )?;
        self.stream.submit(recorder)?;
        let got = self.stream.download(&self.transforms)?;
        let mut gradient = vec![[0.0f32; 4]; 2 * rows];
        let mut sum = 0.0f64;
        for (b, &time) in chosen.iter().enumerate() {
            for node in 0..nodes {
                let row = 2 * (b * nodes + node);
                for k in 0..3 {
                    let difference = got[row][k] - targets[node][time][k];
                    sum += f64::from(difference * difference);
                    gradient[row][k] = 2.0 * difference / rows as f32;
                }
            }
        }
        let mean = sum / rows as f64;
        self.error = if self.step == 0 { mean } else { 0.95 * self.error + 0.05 * mean };
        self.stream.upload(&mut self.by_transforms, &gradient)?;
        let mut recorder = self.stream.record()?;
        self.plan.backward(
            &mut recorder,
            self.parameters.view(),
            self.by_transforms.view(),
            self.gradients.view_mut(),
            false,
            &mut self.scratch,
        )?;
        let rate = super::settings::exponential(2e-3, 1e-4, self.step, self.steps);
        self.adam.record(
            &mut recorder,
            &AdamSettings { rate, step: self.step + 1, ..AdamSettings::default() },
            AdamArgs {
                gradients: self.gradients.view(),
                parameters: self.parameters.view_mut(),
                first: self.first.view_mut(),
                second: self.second.view_mut(),
                visible: None,
            },
        )?;
        self.stream.submit(recorder)?;
        self.step += 1;
        Ok(())
    }

    /// Waits and reads all that the next step depends on.
    ///
    /// # Errors
    /// A failed submission.
    pub fn state(&mut self) -> Result<TranslationFitState> {
        let moments = [self.stream.download(&self.first)?, self.stream.download(&self.second)?];
        Ok(TranslationFitState {
            step: self.step,
            parameters: self.parameters()?,
            moments,
            rng: self.rng.clone(),
            error: self.error,
        })
    }

    /// Waits and reads the network's parameters.
    ///
    /// # Errors
    /// A failed submission.
    pub fn parameters(&mut self) -> Result<Vec<f32>> {
        self.stream.download(&self.parameters)
    }

    /// The root mean square error of the last steps.
    pub fn error(&self) -> f64 {
        self.error.sqrt()
    }
}
