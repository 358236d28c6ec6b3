//! `splat4d batch`: reconstructs many clips, one after another.

use std::fmt::Write;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use clap::Args;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use splat4d::io::{self, Identity, difference};
use splat4d::report::record;
use splat4d::{Error, Result};

use super::batch_emit::{self, EmitArgs};
use super::batch_list::{self, Job};
use super::common::{Answer, Common, path_text, say, thousands};
use super::outputs::{Inputs, Outputs};
use super::{child, interrupt};

const AFTER_HELP: &str = "\
LIST is a TOML file. [defaults] holds options of reconstruct by their long names, each [[job]] a `name`
of its own, by which its files are called, an `input`, the clip, and options that override the defaults:

  [defaults]
  quality = \"draft\"
  size = 320

  [[job]]
  name = \"bear\"
  input = \"videos/bear.mp4\"

  [[job]]
  name = \"cow\"
  input = \"videos/cow\"
  steps = 500
  poses = \"poses/cow.txt\"
  refine = [\"poses\", \"focal\"]
  pinhole = true

Paths are relative to the list's folder. --device and --seed hold where the list does not say. All jobs
are checked before the first one begins. Each runs in a process of its own; one that fails is told, and
the others go on; then the exit code is 1.

A job writes OUT/NAME.safetensors, OUT/NAME.report, OUT/NAME.log, and NAME.done.json when it is done. The
same command again skips what is done, as long as its options and what its files hold are the same, and
goes on with what was stopped. To begin a job anew, remove OUT/NAME.*.

--emit writes the jobs into OUT for another engine instead, each one `splat4d reconstruct`: Snakefile;
jobs.sbatch (an array, with jobs.tsv); jobs.yaml (a Job each). Snakemake and Slurm take splat4d from PATH.

Examples:
  splat4d batch list.toml -o out
  splat4d batch list.toml -o out --emit snakemake --cpus 4
  splat4d batch list.toml -o out --emit slurm --cpus 8 --memory 32 --gpus 1
  splat4d batch list.toml -o /data/out --emit k8s --mount /data --image registry/splat4d

JSON: jobs [{name, state (done, failed, skipped), seconds, psnr_input, ssim_input, frames, gaussians,
control_points, dynamic_share, peak_bytes, error (or null), log}], done, failed, skipped, seconds,
output. With --emit: emit, files, jobs, output";

/// Metrics of a reconstruction in the summary.
const FIGURES: [&str; 7] = [
    "psnr_input",
    "ssim_input",
    "frames",
    "gaussians",
    "control_points",
    "dynamic_share",
    "peak_bytes",
];
/// File name of the summary table.
const TABLE: &str = "batch.csv";
/// Suffixes of the files that a job writes besides its scene and its report.
const LOG: &str = ".log";
const DONE: &str = ".done.json";
const BEGUN: &str = ".begun.json";

/// Reconstruct many clips, one after another
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct BatchArgs {
    /// The list of jobs, a TOML file
    #[arg(value_name = "LIST")]
    list: PathBuf,
    /// The folder for all output of the jobs
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    emit: EmitArgs,
}

/// Runs the command. The exit code indicates whether every job is done.
pub fn run(args: &BatchArgs, common: &Common) -> Result<(Answer, ExitCode)> {
    let BatchArgs { list, output, emit } = args;
    if let Some(engine) = emit.engine()? {
        // The other engine may run in another working directory.
        let [list, output] = [absolute(list)?, absolute(output)?];
        let jobs = batch_list::read(&list, &output, common)?;
        check_outputs(&list, &jobs, &output, engine.files())?;
        return Ok((batch_emit::write(engine, emit, &jobs, &output)?, ExitCode::SUCCESS));
    }
    let jobs = batch_list::read(list, output, common)?;
    check_outputs(list, &jobs, output, &[TABLE])?;
    let began = Instant::now();
    let mut ended = Vec::new();
    for (i, job) in jobs.iter().enumerate() {
        say(&format!("{} ({} of {})", job.name, i + 1, jobs.len()));
        let end = attempt(job);
        if let Err(error @ Error::Interrupted { .. }) = end {
            say(&format!("note: the same command goes on with {}", job.name));
            write_table(&output.join(TABLE), &ended)?;
            return Err(error);
        }
        let end = end.unwrap_or_else(|error| End::failed(job, 0.0, error.to_string()));
        say(&end.line());
        ended.push(end);
    }
    write_table(&output.join(TABLE), &ended)?;
    let count = |state| ended.iter().filter(|end| end.state == state).count();
    let failed = count(State::Failed);
    let json = json!({
        "jobs": ended.iter().map(End::json).collect::<Vec<_>>(),
        "done": count(State::Done),
        "failed": failed,
        "skipped": count(State::Skipped),
        "seconds": began.elapsed().as_secs_f64(),
        "output": path_text(output),
    });
    let code = if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    Ok((Answer { text: text(&ended, &json, &output.join(TABLE)), json }, code))
}

fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).map_err(Error::io(path))
}

