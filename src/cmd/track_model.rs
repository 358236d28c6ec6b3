//! What `track` found as a COLMAP model.

use std::path::Path;

use splat4d::Result;

use splat4d::data::colmap::{Registered, TrackedPoint, write_model};
use splat4d::data::{Distortion, Lens};
use splat4d::track::{Landmark, StaticPoint, Track};
use splat4d::types::{Image, Pose};

/// Programs that begin with the points of a model need some: with fewer landmarks than this, static points
/// that no image is said to have seen stand beside them.
const FEW: usize = 200;

/// Writes the model; image `i` is called `names[i]`. Positions are in the unit of the poses that were
/// supplied, else in the world's.
pub fn write(
    folder: &Path,
    names: &[String],
    frames: &[Image],
    poses: &[Pose],
    track: &Track,
    landmarks: &[Landmark],
) -> Result<()> {
    let lens = Lens { intrinsics: track.intrinsics, distortion: Distortion::default() };
    let image = |(name, pose): (&String, &Pose)| Registered {
        name: name.clone(),
        camera: 1,
        view_from_world: *pose,
    };
    let images: Vec<Registered> = names.iter().zip(poses).map(image).collect();
    let seen = |landmark: &Landmark| TrackedPoint {
        position: track.unit * landmark.position,
        colour: colour(landmark, frames),
        error: Some(landmark.error),
        observations: landmark.observations.clone(),
    };
    let mut points: Vec<TrackedPoint> = landmarks.iter().map(seen).collect();
    if points.len() < FEW {
        let unseen = |point: &StaticPoint| TrackedPoint {
            position: track.unit * point.position,
            colour: point.colour,
            error: None,
            observations: Vec::new(),
        };
        points.extend(track.points.iter().map(unseen));
    }
    write_model(folder, &[(1, lens)], &images, &points)
}

/// The mean of what the frames show of a point.
fn colour(landmark: &Landmark, frames: &[Image]) -> [f32; 3] {
    let mut mean = [0.0; 3];
    for (frame, pixel) in &landmark.observations {
        let image = &frames[*frame];
        let at = |v: f64, side: u32| (v.max(0.0) as u32).min(side - 1);
        let shown = image.at(at(pixel.x, image.width), at(pixel.y, image.height));
        let count = landmark.observations.len() as f32;
        mean.iter_mut().zip(shown).for_each(|(mean, v)| *mean += v / count);
    }
    mean
}
