//! Networks of each kind: a frame in, what it tells of the frame out.

use std::path::{Path, PathBuf};

use ort::session::{Session, SessionInputValue};
use ort::value::TensorRef;

use super::contract::{Contract, DepthContract, FlowContract, LpipsContract};
use super::picture::Layout;
use super::runtime::Runtime;
use crate::observe::flow::neighbours;
use crate::observe::{EstimatedDepth, FlowPair, FlowSource};
use crate::types::Image;
use crate::{Error, Result};

/// A loaded model.
pub(super) struct Network {
    session: Session,
    file: PathBuf,
}

/// An output: its channels one after the other.
struct Planes {
    values: Vec<f32>,
    channels: usize,
    size: (u32, u32),
}

impl Network {
    /// Loads a model. `given` is its contract where its metadata has none.
    ///
    /// # Errors
    /// A file that cannot be read or that is no model, a contract that is absent or does not hold.
    pub fn open(
        runtime: &Runtime,
        file: &Path,
        given: Option<&Contract>,
    ) -> Result<(Network, Contract)> {
        let session = runtime.session(file)?;
        let contract = Contract::of(&session, file, given)?;
        Ok((Network { session, file: file.to_owned() }, contract))
    }

    /// Runs it on pictures of a size, by the names of its inputs, and returns the outputs of these names.
    fn run(
        &mut self,
        inputs: &[(&str, &[f32])],
        (width, height): (u32, u32),
        outputs: &[&str],
    ) -> Result<Vec<Planes>> {
        let file = &self.file;
        let failed = |error: ort::Error| {
            Error::format(file, format!("does not run on {width}×{height} pixels: {error}"))
        };
        let shape = [1, 3, height as usize, width as usize];
        let mut given: Vec<(&str, SessionInputValue<'_>)> = Vec::new();
        for (name, picture) in inputs {
            let tensor = TensorRef::from_array_view((shape, *picture)).map_err(failed)?;
            given.push((name, tensor.into()));
        }
        let found = self.session.run(given).map_err(failed)?;
        outputs
            .iter()
            .map(|name| {
                let value = found.get(*name).ok_or_else(|| {
                    Error::format(file, format!("has not computed its output `{name}`"))
                })?;
                let (shape, values) = value.try_extract_tensor::<f32>().map_err(failed)?;
                let planes = match *shape.as_ref() {
                    [1, c, h, w] if c > 0 && h > 0 && w > 0 => Some((c, h, w)),
                    [1, h, w] if h > 0 && w > 0 => Some((1, h, w)),
                    _ => None,
                };
                let (channels, h, w) = planes.ok_or_else(|| {
                    let what =
                        format!("its output `{name}` came out as {shape:?}, which is no picture");
                    Error::format(file, what)
                })?;
                Ok(Planes {
                    values: values.to_vec(),
                    channels: channels as usize,
                    size: (w as u32, h as u32),
                })
            })
            .collect()
    }
}

/// A network that estimates depth from one picture.
pub struct DepthNetwork {
    network: Network,
    contract: DepthContract,
}

impl DepthNetwork {
    /// A model whose contract is one for depth.
    pub(super) fn new((network, contract): (Network, Contract)) -> Result<DepthNetwork> {
        match contract {
            Contract::Depth(contract) => Ok(DepthNetwork { network, contract }),
            other => Err(listed_for("depth", &network, &other)),
        }
    }

    /// The depth of a frame, one channel at its size, as [`DepthNetwork::contract`] says what it holds.
    ///
    /// # Errors
    /// A frame without three channels; the network fails, or says something else than its contract.
    pub fn depth(&mut self, frame: &Image) -> Result<Image> {
        check_frame(frame)?;
        let DepthContract { input, picture: rule, output, .. } = &self.contract;
        let layout = Layout::new(rule, (frame.width, frame.height));
        let picture = layout.picture(rule, frame);
        let found =
            self.network.run(&[(input.as_str(), &picture)], layout.picture, &[output.as_str()])?;
        let planes = &found[0];
        check_channels(planes, 1, output, &self.network.file)?;
        Ok(layout.nearest(&planes.values, planes.size))
    }

    /// The depth of all frames; `progress` is called with the share done.
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
        Ok(EstimatedDepth { maps, kind: self.contract.holds })
    }

    /// What the network says of itself.
    pub fn contract(&self) -> &DepthContract {
        &self.contract
    }
}

/// A network that estimates flow from one picture to another.
pub struct FlowNetwork {
    network: Network,
    contract: FlowContract,
}

impl FlowNetwork {
    /// A model whose contract is one for flow.
    pub(super) fn new((network, contract): (Network, Contract)) -> Result<FlowNetwork> {
        match contract {
            Contract::Flow(contract) => Ok(FlowNetwork { network, contract }),
            other => Err(listed_for("flow", &network, &other)),
        }
    }

    /// What the network says of itself.
    pub fn contract(&self) -> &FlowContract {
        &self.contract
    }

