//! The camera path on maps from above and from the side.

use std::fmt::Write;

use glam::DVec3;
use splat4d::track::Track;
use splat4d::types::{Intrinsics, Pose};

use super::charts::{self, Map, Placed};

/// Maximum number of static points on a map.
const CLOUD: usize = 1500;

/// The cameras of a map, and the points that they see.
pub struct Cameras<'a> {
    /// World to camera.
    pub poses: &'a [Pose],
    /// Intrinsics of one of them.
    pub intrinsics: &'a Intrinsics,
    /// Points in the world.
    pub points: Vec<DVec3>,
    /// Indices of cameras with a large uncertainty.
    pub doubtful: &'a [usize],
    /// Whether the cameras have more than one position.
    pub travels: bool,
}

/// Adds the section about the cameras of a tracked clip to a page. `poses` are world to camera; their
/// `unit` corresponds to `track.unit` units of the track.
pub fn section(body: &mut String, track: &Track, poses: &[Pose], unit: &str) {
    body.push_str("<h2>Where the camera went</h2>\n");
    if track.quality.tripod {
        body.push_str("<p>The camera is fixed: it has one place and looks in one direction.</p>\n");
    }
    if track.quality.turns {
        body.push_str("<p>The camera turns in place: it has one place.</p>\n");
    }
    let points = track.points.iter().map(|point| track.unit * point.position);
    let cameras = Cameras {
        poses,
        intrinsics: &track.intrinsics,
        points: thinned(points),
        doubtful: &track.quality.doubtful_frames,
        travels: !track.quality.tripod && !track.quality.turns,
    };
    maps(body, &cameras, unit, "static points");
    body.push_str(
        "<p>The line is the camera's path from its first frame (disc) to its last (square); \
         triangles are what it sees from some of them. Up is the mean upward direction of the images. Of \
         the points, those within the middle nine tenths along each axis are shown.</p>\n",
    );
}

/// A subset of the points for a map.
pub fn thinned(points: impl ExactSizeIterator<Item = DVec3>) -> Vec<DVec3> {
    let every = points.len().div_ceil(CLOUD).max(1);
    points.step_by(every).collect()
}

/// Maps from above and from the side, with points that the caption calls `with`; if there are points, also
/// maps of the path alone.
pub fn maps(body: &mut String, shown: &Cameras, unit: &str, with: &str) {
    let Cameras { poses, intrinsics: k, doubtful, travels, .. } = shown;
    let axes = Axes::of(poses);
    let [right, ahead, up] =
        ["right", "ahead", "up"].map(|direction| format!("{direction} ({unit})"));
    let points: Vec<DVec3> = shown.points.iter().map(|point| axes.of_world(*point)).collect();
    let cameras: Vec<(DVec3, DVec3)> = poses
        .iter()
        .map(|pose| {
            let world_from_view = pose.inverse();
            (
                axes.of_world(world_from_view.translation),
                axes.of_world(world_from_view.rotation * DVec3::Z),
            )
        })
        .collect();
    let across = 0.5 * f64::from(k.width) / k.fx;
    let along = 0.5 * f64::from(k.height) / k.fy;
    let above = |v: DVec3| [v.x, v.z];
    let side = |v: DVec3| [v.z, v.y];
    body.push_str("<div class=\"grid-of maps\">");
    let mut map = |title: &str,
                   axes: [&str; 2],
                   spread: f64,
                   is_full: bool,
                   flat: &dyn Fn(DVec3) -> [f64; 2]| {
        let placed = |(i, (at, looks)): (usize, &(DVec3, DVec3))| Placed {
            at: flat(*at),
            looks: flat(*looks),
            spread,
            doubtful: doubtful.contains(&i),
        };
        let placed: Vec<Placed> = cameras.iter().enumerate().map(placed).collect();
        let flat_points = || inner(points.iter().map(|p| flat(*p)).collect());
        let points = if is_full { flat_points() } else { Vec::new() };
        let drawn = charts::map(&Map { title, axes, cameras: &placed, points: &points });
        let _ = write!(body, "<figure><h3>{title}</h3>{drawn}</figure>");
    };
    let with = if points.is_empty() { String::new() } else { format!(", with {with}") };
    map(&format!("From above{with}"), [&right, &ahead], across, true, &above);
    map(&format!("From the side{with}"), [&ahead, &up], along, true, &side);
    if *travels && !points.is_empty() {
        map("The path alone, from above", [&right, &ahead], across, false, &above);
        map("The path alone, from the side", [&ahead, &up], along, false, &side);
    }
    body.push_str("</div>\n");
}

/// Axes of a map: the cameras' mean right, up and forward directions.
struct Axes {
    right: DVec3,
    up: DVec3,
    ahead: DVec3,
}

impl Axes {
    fn of(poses: &[Pose]) -> Axes {
        let mean =
            |axis: DVec3| poses.iter().map(|pose| pose.inverse().rotation * axis).sum::<DVec3>();
        let up = (-mean(DVec3::Y)).try_normalize().unwrap_or(DVec3::NEG_Y);
        // Cameras that look in all directions have no common one; the first camera's is used.
        let first = poses.first().map_or(DVec3::Z, |pose| pose.inverse().rotation * DVec3::Z);
        let ahead = [mean(DVec3::Z), first]
            .into_iter()
            .find_map(|v| v.reject_from_normalized(up).try_normalize())
            .unwrap_or_else(|| up.any_orthonormal_vector());
        Axes { right: ahead.cross(up), up, ahead }
    }

    /// A position or a direction as (right, up, ahead).
    fn of_world(&self, v: DVec3) -> DVec3 {
        DVec3::new(v.dot(self.right), v.dot(self.up), v.dot(self.ahead))
    }
}

/// Points within the middle nine tenths along both axes, because a few distant ones would leave the map
/// nearly empty.
fn inner(points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    let limits = [0, 1].map(|axis| {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().saturating_sub(1);
        let at = |share: usize| values.get(last * share / 20).copied().unwrap_or(0.0);
        (at(1), at(19))
    });
    let inside = |p: &[f64; 2]| [0, 1].iter().all(|&i| (limits[i].0..=limits[i].1).contains(&p[i]));
    points.into_iter().filter(inside).collect()
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn maps_are_seen_as_cameras_see() {
        let poses = [Pose::IDENTITY, Pose::new(DQuat::IDENTITY, DVec3::new(-1.0, 0.0, -2.0))];
        let axes = Axes::of(&poses);
        // The second camera is to the right of the first and ahead of it; y points down.
        let at = axes.of_world(poses[1].inverse().translation);
        assert!(at.abs_diff_eq(DVec3::new(1.0, 0.0, 2.0), 1e-12), "{at}");
        assert!(axes.of_world(DVec3::Y).abs_diff_eq(DVec3::NEG_Y, 1e-12));
        // For cameras that look in opposite directions, the first one determines the axes.
        let turned = Pose::new(DQuat::from_rotation_y(std::f64::consts::PI), DVec3::ZERO);
        let axes = Axes::of(&[Pose::IDENTITY, turned]);
        assert!(axes.ahead.is_finite() && axes.up.abs_diff_eq(DVec3::NEG_Y, 1e-9));
    }

    #[test]
    fn far_points_are_left_out() {
        let mut points: Vec<[f64; 2]> = (0..100).map(|i| [f64::from(i), 1.0]).collect();
        points[50] = [50.0, 1e9];
        let kept = inner(points);
        assert_eq!(kept.len(), 90);
        assert!(kept.iter().all(|p| p[1] == 1.0));
        assert!(inner(Vec::new()).is_empty());
    }
}
