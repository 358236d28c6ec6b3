//! Tracking or training that resumes from a checkpoint gives the same bits as an uninterrupted run.

mod common;

use splat4d::data::synth::{self, SynthOptions};
use splat4d::gpu::Device;
use splat4d::io::{Identity, checksum, read_state, write_state};
use splat4d::observe::EngineFlow;
use splat4d::scene::Scene;
use splat4d::track::{self, Options, Sources, Stage, track, track_observed};
use splat4d::train::{
    AdaptiveSettings, Checkpoint, GrowthSettings, McmcSettings, Observer, Phase, PosedMotion,
    Sequence, SequenceSettings, TrainSettings, Trainer, TrainingView, fit_posed, fit_sequence,
    random_points, seed_from_points,
};
use splat4d::types::{Camera, FlowSettings};
use splat4d::{Error, Result};
use std::collections::BTreeMap;

/// Keeps checkpoints, as read back from their files, after given steps of the whole training. Also looks
/// at the scene from time to time, and after each last step.
struct Keeper<'a> {
    after: &'a [u32],
    steps: u32,
    kept: Vec<Checkpoint>,
    is_last: bool,
    seen: Vec<Scene>,
}

impl Observer for Keeper<'_> {
    fn progress(&mut self, _: Phase, step: u32, steps: u32) -> Result<()> {
        self.steps += 1;
        self.is_last = step == steps;
        Ok(())
    }

    fn wants_scene(&mut self) -> bool {
        self.is_last || self.steps.is_multiple_of(37)
    }

    fn scene(&mut self, scene: Scene) {
        self.seen.push(scene);
    }

    fn wants_checkpoint(&mut self) -> bool {
        self.after.contains(&self.steps)
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint");
        write_state(&path, "training", &Identity::new(), checkpoint)?;
        self.kept.push(read_state(&path, "training", &Identity::new())?);
        assert_eq!(self.kept.last(), Some(checkpoint));
        Ok(())
    }
}

/// Trains without checkpoints, with checkpoints after some steps, and from each of them; all runs must
/// give the same scene. Returns the positions of the checkpoints.
fn resumes(
    after: &[u32],
    train: impl Fn(Option<Checkpoint>, &mut dyn Observer) -> Result<Scene>,
) -> Vec<(Phase, u32)> {
    let quiet = || |_: Phase, _: u32, _: u32| Ok(());
    let whole = train(None, &mut quiet()).unwrap();
    let mut keeper = Keeper { after, steps: 0, kept: Vec::new(), is_last: false, seen: Vec::new() };
    assert!(train(None, &mut keeper).unwrap() == whole, "keeping checkpoints changes the result");
    // The last scene that the observer sees is the result.
    let last = keeper.seen.pop().unwrap();
    assert!(keeper.seen.len() > 3 && keeper.seen.iter().all(|scene| scene.check().is_ok()));
    assert!(Scene { report: whole.report.clone(), ..last } == whole, "another scene is seen");
    assert!(keeper.seen[0].gaussians != whole.gaussians, "it has changed on the way");
    let places: Vec<_> = keeper.kept.iter().map(Checkpoint::place).collect();
    for checkpoint in keeper.kept {
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
            mask: None,
            every: 1,
        })
        .collect()
}

fn growing(steps: u32) -> TrainSettings {
    TrainSettings {
        steps,
        sh_degree: 1,
        sh_interval: 150,
        max_gaussians: 1200,
        // The rounds do not coincide with the checkpoints, so that some fall between them.
        growth: Some(GrowthSettings::Mcmc(McmcSettings {
            from: 40,
            every: 30,
            ..McmcSettings::default()
        })),
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
    let places = resumes(&[1, 100, 173, 250], |resume, observer| {
        fit_posed(&device, &mut views.clone(), &seeds, None, &growing(250), resume, observer)
    });
    assert_eq!(places, [1, 100, 173, 250].map(|step| (Phase::Static, step)));

    let motion = PosedMotion { warm_up: 0.4, control_points: 20, ..PosedMotion::default() };
    let settings = growing(320);
    // Nothing moves in the first 128 steps.
    let places = resumes(&[128, 171, 228], |resume, observer| {
        fit_posed(&device, &mut views.clone(), &seeds, Some(&motion), &settings, resume, observer)
    });
    assert_eq!(places, [(Phase::Static, 128), (Phase::Joint, 43), (Phase::Joint, 100)]);

    let adaptive = AdaptiveSettings {
        until: 0.9,
        every: 30,
        reset_every: 80,
        ..AdaptiveSettings::scaled_to(192)
    };
    let settings = TrainSettings {
        growth: Some(GrowthSettings::Adaptive(adaptive)),
        max_gaussians: 5000,
        ..settings
    };
    let places = resumes(&[77, 283], |resume, observer| {
        fit_posed(&device, &mut views.clone(), &seeds, Some(&motion), &settings, resume, observer)
    });
    assert_eq!(places, [(Phase::Static, 77), (Phase::Joint, 155)]);
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
        static_steps: 60,
        steps: 350,
        max_gaussians: 2000,
        control_points: 24,
        ..SequenceSettings::default()
    };
    // Checkpoints in every phase, at its end, and in the last phase before and after the moving Gaussians
    // are selected, and after growth has begun.
    let after = [31, 60, 60 + 1, 60 + 107, 60 + 249, 60 + 350];
    let places = resumes(&after, |resume, observer| {
        fit_sequence(&device, sequence, &settings, resume, observer)
    });
    assert_eq!(places[..2], [(Phase::Static, 31), (Phase::Static, 60)]);
    assert_eq!(places[2..], [1, 107, 249, 350].map(|step| (Phase::Joint, step)));
    common::assert_valid(&device);
}

