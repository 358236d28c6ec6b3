//! Training: from posed pictures and points to Gaussians, and from these to a moving scene.
//!
//! | module | what it does |
//! |---|---|
//! | [`seed`] | the first Gaussians, from points |
//! | `surface` | Gaussians laid along the surfaces that the depth shows |
//! | [`region`] | points where there are none |
//! | [`scale`] | what a training takes of a device's memory, before it begins |
//! | [`sampling`] | farthest-point sampling, for control points |
//! | `windows` | stretches of a clip in which what moves has Gaussians and control points of its own |
//! | `carried` | Gaussians seeded on what moves: points of a frame in the canonical one |
//! | `movers` | the first Gaussians on what moves |
//! | `shadow` | Gaussians for the shadows of movers |
//! | [`settings`] | every number that training depends on |
//! | [`views`] | the pictures to train on |
//! | `aside` | pictures from where no camera was, drawn from a tracked clip's frames by their depth |
//! | `flank` | what of movers these show where no frame does |
//! | `mesh` | frames as meshes over their pixels, drawn before other cameras |
//! | `beyond` | what lies beyond the edges of what a frame shows: a guess |
//! | [`frame_pool`] | the pictures on the device, and the renderer for each of their sizes |
//! | [`optimiser`] | Adam over the Gaussians' parameter groups |
//! | [`own_loss`] | a step with the caller's own loss |
//! | [`growth`] | density control: MCMC, or clone, split and prune |
//! | [`motion`] | the control points, and their paths or the network that moves them |
//! | [`control`] | control points added and removed |
//! | [`selection`] | which Gaussians move |
//! | `lifting` | pixels of a tracked clip in the world, and the paths of its nodes |
//! | [`posed`] | from posed pictures of a moving scene to a scene |
//! | [`preset`] | sizes, steps and caps by quality and device |
//! | [`sequence`] | from a tracked clip to a scene |
//! | [`observer`] | who looks on: progress, checkpoints |
//! | `glimpse` | the scene as it is while it is trained |
//! | [`state`] | a trainer's state, to put away and resume from |
//! | [`rounds`] | what happens between some steps: growth, control points, who moves |
//! | [`trainer`] | the step: deform, render, compare, differentiate, update |

#[cfg(feature = "reconstruct")]
mod aside;
#[cfg(feature = "reconstruct")]
mod beyond;
#[cfg(feature = "reconstruct")]
mod carried;
pub mod control;
#[cfg(feature = "reconstruct")]
mod flank;
#[cfg(feature = "reconstruct")]
mod glimpse;
pub mod growth;
#[cfg(feature = "reconstruct")]
mod lifting;
#[cfg(feature = "reconstruct")]
mod mesh;
pub mod motion;
#[cfg(feature = "reconstruct")]
mod movers;
#[cfg(feature = "reconstruct")]
pub mod observer;
pub mod optimiser;
pub mod own_loss;
pub mod frame_pool;
#[cfg(feature = "reconstruct")]
pub mod posed;
#[cfg(feature = "reconstruct")]
pub mod preset;
#[cfg(feature = "reconstruct")]
pub mod region;
pub mod rounds;
#[cfg(feature = "reconstruct")]
pub mod sampling;
pub mod scale;
#[cfg(feature = "reconstruct")]
pub mod seed;
pub mod selection;
#[cfg(feature = "reconstruct")]
pub mod sequence;
pub mod settings;
#[cfg(feature = "reconstruct")]
mod shadow;
pub mod state;
#[cfg(feature = "reconstruct")]
mod surface;
pub mod trainer;
pub mod views;
#[cfg(feature = "reconstruct")]
mod windows;

pub use motion::MotionStart;
#[cfg(feature = "reconstruct")]
pub use observer::{Checkpoint, Measured, Observer, Phase};
#[cfg(feature = "reconstruct")]
pub use posed::{PosedMotion, fit_posed, posed_scale, posed_unit};
#[cfg(feature = "reconstruct")]
pub use preset::{Preset, Quality};
#[cfg(feature = "reconstruct")]
pub use region::{points_in_hull, random_points};
pub use rounds::ControlChanges;
pub use scale::{PictureKind, TrainingScale};
#[cfg(feature = "reconstruct")]
pub use seed::seed_from_points;
#[cfg(feature = "reconstruct")]
pub use sequence::{Sequence, SequenceSettings, first_gaussians, fit_sequence};
pub use settings::{
    AdaptiveSettings, ControlSettings, GrowthSettings, McmcSettings, MotionSettings, Rates,
    SelectionSettings, TrainSettings,
};
pub use state::TrainerState;
pub use trainer::{Progress, SYNC_INTERVAL, Trainer};
pub use views::TrainingView;
