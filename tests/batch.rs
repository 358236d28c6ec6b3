//! `splat4d batch`: jobs that succeed and fail, repeated runs and runs after a stop, and the same jobs
//! for other engines: Snakemake runs them, a shell runs Slurm's script, and Kubernetes' schemas validate
//! the manifests.

#![cfg(all(feature = "cli", unix))]

#[path = "support/program.rs"]
mod program;
#[path = "support/python.rs"]
mod python;
mod support;

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use program::{content, fails, json, program, run, stderr};
use python::python;
use serde_json::Value;
use support::says;
use tempfile::TempDir;

/// A small synthetic clip `clip` with its ground truth, which keeps jobs short.
static CLIP: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth rigid -o clip --frames 6 --size 64x36 --seed 1");
    folder
});

const DEFAULTS: &str = "[defaults]\ndevice = \"software\"\nsteps = 20\nmax-gaussians = 300\n\
    control-points = 8\nflow = \"clip/truth\"\nposes = \"clip/truth/poses.txt\"\n\
    masks = \"clip/truth/masks\"\ndepth = \"clip/truth/depth\"\npinhole = true\n";
/// A folder name with special characters of shells, Snakemake and Kubernetes.
const ODD: &str = "it's a \"$(HOME)\" {b}";

fn job(name: &str, input: &str, more: &str) -> String {
    format!("[[job]]\nname = {name:?}\ninput = {input:?}\n{more}\n")
}

/// Two valid jobs, and between them one with a damaged frame, which is only detected when the job runs.
fn three_jobs() -> String {
    ending_with(ODD)
}

fn ending_with(clip: &str) -> String {
    let last = job("Two_b", &format!("{clip}/frames"), "steps = 25\npinhole = false");
    [DEFAULTS.to_owned(), job("one", "clip/frames", ""), job("bad", "bad", ""), last].concat()
}

/// A folder with the clip, a damaged copy of it, and a list `list.toml`.
fn folder(list: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    symlink(CLIP.path().join("clip"), at("clip")).unwrap();
    symlink(CLIP.path().join("clip"), at(ODD)).unwrap();
    fs::create_dir(at("bad")).unwrap();
    for i in 0..6 {
        mend(folder.path(), i, i);
    }
    let frame = at("bad/0003.png");
    let whole = fs::read(&frame).unwrap();
    fs::write(frame, &whole[..whole.len() / 2]).unwrap();
    fs::write(at("list.toml"), list).unwrap();
    folder
}

/// Replaces a frame of the damaged copy with one of the clip.
fn mend(folder: &Path, frame: usize, by: usize) {
    let of = |clip: &str, i: usize| folder.join(format!("{clip}/{i:04}.png"));
    fs::copy(of("clip/frames", by), of("bad", frame)).unwrap();
}

/// Runs a batch with `--json`; returns the exit code, the result and stderr.
fn batch(folder: &Path) -> (i32, Value, String) {
    let output = run(folder, "batch list.toml -o out --json");
    let said = stderr(&output);
    let answer = serde_json::from_slice(&output.stdout).expect("one JSON value");
    (output.status.code().expect(&said), answer, said)
}

fn states(answer: &Value) -> Vec<String> {
    let text = |row: &Value, key: &str| row[key].as_str().unwrap().to_owned();
    let jobs = answer["jobs"].as_array().unwrap();
    jobs.iter().map(|job| format!("{} {}", text(job, "name"), text(job, "state"))).collect()
}

