//! `splat4d table`: runs a published protocol on the scenes of a dataset, and lists published results beside
//! its own.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use serde_json::{Value, json};
use splat4d::report::{ResultTable, SceneRow};
use splat4d::{Error, Result, bench, io};

use super::common::{Answer, Common, path_text, say};
use super::networks::LpipsArgs;
use super::outputs::Outputs;
use super::protocols::{Choices, Protocol, Work, figures};
use super::staged::{Cameras, Staged};
use super::{child, interrupt, parsed, values};

const AFTER_HELP: &str = "\
Each scene is made, measured and rendered by commands of this program, one after the other. What is done is
kept in OUT/SCENE (the answers as NAME.json, what was said as NAME.log, the scene, test images beside their
truth): the same command again goes on where it was stopped, and does anew what other options change. A scene
that fails is counted as failed, and then there is no mean: one over the others would flatter.

OUT/index.html, OUT/table.tex and OUT/table.csv hold the table with published figures, their sources and in
what their protocols differ. Times, frames a second and sizes are of this machine.

Examples:
  splat4d table nvidia nvidia_scenes -o out --size 480
  splat4d table dnerf dnerf -o out --size 400 -- --steps 5000 --max-gaussians 20000
  splat4d table hypernerf-vrig hypernerf -o out --size 960 --fit-poses
  splat4d table dynerf-mono dynerf -o out --size 1352 -- --models models
  splat4d table sintel-pose MPI-Sintel -o out

JSON: version, title, caption [], machine {device, driver, kind, software, subgroup_size, threads}, figures
[{key, title, better (more, less)}], rows [{scene, figures {KEY: value}, failed (why, or null)}], published
[{method, of, figures, source}], mean {KEY: value or null}, failed (scenes); output.
Exit code 1 if a scene failed; the table is written all the same.";

/// Run a published protocol on a dataset and write its table
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct TableArgs {
    /// The protocol
    #[arg(value_enum)]
    protocol: Protocol,
    /// The dataset
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// The output folder
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Only these scenes
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    scenes: Vec<String>,
    /// Downscale images so that their longer side has at most this many pixels
    #[arg(long, value_name = "LONGEST",
          value_parser = values::whole::<u32>(1..=values::MOST_PIXELS))]
    size: Option<u32>,
    /// dynerf-mono: the camera whose video is the training input [default: cam00]
    #[arg(long, value_name = "NAME")]
    train_camera: Option<String>,
    /// dynerf-mono: the cameras whose videos are the test [default: cam05,cam06]
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    test_cameras: Vec<String>,
    /// Also evaluate from test poses that are fitted to the test images
    #[arg(long)]
    fit_poses: bool,
    #[command(flatten)]
    lpips: LpipsArgs,
    /// Further options of the command that reconstructs the scene: reconstruct, train or track
    #[arg(last = true, value_name = "OPTIONS")]
    making: Vec<OsString>,
}

/// Runs the command.
pub fn run(args: &TableArgs, common: &Common) -> Result<(Answer, ExitCode)> {
    let choices = Choices {
        size: args.size,
        fit_poses: args.fit_poses,
        cameras: args.cameras()?,
        lpips: args.lpips.arguments(),
        making: args.making.clone(),
    };
    check_apart(&args.folder, &args.output)?;
    let mut works = args.protocol.works(&args.folder, &args.output, &choices)?;
    choose(&mut works, &args.scenes)?;
    for work in &mut works {
        for step in &mut work.steps {
            step.arguments.extend(common.arguments());
        }
        check(work)?;
    }
    // An invalid model is reported before the first scene.
    let net = args.lpips.open()?.map(|network| network.contract().net.clone());
    Outputs::default().folder(&args.output, &ResultTable::REPORT_FILES)?;
    let device = common.open_device()?;
    let machine = bench::machine(&device);
    drop(device);

    let mut caption = args.protocol.caption(&choices, works.len());
    caption.extend(net.map(|net| format!("LPIPS compares the features of {net}.")));
    let mut table = ResultTable {
        version: env!("CARGO_PKG_VERSION").into(),
        title: args.protocol.title().into(),
        caption,
        machine,
        figures: args.protocol.figures(&choices),
        rows: Vec::new(),
        published: args.protocol.published(),
    };
    for (i, work) in works.iter().enumerate() {
        say(&format!("{} ({} of {})", work.scene, i + 1, works.len()));
        let row = match answers(work) {
            Ok(answers) => {
                let (figures, failed) = (figures(&answers, &work.folder), None);
                SceneRow { scene: work.scene.clone(), figures, failed }
            }
            Err(error @ Error::Interrupted { .. }) => return Err(error),
            Err(error) => {
                say(&format!("note: {} failed: {error}", work.scene));
                let failed = Some(error.to_string());
                SceneRow { scene: work.scene.clone(), figures: BTreeMap::new(), failed }
            }
        };
        table.rows.push(row);
        // Written after every scene, because the rest may take days.
        table.write_report(&args.output)?;
    }
    let mut json = table.json();
    json["output"] = path_text(&args.output);
    Ok((Answer { text: table.text(), json }, ExitCode::from(u8::from(table.failed() > 0))))
}

