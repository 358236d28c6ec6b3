//! Training: from posed pictures and points to Gaussians, and from these to a moving scene.
//!
//! | module | what it does |
//! |---|---|
//! | [`seed`] | the first Gaussians, from points |
//! | [`region`] | points where there are none |
//! | [`sampling`] | farthest-point sampling, for control points |
//! | [`settings`] | every number that training depends on |
//! | [`photographs`] | the pictures on the device, and the renderer for each of their sizes |
//! | [`optimiser`] | Adam over the Gaussians' parameter groups |
//! | [`growth`] | density control: MCMC relocation and growth |
//! | [`motion`] | the network and the control points |
//! | [`trajectories`] | where a mover's points are at every frame |
//! | [`network`] | the deformation network's start |
//! | [`posed`] | from posed pictures of a moving scene to a scene |
//! | [`sequence`] | from a tracked clip to a scene: the two stages |
//! | [`observer`] | who looks on: progress, checkpoints |
//! | [`state`] | a trainer's state, to put away and resume from |
//! | [`trainer`] | the step: deform, render, compare, differentiate, update |

pub mod growth;
pub mod motion;
pub mod network;
pub mod observer;
pub mod optimiser;
pub mod photographs;
pub mod posed;
pub mod region;
pub mod sampling;
pub mod seed;
pub mod sequence;
pub mod settings;
pub mod state;
pub mod trainer;
pub mod trajectories;

pub use motion::MotionStart;
pub use observer::{Checkpoint, Observer, Phase};
pub use posed::{PosedMotion, fit_posed};
pub use region::random_points;
pub use seed::seed_from_points;
pub use sequence::{Sequence, SequenceSettings, fit_sequence};
pub use settings::{GrowthSettings, MotionSettings, Rates, TrainSettings};
pub use state::TrainerState;
pub use trainer::{Progress, SYNC_INTERVAL, Trainer, TrainingView};
