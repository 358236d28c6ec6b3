//! Hard clips: movers that appear, leave or cross, wrong masks, few frames, arbitrary units, few control
//! points. Each required value is slightly below the measured one, which stands beside it.

mod common;
mod outcome;

use outcome::{HeldOut, Outcome};
use splat4d::data::synth::{self, SynthOptions};
use splat4d::eval::psnr;
use splat4d::renderer::Renderer;
use splat4d::track::Options;
use splat4d::train::{
    Phase, PosedMotion, SequenceSettings, TrainSettings, TrainingView, fit_posed, random_points,
    seed_from_points,
};
use splat4d::types::{Camera, Image, Pose};

const FRAMES: usize = 12;
const SIZE: SynthOptions = SynthOptions { frames: FRAMES, width: 160, height: 90, seed: 1 };

fn clip(name: &str) -> synth::Clip {
    synth::clip(name, &SIZE).unwrap()
}

fn settings() -> SequenceSettings {
    SequenceSettings {
        static_steps: 100,
        steps: 200,
        max_gaussians: 5_000,
        control_points: 48,
        ..SequenceSettings::default()
    }
}

/// Reconstructs a clip and computes its metrics.
fn reconstruct(
    what: &str,
    clip: synth::Clip,
    options: &Options,
    settings: &SequenceSettings,
) -> (Outcome, HeldOut) {
    let outcome = outcome::reconstruct(common::device(), clip, options, settings);
    let held_out = outcome.held_out();
    println!(
        "{what}: ATE {:.3} % of the path, mask IoU {:.2}, input {:.2} dB, held out {:.2} dB, inside movers \
         {:.2} dB, the input frame itself {:.2} dB; {:?}",
        100.0 * outcome.ate(),
        outcome.mask_iou(),
        outcome.psnr_on_input(),
        held_out.whole,
        held_out.movers,
        held_out.copied,
        outcome.track.quality.notes
    );
    common::assert_valid(&outcome.device);
    (outcome, held_out)
}

/// The frames of one clip before frame `at`, and those of another clip with the same cameras from there
/// on.
fn joined(first: &str, second: &str, at: usize) -> synth::Clip {
    let (mut joined, second) = (clip(first), clip(second));
    assert_eq!(joined.view_from_world, second.view_from_world);
    joined.frames[at..].clone_from_slice(&second.frames[at..]);
    joined.masks[at..].clone_from_slice(&second.masks[at..]);
    for (to, from) in joined.held_out.iter_mut().zip(second.held_out) {
        let k = to.times.iter().take_while(|frame| **frame < at).count();
        to.frames[k..].clone_from_slice(&from.frames[k..]);
        to.masks[k..].clone_from_slice(&from.masks[k..]);
    }
    joined
}

/// Reconstructs a clip without any given data; requires a quality of cameras and masks, and PSNR in dB of
/// held-out views, whole and inside movers.
fn demand(what: &str, clip: synth::Clip, least_iou: f64, least: [f64; 2]) {
    let (outcome, held_out) = reconstruct(what, clip, &Options::default(), &settings());
    assert!(outcome.ate() < 0.005 && outcome.mask_iou() > least_iou, "{what}");
    let found = [held_out.whole, held_out.movers];
    assert!(found[0] > least[0] && found[1] > least[1], "{what}: {found:?} dB");
}

#[test]
fn what_appears_in_the_middle_of_a_clip() {
    // Measured: 19.27 dB, inside the mover that appears 12.89 dB.
    demand("appears", joined("still", "rigid", FRAMES / 2), 0.8, [18.0, 11.5]);
}

#[test]
fn what_leaves_in_the_middle_of_a_clip() {
    // Measured: 20.35 dB, inside the mover that leaves 15.51 dB.
    demand("leaves", joined("rigid", "still", FRAMES / 2), 0.8, [19.0, 14.0]);
}

/// A ball and a box that fly past each other, each by more than its size per frame.
#[test]
fn movers_that_cross() {
    // Measured: 21.22 dB, inside movers 13.19 dB.
    demand("crosses", clip("throw"), 0.55, [20.0, 12.0]);
}

/// Supplied masks that lack the movers in every second frame, and masks that are displaced in every
/// third, give results as good as the true masks.
#[test]
fn masks_that_flicker_and_masks_that_slip() {
    let clip = clip("rigid");
    let with = |what: &str, masks: Vec<Image>| {
        let options = Options { masks: Some(masks), ..Options::default() };
        reconstruct(what, clip.clone(), &options, &settings())
    };
    let (kept, truth) = with("true masks", clip.masks.clone());
    assert_eq!(kept.track.masks, clip.masks);
    assert!(kept.track.quality.notes.is_empty());
    let changed = |first: usize, step: usize, change: &dyn Fn(&Image) -> Image| {
        let mut masks = clip.masks.clone();
        masks.iter_mut().skip(first).step_by(step).for_each(|mask| *mask = change(mask));
        masks
    };
    let empty = |mask: &Image| Image::new(mask.width, mask.height, 1);
    let aside = |mask: &Image| {
        let mut moved = mask.clone();
        moved.pixels.chunks_exact_mut(mask.width as usize).for_each(|row| row.rotate_left(40));
        moved
    };
    for (what, masks, frames) in [
        ("masks that flicker", changed(1, 2, &empty), "(1, 3, 5, 7, 9, 11)"),
        ("masks that slip", changed(1, 3, &aside), "(1, 4, 7, 10)"),
    ] {
        let (outcome, held_out) = with(what, masks);
        let notes = &outcome.track.quality.notes;
        assert!(notes.iter().any(|note| note.contains(frames)), "{what}: {notes:?}");
        // Measured: IoU 0.97 and 0.98; inside movers 20.44 dB with the true masks, 20.54 and 20.25 dB
        // with these.
        assert!(outcome.mask_iou() > 0.93, "{what}");
        assert!(held_out.movers > truth.movers - 0.7, "{what}: {} dB", held_out.movers);
        assert!(held_out.whole > truth.whole - 0.3, "{what}: {} dB", held_out.whole);
    }
}

