//! Pointmaps: networks whose outputs are exact, invalid models and lists, and clips whose cameras are
//! initialised from pointmaps.
//!
//! `tools/setup.sh test` installs the ONNX Runtime beside the build directory; without it the tests fail.

#[path = "support/runtime.rs"]
mod runtime;
mod support;

use std::path::Path;

use glam::{DVec2, DVec3};
use runtime::library;
use splat4d::data::synth::{self, SynthOptions};
use splat4d::eval::{Align, compare_trajectories};
use splat4d::geometry::se3::exp_so3;
use splat4d::observe::SuppliedFlow;
use splat4d::observe::alignment::align;
use splat4d::observe::onnx::{Models, Runtime, RuntimeOptions};
use splat4d::observe::pointmaps::{PairMaps, Placement, PointmapSource, Pointmaps, pairs};
use splat4d::track::{Guess, Options, Track, track};
use splat4d::types::{Image, Pose};
use splat4d::{Error, Result};
use support::{message, picture, says};

/// The runtime that `tools/setup.sh` installs, else the one that the library finds.
fn runtime() -> Runtime {
    let options = RuntimeOptions { library: library(), threads: 1, ..RuntimeOptions::default() };
    Runtime::load(&options)
        .unwrap_or_else(|error| panic!("{error}; tools/setup.sh test installs it"))
}

/// A list of an encoder with this image rule, and of a decoder.
fn list(picture: &str, decoder: &str) -> String {
    format!(
        "[pointmap_encoder]\nfile = \"pointmap_encoder.onnx\"\n[pointmap_encoder.contract]\n\
         kind = \"pointmap_encoder\"\nversion = 1\ninput = \"image\"\noutput = \"tokens\"\n\
         picture = {{ {picture} }}\n[pointmap_decoder]\nfile = \"{decoder}\"\n"
    )
}

/// Opens the models of a folder with this list.
fn models(list: &str) -> Result<Models> {
    let folder = tempfile::tempdir().unwrap();
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models");
    let names =
        ["pointmap_encoder.onnx", "pointmap_decoder.onnx", "pointmap_uneven.onnx", "depth.onnx"];
    for name in names {
        std::fs::copy(from.join(name), folder.path().join(name)).unwrap();
    }
    std::fs::write(folder.path().join("models.toml"), list).unwrap();
    Models::open(&runtime(), folder.path())
}

const CUT: &str = "multiple = 4, fit = \"crop\"";
/// The rule for images that are transposed for the network.
const LAID: &str = "size = [16, 8], fit = \"crop\"";

/// The exact decoder's output for a pair, at a pixel of the frames.
fn expected(frames: &[Image; 2], (x, y): (u32, u32)) -> [([f32; 3], f32); 2] {
    let [a, b] = [0, 1].map(|k| frames[k].at(x, y));
    let point = |c: [f32; 3]| [c[0], c[1], 1.0 + c[2]];
    let both = [0, 1, 2].map(|c| a[c] + b[c]);
    [(point([a[0], a[1], a[2]]), 1.0 + a[0]), (point(both), 1.0 + b[2])]
}

#[test]
fn a_network_is_asked_for_both_pictures_of_a_pair() {
    let mut models = models(&list(CUT, "pointmap_decoder.onnx")).unwrap();
    let network = models.pointmaps.as_mut().unwrap();
    assert!(network.file().ends_with("pointmap_decoder.onnx"));
    for (size, corner, picture_size) in
        [((20, 12), (0, 0), (20, 12)), ((12, 20), (0, 0), (12, 20)), ((23, 14), (1, 1), (20, 12))]
    {
        let frames = [1, 2].map(|seed| picture(size.0, size.1, seed));
        let mut source = network.source(&frames).unwrap();
        let placement = source.placement();
        assert_eq!((placement.frame, placement.picture), (size, picture_size));
        let corner_of_picture = DVec2::new(f64::from(corner.0), f64::from(corner.1));
        assert_eq!((placement.scale, placement.corner), (DVec2::ONE, corner_of_picture));
        for [first, second] in [[0, 1], [1, 0]] {
            let maps = source.pair(first, second).unwrap();
            let pair = [frames[first].clone(), frames[second].clone()];
            for (x, y) in (0..picture_size.1).flat_map(|y| (0..picture_size.0).map(move |x| (x, y)))
            {
                let told = expected(&pair, (x + corner.0, y + corner.1));
                for (k, (point, confidence)) in told.into_iter().enumerate() {
                    let found = maps.points[k].at(x, y);
                    assert!(
                        (0..3).all(|c| (found[c] - point[c]).abs() < 1e-6),
                        "{found:?} {point:?}"
                    );
                    assert!((maps.confidence[k].at(x, y)[0] - confidence).abs() < 1e-6);
                }
            }
        }
        let missing = source.pair(0, 2);
        says(&message(missing), &["frame 2", "has 2 frames"]);
    }
}