#[test]
fn a_failed_job_is_told_and_the_others_go_on() {
    let folder = folder(&three_jobs());
    let at = |name: &str| folder.path().join(name);
    let (code, answer, said) = batch(folder.path());
    assert_eq!(code, 1, "{said}");
    assert_eq!(states(&answer), ["one done", "bad failed", "Two_b done"], "{answer}");
    says(&said, &["one (1 of 3)", "bad: failed: ", "0003.png", "Two_b: done in"]);
    let counts = ["done", "failed", "skipped"].map(|key| answer[key].as_u64().unwrap());
    assert_eq!(counts, [2, 1, 0]);
    let [one, bad, two] = [0, 1, 2].map(|i| &answer["jobs"][i]);
    says(bad["error"].as_str().unwrap(), &["0003.png"]);
    assert_eq!((&bad["psnr_input"], &one["error"]), (&Value::Null, &Value::Null));
    assert!(one["psnr_input"].as_f64() > Some(5.0) && two["frames"] == 6, "{answer}");
    let help = run(folder.path(), "batch --help").stdout;
    let help = String::from_utf8(help).unwrap();
    let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    for key in [keys(&answer), keys(one)].concat() {
        assert!(help.contains(&key), "batch --help does not name `{key}`");
    }

    // Each scene is the result of its own job, and each log reports its job.
    let found = json(folder.path(), "info out/Two_b.safetensors");
    assert_eq!(found["report"]["psnr_input"], two["psnr_input"]);
    says(&fs::read_to_string(at("out/one.log")).unwrap(), &["6 frames of 64×36"]);
    says(&fs::read_to_string(at("out/bad.log")).unwrap(), &["error: ", "0003.png"]);
    assert!(at("out/one.report/report.json").is_file() && !at("out/bad.done.json").exists());
    let table = fs::read_to_string(at("out/batch.csv")).unwrap();
    let rows: Vec<&str> = table.lines().collect();
    assert!(rows[0].starts_with("name,state,seconds,psnr_input,") && rows.len() == 4, "{table}");
    assert!(rows[1].starts_with("one,done,") && rows[2].starts_with("bad,failed,"), "{table}");
    says(rows[2], &["0003.png"]);

    // Finished jobs are skipped; jobs with a changed option or a repaired input run again.
    mend(folder.path(), 3, 3);
    fs::write(at("list.toml"), three_jobs().replace("steps = 25", "steps = 30")).unwrap();
    let (code, answer, said) = batch(folder.path());
    assert_eq!((code, &answer["failed"]), (0, &0.into()), "{said}");
    assert_eq!(states(&answer), ["one skipped", "bad done", "Two_b done"], "{answer}");
    says(&said, &["one: skipped", "Two_b: anew: steps was 25 and is 30"]);
    assert_eq!(&answer["jobs"][0]["psnr_input"], &one["psnr_input"], "as it was when it ran");

    // File content counts too, and a job whose scene is missing is not done.
    mend(folder.path(), 3, 4);
    let (code, answer, said) = batch(folder.path());
    assert_eq!(code, 0, "{said}");
    assert_eq!(states(&answer), ["one skipped", "bad done", "Two_b skipped"], "{answer}");
    says(&said, &["bad: anew: the checksum"]);
    fs::remove_file(at("out/bad.safetensors")).unwrap();
    fs::write(at("out/Two_b.done.json"), "{").unwrap();
    mend(folder.path(), 3, 3);
    fs::remove_file(at("bad/0003.png")).unwrap();
    fs::write(at("list.toml"), ending_with("nowhere")).unwrap();
    let output = run(folder.path(), "batch list.toml -o out");
    assert_eq!(output.status.code(), Some(1));
    says(&stderr(&output), &["Two_b.done.json", "taken for missing", "one: skipped"]);
    let text = String::from_utf8(output.stdout).unwrap();
    says(&text, &["one    ", "nowhere/frames: ", "(out/Two_b.log)", "0 done, 2 failed, 1 skipped"]);
}

