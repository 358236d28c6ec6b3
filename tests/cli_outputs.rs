//! Outputs of the command line: inputs are never overwritten, every output path is tested before the
//! work, names need not be Unicode, and with `--json` there is always exactly one object.

#![cfg(all(feature = "cli", unix))]

#[path = "support/program.rs"]
mod program;
mod support;

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;

use program::{blobs, cameras, content, copy, dataset, fails, json, program, run, stderr};
use serde_json::Value;
use splat4d::data::transforms;
use splat4d::scene::{Scene, ply};
use support::says;
use tempfile::TempDir;

const TRAIN: &str = "--steps 2 --random-points 50 --sh-degree 0 --static --device software";

/// As `fails`, and checks that every file has kept its content.
#[track_caller]
fn spares(folder: &Path, arguments: &str) -> String {
    let held = |path: &PathBuf| fs::read(path).ok();
    let before: Vec<_> = content(folder).iter().map(held).collect();
    let said = fails(folder, 1, arguments);
    let after: Vec<_> = content(folder).iter().map(held).collect();
    assert!(before == after, "{arguments} changes a file");
    said
}

/// A synthetic clip `clip` of a few frames.
static CLIP: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth still -o clip --frames 6 --size 112x63");
    folder
});

#[test]
fn a_dataset_is_not_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("set"), 3);
    symlink("set", at("soft")).unwrap();
    symlink("set/1.png", at("soft.png")).unwrap();
    fs::hard_link(at("set/1.png"), at("hard.png")).unwrap();
    fs::write(at("fast.json"), "{}").unwrap();
    for output in ["set/transforms.json", "set/1.png", "soft/1.png", "soft.png", "hard.png"] {
        for command in ["train set", "train set/transforms.json"] {
            let said = spares(folder.path(), &format!("{command} -o {output}"));
            says(&said, &[output, "this command", "Name another"]);
        }
    }
    let said = spares(folder.path(), "train set -o fast.json --settings fast.json");
    says(&said, &["fast.json", "read by this command"]);
    // The same holds for a report.
    fs::rename(at("set/2.png"), at("set/sheet.png")).unwrap();
    let names = ["0.png", "1.png", "sheet.png"].map(String::from);
    transforms::write(at("set/transforms.json"), &cameras(3), &names, None).unwrap();
    says(&spares(folder.path(), "train set -o x --report set"), &["sheet.png", "another"]);
    // A new file in the folder is allowed, and so is repeating the same command.
    for _ in 0..2 {
        let output = run(folder.path(), &format!("train set -o set/scene {TRAIN}"));
        assert!(output.status.success(), "{}", stderr(&output));
    }
}

#[test]
fn a_clip_is_not_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    copy(&CLIP.path().join("clip"), &at("clip"));
    fs::write(at("in.mp4"), "a video").unwrap();
    symlink("in.mp4", at("link.mp4")).unwrap();
    says(&spares(folder.path(), "reconstruct in.mp4 -o in.mp4"), &["in.mp4", "would be lost"]);
    says(&spares(folder.path(), "reconstruct link.mp4 -o in.mp4"), &["link.mp4", "would be lost"]);
    let truth = "reconstruct clip --poses clip/truth/poses.txt --masks clip/truth/masks --depth \
                 clip/truth/depth --flow clip/truth --intrinsics clip/truth/intrinsics.json";
    for output in [
        "frames/0002.png",
        "frames/new.png",
        "truth/poses.txt",
        "truth/intrinsics.json",
        "truth/masks/0001.png",
        "truth/depth/0001.exr",
        "truth/flow_forward/0001.flo",
    ] {
        says(&spares(folder.path(), &format!("{truth} -o clip/{output}")), &[output, "another"]);
    }
    let said = spares(folder.path(), &format!("{truth} -o x --report clip/truth"));
    says(&said, &["clip/truth/poses.txt", "another"]);
    // The sheet would be read as a frame by the next run.
    says(&spares(folder.path(), "reconstruct clip -o x --report clip"), &["sheet.png", "another"]);
}

