//! One run of an ablation: tracking, training and evaluation of a clip.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::{Value, json};
use splat4d::Result;
use splat4d::data::{Clip, read_mask};
use splat4d::gpu::Device;
use splat4d::observe::onnx::Models;
use splat4d::observe::{FeatureSource, MaskSource};
use splat4d::renderer::Renderer;
use splat4d::report::{Better, Figure};
use splat4d::scene::Scene;
use splat4d::track::{Observer, Options, Sources, Stage, Track, track_observed};
use splat4d::train::{Phase, Sequence, SequenceSettings, fit_sequence};
use splat4d::types::Image;

use super::common::notes;
use super::eval_truth::Extras;
use super::held_out::{self, Judge, Shot};
use super::known::flow_source;
use super::meter::Meter;
use super::networks::{TrackNetworks, estimate_depth, estimate_pointmaps};
use super::{eval_truth, interrupt};

/// Data shared by all runs.
pub struct Material<'a> {
    device: &'a Device,
    /// The clip's frames.
    pub frames: Vec<Image>,
    names: Vec<String>,
    times: Vec<f64>,
    /// Folder of the clip's ground truth, if there is one.
    truth: Option<&'a Path>,
    /// Per frame, 1 on movers.
    movers: Vec<Image>,
    /// Parts of the tracking that are the same in every run: the flow.
    flow: BTreeMap<String, Vec<u8>>,
    /// Time for computing these parts, seconds.
    pub seconds_flow: f64,
    /// Distances of the held-out cameras, from the last evaluated run.
    pub distances: Vec<String>,
}

/// A tracked clip, with the time for tracking without the flow.
pub struct Tracked {
    pub track: Track,
    seconds: f64,
}

/// Metrics of a run, by key.
pub type Figures = BTreeMap<String, f64>;

