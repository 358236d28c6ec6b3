//! What a network says of itself: what it computes, how its pictures are to be made, what its numbers mean.
//!
//! The contract is a JSON object under the key `splat4d` of the model's metadata. For a model that was
//! exported elsewhere and has none, `models.toml` holds it.

use std::path::Path;

use ort::session::Session;
use ort::value::{Outlet, TensorElementType};
use serde::{Deserialize, Serialize};

use crate::observe::EstimatedKind;
use crate::{Error, Result};

/// The key in a model's metadata.
pub const METADATA_KEY: &str = "splat4d";
/// The version of contracts that this version of the program knows.
pub const VERSION: u32 = 1;

/// A network's contract.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Contract {
    /// Depth of one picture.
    Depth(DepthContract),
    /// Optical flow from one picture to another.
    Flow(FlowContract),
    /// What a pointmap decoder needs of a picture.
    PointmapEncoder(PointmapEncoderContract),
    /// The points that two pictures show, in the first's camera.
    PointmapDecoder(PointmapDecoderContract),
    /// What a mask decoder needs of a picture.
    MaskEncoder(MaskEncoderContract),
    /// Masks of what prompts point at.
    MaskDecoder(MaskDecoderContract),
    /// Keypoints of a picture and what describes them.
    Features(FeaturesContract),
    /// How different two pictures look.
    Lpips(LpipsContract),
}

/// That of a network for depth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width.
    pub input: String,
    /// How the picture is made.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, 1 × height × width or 1 × 1 × height × width.
    pub output: String,
    /// What it holds.
    pub holds: EstimatedKind,
}

/// That of a network for flow.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlowContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs, each 1 × 3 × height × width: the picture that flow leads from and the one that it
    /// leads to.
    pub inputs: [String; 2],
    /// How the pictures are made.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, 1 × 2 × height × width: right and down, in pixels of the input.
    pub output: String,
    /// Name of an output of the flow's confidence, 0 to 1, 1 × 1 × height × width, where there is one.
    #[serde(default)]
    pub confidence: Option<String>,
}

/// That of a pointmap network's encoder: each frame is encoded once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointmapEncoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width. Where `picture` has a size that lies on its side, frames that
    /// stand upright are transposed.
    pub input: String,
    /// How the picture is made.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, what the decoder takes, of any shape.
    pub output: String,
}

/// That of a pointmap network's decoder, as DUSt3R's (Wang et al. 2024) and MonST3R's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointmapDecoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs, the encoder's output for each of the two pictures.
    pub inputs: [String; 2],
    /// Names of the outputs of points, each 1 × height × width × 3: what each pixel of a picture shows, x right,
    /// y down, z forward in the camera of the first, in a unit of the pair's own.
    pub points: [String; 2],
    /// Names of the outputs of how far each point is to be believed, each 1 × height × width, 1 or more.
    pub confidence: [String; 2],
}

/// That of a mask network's encoder, as that of SAM 2 (Ravi et al. 2024): each frame is encoded once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskEncoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width.
    pub input: String,
    /// How the picture is made; it has a size.
    pub picture: PictureRule,
    /// Names of the outputs, what the decoder takes, of any shape.
    pub outputs: Vec<String>,
}

/// That of a mask network's decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskDecoderContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs of what the encoder gives, in its outputs' order.
    pub features: Vec<String>,
    /// Name of the input of prompts, 1 × prompts × 2: x and y in pixels of the encoder's picture.
    pub points: String,
    /// Name of the input of what the prompts are, 1 × prompts: 1 a point of the thing, 0 one beside it, 2 and 3 the
    /// first and the last corner of a box.
    pub labels: String,
    /// Name of the input of a mask to begin with, 1 × 1 × height × width, log odds.
    pub mask_input: String,
    /// Name of the input that says whether there is one, 1 value: 1 or 0.
    pub has_mask: String,
    /// Name of the output of masks, 1 × masks × height × width, log odds, of the size of `mask_input`.
    pub masks: String,
    /// Name of the output of how good each mask is, 1 × masks.
    pub scores: String,
}

