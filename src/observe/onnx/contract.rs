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
    /// How sides become multiples.
    pub fit: Fit,
    /// What white is, before `mean` and `deviation`: 1 or 255.
    pub white: f32,
    /// Is taken off red, green and blue.
    pub mean: [f32; 3],
    /// Then divides them.
    pub deviation: [f32; 3],
}

/// How a picture's sides become multiples of a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// The picture is scaled to the nearest multiples.
    #[default]
    Stretch,
    /// Its last row and column are repeated to the right and below.
    Pad,
}

impl Default for PictureRule {
    fn default() -> PictureRule {
        PictureRule {
            multiple: 1,
            shorter: 0,
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
            Contract::Lpips(_) => "lpips",
        }
    }

    fn check(&self) -> std::result::Result<(), String> {
        let (version, rule) = match self {
            Contract::Depth(c) => (c.version, &c.picture),
            Contract::Flow(c) => (c.version, &c.picture),
            Contract::Lpips(c) => (c.version, &c.picture),
        };
        if version != VERSION {
            return Err(format!(
                "its contract is of version {version}, this program knows version {VERSION}"
            ));
        }
        let range = 1..=LARGEST;
        if !range.contains(&rule.multiple) || rule.shorter > LARGEST {
            return Err(format!(
                "its contract asks for sides that are multiples of {} and a shorter one of {}; 1 to \
                 {LARGEST} make sense",
                rule.multiple, rule.shorter
            ));
        }
        let numbers = rule.mean.iter().chain(&rule.deviation).chain([&rule.white]);
        let positive = rule.deviation.iter().chain([&rule.white]).all(|x| *x > 0.0);
        if !positive || !numbers.into_iter().all(|x| x.is_finite()) {
            return Err("its contract's white and deviation are not all above 0".into());
        }
        Ok(())
    }

    /// That a model has the inputs and outputs of the contract, and no other inputs.
    fn check_model(&self, session: &Session) -> std::result::Result<(), String> {
        let (inputs, outputs): (Vec<&str>, Vec<(&str, usize)>) = match self {
            Contract::Depth(c) => (vec![&c.input], vec![(&c.output, 1)]),
            Contract::Flow(c) => (
                c.inputs.iter().map(String::as_str).collect(),
                std::iter::once((c.output.as_str(), 2))
                    .chain(c.confidence.as_deref().map(|name| (name, 1)))
                    .collect(),
            ),
            Contract::Lpips(c) => {
                (c.inputs.iter().map(String::as_str).collect(), vec![(&c.output, 1)])
            }
        };
        for name in &inputs {
            has(session.inputs(), name, "input", &[Some(3)])?;
        }
        if let Some(more) = session.inputs().iter().find(|i| !inputs.contains(&i.name())) {
            return Err(format!(
                "it has an input `{}` that its contract does not name",
                more.name()
            ));
        }
        for (name, channels) in outputs {
            // A single channel may have no axis of its own.
            let ranks: &[Option<usize>] =
                if channels == 1 { &[Some(1), None] } else { &[Some(channels)] };
            has(session.outputs(), name, "output", ranks)?;
        }
        Ok(())
    }
}

/// That there is a tensor of this name, of floats, with as many channels as one of `channels` says; `None`:
/// without an axis of channels.
fn has(
    all: &[Outlet],
    name: &str,
    what: &str,
    channels: &[Option<usize>],
) -> std::result::Result<(), String> {
    let expected = || {
        let shape = |c: &Option<usize>| match c {
            Some(c) => format!("1 × {c} × height × width"),
            None => "1 × height × width".to_owned(),
        };
        channels.iter().map(shape).collect::<Vec<_>>().join(" or ")
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
    let is = |known: i64, wanted: usize| known == -1 || known == wanted as i64;
    let fits = |c: &Option<usize>| {
        shape.is_some_and(|shape| match c {
            Some(c) => shape.len() == 4 && is(shape[0], 1) && is(shape[1], *c),
            None => shape.len() == 3 && is(shape[0], 1),
        })
    };
    if element != Some(TensorElementType::Float32) || !channels.iter().any(fits) {
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
