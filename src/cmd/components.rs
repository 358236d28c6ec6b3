//! The components of a reconstruction that can be disabled, each by a setting of the library.

use splat4d::track::Options;
use splat4d::train::SequenceSettings;

/// A component of a reconstruction.
pub struct Component {
    /// Name in options and reports.
    pub name: &'static str,
    /// Effect of disabling it, in words.
    pub without: &'static str,
    /// The setting that disables it.
    pub switch: Switch,
}

/// How a component is disabled.
#[derive(Clone, Copy)]
pub enum Switch {
    /// By a tracking option: the clip is tracked anew.
    Track(fn(&mut Options)),
    /// By a training setting: the track stays the same.
    Train(fn(&mut SequenceSettings)),
}

use Switch::{Track, Train};

/// All components; those of training come first, because they share the full run's track.
pub const COMPONENTS: [Component; 17] = [
    Component {
        name: "motion",
        without: "everything is static",
        switch: Train(|settings| settings.least_dynamic_share = f64::INFINITY),
    },
    Component {
        name: "windows",
        without: "what moves has one set of Gaussians for the whole clip, however its look changes",
        switch: Train(|settings| settings.windows = false),
    },
    Component {
        name: "control-revision",
        without: "no control points are added or removed in training; it begins with all of them",
        switch: Train(|settings| settings.revise_control = false),
    },
    Component {
        name: "blending",
        without: "each Gaussian follows one control point",
        switch: Train(|settings| settings.neighbours = 1),
    },
    Component {
        name: "arap",
        without: "nothing keeps the control points' motion as rigid as possible",
        switch: Train(|settings| settings.arap_weight = 0.0),
    },
    Component {
        name: "lifespans",
        without: "what comes or goes is there in all frames",
        switch: Train(|settings| settings.lifespans = false),
    },
    Component {
        name: "aside",
        without: "no offset views in training",
        switch: Train(|settings| settings.aside = 0.0),
    },
    Component {
        name: "flanks",
        without: "offset views show nothing of movers that their own frame does not",
        switch: Train(|settings| settings.flanks = false),
    },
    Component {
        name: "movers-depth",
        without: "the depth term leaves movers out",
        switch: Train(|settings| settings.movers_depth = 0.0),
    },
    Component {
        name: "depth",
        without: "no depth term",
        switch: Train(|settings| settings.depth_scale = 0.0),
    },
    Component {
        name: "growth",
        without: "no Gaussians are added or moved to where they are needed",
        switch: Train(|settings| settings.grow = false),
    },
    Component {
        name: "sh",
        without: "each Gaussian has one colour from everywhere",
        switch: Train(|settings| settings.sh_degree = 0),
    },
    Component {
        name: "lifting",
        without: "a mover has one depth per region of its mask and frame",
        switch: Track(|options| options.lift = false),
    },
    Component {
        name: "stereo",
        without: "static depth is that of the flow between neighbouring frames",
        switch: Track(|options| options.stereo = false),
    },
    Component {
        name: "track-refinement",
        without: "tracks are chained flow",
        switch: Track(|options| options.refine_tracks = false),
    },
    Component {
        name: "exposure",
        without: "all frames are taken to be equally exposed",
        switch: Track(|options| options.exposure = false),
    },
    Component {
        name: "rounds",
        without: "masks and cameras are found once, not in turns",
        switch: Track(|options| options.rounds = 1),
    },
];