impl<'a> Material<'a> {
    /// Material of a clip and its ground truth.
    pub fn new(device: &'a Device, clip: Clip, truth: Option<&'a Path>) -> Material<'a> {
        let names = clip.frames.iter().map(|frame| frame.name.clone()).collect();
        let times = clip.frames.iter().map(|frame| frame.time).collect();
        let frames = clip.frames.into_iter().map(|frame| frame.image).collect();
        Material {
            device,
            frames,
            names,
            times,
            truth,
            movers: Vec::new(),
            flow: BTreeMap::new(),
            seconds_flow: 0.0,
            distances: Vec::new(),
        }
    }

    /// Estimates depth and cameras with the networks, for all runs.
    pub fn estimate(&self, models: &mut Option<Models>, options: &mut Options) -> Result<()> {
        estimate_depth(models, &self.frames, options)?;
        let said = estimate_pointmaps(models, &self.frames, options)?;
        notes(said.as_slice());
        Ok(())
    }

    /// Tracks the clip; the flow is computed the first time.
    pub fn track(&mut self, options: &Options, models: &mut Option<Models>) -> Result<Tracked> {
        let TrackNetworks { flow, masks, features } = TrackNetworks::of(models);
        let mut source = flow_source(self.device, &self.frames, None, flow)?;
        let first = self.flow.is_empty();
        let mut follower = Follower {
            flow: &mut self.flow,
            began: Instant::now(),
            seconds_flow: 0.0,
            under_way: None,
        };
        let sources = Sources {
            flow: source.as_mut(),
            masks: masks.map(|network| network as &mut dyn MaskSource),
            features: features.map(|network| network as &mut dyn FeatureSource),
        };
        let track = track_observed(&self.frames, options, sources, &mut follower)?;
        let seconds = follower.began.elapsed().as_secs_f64() - follower.seconds_flow;
        if first {
            self.seconds_flow = follower.seconds_flow;
        }
        notes(&track.quality.notes);
        Ok(Tracked { track, seconds })
    }

    /// Stores each frame's mover mask, from the ground truth where it has masks, else from the full run.
    pub fn keep_masks(&mut self, full: &Track) {
        let true_mask = |frame: usize| -> Option<Image> {
            let number: usize = self.names[frame].parse().ok()?;
            let file: PathBuf = self.truth?.join("masks").join(format!("{number:04}.png"));
            let mask = read_mask(file).ok()?;
            Some(sampled(&mask, &self.frames[frame]))
        };
        let own = |frame: usize| {
            let mask = &full.masks[frame];
            Image { pixels: mask.pixels.iter().map(|m| m.round()).collect(), ..*mask }
        };
        let of = |frame| true_mask(frame).unwrap_or_else(|| own(frame));
        self.movers = (0..self.frames.len()).map(of).collect();
    }

    /// Trains on a track and evaluates the scene.
    pub fn train(&mut self, tracked: &Tracked, settings: &SequenceSettings) -> Result<Figures> {
        let Tracked { track, seconds } = tracked;
        self.device.restart_memory_peak();
        let began = Instant::now();
        let mut under_way: Option<(Phase, Meter)> = None;
        let mut observer = |phase: Phase, step: u32, steps: u32| {
            interrupt::check()?;
            if under_way.as_ref().is_none_or(|(before, _)| *before != phase) {
                let name = match phase {
                    Phase::Static => "static",
                    Phase::Joint => "joint",
                };
                let meter = Meter::new(name, "steps", steps.into(), u64::from(step) - 1);
                under_way = Some((phase, meter));
            }
            if let Some((_, meter)) = &mut under_way {
                meter.set(step.into());
            }
            Ok(())
        };
        let sequence = Sequence { frames: &self.frames, times: &self.times, track };
        let mut scene = fit_sequence(self.device, sequence, settings, None, &mut observer)?;
        drop(under_way);
        let seconds_train = began.elapsed().as_secs_f64();
        let peak = self.device.memory().1;
        scene.report["frame_names"] = json!(self.names);
        let mut figures = Figures::from([
            ("gaussians".to_owned(), scene.gaussians.len() as f64),
            ("control_points".to_owned(), scene.control_points.len() as f64),
            ("seconds_track".to_owned(), *seconds),
            ("seconds_train".to_owned(), seconds_train),
            ("peak_bytes".to_owned(), peak as f64),
        ]);
        figures.extend(self.on_input(&scene, &track.prepared(&self.frames))?);
        if let Some(truth) = self.truth {
            let extras = Extras { fit_poses: false, shown: &|_, _| Ok(None), lpips: None };
            let found = eval_truth::measure(self.device, &scene, truth, extras)?;
            self.distances.clear();
            for row in found["held_out"].as_array().into_iter().flatten() {
                let distance = row["distance"].as_str().unwrap_or_default();
                figures.extend(of_row(&format!("held_out_{distance}"), row));
                self.distances.push(distance.to_owned());
            }
        }
        Ok(figures)
    }

    /// Evaluates a scene on the training frames.
    fn on_input(&self, scene: &Scene, frames: &[Image]) -> Result<Figures> {
        let mut renderer = Renderer::new(self.device, scene)?;
        let mut judge = Judge {
            renderer: &mut renderer,
            background: scene.background,
            fit: false,
            comparisons: None,
            lpips: None,
        };
        let mut meter = Meter::new("input", "frames", self.frames.len() as u64, 0);
        let mut judged = Vec::with_capacity(self.frames.len());
        for (frame, at) in scene.cameras.iter().enumerate() {
            interrupt::check()?;
            let shot = Shot {
                name: self.names[frame].clone(),
                distance: "input".into(),
                camera: at.camera,
                time: at.time,
                truth: frames[frame].clone(),
                movers: Some(self.movers[frame].clone()),
                covisible: None,
            };
            judged.push(judge.judge(frame, &shot)?);
            meter.advance();
        }
        Ok(of_row("input", &held_out::keys(&judged)["held_out"][0]))
    }
}

