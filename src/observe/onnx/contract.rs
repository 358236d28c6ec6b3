//! The contract of a network: what it computes, how its input images are prepared, and what its outputs mean.
//!
//! The contract is a JSON object under the key `splat4d` of the model's metadata. For an externally
//! exported model without one, `models.toml` contains it.

use std::path::Path;

use ort::session::Session;
use ort::value::{Outlet, TensorElementType};
use serde::{Deserialize, Serialize};

use crate::observe::EstimatedKind;
use crate::{Error, Result};

/// The key in a model's metadata.
pub const METADATA_KEY: &str = "splat4d";
/// The supported version of the contract format.
pub const VERSION: u32 = 1;

/// A network's contract.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Contract {
    /// Depth from one image.
    Depth(DepthContract),
    /// Optical flow from one image to another.
    Flow(FlowContract),
    /// Encoder of a pointmap network, applied to each image.
    PointmapEncoder(PointmapEncoderContract),
    /// Decoder of a pointmap network: the points of two images, in the camera frame of the first.
    PointmapDecoder(PointmapDecoderContract),
    /// Encoder of a mask network, applied to each image.
    MaskEncoder(MaskEncoderContract),
    /// Decoder of a mask network: masks from prompts.
    MaskDecoder(MaskDecoderContract),
    /// Keypoints of an image and their descriptors.
    Features(FeaturesContract),
    /// Perceptual distance between two images.
    Lpips(LpipsContract),
}

/// Contract of a depth network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width.
    pub input: String,
    /// How the input image is prepared.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, 1 × height × width or 1 × 1 × height × width.
    pub output: String,
    /// What the output holds.
    pub holds: EstimatedKind,
}

/// Contract of a flow network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlowContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs, each 1 × 3 × height × width: the image that flow leads from and the one that it
    /// leads to.
    pub inputs: [String; 2],
    /// How the input images are prepared.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, 1 × 2 × height × width: flow to the right and down, in pixels of the input.
    pub output: String,
    /// Name of the confidence output, 0 to 1, 1 × 1 × height × width, if there is one.
    #[serde(default)]
    pub confidence: Option<String>,
}

/// Contract of a pointmap network's encoder; each frame is encoded once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointmapEncoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width. Where `picture` has a landscape size, portrait frames are
    /// transposed.
    pub input: String,
    /// How the input image is prepared.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, which is passed to the decoder, of any shape.
    pub output: String,
}

/// Contract of a pointmap network's decoder, such as DUSt3R's (Wang et al. 2024) and MonST3R's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointmapDecoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs: the encoder's output for each of the two images.
    pub inputs: [String; 2],
    /// Names of the point outputs, each 1 × height × width × 3: the point at each pixel of an image, x
    /// right, y down, z forward in the camera frame of the first image, in a unit specific to the pair.
    pub points: [String; 2],
    /// Names of the confidence outputs for the points, each 1 × height × width, 1 or more.
    pub confidence: [String; 2],
}

/// Contract of a mask network's encoder, such as that of SAM 2 (Ravi et al. 2024); each frame is encoded
/// once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskEncoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width.
    pub input: String,
    /// How the input image is prepared; it must have a size.
    pub picture: PictureRule,
    /// Names of the outputs, which are passed to the decoder, of any shape.
    pub outputs: Vec<String>,
}

/// Contract of a mask network's decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskDecoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs for the encoder's outputs, in the same order.
    pub features: Vec<String>,
    /// Name of the input of prompts, 1 × prompts × 2: x and y in pixels of the encoder's input image.
    pub points: String,
    /// Name of the input of the prompts' labels, 1 × prompts: 1 for a point on the object, 0 for one on the
    /// background, 2 and 3 for the first and the last corner of a box.
    pub labels: String,
    /// Name of the input of an initial mask, 1 × 1 × height × width, log odds.
    pub mask_input: String,
    /// Name of the input that indicates whether there is an initial mask, 1 value: 1 or 0.
    pub has_mask: String,
    /// Name of the output of masks, 1 × masks × height × width, log odds, at the size of `mask_input`.
    pub masks: String,
    /// Name of the output of each mask's estimated quality, 1 × masks.
    pub scores: String,
}

