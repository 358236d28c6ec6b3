//! The motion model of the dynamic Gaussians: control points and the deformation network.

use super::range::{self, Check, LOG_SCALE, REACH, WEIGHT};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// Sparse control points in the canonical frame. Each has a rigid motion at every time, given by
/// its path or, without paths, by the network. Gaussians follow the nearest control points (linear
/// blend skinning).
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct ControlPoints {
    /// Canonical positions.
    pub positions: Vec<[f32; 3]>,
    /// Natural logarithms of the radius ρ of the Gaussian kernel `exp(−d²/2ρ²)`.
    pub log_radii: Vec<f32>,
    /// Paths of the control points, `[key][point]`: motions at evenly spaced key times, the first
    /// at 0 and the last at 1. A motion is a translation (3), a value added to the opacity logits
    /// of the Gaussians that follow the point (0 while the point is present,
    /// [`ABSENT`](Self::ABSENT) while it is not; positive values count as 0), and the rotation's
    /// offset δ (4) from the quaternion `[1, 0, 0, 0]`. Catmull–Rom splines interpolate between
    /// keys. Empty if the network moves the points.
    pub paths: Vec<[f32; 8]>,
}

impl ControlPoints {
    /// Added to any opacity logit, this makes the Gaussian invisible.
    pub const ABSENT: f32 = -20.0;

    /// Checks that every number is in its range; see [`range`].
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        for (i, position) in self.positions.iter().enumerate() {
            let near = position.iter().try_for_each(|&v| range::within("position", v, REACH));
            near.map_err(|what| format!("control point {i}: {what}"))?;
        }
        for (i, &radius) in self.log_radii.iter().enumerate() {
            range::inside("log radius", radius, &LOG_SCALE)
                .map_err(|what| format!("control point {i}: {what}"))?;
        }
        self.check_paths()?;
        for (i, motion) in self.paths.iter().enumerate() {
            let inside = |&v: &f32| range::within("motion on its path", v, REACH);
            motion
                .iter()
                .try_for_each(inside)
                .map_err(|what| format!("control point {}: {what}", i % self.len()))?;
        }
        Ok(())
    }

    /// Checks that the paths hold one motion per control point at every key time.
    ///
    /// # Errors
    /// A description of the violation.
    pub(crate) fn check_paths(&self) -> Check {
        let (motions, points) = (self.paths.len(), self.len());
        match motions == self.keys() * points {
            true => Ok(()),
            false => Err(format!("{motions} motions on the paths of {points} control points")),
        }
    }

    /// Number of key times of the paths; 0 without paths.
    pub fn keys(&self) -> usize {
        self.paths.len() / self.len().max(1)
    }

    /// Number of control points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// The shape of the deformation network.
///
/// Input: positional encodings of the canonical position (`3 + 6·position_frequencies` values) and
/// of the time (`1 + 2·time_frequencies`), frequencies 2⁰, 2¹, … without a factor π, each as
/// `[x, sin(2⁰x), cos(2⁰x), sin(2¹x), …]`. Then `depth` ReLU layers of `width`; the encodings are
/// concatenated again *after* the activations of layer `skip` (counted from 0), so that layer
/// `skip + 1` sees `[encoding, activations]`. One linear head of 7: translation (3) and the
/// rotation's offset δ (4), rotation = normalise([1, 0, 0, 0] + δ).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct NetShape {
    /// Number of hidden layers.
    pub depth: u32,
    /// Width of a hidden layer; a multiple of 16.
    pub width: u32,
    /// The layer after which the encodings are concatenated again; `depth` or more for never.
    pub skip: u32,
    /// Frequencies of the position's encoding.
    pub position_frequencies: u32,
    /// Frequencies of the time's encoding.
    pub time_frequencies: u32,
    /// The position's lowest frequency is 2 to the power of this, and each further one twice as high; the
    /// time's lowest is 1.
    pub position_octave: i32,
}

impl NetShape {
    /// Number of outputs of the head: translation (3), rotation offset (4).
    pub const OUTPUTS: usize = 7;

    /// The network of the SC-GS paper.
    pub const PAPER: NetShape = NetShape {
        depth: 8,
        width: 256,
        skip: 4,
        position_frequencies: 10,
        time_frequencies: 10,
        position_octave: 0,
    };

    /// Number of values that enter the network.
    pub fn inputs(&self) -> usize {
        (3 + 6 * self.position_frequencies + 1 + 2 * self.time_frequencies) as usize
    }

