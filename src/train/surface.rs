//! Alignment of Gaussians with the surfaces that the depth shows.
//!
//! Seeds are spaced evenly in the images. On a surface at a grazing angle they are far apart along the
//! line of sight. The frames that they come from show no gap there, but a camera at a higher position
//! does. A flat Gaussian whose footprint is round in its own frame covers the surface from all
//! viewpoints.

use crate::types::{Gaussians, Image, Intrinsics};
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Half the side of the window in which a plane is fitted, pixels.
const REACH: i64 = 4;
/// Absolute logarithm of the depth ratio above which pixels belong to another surface.
const SAME_SURFACE: f64 = 0.1;
/// Smallest share of the window's pixels that must belong to the surface.
const LEAST_SHARE: f64 = 0.75;
/// Largest share of the inverse depths' variance that the fit of a plane may leave. The edge of an
/// object slopes as steeply as ground at a grazing angle, but is not a plane. Measured depth is noisy,
/// so the bound is wide.
const UNEXPLAINED: f64 = 0.5;
/// Largest elongation of a Gaussian, in units of its width.
const LONGEST: f64 = 3.0;
/// Thickness of a Gaussian on a surface, in units of its width.
const THICKNESS: f64 = 0.3;

/// The unit normal of the surface at a pixel, in the camera frame, towards the camera. The inverse depth
/// of a plane is linear in the pixel, so the plane is fitted by least squares. `None` where the depth
/// shows no plane.
pub(super) fn normal(depth: &Image, intrinsics: &Intrinsics, pixel: DVec2) -> Option<DVec3> {
    let (width, height) = (i64::from(depth.width), i64::from(depth.height));
    let (x0, y0) = (pixel.x.floor() as i64, pixel.y.floor() as i64);
    if !(0..width).contains(&x0) || !(0..height).contains(&y0) {
        return None;
    }
    let z = |x: i64, y: i64| f64::from(depth.at(x as u32, y as u32)[0]);
    let here = z(x0, y0);
    if here <= 0.0 || !here.is_finite() {
        return None;
    }
    // Normal equations of 1 / z = a X + b Y + c, where X and Y are the ray's coordinates.
    let (mut products, mut right) = (DMat3::ZERO, DVec3::ZERO);
    let (mut surface, mut window) = (Vec::new(), 0.0);
    for y in (y0 - REACH).max(0)..=(y0 + REACH).min(height - 1) {
        for x in (x0 - REACH).max(0)..=(x0 + REACH).min(width - 1) {
            let there = z(x, y);
            window += 1.0;
            if there <= 0.0 || (there / here).ln().abs() > SAME_SURFACE {
                continue;
            }
            let ray = intrinsics.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            products += DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
            right += ray / there;
            surface.push((ray, 1.0 / there));
        }
    }
    if (surface.len() as f64) < LEAST_SHARE * window || products.determinant() <= 0.0 {
        return None;
    }
    let plane = products.inverse() * right;
    let mean = surface.iter().map(|(_, w)| w).sum::<f64>() / surface.len() as f64;
    let total: f64 = surface.iter().map(|(_, w)| (w - mean).powi(2)).sum();
    let rest: f64 = surface.iter().map(|(ray, w)| (w - plane.dot(*ray)).powi(2)).sum();
    if rest > UNEXPLAINED * total {
        return None;
    }
    let normal = plane.try_normalize()?;
    Some(if normal.dot(intrinsics.ray(pixel)) > 0.0 { -normal } else { normal })
}

