//! Where the nodes of a tracked clip's scaffold are at every frame: what control points start from.

use crate::track::Track;
use crate::track::scaffold::Node;
pub(super) use crate::track::scaffold::value;
use crate::types::Camera;

/// Above this a pixel of a mask counts as moving.
pub(super) const MOVING: f32 = 0.5;

/// The camera of a frame.
pub(super) fn camera(track: &Track, frame: usize) -> Camera {
    Camera { intrinsics: track.intrinsics, view_from_world: track.view_from_world[frame] }
}

/// A node's motions from the canonical frame at so many even times over the frames, as
/// [`ControlPoints::paths`](crate::types::ControlPoints::paths) has them.
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
            let motion = [t.x, t.y, t.z, 0.0, q.w - 1.0, q.x, q.y, q.z];
            motion.map(|v| v as f32)
        })
        .collect()
}
