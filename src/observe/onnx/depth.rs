//! Networks that estimate depth from one image.

use std::path::Path;

use super::contract::{Contract, DepthContract};
use super::network::{Network, check_frame};
use super::picture::Layout;
use crate::Result;
use crate::observe::EstimatedDepth;
use crate::types::Image;

/// A network that estimates depth from one image.
pub struct DepthNetwork {
    network: Network,
    contract: DepthContract,
}

impl DepthNetwork {
    /// Makes the network from a model with a depth contract.
    pub(super) fn new((network, contract): (Network, Contract)) -> Result<DepthNetwork> {
        match contract {
            Contract::Depth(contract) => Ok(DepthNetwork { network, contract }),
            other => Err(network.listed_for("depth", &other)),
        }
    }

    /// Depth of a frame, one channel at its size; [`DepthNetwork::contract`] gives its meaning.
    ///
    /// # Errors
    /// A frame without three channels; the network fails, or its output violates its contract.
    pub fn depth(&mut self, frame: &Image) -> Result<Image> {
        check_frame(frame)?;
        let DepthContract { input, picture: rule, output, .. } = &self.contract;
        let layout = Layout::new(rule, (frame.width, frame.height));
        let picture = layout.picture(rule, frame);
        let given = vec![(input.as_str(), picture)];
        let found = self.network.run_pictures(given, layout.picture, &[output.as_str()])?;
        let planes = &found[0];
        self.network.check_channels(planes, 1, output)?;
        Ok(layout.nearest(&planes.values, planes.size))
    }

    /// Depth of all frames; `progress` is called with the share done.
    ///
    /// # Errors
    /// Those of [`DepthNetwork::depth`] and of `progress`.
    pub fn clip(
        &mut self,
        frames: &[Image],
        progress: &mut dyn FnMut(f64) -> Result<()>,
    ) -> Result<EstimatedDepth> {
        let mut maps = Vec::with_capacity(frames.len());
        for frame in frames {
            maps.push(self.depth(frame)?);
            progress(maps.len() as f64 / frames.len() as f64)?;
        }
        Ok(EstimatedDepth { maps, kind: self.contract.holds, confidence: None })
    }

    /// The network's file.
    pub fn file(&self) -> &Path {
        &self.network.file
    }

    /// The network's contract.
    pub fn contract(&self) -> &DepthContract {
        &self.contract
    }
}
