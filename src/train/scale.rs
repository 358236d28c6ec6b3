//! The device memory that a training needs, computed before it begins.
//!
//! [`TrainingScale::footprint`] runs a trainer's steps in a rehearsal, in which buffers have no memory:
//! it counts what a real run would allocate. The number of tiles that the splats of a frame overlap can
//! be counted for the first Gaussians only ([`Renderer::count`](crate::renderer::Renderer::count)). The
//! initial capacity is four (splat, tile) pairs per permitted Gaussian; it grows for a frame that needs
//! more, if the memory suffices.

use super::frame_pool::{Capacity, DeviceView};
use super::motion::MotionStart;
use super::scene_optimiser::{Lengths, SceneOptimiser};
use super::settings::TrainSettings;
use super::trainer::Trainer;
use super::views::TrainingView;
use crate::Result;
use crate::gpu::{Device, Footprint, Rehearsal, most_that_fits};
use crate::ops::gaussians::GaussianBuffers;
use crate::types::{Camera, Gaussians, Image, Intrinsics, MotionScale, Pose};
use std::collections::BTreeMap;

/// A kind of training view; all views of a kind take the same memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct PictureKind {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Whether a disparity is known.
    pub disparity: bool,
    /// Whether a motion mask is known.
    pub mask: bool,
}

/// The size of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingScale {
    /// Number of training views of each kind.
    pub pictures: BTreeMap<PictureKind, usize>,
    /// Number of Gaussians at the beginning.
    pub gaussians: usize,
    /// Largest number of (splat, tile) pairs of a frame; 0 where it is not known.
    pub intersections: usize,
    /// Upper limits of the motion model; `None` for a static scene.
    pub motion: Option<MotionScale>,
    /// The settings of training.
    pub settings: TrainSettings,
}

impl PictureKind {
    fn of(view: &TrainingView) -> PictureKind {
        PictureKind {
            width: view.image.width,
            height: view.image.height,
            disparity: view.disparity.is_some(),
            mask: view.mask.is_some(),
        }
    }

    /// A black view of this kind.
    fn blank(&self) -> TrainingView {
        let PictureKind { width, height, disparity, mask } = *self;
        let image = |channels| Image::new(width, height, channels);
        let intrinsics = Intrinsics::centred(f64::from(width), width, height);
        TrainingView {
            camera: Camera { intrinsics, view_from_world: Pose::IDENTITY },
            time: 0.0,
            image: image(3),
            weights: None,
            disparity: disparity.then(|| image(2)),
            mask: mask.then(|| image(1)),
            every: 1,
        }
    }
}

impl TrainingScale {
    /// The size of a training of `gaussians` Gaussians on some views.
    pub fn new(
        views: &[TrainingView],
        gaussians: usize,
        motion: Option<MotionScale>,
        settings: TrainSettings,
    ) -> TrainingScale {
        let mut pictures = BTreeMap::new();
        views.iter().for_each(|view| *pictures.entry(PictureKind::of(view)).or_insert(0) += 1);
        TrainingScale { pictures, gaussians, intersections: 0, motion, settings }
    }

    /// The largest number of Gaussians that growth can reach.
    pub fn reached(&self) -> usize {
        self.settings.reachable(self.gaussians)
    }

    /// Whether its frames need more (splat, tile) pairs than the initial capacity.
    pub fn is_dense(&self) -> bool {
        !Capacity::of(&self.settings, self.gaussians).holds(self.intersections)
    }

    /// The largest amount of device memory that the training takes.
    ///
    /// # Errors
    /// [`Error::RangeLimit`](crate::Error::RangeLimit) for a buffer larger than one binding of the
    /// device may be; [`Error::Input`](crate::Error::Input) as for [`Trainer::new`].
    pub fn footprint(&self, device: &Device) -> Result<Footprint> {
        let first_capacity = Capacity::of(&self.settings, self.gaussians);
        let capacity = first_capacity.after(self.intersections);
        let first = Gaussians::one(self.settings.sh_degree);
        let start = self.motion.map(|scale| {
            let (points, network) = scale.sketch();
            MotionStart { points, network, neighbours: scale.neighbours }
        });
        Rehearsal::of(device, |rehearsal| {
            let (device, start) = (rehearsal.device(), start.as_ref());
            let (settings, lengths) = (self.settings.clone(), Lengths { radius: 1.0, extent: 1.0 });
            let scene = SceneOptimiser::build(device, &first, start, settings, lengths, capacity)?;
            let views = (self.pictures.iter()).map(|(kind, &count)| {
                rehearsal.repeat(count, |device| DeviceView::new(device, &kind.blank()))
            });
            let mut trainer = Trainer::of(scene, views.collect::<Result<_>>()?);
            trainer.rehearse(capacity.gaussians, start)?;
            trainer.scene.frame_pool.rehearse_growth(device, first_capacity)
        })
    }

    /// The largest number of Gaussians with which such a training fits on a device, with no Gaussians
    /// added in training; 0 where the views alone do not fit.
    pub fn most_gaussians(&self, device: &Device) -> usize {
        let each = self.intersections as f64 / self.gaussians.max(1) as f64;
        most_that_fits(device, |count| {
            let settings = TrainSettings { max_gaussians: count, ..self.settings.clone() };
            let intersections = (each * count as f64) as usize;
            TrainingScale { gaussians: count, intersections, settings, ..self.clone() }
                .footprint(device)
        })
    }
}

impl Trainer {
    /// In a rehearsal, does everything for which a training allocates buffers, with `gaussians`
    /// Gaussians, all of which move if the scene moves.
    fn rehearse(&mut self, gaussians: usize, start: Option<&MotionStart>) -> Result<()> {
        let scene = &mut self.scene;
        scene.gaussians.len = gaussians;
        if let Some(motion) = &mut scene.motion {
            motion.motion.dynamic = gaussians;
            let mut recorder = scene.stream.record()?;
            motion.motion.refresh(&mut recorder, scene.gaussians.views().positions)?;
            scene.stream.submit(recorder)?;
        }
        for view in 0..self.views.len() {
            // The first step has soft motion, the last one evaluates all bands.
            for step in [0, self.scene.settings.steps.saturating_sub(1)] {
                self.scene.step = step;
                self.submit(view)?;
                self.finish()?;
            }
        }
        let SceneOptimiser { stream, settings, motion, gaussians, .. } = &mut self.scene;
        if let (Some(motion), Some(start), Some(_)) = (motion, start, settings.motion.control) {
            motion.rehearse_revision(stream, start)?;
        }
        // Buffers for downloading checkpoints and the result.
        let GaussianBuffers { positions, rotations, sh, .. } = gaussians;
        stream.prepare_download(rotations)?;
        stream.prepare_download(positions)?;
        sh.iter().try_for_each(|band| stream.prepare_download(band))
    }
}
