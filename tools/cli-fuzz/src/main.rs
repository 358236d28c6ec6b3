//! Fuzzes the command line with random options and damaged files. For any input the program must end with
//! exit code 0, 1 or 2 (130 when interrupted), report an error in one line, leave no partial output,
//! leave its inputs unchanged, and stay within limits of time and memory.
//!
//! A command depends only on the seed and its number, so `--only NUMBER` repeats it.

mod damage;
mod draw;
mod fixtures;
mod grammar;
mod judge;
#[path = "../../../tests/support/wild.rs"]
mod wild;

use std::fs;
use std::io::Write;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;

use draw::{COMMANDS, Drawn, INPUTS};
use fixtures::Fixtures;
use grammar::Flag;
use judge::{Bounds, Ended};

/// Runs splat4d with options and damaged files drawn at random
#[derive(Parser)]
struct Args {
    /// The program
    #[arg(long, value_name = "FILE", default_value = "target/release/splat4d")]
    program: PathBuf,
    /// Number of commands
    #[arg(long, value_name = "N", default_value_t = 5000)]
    commands: u64,
    /// Chooses the commands
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    seed: u64,
    /// Only the command of this number
    #[arg(long, value_name = "NUMBER")]
    only: Option<u64>,
    /// Seconds after which a command is interrupted
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    seconds: u64,
    /// Address space of a command, MiB
    #[arg(long, value_name = "MIB", default_value_t = 4096)]
    memory: u64,
    /// Commands at a time
    #[arg(long, value_name = "N", default_value_t = 2)]
    jobs: usize,
    /// Failures are kept here: the command, what it printed and its files
    #[arg(long, value_name = "DIR", default_value = "out/cli-fuzz")]
    keep: PathBuf,
}

fn main() -> ExitCode {
    match run(&Args::parse()) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// State that all commands share.
struct Run<'a> {
    args: &'a Args,
    program: PathBuf,
    fixtures: Fixtures,
    flags: Vec<(String, Vec<Flag>)>,
    bounds: Bounds,
    folder: PathBuf,
    /// Number of commands by outcome.
    ends: Mutex<std::collections::BTreeMap<String, usize>>,
    /// The fixtures' previous state. The lock lets only one command check the fixtures at a time.
    fixtures_before: Mutex<fixtures::State>,
}

fn run(args: &Args) -> Result<ExitCode, String> {
    let program = fs::canonicalize(&args.program).map_err(at(&args.program))?;
    // The work folder is beside the kept failures, so that a failure's folder can be moved there.
    fs::create_dir_all(&args.keep).map_err(at(&args.keep))?;
    let keep = fs::canonicalize(&args.keep).map_err(at(&args.keep))?;
    let scratch = tempfile::tempdir_in(&keep).map_err(at(&keep))?;
    let fixtures = Fixtures::write(&program, &keep.join("fixtures"))?;
    let flags = COMMANDS
        .iter()
        .map(|command| Ok((command.to_string(), grammar::flags(&program, command)?)))
        .collect::<Result<_, String>>()?;
    let state = fixtures.state();
    let run = Run {
        args,
        program,
        fixtures,
        flags,
        bounds: Bounds {
            time: Duration::from_secs(args.seconds),
            grace: Duration::from_secs(20),
            memory: args.memory << 10,
        },
        folder: scratch.path().to_path_buf(),
        ends: Mutex::default(),
        fixtures_before: Mutex::new(state),
    };
    let numbers = match args.only {
        Some(number) => number..number + 1,
        None => 0..args.commands,
    };
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {per_sec} {eta} {msg}");
    let bar = ProgressBar::new(numbers.end - numbers.start)
        .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.jobs.max(1))
        .build()
        .map_err(|e| e.to_string())?;
    let outcomes: Vec<Result<bool, String>> = pool.install(|| {
        numbers
            .into_par_iter()
            .map(|number| {
                let fine = one(&run, &keep, number, &bar);
                bar.inc(1);
                fine
            })
            .collect()
    });
    bar.finish_and_clear();
    let outcomes = outcomes.into_iter().collect::<Result<Vec<bool>, String>>()?;
    let failed = outcomes.iter().filter(|fine| !**fine).count();
    let ends = run.ends.lock().map_err(|e| e.to_string())?;
    let how: Vec<String> = ends.iter().map(|(how, count)| format!("{how}: {count}")).collect();
    println!(
        "{} commands of seed {} ({}), {failed} failed",
        outcomes.len(),
        args.seed,
        how.join(", ")
    );
    Ok(ExitCode::from(u8::from(failed > 0)))
}

