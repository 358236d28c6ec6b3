//! Networks that estimate optical flow from one image to another.

use std::path::Path;

use super::contract::{Contract, FlowContract};
use super::network::{Network, check_pair};
use super::picture::Layout;
use crate::Result;
use crate::observe::flow::neighbours;
use crate::observe::{FlowPair, FlowSource};
use crate::types::Image;

/// A network that estimates optical flow from one image to another.
pub struct FlowNetwork {
    network: Network,
    contract: FlowContract,
}

impl FlowNetwork {
    /// Makes the network from a model with a flow contract.
    pub(super) fn new((network, contract): (Network, Contract)) -> Result<FlowNetwork> {
        match contract {
            Contract::Flow(contract) => Ok(FlowNetwork { network, contract }),
            other => Err(network.listed_for("flow", &other)),
        }
    }

    /// The network's file.
    pub fn file(&self) -> &Path {
        &self.network.file
    }

    /// The network's contract.
    pub fn contract(&self) -> &FlowContract {
        &self.contract
    }

    /// Flow from one frame to another in pixels of the frames, two channels, and its confidence where the
    /// network gives one.
    ///
    /// # Errors
    /// Frames of different sizes or without three channels; the network fails, its output violates its
    /// contract, or the flow is not finite.
    pub fn flow(&mut self, from: &Image, to: &Image) -> Result<(Image, Option<Image>)> {
        check_pair("flow leads between frames", from, to)?;
        let FlowContract { inputs, picture: rule, output, confidence, .. } = &self.contract;
        let layout = Layout::new(rule, (from.width, from.height));
        let given = vec![
            (inputs[0].as_str(), layout.picture(rule, from)),
            (inputs[1].as_str(), layout.picture(rule, to)),
        ];
        let outputs: Vec<&str> =
            std::iter::once(output.as_str()).chain(confidence.as_deref()).collect();
        let found = self.network.run_pictures(given, layout.picture, &outputs)?;
        self.network.check_channels(&found[0], 2, output)?;
        self.network.check_finite(&found[0].values, output, layout.picture)?;
        let mut flow = layout.nearest(&found[0].values, found[0].size);
        let scale = layout.frame_from_picture();
        for vector in flow.pixels.chunks_exact_mut(2) {
            (vector[0], vector[1]) = (vector[0] * scale[0], vector[1] * scale[1]);
        }
        let confidence = match (found.get(1), confidence) {
            (Some(planes), Some(name)) => {
                self.network.check_channels(planes, 1, name)?;
                let mut image = layout.nearest(&planes.values, planes.size);
                image.pixels.iter_mut().for_each(|c| *c = c.clamp(0.0, 1.0));
                Some(image)
            }
            _ => None,
        };
        Ok((flow, confidence))
    }

    /// A flow source for a clip.
    pub fn source<'a>(&'a mut self, frames: &'a [Image]) -> impl FlowSource + 'a {
        NetworkFlow { network: self, frames }
    }
}

/// A network's flow between the frames of a clip.
struct NetworkFlow<'a> {
    network: &'a mut FlowNetwork,
    frames: &'a [Image],
}

impl FlowSource for NetworkFlow<'_> {
    fn pair(&mut self, first: usize) -> Result<FlowPair> {
        let (here, next) = neighbours(self.frames, first)?;
        let (forward, forward_confidence) = self.network.flow(here, next)?;
        let (backward, backward_confidence) = self.network.flow(next, here)?;
        Ok(FlowPair { forward, backward, forward_confidence, backward_confidence })
    }
}
