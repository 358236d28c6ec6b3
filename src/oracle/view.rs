//! The renderer's inputs, Gaussians and camera, in the oracle's number type.

use super::Real;
use super::linear::{Mat3, Vec3, sub};
use crate::types::{Camera, Gaussians, Pose, sh_coefficients};
use glam::{DQuat, DVec3};

/// The parameters of 3D Gaussians, or gradients with respect to them; one row of every array per
/// Gaussian, laid out as [`Gaussians`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cloud<R> {
    /// Centres, world frame.
    pub positions: Vec<Vec3<R>>,
    /// Logarithms of the standard deviations along the Gaussian's own axes.
    pub log_scales: Vec<Vec3<R>>,
    /// `world_from_gaussian` quaternions (w, x, y, z), of any length.
    pub rotations: Vec<[R; 4]>,
    /// Logits of the opacity.
    pub opacity_logits: Vec<R>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// `(sh_degree + 1)²` RGB rows per Gaussian.
    pub sh: Vec<Vec3<R>>,
}

impl<R: Real> Cloud<R> {
    /// The parameters of `gaussians` in this number type.
    pub fn new(gaussians: &Gaussians) -> Cloud<R> {
        let real = |x: f32| R::of(f64::from(x));
        Cloud {
            positions: gaussians.positions.iter().map(|v| v.map(real)).collect(),
            log_scales: gaussians.log_scales.iter().map(|v| v.map(real)).collect(),
            rotations: gaussians.rotations.iter().map(|v| v.map(real)).collect(),
            opacity_logits: gaussians.opacity_logits.iter().map(|&v| real(v)).collect(),
            sh_degree: gaussians.sh_degree,
            sh: gaussians.sh.iter().map(|v| v.map(real)).collect(),
        }
    }

    /// As many rows of zeros as `self` has.
    pub fn zeros_like(&self) -> Cloud<R> {
        Cloud {
            positions: vec![[R::zero(); 3]; self.positions.len()],
            log_scales: vec![[R::zero(); 3]; self.log_scales.len()],
            rotations: vec![[R::zero(); 4]; self.rotations.len()],
            opacity_logits: vec![R::zero(); self.opacity_logits.len()],
            sh_degree: self.sh_degree,
            sh: vec![[R::zero(); 3]; self.sh.len()],
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// The SH coefficients of one Gaussian.
    pub fn sh_of(&self, index: usize) -> &[Vec3<R>] {
        let count = sh_coefficients(self.sh_degree);
        &self.sh[index * count..(index + 1) * count]
    }
}

/// A camera in the oracle's number type.
#[derive(Clone, Debug, PartialEq)]
pub struct View<R> {
    /// Rotation of `view_from_world`.
    pub rotation: Mat3<R>,
    /// The camera's centre in the world.
    pub eye: Vec3<R>,
    /// The rounding error of `eye` in R: far from the origin it is needed for accurate differences
    /// to nearby points.
    pub eye_rest: Vec3<R>,
    /// Focal lengths along x and y, pixels.
    pub focal: [R; 2],
    /// Principal point from the image's upper left corner, pixels.
    pub centre: [R; 2],
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
}

impl<R: Real> View<R> {
    /// The camera in this number type.
    pub fn new(camera: &Camera) -> View<R> {
        let matrix = camera.view_from_world.rotation_matrix().transpose();
        let i = camera.intrinsics;
        let centre = camera.centre().to_array();
        let eye = centre.map(R::of);
        View {
            rotation: matrix.to_cols_array_2d().map(|row| row.map(R::of)),
            eye,
            eye_rest: std::array::from_fn(|k| R::of(centre[k] - eye[k].f64())),
            focal: [R::of(i.fx), R::of(i.fy)],
            centre: [R::of(i.cx), R::of(i.cy)],
            width: i.width,
            height: i.height,
        }
    }
}

impl<R: Real> View<R> {
    /// From the camera's centre to a point, world frame.
    pub fn sight(&self, point: Vec3<R>) -> Vec3<R> {
        sub(sub(point, self.eye), self.eye_rest)
    }
}

/// The rigid motion exp(ξ) of a twist ξ = (ρ, φ), translation first.
pub fn exp(twist: [f64; 6]) -> Pose {
    let rho = DVec3::new(twist[0], twist[1], twist[2]);
    let phi = DVec3::new(twist[3], twist[4], twist[5]);
    let theta = phi.length();
    // sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ cancel at small angles: their series there.
    let (b, c) = if theta < 1e-2 {
        let t2 = theta * theta;
        (0.5 - t2 / 24.0 + t2 * t2 / 720.0, 1.0 / 6.0 - t2 / 120.0 + t2 * t2 / 5040.0)
    } else {
        ((1.0 - theta.cos()) / (theta * theta), (theta - theta.sin()) / (theta * theta * theta))
    };
    let turned = phi.cross(rho);
    Pose::new(DQuat::from_scaled_axis(phi), rho + turned * b + phi.cross(turned) * c)
}

/// The camera after `view_from_world ← exp(twist) · view_from_world`: the perturbation to which
/// pose gradients refer.
pub fn perturbed(camera: &Camera, twist: [f64; 6]) -> Camera {
    Camera { view_from_world: exp(twist) * camera.view_from_world, ..*camera }
}
