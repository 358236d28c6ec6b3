//! The commands of the `splat4d` program, and the modules that they share (options, progress, checkpoints,
//! report pages, output checks). They use only the crate's public API.
//!
//! A command returns an [`Answer`]; [`main`] prints it, as text or as JSON, and turns errors into
//! exit codes: 0 done, 1 the job failed, 2 wrong usage, 130 stopped by Ctrl-C.

mod ablate;
mod ablation;
mod batch;
mod batch_emit;
mod batch_list;
mod bench;
mod camera_maps;
mod charts;
mod checkpoints;
mod child;
mod clip;
mod clock;
mod common;
mod compact;
mod completions;
mod components;
mod devices;
mod doctor;
mod doctor_machine;
mod doctor_vulkan;
mod encode;
mod eval;
mod eval_first;
mod eval_scale;
mod eval_tracks;
mod eval_truth;
mod export;
mod export_target;
mod fuzz;
mod held_out;
mod info;
mod interrupt;
mod known;
mod layers;
mod live;
mod man;
mod meter;
mod model;
mod networks;
mod origins;
mod outputs;
mod page;
mod pictures;
mod player;
mod protocols;
mod published;
mod quality;
mod reconstruct;
mod reconstruct_page;
mod reconstruct_pictures;
mod render;
mod render_bench;
mod rows;
mod run_page;
mod sheet;
mod shots;
mod staged;
mod supplied;
mod synth;
mod table;
mod track;
mod track_model;
mod track_page;
mod track_pictures;
mod tracker;
mod train;
mod train_page;
mod tuning;
mod validate;
mod validate_page;
mod values;
mod view;
mod watcher;

use std::ffi::OsString;
use std::io::{IsTerminal, Write, stderr, stdin, stdout};
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use common::{Answer, Common};
use serde_json::json;
use splat4d::{Error, Result};

const AFTER_HELP: &str = "\
Examples:
  splat4d reconstruct video.mp4 -o scene.safetensors
  splat4d train captures/fox -o fox.safetensors
  splat4d render scene.safetensors -o views --path orbit

`splat4d COMMAND --help` shows each command's options, an example and the keys of its JSON.
Exit codes: 0 done, 1 the job failed, 2 wrong usage, 130 stopped by Ctrl-C.";

/// A Vulkan compute engine that turns one video of a moving scene into a 4D Gaussian-splat scene.
#[derive(Parser)]
#[command(name = "splat4d", version, after_help = AFTER_HELP, arg_required_else_help = true)]
struct Cli {
    #[command(flatten)]
    common: Common,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Reconstruct(reconstruct::ReconstructArgs),
    Batch(batch::BatchArgs),
    Track(track::TrackArgs),
    Train(train::TrainArgs),
    Render(render::RenderArgs),
    Export(export::ExportArgs),
    Eval(eval::EvalArgs),
    Ablate(ablate::AblateArgs),
    Info(info::InfoArgs),
    Devices(devices::DevicesArgs),
    Doctor(doctor::DoctorArgs),
    Bench(bench::BenchArgs),
    Synth(synth::SynthArgs),
    Table(table::TableArgs),
    Validate(validate::ValidateArgs),
    Completions(completions::CompletionsArgs),
    Man(man::ManArgs),
    View(view::ViewArgs),
}

/// Columns of the help where neither a terminal nor `COLUMNS` gives a width: as many as the lines of its
/// texts have at most, so that none is broken again.
const HELP_WIDTH: usize = 110;