/// Checks that the jobs' files and the `further` ones can be written and do not overwrite any job's inputs.
fn check_outputs(list: &Path, jobs: &[Job], folder: &Path, further: &[&str]) -> Result<()> {
    let all = Inputs::new([list.to_path_buf()], []);
    let all = jobs.iter().fold(all, |all, job| all.and(job.args.inputs()));
    Outputs::default().folder(folder, further)?.spare(&all)?;
    for job in jobs {
        let of_job = |error: Error| Error::Input(format!("job `{}`: {error}", job.name));
        let outputs = job.args.outputs().map_err(of_job)?;
        let own = [LOG, DONE, BEGUN].iter().try_fold(outputs, |all, end| all.file(&job.file(end)));
        own.and_then(|own| own.spare(&all)).map_err(of_job)?;
    }
    Ok(())
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    Done,
    Failed,
    /// Completed by an earlier run.
    Skipped,
}

/// Result of a job.
struct End {
    name: String,
    state: State,
    seconds: f64,
    figures: Map<String, Value>,
    error: Option<String>,
    log: PathBuf,
}

/// Record of a completed job.
#[derive(Serialize, Deserialize)]
struct Finished {
    identity: Identity,
    seconds: f64,
    figures: Map<String, Value>,
}

impl End {
    fn new(job: &Job, state: State, finished: Finished) -> End {
        let Finished { seconds, figures, .. } = finished;
        End { name: job.name.clone(), state, seconds, figures, error: None, log: job.file(LOG) }
    }

    fn failed(job: &Job, seconds: f64, error: String) -> End {
        let none = Finished { identity: Identity::new(), seconds, figures: Map::new() };
        End { error: Some(error), ..End::new(job, State::Failed, none) }
    }

    fn state(&self) -> &'static str {
        match self.state {
            State::Done => "done",
            State::Failed => "failed",
            State::Skipped => "skipped",
        }
    }

    /// A metric, null where it is absent.
    fn figure(&self, key: &str) -> Value {
        self.figures.get(key).cloned().unwrap_or_default()
    }

    fn json(&self) -> Value {
        let mut json = json!({
            "name": self.name,
            "state": self.state(),
            "seconds": self.seconds,
            "error": self.error,
            "log": path_text(&self.log),
        });
        FIGURES.iter().for_each(|key| json[key] = self.figure(key));
        json
    }

    /// A line for people, printed as soon as the job ends.
    fn line(&self) -> String {
        match (&self.error, self.state) {
            (Some(error), _) => format!("{}: failed: {error}", self.name),
            (None, State::Skipped) => format!("{}: skipped, it is done already", self.name),
            _ => format!("{}: done in {:.1} s", self.name, self.seconds),
        }
    }
}

