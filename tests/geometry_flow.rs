//! Reconstruction of cameras from real optical flow of a real dynamic scene, with unknown poses and focal
//! length, compared with COLMAP's cameras: a small version of the front end.

use glam::{DMat4, DVec2, DVec3};
use splat4d::eval::{Align, compare_trajectories};
use splat4d::geometry::bundle::{FocalMode, Observation, Options, Point, Problem, adjust};
use splat4d::geometry::focal::{FocalPair, estimate_focal};
use splat4d::geometry::pnp::{PnpOptions, pnp_ransac};
use splat4d::geometry::ransac::RansacOptions;
use splat4d::geometry::se3::angle_between;
use splat4d::geometry::triangulate::inverse_depth;
use splat4d::geometry::two_view::{Motion, TwoViewOptions, fundamental_ransac, two_view};
use splat4d::types::{Intrinsics, Pose};
use std::collections::{BTreeMap, HashMap};
use std::io::Read;
use std::path::{Path, PathBuf};

const WIDTH: usize = 480;
const HEIGHT: usize = 270;
const FRAMES: usize = 12;

#[path = "support/data.rs"]
mod data;

fn clip() -> Option<PathBuf> {
    data::shared_data("nvidia_balloon1")
}

/// The arrays of an `.npz` of 2-channel half floats, by name without `.npy`.
fn flows(path: &Path) -> HashMap<String, Vec<[f32; 2]>> {
    let bytes = std::fs::read(path).unwrap();
    let u16_at = |at: usize| usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
    let u32_at = |at: usize| u16_at(at) + (u16_at(at + 2) << 16);
    // The end record of a zip without comment, then the central directory.
    let end = bytes.len() - 22;
    assert_eq!(u32_at(end), 0x0605_4b50);
    let mut at = u32_at(end + 16);
    let mut out = HashMap::new();
    for _ in 0..u16_at(end + 10) {
        assert_eq!(u32_at(at), 0x0201_4b50);
        let (packed, name) = (u32_at(at + 20), u16_at(at + 28));
        let local = u32_at(at + 42);
        let file = String::from_utf8(bytes[at + 46..at + 46 + name].to_vec()).unwrap();
        let data = local + 30 + u16_at(local + 26) + u16_at(local + 28);
        let mut array = Vec::new();
        flate2::read::DeflateDecoder::new(&bytes[data..data + packed])
            .read_to_end(&mut array)
            .unwrap();
        let header = 10 + usize::from(u16::from_le_bytes([array[8], array[9]]));
        let text = String::from_utf8_lossy(&array[10..header]).into_owned();
        assert!(text.contains("'<f2'") && text.contains("(270, 480, 2)"), "{text}");
        let values = array[header..]
            .chunks(4)
            .map(|c| {
                [half(u16::from_le_bytes([c[0], c[1]])), half(u16::from_le_bytes([c[2], c[3]]))]
            })
            .collect();
        out.insert(file.trim_end_matches(".npy").to_string(), values);
        at += 46 + name + u16_at(at + 30) + u16_at(at + 32);
    }
    out
}

fn half(bits: u16) -> f32 {
    let (sign, exponent, fraction) = (bits >> 15, (bits >> 10) & 31, f32::from(bits & 1023));
    let value = match exponent {
        0 => fraction * 2f32.powi(-24),
        31 => f32::NAN,
        e => (1.0 + fraction / 1024.0) * 2f32.powi(i32::from(e) - 15),
    };
    if sign == 1 { -value } else { value }
}

/// Bilinear sample; `None` outside of the image.
fn sample(flow: &[[f32; 2]], p: DVec2) -> Option<DVec2> {
    let (x, y) = (p.x - 0.5, p.y - 0.5);
    if !(x >= 0.0 && y >= 0.0 && x < (WIDTH - 1) as f64 && y < (HEIGHT - 1) as f64) {
        return None;
    }
    let (i, j) = (x as usize, y as usize);
    let (u, v) = (x - i as f64, y - j as f64);
    let at = |i: usize, j: usize| {
        let f = flow[j * WIDTH + i];
        DVec2::new(f64::from(f[0]), f64::from(f[1]))
    };
    Some(
        (at(i, j) * (1.0 - u) + at(i + 1, j) * u) * (1.0 - v)
            + (at(i, j + 1) * (1.0 - u) + at(i + 1, j + 1) * u) * v,
    )
}