/// Starts a batch, and waits until its job has written a checkpoint of the training.
fn begun(folder: &Path) -> Child {
    let kept = folder.join("out/one.safetensors.checkpoint/training");
    let written = || fs::metadata(&kept).and_then(|found| found.modified()).ok();
    let before = written();
    let mut child = program()
        .current_dir(folder)
        .args(["batch", "list.toml", "-o", "out"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let begun = Instant::now();
    while written() == before || written().is_none() {
        assert!(child.try_wait().unwrap().is_none(), "it ended without a checkpoint");
        assert!(begun.elapsed() < Duration::from_secs(120), "there is no checkpoint");
        std::thread::sleep(Duration::from_millis(5));
    }
    child
}

fn signal(signal: &str, process: &str) {
    assert!(Command::new("kill").args([signal, process]).status().unwrap().success());
}

#[test]
fn what_was_stopped_goes_on() {
    let list = |steps: u32| {
        let often = format!("steps = {steps}\ncheckpoint-every = 1e-9");
        DEFAULTS.replace("steps = 20\n", "") + &job("one", "clip/frames", &often)
    };
    let folder = folder(&list(90));
    let at = |name: &str| folder.path().join(name);
    let log = || fs::read_to_string(at("out/one.log")).unwrap();

    // SIGINT to the batch alone: it stops its job, which leaves its checkpoint.
    let child = begun(folder.path());
    signal("-INT", &child.id().to_string());
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(130), "{said}");
    says(&said, &["stopping", "the same command goes on with one", "error: interrupted"]);
    says(&log(), &["interrupted; the run can be resumed", "give --resume"]);
    assert!(!at("out/one.done.json").exists() && at("out/batch.csv").is_file());

    // With other options the checkpoint cannot be used, but it is not an error.
    fs::write(at("list.toml"), list(80)).unwrap();
    let mut child = begun(folder.path());
    says(&log(), &["is left of an earlier run and will be replaced"]);
    // A killed batch leaves its job running; another batch must not start that job meanwhile.
    let batch_id = child.id().to_string();
    let children = format!("/proc/{batch_id}/task/{batch_id}/children");
    let orphan = fs::read_to_string(children).unwrap().trim().to_owned();
    signal("-STOP", &orphan);
    signal("-KILL", &batch_id);
    child.wait().unwrap();
    let (code, answer, said) = batch(folder.path());
    assert_eq!((code, states(&answer)), (1, vec!["one failed".to_owned()]), "{said}");
    says(answer["jobs"][0]["error"].as_str().unwrap(), &["one.log", "another run is at this job"]);
    signal("-KILL", &orphan);
    // The job's threads may take a moment to end; they hold the lock until then.
    fs::File::open(at("out/one.log")).unwrap().lock().unwrap();

    let (code, answer, said) = batch(folder.path());
    assert_eq!((code, states(&answer)), (0, vec!["one done".to_owned()]), "{said}");
    assert!(!log().contains("beginning anew"), "{}", log());
    let left: Vec<_> = fs::read_dir(at("out")).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 5, "done, log, report, scene and table: {left:?}");
    let resumed = fs::read(at("out/one.safetensors")).unwrap();
    let whole = list(80).replace("1e-9", "0");
    fs::write(at("list.toml"), whole).unwrap();
    json(folder.path(), "batch list.toml -o whole");
    assert!(
        fs::read(at("whole/one.safetensors")).unwrap() == resumed,
        "as if it had not been stopped"
    );
}

