//! Where the nodes of a tracked clip's scaffold are at every frame: what control points start from.

use crate::track::Track;
use crate::track::scaffold::Node;
pub(super) use crate::track::scaffold::value;
use crate::types::{Camera, ControlPoints};

/// Above this a pixel of a mask counts as moving.
pub(super) const MOVING: f32 = 0.5;

/// The camera of a frame.
pub(super) fn camera(track: &Track, frame: usize) -> Camera {
    Camera { intrinsics: track.intrinsics, view_from_world: track.view_from_world[frame] }
}

/// A node's motions from the canonical frame at so many even times over the frames, as
/// [`ControlPoints::paths`] has them.
pub(super) fn path(node: &Node, canonical: usize, keys: usize) -> Vec<[f32; 8]> {
    let poses = &node.world_from_node;
    let (last, origin) = (poses.len() - 1, poses[canonical]);
    let mut before = glam::DQuat::IDENTITY;
    (0..keys)
        .map(|key| {
            let place = last as f64 * key as f64 / (keys.max(2) - 1) as f64;
            let frame = (place as usize).min(last);
            let next = (frame + 1).min(last);
            let u = place - frame as f64;
            let t = poses[frame].translation.lerp(poses[next].translation, u) - origin.translation;
            let turned = poses[frame].rotation.slerp(poses[next].rotation, u);
            let q = turned * origin.rotation.conjugate();
            // Of the two quaternions of a rotation the one on the side of the key before.
            let q = if q.dot(before) < 0.0 { -q } else { q };
            before = q;
            let alive = node.alive.contains(&frame) || (u > 0.0 && node.alive.contains(&next));
            let fade = if alive { 0.0 } else { f64::from(ControlPoints::ABSENT) };
            let motion = [t.x, t.y, t.z, fade, q.w - 1.0, q.x, q.y, q.z];
            motion.map(|v| v as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Pose;
    use glam::{DQuat, DVec3};

    #[test]
    fn a_node_is_absent_before_and_after_its_life() {
        let pose = |f: u32| Pose::new(DQuat::IDENTITY, DVec3::X * f64::from(f));
        let node = Node {
            owner: 1,
            world_from_node: (0..9).map(pose).collect(),
            spacing: 0.1,
            alive: 3..6,
        };
        let fades = |keys: usize| -> Vec<f32> {
            let path = path(&node, 4, keys);
            path.iter().for_each(|key| assert!(key[0].is_finite() && key[1] == 0.0));
            path.iter().map(|key| key[3]).collect()
        };
        let gone = ControlPoints::ABSENT;
        assert_eq!(fades(9), [gone, gone, gone, 0.0, 0.0, 0.0, gone, gone, gone]);
        // A key between a frame in which it is there and one in which it is not.
        assert_eq!(fades(4), [gone, 0.0, 0.0, gone]);
    }
}
