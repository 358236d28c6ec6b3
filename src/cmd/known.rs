//! User-supplied knowledge about a clip and the tracking itself, which `reconstruct` and `track` share.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::Deserialize;
use serde_json::{Value, json};
use splat4d::data::trajectory::{self, TimedPose};
use splat4d::data::{Clip, Distortion, Lens, Resize, depth, flow, images, intrinsics};
use splat4d::gpu::Device;
use splat4d::observe::onnx::{FlowNetwork, Models};
use splat4d::observe::{
    EngineFlow, EstimatedDepth, EstimatedKind, FeatureSource, FlowSource, MaskSource, SuppliedFlow,
};
use splat4d::track::{
    FocalSource, Observer, Options, Quality, Refined, Sources, Track, track_observed,
};
use splat4d::types::{Camera, FlowSettings, Image, Intrinsics};
use splat4d::{Error, Result};

use super::clip::ClipArgs;
use super::common::notes;
use super::networks::{NetworkArgs, TrackNetworks};
use super::origins::Given;
use super::outputs::{Folder, Inputs};
use super::{supplied, values};

/// Extensions of camera files in a folder.
const CAMERAS: [&str; 4] = ["cam", "bin", "txt", "json"];

/// Supplied quantities that are adjusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Refine {
    /// Poses, except for the first one and the scale
    Poses,
    /// The focal length, where the clip determines it
    Focal,
}

/// Contents of depth maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DepthKind {
    /// Depth z up to one scale for the whole clip, which is kept
    Measured,
    /// A network's depth z, up to a scale per frame
    Estimated,
    /// A network's depth z, up to a scale and a shift per frame
    Shifted,
    /// A network's inverse depth, up to a scale and a shift per frame, as MiDaS and Depth Anything write it
    Inverse,
}

/// Options for user-supplied data of a clip.
#[derive(Args)]
pub struct KnownArgs {
    /// Focal length, in pixels of the clip's original size
    #[arg(long, value_name = "PIXELS",
          value_parser = values::number(1.0..=values::MOST_FOCAL))]
    pub focal: Option<f64>,
    /// Intrinsics: JSON with fx, fy, cx, cy, width, height
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    intrinsics: Option<PathBuf>,
    /// Camera poses in any unit, one per frame or named like the frames: a TUM, KITTI or EuRoC file (camera
    /// to world) or a transforms.json; a folder with a transforms.json, a COLMAP model, Sintel's .cam files
    /// or MonST3R's output; or a dataset that `train` reads. Its intrinsics are used unless others are
    /// given
    #[arg(long, value_name = "FILE|DIR")]
    poses: Option<PathBuf>,
    /// Which of --poses and the focal length are only initial values and are adjusted to the clip
    #[arg(long, value_name = "WHAT", value_enum, value_delimiter = ',')]
    pub refine: Vec<Refine>,
    /// Assume a pinhole camera: do not estimate lens distortion
    #[arg(long)]
    pub pinhole: bool,
    /// Motion masks: a folder of images, white on movers or with a colour per object (DAVIS), one per frame
    /// or named like the frames (dynamic_mask_*.png in MonST3R's folder); masks that flicker or slip are
    /// repaired, with a note
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Depth maps: a folder of EXR, .npy, .npz or Sintel's .dpt files or of grey 16-bit PNGs (frame_*.npy
    /// in MonST3R's folder), z up to one scale, 0 where unknown; see --depth-kind for other contents
    #[arg(long, value_name = "DIR")]
    depth: Option<PathBuf>,
    /// Number of PNG depth values per unit of length
    #[arg(long, value_name = "VALUE", default_value_t = 1000.0, requires = "depth",
          value_parser = values::number(1e-6..=1e9))]
    pub depth_scale: f64,
    /// What the maps of --depth contain. A network's maps fill in what the clip does not show, and give the
    /// movers' shapes and distances, after each frame is scaled to the triangulated points
    #[arg(long, value_name = "KIND", value_enum, default_value = "measured", requires = "depth")]
    pub depth_kind: DepthKind,
    /// Optical flow: a folder with .flo, .npy or .npz files (height × width × 2) or KITTI's PNGs in
    /// flow_forward and flow_backward (or forward and backward); frames then keep their original size
    /// unless another is requested
    #[arg(long, value_name = "DIR")]
    flow: Option<PathBuf>,
    /// Additional point tracks: an .npz in the format of TAPIR (tracks, visibles) or CoTracker
    /// (pred_tracks, pred_visibility), with one position per frame
    #[arg(long, value_name = "FILE")]
    tracks: Option<PathBuf>,
    /// Take this rigid motion as that of the static world, numbered from 0 as in the notes of an earlier run
    #[arg(long = "static", value_name = "N", conflicts_with_all = ["poses", "masks"],
          value_parser = values::whole::<usize>(0..=Options::MOST_MOTIONS as u64 - 1))]
    pub static_motion: Option<usize>,
    #[command(flatten)]
    pub networks: NetworkArgs,
}

