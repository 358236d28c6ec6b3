//! Networks that segment objects from point prompts, such as SAM 2: an image encoder and a decoder.

use std::path::Path;

use super::contract::{Contract, MaskDecoderContract, MaskEncoderContract};
use super::network::{Network, Tensor, check_frame};
use super::picture::{Axis, Layout};
use crate::observe::{FoundMask, MaskQuery, MaskSource};
use crate::types::Image;
use crate::{Error, Result};

/// A network that segments objects from point prompts.
pub struct MaskNetwork {
    encoder: Network,
    decoder: Network,
    encoding: MaskEncoderContract,
    decoding: MaskDecoderContract,
    /// Width and height of the decoder's input and output masks.
    mask: (u32, u32),
}

impl MaskNetwork {
    /// Makes the network from models with the contracts of a mask encoder and a mask decoder.
    pub(super) fn new(
        (encoder, encoding): (Network, Contract),
        (decoder, decoding): (Network, Contract),
    ) -> Result<MaskNetwork> {
        let encoding = match encoding {
            Contract::MaskEncoder(contract) => contract,
            other => return Err(encoder.listed_for("mask_encoder", &other)),
        };
        let decoding = match decoding {
            Contract::MaskDecoder(contract) => contract,
            other => return Err(decoder.listed_for("mask_decoder", &other)),
        };
        if encoding.outputs.len() != decoding.features.len() {
            let what = format!(
                "takes {} features ({}), and {} gives {} ({}); export both together",
                decoding.features.len(),
                decoding.features.join(", "),
                encoder.file.display(),
                encoding.outputs.len(),
                encoding.outputs.join(", ")
            );
            return Err(Error::format(&decoder.file, what));
        }
        // Where the model does not fix the sides of its masks, they are those of the input image.
        let [width, height] = encoding.picture.size;
        let told = decoder.input_shape(&decoding.mask_input);
        let side = |axis: usize, picture: u32| match told.get(axis) {
            Some(side) if *side > 0 => *side as u32,
            _ => picture,
        };
        let mask = (side(3, width), side(2, height));
        Ok(MaskNetwork { encoder, decoder, encoding, decoding, mask })
    }

    /// The decoder's file.
    pub fn file(&self) -> &Path {
        &self.decoder.file
    }

    /// The encoder's contract.
    pub fn encoder(&self) -> &MaskEncoderContract {
        &self.encoding
    }

    /// The decoder's contract.
    pub fn decoder(&self) -> &MaskDecoderContract {
        &self.decoding
    }

    /// Masks of each queried object in a frame, which is encoded once for all of them.
    ///
    /// # Errors
    /// A frame without three channels, a query without points, an initial mask whose size differs from the
    /// frame's; a network fails, its output violates its contract, or is not finite.
    pub fn ask(&mut self, frame: &Image, asked: &[MaskQuery]) -> Result<Vec<Vec<FoundMask>>> {
        check_frame(frame)?;
        asked.iter().try_for_each(|query| check_query(frame, query))?;
        let MaskEncoderContract { input, picture: rule, outputs, .. } = &self.encoding;
        let layout = Layout::new(rule, (frame.width, frame.height));
        let picture = Tensor::of_picture(layout.picture, layout.picture(rule, frame));
        let outputs: Vec<&str> = outputs.iter().map(String::as_str).collect();
        let what = format!("{}×{} pixels", layout.picture.0, layout.picture.1);
        let features = self.encoder.run(&[(input.as_str(), &picture)], &what, &outputs)?;
        for (feature, name) in features.iter().zip(&outputs) {
            self.encoder.check_finite(&feature.values, name, layout.picture)?;
        }
        asked.iter().map(|query| self.decode(&layout, &features, query)).collect()
    }