/// The process's command line.
fn parse() -> std::result::Result<Cli, clap::Error> {
    let terminals = [stdin().is_terminal(), stdout().is_terminal(), stderr().is_terminal()];
    let mut command = Cli::command();
    if std::env::var_os("COLUMNS").is_none() && !terminals.contains(&true) {
        command = command.term_width(HELP_WIDTH);
    }
    let matches = command.try_get_matches_from_mut(std::env::args_os())?;
    Cli::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// Runs the command on the process's command line.
pub fn main() -> ExitCode {
    let cli = match parse() {
        Ok(cli) => cli,
        Err(error) => return explain(&error),
    };
    let json = cli.common.json;
    let done = run(&cli);
    interrupt::end();
    match done.and_then(|(answer, code)| print(&answer, json).map(|()| code)) {
        Ok(code) => code,
        Err(error) => {
            let what = in_full(&error);
            common::say(&format!("error: {what}"));
            if json {
                // With --json, errors are reported as the one object on stdout too. If even that cannot be
                // written, stderr and the exit code have reported the error.
                let _ = common::print_json(&json!({ "error": what }));
            }
            ExitCode::from(match error {
                Error::Interrupted { .. } => interrupt::EXIT_CODE,
                _ => 1,
            })
        }
    }
}

/// An error message, with the command-line option that remedies it.
fn in_full(error: &Error) -> String {
    match error {
        Error::Interrupted { checkpoint: Some(_) } => format!("{error}: give --resume"),
        _ => error.to_string(),
    }
}

/// Prints help or the version where they were requested, else the error in the arguments.
fn explain(error: &clap::Error) -> ExitCode {
    let _ = error.print();
    let json = std::env::args_os().take_while(|argument| argument != "--");
    if error.use_stderr() && json.into_iter().any(|argument| argument == "--json") {
        let _ = common::print_json(&json!({ "error": usage_error(error) }));
    }
    ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2))
}

/// Parses words after the program's name as a command, without running it.
fn parsed(words: &[OsString]) -> std::result::Result<Cli, String> {
    let whole = [OsString::from("splat4d")].into_iter().chain(words.iter().cloned());
    Cli::try_parse_from(whole).map_err(|error| usage_error(&error))
}

/// The error in the arguments on one line, without the usage that follows.
fn usage_error(error: &clap::Error) -> String {
    let text = error.render().to_string();
    let what = ["\n\nUsage:", "\n\nFor more information"]
        .iter()
        .fold(&text[..], |text, end| text.split(end).next().unwrap_or_default());
    let words = what.strip_prefix("error: ").unwrap_or(what).split_whitespace();
    words.collect::<Vec<_>>().join(" ")
}

fn run(cli: &Cli) -> Result<(Answer, ExitCode)> {
    common::check_room()?;
    start_threads()?;
    interrupt::watch(cli.common.json);
    let answer = match &cli.command {
        Command::Reconstruct(args) => reconstruct::run(args, &cli.common),
        Command::Track(args) => track::run(args, &cli.common),
        Command::Train(args) => train::run(args, &cli.common),
        Command::Render(args) => render::run(args, &cli.common),
        Command::Export(args) => export::run(args, &cli.common),
        Command::Eval(args) => eval::run(args, &cli.common),
        Command::Ablate(args) => ablate::run(args, &cli.common),
        Command::Info(args) => info::run(args),
        Command::Devices(args) => devices::run(args),
        Command::Synth(args) => synth::run(args, &cli.common),
        Command::Completions(args) => completions::run(args),
        Command::Man(args) => man::run(args),
        Command::View(args) => view::run(args, &cli.common),
        // The results of these commands determine the exit code.
        Command::Batch(args) => return batch::run(args, &cli.common),
        Command::Doctor(_) => return doctor::run(&cli.common),
        Command::Bench(args) => return bench::run(args, &cli.common),
        Command::Table(args) => return table::run(args, &cli.common),
        Command::Validate(args) => return validate::run(args, &cli.common),
    };
    Ok((answer?, ExitCode::SUCCESS))
}

/// Starts the threads that all parallel work shares. If they were started by the first such work instead, a
/// failure would be a panic.
fn start_threads() -> Result<()> {
    rayon::ThreadPoolBuilder::new().build_global().map_err(|error| {
        Error::Failed(format!(
            "the threads to work on cannot be started: {error}; raise the limits (ulimit -v, ulimit \
             -u) or set RAYON_NUM_THREADS=1"
        ))
    })
}

