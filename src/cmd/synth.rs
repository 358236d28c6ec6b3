//! `splat4d synth`: makes a synthetic clip with ground truth.

use std::path::PathBuf;

use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use splat4d::data::synth::{self, SynthOptions};
use splat4d::{Result, io};

use super::common::{Answer, Common, path_text, say};
use super::outputs::Outputs;
use super::{interrupt, values};

const AFTER_HELP: &str = "\
rigid   a cart is driven through a room, the camera moves
bend    a cloth ripples and a column bends, the camera moves
crowd   walkers cover more than half of the image, the camera moves
still   nothing moves but the camera
tripod  the cart again, the camera fixed
throw   a ball and a box fly past each other, spinning, over a floor that is nearly plain
hold    a hand turns a glossy jug before the camera
walk    a person with limbs walks across the room and turns
pan     a car passes in a street, the camera turns in place and follows it
follow  the same, the camera in the hands of one who stands

In the last five movers cast shadows. DIR/frames holds the images; DIR/truth intrinsics, poses
(TUM), depth (EXR), flow (.flo), masks, point tracks (.npz), and held-out cameras 8, 18 and 30 % of the
median depth aside, every second time, with masks of the movers there and of the pixels that some frame saw.

--coded is for clips in which nothing moves but as one rigid thing: rigid, still, tripod. Depth, what moves,
the camera and the motion stand in the colours of its frames; their brightness is that of the clip.

Example:
  splat4d synth rigid -o clip --frames 24 --size 320x180

JSON: name, frames, width, height, seed, coded, output";

/// Make a synthetic clip with exact poses, depth, flow and masks
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct SynthArgs {
    /// Name of the clip
    #[arg(value_parser = PossibleValuesParser::new(synth::NAMES))]
    name: String,
    /// The output folder, which must be new or empty
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Number of frames
    #[arg(long, value_name = "N", default_value_t = SynthOptions::default().frames,
          value_parser = values::whole::<usize>(2..=10_000))]
    frames: usize,
    /// Size of the images
    #[arg(long, value_name = "WxH", default_value = "320x180", value_parser = values::size)]
    size: (u32, u32),
    /// Encode ground truth in the frames' colours (16-bit PNG), for tests of networks
    #[arg(long)]
    coded: bool,
}

/// Runs the command.
pub fn run(args: &SynthArgs, common: &Common) -> Result<Answer> {
    Outputs::default().folder(&args.output, &["frames", "truth"])?;
    io::check_new_folder(&args.output)?;
    let SynthArgs { name, output, frames, size: (width, height), coded } = args;
    let options =
        SynthOptions { frames: *frames, width: *width, height: *height, seed: common.seed };
    say(&format!("rendering {frames} frames of {name}, {width}×{height}"));
    let clip = match coded {
        true => synth::coded_clip(name, &options)?,
        false => synth::clip(name, &options)?,
    };
    interrupt::check()?;
    synth::write(&clip, output)?;
    let json = json!({
        "name": name, "frames": frames, "width": width, "height": height, "seed": common.seed,
        "coded": coded, "output": path_text(output),
    });
    let text = format!("{0}/frames, {0}/truth\n", output.display());
    Ok(Answer { json, text })
}