    /// Flow from one frame to another in pixels of the frames, two channels, and its confidence where the network
    /// tells one.
    ///
    /// # Errors
    /// Frames of different size or without three channels; the network fails, says something else than its
    /// contract, or gives flow that is not finite.
    pub fn flow(&mut self, from: &Image, to: &Image) -> Result<(Image, Option<Image>)> {
        check_pair("flow leads between frames", from, to)?;
        let FlowContract { inputs, picture: rule, output, confidence, .. } = &self.contract;
        let layout = Layout::new(rule, (from.width, from.height));
        let pictures = [layout.picture(rule, from), layout.picture(rule, to)];
        let given =
            [(inputs[0].as_str(), &pictures[0][..]), (inputs[1].as_str(), &pictures[1][..])];
        let outputs: Vec<&str> =
            std::iter::once(output.as_str()).chain(confidence.as_deref()).collect();
        let found = self.network.run(&given, layout.picture, &outputs)?;
        check_channels(&found[0], 2, output, &self.network.file)?;
        let unknown = found[0].values.iter().filter(|value| !value.is_finite()).count();
        if unknown > 0 {
            let (width, height) = layout.picture;
            let what = format!(
                "its output `{output}` is not finite at {unknown} of {} values; some networks take no picture \
                 as small as {width}×{height}",
                found[0].values.len()
            );
            return Err(Error::format(&self.network.file, what));
        }
        let mut flow = layout.nearest(&found[0].values, found[0].size);
        let scale = layout.frame_from_picture();
        for vector in flow.pixels.chunks_exact_mut(2) {
            (vector[0], vector[1]) = (vector[0] * scale[0], vector[1] * scale[1]);
        }
        let confidence = match (found.get(1), confidence) {
            (Some(planes), Some(name)) => {
                check_channels(planes, 1, name, &self.network.file)?;
                let mut image = layout.nearest(&planes.values, planes.size);
                image.pixels.iter_mut().for_each(|c| *c = c.clamp(0.0, 1.0));
                Some(image)
            }
            _ => None,
        };
        Ok((flow, confidence))
    }

    /// The flow of a clip.
    pub fn source<'a>(&'a mut self, frames: &'a [Image]) -> impl FlowSource + 'a {
        NetworkFlow { network: self, frames }
    }
}

/// A network that tells how different two pictures look: LPIPS.
pub struct LpipsNetwork {
    network: Network,
    contract: LpipsContract,
}

impl LpipsNetwork {
    /// Opens a model's file, which belongs to no folder of models: it measures, and reconstructs nothing.
    ///
    /// # Errors
    /// A model that does not load, or whose metadata holds no contract for LPIPS.
    pub fn open(runtime: &Runtime, file: &Path) -> Result<LpipsNetwork> {
        let (network, contract) = Network::open(runtime, file, None)?;
        match contract {
            Contract::Lpips(contract) => Ok(LpipsNetwork { network, contract }),
            other => Err(listed_for("lpips", &network, &other)),
        }
    }

    /// What the network says of itself.
    pub fn contract(&self) -> &LpipsContract {
        &self.contract
    }

    /// The distance of two pictures, RGB in [0, 1]; 0 for equal ones. What lies outside [0, 1] is clamped.
    ///
    /// # Errors
    /// Pictures of different size or without three channels; the network fails, as it does on pictures that are
    /// too small for its features, or says something else than its contract.
    pub fn distance(&mut self, first: &Image, second: &Image) -> Result<f64> {
        check_pair("a distance is that of pictures", first, second)?;
        let LpipsContract { inputs, picture: rule, output, .. } = &self.contract;
        let layout = Layout::new(rule, (first.width, first.height));
        let pictures = [first, second].map(|picture| {
            let pixels = picture.pixels.iter().map(|v| v.clamp(0.0, 1.0)).collect();
            layout.picture(rule, &Image { pixels, ..*picture })
        });
        let given =
            [(inputs[0].as_str(), &pictures[0][..]), (inputs[1].as_str(), &pictures[1][..])];
        let found = self.network.run(&given, layout.picture, &[output.as_str()])?;
        match found[0].values[..] {
            [distance] if distance.is_finite() => Ok(f64::from(distance)),
            ref values => {
                let what = match values {
                    [distance] => format!("its output `{output}` is {distance}"),
                    _ => format!("its output `{output}` has {} values, not one", values.len()),
                };
                Err(Error::format(&self.network.file, what))
            }
        }
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

/// That a model is listed for what it does not compute.
fn listed_for(purpose: &str, network: &Network, contract: &Contract) -> Error {
    let what = format!("is listed for {purpose}, and computes {}", contract.kind());
    Error::format(&network.file, what)
}

fn check_frame(frame: &Image) -> Result<()> {
    if frame.channels != 3 || frame.width == 0 || frame.height == 0 {
        return Err(Error::Input(format!(
            "a network takes RGB frames, not one of {}×{} with {} channels",
            frame.width, frame.height, frame.channels
        )));
    }
    Ok(())
}

/// That two pictures are ones that a network takes, and of one size; `what` is asked of such.
fn check_pair(what: &str, from: &Image, to: &Image) -> Result<()> {
    check_frame(from)?;
    check_frame(to)?;
    if (from.width, from.height) != (to.width, to.height) {
        return Err(Error::Input(format!(
            "{what} of one size, not from {}×{} to {}×{}",
            from.width, from.height, to.width, to.height
        )));
    }
    Ok(())
}

fn check_channels(planes: &Planes, channels: usize, name: &str, file: &Path) -> Result<()> {
    if planes.channels != channels {
        return Err(Error::format(
            file,
            format!("its output `{name}` has {} channels, not {channels}", planes.channels),
        ));
    }
    Ok(())
}
