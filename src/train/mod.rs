//! Training: from posed images and points to Gaussians, and from these to a moving scene.
//!
//! | module | what it does |
//! |---|---|
//! | [`seed`] | the first Gaussians, from points |
//! | `surface` | aligns Gaussians with the surfaces that the depth shows |
//! | [`region`] | random initial points where none are given |
//! | [`scale`] | the device memory that a training needs, computed before it begins |
//! | [`sampling`] | farthest-point sampling, for control points |
//! | `windows` | intervals of a clip in which the movers have their own Gaussians and control points |
//! | `carried` | seeds on movers: points of a frame, carried to the canonical frame |
//! | `movers` | the first Gaussians on the movers |
//! | `shadow` | Gaussians for the shadows of movers |
//! | [`settings`] | every setting of training |
//! | [`views`] | the training views |
//! | `aside` | views from offset cameras, rendered from a tracked clip's frames and their depth |
//! | `flank` | the unseen sides of movers: a guess |
//! | `mesh` | frames as meshes over their pixels, rasterised for other cameras |
//! | `beyond` | extrapolation of surfaces beyond the edges of what a frame shows |
//! | [`frame_pool`] | the training views on the device, and the frame resources for each image size |
//! | [`optimiser`] | Adam over the Gaussians' parameter groups |
//! | [`scene_optimiser`] | the scene on the device: the path of every step, to render, differentiate and update |
//! | [`own_loss`] | a step with the caller's own loss |
//! | [`growth`] | density control: MCMC, or clone, split and prune |
//! | [`motion`] | training of the control points' paths or of the network that moves them |
//! | [`control`] | control points added and removed |
//! | [`selection`] | which Gaussians move |
//! | `lifting` | a tracked clip's cameras, and the paths of its scaffold's nodes |
//! | [`posed`] | from posed images of a moving scene to a scene |
//! | [`preset`] | image sizes, steps and limits by quality and device |
//! | [`sequence`] | from a tracked clip to a scene |
//! | [`observer`] | observers of a training: progress, previews, checkpoints |
//! | `glimpse` | previews: the scene in its current state of training |
//! | [`state`] | the state of a training, to save and resume from |
//! | [`rounds`] | work due between steps: density control, control points, lists of dynamic Gaussians |
//! | [`trainer`] | training on views with the engine's loss |

#[cfg(feature = "reconstruct")]
mod aside;
#[cfg(feature = "reconstruct")]
mod beyond;
#[cfg(feature = "reconstruct")]
mod carried;
pub mod control;
#[cfg(feature = "reconstruct")]
mod flank;
pub mod frame_pool;
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
pub mod scene_optimiser;
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
pub use rounds::{ControlChanges, SYNC_INTERVAL};
pub use scale::{PictureKind, TrainingScale};
pub use scene_optimiser::{Progress, SceneOptimiser};
#[cfg(feature = "reconstruct")]
pub use seed::seed_from_points;
#[cfg(feature = "reconstruct")]
pub use sequence::{Sequence, SequenceSettings, first_gaussians, fit_sequence};
pub use settings::{
    AdaptiveSettings, ControlSettings, GrowthSettings, McmcSettings, MotionSettings, Rates,
    SelectionSettings, TrainSettings,
};
pub use state::TrainerState;
pub use trainer::Trainer;
pub use views::TrainingView;
