//! Selects static points, spread over everything that the cameras saw, without duplicates.

use glam::{DVec2, DVec3};

use super::StaticPoint;
use super::cameras::Cameras;
use crate::types::{Image, Pose};

/// Relative difference in depth within which a point counts as seen already by a frame that points were taken
/// from.
const SAME_DEPTH: f64 = 0.05;
/// Maximum number of frames that points are taken from.
const FRAMES: usize = 16;
/// Minimum distance of points from the motion mask, pixels, because its edge is not exact.
const MARGIN: usize = 2;

/// Takes points from frames over the whole clip: first measured points, then, at half the density along each
/// axis, filled-in points where no measured point covers them. Returns at most `most` points.
pub(super) fn gather(
    frames: &[Image],
    cameras: &Cameras,
    depth: &[Image],
    confidence: &[Image],
    masks: &[Image],
    most: usize,
) -> Vec<StaticPoint> {
    let n = frames.len();
    let (w, h) = (frames[0].width as i64, frames[0].height as i64);
    let count = FRAMES.min(n);
    // The order is first, last, middle, then the frames between: the first ones cover most of the scene, the
    // later ones add to it.
    let mut order: Vec<usize> = vec![0, n - 1];
    let mut parts = 2;
    while order.len() < count && parts <= 2 * n {
        for k in (1..parts).step_by(2) {
            let f = k * (n - 1) / parts;
            if order.len() < count && !order.contains(&f) {
                order.push(f);
            }
        }
        parts *= 2;
    }
    // Apart from movers, neighbouring frames see mostly the same, so the stride allows two images' worth of
    // points.
    let stride = (2.0 * (w * h) as f64 / most.max(1) as f64).sqrt().ceil().max(1.0) as i64;
    let near_movers: Vec<Vec<bool>> = order.iter().map(|f| masks[*f].near(MARGIN)).collect();
    let mut points = Vec::new();
    for measured in [true, false] {
        let step = if measured { stride } else { 2 * stride };
        let mut taken: Vec<usize> = Vec::new();
        for (&f, near_movers) in order.iter().zip(&near_movers) {
            let world_from_view: Pose = cameras.poses[f].inverse();
            for y in (step / 2..h).step_by(step as usize) {
                for x in (step / 2..w).step_by(step as usize) {
                    let sure = confidence[f].at(x as u32, y as u32)[0];
                    if (sure > 0.5 || !cameras.have_parallax()) != measured
                        || near_movers[(y * w + x) as usize]
                    {
                        continue;
                    }
                    let z = f64::from(depth[f].at(x as u32, y as u32)[0]);
                    let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    let position = world_from_view.apply(cameras.intrinsics.ray(pixel) * z);
                    let seen = if measured { &taken[..] } else { &order[..] };
                    let covered = seen.iter().any(|&other| {
                        (measured || other != f)
                            && covers(cameras, depth, confidence, other, position, measured)
                    });
                    let doubled = !measured
                        && taken
                            .iter()
                            .any(|&o| covers(cameras, depth, confidence, o, position, true));
                    if covered || doubled || points.len() >= most {
                        continue;
                    }
                    let c = frames[f].at(x as u32, y as u32);
                    points.push(StaticPoint {
                        position,
                        colour: [c[0], c[1], c[2]],
                        frame: f,
                        deviation: if sure > 0.5 { 0.35 * 2.0 * (1.0 - sure) } else { 1.0 },
                    });
                }
            }
            taken.push(f);
        }
    }
    points
}

/// Whether a frame sees a point at that frame's own depth. For a filled-in point (`compare` is false) it is
/// enough that the frame has a measured depth along that ray.
fn covers(
    cameras: &Cameras,
    depth: &[Image],
    confidence: &[Image],
    frame: usize,
    position: DVec3,
    compare: bool,
) -> bool {
    let p = cameras.poses[frame].apply(position);
    if p.z <= 0.0 {
        return false;
    }
    let pixel = cameras.intrinsics.project(p);
    let k = &cameras.intrinsics;
    let inside = pixel.x >= 0.0
        && pixel.y >= 0.0
        && pixel.x < f64::from(k.width)
        && pixel.y < f64::from(k.height);
    if !inside {
        return false;
    }
    let (x, y) = (pixel.x as u32, pixel.y as u32);
    let z = f64::from(depth[frame].at(x, y)[0]);
    if compare { (z / p.z).ln().abs() < SAME_DEPTH } else { confidence[frame].at(x, y)[0] > 0.5 }
}

#[cfg(test)]
mod tests {
    use super::super::sliding::FRAMES;
    use super::super::sliding::*;
    use super::*;

    #[test]
    fn what_several_frames_see_is_taken_once_and_movers_never() {
        let cameras = cameras(STEP);
        let wall = vec![map(|_| WALL as f32); FRAMES];
        let sure = vec![map(|_| 0.9); FRAMES];
        let mover = |frame: usize| {
            map(move |p| {
                let x = 30.0 + frame as f64;
                f32::from(u8::from(within(p, (x, 10.0), (x + 10.0, 30.0))))
            })
        };
        let nothing = vec![map(|_| 0.0); FRAMES];
        let gathered = gather(&frames(), &cameras, &wall, &sure, &nothing, 5120);
        // The stride is one pixel, because two images' worth of points fit. The first frame gives all of its
        // pixels, the last one the ten columns that only it sees, and those between add nothing.
        let (w, h) = (WIDTH as usize, HEIGHT as usize);
        assert_eq!(gathered.len(), (w + 10) * h);
        assert!(gathered.iter().all(|p| (p.position.z - WALL).abs() < 1e-6 && p.frame != 2));
        let masks: Vec<Image> = (0..FRAMES).map(mover).collect();
        for point in gather(&frames(), &cameras, &wall, &sure, &masks, 5120) {
            let p = cameras.poses[point.frame].apply(point.position);
            let x = 30.0 + point.frame as f64;
            let pixel = cameras.intrinsics.project(p);
            assert!(!within(pixel, (x - 1.5, 8.5), (x + 11.5, 31.5)), "{pixel}");
        }
        assert!(gather(&frames(), &cameras, &wall, &sure, &nothing, 100).len() <= 100);
    }
}
