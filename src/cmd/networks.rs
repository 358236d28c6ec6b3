//! Options for user-supplied networks, and what they estimate for a clip.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use splat4d::data::Clip;
use splat4d::observe::alignment::align;
use splat4d::observe::onnx::{
    FeaturesNetwork, FlowNetwork, LpipsNetwork, MaskNetwork, Models, Provider, Runtime,
    RuntimeOptions,
};
use splat4d::observe::pointmaps::Pointmaps;
use splat4d::track::{Guess, Options};
use splat4d::types::Image;
use splat4d::{Result, io};

use super::common::say;
use super::interrupt;
use super::meter::Meter;
use super::values;

/// [`Provider`] by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ProviderName {
    Cpu,
    Cuda,
    Rocm,
    Coreml,
    Directml,
    Openvino,
}

/// Options for running networks. The command has an option of the group `networks` that requests one.
#[derive(Args)]
pub struct RuntimeArgs {
    /// The ONNX Runtime's library [default: that of ORT_DYLIB_PATH, else that of the Python package
    /// onnxruntime, else the system's]
    #[arg(long, value_name = "FILE", requires = "networks")]
    onnxruntime: Option<PathBuf>,
    /// Execution provider of the ONNX Runtime, if its library supports it
    #[arg(
        long = "ep",
        value_name = "NAME",
        value_enum,
        default_value = "cpu",
        requires = "networks"
    )]
    provider: ProviderName,
    /// Threads per network [default: chosen by the ONNX Runtime]
    #[arg(long = "onnx-threads", value_name = "N", requires = "networks",
          value_parser = values::whole::<usize>(1..=1024))]
    threads: Option<usize>,
}

impl RuntimeArgs {
    /// Loads the runtime.
    pub fn load(&self) -> Result<Runtime> {
        let provider = match self.provider {
            ProviderName::Cpu => Provider::Cpu,
            ProviderName::Cuda => Provider::Cuda,
            ProviderName::Rocm => Provider::Rocm,
            ProviderName::Coreml => Provider::CoreMl,
            ProviderName::Directml => Provider::DirectMl,
            ProviderName::Openvino => Provider::OpenVino,
        };
        let library = self.onnxruntime.clone();
        let threads = self.threads.unwrap_or(0);
        let runtime = Runtime::load(&RuntimeOptions { library, provider, threads })?;
        say(&format!("networks by the ONNX Runtime {}", runtime.library().display()));
        Ok(runtime)
    }

    fn arguments(&self) -> Vec<OsString> {
        let named = self.provider.to_possible_value();
        let provider = named.map(|value| value.get_name().to_owned().into());
        let options = [
            ("--onnxruntime", self.onnxruntime.clone().map(OsString::from)),
            ("--ep", provider),
            ("--onnx-threads", self.threads.map(|threads| threads.to_string().into())),
        ];
        let given = options.into_iter().filter_map(|(name, value)| Some([name.into(), value?]));
        given.flatten().collect()
    }
}

/// Networks that estimate properties of a clip.
#[derive(Args)]
pub struct NetworkArgs {
    /// Networks for depth, flow, masks, pointmaps and features: a folder with ONNX models and a models.toml
    /// that lists the purpose of each. Pointmaps (MonST3R, DUSt3R) give initial cameras, and depth if no
    /// other network does. Features (XFeat) link frames that flow does not: where the camera returns, and
    /// where flow is lost. Data from --poses, --depth, --flow or --masks replaces that of the networks
    #[arg(long, value_name = "DIR", group = "networks")]
    models: Option<PathBuf>,
    #[command(flatten)]
    runtime: RuntimeArgs,
}

impl NetworkArgs {
    /// Loads the runtime and the networks, if any are requested.
    pub fn open(&self) -> Result<Option<Models>> {
        let Some(folder) = &self.models else { return Ok(None) };
        // A missing list is reported before a missing runtime.
        Models::files(folder)?;
        Models::open(&self.runtime.load()?, folder).map(Some)
    }

    /// All files that are read.
    pub fn files(&self) -> Vec<PathBuf> {
        let models = self.models.as_ref().and_then(|folder| Models::files(folder).ok());
        models.into_iter().flatten().chain(self.runtime.onnxruntime.clone()).collect()
    }

    /// The networks as an entry of a checkpoint's identity: the checksum of the files' contents.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn identity(&self) -> Result<String> {
        let Some(folder) = &self.models else { return Ok("none".into()) };
        let sums = Models::files(folder)?
            .into_iter()
            .map(|file| Ok(format!("{:08x}", crc32fast::hash(&io::read(&file)?))));
        Ok(format!("files with the checksums {}", sums.collect::<Result<Vec<_>>>()?.join(", ")))
    }
}