    /// Masks of one object.
    fn decode(
        &mut self,
        layout: &Layout,
        features: &[Tensor],
        query: &MaskQuery,
    ) -> Result<Vec<FoundMask>> {
        let MaskQuery { prompts, before } = query;
        let along = |axis, at: f64| layout.picture_from_frame(axis, at) as f32;
        let points = prompts
            .iter()
            .flat_map(|prompt| [along(Axis::X, prompt.pixel.x), along(Axis::Y, prompt.pixel.y)]);
        let n = prompts.len();
        let points = Tensor { shape: vec![1, n, 2], values: points.collect() };
        let label = prompts.iter().map(|prompt| f32::from(u8::from(prompt.inside)));
        let labels = Tensor { shape: vec![1, n], values: label.collect() };
        let size = self.mask;
        let begun = match before {
            Some(mask) => layout.in_picture(mask, size),
            None => vec![0.0; size.0 as usize * size.1 as usize],
        };
        let begun = Tensor { shape: vec![1, 1, size.1 as usize, size.0 as usize], values: begun };
        let has_mask =
            Tensor { shape: vec![1], values: vec![f32::from(u8::from(before.is_some()))] };
        let names = &self.decoding;
        let mut given: Vec<(&str, &Tensor)> =
            names.features.iter().map(String::as_str).zip(features).collect();
        given.push((&names.points, &points));
        given.push((&names.labels, &labels));
        given.push((&names.mask_input, &begun));
        given.push((&names.has_mask, &has_mask));
        let what = format!("what the encoder gives, and {n} points");
        let found = self.decoder.run(&given, &what, &[&names.masks, &names.scores])?;
        let [masks, scores] = &found[..] else {
            return Err(self.decoder.wrong(&names.masks, "has not come out"));
        };
        self.taken(layout, masks, scores)
    }

    /// Converts the decoder's outputs to masks of the frame.
    fn taken(&self, layout: &Layout, masks: &Tensor, scores: &Tensor) -> Result<Vec<FoundMask>> {
        let names = &self.decoding;
        let (width, height) = self.mask;
        let sides = [height as usize, width as usize];
        let n = match masks.shape[..] {
            [1, n, h, w] if n > 0 && [h, w] == sides => n,
            _ => {
                let what = format!(
                    "came out as {:?}; masks of {width}×{height}, the size of `{}`, were expected",
                    masks.shape, names.mask_input
                );
                return Err(self.decoder.wrong(&names.masks, &what));
            }
        };
        if scores.shape != [1, n] {
            let what = format!("came out as {:?}, for {n} masks", scores.shape);
            return Err(self.decoder.wrong(&names.scores, &what));
        }
        self.decoder.check_finite(&masks.values, &names.masks, layout.picture)?;
        self.decoder.check_finite(&scores.values, &names.scores, layout.picture)?;
        let planes = masks.values.chunks_exact(sides[0] * sides[1]);
        let found = |(plane, score): (&[f32], &f32)| FoundMask {
            odds: layout.smooth(plane, self.mask),
            score: *score,
        };
        Ok(planes.zip(&scores.values).map(found).collect())
    }
}

impl MaskSource for MaskNetwork {
    fn masks(
        &mut self,
        _number: usize,
        frame: &Image,
        asked: &[MaskQuery],
    ) -> Result<Vec<Vec<FoundMask>>> {
        self.ask(frame, asked)
    }
}

/// Checks a query.
fn check_query(frame: &Image, query: &MaskQuery) -> Result<()> {
    if query.prompts.is_empty() {
        return Err(Error::Input("a mask is asked for without points; give one at least".into()));
    }
    if let Some(prompt) = query.prompts.iter().find(|prompt| !prompt.pixel.is_finite()) {
        let what = format!("a mask is asked for by a point at {}", prompt.pixel);
        return Err(Error::Input(what));
    }
    match &query.before {
        Some(mask)
            if (mask.width, mask.height, mask.channels) != (frame.width, frame.height, 1) =>
        {
            Err(Error::Input(format!(
                "a mask to begin with is {}×{} with {} channels, the frame is {}×{}; give one channel at its \
                 size",
                mask.width, mask.height, mask.channels, frame.width, frame.height
            )))
        }
        _ => Ok(()),
    }
}