/// Contract of a keypoint network, such as XFeat (Potje et al. 2024).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeaturesContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width.
    pub input: String,
    /// How the input image is prepared.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output of descriptors, 1 × values × rows × columns, each of unit length.
    pub descriptors: String,
    /// Name of the output of keypoint probabilities per pixel, 1 × 1 × height × width, 0 to 1.
    pub keypoints: String,
    /// Name of the output of the descriptors' reliability, 1 × 1 × rows × columns, 0 to 1.
    pub reliability: String,
}

/// Contract of an LPIPS network (Zhang et al. 2018), the learned perceptual distance between two images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LpipsContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs, each 1 × 3 × height × width.
    pub inputs: [String; 2],
    /// How the input images are prepared; LPIPS takes values from −1 to 1.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, 1 × 1 × 1 × 1.
    pub output: String,
    /// The feature network, which is reported with the results: `alex`, `vgg`, `squeeze`.
    pub net: String,
}

/// Preparation of a network's input image: scaling, fitting to permitted sides, normalisation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PictureRule {
    /// Both sides must be multiples of this.
    pub multiple: u32,
    /// Length that the shorter side is scaled to, pixels; 0 keeps the size.
    pub shorter: u32,
    /// Fixed width and height of the input image, in place of `multiple` and `shorter`; 0 for a variable
    /// size.
    pub size: [u32; 2],
    /// How images are fitted to these sides.
    pub fit: Fit,
    /// Value of white before `mean` and `deviation`: 1 or 255.
    pub white: f32,
    /// Subtracted from red, green and blue.
    pub mean: [f32; 3],
    /// Divides them after the subtraction.
    pub deviation: [f32; 3],
}

/// How an image is fitted to fixed sides, or to multiples of a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// The image is scaled to the sides, or to the nearest multiples.
    #[default]
    Stretch,
    /// The last row and column are repeated to the right and below.
    Pad,
    /// Equal margins are cropped on both sides.
    Crop,
}

impl Default for PictureRule {
    fn default() -> PictureRule {
        PictureRule {
            multiple: 1,
            shorter: 0,
            size: [0; 2],
            fit: Fit::Stretch,
            white: 1.0,
            mean: [0.0; 3],
            deviation: [1.0; 3],
        }
    }
}

/// Maximum side of a network's input image, pixels.
const LARGEST: u32 = 8192;

impl Contract {
    /// The contract in a model's metadata, else `given`, checked against the model.
    ///
    /// # Errors
    /// There is no contract in either place, it is not of this version, or its inputs and outputs are
    /// missing in the model or have another type or shape.
    pub(super) fn of(session: &Session, file: &Path, given: Option<&Contract>) -> Result<Contract> {
        let told = session.metadata().ok().and_then(|metadata| metadata.custom(METADATA_KEY));
        // The runtime reports an absent key as an empty value.
        let told = told.filter(|told| !told.is_empty());
        let contract = match (told, given) {
            (Some(told), _) => serde_json::from_str(&told).map_err(|error| {
                let what = format!("its metadata `{METADATA_KEY}` is no contract: {error}");
                Error::format(file, what)
            })?,
            (None, Some(given)) => given.clone(),
            (None, None) => {
                return Err(Error::format(
                    file,
                    format!(
                        "does not say what it is: neither its metadata has the key `{METADATA_KEY}`, nor \
                         models.toml a contract for it"
                    ),
                ));
            }
        };
        contract.check().map_err(|what| Error::format(file, what))?;
        contract.check_model(session).map_err(|what| Error::format(file, what))?;
        Ok(contract)
    }