#[test]
fn frames_that_stand_are_laid_on_their_side() {
    let mut models = models(&list(LAID, "pointmap_decoder.onnx")).unwrap();
    let network = models.pointmaps.as_mut().unwrap();
    let frames = [1, 2].map(|seed| picture(8, 16, seed));
    let mut source = network.source(&frames).unwrap();
    assert_eq!(source.placement(), Placement::whole(8, 16));
    let maps = source.pair(0, 1).unwrap();
    for (x, y) in (0..16).flat_map(|y| (0..8).map(move |x| (x, y))) {
        for (k, (point, confidence)) in expected(&frames, (x, y)).into_iter().enumerate() {
            // The network's x axis is down in the frame.
            let found = maps.points[k].at(x, y);
            let swapped = [point[1], point[0], point[2]];
            assert!((0..3).all(|c| (found[c] - swapped[c]).abs() < 1e-6), "{found:?} {swapped:?}");
            assert!((maps.confidence[k].at(x, y)[0] - confidence).abs() < 1e-6);
        }
    }
}

#[test]
fn what_is_wrong_is_told() {
    let good = list(CUT, "pointmap_decoder.onnx");
    let (encoder, decoder) = good.split_at(good.find("[pointmap_decoder]").unwrap());
    let depth = "[pointmap_encoder]\nfile = \"depth.onnx\"\n";
    let named = good.replace("\"tokens\"", "\"features\"");
    let cases: [(&str, &[&str]); 6] = [
        (encoder, &["models.toml", "has `pointmap_encoder` without `pointmap_decoder`"]),
        (decoder, &["models.toml", "has `pointmap_decoder` without `pointmap_encoder`"]),
        (
            &list(CUT, "depth.onnx"),
            &["depth.onnx", "is listed for pointmap_decoder, and computes depth"],
        ),
        (
            &format!("{depth}{decoder}"),
            &["depth.onnx", "is listed for pointmap_encoder, and computes depth"],
        ),
        (&named, &["pointmap_encoder.onnx", "output `features`", "has `tokens`"]),
        (&list("multiple = 0", "pointmap_decoder.onnx"), &["multiples of 0"]),
    ];
    for (list, parts) in cases {
        says(&message(models(list).map(drop)), parts);
    }
}

#[test]
fn answers_that_are_no_pointmaps_are_told() {
    let ask = |decoder: &str, frames: &[Image]| {
        let mut models = models(&list(CUT, decoder)).unwrap();
        let network = models.pointmaps.as_mut().unwrap();
        network.source(frames).and_then(|mut source| source.pair(0, 1)).map(drop)
    };
    let good = [1, 2].map(|seed| picture(8, 4, seed));
    let uneven = message(ask("pointmap_uneven.onnx", &good));
    says(&uneven, &["pointmap_uneven.onnx", "`points0` came out as [1, 4, 4, 3]", "8×4"]);
    let with = |value: f32| {
        let mut frames = good.clone();
        frames[1].pixels[5] = value;
        message(ask("pointmap_decoder.onnx", &frames))
    };
    says(&with(f32::NAN), &["pointmap_decoder.onnx", "`points1` is not finite at 1 of 96 values"]);
    says(&with(-0.5), &["`confidence1` is 0.5 at a pixel", "1 or more"]);
    says(&message(ask("pointmap_decoder.onnx", &[])), &["there are none"]);
    let grey = [Image::new(8, 4, 1), Image::new(8, 4, 1)];
    says(&message(ask("pointmap_decoder.onnx", &grey)), &["RGB", "1 channels"]);
    let sizes = [picture(8, 4, 1), picture(4, 8, 1)];
    says(&message(ask("pointmap_decoder.onnx", &sizes)), &["frame 1 is 4×8", "8×4"]);
}

#[test]
fn frames_are_paired_at_odd_distances() {
    assert_eq!(pairs(2).collect::<Vec<_>>(), [(0, 1)]);
    assert_eq!(pairs(4).collect::<Vec<_>>(), [(0, 1), (1, 2), (2, 3), (0, 3)]);
    let all: Vec<_> = pairs(60).collect();
    assert_eq!(all.len(), 59 + 57 + 55 + 53 + 51);
    assert!(all.iter().all(|(a, b)| [1, 3, 5, 7, 9].contains(&(b - a))));
    assert!(all.is_sorted_by_key(|(_, later)| *later));
}

/// The ground truth of a synthetic clip, with movers at their position at the frame's time.
struct Truth<'a>(&'a synth::Clip);

