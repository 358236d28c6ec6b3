//! Networks that the user has: depth and flow, run through the ONNX Runtime.
//!
//! A folder holds the models and `models.toml`, which says what each is for:
//!
//! ```toml
//! [depth]
//! file = "depth_anything_v2_small.onnx"
//!
//! # Only for a model whose metadata has no contract of its own.
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
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`contract`] | what a model says of itself, held against what it is |
//! | [`networks`] | networks for depth and flow |
//! | `picture` | a frame as a network takes it, and the way back |
//! | [`runtime`] | the runtime's library, found and loaded |

pub mod contract;
pub mod networks;
mod picture;
pub mod runtime;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{Error, Result, io};
pub use contract::Contract;
use networks::AnyNetwork;
pub use networks::{DepthNetwork, FlowNetwork};
pub use runtime::{Provider, Runtime, RuntimeOptions};

/// The file in a folder of models that says what each is for.
pub const LIST: &str = "models.toml";

/// What [`LIST`] says of a model.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    file: PathBuf,
    contract: Option<Contract>,
}

/// The networks of a folder, one for each purpose at most.
pub struct Models {
    /// Estimates depth.
    pub depth: Option<DepthNetwork>,
    /// Estimates flow.
    pub flow: Option<FlowNetwork>,
}

impl Models {
    /// Opens the models that a folder's [`LIST`] names.
    ///
    /// # Errors
    /// No such file, one that is no list or names an unknown purpose or a file outside the folder, a model that
    /// does not load, one that is of another kind than it is listed for.
    pub fn open(runtime: &Runtime, folder: &Path) -> Result<Models> {
        let mut models = Models { depth: None, flow: None };
        for (purpose, (file, contract)) in listed(folder)? {
            let network = AnyNetwork::open(runtime, &file, contract.as_ref())?;
            let kind = match &network {
                AnyNetwork::Depth(_) => "depth",
                AnyNetwork::Flow(_) => "flow",
            };
            if kind != purpose {
                let what = format!("is listed for {purpose}, and computes {kind}");
                return Err(Error::format(file, what));
            }
            match network {
                AnyNetwork::Depth(network) => models.depth = Some(network),
                AnyNetwork::Flow(network) => models.flow = Some(network),
            }
        }
        Ok(models)
    }

    /// The files that [`Models::open`] reads.
    ///
    /// # Errors
    /// As [`Models::open`] for the list itself.
    pub fn files(folder: &Path) -> Result<Vec<PathBuf>> {
        let models = listed(folder)?.into_values().map(|(file, _)| file);
        Ok(std::iter::once(folder.join(LIST)).chain(models).collect())
    }
}

/// What a folder's list says: for each purpose a file, and a contract where it holds one.
fn listed(folder: &Path) -> Result<BTreeMap<String, (PathBuf, Option<Contract>)>> {
    let list = folder.join(LIST);
    let text = io::read_text(&list)?;
    let entries: BTreeMap<String, Entry> =
        toml::from_str(&text).map_err(|error| Error::format(&list, error.to_string()))?;
    if entries.is_empty() {
        return Err(Error::format(&list, "names no model"));
    }
    let mut out = BTreeMap::new();
    for (purpose, Entry { file, contract }) in entries {
        if !["depth", "flow"].contains(&purpose.as_str()) {
            let what = format!("[{purpose}] is no purpose of a model; there are depth and flow");
            return Err(Error::format(&list, what));
        }
        out.insert(purpose, (folder.join(file), contract));
    }
    Ok(out)
}