#[test]
fn what_is_wrong_with_a_list_is_told_before_the_first_job() {
    let folder = folder("");
    let one = |more: &str| job("one", "clip/frames", more);
    let named = |name: &str| job(name, "clip/frames", "");
    for (list, parts) in [
        (String::new(), &["lists no job", "[[job]]"][..]),
        ("[defaults\n".into(), &["line 1"]),
        ("\n[default]\nsteps = 3\n".into(), &["line 2", "unknown field `default`", "`defaults`"]),
        (named("one") + "steps = ", &["line 5"]),
        (one("stepz = 3"), &["job `one`", "--stepz", "--steps"]),
        (one("max_gaussians = 300"), &["job `one`", "--max_gaussians", "--max-gaussians"]),
        (one("steps = 0"), &["job `one`", "--steps", "from 1 to"]),
        (one("steps = \"many\""), &["job `one`", "many", "--steps"]),
        (one("focal = 9\nintrinsics = \"a\""), &["job `one`", "--focal", "--intrinsics"]),
        (one("flow = \"a\"\nevery = 2"), &["job `one`", "--flow", "--every"]),
        (one("depth = \"\""), &["job `one`", "--depth"]),
        (one("pinhole = \"yes\""), &["job `one`", "pinhole", "true or false"]),
        (one("steps = { a = 1 }"), &["job `one`", "steps", "a number"]),
        (one("depth = \"a\\nb\""), &["job `one`", "depth", "control characters"]),
        (one("resume = true"), &["job `one`", "resume", "set by batch"]),
        (one("help = true"), &["job `one`", "help", "set by batch"]),
        (one("") + "[defaults]\noutput = \"x\"", &["job `one`", "output", "set by batch"]),
        (one("") + &named("two") + &named("One"), &["jobs 1 and 3", "`One`"]),
        (named("a/b"), &["job 1", "a/b", "digits"]),
        (named(".."), &["job 1", "..", "first place"]),
        (named(&"n".repeat(101)), &["job 1", "up to 100"]),
        (one("") + "[[job]]\nname = 5\ninput = \"clip\"", &["job 2", "5 cannot be a name"]),
        (one("") + "[[job]]\ninput = \"clip\"", &["job 2", "no `name`"]),
        ("[[job]]\nname = \"one\"".into(), &["job `one`", "no `input`"]),
        (job("one", "", ""), &["job `one`", "VIDEO"]),
        (one("") + "input = [[\"a\"]]", &["line 5", "duplicate"]),
    ] {
        fs::write(folder.path().join("list.toml"), &list).unwrap();
        let said = fails(folder.path(), 1, "batch list.toml -o out");
        says(&said, &[&["error: list.toml: "], parts].concat());
        assert_eq!(said.lines().count(), 1, "{said}");
    }
    says(&fails(folder.path(), 1, "batch none.toml -o out"), &["none.toml"]);
    says(&fails(folder.path(), 2, "batch list.toml -o out --cpus 3"), &["--emit"]);
    says(&fails(folder.path(), 2, "batch list.toml -o out --emit k8s"), &["--mount"]);
}

#[test]
fn no_output_lies_on_what_any_job_reads() {
    let folder = folder("");
    let at = |name: &str| folder.path().join(name);
    fs::create_dir_all(at("out/two.report")).unwrap();
    fs::write(at("out/two.report/poses.txt"), "").unwrap();
    let two = job("two", "clip/frames", "");
    let list = job("one", "clip/frames", "poses = \"out/two.report/poses.txt\"") + &two;
    fs::write(at("list.toml"), list).unwrap();
    let said = fails(folder.path(), 1, "batch list.toml -o out");
    says(&said, &["job `two`", "out/two.report/poses.txt", "read by this command"]);
    for (name, options) in [
        ("batch.csv", ""),
        ("two.log", ""),
        ("two.done.json", ""),
        ("Snakefile", "--emit snakemake"),
    ] {
        fs::write(at("out").join(name), job("two", "../clip/frames", "")).unwrap();
        let said = fails(folder.path(), 1, &format!("batch out/{name} -o out {options}"));
        says(&said, &[name, "read by this command"]);
    }
    says(&fails(folder.path(), 1, "batch list.toml -o clip/frames/0001.png"), &["name a folder"]);
}

/// Writes a program `splat4d` into a separate folder, and returns a PATH that begins with that folder.
fn path_with(folder: &Path, script: &str) -> String {
    let bin = folder.join("bin");
    fs::create_dir_all(&bin).unwrap();
    let file = bin.join("splat4d");
    fs::write(&file, format!("#!/bin/sh\n{script}\n")).unwrap();
    fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
    format!("{}:{}", bin.display(), std::env::var("PATH").unwrap())
}

const PROGRAM: &str = env!("CARGO_BIN_EXE_splat4d");