/// A mask at the size of an image, by nearest neighbour.
fn sampled(mask: &Image, like: &Image) -> Image {
    let mut out = Image::new(like.width, like.height, 1);
    for y in 0..out.height {
        for x in 0..out.width {
            let at = |i: u32, to: u32, from: u32| {
                ((2 * u64::from(i) + 1) * u64::from(from) / (2 * u64::from(to))) as u32
            };
            let there = mask.at(at(x, out.width, mask.width), at(y, out.height, mask.height));
            out.at_mut(x, y)[0] = there[0];
        }
    }
    out
}

/// The metrics of a row of [`held_out::keys`], with a prefix on their keys.
fn of_row(prefix: &str, row: &Value) -> Figures {
    let still = [&row["static_covisible"], &row["outside_movers"]];
    let still = still.into_iter().find(|region| !region.is_null()).unwrap_or(&Value::Null);
    let all = [
        ("psnr", &row["psnr"]),
        ("ssim", &row["ssim"]),
        ("movers_psnr", &row["movers"]["psnr"]),
        ("movers_ssim", &row["movers"]["ssim"]),
        ("static_psnr", &still["psnr"]),
    ];
    all.into_iter()
        .filter_map(|(key, value)| Some((format!("{prefix}_{key}"), value.as_f64()?)))
        .collect()
}

/// The metrics of each run, given the distances of the held-out cameras.
pub fn figures(distances: &[String]) -> Vec<Figure> {
    let figure = |key: String, title: String, better| Figure { key, title, better };
    let mut all = Vec::new();
    let mut pictures = |prefix: &str, title: &str, regions: &[(&str, &str)]| {
        for (key, words) in regions {
            let (key, title) = (format!("{prefix}_{key}"), format!("{words} {title}"));
            all.push(figure(key, title, Better::More));
        }
    };
    let whole = [("psnr", "PSNR (dB),"), ("ssim", "SSIM,")];
    let movers =
        [("movers_psnr", "PSNR (dB) inside movers,"), ("movers_ssim", "SSIM inside movers,")];
    pictures("input", "input", &[whole, movers].concat());
    for distance in distances {
        let still = [("static_psnr", "PSNR (dB) of filmed static pixels,")];
        let regions = [&whole[..], &movers[..1], &still].concat();
        pictures(&format!("held_out_{distance}"), &format!("held out {distance}"), &regions);
    }
    let costs = [
        ("gaussians", "Gaussians"),
        ("control_points", "control points"),
        ("seconds_track", "seconds of tracking, without flow"),
        ("seconds_train", "seconds of training"),
        ("peak_bytes", "bytes of device memory in training"),
    ];
    all.extend(costs.map(|(key, title)| figure(key.into(), title.into(), Better::Less)));
    all
}

/// Tracking observer that keeps the flow for the next run.
struct Follower<'a> {
    flow: &'a mut BTreeMap<String, Vec<u8>>,
    began: Instant,
    seconds_flow: f64,
    under_way: Option<(Stage, Meter)>,
}

impl Observer for Follower<'_> {
    fn progress(&mut self, stage: Stage, share: f64) -> Result<()> {
        interrupt::check()?;
        let name = match stage {
            Stage::Flow => "flow",
            Stage::Cameras => "cameras",
            Stage::Masks => "masks",
            Stage::Depth => "depth",
        };
        if stage == Stage::Flow {
            self.seconds_flow = self.began.elapsed().as_secs_f64();
        }
        if self.under_way.as_ref().is_none_or(|(before, _)| *before != stage) {
            self.under_way = Some((stage, Meter::new(name, "%", 100, 0)));
        }
        if let Some((_, meter)) = &mut self.under_way {
            meter.set((100.0 * share) as u64);
        }
        Ok(())
    }

    fn keeps(&self) -> bool {
        true
    }

    fn keep(&mut self, part: &str, value: Vec<u8>) -> Result<()> {
        if part.starts_with("flow/") {
            self.flow.insert(part.to_owned(), value);
        }
        Ok(())
    }

    fn kept(&mut self, part: &str) -> Result<Option<Vec<u8>>> {
        Ok(self.flow.get(part).cloned())
    }
}
