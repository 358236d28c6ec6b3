//! Estimates the device memory of rendering before it begins.

use super::{Half, Renderer};
use crate::Result;
use crate::gpu::{Device, Footprint, Rehearsal, most_that_fits};
use crate::scene::Scene;
use crate::types::{Camera, Gaussians, Intrinsics, MotionScale, Pose, Tuning};

/// The sizes of a scene and its images that determine the memory of rendering.
///
/// [`footprint`](Self::footprint) creates a renderer and renders in a rehearsal, in which buffers
/// have no memory; it counts the bytes that a real renderer allocates. The number of (splat, tile)
/// pairs depends on the cameras: [`Renderer::count`] counts them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderScale {
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Degree of their spherical harmonics.
    pub sh_degree: u32,
    /// Size of the motion model; `None` in a static scene.
    pub motion: Option<MotionScale>,
    /// Width and height of the largest image, pixels.
    pub size: (u32, u32),
    /// (splat, tile) pairs of the image that has the most; the capacity is at least four per
    /// Gaussian.
    pub intersections: usize,
    /// Trade-offs of accuracy for speed.
    pub tuning: Tuning,
    /// Whether [`Renderer::repaint`] is used, as motion masks, normals and flow do.
    pub repainted: bool,
}

impl RenderScale {
    /// The sizes of a scene that is rendered to images of `size`.
    pub fn new(scene: &Scene, size: (u32, u32), tuning: &Tuning) -> RenderScale {
        RenderScale {
            gaussians: scene.gaussians.len(),
            sh_degree: scene.gaussians.sh_degree,
            motion: scene.moves().then(|| MotionScale {
                control_points: scene.control_points.len(),
                keys: scene.control_points.keys(),
                network: scene.network.as_ref().map(|network| network.shape),
                neighbours: scene.neighbours as usize,
            }),
            size,
            intersections: 0,
            tuning: *tuning,
            repainted: false,
        }
    }

    /// Whether the images need more than the initial capacity for (splat, tile) pairs.
    pub fn is_dense(&self) -> bool {
        self.intersections > super::usual_capacity(self.gaussians)
    }

    /// The peak device memory of rendering.
    ///
    /// # Errors
    /// [`Error::RangeLimit`](crate::Error::RangeLimit) for a buffer larger than one binding of the
    /// device may be; [`Error::Input`](crate::Error::Input) as for [`Renderer::tuned`].
    pub fn footprint(&self, device: &Device) -> Result<Footprint> {
        let scene = self.sketch();
        let (width, height) = self.size;
        let intrinsics = Intrinsics::centred(f64::from(width), width, height);
        let camera = Camera { intrinsics, view_from_world: Pose::IDENTITY };
        Rehearsal::of(device, |rehearsal| {
            let (device, count) = (rehearsal.device(), self.gaussians);
            let mut renderer = Renderer::with_capacity(device, &scene, &self.tuning, count.max(1))?;
            renderer.half = Half::capacity(device, count, self.sh_degree, &self.tuning)?;
            renderer.gaussians.len = count;
            renderer.capacity = self.intersections;
            if let Some(motion) = &mut renderer.motion {
                motion.dynamic = count;
                let mut recorder = renderer.stream.record()?;
                motion.refresh(&mut recorder, renderer.gaussians.views().positions)?;
                renderer.stream.submit(recorder)?;
            }
            renderer.render(&camera, 0.0)?;
            if self.repainted {
                renderer.repaint(&vec![[0.0; 3]; renderer.gaussians.len])?;
            }
            Ok(())
        })
    }

    /// The largest number of Gaussians with which such a scene fits on a device, at the same number
    /// of tiles per Gaussian; 0 if the image alone does not fit.
    pub fn most_gaussians(&self, device: &Device) -> usize {
        let each = self.intersections as f64 / self.gaussians.max(1) as f64;
        most_that_fits(device, |gaussians| {
            let intersections = (each * gaussians as f64) as usize;
            RenderScale { gaussians, intersections, ..*self }.footprint(device)
        })
    }

    /// A scene of one Gaussian with the motion model of this scale.
    fn sketch(&self) -> Scene {
        let scene = Scene::of(Gaussians::one(self.sh_degree));
        let Some(motion) = self.motion else { return scene };
        let (control_points, network) = motion.sketch();
        Scene { control_points, network, neighbours: motion.neighbours as u32, ..scene }
    }
}