/// A track: the first frame and the pixels from there on, frame by frame. It ends where forward and
/// backward flow disagree.
struct Track {
    first: usize,
    pixels: Vec<DVec2>,
}

fn tracks(flows: &HashMap<String, Vec<[f32; 2]>>, spacing: usize) -> Vec<Track> {
    let mut tracks: Vec<Track> = Vec::new();
    for frame in 0..FRAMES {
        // A new track starts in each cell that no track passes through.
        let (columns, rows) = (WIDTH / spacing, HEIGHT / spacing);
        let mut taken = vec![false; columns * rows];
        for t in tracks.iter().filter(|t| t.first + t.pixels.len() == frame + 1) {
            let p = t.pixels[t.pixels.len() - 1];
            let cell = (p.x as usize / spacing, p.y as usize / spacing);
            if cell.0 < columns && cell.1 < rows {
                taken[cell.1 * columns + cell.0] = true;
            }
        }
        for cell in (0..taken.len()).filter(|&c| !taken[c]) {
            let corner = DVec2::new((cell % columns) as f64, (cell / columns) as f64);
            tracks.push(Track { first: frame, pixels: vec![(corner + 0.5) * spacing as f64] });
        }
        if frame + 1 == FRAMES {
            break;
        }
        let forward = &flows[&format!("{frame:03}_{:03}", frame + 1)];
        let backward = &flows[&format!("{:03}_{frame:03}", frame + 1)];
        for t in tracks.iter_mut().filter(|t| t.first + t.pixels.len() == frame + 1) {
            let p = t.pixels[t.pixels.len() - 1];
            let next = sample(forward, p).map(|f| p + f);
            let back = next.and_then(|q| sample(backward, q).map(|f| q + f));
            if let (Some(q), Some(back)) = (next, back)
                && (back - p).length() < 0.7
            {
                t.pixels.push(q);
            }
        }
    }
    tracks.retain(|t| t.pixels.len() > 1);
    tracks
}

fn at(track: &Track, frame: usize) -> Option<DVec2> {
    frame.checked_sub(track.first).and_then(|k| track.pixels.get(k)).copied()
}

/// The indices of all tracks that exist in both frames, and their pixels.
fn shared(tracks: &[Track], a: usize, b: usize) -> (Vec<usize>, Vec<DVec2>, Vec<DVec2>) {
    let mut out = (vec![], vec![], vec![]);
    for (i, t) in tracks.iter().enumerate() {
        if let (Some(p), Some(q)) = (at(t, a), at(t, b)) {
            out.0.push(i);
            out.1.push(p);
            out.2.push(q);
        }
    }
    out
}