/// Keeps the parts of a tracking, and interrupts it after some new ones.
struct Parts {
    kept: BTreeMap<String, Vec<u8>>,
    left: usize,
}

impl track::Observer for Parts {
    fn progress(&mut self, _: Stage, share: f64) -> Result<()> {
        assert!((0.0..=1.0).contains(&share), "{share}");
        if self.left == 0 { Err(Error::Interrupted { checkpoint: None }) } else { Ok(()) }
    }

    fn keeps(&self) -> bool {
        true
    }

    fn keep(&mut self, part: &str, value: Vec<u8>) -> Result<()> {
        self.kept.retain(|name, _| !name.starts_with(&format!("{part}/")));
        self.kept.insert(part.into(), value);
        self.left = self.left.saturating_sub(1);
        Ok(())
    }

    fn kept(&mut self, part: &str) -> Result<Option<Vec<u8>>> {
        Ok(self.kept.get(part).cloned())
    }
}

/// A moving camera, one that is estimated again because much of the frame moves, and a fixed one.
#[test]
fn a_tracking_interrupted_again_and_again() {
    let device = common::device();
    for name in ["rigid", "crowd", "tripod"] {
        let options = SynthOptions { frames: 8, width: 120, height: 68, seed: 3 };
        let clip = synth::clip(name, &options).unwrap();
        let source = || EngineFlow::new(&device, &clip.frames, &FlowSettings::default()).unwrap();
        let options = Options::default();
        let whole = track(&clip.frames, &options, &mut source(), &mut |_, _| Ok(())).unwrap();
        let mut kept = BTreeMap::new();
        let mut stages = Vec::new();
        let found = loop {
            let mut parts = Parts { kept, left: 5 };
            let sources = Sources { flow: &mut source(), masks: None, features: None };
            match track_observed(&clip.frames, &options, sources, &mut parts) {
                Ok(found) => break found,
                Err(Error::Interrupted { .. }) => kept = parts.kept,
                Err(error) => panic!("{name}: {error}"),
            }
            stages.extend(kept.keys().map(|part| part.split('/').next().unwrap().to_string()));
        };
        assert_eq!(checksum(&found), checksum(&whole), "{name}");
        for stage in ["flow", "cameras", "round-0", "last", "depth"] {
            assert!(stages.iter().any(|part| part == stage), "{name}: never ended in {stage}");
        }
    }
    common::assert_valid(&device);
}

/// A state can only be resumed with its own images.
#[test]
fn what_does_not_fit_is_refused() {
    let device: Device = common::device();
    let views = posed(&clip(32, 18));
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let seeds = seed_from_points(&random_points(&cameras, 50, 1), 0);
    let settings = TrainSettings { steps: 300, growth: None, ..TrainSettings::default() };
    let mut trainer = Trainer::new(&device, &views, &seeds, None, settings.clone()).unwrap();
    trainer.step().unwrap();
    let state = trainer.state().unwrap();
    let fewer = Trainer::resume(&device, &views[..1], state.clone(), settings.clone());
    let message = fewer.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(message.contains("other images"), "{message}");

    // A static scene's checkpoint holds no motion.
    let joint = Checkpoint::Joint(state);
    let resumed =
        fit_posed(&device, &mut views.clone(), &seeds, None, &settings, Some(joint), &mut {
            |_: Phase, _: u32, _: u32| Ok(())
        });
    let message = resumed.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(message.contains("another training"), "{message}");
}
