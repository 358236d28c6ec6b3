//! Training: from posed pictures and points to Gaussians, and from these to a moving scene.
//!
//! | module | what it does |
//! |---|---|
//! | [`seed`] | the first Gaussians, from points |
//! | [`sampling`] | farthest-point sampling, for control points |
//! | [`settings`] | every number that training depends on |
//! | [`photographs`] | the pictures on the device, and the renderer for each of their sizes |
//! | [`optimiser`] | Adam over the Gaussians' parameter groups |
//! | [`growth`] | density control: MCMC relocation and growth |
//! | [`motion`] | the network and the control points |
//! | [`trainer`] | the step: deform, render, compare, differentiate, update |

pub mod growth;
pub mod motion;
pub mod optimiser;
pub mod photographs;
pub mod sampling;
pub mod seed;
pub mod settings;
pub mod trainer;

pub use motion::MotionStart;
pub use seed::seed_from_points;
pub use settings::{GrowthSettings, MotionSettings, Rates, TrainSettings};
pub use trainer::{Progress, Trainer, TrainingView};