/// `python -m snakemake` on two cores.
fn snakemake(folder: &Path, path: &str) -> Output {
    let python = python("engines", "import snakemake");
    let mut command = Command::new(python);
    command.args([
        "-m",
        "snakemake",
        "--snakefile",
        "out/Snakefile",
        "--cores",
        "2",
        "--keep-going",
    ]);
    command.current_dir(folder).env("PATH", path).env("HOME", folder).env_remove("XDG_CACHE_HOME");
    command.stdin(Stdio::null()).output().unwrap()
}

#[test]
fn snakemake_runs_two_jobs_at_once_and_one_that_fails() {
    let folder = folder(&three_jobs());
    let at = |name: &str| folder.path().join(name);
    let said = fails(folder.path(), 1, "batch list.toml -o {b}/out --emit snakemake");
    says(&said, &["{b}/out", "braces"]);
    let emitted = json(folder.path(), "batch list.toml -o out --emit snakemake");
    assert_eq!((&emitted["jobs"], &emitted["emit"]), (&3.into(), &"snakemake".into()));
    let times = at("times");
    let script = format!(
        "echo begin >>{0}\n{PROGRAM} \"$@\"\ncode=$?\necho end >>{0}\nexit $code",
        times.display()
    );
    let path = path_with(folder.path(), &script);
    let output = snakemake(folder.path(), &path);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let done = |name: &str| {
        at(&format!("out/{name}.safetensors")).is_file()
            && at(&format!("out/{name}.report/report.json")).is_file()
    };
    assert_eq!(["one", "bad", "Two_b"].map(done), [true, false, true], "{said}");
    says(&fs::read_to_string(at("out/bad.log")).unwrap(), &["error: ", "0003.png"]);
    let lines =
        || fs::read_to_string(&times).unwrap().lines().map(str::to_owned).collect::<Vec<_>>();
    let mut running = 0;
    let most = lines().into_iter().map(|line| {
        running += if line == "begin" { 1 } else { -1 };
        running
    });
    assert_eq!(most.max(), Some(2), "at once");
    assert_eq!(lines().len(), 6);

    // Only unfinished jobs run again.
    mend(folder.path(), 3, 3);
    let output = snakemake(folder.path(), &path);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(done("bad") && lines().len() == 8, "{:?}", lines());
}