    /// `(inputs, outputs)` of every layer, hidden ones first, the head last.
    pub fn layers(&self) -> Vec<(usize, usize)> {
        let (width, inputs) = (self.width as usize, self.inputs());
        let mut layers: Vec<_> = (0..self.depth)
            .map(|layer| match layer {
                0 => (inputs, width),
                l if l == self.skip.saturating_add(1) => (inputs + width, width),
                _ => (width, width),
            })
            .collect();
        layers.push((
            if self.skip.saturating_add(1) == self.depth { inputs + width } else { width },
            Self::OUTPUTS,
        ));
        layers
    }

    /// Number of parameters: per layer the weights `[outputs][inputs]`, then the biases.
    pub fn parameters(&self) -> usize {
        self.layers().iter().map(|(inputs, outputs)| (inputs + 1) * outputs).sum()
    }
}

/// The deformation network: `(canonical position, time) → (translation, rotation)`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct DeformNet {
    /// Its shape.
    pub shape: NetShape,
    /// All parameters, layer after layer in the order of [`NetShape::layers`]: weights as
    /// `[outputs][inputs]`, row-major, then biases.
    pub parameters: Vec<f32>,
}

/// Standard deviation of the head's initial weights: initial motions are close to zero.
const HEAD_DEVIATION: f64 = 1e-5;

impl DeformNet {
    /// Checks that every parameter is in its range; see [`range`].
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        let mut all = self.parameters.iter();
        all.try_for_each(|&weight| range::within("network parameter", weight, WEIGHT))
    }

    /// A randomly initialised network for training: hidden weights uniform in ±√(6 / inputs)
    /// (Kaiming for ReLU), the head's normal with a deviation of 1e-5, biases zero. The same seed
    /// gives the same parameters everywhere.
    pub fn random(shape: NetShape, seed: u64) -> DeformNet {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let layers = shape.layers();
        let mut parameters = Vec::with_capacity(shape.parameters());
        for (layer, &(inputs, outputs)) in layers.iter().enumerate() {
            let bound = (6.0 / inputs as f64).sqrt();
            for _ in 0..inputs * outputs {
                let value = if layer + 1 < layers.len() {
                    rng.random_range(-bound..bound)
                } else {
                    HEAD_DEVIATION * normal(&mut rng)
                };
                parameters.push(value as f32);
            }
            parameters.extend(std::iter::repeat_n(0.0, outputs));
        }
        DeformNet { shape, parameters }
    }

    /// Rescales the network to a scene that is `2^octaves` times as large. Only the exponents of
    /// values change, so that the result is exact.
    #[cfg(feature = "reconstruct")]
    pub(crate) fn enlarge(&mut self, octaves: i32) {
        let factor = 2f32.powi(octaves);
        let layers = self.shape.layers();
        let mut rest = &mut self.parameters[..];
        for (index, &(inputs, outputs)) in layers.iter().enumerate() {
            let (layer, next) = rest.split_at_mut((inputs + 1) * outputs);
            let (weights, biases) = layer.split_at_mut(inputs * outputs);
            // In layers that read the encoding, the first inputs are the plain position.
            if index == 0 || index as u32 == self.shape.skip.saturating_add(1) {
                for row in weights.chunks_exact_mut(inputs) {
                    row[..3].iter_mut().for_each(|weight| *weight /= factor);
                }
            }
            if index + 1 == layers.len() {
                let translation = weights[..3 * inputs].iter_mut().chain(&mut biases[..3]);
                translation.for_each(|value| *value *= factor);
            }
            rest = next;
        }
        self.shape.position_octave -= octaves;
    }
}

/// A standard normal random number (Box–Muller).
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// The size of the motion model of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionScale {
    /// Number of control points.
    pub control_points: usize,
    /// Number of key times of the paths; 0 if the network moves the control points.
    pub keys: usize,
    /// Shape of the deformation network; `None` if paths move the control points.
    pub network: Option<NetShape>,
    /// Number of control points that a Gaussian follows.
    pub neighbours: usize,
}

impl MotionScale {
    /// Control points and a network of this scale, all zero.
    pub(crate) fn sketch(&self) -> (ControlPoints, Option<DeformNet>) {
        let count = self.control_points;
        let points = ControlPoints {
            positions: vec![[0.0; 3]; count],
            log_radii: vec![0.0; count],
            paths: vec![[0.0; 8]; self.keys * count],
        };
        let network = self
            .network
            .map(|shape| DeformNet { shape, parameters: vec![0.0; shape.parameters()] });
        (points, network)
    }
}