impl TableArgs {
    /// Training and test cameras where the protocol leaves them open.
    fn cameras(&self) -> Result<Cameras> {
        let TableArgs { protocol, train_camera, test_cameras, .. } = self;
        if *protocol != Protocol::DynerfMono && (train_camera.is_some() || !test_cameras.is_empty())
        {
            let what = "--train-camera and --test-cameras are of dynerf-mono alone; the other protocols say \
                        themselves what is trained on and tested with";
            return Err(Error::Input(what.into()));
        }
        let train = train_camera.clone().unwrap_or_else(|| "cam00".into());
        let test = match &test_cameras[..] {
            [] => ["cam05", "cam06"].map(str::to_owned).into(),
            named => named.iter().cloned().collect(),
        };
        let cameras = Cameras { train, test };
        if cameras.test.contains(&cameras.train) {
            let what = format!("{} is trained on; --test-cameras takes others", cameras.train);
            return Err(Error::Input(what));
        }
        Ok(cameras)
    }
}

/// Checks that outputs and inputs are in separate folders.
fn check_apart(folder: &Path, output: &Path) -> Result<()> {
    let set = std::fs::canonicalize(folder).map_err(Error::io(folder))?;
    // The output may not exist yet; its nearest existing ancestor determines its location.
    let there = output.ancestors().find_map(|path| match path.as_os_str().is_empty() {
        true => std::fs::canonicalize(".").ok(),
        false => std::fs::canonicalize(path).ok(),
    });
    match there {
        Some(there) if there.starts_with(&set) => {
            let what = format!("lies in the data set {}; name a place outside", folder.display());
            Err(Error::format(output, what))
        }
        _ => Ok(()),
    }
}

/// Keeps the scenes with these names; without names, all.
fn choose(works: &mut Vec<Work>, names: &[String]) -> Result<()> {
    let all: Vec<&str> = works.iter().map(|work| work.scene.as_str()).collect();
    if let Some(absent) = names.iter().find(|name| !all.contains(&name.as_str())) {
        let what =
            format!("--scenes {absent}: there is no such scene; there are {}", all.join(", "));
        return Err(Error::Input(what));
    }
    works.retain(|work| names.is_empty() || names.contains(&work.scene));
    Ok(())
}

/// Checks that every step is a valid command of this program before the first one runs.
fn check(work: &Work) -> Result<()> {
    for step in &work.steps {
        parsed(&step.arguments).map_err(|what| {
            Error::Input(format!("options after --, for `{}`: {what}", step.name))
        })?;
    }
    Ok(())
}

/// The answers of a scene's steps, by name: a stored one is used if its command is unchanged and no earlier
/// step was run again, else the step is run.
fn answers(work: &Work) -> Result<BTreeMap<&'static str, Value>> {
    std::fs::create_dir_all(&work.folder).map_err(Error::io(&work.folder))?;
    let mut found = BTreeMap::new();
    let mut anew = match &work.staged {
        Some(source) => Staged::within(&work.folder).lay_out(source)?,
        None => false,
    };
    for step in &work.steps {
        interrupt::check()?;
        let file = work.folder.join(format!("{}.json", step.name));
        let told: Vec<String> =
            step.arguments.iter().map(|word| word.to_string_lossy().into_owned()).collect();
        let kept = if anew { None } else { kept(&file, &told)? };
        let answer = match kept {
            Some(answer) => answer,
            None => {
                anew = true;
                say(&format!("  {}", step.name));
                let log = work.folder.join(format!("{}.log", step.name));
                let said = File::create(&log).map_err(Error::io(&log))?;
                let words = step.arguments.iter().cloned().chain(["--json".into()]);
                let answer = child::run(words, said)?;
                keep(&file, &json!({ "arguments": told, "answer": answer }))?;
                answer
            }
        };
        found.insert(step.name, answer);
    }
    Ok(found)
}

/// The stored answer in a file, if it is for the same command.
fn kept(file: &Path, words: &[String]) -> Result<Option<Value>> {
    if !file.exists() {
        return Ok(None);
    }
    let text = io::read_text(file)?;
    let Ok(mut whole) = serde_json::from_str::<Value>(&text) else { return Ok(None) };
    let same = whole["arguments"] == json!(words);
    Ok(same.then(|| whole["answer"].take()))
}

fn keep(file: &Path, whole: &Value) -> Result<()> {
    io::write_atomically(file, |sink| sink.write_all(whole.to_string().as_bytes()))
}
