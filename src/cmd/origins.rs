//! The source of each quantity of a clip: the program itself, a network, or the user.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};
use splat4d::observe::onnx::Models;
use splat4d::track::Told;

/// Kind of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    BuiltIn,
    Network,
    Supplied,
    /// The quantity is absent.
    None,
}

impl Source {
    /// Name in JSON.
    fn key(self) -> &'static str {
        match self {
            Source::BuiltIn => "built_in",
            Source::Network => "network",
            Source::Supplied => "supplied",
            Source::None => "none",
        }
    }
}

/// Source of one quantity.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    what: &'static str,
    source: Source,
    /// The network's file, or the option that supplied it.
    from: Option<String>,
    /// The method by which it was determined.
    how: String,
}

impl Origin {
    fn built_in(what: &'static str, how: impl Into<String>) -> Origin {
        Origin { what, source: Source::BuiltIn, from: None, how: how.into() }
    }

    fn network(what: &'static str, file: &Path, how: impl Into<String>) -> Origin {
        let file = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Origin { what, source: Source::Network, from: Some(file), how: how.into() }
    }

    fn supplied(what: &'static str, option: &str, how: impl Into<String>) -> Origin {
        Origin { what, source: Source::Supplied, from: Some(option.into()), how: how.into() }
    }

    fn none(what: &'static str, how: impl Into<String>) -> Origin {
        Origin { what, source: Source::None, from: None, how: how.into() }
    }
}

/// The quantities that the user supplied.
#[derive(Clone, Copy, Debug, Default)]
pub struct Given {
    pub poses: bool,
    pub flow: bool,
    pub depth: bool,
    pub masks: bool,
    pub tracks: bool,
}

/// The files of the opened networks.
#[derive(Clone, Debug, Default)]
pub struct Networks {
    pub depth: Option<PathBuf>,
    pub flow: Option<PathBuf>,
    pub masks: Option<PathBuf>,
    pub pointmaps: Option<PathBuf>,
    pub features: Option<PathBuf>,
}

impl Networks {
    /// The networks of a model folder.
    pub fn of(models: Option<&Models>) -> Networks {
        let Some(models) = models else { return Networks::default() };
        Networks {
            depth: models.depth.as_ref().map(|network| network.file().to_owned()),
            flow: models.flow.as_ref().map(|network| network.file().to_owned()),
            masks: models.masks.as_ref().map(|network| network.file().to_owned()),
            pointmaps: models.pointmaps.as_ref().map(|network| network.file().to_owned()),
            features: models.features.as_ref().map(|network| network.file().to_owned()),
        }
    }
}

/// The source of each quantity of a tracked clip.
pub fn of(given: Given, networks: &Networks, told: &Told) -> Vec<Origin> {
    let depth = depth(given, networks, told);
    let cameras = cameras(given, networks, told);
    let maps = |origin: &Origin| {
        origin.source == Source::Network && (networks.depth.is_none() || origin.what == "cameras")
    };
    let uses: Vec<&str> =
        [&cameras, &depth].into_iter().filter(|o| maps(o)).map(|o| o.what).collect();
    let pointmaps = match (&networks.pointmaps, &uses[..]) {
        (None, _) => Origin::none("pointmaps", "no network tells them"),
        (Some(_), []) => Origin::none("pointmaps", "the network's are not used"),
        (Some(file), uses) => {
            Origin::network("pointmaps", file, format!("used for {}", uses.join(" and ")))
        }
    };
    vec![cameras, flow(given, networks), depth, masks(given, networks, told), pointmaps]
        .into_iter()
        .chain([features(networks, told), tracks(given)])
        .collect()
}

fn cameras(given: Given, networks: &Networks, told: &Told) -> Origin {
    const WHAT: &str = "cameras";
    if given.poses {
        return Origin::supplied(WHAT, "--poses", "");
    }
    match (&networks.pointmaps, told.guess) {
        (Some(file), Some(true)) => {
            Origin::network(WHAT, file, "begun with its pointmaps, adjusted to the video")
        }
        (Some(_), _) => {
            Origin::built_in(WHAT, "from the video; those of the network are not taken")
        }
        (None, _) => Origin::built_in(WHAT, "from the video"),
    }
}

fn flow(given: Given, networks: &Networks) -> Origin {
    const WHAT: &str = "flow";
    match &networks.flow {
        _ if given.flow => Origin::supplied(WHAT, "--flow", ""),
        Some(file) => Origin::network(WHAT, file, "in both directions"),
        None => Origin::built_in(WHAT, "dense inverse search with variational refinement"),
    }
}

fn depth(given: Given, networks: &Networks, told: &Told) -> Origin {
    const WHAT: &str = "depth";
    const SCALED: &str = "brought to the scale of what is triangulated";
    if given.depth {
        let how = if told.estimated_depth { SCALED } else { "as measured" };
        return Origin::supplied(WHAT, "--depth", how);
    }
    match (&networks.depth, &networks.pointmaps) {
        (Some(file), _) | (None, Some(file)) if told.estimated_depth => {
            Origin::network(WHAT, file, SCALED)
        }
        _ => Origin::built_in(WHAT, "triangulated, filled in from the surroundings"),
    }
}