impl KnownArgs {
    /// Checks that the options are compatible.
    pub fn check(&self, frames: &ClipArgs) -> Result<()> {
        if self.flow.is_some() && frames.every > 1 {
            let what = "--flow leads from each frame to the next; it does not go with --every";
            return Err(Error::Input(what.into()));
        }
        if self.refine.contains(&Refine::Poses) && self.poses.is_none() {
            let what = "--refine poses adjusts those that --poses gives; there are none";
            return Err(Error::Input(what.into()));
        }
        Ok(())
    }

    /// Whether flow is supplied and need not be computed.
    pub fn supplies_flow(&self) -> bool {
        self.flow.is_some()
    }

    /// Whether initial poses are supplied.
    pub fn supplies_poses(&self) -> bool {
        self.poses.is_some()
    }

    /// The kinds of supplied data.
    pub fn given(&self) -> Given {
        Given {
            poses: self.poses.is_some(),
            flow: self.flow.is_some(),
            depth: self.depth.is_some(),
            masks: self.masks.is_some(),
            tracks: self.tracks.is_some(),
        }
    }

    /// Whether data is supplied for each frame, so that the user knows which frames these are.
    pub fn is_for_each_frame(&self) -> bool {
        let given = [&self.poses, &self.masks, &self.depth, &self.flow, &self.tracks];
        given.iter().any(|path| path.is_some())
    }

    /// Default size of the frames.
    pub fn size(&self, longest_side: u32) -> Resize {
        match self.flow {
            // Flow has the size of its frames.
            Some(_) => Resize::Keep,
            None => Resize::Longest(longest_side),
        }
    }

    /// The tracking options from the supplied data.
    pub fn options(&self, clip: &Clip, seed: u64) -> Result<Options> {
        let scale = f64::from(clip.width) / f64::from(clip.original.0);
        if let Some(focal) = self.focal {
            let whole = Intrinsics::centred(focal, clip.original.0, clip.original.1);
            whole.check().map_err(|what| Error::Input(format!("--focal {focal:?}: {what}")))?;
        }
        let cameras = given(&self.poses, clip, supplied::cameras)?;
        notes(cameras.as_ref().map_or(&[], |cameras| &cameras.notes));
        let told = cameras.as_ref().and_then(|cameras| cameras.intrinsics);
        let kind = match self.depth_kind {
            DepthKind::Measured => None,
            DepthKind::Estimated => Some(EstimatedKind::Depth),
            DepthKind::Shifted => Some(EstimatedKind::ShiftedDepth),
            DepthKind::Inverse => Some(EstimatedKind::ShiftedInverse),
        };
        let read = |file: &Path| match kind {
            None => depth::read(file, self.depth_scale),
            Some(_) => depth::read_stored(file, self.depth_scale),
        };
        let maps = given(&self.depth, clip, |path, clip| supplied::depth(path, clip, read))?;
        let (depth, estimated_depth) = match kind {
            None => (maps, None),
            Some(kind) => (None, maps.map(|maps| EstimatedDepth { maps, kind, confidence: None })),
        };
        Ok(Options {
            intrinsics: given(&self.intrinsics, clip, supplied::intrinsics)?
                .or(told.filter(|_| self.focal.is_none())),
            focal: self.focal.map(|focal| focal * scale).or(clip.focal),
            poses: cameras.map(|cameras| cameras.poses),
            refined: Refined {
                poses: self.refine.contains(&Refine::Poses),
                focal: self.refine.contains(&Refine::Focal),
            },
            masks: given(&self.masks, clip, supplied::masks)?,
            depth,
            estimated_depth,
            tracks: given(&self.tracks, clip, supplied::tracks)?,
            static_motion: self.static_motion,
            lens: !self.pinhole,
            seed,
            ..Options::default()
        })
    }

    /// The supplied flow.
    pub fn flow(&self, clip: &Clip) -> Result<Option<SuppliedFlow>> {
        given(&self.flow, clip, supplied::flow)
    }

    /// All input files, including those of the clip.
    pub fn inputs(&self, clip: &PathBuf) -> Inputs {
        let files =
            [Some(clip), self.intrinsics.as_ref(), self.poses.as_ref(), self.tracks.as_ref()];
        // A clip's or a flow's files may be one folder deeper.
        let below = |folder: Option<&PathBuf>, names: &[&str], extensions| -> Vec<Folder> {
            let inner =
                folder.map(|folder| names.iter().map(move |name| (folder.join(name), extensions)));
            inner.into_iter().flatten().collect()
        };
        let folders = [
            below(Some(clip), &["", "frames", "images"], &images::EXTENSIONS),
            below(self.masks.as_ref(), &[""], &images::EXTENSIONS),
            below(self.depth.as_ref(), &[""], &depth::EXTENSIONS),
            below(self.poses.as_ref(), &["", "sparse", "sparse/0", "colmap/sparse/0"], &CAMERAS),
            below(
                self.flow.as_ref(),
                &["flow_forward", "flow_backward", "forward", "backward"],
                &flow::EXTENSIONS,
            ),
        ];
        // Errors of the clip's folder are reported later.
        let frames = if clip.is_dir() { Clip::files(clip).unwrap_or_default() } else { Vec::new() };
        let files = files.into_iter().flatten().cloned().chain(self.networks.files()).chain(frames);
        Inputs::new(files, folders.into_iter().flatten())
    }
}