/// COLMAP's focal length at this size, and `world_from_view` (converted from OpenGL axes to OpenCV's).
fn colmap(folder: &Path) -> (f64, Vec<Pose>) {
    let text = std::fs::read_to_string(folder.join("transforms_train.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let focal = json["fl_x"].as_f64().unwrap() * WIDTH as f64 / json["w"].as_f64().unwrap();
    let mut frames: Vec<_> = json["frames"].as_array().unwrap().iter().collect();
    frames.sort_by_key(|f| f["file_path"].as_str().unwrap().to_string());
    let poses = frames
        .iter()
        .map(|f| {
            let rows = f["transform_matrix"].as_array().unwrap();
            let v: Vec<f64> = rows
                .iter()
                .flat_map(|r| r.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()))
                .collect();
            let gl = DMat4::from_cols_slice(&v).transpose();
            Pose::from_matrix(gl * DMat4::from_diagonal(DVec3::new(1.0, -1.0, -1.0).extend(1.0)))
        })
        .collect();
    (focal, poses)
}

#[test]
fn each_pair_of_neighbours_moves_as_colmap_says() {
    let Some(folder) = clip() else { return };
    let flows = flows(&folder.join("flow_raft_480x270_f16.npz"));
    let tracks = tracks(&flows, 10);
    let (focal, truth) = colmap(&folder);
    let k = Intrinsics::centred(focal, WIDTH as u32, HEIGHT as u32);
    let (mut rotations, mut directions) = (Vec::new(), Vec::new());
    for a in 0..FRAMES - 1 {
        let (_, pa, pb) = shared(&tracks, a, a + 1);
        let found = two_view(&pa, &pb, None, &k, &k, &TwoViewOptions::default()).unwrap();
        let motion = truth[a + 1].inverse() * truth[a];
        let rotation = angle_between(found.b_from_a.rotation, motion.rotation).to_degrees();
        let direction = found.b_from_a.translation.angle_between(motion.translation).to_degrees();
        eprintln!(
            "{a}: {:?} {:.2} of {} inliers, rotation off by {rotation:.2}°, direction by \
             {direction:.1}°, parallax {:.1} px",
            found.motion,
            found.inlier_ratio,
            pa.len(),
            found.parallax_px
        );
        assert!(matches!(found.motion, Motion::General | Motion::Planar));
        rotations.push(rotation);
        directions.push(direction);
    }
    rotations.sort_by(f64::total_cmp);
    directions.sort_by(f64::total_cmp);
    // The frames show a moving person and a balloon, and lens distortion is not removed.
    assert!(rotations[5] < 0.5 && rotations[10] < 2.0, "{rotations:?}");
    assert!(directions[5] < 5.0 && directions[10] < 15.0, "{directions:?}");
}

#[test]
fn cameras_of_a_dynamic_scene_from_flow_alone() {
    let Some(folder) = clip() else { return };
    let (true_focal, truth) = colmap(&folder);
    let flows = flows(&folder.join("flow_raft_480x270_f16.npz"));
    let tracks = tracks(&flows, 10);
    let side = WIDTH as f64;

    // Focal length: estimated from frame pairs, else a common prior.
    let mut pairs = Vec::new();
    for (a, b) in (0..FRAMES).flat_map(|a| [(a, a + 1), (a, a + 2)]).filter(|p| p.1 < FRAMES) {
        let (_, pa, pb) = shared(&tracks, a, b);
        let pixels: Vec<_> = pa.into_iter().zip(pb).collect();
        if let Some(found) = fundamental_ransac(&pixels, &RansacOptions::default()) {
            let pixels = found.inliers.iter().map(|&i| pixels[i]).collect();
            pairs.push(FocalPair { fundamental: found.model, pixels });
        }
    }
    let estimate =
        estimate_focal(&pairs, WIDTH as u32, HEIGHT as u32, &Default::default()).unwrap();
    eprintln!(
        "focal {:.0} ± {:.3} ({}), COLMAP {true_focal:.0}",
        estimate.focal,
        estimate.relative_std,
        if estimate.observable { "observable" } else { "not observable" }
    );
    let focal = if estimate.observable { estimate.focal } else { 1.1 * side };
    let k = Intrinsics::centred(focal, WIDTH as u32, HEIGHT as u32);

    // Start: frames 0 and 2, all tracks that begin in frame 0.
    let (ids, pa, pb) = shared(&tracks, 0, 2);
    let start = two_view(&pa, &pb, None, &k, &k, &TwoViewOptions::default()).unwrap();
    let mut poses: Vec<Option<Pose>> = vec![None; FRAMES];
    poses[0] = Some(Pose::IDENTITY);
    poses[2] = Some(start.b_from_a);
    let mut depths: BTreeMap<usize, f64> = BTreeMap::new();
    for (n, &i) in ids.iter().enumerate().filter(|(n, _)| start.inliers[*n]) {
        if let Some(d) = inverse_depth(&k, pa[n], &[(start.b_from_a, pb[n], 1.0)], 1.0) {
            depths.insert(i, d.value);
        }
    }
    // Frame by frame: its pose by PnP on the known points, then the depths of tracks that it makes
    // observable, then a short adjustment of all frames so far.
    let mut k = k;
    for frame in [1].into_iter().chain(3..FRAMES) {
        let (mut world, mut pixels) = (Vec::new(), Vec::new());
        for (&i, &d) in depths.iter().filter(|(_, d)| **d > 1e-6) {
            let (track, pixel) = (&tracks[i], at(&tracks[i], frame));
            if let (Some(pixel), Some(reference)) = (pixel, poses[track.first]) {
                world.push(reference.inverse().apply(k.ray(track.pixels[0]) / d));
                pixels.push(pixel);
            }
        }
        let options = PnpOptions::for_width(WIDTH as u32);
        let found = pnp_ransac(&world, &pixels, None, &k, None, &options).unwrap();
        poses[frame] = Some(found.view_from_world);
        let last = frame == FRAMES - 1;
        let mut problem = gather(&tracks, &poses, &depths, &k);
        let focal = if last { FocalMode::Gated(0.05) } else { FocalMode::Fixed };
        let report = adjust(&mut problem.0, &Options { focal, ..Default::default() }).unwrap();
        eprintln!(
            "frame {frame}: PnP {:.2} of {}, adjusted to {:.2} px on {:.2} of {} observations",
            found.inlier_ratio,
            world.len(),
            report.inlier_rmse,
            report.inlier_ratio,
            problem.0.observations.len()
        );
        let posed: Vec<usize> = (0..FRAMES).filter(|&f| poses[f].is_some()).collect();
        for (place, &f) in posed.iter().enumerate() {
            poses[f] = Some(problem.0.poses[place]);
        }
        for (point, &i) in problem.0.points.iter().zip(&problem.1) {
            depths.insert(i, point.inverse_depth);
        }
        k = problem.0.intrinsics;
        if last {
            eprintln!(
                "focal {:.1} ± {:.4}, released: {}",
                k.fx, report.focal_std, report.focal_released
            );
        }
    }
    let estimate: Vec<Pose> = poses.iter().map(|p| p.unwrap().inverse()).collect();
    let errors = compare_trajectories(&estimate, &truth, Align::Sim3).unwrap();
    eprintln!(
        "ATE {:.4} of the path's length, RPE rotation {:.3}°, focal off by {:.3}",
        errors.ate_relative,
        errors.rpe_rot_deg.rmse,
        k.fx / true_focal - 1.0
    );
    assert!(errors.ate_relative < 0.02, "{}", errors.ate_relative);
    assert!(errors.rpe_rot_deg.rmse < 1.0, "{}", errors.rpe_rot_deg.rmse);
}

/// The adjustment of all frames that have a pose, and the track behind each of its points. Tracks
/// without a depth get one from the frames that have a pose.
fn gather(
    tracks: &[Track],
    poses: &[Option<Pose>],
    depths: &BTreeMap<usize, f64>,
    k: &Intrinsics,
) -> (Problem, Vec<usize>) {
    let posed: Vec<usize> = (0..FRAMES).filter(|&f| poses[f].is_some()).collect();
    let place = |f: usize| posed.iter().position(|&p| p == f);
    let mut problem = Problem {
        intrinsics: *k,
        k1: 0.0,
        poses: posed.iter().map(|&f| poses[f].unwrap()).collect(),
        fixed: posed.iter().map(|&f| f == 0).collect(),
        points: Vec::new(),
        observations: Vec::new(),
    };
    let mut origin = Vec::new();
    for (i, track) in tracks.iter().enumerate() {
        let Some(first) = place(track.first) else { continue };
        let seen: Vec<(usize, DVec2)> = (1..track.pixels.len())
            .filter_map(|n| place(track.first + n).map(|f| (f, track.pixels[n])))
            .collect();
        let reference = problem.poses[first].inverse();
        let views: Vec<_> =
            seen.iter().map(|&(f, pixel)| (problem.poses[f] * reference, pixel, 1.0)).collect();
        let depth = depths
            .get(&i)
            .copied()
            .or_else(|| inverse_depth(k, track.pixels[0], &views, 1.0).map(|d| d.value));
        let Some(inverse_depth) = depth.filter(|_| !seen.is_empty()) else { continue };
        let point = problem.points.len();
        problem.points.push(Point {
            frame: first,
            pixel: track.pixels[0],
            inverse_depth,
            prior: None,
        });
        origin.push(i);
        for (frame, pixel) in seen {
            problem.observations.push(Observation {
                point,
                frame,
                pixel,
                weight: 1.0,
                deviation: 1.0,
            });
        }
    }
    (problem, origin)
}
