//! Pointmap networks: an encoder of one image, and a decoder of two.

use std::collections::HashMap;
use std::path::Path;

use super::contract::{Contract, PictureRule, PointmapDecoderContract, PointmapEncoderContract};
use super::network::{Network, Tensor, check_frame};
use super::picture::Layout;
use crate::observe::pointmaps::{PairMaps, Placement, PointmapSource};
use crate::types::Image;
use crate::{Error, Result};

/// A pointmap network.
pub struct PointmapNetwork {
    encoder: Network,
    decoder: Network,
    encodes: PointmapEncoderContract,
    decodes: PointmapDecoderContract,
}

impl PointmapNetwork {
    /// Makes the network from models with the contracts of a pointmap encoder and decoder.
    pub(super) fn new(
        (encoder, encodes): (Network, Contract),
        (decoder, decodes): (Network, Contract),
    ) -> Result<PointmapNetwork> {
        let encodes = match encodes {
            Contract::PointmapEncoder(contract) => contract,
            other => return Err(encoder.listed_for("pointmap_encoder", &other)),
        };
        let decodes = match decodes {
            Contract::PointmapDecoder(contract) => contract,
            other => return Err(decoder.listed_for("pointmap_decoder", &other)),
        };
        Ok(PointmapNetwork { encoder, decoder, encodes, decodes })
    }

    /// The decoder's file.
    pub fn file(&self) -> &Path {
        &self.decoder.file
    }

    /// A pointmap source for a clip. Each frame is encoded once, and its tokens are dropped when no later
    /// pair needs them.
    ///
    /// # Errors
    /// No frames, frames of different sizes or without three channels.
    pub fn source<'a>(&'a mut self, frames: &'a [Image]) -> Result<impl PointmapSource + 'a> {
        let Some(first) = frames.first() else {
            return Err(Error::Input("pointmaps are of frames, and there are none".into()));
        };
        for (i, frame) in frames.iter().enumerate() {
            check_frame(frame)?;
            if (frame.width, frame.height) != (first.width, first.height) {
                return Err(Error::Input(format!(
                    "pointmaps are of frames of one size; frame {i} is {}×{}, the first one {}×{}",
                    frame.width, frame.height, first.width, first.height
                )));
            }
        }
        let size = (first.width, first.height);
        let transposes = lies(&self.encodes.picture) && size.1 > size.0;
        let laid = if transposes { (size.1, size.0) } else { size };
        let layout = Layout::new(&self.encodes.picture, laid);
        Ok(ClipMaps { network: self, frames, layout, transposes, tokens: HashMap::new() })
    }

    /// Encodes an input image.
    fn encode(&mut self, picture: Vec<f32>, size: (u32, u32)) -> Result<Tensor> {
        let PointmapEncoderContract { input, output, .. } = &self.encodes;
        let picture = Tensor::of_picture(size, picture);
        let what = format!("{}×{} pixels", size.0, size.1);
        let mut found = self.encoder.run(&[(input, &picture)], &what, &[output])?;
        Ok(found.swap_remove(0))
    }

    /// Decodes the pointmaps of two images.
    fn decode(&mut self, tokens: [&Tensor; 2], size: (u32, u32)) -> Result<PairMaps> {
        let PointmapDecoderContract { inputs, points, confidence, .. } = &self.decodes;
        let given = [(inputs[0].as_str(), tokens[0]), (inputs[1].as_str(), tokens[1])];
        let outputs: Vec<&str> = points.iter().chain(confidence).map(String::as_str).collect();
        let what = format!("what its encoder gives for {}×{} pixels", size.0, size.1);
        let found = self.decoder.run(&given, &what, &outputs)?;
        let mut maps = Vec::with_capacity(4);
        for (k, (tensor, name)) in found.into_iter().zip(&outputs).enumerate() {
            maps.push(self.map(tensor, name, size, if k < 2 { 3 } else { 1 })?);
        }
        for (map, name) in maps[2..].iter().zip(confidence) {
            if let Some(low) = map.pixels.iter().find(|c| **c < 1.0) {
                let what = format!("is {low} at a pixel; confidence is 1 or more");
                return Err(self.decoder.wrong(name, &what));
            }
        }
        let [a, b, c, d]: [Image; 4] = maps.try_into().expect("as many as were asked for");
        Ok(PairMaps { points: [a, b], confidence: [c, d] })
    }

    /// Converts an output to a map of the input image.
    fn map(
        &self,
        Tensor { shape, values }: Tensor,
        name: &str,
        (width, height): (u32, u32),
        channels: u32,
    ) -> Result<Image> {
        let sides = [1, height as usize, width as usize, channels as usize];
        let wanted = if channels == 1 { &sides[..3] } else { &sides[..] };
        if shape != wanted {
            let what = format!(
                "came out as {shape:?} for an image of {width}×{height}, not as {wanted:?}"
            );
            return Err(self.decoder.wrong(name, &what));
        }
        self.decoder.check_finite(&values, name, (width, height))?;
        Ok(Image { width, height, channels, pixels: values })
    }
}

/// Whether the input image has a fixed landscape size.
fn lies(rule: &PictureRule) -> bool {
    rule.size[0] > rule.size[1]
}

/// The frame with x and y exchanged.
fn transposed(image: &Image) -> Image {
    let mut out = Image::new(image.height, image.width, image.channels);
    for y in 0..image.height {
        for x in 0..image.width {
            out.at_mut(y, x).copy_from_slice(image.at(x, y));
        }
    }
    out
}

/// A network's pointmap source for a clip.
struct ClipMaps<'a> {
    network: &'a mut PointmapNetwork,
    frames: &'a [Image],
    /// Layout of the frames as the network sees them.
    layout: Layout,
    /// Whether the network sees the frames with x and y exchanged, which mirrors the scene.
    transposes: bool,
    /// The encoder's outputs by frame.
    tokens: HashMap<usize, Tensor>,
}

impl ClipMaps<'_> {
    fn encode(&mut self, frame: usize) -> Result<()> {
        if self.tokens.contains_key(&frame) {
            return Ok(());
        }
        let Some(image) = self.frames.get(frame) else {
            let what =
                format!("pointmaps of frame {frame}: the clip has {} frames", self.frames.len());
            return Err(Error::Input(what));
        };
        let rule = self.network.encodes.picture;
        let picture = match self.transposes {
            true => self.layout.picture(&rule, &transposed(image)),
            false => self.layout.picture(&rule, image),
        };
        let tokens = self.network.encode(picture, self.layout.picture)?;
        self.tokens.insert(frame, tokens);
        Ok(())
    }
}

impl PointmapSource for ClipMaps<'_> {
    fn placement(&self) -> Placement {
        let placement = self.layout.placement();
        if self.transposes { placement.transposed() } else { placement }
    }

    fn pair(&mut self, first: usize, second: usize) -> Result<PairMaps> {
        self.encode(first)?;
        self.encode(second)?;
        let tokens = [first, second].map(|frame| &self.tokens[&frame]);
        let mut maps = self.network.decode(tokens, self.layout.picture)?;
        if self.transposes {
            maps.points
                .iter_mut()
                .chain(&mut maps.confidence)
                .for_each(|map| *map = transposed(map));
            let points = maps.points.iter_mut().flat_map(|map| map.pixels.chunks_exact_mut(3));
            points.for_each(|point| point.swap(0, 1));
        }
        Ok(maps)
    }

    fn forget(&mut self, before: usize) {
        self.tokens.retain(|frame, _| *frame >= before);
    }
}
