//! User-supplied networks, run through the ONNX Runtime: for depth, flow, masks, pointmaps and features,
//! and for LPIPS, which evaluates images.
//!
//! A folder contains the models and `models.toml`, which lists the purpose of each:
//!
//! ```toml
//! [depth]
//! file = "depth_anything_v2_small.onnx"
//!
//! # Only for a model whose metadata has no contract.
//! [depth.contract]
//! kind = "depth"
//! version = 1
//! input = "image"
//! output = "depth"
//! holds = "shifted_inverse"
//! picture = { multiple = 14, shorter = 518, mean = [0.485, 0.456, 0.406], deviation = [0.229, 0.224, 0.225] }
//!
//! [flow]
//! file = "sea_raft_small.onnx"
//!
//! # SAM 2: both, or none.
//! [mask_encoder]
//! file = "sam2_small.encoder.onnx"
//!
//! [mask_decoder]
//! file = "sam2_small.decoder.onnx"
//!
//! # MonST3R or DUSt3R: both, or none.
//! [pointmap_encoder]
//! file = "monst3r_encoder.onnx"
//!
//! [pointmap_decoder]
//! file = "monst3r_decoder.onnx"
//!
//! [features]
//! file = "xfeat.onnx"
//! ```
//!
//! An LPIPS network is not part of such a folder: [`LpipsNetwork::open`] takes its file.
//!
//! | module | contents |
//! |---|---|
//! | [`contract`] | a model's contract, checked against the model |
//! | `depth`, `features`, `flow`, `mask`, `pointmap`, `lpips` | networks of each kind |
//! | `network` | a loaded model: named tensors in, named tensors out |
//! | `picture` | conversion between a frame and a network's input image |
//! | [`runtime`] | finding and loading the runtime's library |

pub mod contract;
mod depth;
mod features;
mod flow;
mod lpips;
mod mask;
mod network;
mod picture;
mod pointmap;
pub mod runtime;

use std::path::{Component, Path, PathBuf};

use serde::Deserialize;

use crate::{Error, Result, io};
pub use contract::Contract;
pub use depth::DepthNetwork;
pub use features::FeaturesNetwork;
pub use flow::FlowNetwork;
pub use lpips::LpipsNetwork;
pub use mask::MaskNetwork;
use network::Network;
pub use pointmap::PointmapNetwork;
pub use runtime::{Provider, Runtime, RuntimeOptions};

/// The file in a model folder that lists the purpose of each model.
pub const LIST: &str = "models.toml";

/// Contents of [`LIST`]: a model for each purpose.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    depth: Option<Entry>,
    flow: Option<Entry>,
    mask_encoder: Option<Entry>,
    mask_decoder: Option<Entry>,
    pointmap_encoder: Option<Entry>,
    pointmap_decoder: Option<Entry>,
    features: Option<Entry>,
}

/// A model's file within the folder, and its contract where its metadata has none.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    file: PathBuf,
    contract: Option<Contract>,
}

impl List {
    /// Reads a folder's list.
    fn read(folder: &Path) -> Result<List> {
        let path = folder.join(LIST);
        let list: List = toml::from_str(&io::read_text(&path)?)
            .map_err(|error| Error::format(&path, error.to_string()))?;
        let files: Vec<&Path> = list.entries().map(|entry| entry.file.as_path()).collect();
        if files.is_empty() {
            return Err(Error::format(&path, "names no model"));
        }
        let within = |file: &Path| file.components().all(|c| matches!(c, Component::Normal(_)));
        match files.into_iter().find(|file| !within(file)) {
            Some(file) => Err(Error::format(
                &path,
                format!("names {}, which is not within its folder; move it there", file.display()),
            )),
            None => Ok(list),
        }
    }

    fn entries(&self) -> impl Iterator<Item = &Entry> {
        let masks = [&self.mask_encoder, &self.mask_decoder];
        let pointmaps = [&self.pointmap_encoder, &self.pointmap_decoder];
        let alone = [&self.depth, &self.flow, &self.features];
        alone.into_iter().chain(masks).chain(pointmaps).flatten()
    }
}

/// The networks of a folder, at most one for each purpose.
pub struct Models {
    /// Estimates depth.
    pub depth: Option<DepthNetwork>,
    /// Estimates optical flow.
    pub flow: Option<FlowNetwork>,
    /// Segments objects from point prompts.
    pub masks: Option<MaskNetwork>,
    /// Estimates pointmaps of pairs of images.
    pub pointmaps: Option<PointmapNetwork>,
    /// Detects and describes keypoints.
    pub features: Option<FeaturesNetwork>,
}

impl Models {
    /// Opens the models that a folder's [`LIST`] names.
    ///
    /// # Errors
    /// There is no [`LIST`], or it is malformed or names an unknown purpose or a file outside the folder; a
    /// model does not load or has another kind than listed; an encoder is without its decoder, or the
    /// reverse.
    pub fn open(runtime: &Runtime, folder: &Path) -> Result<Models> {
        let list = List::read(folder)?;
        let open = |Entry { file, contract }: Entry| {
            Network::open(runtime, &folder.join(file), contract.as_ref())
        };
        let masks = both(folder, "mask", list.mask_encoder, list.mask_decoder)?;
        let points = both(folder, "pointmap", list.pointmap_encoder, list.pointmap_decoder)?;
        let masks =
            masks.map(|(encoder, decoder)| MaskNetwork::new(open(encoder)?, open(decoder)?));
        let pointmaps =
            points.map(|(encoder, decoder)| PointmapNetwork::new(open(encoder)?, open(decoder)?));
        Ok(Models {
            depth: list.depth.map(|entry| open(entry).and_then(DepthNetwork::new)).transpose()?,
            flow: list.flow.map(|entry| open(entry).and_then(FlowNetwork::new)).transpose()?,
            masks: masks.transpose()?,
            pointmaps: pointmaps.transpose()?,
            features: list
                .features
                .map(|entry| open(entry).and_then(FeaturesNetwork::new))
                .transpose()?,
        })
    }

    /// The files that [`Models::open`] reads.
    ///
    /// # Errors
    /// Those of [`Models::open`] for the list.
    pub fn files(folder: &Path) -> Result<Vec<PathBuf>> {
        let list = List::read(folder)?;
        let models = list.entries().map(|entry| folder.join(&entry.file));
        Ok(std::iter::once(folder.join(LIST)).chain(models).collect())
    }
}

/// An encoder and its decoder; it is an error if only one of them is given.
fn both(
    folder: &Path,
    what: &str,
    encoder: Option<Entry>,
    decoder: Option<Entry>,
) -> Result<Option<(Entry, Entry)>> {
    let lacks = |has: &str, lacks: &str| {
        let what = format!("has `{what}_{has}` without `{what}_{lacks}`; list both, or none");
        Err(Error::format(folder.join(LIST), what))
    };
    match (encoder, decoder) {
        (Some(encoder), Some(decoder)) => Ok(Some((encoder, decoder))),
        (None, None) => Ok(None),
        (Some(_), None) => lacks("encoder", "decoder"),
        (None, Some(_)) => lacks("decoder", "encoder"),
    }
}
