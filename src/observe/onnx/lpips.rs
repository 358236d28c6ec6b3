//! Networks for LPIPS, the perceptual distance between two images.

use std::path::Path;

use super::contract::{Contract, LpipsContract};
use super::network::{Network, check_pair};
use super::picture::Layout;
use super::runtime::Runtime;
use crate::Result;
use crate::types::Image;

/// An LPIPS network, which measures the perceptual distance between two images.
pub struct LpipsNetwork {
    network: Network,
    contract: LpipsContract,
}

impl LpipsNetwork {
    /// Opens a model file. It does not belong to a model folder, because it is only used for evaluation.
    ///
    /// # Errors
    /// A model that does not load, or whose metadata has no LPIPS contract.
    pub fn open(runtime: &Runtime, file: &Path) -> Result<LpipsNetwork> {
        let (network, contract) = Network::open(runtime, file, None)?;
        match contract {
            Contract::Lpips(contract) => Ok(LpipsNetwork { network, contract }),
            other => Err(network.listed_for("lpips", &other)),
        }
    }

    /// The network's contract.
    pub fn contract(&self) -> &LpipsContract {
        &self.contract
    }

    /// The distance between two images, RGB in [0, 1]; 0 for equal ones. Values outside [0, 1] are clamped.
    ///
    /// # Errors
    /// Images of different sizes or without three channels; the network fails, as it does on images that
    /// are too small for its features, or its output violates its contract.
    pub fn distance(&mut self, first: &Image, second: &Image) -> Result<f64> {
        check_pair("a distance is that of images", first, second)?;
        let LpipsContract { inputs, picture: rule, output, .. } = &self.contract;
        let layout = Layout::new(rule, (first.width, first.height));
        let shown = |picture: &Image| {
            let pixels = picture.pixels.iter().map(|v| v.clamp(0.0, 1.0)).collect();
            layout.picture(rule, &Image { pixels, ..*picture })
        };
        let given = vec![(inputs[0].as_str(), shown(first)), (inputs[1].as_str(), shown(second))];
        let found = self.network.run_pictures(given, layout.picture, &[output.as_str()])?;
        match found[0].values[..] {
            [distance] if distance.is_finite() => Ok(f64::from(distance)),
            ref values => {
                let what = match values {
                    [distance] => format!("is {distance}"),
                    _ => format!("has {} values, not one", values.len()),
                };
                Err(self.network.wrong(output, &what))
            }
        }
    }
}