#[test]
fn the_slurm_script_runs_each_job() {
    let folder = folder(&three_jobs());
    let at = |name: &str| folder.path().join(name);
    let out = at("o'u t");
    fs::create_dir(&out).unwrap();
    let output = program()
        .current_dir(folder.path())
        .args(["batch", "list.toml", "-o", "o'u t", "--emit", "slurm"])
        .args(["--cpus", "8", "--memory", "32", "--gpus", "1"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let script = out.join("jobs.sbatch");
    let text = fs::read_to_string(&script).unwrap();
    for option in ["array=1-3", "cpus-per-task=8", "mem=32G", "gres=gpu:1", "signal=B:TERM@60"] {
        assert!(text.lines().any(|line| line == format!("#SBATCH --{option}")), "{option}: {text}");
    }
    assert!(Command::new("bash").arg("-n").arg(&script).status().unwrap().success());
    let task = |number: &str, path: &str| {
        let mut command = Command::new("bash");
        command.arg(&script).current_dir("/").env("PATH", path).env("SLURM_ARRAY_TASK_ID", number);
        command.stdin(Stdio::null()).output().unwrap()
    };
    // Each argument arrives unchanged, including shell metacharacters.
    let told = path_with(folder.path(), "printf '%s\\n' \"$@\"");
    assert!(task("3", &told).status.success());
    let words = fs::read_to_string(out.join("Two_b.log")).unwrap();
    let words: Vec<&str> = words.lines().collect();
    assert_eq!(
        (words[0], words.last()),
        ("reconstruct", Some(&at(ODD).join("frames").to_str().unwrap()))
    );
    assert!(words.contains(&"--steps=25") && words.contains(&"--resume"), "{words:?}");
    assert!(!words.contains(&"--pinhole"), "switched off again: {words:?}");
    assert!(words.contains(&format!("--output={}/Two_b.safetensors", out.display()).as_str()));

    let path = path_with(folder.path(), &format!("exec {PROGRAM} \"$@\""));
    let output = task("3", &path);
    assert!(output.status.success(), "{}", fs::read_to_string(out.join("Two_b.log")).unwrap());
    assert!(out.join("Two_b.safetensors").is_file());
    assert_eq!(task("2", &path).status.code(), Some(1));
    says(&fs::read_to_string(out.join("bad.log")).unwrap(), &["0003.png"]);
    let none = task("4", &path);
    assert_eq!(none.status.code(), Some(2));
    says(&stderr(&none), &["no job 4"]);
}

/// Reads the manifests as YAML, validates each against the strict schema of a batch/v1 Job, and prints
/// them as JSON.
const BY_KUBERNETES: &str = "
import json, sys, yaml, kubernetes_validate
documents = list(yaml.safe_load_all(open(sys.argv[1])))
for document in documents:
    kubernetes_validate.validate(document, '1.32', strict=True)
print(json.dumps(documents))
";

#[test]
fn kubernetes_takes_the_manifests() {
    let list = three_jobs() + &job("two-B", "clip/frames", "");
    let folder = folder(&list);
    let judged = |arguments: &str| -> Vec<Value> {
        let emitted =
            json(folder.path(), &format!("batch list.toml -o out --emit k8s {arguments}"));
        let file = emitted["files"][0].as_str().unwrap();
        let python = python("engines", "import kubernetes_validate");
        let output = Command::new(python).args(["-c", BY_KUBERNETES, file]).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let jobs = judged("--mount . --cpus 4 --memory 16 --gpus 2 --image registry:5000/splat4d:1");
    let names: Vec<&str> =
        jobs.iter().map(|job| job["metadata"]["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["splat4d-one", "splat4d-bad", "splat4d-two-b", "splat4d-two-b-2"]);
    assert_eq!(jobs[2]["metadata"]["annotations"]["splat4d/job"], "Two_b");
    let pod = &jobs[2]["spec"]["template"]["spec"];
    let container = &pod["containers"][0];
    assert_eq!(
        (&container["image"], &container["command"][0]),
        (&"registry:5000/splat4d:1".into(), &"splat4d".into())
    );
    let resources = &container["resources"];
    assert_eq!(
        (&resources["requests"]["cpu"], &resources["limits"]["nvidia.com/gpu"]),
        (&"4".into(), &"2".into())
    );
    assert_eq!(
        (&resources["requests"]["memory"], &resources["limits"]["memory"]),
        (&"16Gi".into(), &"16Gi".into())
    );
    let arguments = container["args"].as_array().unwrap();
    assert_eq!(arguments[0], "reconstruct");
    // Kubernetes turns $$( into $(; an unescaped $( would be a variable reference.
    let clip = arguments.last().unwrap().as_str().unwrap();
    says(clip, &["/it's a \"$$(HOME)\" {b}/frames"]);
    let volume = &pod["volumes"][0];
    assert_eq!(volume["hostPath"]["path"], container["volumeMounts"][0]["mountPath"]);
    says(clip, &[volume["hostPath"]["path"].as_str().unwrap()]);

    let jobs = judged("--mount . --claim clips");
    let pod = &jobs[0]["spec"]["template"]["spec"];
    assert_eq!(pod["volumes"][0]["persistentVolumeClaim"]["claimName"], "clips");
    assert_eq!(pod["containers"][0]["image"], "splat4d");
    assert_eq!(pod["restartPolicy"], "Never");

    let emit = "batch list.toml -o out --emit";
    let before = content(folder.path());
    says(
        &fails(folder.path(), 1, &format!("{emit} k8s --mount clip")),
        &["does not lie in --mount"],
    );
    says(&fails(folder.path(), 1, &format!("{emit} slurm --mount .")), &["--emit k8s"]);
    says(&fails(folder.path(), 2, &format!("{emit} k8s --mount . --claim A_b")), &["--claim"]);
    assert_eq!(content(folder.path()), before);
}