/// Aligns a round Gaussian with a surface: thin across it, as wide as before, and elongated so that its
/// footprint stays round in the direction `ray`. `ray` and `normal` are in the world frame.
pub(super) fn lay(gaussians: &mut Gaussians, i: usize, ray: DVec3, normal: DVec3) {
    let ray = ray.normalize();
    let cosine = ray.dot(normal).abs().max(1.0 / LONGEST);
    let side = normal.cross(ray);
    let side = if side.length_squared() > 1e-12 {
        side.normalize()
    } else {
        normal.any_orthonormal_vector()
    };
    let along = normal.cross(side);
    let rotation = DQuat::from_mat3(&DMat3::from_cols(side, along, normal));
    gaussians.rotations[i] =
        [rotation.w as f32, rotation.x as f32, rotation.y as f32, rotation.z as f32];
    let width = gaussians.log_scales[i][0];
    gaussians.log_scales[i] = [width, width - cosine.ln() as f32, width + THICKNESS.ln() as f32];
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Point;
    use crate::train::seed::seed_from_points;

    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 250.0, fy: 260.0, cx: 32.0, cy: 24.0, width: 64, height: 48 };

    fn depth(z: impl Fn(DVec3) -> f64) -> Image {
        let mut image = Image::new(64, 48, 1);
        for y in 0..48 {
            for x in 0..64 {
                let ray = INTRINSICS.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                image.at_mut(x, y)[0] = z(ray) as f32;
            }
        }
        image
    }

    #[test]
    fn a_plane_has_its_normal() {
        // n · x = -2, towards the camera.
        let expected = DVec3::new(0.2, -0.9, -0.5).normalize();
        let image = depth(|ray| -2.0 / expected.dot(ray));
        for pixel in [DVec2::new(30.5, 30.5), DVec2::new(5.5, 40.5), DVec2::new(60.5, 24.5)] {
            let found = normal(&image, &INTRINSICS, pixel).unwrap();
            assert!(found.angle_between(expected) < 1e-3, "{pixel}: {found}");
        }
    }

    #[test]
    fn an_edge_and_what_is_unknown_have_none() {
        // Random steps that are too small to count as another surface.
        let rough = depth(|ray| 2.0 + 0.1 * (5000.0 * (ray.x + 3.0 * ray.y)).sin());
        assert_eq!(normal(&rough, &INTRINSICS, DVec2::new(30.5, 30.5)), None);
        let unknown = depth(|_| 0.0);
        assert_eq!(normal(&unknown, &INTRINSICS, DVec2::new(30.5, 30.5)), None);
        let lone = depth(|ray| if ray.x.abs() < 0.006 { 2.0 } else { 4.0 });
        assert_eq!(normal(&lone, &INTRINSICS, DVec2::new(32.5, 24.5)), None);
        let plane = depth(|_| 2.0);
        for outside in [DVec2::new(-0.5, 3.0), DVec2::new(64.5, 3.0), DVec2::splat(f64::NAN)] {
            assert!(normal(&plane, &INTRINSICS, outside).is_none_or(|n| n.is_finite()));
        }
    }

    #[test]
    fn from_its_frame_it_stays_round() {
        let points: Vec<Point> = (0..4)
            .map(|i| Point { position: [0.01 * i as f32, 0.0, 2.0], colour: [0.5; 3] })
            .collect();
        let normal = DVec3::new(0.1, -0.9, -0.4).normalize();
        let ray = DVec3::new(0.1, 0.2, 1.0).normalize();
        let mut gaussians = seed_from_points(&points, 0);
        let width = f64::from(gaussians.log_scales[1][0]).exp();
        lay(&mut gaussians, 1, ray, normal);
        let [w, x, y, z] = gaussians.rotations[1].map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
        let scales = DVec3::from_array(gaussians.log_scales[1].map(|s| f64::from(s).exp()));
        assert!((axes.z_axis.dot(normal).abs() - 1.0).abs() < 1e-6);
        // The extent of a flat Gaussian in directions across the ray, from its in-plane axes alone.
        let across = ray.any_orthonormal_vector();
        for direction in [across, ray.cross(across), (across + 2.0 * ray.cross(across)).normalize()]
        {
            let flat = [axes.x_axis * scales.x, axes.y_axis * scales.y];
            let spread = flat.iter().map(|a| a.dot(direction).powi(2)).sum::<f64>().sqrt();
            assert!((spread / width - 1.0).abs() < 1e-4, "{direction}: {spread} {width}");
        }
        // At a right angle it is as long as wide; at a grazing angle its length is at the limit.
        lay(&mut gaussians, 2, DVec3::Z, DVec3::NEG_Z);
        let flat = gaussians.log_scales[2];
        assert!((flat[0] - flat[1]).abs() < 1e-6 && flat[2] < flat[0]);
        lay(&mut gaussians, 3, DVec3::Z, DVec3::X);
        let long = gaussians.log_scales[3];
        assert!((f64::from(long[1] - long[0]).exp() - LONGEST).abs() < 1e-3);
        assert!(gaussians.rotations.iter().flatten().all(|v| v.is_finite()));
    }
}
