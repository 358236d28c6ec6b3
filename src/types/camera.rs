//! Pinhole cameras and rigid transforms.

use super::range::{self, Check, LARGEST_TANGENT, LONGEST_FOCAL};
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
#[cfg(feature = "files")]
use serde::{Deserialize, Serialize};

/// The intrinsics of a pinhole camera, in pixels of an image of `width` × `height`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Intrinsics {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, x, measured from the image's left edge (the first pixel's centre is 0.5).
    pub cx: f64,
    /// Principal point, y, measured from the image's upper edge.
    pub cy: f64,
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
}

impl Intrinsics {
    /// Intrinsics with square pixels and the principal point in the image centre.
    pub fn centred(focal: f64, width: u32, height: u32) -> Intrinsics {
        Intrinsics {
            fx: focal,
            fy: focal,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
            width,
            height,
        }
    }

    /// Checks that every value is in its range; see [`range`].
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        let Intrinsics { fx, fy, cx, cy, width, height } = *self;
        range::inside("image width", width, &range::SIDE)?;
        range::inside("image height", height, &range::SIDE)?;
        let most = LONGEST_FOCAL * f64::from(width.max(height));
        for (axis, focal, centre, side) in [("x", fx, cx, width), ("y", fy, cy, height)] {
            let side = f64::from(side);
            range::wanted(focal > 0.0 && focal <= most, || {
                format!("focal length {focal:?} along {axis} is not above 0 and at most {most:e}")
            })?;
            // At more than 87.5° from the axis a pinhole image is stretched without bound.
            let reach = centre.abs().max((side - centre).abs());
            let least = reach / LARGEST_TANGENT;
            range::wanted(centre.is_finite() && focal >= least, || {
                format!(
                    "focal length {focal:?} and principal point {centre:?} along {axis} see more than \
                     87.5° beside the optical axis on {side} pixels; {:?} is the least focal length \
                     there",
                    (10.0 * least).ceil() / 10.0
                )
            })?;
        }
        Ok(())
    }

    /// The same camera at another image size, stretched to it.
    pub fn resized(&self, width: u32, height: u32) -> Intrinsics {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Intrinsics {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            width,
            height,
        }
    }

    /// Intrinsics for another image size: the whole field of view stays in the image, and pixels stay square
    /// if they were.
    pub fn fitted(&self, width: u32, height: u32) -> Intrinsics {
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        let scale = (f64::from(width) / w).min(f64::from(height) / h);
        let centre = |c: f64, old: f64, new: u32| f64::from(new) / 2.0 + (c - old / 2.0) * scale;
        Intrinsics {
            fx: self.fx * scale,
            fy: self.fy * scale,
            cx: centre(self.cx, w, width),
            cy: centre(self.cy, h, height),
            width,
            height,
        }
    }

    /// The pixel position of a point in the camera's frame; undefined for z ≤ 0.
    pub fn project(&self, point: DVec3) -> DVec2 {
        DVec2::new(self.fx * point.x / point.z + self.cx, self.fy * point.y / point.z + self.cy)
    }

    /// The point at depth z = 1 on the ray through a pixel position, in the camera's frame.
    pub fn ray(&self, pixel: DVec2) -> DVec3 {
        DVec3::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1.0)
    }
}

/// A rigid transform, named `a_from_b`: `x_a = rotation · x_b + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Pose {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Origin of b in a, in units of a.
    pub translation: DVec3,
}

impl Pose {
    /// Maps every point to itself.
    pub const IDENTITY: Pose = Pose { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// A pose from its parts; the quaternion is normalised.
    pub fn new(rotation: DQuat, translation: DVec3) -> Pose {
        Pose { rotation: rotation.normalize(), translation }
    }

    /// A pose from the upper 3×4 part of a matrix whose left 3×3 block is a rotation.
    pub fn from_matrix(matrix: DMat4) -> Pose {
        let rotation = DMat3::from_mat4(matrix);
        Pose::new(DQuat::from_mat3(&rotation), matrix.w_axis.truncate())
    }

    /// Checks that the rotation is of unit length and the translation is in its range; see
    /// [`range`].
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        range::quaternion(self.rotation)?;
        range::place(self.translation).map_err(|what| format!("translation {what}"))
    }

    /// The inverse transform: `b_from_a` of an `a_from_b`.
    pub fn inverse(&self) -> Pose {
        let rotation = self.rotation.conjugate();
        Pose { rotation, translation: -(rotation * self.translation) }
    }

    /// Transforms a point from b to a.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// The rotation as a matrix.
    pub fn rotation_matrix(&self) -> DMat3 {
        DMat3::from_quat(self.rotation)
    }
}

/// `a_from_c = a_from_b * b_from_c`.
impl std::ops::Mul for Pose {
    type Output = Pose;
    fn mul(self, other: Pose) -> Pose {
        Pose {
            rotation: (self.rotation * other.rotation).normalize(),
            translation: self.rotation * other.translation + self.translation,
        }
    }
}

/// A camera in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "files", derive(Serialize, Deserialize))]
pub struct Camera {
    /// Intrinsics.
    pub intrinsics: Intrinsics,
    /// The camera's pose: world to camera.
    pub view_from_world: Pose,
}

impl Camera {
    /// [`Intrinsics::check`] and [`Pose::check`].
    ///
    /// # Errors
    /// A description of the violation.
    pub fn check(&self) -> Check {
        self.intrinsics.check()?;
        self.view_from_world.check()
    }

    /// The camera's centre in the world.
    pub fn centre(&self) -> DVec3 {
        self.view_from_world.inverse().translation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_size_keeps_the_whole_picture() {
        let k = Intrinsics { fx: 80.0, fy: 82.0, cx: 48.0, cy: 31.0, width: 100, height: 60 };
        let twice = k.fitted(200, 120);
        assert_eq!((twice.fx, twice.cx, twice.cy), (160.0, 96.0, 62.0));
        let wide = k.fitted(300, 60);
        assert_eq!((wide.fx, wide.fy, wide.cx, wide.cy), (80.0, 82.0, 148.0, 31.0));
    }
}