/// Cameras that move by micrometres and by thousands of kilometres.
#[test]
fn supplied_poses_have_any_unit() {
    let clip = clip("rigid");
    let scaled = |unit: f64| {
        let pose = |pose: &Pose| Pose { translation: unit * pose.translation, ..*pose };
        let poses = clip.view_from_world.iter().map(pose).collect();
        let options = Options { poses: Some(poses), ..Options::default() };
        let what = format!("poses × {unit:e}");
        let (outcome, held_out) = reconstruct(&what, clip.clone(), &options, &settings());
        // The scene has the unit of the poses.
        for (at, theirs) in outcome.scene.cameras.iter().zip(&clip.view_from_world) {
            let off = at.camera.view_from_world.translation / unit - theirs.translation;
            assert!(off.length() < 1e-6, "{what}: {off}");
        }
        held_out
    };
    let usual = scaled(1.0);
    // Measured: 20.63 dB, inside movers 18.69 dB, in each unit.
    assert!(usual.whole > 19.5 && usual.movers > 17.5, "{} dB", usual.whole);
    for unit in [1e-6, 1e6] {
        let held_out = scaled(unit);
        assert!((held_out.whole - usual.whole).abs() < 0.1, "× {unit}: {} dB", held_out.whole);
        assert!((held_out.movers - usual.movers).abs() < 0.5, "× {unit}: {} dB", held_out.movers);
    }
}

/// Posed images of a moving scene, with distances between cameras scaled by a thousandth or a thousand.
#[test]
fn posed_pictures_have_any_unit() {
    let clip = clip("rigid");
    let device = common::device();
    let fitted = |unit: f64| {
        let camera = |frame: usize| {
            let mut camera = clip.camera(frame);
            camera.view_from_world.translation *= unit;
            camera
        };
        let view = |frame: usize| TrainingView {
            camera: camera(frame),
            time: clip.times[frame],
            image: clip.frames[frame].clone(),
            weights: None,
            disparity: None,
            mask: None,
            every: 1,
        };
        let mut views: Vec<TrainingView> = (0..FRAMES).map(view).collect();
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let seeds = seed_from_points(&random_points(&cameras, 3000, 1), 0);
        let motion = PosedMotion { control_points: 32, ..PosedMotion::default() };
        let settings = TrainSettings { growth: None, ..TrainSettings::of_steps(300) };
        let observer = &mut |_: Phase, _, _| Ok(());
        let motion = Some(&motion);
        let scene = fit_posed(&device, &mut views, &seeds, motion, &settings, None, observer);
        let back = views.iter().zip(&cameras).all(|(view, camera)| view.camera == *camera);
        assert!(back, "the pictures come back as they were");
        let mut renderer = Renderer::new(&device, &scene.unwrap()).unwrap();
        let psnrs = views.iter().map(|view| {
            let picture = renderer.render(&view.camera, view.time).unwrap().over([0.0; 3]);
            psnr(&picture, &view.image).unwrap()
        });
        let mean = psnrs.sum::<f64>() / FRAMES as f64;
        println!("posed, × {unit:e}: {mean:.2} dB");
        mean
    };
    let usual = fitted(1.0);
    for unit in [1e-3, 1e3] {
        let psnr = fitted(unit);
        assert!((psnr - usual).abs() < 0.5, "× {unit}: {psnr} dB instead of {usual}");
    }
    // Measured: 20.25 dB, 20.15 and 20.19 dB.
    assert!(usual > 19.0, "{usual} dB");
    common::assert_valid(&device);
}

#[test]
fn a_clip_of_eight_frames() {
    let options = SynthOptions { frames: 8, width: 240, height: 136, seed: 1 };
    let clip = synth::clip("rigid", &options).unwrap();
    // Measured: 20.72 dB, inside movers 18.42 dB.
    demand("8 frames", clip, 0.8, [19.5, 17.0]);
}

/// Fewer control points than the number of neighbours that a Gaussian follows.
#[test]
fn fewer_control_points_than_neighbours() {
    let settings = SequenceSettings { control_points: 2, ..settings() };
    assert!(settings.control_points < settings.neighbours);
    let (outcome, held_out) =
        reconstruct("2 control points", clip("rigid"), &Options::default(), &settings);
    let points = outcome.scene.control_points.len();
    assert!((1..=2).contains(&points), "{points}");
    assert!(outcome.scene.neighbours as usize <= points);
    // Measured: 20.37 dB, inside movers 18.55 dB.
    assert!(held_out.whole > 19.0 && held_out.movers > 17.0, "{} dB", held_out.whole);
}