/// Data of a file or folder for the clip's frames.
fn given<T>(
    path: &Option<PathBuf>,
    clip: &Clip,
    read: impl FnOnce(&Path, &Clip) -> Result<T>,
) -> Result<Option<T>> {
    path.as_deref().map(|path| read(path, clip)).transpose()
}

/// Estimates flow, cameras, masks and depth.
pub fn observe(
    device: &Device,
    frames: &[Image],
    options: &Options,
    supplied: Option<SuppliedFlow>,
    models: &mut Option<Models>,
    observer: &mut dyn Observer,
) -> Result<Track> {
    let TrackNetworks { flow, masks, features } = TrackNetworks::of(models);
    let mut flow = flow_source(device, frames, supplied, flow)?;
    let sources = Sources {
        flow: flow.as_mut(),
        masks: masks.map(|network| network as &mut dyn MaskSource),
        features: features.map(|network| network as &mut dyn FeatureSource),
    };
    track_observed(frames, options, sources, observer)
}

/// The supplied flow, else a network's, else the engine's.
pub fn flow_source<'a>(
    device: &Device,
    frames: &'a [Image],
    supplied: Option<SuppliedFlow>,
    network: Option<&'a mut FlowNetwork>,
) -> Result<Box<dyn FlowSource + 'a>> {
    Ok(match (supplied, network) {
        (Some(flow), _) => Box::new(flow),
        (None, Some(network)) => Box::new(network.source(frames)),
        (None, None) => Box::new(EngineFlow::new(device, frames, &FlowSettings::default())?),
    })
}

/// Source of the focal length, for reports.
pub fn focal_source(source: FocalSource) -> &'static str {
    match source {
        FocalSource::Given => "given",
        FocalSource::Measured => "measured",
        FocalSource::Assumed => "assumed",
    }
}

/// The intrinsics of a clip and where they are from, for reports.
pub fn intrinsics_json(track: &Track) -> Value {
    let mut json = intrinsics::to_json(&track.intrinsics);
    json["source"] = json!(focal_source(track.quality.focal_source));
    json
}

/// Uncertainty of the cameras, for reports.
pub fn poses_json(found: &Quality) -> Value {
    json!({
        "tripod": found.tripod,
        "turns": found.turns,
        "inlier_share": found.inlier_share,
        "reprojection_rms": found.reprojection_rms,
        "parallax_deg": found.parallax_deg,
        "focal_std": found.focal_std,
        "doubtful_frames": found.doubtful_frames,
        "tracks": found.tracks,
        "motions": found.motions,
        "static_motion": found.static_motion,
    })
}

/// The lens that frames were undistorted with, for reports.
pub fn lens_json(lens: Option<&Lens>) -> Value {
    lens.map_or(Value::Null, |lens| {
        let mut json = intrinsics::to_json(&lens.intrinsics);
        json["k1"] = json!(lens.distortion.radial[0]);
        json
    })
}

/// The lens in a scene's report, as [`lens_json`] writes it.
///
/// # Errors
/// The entry is malformed.
pub fn lens_of(report: &Value) -> Result<Option<Lens>> {
    let told = &report["lens"];
    if told.is_null() {
        return Ok(None);
    }
    let bad =
        |what: String| Error::Input(format!("the scene's report has no valid `lens`: {what}"));
    let intrinsics = Intrinsics::deserialize(told).map_err(|error| bad(error.to_string()))?;
    let k1 = told["k1"].as_f64().ok_or_else(|| bad("`k1` is no number".into()))?;
    let distortion = Distortion { radial: [k1, 0.0, 0.0, 0.0], ..Default::default() };
    intrinsics.check().and_then(|()| distortion.check(&intrinsics)).map_err(bad)?;
    Ok(Some(Lens { intrinsics, distortion }))
}

/// The files that [`write_cameras`] writes.
pub const CAMERA_FILES: [&str; 2] = ["poses.txt", "intrinsics.json"];

/// Writes the cameras of a clip's frames: poses in TUM format, camera to world, with the frame's index as
/// the time, and the intrinsics of the first.
pub fn write_cameras(folder: &Path, cameras: impl Iterator<Item = Camera>) -> Result<()> {
    let cameras: Vec<Camera> = cameras.collect();
    let pose = |(i, camera): (usize, &Camera)| TimedPose {
        time: i as f64,
        world_from_view: camera.view_from_world.inverse(),
    };
    let poses: Vec<TimedPose> = cameras.iter().enumerate().map(pose).collect();
    trajectory::write(folder.join(CAMERA_FILES[0]), &poses)?;
    match cameras.first() {
        Some(first) => intrinsics::write(folder.join(CAMERA_FILES[1]), &first.intrinsics),
        None => Ok(()),
    }
}