/// Estimates the depth of the frames with a network, if there is one and no depth is supplied.
pub fn estimate_depth(
    models: &mut Option<Models>,
    frames: &[Image],
    options: &mut Options,
) -> Result<()> {
    let network = models.as_mut().and_then(|models| models.depth.as_mut());
    let supplied = options.depth.is_some() || options.estimated_depth.is_some();
    let Some(network) = network.filter(|_| !supplied) else { return Ok(()) };
    let mut meter = Meter::new("depth by the network", "%", 100, 0);
    options.estimated_depth = Some(network.clip(frames, &mut |share| {
        interrupt::check()?;
        meter.set((100.0 * share) as u64);
        Ok(())
    })?);
    Ok(())
}

/// The networks that tracking uses, if present.
#[derive(Default)]
pub struct TrackNetworks<'a> {
    pub flow: Option<&'a mut FlowNetwork>,
    pub masks: Option<&'a mut MaskNetwork>,
    pub features: Option<&'a mut FeaturesNetwork>,
}

impl<'a> TrackNetworks<'a> {
    /// The networks of a model folder.
    pub fn of(models: &'a mut Option<Models>) -> TrackNetworks<'a> {
        let Some(Models { flow, masks, features, .. }) = models else {
            return TrackNetworks::default();
        };
        TrackNetworks { flow: flow.as_mut(), masks: masks.as_mut(), features: features.as_mut() }
    }
}

/// Estimates pointmaps with a network, if there is one and the initial cameras or the depth that they give
/// are not supplied. Returns a note in addition to the track's own.
pub fn estimate_pointmaps(
    models: &mut Option<Models>,
    frames: &[Image],
    options: &mut Options,
) -> Result<Option<String>> {
    let network = models.as_mut().and_then(|models| models.pointmaps.as_mut());
    let cameras = options.poses.is_none() && options.static_motion.is_none();
    let depth = options.depth.is_none() && options.estimated_depth.is_none();
    let asked = (cameras || depth) && frames.len() >= Clip::LEAST;
    let Some(network) = network.filter(|_| asked) else { return Ok(None) };
    let name = network.file().file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut meter = Meter::new("pointmaps by the network", "%", 100, 0);
    let maps = Pointmaps::gather(&mut network.source(frames)?, frames.len(), &mut |share| {
        interrupt::check()?;
        meter.set((100.0 * share) as u64);
        Ok(())
    })?;
    let given = options.intrinsics.map(|k| 0.5 * (k.fx + k.fy)).or(options.focal);
    let found = match align(&maps, given.filter(|_| !options.refined.focal)) {
        Ok(found) => found,
        // The video is tracked without them, as without a network.
        Err(error) => return Ok(Some(format!("the pointmaps of {name} are not used: {error}"))),
    };
    let factors = &found.depth_factors;
    if depth {
        options.estimated_depth = Some(maps.into_depth(factors));
    }
    if !cameras {
        return Ok(Some(format!("estimated depth is that of the pointmaps of {name}")));
    }
    let whose = if depth { "estimated depth is theirs, too" } else { "depth is not theirs" };
    options.guess = Some(Guess {
        from: format!(
            "the pointmaps of {name} (half of their points agree within {:.1} %; {whose})",
            100.0 * found.off
        ),
        poses: found.view_from_world,
        focal: found.focal,
        focal_deviation: found.focal_deviation,
    });
    Ok(None)
}

/// Option for LPIPS in addition to the other image metrics.
#[derive(Args)]
pub struct LpipsArgs {
    /// Also measure LPIPS, with this ONNX model, whose metadata names the feature network
    #[arg(long, value_name = "FILE", group = "networks")]
    lpips: Option<PathBuf>,
    #[command(flatten)]
    runtime: RuntimeArgs,
}

impl LpipsArgs {
    /// Loads the runtime and the network, if it is requested.
    pub fn open(&self) -> Result<Option<LpipsNetwork>> {
        let Some(file) = &self.lpips else { return Ok(None) };
        // A missing model is reported before a missing runtime.
        io::open(file)?;
        LpipsNetwork::open(&self.runtime.load()?, file).map(Some)
    }

    /// The same options for another command of this program.
    pub fn arguments(&self) -> Vec<OsString> {
        let Some(file) = &self.lpips else { return Vec::new() };
        let mut words: Vec<OsString> = vec!["--lpips".into(), file.into()];
        words.extend(self.runtime.arguments());
        words
    }

    /// All files that are read.
    pub fn files(&self) -> impl Iterator<Item = PathBuf> {
        [&self.lpips, &self.runtime.onnxruntime].into_iter().flatten().cloned()
    }
}
