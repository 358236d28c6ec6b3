//! Synthetic clips: the ground truth agrees with the pixels, with itself, and with the clips' names.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex};

use glam::DVec2;
use splat4d::data::synth::{self, Clip, SynthOptions};
use splat4d::data::{Dataset, exr, flo, images, intrinsics, read_mask, trajectory, transforms};
use splat4d::types::Image;

/// A small clip, whose steps between frames are several times the usual.
const SMALL: SynthOptions = SynthOptions { frames: 5, width: 96, height: 54, seed: 3 };

/// A clip with steps between frames as at the usual length and size.
const SMOOTH: SynthOptions = SynthOptions { frames: 12, width: 144, height: 81, seed: 1 };

/// Each clip is rendered once for all tests.
fn rendered(name: &str, options: SynthOptions) -> Arc<Clip> {
    static CLIPS: LazyLock<Mutex<HashMap<String, Arc<Clip>>>> = LazyLock::new(Default::default);
    let mut clips = CLIPS.lock().unwrap();
    let render = || Arc::new(synth::clip(name, &options).unwrap());
    clips.entry(format!("{name} {options:?}")).or_insert_with(render).clone()
}

fn small(name: &str) -> Arc<Clip> {
    rendered(name, SMALL)
}

fn mean(image: &Image) -> f64 {
    image.pixels.iter().map(|v| f64::from(*v)).sum::<f64>() / image.pixels.len() as f64
}

/// Bilinear sample, with pixel centres at +0.5; `None` if a neighbour is outside the image.
fn sample(image: &Image, at: DVec2, channel: usize) -> Option<f64> {
    let (x, y) = (at.x - 0.5, at.y - 0.5);
    let (left, top) = (x.floor(), y.floor());
    let inside = left >= 0.0
        && top >= 0.0
        && left + 1.0 < f64::from(image.width)
        && top + 1.0 < f64::from(image.height);
    if !inside {
        return None;
    }
    let value = |dx, dy| f64::from(image.at(left as u32 + dx, top as u32 + dy)[channel]);
    let (a, b) = (x - left, y - top);
    let upper = value(0, 0) * (1.0 - a) + value(1, 0) * a;
    let lower = value(0, 1) * (1.0 - a) + value(1, 1) * a;
    Some(upper * (1.0 - b) + lower * b)
}