    /// Name of the contract's kind.
    pub fn kind(&self) -> &'static str {
        match self {
            Contract::Depth(_) => "depth",
            Contract::Flow(_) => "flow",
            Contract::PointmapEncoder(_) => "pointmap_encoder",
            Contract::PointmapDecoder(_) => "pointmap_decoder",
            Contract::MaskEncoder(_) => "mask_encoder",
            Contract::MaskDecoder(_) => "mask_decoder",
            Contract::Features(_) => "features",
            Contract::Lpips(_) => "lpips",
        }
    }

    fn check(&self) -> std::result::Result<(), String> {
        let (version, rule) = match self {
            Contract::Depth(c) => (c.version, Some(&c.picture)),
            Contract::Flow(c) => (c.version, Some(&c.picture)),
            Contract::PointmapEncoder(c) => (c.version, Some(&c.picture)),
            Contract::PointmapDecoder(c) => (c.version, None),
            Contract::MaskEncoder(c) => (c.version, Some(&c.picture)),
            Contract::MaskDecoder(c) => (c.version, None),
            Contract::Features(c) => (c.version, Some(&c.picture)),
            Contract::Lpips(c) => (c.version, Some(&c.picture)),
        };
        if version != VERSION {
            return Err(format!(
                "its contract is of version {version}, this program knows version {VERSION}"
            ));
        }
        rule.map_or(Ok(()), PictureRule::check)?;
        match self {
            Contract::MaskEncoder(c) if c.picture.size == [0; 2] => {
                Err("its contract does not say which `size` its image has".into())
            }
            _ => Ok(()),
        }
    }

    /// Checks that a model has the inputs and outputs of the contract, and no other inputs.
    fn check_model(&self, session: &Session) -> std::result::Result<(), String> {
        let (inputs, outputs): (Vec<Named>, Vec<Named>) = match self {
            Contract::Depth(c) => (vec![(&c.input, PICTURE)], vec![(&c.output, PLANE)]),
            Contract::Flow(c) => {
                let confidence = c.confidence.iter().map(|name| (name.as_str(), PLANE));
                let outputs = std::iter::once((c.output.as_str(), VECTORS)).chain(confidence);
                (c.inputs.iter().map(|name| (name.as_str(), PICTURE)).collect(), outputs.collect())
            }
            Contract::PointmapEncoder(c) => (vec![(&c.input, PICTURE)], vec![(&c.output, ANY)]),
            Contract::PointmapDecoder(c) => {
                let points = c.points.iter().map(|name| (name.as_str(), POINTS));
                let confidence = c.confidence.iter().map(|name| (name.as_str(), PLANE_ALONE));
                let inputs = c.inputs.iter().map(|name| (name.as_str(), ANY));
                (inputs.collect(), points.chain(confidence).collect())
            }
            Contract::MaskEncoder(c) => {
                let outputs = c.outputs.iter().map(|name| (name.as_str(), ANY));
                (vec![(&c.input, PICTURE)], outputs.collect())
            }
            Contract::MaskDecoder(c) => {
                let prompts: [Named; 4] = [
                    (&c.points, PROMPTS),
                    (&c.labels, LABELS),
                    (&c.mask_input, PLANE_WITH_CHANNEL),
                    (&c.has_mask, ONE),
                ];
                let features = c.features.iter().map(|name| (name.as_str(), ANY));
                let outputs = vec![(c.masks.as_str(), MASKS), (c.scores.as_str(), LABELS)];
                (features.chain(prompts).collect(), outputs)
            }
            Contract::Features(c) => {
                let outputs: [Named; 3] = [
                    (&c.descriptors, DESCRIPTORS),
                    (&c.keypoints, PLANE_WITH_CHANNEL),
                    (&c.reliability, PLANE_WITH_CHANNEL),
                ];
                (vec![(&c.input, PICTURE)], outputs.into())
            }
            Contract::Lpips(c) => {
                let inputs = c.inputs.iter().map(|name| (name.as_str(), PICTURE));
                (inputs.collect(), vec![(&c.output, PLANE)])
            }
        };
        for (name, shapes) in &inputs {
            has(session.inputs(), name, "input", shapes)?;
        }
        let named = |name: &str| inputs.iter().any(|(input, _)| *input == name);
        if let Some(more) = session.inputs().iter().find(|input| !named(input.name())) {
            return Err(format!(
                "it has an input `{}` that its contract does not name",
                more.name()
            ));
        }
        outputs
            .into_iter()
            .try_for_each(|(name, shapes)| has(session.outputs(), name, "output", shapes))
    }
}

impl PictureRule {
    fn check(&self) -> std::result::Result<(), String> {
        let range = 1..=LARGEST;
        if !range.contains(&self.multiple) || self.shorter > LARGEST {
            return Err(format!(
                "its contract asks for sides that are multiples of {} and a shorter one of {}; 1 to \
                 {LARGEST} make sense",
                self.multiple, self.shorter
            ));
        }
        let [width, height] = self.size;
        if self.size != [0; 2] && !(range.contains(&width) && range.contains(&height)) {
            return Err(format!(
                "its contract asks for images of {width}×{height}; 1 to {LARGEST} make sense"
            ));
        }
        let numbers = self.mean.iter().chain(&self.deviation).chain([&self.white]);
        let positive = self.deviation.iter().chain([&self.white]).all(|x| *x > 0.0);
        if !positive || !numbers.into_iter().all(|x| x.is_finite()) {
            return Err("its contract's white and deviation are not all above 0".into());
        }
        Ok(())
    }
}