/// Runs a job unless it is done. An error belongs to the job, unless the user has requested a stop.
fn attempt(job: &Job) -> Result<End> {
    interrupt::check()?;
    let identity = job.identity()?;
    let kept = [DONE, BEGUN].map(|end| job.file(end));
    if let Some(finished) = read_kept::<Finished>(&kept[0])
        && job.scene().is_file()
    {
        match difference(&finished.identity, &identity) {
            None => return Ok(End::new(job, State::Skipped, finished)),
            Some(what) => say(&format!("{}: anew: {what}", job.name)),
        }
    }
    // The checkpoint of other input or options would be rejected.
    let resumes = read_kept::<Identity>(&kept[1]).is_some_and(|begun| begun == identity);
    let log = open_log(&job.file(LOG), resumes)?;
    remove(&kept[0])?;
    io::write_json(&kept[1], &json!(identity))?;

    let further: &[&str] = if resumes { &["--json", "--resume"] } else { &["--json"] };
    let began = Instant::now();
    let answered = child::run(job.words(further), log);
    let seconds = began.elapsed().as_secs_f64();
    match answered {
        Ok(answer) => {
            let figures =
                FIGURES.iter().map(|&key| (key.to_owned(), answer[key].clone())).collect();
            let finished = Finished { identity, seconds, figures };
            io::write_json(&kept[0], &json!(finished))?;
            remove(&kept[1])?;
            Ok(End::new(job, State::Done, finished))
        }
        Err(error @ Error::Interrupted { .. }) => Err(error),
        Err(error) => Ok(End::failed(job, seconds, error.to_string())),
    }
}

/// The record of an earlier run; a damaged file is reported and ignored.
fn read_kept<T: for<'a> Deserialize<'a>>(path: &Path) -> Option<T> {
    if !path.exists() {
        return None;
    }
    let read = io::read_json(path).and_then(|value| {
        serde_json::from_value(value).map_err(|error| Error::format(path, error.to_string()))
    });
    read.map_err(|error| say(&format!("note: {error}; it is taken for missing"))).ok()
}

fn remove(path: &Path) -> Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path)(error)),
        _ => Ok(()),
    }
}

/// Opens a job's log for appending. It is locked for the lifetime of the job's process, which outlives a
/// `batch` that is killed: two processes that write one checkpoint would corrupt it.
fn open_log(path: &Path, resumes: bool) -> Result<File> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(Error::io(folder))?;
    }
    let file = File::options().append(true).create(true).open(path).map_err(Error::io(path))?;
    // Not every file system supports locks, and mandatory locks would exclude the job's own process.
    if cfg!(unix) && matches!(file.try_lock(), Err(fs::TryLockError::WouldBlock)) {
        let what = "is being written: another run is at this job; wait for its end, or stop it";
        return Err(Error::format(path, what));
    }
    if !resumes {
        file.set_len(0).map_err(Error::io(path))?;
    }
    Ok(file)
}

/// Writes the summary table.
fn write_table(path: &Path, ended: &[End]) -> Result<()> {
    let mut table = String::new();
    let heading = ["name", "state", "seconds"].iter().chain(&FIGURES).chain(&["error"]);
    record(&mut table, heading.map(|&name| name.to_owned()));
    for end in ended {
        let figure = |key: &&str| match end.figure(key) {
            Value::Null => String::new(),
            value => value.to_string(),
        };
        let first = [end.name.clone(), end.state().to_owned(), end.seconds.to_string()];
        let last = end.error.clone().unwrap_or_default();
        record(&mut table, first.into_iter().chain(FIGURES.iter().map(figure)).chain([last]));
    }
    io::write_atomically(path, |sink| std::io::Write::write_all(sink, table.as_bytes()))
}

fn text(ended: &[End], json: &Value, table: &Path) -> String {
    let widest = ended.iter().map(|end| end.name.len()).max().unwrap_or(0).max(8);
    let mut text = format!(
        "{:widest$}  {:8}{:>9}{:>8}{:>8}{:>8}{:>12}\n",
        "job", "state", "seconds", "PSNR", "SSIM", "frames", "Gaussians"
    );
    for end in ended {
        let (name, state) = (&end.name, end.state());
        let _ = write!(text, "{name:widest$}  {state:8}{:>9.1}", end.seconds);
        match &end.error {
            Some(error) => {
                let _ = writeln!(text, "  {error} ({})", end.log.display());
            }
            None => {
                let number = |key| end.figure(key).as_f64().unwrap_or(f64::NAN);
                let whole = |key| thousands(end.figure(key).as_u64().unwrap_or(0) as usize);
                let _ = writeln!(
                    text,
                    "{:>8.2}{:>8.4}{:>8}{:>12}",
                    number("psnr_input"),
                    number("ssim_input"),
                    whole("frames"),
                    whole("gaussians")
                );
            }
        }
    }
    let _ = writeln!(
        text,
        "{} done, {} failed, {} skipped; {}",
        json["done"],
        json["failed"],
        json["skipped"],
        table.display()
    );
    text
}