fn masks(given: Given, networks: &Networks, told: &Told) -> Origin {
    const WHAT: &str = "masks";
    if given.masks {
        return Origin::supplied(WHAT, "--masks", "");
    }
    match (&networks.masks, told.masks) {
        (Some(file), Some(frames @ 1..)) => {
            let how = format!("accepted in {frames} frames, fused with residual motion");
            Origin::network(WHAT, file, how)
        }
        (Some(_), _) => {
            Origin::built_in(WHAT, "residual motion; none of the network's is accepted")
        }
        (None, _) => Origin::built_in(WHAT, "residual motion"),
    }
}

fn features(networks: &Networks, told: &Told) -> Origin {
    const WHAT: &str = "features";
    let how = format!("{} points link frames that flow does not", told.linked);
    match (told.linked, &networks.features) {
        (0, _) => Origin::none(WHAT, "none link frames that flow does not"),
        (_, Some(file)) => Origin::network(WHAT, file, how),
        (_, None) => Origin::built_in(WHAT, format!("SIFT: {how}")),
    }
}

fn tracks(given: Given) -> Origin {
    const WHAT: &str = "tracks";
    match given.tracks {
        true => Origin::supplied(WHAT, "--tracks", "beside chained flow"),
        false => Origin::built_in(WHAT, "chained flow, found again in the frames"),
    }
}

/// JSON for reports: per quantity the kind of source, the source, and the method.
pub fn to_json(origins: &[Origin]) -> Value {
    let entry = |o: &Origin| {
        (o.what.to_owned(), json!({ "source": o.source.key(), "from": o.from, "how": o.how }))
    };
    Value::Object(origins.iter().map(entry).collect::<Map<_, _>>())
}

/// Names and values for pages.
pub fn facts(origins: &[Origin]) -> Vec<(&'static str, String)> {
    let words = |o: &Origin| {
        let source = match (o.source, &o.from) {
            (Source::BuiltIn, _) => "built in".to_owned(),
            (Source::None, _) => "none".into(),
            (Source::Network, from) => from.clone().unwrap_or_default(),
            (Source::Supplied, from) => format!("supplied by {}", from.as_deref().unwrap_or("you")),
        };
        let how = if o.how.is_empty() { String::new() } else { format!(": {}", o.how) };
        (o.what, source + &how)
    };
    origins.iter().map(words).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Kind of source and source, per quantity.
    fn told(given: Given, networks: &Networks, told: &Told) -> Vec<String> {
        let found = to_json(&of(given, networks, told));
        let entry = |what: &str| {
            let [source, from] = ["source", "from"].map(|key| found[what][key].as_str());
            format!("{what} {} {}", source.unwrap(), from.unwrap_or("-"))
        };
        ["cameras", "flow", "depth", "masks", "pointmaps", "features", "tracks"].map(entry).into()
    }

    const NETWORKS: [&str; 5] = ["depth.onnx", "flow.onnx", "masks.onnx", "points.onnx", "f.onnx"];

    fn networks(which: [bool; 5]) -> Networks {
        let [depth, flow, masks, pointmaps, features] =
            [0, 1, 2, 3, 4].map(|i| which[i].then(|| PathBuf::from(NETWORKS[i])));
        Networks { depth, flow, masks, pointmaps, features }
    }

    #[test]
    fn each_quantity_has_one_source() {
        let nothing = Told::default();
        assert_eq!(
            told(Given::default(), &networks([false; 5]), &nothing),
            [
                "cameras built_in -",
                "flow built_in -",
                "depth built_in -",
                "masks built_in -",
                "pointmaps none -",
                "features none -",
                "tracks built_in -"
            ]
        );
        let all = Told { guess: Some(true), estimated_depth: true, masks: Some(3), linked: 9 };
        assert_eq!(
            told(Given::default(), &networks([true; 5]), &all),
            [
                "cameras network points.onnx",
                "flow network flow.onnx",
                "depth network depth.onnx",
                "masks network masks.onnx",
                "pointmaps network points.onnx",
                "features network f.onnx",
                "tracks built_in -"
            ]
        );
        let supplied = Given { poses: true, flow: true, depth: true, masks: true, tracks: true };
        assert_eq!(
            told(supplied, &networks([true; 5]), &nothing),
            [
                "cameras supplied --poses",
                "flow supplied --flow",
                "depth supplied --depth",
                "masks supplied --masks",
                "pointmaps none -",
                "features none -",
                "tracks supplied --tracks"
            ]
        );
    }

    #[test]
    fn what_a_network_told_in_vain_is_not_its() {
        let vain = Told { guess: Some(false), estimated_depth: false, masks: Some(0), linked: 0 };
        let found = told(Given::default(), &networks([false, false, true, true, true]), &vain);
        assert_eq!(found[0], "cameras built_in -");
        assert_eq!(
            found[2..6],
            ["depth built_in -", "masks built_in -", "pointmaps none -", "features none -"]
        );
        // Only depth is from the pointmaps.
        let depth = Told { estimated_depth: true, ..vain };
        let found = told(Given::default(), &networks([false, false, false, true, false]), &depth);
        assert_eq!(found[2], "depth network points.onnx");
        assert_eq!(found[4], "pointmaps network points.onnx");
        // With a depth network, pointmaps are used at most for cameras.
        let found = told(Given::default(), &networks([true, false, false, true, false]), &depth);
        assert_eq!((&*found[2], &*found[4]), ("depth network depth.onnx", "pointmaps none -"));
    }
}