#[test]
fn a_scene_is_not_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    ply::write(at("a.ply"), &blobs()).unwrap();
    fs::create_dir(at("views")).unwrap();
    fs::hard_link(at("a.ply"), at("views/0001.png")).unwrap();
    fs::hard_link(at("a.ply"), at("b.mp4")).unwrap();
    let render = "render a.ply --frames 2 --size 16x16";
    says(&spares(folder.path(), &format!("{render} -o views")), &["0001.png", "a.ply"]);
    says(&spares(folder.path(), &format!("{render} -o b.mp4")), &["b.mp4", "a.ply"]);
    let budget = "bench --quick --scene a.ply --error-budget 0.1 --settings a.ply";
    says(&spares(folder.path(), budget), &["a.ply", "read by this command"]);
}

#[test]
fn outputs_do_not_lie_on_each_other() {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("set"), 3);
    for (output, report) in [("r/report.json", "r"), ("x", "x"), ("r/sheet.png/x", "r")] {
        let said = spares(folder.path(), &format!("train set -o {output} --report {report}"));
        says(&said, &["cannot both"]);
    }
}

#[test]
fn a_link_stays_and_its_file_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("set"), 3);
    ply::write(at("a.ply"), &blobs()).unwrap();
    for inner in ["scenes", "videos", "empty"] {
        fs::create_dir(at(inner)).unwrap();
    }
    symlink("scenes/new", at("scene")).unwrap();
    symlink("videos/new.mp4", at("video.mp4")).unwrap();
    symlink("empty", at("clip")).unwrap();
    for command in [
        format!("train set -o scene {TRAIN}"),
        "render a.ply -o video.mp4 --frames 2 --size 16x16 --device software".into(),
        "synth still -o clip --frames 2 --size 16x16".into(),
    ] {
        let output = run(folder.path(), &command);
        assert!(output.status.success(), "{command}: {}", stderr(&output));
    }
    for name in ["scene", "video.mp4", "clip"] {
        assert!(at(name).is_symlink(), "{name} is still a link");
    }
    assert_eq!(Scene::open(at("scenes/new"), false).unwrap().scene.gaussians.len(), 50);
    assert!(fs::metadata(at("videos/new.mp4")).unwrap().len() > 100);
    assert!(at("empty/frames/0001.png").is_file() && at("empty/truth/poses.txt").is_file());
    assert_eq!(content(&at("scenes")).len() + content(&at("videos")).len(), 2, "nothing is left");
}

/// Every output path is tested under its name before anything is read.
#[test]
fn places_are_tried_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("file"), "x").unwrap();
    symlink("nowhere", at("dangling")).unwrap();
    symlink("circle", at("circle")).unwrap();
    let long = "n".repeat(300);
    for (output, part) in [
        ("new/", "name the file"),
        ("new/.", "name the file"),
        ("..", "name the file"),
        (&long, "too long"),
        (&format!("new/{long}/x"), "too long"),
        ("file/x", "file"),
        ("dangling/x", "link to nothing"),
        ("circle", "circle"),
    ] {
        for command in ["train missing", "reconstruct missing"] {
            says(&fails(folder.path(), 1, &format!("{command} -o {output}")), &[part]);
        }
        let bench = format!("bench --scene missing --error-budget 1 --settings {output}");
        says(&fails(folder.path(), 1, &bench), &[part]);
    }
    for (output, part) in
        [(&long[..], "too long"), ("file", "name a folder"), ("dangling", "link to nothing")]
    {
        for command in
            ["render missing -o", "synth still -o", "train missing -o x --report", "bench --report"]
        {
            says(&fails(folder.path(), 1, &format!("{command} {output}")), &[part]);
        }
    }
    says(&fails(folder.path(), 1, "render missing -o new.mp4/"), &["name the file"]);
    ply::write(at("a.ply"), &blobs()).unwrap();
    fs::create_dir_all(at("views/0002.png")).unwrap();
    fs::create_dir_all(at("report/sheet.png")).unwrap();
    let said = fails(folder.path(), 1, "render a.ply -o views --frames 3 --size 16x16");
    says(&said, &["0002.png", "is a folder"]);
    let said = fails(folder.path(), 1, "train missing -o x --report report");
    says(&said, &["sheet.png", "is a folder"]);
    // This fails before the images are made, so it is reported first.
    let said = fails(folder.path(), 1, "synth still -o . --frames 2 --size 16x16");
    says(&said, &["not empty"]);
    assert!(!said.contains("rendering"), "{said}");
}