/// The axes of a tensor: a fixed length, or a name for a length that is known only at run time.
type Shape = &'static [Axis];

/// Name of a tensor and its permitted shapes.
type Named<'a> = (&'a str, &'static [Shape]);

/// An axis of a tensor.
enum Axis {
    Long(usize),
    Called(&'static str),
}

use Axis::{Called, Long};

const ROWS: Axis = Called("height");
const COLUMNS: Axis = Called("width");
const PICTURE: &[Shape] = &[&[Long(1), Long(3), ROWS, COLUMNS]];
const VECTORS: &[Shape] = &[&[Long(1), Long(2), ROWS, COLUMNS]];
const PLANE_ALONE: &[Shape] = &[&[Long(1), ROWS, COLUMNS]];
const PLANE_WITH_CHANNEL: &[Shape] = &[&[Long(1), Long(1), ROWS, COLUMNS]];
/// A single-channel tensor may omit the channel axis.
const PLANE: &[Shape] = &[&[Long(1), Long(1), ROWS, COLUMNS], &[Long(1), ROWS, COLUMNS]];
const POINTS: &[Shape] = &[&[Long(1), ROWS, COLUMNS, Long(3)]];
const PROMPTS: &[Shape] = &[&[Long(1), Called("prompts"), Long(2)]];
const LABELS: &[Shape] = &[&[Long(1), Called("one each")]];
const MASKS: &[Shape] = &[&[Long(1), Called("masks"), ROWS, COLUMNS]];
const DESCRIPTORS: &[Shape] = &[&[Long(1), Called("values"), Called("rows"), Called("columns")]];
const ONE: &[Shape] = &[&[Long(1)]];
/// A tensor that only another model reads may have any shape.
const ANY: &[Shape] = &[];

/// Checks that there is a float tensor of this name with one of the shapes.
fn has(
    all: &[Outlet],
    name: &str,
    what: &str,
    shapes: &[Shape],
) -> std::result::Result<(), String> {
    let expected = || {
        let axis = |axis: &Axis| match axis {
            Long(length) => length.to_string(),
            Called(name) => (*name).to_owned(),
        };
        let shape = |shape: &Shape| shape.iter().map(axis).collect::<Vec<_>>().join(" × ");
        match shapes {
            [] => "any shape".to_owned(),
            shapes => shapes.iter().map(shape).collect::<Vec<_>>().join(" or "),
        }
    };
    let Some(found) = all.iter().find(|outlet| outlet.name() == name) else {
        let names: Vec<String> = all.iter().map(|o| format!("`{}`", o.name())).collect();
        return Err(format!(
            "its contract names an {what} `{name}` of {}, and it has {}",
            expected(),
            names.join(", ")
        ));
    };
    let (shape, element) = (found.dtype().tensor_shape(), found.dtype().tensor_type());
    // −1 means that the length is known only at run time.
    let is = |(known, axis): (&i64, &Axis)| match axis {
        Long(wanted) => *known == -1 || *known == *wanted as i64,
        Called(_) => true,
    };
    let fits = |wanted: &Shape| {
        shape.is_some_and(|shape| shape.len() == wanted.len() && shape.iter().zip(*wanted).all(is))
    };
    if element != Some(TensorElementType::Float32)
        || !(shapes.is_empty() || shapes.iter().any(fits))
    {
        let sides = shape.map_or(String::from("no tensor"), |shape| {
            let side = |s: &i64| if *s < 0 { "?".to_owned() } else { s.to_string() };
            shape.iter().map(side).collect::<Vec<_>>().join(" × ")
        });
        let element = element.map_or(String::new(), |element| format!(" of {element:?}"));
        return Err(format!(
            "its {what} `{name}` is {sides}{element}; {} of Float32 was expected",
            expected()
        ));
    }
    Ok(())
}