impl PointmapSource for Truth<'_> {
    fn placement(&self) -> Placement {
        Placement::whole(self.0.intrinsics.width, self.0.intrinsics.height)
    }

    fn pair(&mut self, first: usize, second: usize) -> Result<PairMaps> {
        let synth::Clip { intrinsics, view_from_world, depth, .. } = self.0;
        // Each pair has a different unit.
        let unit = 1.0 + 0.3 * ((7 * first + 3 * second) % 5) as f64;
        let points = [first, second].map(|frame| {
            let first_from_frame = view_from_world[first] * view_from_world[frame].inverse();
            let mut map = Image::new(intrinsics.width, intrinsics.height, 3);
            for (i, out) in map.pixels.chunks_exact_mut(3).enumerate() {
                let (x, y) = (i % intrinsics.width as usize, i / intrinsics.width as usize);
                let ray = intrinsics.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
                let z = f64::from(depth[frame].pixels[i]);
                let point = unit * first_from_frame.apply(z * ray);
                out.copy_from_slice(&point.as_vec3().to_array());
            }
            map
        });
        let sure =
            Image { pixels: vec![10.0; points[0].pixels.len() / 3], channels: 1, ..points[0] };
        Ok(PairMaps { points, confidence: [sure.clone(), sure] })
    }
}

fn ate(found: &[Pose], clip: &synth::Clip) -> f64 {
    let centres = |poses: &[Pose]| poses.iter().map(Pose::inverse).collect::<Vec<_>>();
    let (a, b) = (centres(found), centres(&clip.view_from_world));
    compare_trajectories(&a, &b, Align::Sim3).unwrap().ate_relative
}

fn tracked(clip: &synth::Clip, options: &Options) -> Track {
    let mut flow =
        SuppliedFlow::new(clip.flow_forward.clone(), clip.flow_backward.clone()).unwrap();
    track(&clip.frames, options, &mut flow, &mut |_, _| Ok(())).unwrap()
}

#[test]
fn cameras_begin_with_pointmaps_and_leave_wrong_ones() {
    let size = SynthOptions { frames: 12, width: 160, height: 90, seed: 3 };
    let clip = synth::clip("rigid", &size).unwrap();
    let maps = Pointmaps::gather(&mut Truth(&clip), 12, &mut |_| Ok(())).unwrap();
    let told = align(&maps, None).unwrap();
    let off = ate(&told.view_from_world, &clip);
    let focal = told.focal / clip.intrinsics.fx - 1.0;
    eprintln!("aligned: ATE {off:.2e}, focal {focal:+.2e}, off {:.2e}", told.off);
    assert!(off < 1e-3 && focal.abs() < 1e-3, "{off} {focal}");
    let guess = |poses: Vec<Pose>| Guess {
        poses,
        focal: told.focal,
        focal_deviation: told.focal_deviation,
        from: "the pointmaps of truth".into(),
    };
    let estimated_depth = Some(maps.into_depth(&told.depth_factors));
    let right = Some(guess(told.view_from_world.clone()));
    let options = Options { guess: right, estimated_depth, ..Options::default() };
    let found = tracked(&clip, &options);
    eprintln!("tracked: ATE {:.2e}, {:?}", ate(&found.view_from_world, &clip), found.quality.notes);
    assert!(ate(&found.view_from_world, &clip) < 0.01);
    assert!((found.intrinsics.fx / clip.intrinsics.fx - 1.0).abs() < 0.02);
    says(&found.quality.notes.join("\n"), &["cameras begin with the pointmaps of truth"]);
    // Each camera has a different wrong pose.
    let wrong = |i: usize| {
        let t = i as f64;
        Pose::new(exp_so3(DVec3::new(t.sin(), (2.0 * t).cos(), t)), DVec3::new(t.cos(), t, t.sin()))
    };
    let options =
        Options { guess: Some(guess((0..12).map(wrong).collect())), ..Options::default() };
    let found = tracked(&clip, &options);
    eprintln!("wrong: ATE {:.2e}, {:?}", ate(&found.view_from_world, &clip), found.quality.notes);
    assert!(ate(&found.view_from_world, &clip) < 0.02);
    let notes = found.quality.notes.join("\n");
    assert!(!notes.contains("cameras begin with"), "{notes}");
    assert!(notes.contains("the pointmaps of truth"), "{notes}");
}

#[test]
fn a_guess_must_fit_the_clip() {
    let frames = vec![picture(32, 24, 1); 6];
    let refused = |poses: usize, focal: f64| {
        let guess = Guess {
            poses: vec![Pose::IDENTITY; poses],
            focal,
            focal_deviation: 0.1,
            from: "a guess".into(),
        };
        let options = Options { guess: Some(guess), ..Options::default() };
        let nothing = vec![Image::new(32, 24, 2); 5];
        let mut flow = SuppliedFlow::new(nothing.clone(), nothing).unwrap();
        let found: std::result::Result<Track, Error> =
            track(&frames, &options, &mut flow, &mut |_, _| Ok(()));
        message(found.map(drop))
    };
    says(&refused(5, 30.0), &["5 guessed poses are supplied for 6 frames"]);
    says(&refused(6, -1.0), &["focal length of -1.0 px makes no sense"]);
}