#[test]
fn folders_that_take_no_files() {
    let folder = tempfile::tempdir().unwrap();
    let closed = folder.path().join("closed");
    fs::create_dir(&closed).unwrap();
    fs::set_permissions(&closed, std::os::unix::fs::PermissionsExt::from_mode(0o555)).unwrap();
    if fs::write(closed.join("x"), "").is_ok() {
        return eprintln!(
            "SKIPPED (permissions do not bind this user): folders_that_take_no_files"
        );
    }
    for command in ["train missing -o closed/x", "render missing -o closed/new"] {
        says(&fails(folder.path(), 1, command), &["cannot write into", "closed"]);
    }
}

#[test]
fn a_checkpoints_place_is_tried_too() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("set"), 3);
    fs::write(at("x.checkpoint"), "mine").unwrap();
    let train = format!("train set -o x {TRAIN}");
    says(&spares(folder.path(), &train), &["x.checkpoint", "no folder", "--checkpoint-every 0"]);
    says(&spares(folder.path(), "reconstruct set -o x"), &["x.checkpoint", "no folder"]);
    let output = run(folder.path(), &format!("{train} --checkpoint-every 0"));
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(at("x").is_file());
    assert_eq!(fs::read(at("x.checkpoint")).unwrap(), b"mine");
}

/// A % in a folder's name is not part of the pattern by which ffmpeg finds the images.
#[test]
fn a_video_in_a_folder_with_a_percent_sign() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("a.ply"), &blobs()).unwrap();
    json(folder.path(), "render a.ply -o 50%d/x%02d.mp4 --frames 3 --size 16x16");
    assert!(fs::metadata(folder.path().join("50%d/x%02d.mp4")).unwrap().len() > 100);
    assert_eq!(content(&folder.path().join("50%d")).len(), 1);
}

/// Runs a command with `--json`, with `NAME` replaced by a name that is not UTF-8; returns the result.
#[track_caller]
fn json_of_name(folder: &Path, command: &str) -> Value {
    let name = |word: &str| -> OsString {
        let parts: Vec<&[u8]> = word.split("NAME").map(str::as_bytes).collect();
        OsString::from_vec(parts.join(&b"\xff\xfe \xe9"[..]))
    };
    let arguments: Vec<OsString> = command.split_whitespace().map(name).collect();
    let output = program().current_dir(folder).args(&arguments).arg("--json").output().unwrap();
    assert!(output.status.success(), "{command}: {}", stderr(&output));
    serde_json::from_slice(&output.stdout).expect("one JSON value on stdout")
}

