//! Output formats of `export`, and the features of a scene that they cannot represent.

use std::path::Path;

use clap::ValueEnum;
use splat4d::scene::{Format, Scene, spz};
use splat4d::{Error, Result};

use super::export::ExportArgs;

/// Formats of a sequence's files.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Member {
    #[value(name = "ply")]
    Ply,
    #[value(name = "compressed.ply")]
    CompressedPly,
    #[value(name = "splat")]
    Splat,
    #[value(name = "spz")]
    Spz,
}

/// Features that a format may not support.
#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
pub enum Droppable {
    Motion,
    Bands,
}

impl Droppable {
    pub fn name(self) -> &'static str {
        match self {
            Droppable::Motion => "motion",
            Droppable::Bands => "bands",
        }
    }

    /// Reason why it is omitted.
    pub fn why(self, target: Target) -> String {
        match self {
            Droppable::Motion if target.holds_motion() => "one moment was asked for".into(),
            _ => format!("{} holds none", target.extension()),
        }
    }
}

/// Versions of SPZ.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum SpzVersion {
    #[value(name = "3")]
    V3,
    #[value(name = "4")]
    V4,
}

/// Kind of an output file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    Still(Format),
    SplatV,
    Page,
    Scene,
}

impl Target {
    pub fn extension(self) -> &'static str {
        match self {
            Target::Still(format) => format.extension(),
            Target::SplatV => ".splatv",
            Target::Page => ".html",
            Target::Scene => ".safetensors",
        }
    }

    pub fn holds_motion(self) -> bool {
        !matches!(self, Target::Still(format) if format != Format::Spz(spz::Version::V4))
    }

    pub fn most_sh_degree(self) -> u32 {
        match self {
            Target::Still(format) => format.most_sh_degree(),
            Target::SplatV => 0,
            Target::Page | Target::Scene => 3,
        }
    }
}

/// Whether a path has the extension of a zip archive.
pub fn is_zip(path: &Path) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case("zip"))
}

/// The output format, or the format of the sequence's files.
pub fn target(args: &ExportArgs) -> Result<Target> {
    let version = match args.spz_version {
        SpzVersion::V3 => spz::Version::V3,
        SpzVersion::V4 => spz::Version::V4,
    };
    let named = |end: &str| args.output.extension().is_some_and(|e| e.eq_ignore_ascii_case(end));
    let bad = |what: &str| Err(Error::format(&args.output, what));
    let found = match Format::of(&args.output) {
        Some(Format::Spz(_)) => Some(Target::Still(Format::Spz(version))),
        Some(Format::Glb) if args.spz => Some(Target::Still(Format::GlbSpz)),
        Some(format) => Some(Target::Still(format)),
        None if named("splatv") => Some(Target::SplatV),
        None if named("html") => Some(Target::Page),
        None if named("safetensors") => Some(Target::Scene),
        None => None,
    };
    if args.sequence {
        if found.is_some() {
            return bad(
                "names one file; --sequence writes many: name a folder or a .zip, and their format \
                 with --as",
            );
        }
        return Ok(Target::Still(match args.format {
            Member::Ply => Format::Ply,
            Member::CompressedPly => Format::CompressedPly,
            Member::Splat => Format::Splat,
            Member::Spz => Format::Spz(version),
        }));
    }
    match found {
        Some(target) if args.spz && target != Target::Still(Format::GlbSpz) => {
            bad("is no .glb, whose Gaussians --spz compresses: name a .glb")
        }
        Some(target) if args.compact && target != Target::Scene => {
            bad("is not the scene's own format, which --compact writes: name a .safetensors")
        }
        Some(target) => Ok(target),
        None if is_zip(&args.output) => bad("is a .zip, which holds a sequence: give --sequence"),
        None => bad(
            "has no ending of a format that is written: .ply, .compressed.ply, .splat, .spz, .glb, \
             .splatv, .html, .safetensors",
        ),
    }
}

/// The scene's features that the format does not support or that the user asked to omit; an error where an
/// unsupported feature was not listed in `--drop`.
pub fn left_out(args: &ExportArgs, target: Target, scene: &Scene) -> Result<Vec<Droppable>> {
    let (mut left_out, mut refused) = (Vec::new(), Vec::new());
    // In an SPZ, `--time` is the moment that other programs show.
    let shown = args.time.is_some() && !matches!(target, Target::Still(_) if target.holds_motion());
    let still = shown || args.drop.contains(&Droppable::Motion);
    if scene.moves() && !args.sequence && (still || !target.holds_motion()) {
        left_out.push(Droppable::Motion);
        if !still {
            refused.push(
                "the scene's motion: give --time for one moment, --sequence for a file for each time, or \
                 name an .spz of version 4 or a .splatv, which hold it",
            );
        }
    }
    if scene.gaussians.used_sh_degree() > target.most_sh_degree() {
        left_out.push(Droppable::Bands);
        if !args.drop.contains(&Droppable::Bands) {
            refused.push(
                "colours that change with the direction (harmonics above the constant): --drop bands \
                 leaves them out",
            );
        }
    }
    match &refused[..] {
        [] => Ok(left_out),
        _ => Err(Error::Input(format!(
            "{} does not hold {}",
            target.extension(),
            refused.join("; nor ")
        ))),
    }
}
