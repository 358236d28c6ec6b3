//! Reference images of a scene by the oracle in f64, without approximations.

use super::speed::Shot;
use crate::oracle::raster::Pixels;
use crate::oracle::view::{Cloud, View};
use crate::oracle::{deform, mlp, path, render};
use crate::scene::Scene;

/// The scene's Gaussians at a time in [0, 1].
pub(super) fn cloud_at(scene: &Scene, time: f64) -> Cloud<f64> {
    let gaussians = &scene.gaussians;
    let mut cloud = Cloud::<f64>::new(gaussians);
    if !scene.moves() {
        return cloud;
    }
    let points = &scene.control_points;
    let k = (scene.neighbours as usize).min(points.len());
    let nodes: Vec<[f64; 3]> = points.positions.iter().map(|p| p.map(f64::from)).collect();
    let transforms: Vec<[f64; 8]> = match &scene.network {
        Some(network) => {
            let parameters: Vec<f64> = network.parameters.iter().map(|&p| f64::from(p)).collect();
            let queries: Vec<[f64; 4]> = nodes.iter().map(|p| [p[0], p[1], p[2], time]).collect();
            let outputs = mlp::forward(&network.shape, &parameters, &queries).outputs;
            outputs.into_iter().map(mlp::transform).collect()
        }
        None => {
            let paths: Vec<[f64; 8]> =
                points.paths.iter().map(|motion| motion.map(f64::from)).collect();
            path::evaluate(&paths, points.len(), &[time])
        }
    };
    let log_radii: Vec<f64> = points.log_radii.iter().map(|&r| f64::from(r)).collect();
    let ids: Vec<u32> =
        (0..).zip(&gaussians.motion_logits).filter(|(_, m)| **m > 0.0).map(|(i, _)| i).collect();
    let listed: Vec<[f32; 3]> = ids.iter().map(|&i| gaussians.positions[i as usize]).collect();
    let neighbours = deform::nearest(&listed, &points.positions, k);
    let unused = vec![0.0; gaussians.len()];
    let skinned = deform::forward(&deform::Skin {
        positions: &cloud.positions,
        rotations: &cloud.rotations,
        opacity_logits: &cloud.opacity_logits,
        motion_logits: &unused,
        evidence: &unused,
        gaussian_from_dynamic: &ids,
        neighbours: &neighbours,
        k,
        nodes: &nodes,
        log_radii: &log_radii,
        transforms: &transforms,
        soft: false,
    });
    (cloud.positions, cloud.rotations) = (skinned.positions, skinned.rotations);
    cloud.opacity_logits = skinned.opacity_logits;
    cloud
}

/// The image, premultiplied and without background.
pub(super) fn pixels(scene: &Scene, shot: &Shot) -> Pixels<f64> {
    let (cloud, view) = (cloud_at(scene, shot.time), View::new(&shot.camera));
    render::forward(&cloud, &view, &scene.settings).pixels
}

/// The image over the scene's background, three values a pixel.
pub(super) fn image(scene: &Scene, shot: &Shot) -> Vec<f64> {
    let pixels = pixels(scene, shot);
    let background = scene.background.map(f64::from);
    let over = |rgb: &[f64; 3], alpha: f64| -> [f64; 3] {
        std::array::from_fn(|c| rgb[c] + (1.0 - alpha) * background[c])
    };
    pixels.rgb.iter().zip(&pixels.alpha).flat_map(|(rgb, &alpha)| over(rgb, alpha)).collect()
}