/// Adds the path to an error.
fn at(path: &Path) -> impl FnOnce(std::io::Error) -> String {
    move |e| format!("{}: {e}", path.display())
}

/// Runs the command with the given number; returns whether it kept the rules.
fn one(run: &Run, keep: &Path, number: u64, bar: &ProgressBar) -> Result<bool, String> {
    let folder = run.folder.join(number.to_string());
    let failed = |e: std::io::Error| format!("command {number}: {e}");
    fs::create_dir(&folder).map_err(failed)?;
    fs::create_dir(folder.join("out")).map_err(failed)?;
    symlink(&run.fixtures.root, folder.join(INPUTS)).map_err(failed)?;
    let drawn =
        draw::draw(&run.fixtures, &run.flags, &folder, run.args.seed, number).map_err(failed)?;
    let mut ended = judge::run(&run.program, &drawn, &folder, &run.bounds).map_err(failed)?;
    {
        let mut before = run.fixtures_before.lock().map_err(|e| e.to_string())?;
        let now = settled(&run.fixtures, &before);
        if *before != now {
            ended.faults.push("an input was changed by this command or one beside it".into());
            *before = now;
        }
    }
    *run.ends.lock().map_err(|e| e.to_string())?.entry(ended.how.clone()).or_default() += 1;
    if ended.faults.is_empty() {
        fs::remove_dir_all(&folder).map_err(failed)?;
        return Ok(true);
    }
    let command = shell(&drawn);
    bar.suspend(|| println!("{number}: {command}\n    {}", ended.faults.join("\n    ")));
    let kept = keep.join(format!("{}-{number}", run.args.seed));
    if kept.exists() {
        fs::remove_dir_all(&kept).map_err(failed)?;
    }
    fs::rename(&folder, &kept).map_err(failed)?;
    report(&kept, &command, &ended).map_err(failed)?;
    Ok(false)
}

/// The fixtures' state. Waits up to a second for it to equal `before`: a command that would write over an
/// input tests the path before it refuses, and removes its test file soon after.
fn settled(fixtures: &Fixtures, before: &fixtures::State) -> fixtures::State {
    let begun = Instant::now();
    loop {
        let now = fixtures.state();
        if now == *before || begun.elapsed().as_secs() >= 1 {
            return now;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn report(folder: &Path, command: &str, ended: &Ended) -> std::io::Result<()> {
    let mut file = fs::File::create(folder.join("fault.txt"))?;
    writeln!(file, "{command}\n\n{}\n{}\n\nstderr:", ended.how, ended.faults.join("\n"))?;
    file.write_all(&ended.stderr)?;
    writeln!(file, "\nstdout:")?;
    file.write_all(&ended.stdout)
}

/// The command, quoted for a shell.
fn shell(drawn: &Drawn) -> String {
    let plain = |b: &u8| b.is_ascii_alphanumeric() || b"-_./,=%:".contains(b);
    let quoted = drawn.words.iter().map(|word| {
        let bytes = word.as_bytes();
        if !bytes.is_empty() && bytes.iter().all(plain) {
            return word.to_string_lossy().into_owned();
        }
        let escaped = |b: &u8| match b {
            b'\'' | b'\\' => format!("\\{}", *b as char),
            b' '..=b'~' => (*b as char).to_string(),
            _ => format!("\\x{b:02x}"),
        };
        format!("$'{}'", bytes.iter().map(escaped).collect::<String>())
    });
    let text = quoted.collect::<Vec<_>>().join(" ");
    // Names of 300 letters are shortened.
    let long = "n".repeat(300);
    format!("splat4d {}", text.replace(&long, "nnn…"))
}