/// Prints an answer on stdout. A closed pipe is not an error.
fn print(answer: &Answer, json: bool) -> Result<()> {
    let printed = match json {
        true => common::print_json(&answer.json),
        false => {
            let mut stdout = std::io::stdout().lock();
            write!(stdout, "{}", answer.text).and_then(|()| stdout.flush())
        }
    };
    match printed {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Error::io("stdout")(error))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::error::ErrorKind;
    use std::any::TypeId;
    use std::path::PathBuf;

    #[test]
    fn the_declarations_hold_together() {
        Cli::command().debug_assert();
    }

    #[test]
    fn no_line_of_a_help_text_is_broken_again() {
        fn walk(command: &clap::Command, seen: &mut usize) {
            let text = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            for line in text.lines() {
                *seen += 1;
                let width = line.chars().count();
                assert!(width <= HELP_WIDTH, "{}, {width} columns: {line}", command.get_name());
            }
            command.get_subcommands().for_each(|command| walk(command, seen));
        }
        let mut seen = 0;
        walk(&Cli::command(), &mut seen);
        assert!(seen > 300, "{seen} lines were found");
    }

    /// Option values that are invalid for every command.
    const HOSTILE: [&str; 11] = [
        "-1",
        "0",
        "NaN",
        "inf",
        "1e300",
        "4294967295",
        "4294967296",
        "18446744073709551615",
        "18446744073709551616",
        "many",
        "",
    ];

    /// Those of them that are within an option's range.
    fn in_range(option: &str) -> &'static [&'static str] {
        match option {
            "seed" => &["0", "4294967295", "4294967296", "18446744073709551615"],
            "max_gaussians" | "eval_every" | "sh_degree" | "checkpoint_every" | "max_time_diff"
            | "align_first" | "rpe_tolerance" | "static_motion" | "shot" | "times" => &["0"],
            "time_offset" => &["-1", "0"],
            "time" => &["0"],
            "background" => &["0,0,0"],
            _ => &[],
        }
    }

    /// Whether an argument takes text (a path, one of a list of words, a name) and not numbers.
    fn takes_text(argument: &clap::Arg) -> bool {
        let is_path = argument.get_value_parser().type_id() == TypeId::of::<PathBuf>();
        let words = ["device", "filter", "path", "image", "claim", "host"];
        let names = ["scenes", "train_camera", "test_cameras"];
        is_path
            || !argument.get_possible_values().is_empty()
            || argument.is_last_set()
            || words.iter().chain(&names).any(|name| argument.get_id() == *name)
    }

    /// Whether a command accepts the value, regardless of other missing arguments.
    fn accepts(way: &[String], argument: &clap::Arg, value: &str) -> bool {
        let long = argument.get_long().expect("a number has a name");
        let line = [way, &[format!("--{long}={value}")]].concat();
        let kind = Cli::command().try_get_matches_from(line).err().map(|error| error.kind());
        !matches!(kind, Some(ErrorKind::InvalidValue | ErrorKind::ValueValidation))
    }

    #[test]
    fn every_number_has_a_range() {
        fn walk(command: &clap::Command, way: &[String], seen: &mut usize) {
            let way = [way, &[command.get_name().to_owned()]].concat();
            for argument in command.get_arguments() {
                if !argument.get_action().takes_values() || takes_text(argument) {
                    continue;
                }
                *seen += 1;
                for hostile in HOSTILE {
                    let several = [
                        hostile.to_owned(),
                        format!("{hostile}x{hostile}"),
                        format!("{hostile}x9"),
                        format!("{hostile},{hostile},{hostile}"),
                        format!("1,{hostile}"),
                    ];
                    for value in several {
                        let option = argument.get_id().as_str();
                        // A list is in range if each of its numbers is.
                        let fine = in_range(option).contains(&value.as_str())
                            || option == "times" && value.split(',').all(|v| v == "0" || v == "1");
                        assert!(
                            fine || !accepts(&way, argument, &value),
                            "{}: --{option} takes `{value}`; give it a parser of cmd/values.rs",
                            way.join(" ")
                        );
                    }
                }
            }
            command.get_subcommands().for_each(|command| walk(command, &way, seen));
        }
        let mut seen = 0;
        walk(&Cli::command(), &[], &mut seen);
        assert!(seen > 30, "{seen} numbers were found");
    }
}
