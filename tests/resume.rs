//! A training that resumes from a checkpoint ends with the same bits as one that went on.

mod common;

use splat4d::Result;
use splat4d::data::synth::{self, SynthOptions};
use splat4d::gpu::Device;
use splat4d::io::{Identity, read_state, write_state};
use splat4d::observe::EngineFlow;
use splat4d::scene::Scene;
use splat4d::track::{Options, track};
use splat4d::train::{
    Checkpoint, GrowthSettings, Observer, Phase, PosedMotion, Sequence, SequenceSettings,
    TrainSettings, Trainer, TrainingView, fit_posed, fit_sequence, random_points, seed_from_points,
};
use splat4d::types::{Camera, FlowSettings};

/// Keeps every checkpoint as it comes back from its file.
#[derive(Default)]
struct Keeper(Vec<Checkpoint>);

impl Observer for Keeper {
    fn progress(&mut self, _: Phase, _: u32, _: u32) -> Result<()> {
        Ok(())
    }

    fn wants_checkpoint(&mut self) -> bool {
        true
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint");
        write_state(&path, "training", &Identity::new(), checkpoint)?;
        self.0.push(read_state(&path, "training", &Identity::new())?);
        assert_eq!(self.0.last(), Some(checkpoint));
        Ok(())
    }
}

/// Trains without checkpoints, with them, and from each of them: to the same scene. Gives the places
/// of the checkpoints.
fn resumes(
    train: impl Fn(Option<Checkpoint>, &mut dyn Observer) -> Result<Scene>,
) -> Vec<(Phase, u32)> {
    let quiet = || |_: Phase, _: u32, _: u32| Ok(());
    let whole = train(None, &mut quiet()).unwrap();
    let mut keeper = Keeper::default();
    assert!(train(None, &mut keeper).unwrap() == whole, "keeping checkpoints changes the result");
    let places: Vec<_> = keeper.0.iter().map(Checkpoint::place).collect();
    for checkpoint in keeper.0 {
        let place = checkpoint.place();
        let resumed = train(Some(checkpoint), &mut quiet()).unwrap();
        assert!(resumed == whole, "resuming from {place:?} changes the result");
    }
    places
}

fn clip(width: u32, height: u32) -> synth::Clip {
    synth::clip("rigid", &SynthOptions { frames: 6, width, height, seed: 3 }).unwrap()
}

fn posed(clip: &synth::Clip) -> Vec<TrainingView> {
    let frames = clip.frames.iter().zip(&clip.view_from_world).zip(&clip.times);
    frames
        .map(|((image, &view_from_world), &time)| TrainingView {
            camera: Camera { intrinsics: clip.intrinsics, view_from_world },
            time,
            image: image.clone(),
            weights: None,
            disparity: None,
        })
        .collect()
}

fn growing(steps: u32) -> TrainSettings {
    TrainSettings {
        steps,
        sh_degree: 1,
        sh_interval: 150,
        max_gaussians: 1200,
        // Out of step with the checkpoints, so that rounds fall between them.
        growth: Some(GrowthSettings { from: 40, every: 30, ..GrowthSettings::default() }),
        seed: 5,
        ..TrainSettings::default()
    }
}

#[test]
fn posed_pictures_static_and_moving() {
    let device = common::device();
    let views = posed(&clip(64, 36));
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let seeds = seed_from_points(&random_points(&cameras, 800, 1), 1);
    let places = resumes(|resume, observer| {
        fit_posed(&device, &views, &seeds, None, &growing(250), resume, observer)
    });
    assert_eq!(places, [(Phase::Static, 100), (Phase::Static, 200)]);

    let motion = PosedMotion { warm_up: 0.4, control_points: 20, ..PosedMotion::default() };
    let settings = growing(320);
    let places = resumes(|resume, observer| {
        fit_posed(&device, &views, &seeds, Some(&motion), &settings, resume, observer)
    });
    assert_eq!(places, [(Phase::Static, 100), (Phase::Joint, 100)]);
    common::assert_valid(&device);
}

#[test]
fn a_tracked_clip_in_every_phase() {
    let device = common::device();
    let clip = clip(128, 72);
    let options = Options {
        intrinsics: Some(clip.intrinsics),
        poses: Some(clip.view_from_world.clone()),
        masks: Some(clip.masks.clone()),
        ..Options::default()
    };
    let mut source = EngineFlow::new(&device, &clip.frames, &FlowSettings::default()).unwrap();
    let found = track(&clip.frames, &options, &mut source, &mut |_, _| Ok(())).unwrap();
    let sequence = Sequence { frames: &clip.frames, times: &clip.times, track: &found };
    let settings = SequenceSettings {
        static_steps: 120,
        control_steps: 110,
        steps: 350,
        max_gaussians: 2000,
        control_points: 24,
        ..SequenceSettings::default()
    };
    let places =
        resumes(|resume, observer| fit_sequence(&device, sequence, &settings, resume, observer));
    let joint = [100, 200, 300].map(|step| (Phase::Joint, step));
    assert_eq!(places[..2], [(Phase::Static, 100), (Phase::Control, 100)]);
    assert_eq!(places[2..], joint);
    common::assert_valid(&device);
}

/// A state can only be taken where a trainer that goes on and one that resumes do the same, and only
/// be resumed with the pictures that it is of.
#[test]
fn what_does_not_fit_is_refused() {
    let device: Device = common::device();
    let views = posed(&clip(32, 18));
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let seeds = seed_from_points(&random_points(&cameras, 50, 1), 0);
    let settings = TrainSettings { steps: 300, growth: None, ..TrainSettings::default() };
    let mut trainer = Trainer::new(&device, &views, &seeds, None, settings.clone()).unwrap();
    trainer.step().unwrap();
    let message = trainer.state().unwrap_err().to_string();
    assert!(message.contains("every 100 steps"), "{message}");
    for _ in 1..100 {
        trainer.step().unwrap();
    }
    let state = trainer.state().unwrap();
    let fewer = Trainer::resume(&device, &views[..1], state.clone(), settings.clone());
    let message = fewer.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(message.contains("other pictures"), "{message}");

    // A static scene's checkpoint says nothing of what moves.
    let joint = Checkpoint::Joint(state);
    let resumed = fit_posed(&device, &views, &seeds, None, &settings, Some(joint), &mut {
        |_: Phase, _: u32, _: u32| Ok(())
    });
    let message = resumed.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(message.contains("another training"), "{message}");
}