/// Every command reads and writes files, and folders of files, whose names are not UTF-8.
#[test]
fn names_need_not_be_unicode() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &[u8]| folder.path().join(OsStr::from_bytes(name));
    const NAME: &[u8] = b"\xff\xfe \xe9";
    let of = |parts: &[&[u8]]| at(&parts.concat());
    let run = |command: &str| json_of_name(folder.path(), &format!("{command} --device software"));
    let shown = |found: &Value, end: &str| {
        let output = found["output"].as_str().unwrap();
        assert!(output.contains('\u{fffd}') && output.ends_with(end), "{output}");
    };

    let found = run("synth still -o clipNAME --frames 6 --size 112x63");
    shown(&found, "");
    assert!(of(&[b"clip", NAME, b"/frames/0005.png"]).is_file());
    dataset(&of(&[b"set", NAME]), 3);
    let found = run("train setNAME -o newNAME/sceneNAME.st --report reportNAME --steps 2 \
                     --random-points 50 --checkpoint-every 1e-9");
    shown(&found, ".st");
    assert!(of(&[b"report", NAME, b"/sheet.png"]).is_file());
    assert!(of(&[b"new", NAME, b"/scene", NAME, b".st"]).is_file());
    // Frames whose names are not UTF-8 either; two of the names look the same as text.
    let frames = of(&[b"frames", NAME]);
    copy(&of(&[b"clip", NAME, b"/frames"]), &frames);
    for (from, to) in [("0000.png", &b"a\xfe.png"[..]), ("0001.png", b"a\xff.png")] {
        fs::rename(frames.join(from), frames.join(OsStr::from_bytes(to))).unwrap();
    }
    let truth = "--poses clipNAME/truth/poses.txt --masks clipNAME/truth/masks --depth \
                 clipNAME/truth/depth --flow clipNAME/truth \
                 --intrinsics clipNAME/truth/intrinsics.json";
    let found = run(&format!(
        "reconstruct framesNAME -o fitNAME.st --report fitNAME --steps 4 --max-gaussians 300 {truth}"
    ));
    shown(&found, ".st");
    assert!(of(&[b"fit", NAME, b"/poses.txt"]).is_file());

    ply::write(of(&[b"blobs", NAME, b".ply"]), &blobs()).unwrap();
    let names: Vec<String> = (0..2).map(|i| format!("{i}.png")).collect();
    transforms::write(of(&[b"path", NAME, b".json"]), &cameras(2), &names, None).unwrap();
    fs::write(of(&[b"fast", NAME, b".json"]), "{}").unwrap();
    let render = "render blobsNAME.ply --path pathNAME.json --settings fastNAME.json --size 16x16";
    shown(&run(&format!("{render} -o viewsNAME --what colour,depth --exr")), "");
    assert!(of(&[b"views", NAME, b"/0001_depth.exr"]).is_file());
    shown(&run(&format!("{render} -o videoNAME/xNAME.mp4")), ".mp4");
    let clip = run("reconstruct clipNAME -o xNAME.st --steps 4 --max-gaussians 300 --size 64");
    assert_eq!(clip["frames"], 6);

    run("info blobsNAME.ply");
    run("eval newNAME/sceneNAME.st setNAME");
    run("eval fitNAME.st clipNAME");
    run("eval clipNAME/truth/poses.txt clipNAME/truth/poses.txt");
    run("bench --quick --filter scan --report benchNAME");
    assert!(of(&[b"bench", NAME, b"/index.html"]).is_file());
    run("bench cmp benchNAME/bench.json benchNAME/bench.json");
}

/// The same holds for files of settings and cases.
#[test]
fn names_of_settings_and_cases_need_not_be_unicode() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &[u8]| folder.path().join(OsStr::from_bytes(name));
    let name = b"\xff\xfe \xe9";
    ply::write(at(&[b"a", &name[..]].concat()), &blobs()).unwrap();
    let budget = "bench --quick --scene aNAME --size 32x18 --error-budget 0.5 --settings sNAME \
                  --device software";
    json_of_name(folder.path(), budget);
    assert!(at(&[b"s", &name[..]].concat()).is_file());
    let case = splat4d::check::fuzz::file::text(&splat4d::check::fuzz::draw(1, 2));
    fs::write(at(&[b"case", &name[..]].concat()), case).unwrap();
    let found = json_of_name(folder.path(), "validate --case caseNAME --device software");
    says(found["rows"][0]["file"].as_str().unwrap(), &["case\u{fffd}"]);
}

/// The reader of a pipe gets the scene, and neither side waits for anything else.
#[test]
fn a_pipe_gets_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("set"), 3);
    assert!(Command::new("mkfifo").arg(at("pipe")).status().unwrap().success());
    let path = at("pipe");
    let reader = std::thread::spawn(move || fs::read(path).unwrap());
    let output = run(folder.path(), &format!("train set -o pipe {TRAIN}"));
    assert!(output.status.success(), "{}", stderr(&output));
    fs::write(at("copy"), reader.join().unwrap()).unwrap();
    assert_eq!(Scene::open(at("copy"), false).unwrap().scene.gaussians.len(), 50);
    assert!(!at("pipe").is_file(), "the pipe is still one");
}

