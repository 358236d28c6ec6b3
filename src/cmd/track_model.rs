//! The result of `track` as a COLMAP model.

use std::path::Path;

use splat4d::Result;

use splat4d::data::colmap::{Registered, TrackedPoint, write_model};
use splat4d::data::{Distortion, Lens};
use splat4d::track::{Landmark, StaticPoint, Track};
use splat4d::types::{Image, Pose};

/// Programs that initialise from the points of a model need a sufficient number: with fewer landmarks than
/// this, static points without observations are added.
const FEW: usize = 200;

/// Writes the model; image `i` is named `names[i]`. Positions are in the unit of the supplied poses, else
/// in world units.
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

/// Mean colour of a point over the frames that see it.
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