/// That of a network for features, as XFeat (Potje et al. 2024).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeaturesContract {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the input, 1 × 3 × height × width.
    pub input: String,
    /// How the picture is made.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output of descriptors, 1 × values × rows × columns, each of length 1.
    pub descriptors: String,
    /// Name of the output of how likely a pixel is a keypoint, 1 × 1 × height × width, 0 to 1.
    pub keypoints: String,
    /// Name of the output of how far descriptors are to be believed, 1 × 1 × rows × columns, 0 to 1.
    pub reliability: String,
}

/// That of a network for LPIPS (Zhang et al. 2018), the learned perceptual distance of two pictures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LpipsContract {
    /// [`VERSION`].
    pub version: u32,
    /// Names of the inputs, each 1 × 3 × height × width.
    pub inputs: [String; 2],
    /// How the pictures are made; LPIPS takes values from −1 to 1.
    #[serde(default)]
    pub picture: PictureRule,
    /// Name of the output, 1 × 1 × 1 × 1.
    pub output: String,
    /// The features that are compared, which figures are given with: `alex`, `vgg`, `squeeze`.
    pub net: String,
}

/// How a picture is made for a network: scaled, brought to sides that it takes, normalised.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PictureRule {
    /// Both sides are multiples of this.
    pub multiple: u32,
    /// The shorter side is scaled to so many pixels; 0: it keeps its size.
    pub shorter: u32,
    /// Width and height of every picture, in place of `multiple` and `shorter`; 0: it is theirs to say.
    pub size: [u32; 2],
    /// How pictures come to these sides.
    pub fit: Fit,
    /// What white is, before `mean` and `deviation`: 1 or 255.
    pub white: f32,
    /// Is taken off red, green and blue.
    pub mean: [f32; 3],
    /// Then divides them.
    pub deviation: [f32; 3],
}

/// How a picture comes to sides that are told, or are multiples of a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// It is scaled to them, to the nearest multiples.
    #[default]
    Stretch,
    /// Its last row and column are repeated to the right and below.
    Pad,
    /// As much is cut off on both sides.
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

/// Sides of a network's picture, at most.
const LARGEST: u32 = 8192;

impl Contract {
    /// The contract in a model's metadata, else `given`, checked against the model.
    ///
    /// # Errors
    /// None in either place, one that is no contract of this version, inputs and outputs that the model does not
    /// have or that hold something else.
    pub(super) fn of(session: &Session, file: &Path, given: Option<&Contract>) -> Result<Contract> {
        let told = session.metadata().ok().and_then(|metadata| metadata.custom(METADATA_KEY));
        // The runtime takes an absent key for an empty one.
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

    /// The name of what it computes.
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
                Err("its contract does not say which `size` its picture has".into())
            }
            _ => Ok(()),
        }
    }

    /// That a model has the inputs and outputs of the contract, and no other inputs.
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
                "its contract asks for pictures of {width}×{height}; 1 to {LARGEST} make sense"
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

/// A tensor's axes: how long each is, or what it is called where that is known only when it runs.
type Shape = &'static [Axis];

/// A tensor's name and the shapes that it may have.
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
/// A single channel may have no axis of its own.
const PLANE: &[Shape] = &[&[Long(1), Long(1), ROWS, COLUMNS], &[Long(1), ROWS, COLUMNS]];
const POINTS: &[Shape] = &[&[Long(1), ROWS, COLUMNS, Long(3)]];
const PROMPTS: &[Shape] = &[&[Long(1), Called("prompts"), Long(2)]];
const LABELS: &[Shape] = &[&[Long(1), Called("one each")]];
const MASKS: &[Shape] = &[&[Long(1), Called("masks"), ROWS, COLUMNS]];
const DESCRIPTORS: &[Shape] = &[&[Long(1), Called("values"), Called("rows"), Called("columns")]];
const ONE: &[Shape] = &[&[Long(1)]];
/// What only another model reads.
const ANY: &[Shape] = &[];

/// That there is a tensor of this name, of floats, of one of the shapes.
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
    // −1: known when it runs.
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