/// Starts a training that does not end by itself, and waits until it runs. SIGHUP is ignored only if
/// `start` says so, even if the process that runs the tests ignores it.
fn endless(folder: &Path, start: &str, options: &str) -> (Child, impl Iterator<Item = String>) {
    dataset(&folder.join("set"), 3);
    let program = env!("CARGO_BIN_EXE_splat4d");
    let train = "train set -o x --steps 1000000 --random-points 50 --device software";
    let mut child = Command::new("env")
        .current_dir(folder)
        .args(["--default-signal=HUP", "sh", "-c"])
        .arg(format!("{start} exec {program} {train} {options}"))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
    lines.find(|line| line.contains("to begin with")).unwrap();
    (child, lines)
}

fn signal(child: &Child, signal: &str) {
    let pid = child.id().to_string();
    assert!(Command::new("kill").args([signal, &pid]).status().unwrap().success());
}

/// SIGHUP stops the program as Ctrl-C does, unless the parent process has set it to be ignored.
#[test]
fn a_hangup_stops_unless_it_is_ignored() {
    for (start, ignored) in [("", false), ("trap '' HUP;", true)] {
        let folder = tempfile::tempdir().unwrap();
        let (mut child, mut lines) = endless(folder.path(), start, "--checkpoint-every 1e-9");
        signal(&child, "-HUP");
        if ignored {
            // Training continues: new checkpoints are written, and they are removed when the work ends.
            let checkpoint = folder.path().join("x.checkpoint/training");
            let written = || fs::metadata(&checkpoint).and_then(|found| found.modified()).ok();
            for _ in 0..3 {
                let before = written();
                while written() == before {
                    std::thread::sleep(std::time::Duration::from_millis(10));
                    assert!(child.try_wait().unwrap().is_none(), "it goes on");
                }
            }
            signal(&child, "-TERM");
        }
        assert!(lines.any(|line| line.contains("stopping")));
        let rest: Vec<String> = lines.collect();
        assert_eq!(child.wait().unwrap().code(), Some(130), "{rest:?}");
    }
}

/// With `--json`, each way to end gives exactly one object.
#[test]
fn a_machine_always_gets_one_object() {
    let folder = tempfile::tempdir().unwrap();
    let error = |output: &Output| -> String {
        let value: Value = serde_json::from_slice(&output.stdout).expect("one JSON value");
        value["error"].as_str().unwrap().to_owned()
    };
    for (arguments, parts) in [
        ("--json", &["subcommand"][..]),
        ("--json frobnicate", &["frobnicate"]),
        ("train --json", &["--output", "DATASET"]),
        ("train set -o x --steps many --json", &["many", "--steps"]),
        ("info --json a b", &["'b'"]),
        ("bench --json --profile --scene x", &["--scene", "--profile"]),
    ] {
        let output = run(folder.path(), arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments}");
        says(&error(&output), parts);
        assert!(!error(&output).contains("Usage") && !error(&output).contains('\n'));
        assert!(!output.stderr.is_empty(), "{arguments}: people are told too");
    }
    for arguments in ["train set -o x --steps many", "info -- --json x"] {
        assert!(run(folder.path(), arguments).stdout.is_empty(), "{arguments}");
    }
    for times in [1, 2] {
        let folder = tempfile::tempdir().unwrap();
        let (mut child, mut lines) = endless(folder.path(), "", "--json");
        if times == 2 {
            // The program does not handle the first signal while it is stopped.
            signal(&child, "-STOP");
            signal(&child, "-INT");
            signal(&child, "-TERM");
            signal(&child, "-CONT");
        } else {
            signal(&child, "-INT");
        }
        assert!(lines.any(|line| line.contains("stopping")));
        let rest: Vec<String> = lines.collect();
        let mut stdout = Vec::new();
        child.stdout.take().unwrap().read_to_end(&mut stdout).unwrap();
        let status = child.wait().unwrap();
        assert_eq!(status.code(), Some(130), "{rest:?}");
        let said = error(&Output { status, stdout, stderr: Vec::new() });
        assert!(said.contains("interrupted") || said == "stopped at once", "{said}");
        assert!(!folder.path().join("x").exists());
    }
}

