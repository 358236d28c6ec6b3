//! A loaded model: named tensors in, named tensors out.

use std::path::{Path, PathBuf};

use ort::session::{Session, SessionInputValue};
use ort::value::TensorRef;

use super::contract::Contract;
use super::runtime::Runtime;
use crate::types::Image;
use crate::{Error, Result};

/// A loaded model.
pub(super) struct Network {
    session: Session,
    pub file: PathBuf,
}

/// An input or output of a model: values and a shape, with the last axis innermost.
#[derive(Clone, Debug)]
pub(super) struct Tensor {
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

/// An image output: its channels one after the other.
pub(super) struct Planes {
    pub values: Vec<f32>,
    pub channels: usize,
    pub size: (u32, u32),
}

impl Tensor {
    /// A three-channel input image, as [`super::picture::Layout::picture`] makes it.
    pub fn of_picture((width, height): (u32, u32), values: Vec<f32>) -> Tensor {
        Tensor { shape: vec![1, 3, height as usize, width as usize], values }
    }
}

impl Network {
    /// Loads a model. `given` is its contract where its metadata has none.
    ///
    /// # Errors
    /// A file that cannot be read or is not a model; a contract that is absent or does not match the model.
    pub fn open(
        runtime: &Runtime,
        file: &Path,
        given: Option<&Contract>,
    ) -> Result<(Network, Contract)> {
        let session = runtime.session(file)?;
        let contract = Contract::of(&session, file, given)?;
        Ok((Network { session, file: file.to_owned() }, contract))
    }

    /// Runs the model on named inputs and returns the named outputs. Error messages mention `what` it ran on.
    pub fn run(
        &mut self,
        inputs: &[(&str, &Tensor)],
        what: &str,
        outputs: &[&str],
    ) -> Result<Vec<Tensor>> {
        let file = &self.file;
        let failed =
            |error: ort::Error| Error::format(file, format!("does not run on {what}: {error}"));
        let mut given: Vec<(&str, SessionInputValue<'_>)> = Vec::new();
        for (name, Tensor { shape, values }) in inputs {
            let view = (shape.clone(), &values[..]);
            given.push((name, TensorRef::from_array_view(view).map_err(failed)?.into()));
        }
        let found = self.session.run(given).map_err(failed)?;
        outputs
            .iter()
            .map(|name| {
                let value = found.get(*name).ok_or_else(|| {
                    Error::format(file, format!("has not computed its output `{name}`"))
                })?;
                let (shape, values) = value.try_extract_tensor::<f32>().map_err(failed)?;
                let shape = shape.iter().map(|side| *side as usize).collect();
                Ok(Tensor { shape, values: values.to_vec() })
            })
            .collect()
    }

    /// Runs the model on images of one size and returns image outputs.
    pub fn run_pictures(
        &mut self,
        inputs: Vec<(&str, Vec<f32>)>,
        size: (u32, u32),
        outputs: &[&str],
    ) -> Result<Vec<Planes>> {
        let named = |(name, values)| (name, Tensor::of_picture(size, values));
        let pictures: Vec<(&str, Tensor)> = inputs.into_iter().map(named).collect();
        let given: Vec<(&str, &Tensor)> = pictures.iter().map(|(name, one)| (*name, one)).collect();
        let found = self.run(&given, &format!("{}×{} pixels", size.0, size.1), outputs)?;
        found.into_iter().zip(outputs).map(|(one, name)| self.planes(one, name)).collect()
    }

    /// Converts an output to an image.
    ///
    /// # Errors
    /// The output does not have the shape of an image.
    fn planes(&self, Tensor { shape, values }: Tensor, name: &str) -> Result<Planes> {
        let (channels, height, width) = match shape[..] {
            [1, c, h, w] if c > 0 && h > 0 && w > 0 => (c, h, w),
            [1, h, w] if h > 0 && w > 0 => (1, h, w),
            _ => {
                let what = format!("came out as {shape:?}, which is no image");
                return Err(self.wrong(name, &what));
            }
        };
        Ok(Planes { values, channels, size: (width as u32, height as u32) })
    }

    /// Checks an output's number of channels.
    pub fn check_channels(&self, planes: &Planes, channels: usize, name: &str) -> Result<()> {
        if planes.channels != channels {
            let what = format!("has {} channels, not {channels}", planes.channels);
            return Err(self.wrong(name, &what));
        }
        Ok(())
    }

    /// Checks that the output for images of a size has only finite values.
    pub fn check_finite(
        &self,
        values: &[f32],
        name: &str,
        (width, height): (u32, u32),
    ) -> Result<()> {
        let unknown = values.iter().filter(|value| !value.is_finite()).count();
        if unknown > 0 {
            let what = format!(
                "is not finite at {unknown} of {} values; some networks take no image as small as \
                 {width}×{height}",
                values.len()
            );
            return Err(self.wrong(name, &what));
        }
        Ok(())
    }

    /// Lengths of an input's axes in the model, −1 where they are known only at run time.
    pub fn input_shape(&self, name: &str) -> Vec<i64> {
        let input = self.session.inputs().iter().find(|input| input.name() == name);
        let shape = input.and_then(|input| input.dtype().tensor_shape());
        shape.map_or(Vec::new(), |shape| shape.iter().copied().collect())
    }

    /// The error for an output that violates the contract.
    pub fn wrong(&self, output: &str, what: &str) -> Error {
        Error::format(&self.file, format!("its output `{output}` {what}"))
    }

    /// The error for a model that is listed for another purpose.
    pub fn listed_for(&self, purpose: &str, contract: &Contract) -> Error {
        let what = format!("is listed for {purpose}, and computes {}", contract.kind());
        Error::format(&self.file, what)
    }
}

/// Checks that a frame is a valid network input.
pub(super) fn check_frame(frame: &Image) -> Result<()> {
    if frame.channels != 3 || frame.width == 0 || frame.height == 0 {
        return Err(Error::Input(format!(
            "a network takes RGB frames, not one of {}×{} with {} channels",
            frame.width, frame.height, frame.channels
        )));
    }
    Ok(())
}

/// Checks that two images are valid network inputs of one size; `what` names the operation in the message.
pub(super) fn check_pair(what: &str, from: &Image, to: &Image) -> Result<()> {
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
