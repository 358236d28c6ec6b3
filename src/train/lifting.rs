//! Cameras of a tracked clip, and the paths of its scaffold's nodes, which initialise the control
//! points.

use super::windows::Window;
use crate::track::Track;
use crate::track::scaffold::Node;
pub(super) use crate::track::scaffold::value;
use crate::types::{Camera, ControlPoints};

/// Mask value above which a pixel counts as moving.
pub(super) const MOVING: f32 = 0.5;

/// The camera of a frame.
pub(super) fn camera(track: &Track, frame: usize) -> Camera {
    Camera { intrinsics: track.intrinsics, view_from_world: track.view_from_world[frame] }
}

/// A node's motions from its canonical position in a window, at `keys` evenly spaced times over the
/// frames, laid out as in [`ControlPoints::paths`]. The node is absent outside the window's frames and,
/// with `lifespans`, outside its own life.
pub(super) fn path(node: &Node, window: &Window, keys: usize, lifespans: bool) -> Vec<[f32; 8]> {
    let poses = &node.world_from_node;
    let (last, origin) = (poses.len() - 1, poses[window.canonical]);
    let place = window.place(node);
    let is_there =
        |frame| window.frames.contains(&frame) && (!lifespans || node.alive.contains(&frame));
    let mut before = glam::DQuat::IDENTITY;
    (0..keys)
        .map(|key| {
            let moment = last as f64 * key as f64 / (keys.max(2) - 1) as f64;
            let frame = (moment as usize).min(last);
            let next = (frame + 1).min(last);
            let u = moment - frame as f64;
            let t = poses[frame].translation.lerp(poses[next].translation, u) - place;
            let turned = poses[frame].rotation.slerp(poses[next].rotation, u);
            let q = turned * origin.rotation.conjugate();
            // Of the two quaternions of the rotation, this takes the one in the hemisphere of the
            // previous key's.
            let q = if q.dot(before) < 0.0 { -q } else { q };
            before = q;
            let alive = is_there(frame) || (u > 0.0 && is_there(next));
            let fade = if alive { 0.0 } else { f64::from(ControlPoints::ABSENT) };
            let motion = [t.x, t.y, t.z, fade, q.w - 1.0, q.x, q.y, q.z];
            motion.map(|v| v as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::windows::Holds;
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
        let window = |frames| Window {
            frames,
            canonical: 4,
            offset: DVec3::new(7.0, 0.0, 0.0),
            holds: Holds::All,
        };
        let fades = |frames, keys: usize, lifespans| -> Vec<f32> {
            let path = path(&node, &window(frames), keys, lifespans);
            path.iter().for_each(|key| assert!(key[0].is_finite() && key[1] == 0.0));
            // Relative to its canonical position, 7 to the right of its position in frame 4.
            assert_eq!((path[0][0], path[keys - 1][0]), (-11.0, -3.0));
            path.iter().map(|key| key[3]).collect()
        };
        let gone = ControlPoints::ABSENT;
        assert_eq!(fades(0..9, 9, true), [gone, gone, gone, 0.0, 0.0, 0.0, gone, gone, gone]);
        // A key between a frame in which the node is alive and one in which it is not.
        assert_eq!(fades(0..9, 4, true), [gone, 0.0, 0.0, gone]);
        // It is absent outside its window, too.
        assert_eq!(fades(4..9, 9, true)[..5], [gone, gone, gone, gone, 0.0]);
        assert_eq!(fades(4..9, 9, false), [gone, gone, gone, gone, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }
}