/// A file that exceeds the file size limit is an error like a full disk.
#[test]
fn the_limit_of_a_files_size() {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("set"), 3);
    ply::write(folder.path().join("a.ply"), &blobs()).unwrap();
    let before = content(folder.path());
    let program = env!("CARGO_BIN_EXE_splat4d");
    for command in [
        "train set --steps 1 --random-points 5000 --device software -o x",
        "render a.ply --frames 2 --size 400x400 --device software -o new/a.mp4",
        "synth still --frames 2 --size 160x90 -o clip",
    ] {
        let output = Command::new("sh")
            .current_dir(folder.path())
            .args(["-c", &format!("ulimit -f 16; exec {program} {command}")])
            .output()
            .unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{command}: {said}");
        // The message names the output; the file appears there only when it is complete.
        let output = command.split_whitespace().last().unwrap();
        says(&said, &[&format!("error: {output}"), "large"]);
        let mut after = content(folder.path());
        after.retain(|path| !path.ends_with("new"));
        assert_eq!(after, before, "{command} leaves nothing behind");
    }
}

#[test]
fn a_list_of_drivers_that_is_none() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("list.json"), "{nonsense").unwrap();
    for list in ["list.json", "missing.json", "/dev/null", "\u{1b}[31m"] {
        let output = program()
            .current_dir(folder.path())
            .arg("devices")
            .env("VK_DRIVER_FILES", list)
            .env_remove("VK_ADD_DRIVER_FILES")
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1));
        let said = stderr(&output);
        says(&said, &["driver in VK_DRIVER_FILES=", "mesa-vulkan-drivers"]);
        assert!(!said.contains('\u{1b}') && said.lines().count() == 1, "{said}");
    }
}

/// A missing input is reported before a missing driver.
#[test]
fn missing_inputs_come_before_missing_drivers() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("a.ply"), &blobs()).unwrap();
    let clip = CLIP.path().join("clip");
    symlink(&clip, folder.path().join("clip")).unwrap();
    for command in [
        "train missing -o x",
        "reconstruct missing -o x",
        "render missing -o x",
        "render a.ply -o x --path missing",
        "render a.ply -o x --settings missing",
        "eval missing clip",
        "ablate missing",
        "eval a.ply missing",
        "bench --scene missing --error-budget 1 --settings x",
        "validate --case missing",
    ] {
        let output = program()
            .current_dir(folder.path())
            .args(command.split_whitespace())
            .env("VK_DRIVER_FILES", "/dev/null")
            .env_remove("VK_ADD_DRIVER_FILES")
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1), "{command}");
        says(&stderr(&output), &["error: missing: "]);
    }
}

/// Values that differ from run to run are in the report and the result, not in the scene file.
#[test]
fn equal_runs_leave_equal_files() {
    let clip = CLIP.path().join("clip");
    let clip = clip.display();
    for command in [
        format!("train {clip}/truth --steps 20 --random-points 200 --control-points 8"),
        format!("reconstruct {clip} --steps 20 --max-gaussians 600"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["a", "b"] {
            let found = json(folder.path(), &format!("{command} -o {name} --report report"));
            let report: Value =
                serde_json::from_slice(&fs::read(at("report/report.json")).unwrap())
                    .expect("the report is JSON");
            for key in ["seconds", "peak_bytes", "milliseconds_per_step"] {
                assert!(!found[key].is_null() && found[key] == report[key], "{key}: {found}");
            }
        }
        assert!(fs::read(at("a")).unwrap() == fs::read(at("b")).unwrap(), "{command}");
    }
}
