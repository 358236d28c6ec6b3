//! What rendering takes of a device's memory, before it begins.

use super::{Half, Renderer};
use crate::Result;
use crate::gpu::{Device, Footprint, Rehearsal, most_that_fits};
use crate::scene::Scene;
use crate::types::{Camera, Gaussians, Intrinsics, MotionScale, Pose, Tuning};

/// How large a scene and its pictures are.
///
/// [`footprint`](Self::footprint) makes a renderer and lets it draw where buffers have no memory: what it
/// counts is what a real one allocates. How many tiles the splats of a picture will reach depends on the
/// cameras: [`Renderer::count`] counts them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderScale {
    /// Gaussians.
    pub gaussians: usize,
    /// Degree of their spherical harmonics.
    pub sh_degree: u32,
    /// What moves; `None` where nothing does.
    pub motion: Option<MotionScale>,
    /// Width and height of the largest picture, pixels.
    pub size: (u32, u32),
    /// (splat, tile) pairs of the fullest picture; there is room for four per Gaussian in any case.
    pub intersections: usize,
    /// Accuracy given up for speed.
    pub tuning: Tuning,
    /// Whether pictures are painted anew ([`Renderer::repaint`]), as motion, normals and flow are.
    pub repainted: bool,
}

impl RenderScale {
    /// Of a scene, in pictures of a size.
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

    /// Whether its pictures need more room for (splat, tile) pairs than there is at first.
    pub fn is_dense(&self) -> bool {
        self.intersections > super::usual_capacity(self.gaussians)
    }

    /// What it takes of a device's memory at most.
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

    /// The most Gaussians, each of which reaches as many tiles, with which such a scene fits on a
    /// device; 0 where the picture alone does not fit.
    pub fn most_gaussians(&self, device: &Device) -> usize {
        let each = self.intersections as f64 / self.gaussians.max(1) as f64;
        most_that_fits(device, |gaussians| {
            let intersections = (each * gaussians as f64) as usize;
            RenderScale { gaussians, intersections, ..*self }.footprint(device)
        })
    }

    /// A scene of one Gaussian, and all else as it is.
    fn sketch(&self) -> Scene {
        let scene = Scene::of(Gaussians::one(self.sh_degree));
        let Some(motion) = self.motion else { return scene };
        let (control_points, network) = motion.sketch();
        Scene { control_points, network, neighbours: motion.neighbours as u32, ..scene }
    }
}