fn centres(image: &Image) -> impl Iterator<Item = (u32, u32, DVec2)> {
    let (width, height) = (image.width, image.height);
    (0..height).flat_map(move |y| {
        (0..width).map(move |x| (x, y, DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
    })
}

fn vector(flow: &Image, x: u32, y: u32) -> DVec2 {
    let [u, v] = flow.at(x, y) else { panic!("a flow field has two channels") };
    DVec2::new(f64::from(*u), f64::from(*v))
}

/// Mean absolute grey difference between a frame and its neighbour warped back by flow, over the pixels
/// whose point is visible in both; and the same without flow.
fn warp_error(from: &Image, to: &Image, flow: &Image, visible: &Image) -> (f64, f64) {
    let (mut with, mut without, mut count) = (0.0, 0.0, 0.0);
    for (x, y, centre) in centres(from) {
        if visible.at(x, y)[0] == 0.0 {
            continue;
        }
        let green = f64::from(from.at(x, y)[1]);
        let Some(there) = sample(to, centre + vector(flow, x, y), 1) else { continue };
        with += (there - green).abs();
        without += (f64::from(to.at(x, y)[1]) - green).abs();
        count += 1.0;
    }
    (with / count, without / count)
}

#[test]
fn flow_brings_the_next_frame_back() {
    for name in ["rigid", "bend", "crowd", "still"] {
        let clip = rendered(name, SMOOTH);
        for (i, j, flow, visible) in [
            (5, 6, &clip.flow_forward[5], &clip.visible_forward[5]),
            (6, 5, &clip.flow_backward[5], &clip.visible_backward[5]),
        ] {
            let (with, without) = warp_error(&clip.frames[i], &clip.frames[j], flow, visible);
            assert!(with < 0.02, "{name}: frame {j} warped to {i} is off by {with}");
            assert!(with < 0.5 * without, "{name}: {with} with flow, {without} without");
        }
    }
}

#[test]
fn static_flow_is_what_depth_and_poses_say() {
    for name in synth::NAMES {
        let clip = small(name);
        let k = clip.intrinsics;
        for i in 0..clip.flow_forward.len() {
            for (from, to, flow) in
                [(i, i + 1, &clip.flow_forward[i]), (i + 1, i, &clip.flow_backward[i])]
            {
                let to_from = clip.view_from_world[to] * clip.view_from_world[from].inverse();
                for (x, y, centre) in centres(flow) {
                    if clip.masks[from].at(x, y)[0] != 0.0 {
                        continue;
                    }
                    let depth = f64::from(clip.depth[from].at(x, y)[0]);
                    let there = k.project(to_from.apply(k.ray(centre) * depth));
                    let off = (there - centre - vector(flow, x, y)).length();
                    // Depth is stored as f32: its relative error of 1e-7 is multiplied by a shift of tens
                    // of pixels.
                    assert!(off < 1e-4, "{name} {from}→{to} ({x}, {y}): {off} pixels apart");
                }
            }
        }
    }
}

#[test]
fn flow_there_and_back_closes() {
    for name in ["bend", "crowd"] {
        let clip = rendered(name, SMOOTH);
        let (forward, backward) = (&clip.flow_forward[5], &clip.flow_backward[5]);
        let mut gaps = Vec::new();
        for (x, y, centre) in centres(forward) {
            let moving = clip.masks[5].at(x, y)[0] == 1.0;
            if !moving || clip.visible_forward[5].at(x, y)[0] == 0.0 {
                continue;
            }
            let there = centre + vector(forward, x, y);
            if let (Some(u), Some(v)) = (sample(backward, there, 0), sample(backward, there, 1)) {
                gaps.push((there + DVec2::new(u, v) - centre).length());
            }
        }
        gaps.sort_by(f64::total_cmp);
        // The largest tenth is excluded: there the four neighbours are on both sides of an outline.
        let most = gaps[gaps.len() * 9 / 10];
        assert!(gaps.len() > 500 && most < 0.1, "{name}: {} pixels, {most}", gaps.len());
    }
}

#[test]
fn visibility_tells_hidden_points() {
    let clip = small("rigid");
    // Static points of the background are occluded by the cart as it moves.
    let hidden = centres(&clip.masks[1])
        .filter(|&(x, y, centre)| {
            let flow = &clip.flow_forward[1];
            let to = centre + vector(flow, x, y);
            let inside = to.x >= 0.0
                && to.y >= 0.0
                && to.x < f64::from(SMALL.width)
                && to.y < f64::from(SMALL.height);
            inside && clip.visible_forward[1].at(x, y)[0] == 0.0
        })
        .count();
    let seen = mean(&clip.visible_forward[1]);
    assert!(hidden > 20, "{hidden} hidden inside the picture");
    assert!((0.6..0.99).contains(&seen), "{seen} of the picture stays seen");
}

#[test]
fn movers_cover_what_the_clip_promises() {
    for seed in 0..3 {
        for (name, least, most, farthest) in [
            ("rigid", 0.05, 0.14, 9.0),
            ("bend", 0.08, 0.25, 9.0),
            ("crowd", 0.5, 0.85, 9.0),
            ("still", 0.0, 0.0, 9.0),
            ("tripod", 0.05, 0.14, 9.0),
            ("throw", 0.02, 0.08, 9.0),
            ("hold", 0.04, 0.2, 9.0),
            ("walk", 0.03, 0.1, 9.0),
            ("pan", 0.06, 0.25, 40.0),
            ("follow", 0.06, 0.25, 40.0),
        ] {
            let options = SynthOptions { frames: 3, width: 48, height: 27, seed };
            let clip = synth::clip(name, &options).unwrap();
            for (i, mask) in clip.masks.iter().enumerate() {
                let share = mean(mask);
                assert!(mask.pixels.iter().all(|v| *v == 0.0 || *v == 1.0));
                assert!(share >= least && share <= most, "{name}, seed {seed}, {i}: {share}");
            }
            // The room is closed: every ray hits a surface, and none is very close to the camera.
            let depths = clip.depth.iter().flat_map(|d| &d.pixels);
            assert!(depths.clone().all(|d| *d > 1.0 && *d < farthest), "{name}, seed {seed}");
        }
    }
}

#[test]
fn the_cart_crosses_a_part_of_the_picture() {
    for seed in 0..3 {
        let options = SynthOptions { frames: 2, width: 64, height: 36, seed };
        let clip = synth::clip("rigid", &options).unwrap();
        let [first, last] = [0, 1].map(|i: usize| {
            let mask = &clip.masks[i];
            let sum: f64 = centres(mask).map(|(x, y, c)| c.x * f64::from(mask.at(x, y)[0])).sum();
            sum / (mean(mask) * 64.0 * 36.0)
        });
        let share = (last - first).abs() / 64.0;
        assert!((0.2..0.45).contains(&share), "seed {seed}: {share} of the width");
    }
}

#[test]
fn cameras_move_as_the_clip_says() {
    for seed in 0..3 {
        let options = SynthOptions { frames: 24, width: 16, height: 16, seed };
        let still = synth::clip("still", &options).unwrap();
        let mut depths = still.depth[12].pixels.clone();
        depths.sort_by(f32::total_cmp);
        let depth = f64::from(depths[depths.len() / 2]);
        let centres: Vec<_> = (0..24).map(|i| still.camera(i).centre()).collect();
        let length: f64 = centres.windows(2).map(|c| c[0].distance(c[1])).sum();
        let share = length / depth;
        assert!((0.1..0.25).contains(&share), "seed {seed}: path of {share} of the depth");
        assert_eq!(still.held_out.each_ref().map(|view| view.aside), [0.08, 0.18, 0.30]);
        for view in &still.held_out {
            assert_eq!(view.times, (0..24).step_by(2).collect::<Vec<_>>());
            for (frame, camera) in view.times.iter().zip(&view.cameras) {
                let share = camera.centre().distance(centres[*frame]) / depth;
                assert!((share - view.aside).abs() < 1e-6, "held out at {share} of the depth");
            }
        }
    }
    let pan = small("pan");
    assert!(pan.view_from_world.windows(2).all(|pair| pair[0] != pair[1]));
    let centre = pan.camera(0).centre();
    assert!((0..pan.frames.len()).all(|i| pan.camera(i).centre().distance(centre) < 1e-12));
    let tripod = small("tripod");
    assert!(tripod.view_from_world.iter().all(|pose| *pose == tripod.view_from_world[0]));
}

#[test]
fn held_out_pixels_that_a_frame_shows_are_told() {
    let clip = rendered("rigid", SMOOTH);
    let mut filmed = Vec::new();
    for view in &clip.held_out {
        let pairs = view.masks.iter().zip(&view.covisible);
        for (mask, covisible) in pairs.clone() {
            let moving =
                mask.pixels.iter().zip(&covisible.pixels).filter(|(mask, _)| **mask == 1.0);
            assert!(moving.clone().count() > 20 && moving.clone().all(|(_, seen)| *seen == 1.0));
        }
        filmed.push(pairs.map(|(_, covisible)| mean(covisible)).sum::<f64>() / 6.0);
    }
    // The farther the camera is offset, the less of its view is covisible.
    assert!(filmed[0] > 0.9 && filmed[0] > filmed[1] && filmed[1] > filmed[2], "{filmed:?}");
    assert!(filmed[2] > 0.6, "{filmed:?}");

    // At covisible pixels the held-out image has the colours of the input frame at `times[3]`.
    let view = &clip.held_out[0];
    let (frame, camera) = (view.times[3], view.cameras[3]);
    let from = clip.camera(frame);
    let (mut off, mut count) = (0.0, 0.0);
    for (x, y, centre) in centres(&clip.depth[frame]) {
        let z = f64::from(clip.depth[frame].at(x, y)[0]);
        let point = from.view_from_world.inverse().apply(from.intrinsics.ray(centre) * z);
        let local = camera.view_from_world.apply(point);
        let at = camera.intrinsics.project(local);
        let Some(seen) = sample(&view.covisible[3], at, 0).filter(|seen| *seen == 1.0) else {
            continue;
        };
        let Some(there) = sample(&view.frames[3], at, 1) else { continue };
        off += seen * (there - f64::from(clip.frames[frame].at(x, y)[1])).abs();
        count += 1.0;
    }
    assert!(count > 5000.0 && off / count < 0.03, "{count} pixels, off by {}", off / count);
}

#[test]
fn movers_cast_shadows_where_the_clip_says_so() {
    // Counts static points that are visible in the first and the last frame and darker in the last one: a
    // shadow fell on them.
    for (name, shadows) in [("throw", true), ("walk", true), ("bend", false)] {
        let clip = rendered(name, SMOOTH);
        let (first, last) = (clip.camera(0), clip.camera(11));
        let last_from_first = last.view_from_world * first.view_from_world.inverse();
        let (mut darker, mut count) = (0, 0);
        for (x, y, centre) in centres(&clip.depth[0]) {
            let ray = first.intrinsics.ray(centre);
            let point = last_from_first.apply(ray * f64::from(clip.depth[0].at(x, y)[0]));
            let to = last.intrinsics.project(point);
            let Some(depth) = sample(&clip.depth[11], to, 0) else { continue };
            let moves = sample(&clip.masks[11], to, 0) != Some(0.0);
            let hidden = (depth - point.z).abs() > 0.005 * point.z;
            if clip.masks[0].at(x, y)[0] != 0.0 || moves || hidden {
                continue;
            }
            let here = f64::from(clip.frames[0].at(x, y)[1]);
            let there = sample(&clip.frames[11], to, 1).unwrap();
            count += 1;
            darker += usize::from(here > 0.2 && there < 0.75 * here);
        }
        let share = darker as f64 / f64::from(count);
        assert!(count > 4000, "{name}: {count} pixels");
        assert!(if shadows { share > 0.01 } else { share < 0.007 }, "{name}: {share}");
    }
}

#[test]
fn what_flies_and_walks_stays_above_the_floor() {
    // The floor is the lowest surface that the camera sees: no point of a mover is below it.
    for name in ["throw", "walk", "hold"] {
        for seed in 0..3 {
            let options = SynthOptions { frames: 5, width: 96, height: 54, seed };
            let clip = synth::clip(name, &options).unwrap();
            let mut lowest: f64 = 0.0;
            for frame in 0..5 {
                let camera = clip.camera(frame);
                let world_from_view = camera.view_from_world.inverse();
                for (x, y, centre) in centres(&clip.masks[frame]) {
                    if clip.masks[frame].at(x, y)[0] == 1.0 {
                        let z = f64::from(clip.depth[frame].at(x, y)[0]);
                        let point = world_from_view.apply(camera.intrinsics.ray(centre) * z);
                        lowest = lowest.max(point.y);
                    }
                }
            }
            assert!(lowest < 1.0 + 1e-5, "{name}, seed {seed}: {lowest}");
            // A walker's foot is on the floor.
            assert!(name != "walk" || lowest > 0.9, "{name}, seed {seed}: {lowest}");
        }
    }
}

#[test]
fn a_seed_gives_the_same_bits_and_another_gives_others() {
    let options = SynthOptions { frames: 2, width: 32, height: 18, seed: 7 };
    for name in synth::NAMES {
        let first = synth::clip(name, &options).unwrap();
        // A point behind the camera has a NaN pixel, and NaN equals nothing, so the text forms are
        // compared.
        let bits = |clip: &synth::Clip| format!("{clip:?}");
        assert!(bits(&first) == bits(&synth::clip(name, &options).unwrap()), "{name}");
        let other = synth::clip(name, &SynthOptions { seed: 8, ..options }).unwrap();
        assert_ne!(first.frames, other.frames, "{name}");
        assert_ne!(first.depth, other.depth, "{name}");
        assert_ne!(first.intrinsics, other.intrinsics, "{name}");
    }
}

#[test]
fn bad_requests_are_refused() {
    let message = |name: &str, frames, width, height| {
        let options = SynthOptions { frames, width, height, seed: 0 };
        synth::clip(name, &options).unwrap_err().to_string()
    };
    assert!(message("rigit", 24, 64, 36).contains("rigid"));
    assert!(message("rigid", 1, 64, 36).contains("2 to"));
    assert!(message("rigid", 24, 64, 0).contains("16 pixels"));
    assert!(message("rigid", 24, u32::MAX, u32::MAX).contains("GiB"));
}

/// The frames of a coded clip, written and read again, encode depth, movers and numbers of the camera.
#[test]
fn a_coded_clip_says_what_is_true_in_its_colours() {
    let options = SynthOptions { frames: 3, width: 80, height: 48, seed: 3 };
    let clip = synth::coded_clip("rigid", &options).unwrap();
    let natural = synth::clip("rigid", &options).unwrap();
    assert!(clip.coded && (&clip.depth, &clip.held_out) == (&natural.depth, &natural.held_out));
    let folder = tempfile::tempdir().unwrap();
    synth::write(&clip, folder.path().join("clip")).unwrap();
    for (frame, own) in clip.frames.iter().enumerate() {
        let file = folder.path().join(format!("clip/frames/{frame:04}.png"));
        let read = images::decode_rgb(&file, [0.0; 3], images::Orientation::Stored).unwrap();
        assert_eq!(&read, own, "frame {frame}");
        let (mut focal, mut count) = (0.0, 0.0);
        for (i, colour) in read.pixels.chunks_exact(3).enumerate() {
            let [red, green, blue] = [0, 1, 2].map(|c| f64::from(colour[c]));
            let depth = 0.35 / (red - green);
            let truth = f64::from(clip.depth[frame].pixels[i]);
            assert!(
                (depth / truth - 1.0).abs() < 1e-3,
                "frame {frame}, pixel {i}: {depth} {truth}"
            );
            let brightness =
                natural.frames[frame].pixels[3 * i..3 * i + 3].iter().sum::<f32>() / 3.0;
            let mean = (red + green + blue) / 3.0;
            assert!((mean - 0.3 - 0.4 * f64::from(brightness)).abs() < 3e-5, "{mean}");
            let moves = blue - green > 0.225;
            assert_eq!(moves, clip.masks[frame].pixels[i] == 1.0, "frame {frame}, pixel {i}");
            // The eighth of sixteen bands, without its edges, encodes the focal length divided by 4096.
            if (36..39).contains(&(i % 80)) {
                let number = (blue - green - if moves { 0.25 } else { 0.0 }) * 16.0 / 0.2;
                focal += ((number - 7.1) / 0.4 - 1.0) * 4096.0;
                count += 1.0;
            }
        }
        let truth = clip.intrinsics.fx;
        assert!((focal / count / truth - 1.0).abs() < 1e-3, "{} {truth}", focal / count);
    }
    let refused = |name, width| {
        let options = SynthOptions { width, ..options };
        synth::coded_clip(name, &options).unwrap_err().to_string()
    };
    assert!(refused("bend", 80).contains("one rigid thing"));
    assert!(refused("rigid", 63).contains("64 pixels wide"));
    assert!(refused("rigit", 80).contains("no clip named"));
}

#[test]
fn a_written_clip_reads_back() {
    let clip = small("rigid");
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("new").join("clip");
    synth::write(&clip, &folder).unwrap();
    let truth = folder.join("truth");
    let n = clip.frames.len();

    assert_eq!(intrinsics::read(truth.join("intrinsics.json")).unwrap(), clip.intrinsics);
    let poses = trajectory::read(truth.join("poses.txt"), None).unwrap();
    assert_eq!(poses.len(), n);
    for (i, pose) in poses.iter().enumerate() {
        assert_eq!(pose.time, i as f64);
        let gap = pose.world_from_view.translation.distance(clip.camera(i).centre());
        assert!(gap < 1e-6, "pose {i} is {gap} off");
    }
    assert_eq!(exr::read_depth(truth.join("depth/0004.exr")).unwrap(), clip.depth[4]);
    assert_eq!(flo::read(truth.join("flow_forward/0003.flo")).unwrap(), clip.flow_forward[3]);
    assert_eq!(flo::read(truth.join("flow_backward/0004.flo")).unwrap(), clip.flow_backward[3]);
    assert!(!truth.join("flow_forward/0004.flo").exists());
    assert!(!truth.join("flow_backward/0000.flo").exists());
    assert_eq!(read_mask(truth.join("masks/0002.png")).unwrap(), clip.masks[2]);
    let visible = read_mask(truth.join("visible_backward/0001.png")).unwrap();
    assert_eq!(visible, clip.visible_backward[0]);

    // The folder of ground truth is a dataset with known poses, and so is the held-out folder.
    let data = Dataset::open(&truth).unwrap();
    assert_eq!(data.frames.len(), n);
    assert!(data.timed);
    let view = &data.load(&[n - 1], splat4d::data::Resize::default()).unwrap()[0];
    assert_eq!(view.time, 1.0);
    let worst = view
        .image
        .pixels
        .iter()
        .zip(&clip.frames[n - 1].pixels)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(worst <= 0.5 / 255.0 + 1e-6, "8 bits lose at most half a step, not {worst}");
    let held_out = transforms::read_cameras(&truth.join("held_out/transforms.json")).unwrap();
    // Frames 0, 2 and 4 of five.
    assert_eq!(held_out.len(), 3 * 3);
    let gap = held_out[5].camera.centre().distance(clip.held_out[1].cameras[2].centre());
    assert!(gap < 1e-9, "{gap}");
    let views = Dataset::open(truth.join("held_out")).unwrap().frames;
    assert_eq!(views.len(), 3 * 3);
    assert!(views[5].path.ends_with("2/0004.png"), "{:?}", views[5].path);
    let movers = read_mask(truth.join("held_out/masks/2/0004.png")).unwrap();
    assert_eq!(movers, clip.held_out[1].masks[2]);
    let covisible = read_mask(truth.join("held_out/covisible/3/0002.png")).unwrap();
    assert_eq!(covisible, clip.held_out[2].covisible[1]);

    // No other file is left beside the folder, and an existing folder is not overwritten.
    assert_eq!(std::fs::read_dir(folder.parent().unwrap()).unwrap().count(), 1);
    let refused = synth::write(&clip, &folder).unwrap_err().to_string();
    assert!(refused.contains("not empty"), "{refused}");
}
