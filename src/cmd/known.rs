//! What the user knows of a clip before it is tracked, and the tracking itself: what `reconstruct` and
//! `track` share.

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

/// Extensions of files of cameras in a folder.
const CAMERAS: [&str; 4] = ["cam", "bin", "txt", "json"];

/// What is supplied and adjusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Refine {
    /// Poses; the first one and the scale are kept
    Poses,
    /// The focal length, where the clip shows it
    Focal,
}

/// What depth maps hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DepthKind {
    /// Depth z up to one scale for the whole clip; it is kept
    Measured,
    /// A network's depth z, up to a scale of each frame
    Estimated,
    /// A network's depth z, up to a scale and a shift of each frame
    Shifted,
    /// A network's inverse depth, up to a scale and a shift of each frame, as MiDaS and Depth Anything
    /// write it
    Inverse,
}

/// What is known of a clip.
#[derive(Args)]
pub struct KnownArgs {
    /// Focal length, in pixels of the clip's own size
    #[arg(long, value_name = "PIXELS",
          value_parser = values::number(1.0..=values::MOST_FOCAL))]
    pub focal: Option<f64>,
    /// Intrinsics: JSON with fx, fy, cx, cy, width, height
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    intrinsics: Option<PathBuf>,
    /// Camera poses in any unit, one per frame or named as the frames are: a file of TUM, KITTI or EuRoC
    /// (camera to world) or a transforms.json; a folder with one, with a COLMAP model, with Sintel's .cam
    /// files, written by MonST3R, or a dataset that `train` takes. Intrinsics told there are used unless given here
    #[arg(long, value_name = "FILE|DIR")]
    poses: Option<PathBuf>,
    /// What of --poses and of the focal length is only where to begin, and is adjusted to the clip
    #[arg(long, value_name = "WHAT", value_enum, value_delimiter = ',')]
    pub refine: Vec<Refine>,
    /// Take the frames for those of a pinhole: a lens's distortion is not looked for
    #[arg(long)]
    pub pinhole: bool,
    /// Motion masks: a folder of images, white where something moves or with a colour for each object
    /// (DAVIS), one per frame or named as the frames are (of MonST3R's folder dynamic_mask_*.png); those that
    /// flicker or slip are mended, and noted
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Depth maps: a folder of EXR, .npy, .npz or Sintel's .dpt files or of grey 16-bit PNGs (of MonST3R's
    /// folder frame_*.npy), z up to one scale, 0 where unknown; --depth-kind says otherwise
    #[arg(long, value_name = "DIR")]
    depth: Option<PathBuf>,
    /// What a unit of length is in a PNG of depth
    #[arg(long, value_name = "VALUE", default_value_t = 1000.0, requires = "depth",
          value_parser = values::number(1e-6..=1e9))]
    pub depth_scale: f64,
    /// What the maps of --depth hold. A network's fill in what the clip does not show, and tell the movers'
    /// shapes and distances, once each frame is brought to the scale of what was triangulated
    #[arg(long, value_name = "KIND", value_enum, default_value = "measured", requires = "depth")]
    pub depth_kind: DepthKind,
    /// Optical flow: a folder with files of .flo, .npy or .npz (height × width × 2) or KITTI's PNG in
    /// flow_forward and flow_backward (or forward and backward); frames keep their own size then unless
    /// another is asked for
    #[arg(long, value_name = "DIR")]
    flow: Option<PathBuf>,
    /// Points followed through the clip, besides those that the program follows: an .npz as TAPIR
    /// (tracks, visibles) or CoTracker (pred_tracks, pred_visibility) write it, one place for each frame
    #[arg(long, value_name = "FILE")]
    tracks: Option<PathBuf>,
    /// Take this rigid motion for that of the static world, counted from 0 as the notes of an earlier run
    /// count them
    #[arg(long = "static", value_name = "N", conflicts_with_all = ["poses", "masks"],
          value_parser = values::whole::<usize>(0..=Options::MOST_MOTIONS as u64 - 1))]
    pub static_motion: Option<usize>,
    #[command(flatten)]
    pub networks: NetworkArgs,
}

impl KnownArgs {
    /// That options go with each other.
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

    /// Whether flow need not be computed.
    pub fn supplies_flow(&self) -> bool {
        self.flow.is_some()
    }

    /// Whether there are poses to begin with.
    pub fn supplies_poses(&self) -> bool {
        self.poses.is_some()
    }

    /// What is supplied.
    pub fn given(&self) -> Given {
        Given {
            poses: self.poses.is_some(),
            flow: self.flow.is_some(),
            depth: self.depth.is_some(),
            masks: self.masks.is_some(),
            tracks: self.tracks.is_some(),
        }
    }

    /// Whether there is something for each frame, so that the user knows which these are.
    pub fn is_for_each_frame(&self) -> bool {
        let given = [&self.poses, &self.masks, &self.depth, &self.flow, &self.tracks];
        given.iter().any(|path| path.is_some())
    }

    /// The size of the frames where no option says it.
    pub fn size(&self, longest_side: u32) -> Resize {
        match self.flow {
            // Flow is of its frames' own size.
            Some(_) => Resize::Keep,
            None => Resize::Longest(longest_side),
        }
    }

    /// What is known beforehand.
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

    /// The flow that is known.
    pub fn flow(&self, clip: &Clip) -> Result<Option<SuppliedFlow>> {
        given(&self.flow, clip, supplied::flow)
    }

    /// All files that are read, those of the clip among them.
    pub fn inputs(&self, clip: &PathBuf) -> Inputs {
        let files =
            [Some(clip), self.intrinsics.as_ref(), self.poses.as_ref(), self.tracks.as_ref()];
        // A clip's or a flow's files may lie one folder deeper.
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
        // Which files a folder's frames are is not found out here where that is an error later.
        let frames = if clip.is_dir() { Clip::files(clip).unwrap_or_default() } else { Vec::new() };
        let files = files.into_iter().flatten().cloned().chain(self.networks.files()).chain(frames);
        Inputs::new(files, folders.into_iter().flatten())
    }
}

/// What a file or folder holds for the clip's frames.
fn given<T>(
    path: &Option<PathBuf>,
    clip: &Clip,
    read: impl FnOnce(&Path, &Clip) -> Result<T>,
) -> Result<Option<T>> {
    path.as_deref().map(|path| read(path, clip)).transpose()
}

/// Flow, cameras, masks, depth.
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

/// Flow that is supplied, else a network's, else the engine's.
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

/// How a focal length was come by, in reports.
pub fn focal_source(source: FocalSource) -> &'static str {
    match source {
        FocalSource::Given => "given",
        FocalSource::Measured => "measured",
        FocalSource::Assumed => "assumed",
    }
}

/// How well cameras are known, for reports.
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

/// The lens that frames were undistorted by, for reports.
pub fn lens_json(lens: Option<&Lens>) -> Value {
    lens.map_or(Value::Null, |lens| {
        let mut json = intrinsics::to_json(&lens.intrinsics);
        json["k1"] = json!(lens.distortion.radial[0]);
        json
    })
}

/// The lens that a scene's report tells of: what [`lens_json`] wrote there.
///
/// # Errors
/// Something else there.
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

/// What [`write_cameras`] writes.
pub const CAMERA_FILES: [&str; 2] = ["poses.txt", "intrinsics.json"];

/// Writes the cameras of a clip's frames: poses as TUM, camera to world, the time being the frame's index,
/// and the intrinsics of the first.
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
