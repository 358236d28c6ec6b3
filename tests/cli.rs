//! The command line from the user's side: what commands print and write, and how they fail.

#![cfg(feature = "cli")]

mod common;
#[path = "support/program.rs"]
mod program;
#[path = "support/runtime.rs"]
mod runtime;
mod support;

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::LazyLock;

use glam::DVec3;
use program::{blobs, cameras, content, dataset, fails, json, program, run, stderr};
use serde_json::Value;
use splat4d::data::{Dataset, colmap, exr, images, transforms, write_mask, write_png};
use splat4d::renderer::Renderer;
use splat4d::scene::{Scene, SceneCamera, ply};
use splat4d::types::{Gaussians, Image};
use support::{picture, says};
use tempfile::TempDir;

const COMMANDS: [&str; 18] = [
    "reconstruct",
    "batch",
    "track",
    "train",
    "render",
    "export",
    "eval",
    "ablate",
    "info",
    "devices",
    "doctor",
    "bench",
    "synth",
    "table",
    "validate",
    "completions",
    "man",
    "view",
];

/// As `fails`, within `mebibytes` MiB of address space and one minute: a command that takes memory or
/// time without bound fails here without harming the machine.
#[cfg(target_os = "linux")]
#[track_caller]
fn fails_within(folder: &Path, mebibytes: u64, code: i32, arguments: &str) -> String {
    let before = content(folder);
    let output = within(folder, mebibytes, arguments);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{arguments}: {said}");
    assert!(output.stdout.is_empty(), "{arguments}: nothing on stdout");
    let errors = said.lines().filter(|line| line.starts_with("error: ")).count();
    assert!(errors == 1 && !said.contains("panicked"), "{arguments}: {said}");
    assert_eq!(content(folder), before, "{arguments} leaves nothing behind");
    said
}

/// Runs a command within `mebibytes` MiB of address space and one minute.
#[cfg(target_os = "linux")]
fn within(folder: &Path, mebibytes: u64, arguments: &str) -> Output {
    let kibibytes = (mebibytes << 10).to_string();
    let mut command = Command::new("sh");
    command.stdin(Stdio::null()).current_dir(folder);
    command.args(["-c", "ulimit -v $0 && exec timeout 60 \"$@\"", &kibibytes]);
    command.arg(env!("CARGO_BIN_EXE_splat4d")).args(arguments.split_whitespace());
    command.output().unwrap()
}

/// A folder with a synthetic clip `clip` and a scene `scene.safetensors` trained on it for some steps.
static TRAINED: LazyLock<(TempDir, Value)> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth rigid -o clip --frames 4 --size 48x27 --seed 5");
    let train = "train clip/truth -o scene.safetensors --steps 20 --random-points 400 \
                 --sh-degree 1 --eval-every 3 --report report --static";
    let report = json(folder.path(), train);
    (folder, report)
});

fn trained() -> &'static Path {
    TRAINED.0.path()
}

#[test]
fn help_has_an_example_of_every_command() {
    let folder = tempfile::tempdir().unwrap();
    let whole = run(folder.path(), "--help");
    assert!(whole.status.success());
    let whole = String::from_utf8(whole.stdout).unwrap();
    for command in COMMANDS {
        says(&whole, &[command]);
        let help = run(folder.path(), &format!("{command} --help"));
        assert!(help.status.success());
        let help = String::from_utf8(help.stdout).unwrap();
        says(&help, &["Example", &format!("  splat4d {command}"), "JSON"]);
        says(&help, &["Common options", "--json", "--device", "--seed"]);
    }
}

/// The texts behind the options are broken by hand.
#[test]
fn help_without_a_terminal_keeps_the_lines_of_its_texts() {
    for command in COMMANDS {
        let help = |columns: Option<&str>| {
            let mut program = program();
            program.args([command, "--help"]).env_remove("COLUMNS");
            let output =
                program.envs(columns.map(|columns| ("COLUMNS", columns))).output().unwrap();
            let help = String::from_utf8(output.stdout).unwrap();
            help.split_once("\nExample").expect("an example").1.to_owned()
        };
        assert_eq!(help(None), help(Some("10000")), "{command}");
    }
}

#[test]
fn shells_complete_what_the_program_takes() {
    let folder = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "powershell"] {
        let found = json(folder.path(), &format!("completions {shell}"));
        assert_eq!(found["shell"], shell);
        documented("completions", &found);
        let script = found["script"].as_str().unwrap();
        for command in COMMANDS {
            says(script, &[command]);
        }
        says(script, &["max-gaussians", "background"]);
        let printed = run(folder.path(), &format!("completions {shell}")).stdout;
        assert_eq!(String::from_utf8(printed).unwrap(), script);
    }
    // bash is always available, and the script is tested by sourcing it.
    let script = json(folder.path(), "completions bash")["script"].as_str().unwrap().to_owned();
    fs::write(folder.path().join("script"), script).unwrap();
    let ask = "source ./script; COMP_WORDS=(splat4d render scene --backg); COMP_CWORD=3; \
               _splat4d splat4d --backg scene; echo \"${COMPREPLY[@]}\"";
    let asked = Command::new("bash").current_dir(folder.path()).args(["-c", ask]).output().unwrap();
    assert_eq!(String::from_utf8(asked.stdout).unwrap().trim(), "--background");
    fails(folder.path(), 2, "completions csh");
}

#[test]
fn every_command_has_a_manual_page() {
    let folder = tempfile::tempdir().unwrap();
    let found = json(folder.path(), "man new/man1");
    documented("man", &found);
    let pages: BTreeSet<&str> =
        found["pages"].as_array().unwrap().iter().map(|p| p.as_str().unwrap()).collect();
    let there = fs::read_dir(folder.path().join("new/man1")).unwrap().count();
    assert_eq!(there, pages.len());
    let page = |name: &str| fs::read_to_string(folder.path().join("new/man1").join(name)).unwrap();
    says(&page("splat4d.1"), &[".TH splat4d 1", "splat4d\\-render(1)"]);
    for command in COMMANDS {
        let name = format!("splat4d-{command}.1");
        assert!(pages.contains(name.as_str()), "{name} of {pages:?}");
        says(&page(&name), &[&format!(".TH splat4d-{command} 1"), "Example", "\\-\\-device"]);
    }
    assert!(pages.contains("splat4d-bench-cmp.1"));
    fs::write(folder.path().join("file"), "").unwrap();
    says(&fails(folder.path(), 1, "man file"), &["is a file"]);
}

/// Checks that a command's help names every key of its result.
#[track_caller]
fn documented(command: &str, given: &Value) {
    let help = run(Path::new("."), &format!("{command} --help"));
    let help = String::from_utf8(help.stdout).unwrap();
    for key in given.as_object().unwrap().keys() {
        assert!(help.contains(key.as_str()), "{command} --help does not name `{key}`");
    }
}

#[test]
fn devices_are_listed() {
    let found = json(Path::new("."), "devices");
    let first = &found["devices"][0];
    assert!(first["name"].is_string() && first["subgroup_size"].as_u64() >= Some(4), "{found}");
    documented("devices", &found);
    documented("devices", first);
}

/// A finding of `doctor` about a subject.
#[track_caller]
fn finding<'a>(found: &'a Value, subject: &str) -> &'a Value {
    let findings = found["findings"].as_array().unwrap();
    let of = findings.iter().find(|finding| finding["subject"] == subject);
    of.unwrap_or_else(|| panic!("nothing on {subject}: {found}"))
}

#[test]
fn doctor_finds_a_machine_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let found = json(folder.path(), "doctor --seed 3");
    assert_eq!(content(folder.path()).len(), 0, "it leaves nothing behind");
    documented("doctor", &found);
    assert_eq!(found["problems"], 0, "{found}");
    assert_eq!(found["program"]["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(found["system"]["os"], std::env::consts::OS);
    for part in ["program", "system", "vulkan", "ffmpeg", "onnxruntime"] {
        documented("doctor", &found[part]);
    }
    for at in [0, 1] {
        documented("doctor", &found["folders"][at]);
        assert!(found["folders"][at]["free_bytes"].as_u64() > Some(0), "{found}");
    }
    for key in ["memory_bytes", "available_bytes", "cores"] {
        assert!(found["system"][key].as_u64() > Some(0), "{key}: {found}");
    }
    assert!(found["vulkan"]["loader"].as_str().unwrap().starts_with("1."), "{found}");
    let devices = found["vulkan"]["devices"].as_array().unwrap();
    let usable: Vec<_> = devices.iter().filter(|device| device["unfit"].is_null()).collect();
    assert!(!usable.is_empty(), "{found}");
    for device in usable {
        let smoke = &device["smoke"];
        documented("doctor", smoke);
        // Rendering and training; quick cases follow if there is time left.
        assert!(smoke["cases"].as_u64() >= Some(2), "{smoke}");
        assert_eq!((&smoke["failed"], &smoke["error"]), (&Value::Array(vec![]), &Value::Null));
        let subject = format!("device {}, smoke test", device["index"]);
        assert_eq!(finding(&found, &subject)["mark"], "ok");
    }
}

#[test]
fn doctor_names_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let none = folder.path().join("none\u{1b}.json");
    let without = |arguments: &[&str]| {
        let mut command = program();
        command.current_dir(folder.path()).args(arguments).env("PATH", folder.path());
        command.env("VK_DRIVER_FILES", &none).env("VK_ICD_FILENAMES", &none);
        command.env_remove("VK_ADD_DRIVER_FILES").env_remove("ORT_DYLIB_PATH");
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        assert!(!stderr(&output).contains("panicked"), "{}", stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let found: Value = serde_json::from_str(&without(&["doctor", "--json"])).unwrap();
    assert_eq!(
        (&found["problems"], &found["vulkan"]["devices"]),
        (&1.into(), &Value::Array(vec![]))
    );
    says(found["vulkan"]["error"].as_str().unwrap(), &["no driver", "mesa-vulkan-drivers"]);
    let drivers = finding(&found, "Vulkan drivers");
    assert_eq!(drivers["mark"], "problem");
    says(drivers["remedy"].as_str().unwrap(), &["Debian", "Fedora", "Arch"]);
    let ffmpeg = finding(&found, "ffmpeg");
    assert_eq!((&ffmpeg["mark"], &found["ffmpeg"]["version"]), (&"note".into(), &Value::Null));
    says(ffmpeg["remedy"].as_str().unwrap(), &["apt-get install ffmpeg"]);
    let set = &found["environment"]["VK_DRIVER_FILES"];
    assert_eq!(set.as_str(), none.to_str());
    let text = without(&["doctor"]);
    says(
        &text,
        &["problem  Vulkan drivers: ", "note     ffmpeg: not found", "1 problem was found"],
    );
    assert!(text.contains("VK_DRIVER_FILES=") && !text.contains('\u{1b}'), "{text}");
}

/// A file that is no library, where the loader is looked for first.
#[test]
#[cfg(target_os = "linux")]
fn doctor_says_that_there_is_no_loader() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("libvulkan.so.1"), "").unwrap();
    let mut command = program();
    command.arg("doctor").env("LD_LIBRARY_PATH", folder.path());
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    says(&text, &["problem  Vulkan loader: no Vulkan loader found", "libvulkan1", "vulkan-loader"]);
}

/// A driver that aborts the process that loads it.
#[test]
#[cfg(target_os = "linux")]
fn doctor_survives_a_driver_that_crashes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let source = "#include <stdlib.h>\n\
                  void *vk_icdGetInstanceProcAddr(void *a, const char *b) { abort(); }\n\
                  int vk_icdNegotiateLoaderICDInterfaceVersion(unsigned *a) { abort(); }\n";
    fs::write(at("driver.c"), source).unwrap();
    let mut compiler = Command::new("cc");
    compiler.current_dir(folder.path()).args("-shared -fPIC -o driver.so driver.c".split(' '));
    assert!(compiler.status().unwrap().success());
    let manifest = serde_json::json!({
        "file_format_version": "1.0.0",
        "ICD": { "library_path": at("driver.so"), "api_version": "1.3.0" },
    });
    fs::write(at("driver.json"), manifest.to_string()).unwrap();
    let mut command = program();
    command.arg("doctor").env("VK_DRIVER_FILES", at("driver.json"));
    let output = command.env_remove("VK_ADD_DRIVER_FILES").output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    says(&text, &["problem  Vulkan drivers: ", "crashes: signal: 6", "VK_DRIVER_FILES"]);
}

#[test]
fn training_reports_and_leaves_a_scene() {
    let report = &TRAINED.1;
    documented("train", report);
    assert_eq!(report["gaussians"], 400);
    assert_eq!((&report["images"], &report["held_out"]), (&2.into(), &2.into()));
    assert_eq!(report["control_points"], 0);
    assert_eq!((&report["dynamic_share"], &report["density"]), (&0.0.into(), &Value::Null));
    for key in ["psnr_input", "psnr_test", "peak_bytes", "milliseconds_per_step"] {
        assert!(report[key].as_f64() > Some(1.0), "{key}: {report}");
    }
    assert!(report["seconds"]["train"].as_f64() > Some(0.0));

    let scene = Scene::open(trained().join("scene.safetensors"), false).unwrap().scene;
    assert_eq!(scene.gaussians.len(), 400);
    assert_eq!(scene.cameras.len(), 4);
    assert_eq!(scene.report["psnr_test"], report["psnr_test"]);
    let sheet = trained().join("report/sheet.png");
    let (width, height) = images::dimensions(&sheet, images::Orientation::Stored).unwrap();
    assert!(width >= 4 * 48 && height >= 2 * 27, "{width}×{height}");
    let written: Value =
        serde_json::from_slice(&fs::read(trained().join("report/report.json")).unwrap()).unwrap();
    assert_eq!(written["gaussians"], 400);
}

#[test]
fn training_repeats_itself_and_more_of_it_is_better() {
    let folder = tempfile::tempdir().unwrap();
    let clip = trained().join("clip/truth");
    let train = |steps: usize, file: &str| {
        json(
            folder.path(),
            &format!(
                "train {} -o {file} --steps {steps} --random-points 400 --sh-degree 1 \
                 --eval-every 3 --static",
                clip.display()
            ),
        )
    };
    let first = train(20, "a.safetensors");
    assert_eq!(first["psnr_test"], TRAINED.1["psnr_test"], "the same run gives the same bits");
    let longer = train(120, "b.safetensors");
    let input = |report: &Value| report["psnr_input"].as_f64().unwrap();
    assert!(input(&longer) > input(&first) + 0.5, "{longer} after {first}");
}

#[test]
fn pictures_with_times_make_a_scene_that_moves() {
    let folder = tempfile::tempdir().unwrap();
    let train = "-o x --steps 30 --random-points 300 --control-points 20 --sh-degree 0 \
                 --max-gaussians 300 --density adaptive";
    let clip = trained().join("clip/truth");
    let report = json(folder.path(), &format!("train {} {train}", clip.display()));
    documented("train", &report);
    assert_eq!((&report["control_points"], &report["gaussians"]), (&15.into(), &300.into()));
    assert_eq!((&report["dynamic_share"], &report["density"]), (&1.0.into(), &"adaptive".into()));
    let found = json(folder.path(), "info x");
    assert_eq!(found["network"]["width"], 128);
    json(folder.path(), "render x -o views --path input --times 0.5");
}

#[test]
fn info_counts() {
    let found = json(trained(), "info scene.safetensors");
    documented("info", &found);
    assert_eq!(found["gaussians"], 400);
    assert_eq!(found["cameras"], 4);
    assert_eq!(found["sh_degree"], 1);
    assert_eq!((&found["width"], &found["height"]), (&48.into(), &27.into()));
    assert_eq!(found["network"], Value::Null);
    assert_eq!(found["report"]["psnr_test"], TRAINED.1["psnr_test"]);
    let [low, high] = [0, 1].map(|i| found["bounding_box"][i][0].as_f64().unwrap());
    assert!(low < high);
    let text = run(trained(), "info scene.safetensors");
    says(&String::from_utf8(text.stdout).unwrap(), &["400", "48×27"]);
}

#[test]
fn a_network_measures_beside_the_other_figures() {
    let library = runtime::library().expect("an ONNX Runtime; tools/setup.sh test installs it");
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/models/lpips.onnx");
    let options = format!("--lpips {} --onnxruntime {}", model.display(), library.display());
    // The held-out cameras of a clip, and the images of a dataset.
    for reference in ["clip/truth", "clip/truth/transforms.json"] {
        let found = json(trained(), &format!("eval scene.safetensors {reference} {options}"));
        documented("eval", &found);
        assert_eq!(found["lpips_net"], "squared difference");
        let rows = found["per_frame"].as_array().unwrap();
        let of = |row: &Value, key: &str| row[key].as_f64().unwrap();
        for row in rows {
            // This LPIPS model computes the mean squared difference of values in [−1, 1].
            let expected = 4.0 * 10.0f64.powf(-of(row, "psnr") / 10.0);
            assert!((of(row, "lpips") / expected - 1.0).abs() < 1e-4, "{row} {expected}");
        }
        let mean = rows.iter().map(|row| of(row, "lpips")).sum::<f64>() / rows.len() as f64;
        assert!((of(&found, "lpips") - mean).abs() < 1e-9, "{found}");
    }
    let missing = fails(trained(), 2, "eval scene.safetensors clip/truth --onnxruntime x");
    says(&missing, &["--lpips"]);
}

#[test]
fn a_scene_is_measured_against_the_truth() {
    let found = json(trained(), "eval scene.safetensors clip/truth");
    documented("eval", &found);
    // The scene was trained with the true cameras.
    for key in ["ate_rmse", "ate_relative", "rpe_trans_rmse", "rpe_rot_deg_rmse", "focal_error"] {
        assert!(found[key].as_f64().unwrap() < 1e-5, "{key}: {found}");
    }
    assert!((found["scale"].as_f64().unwrap() - 1.0).abs() < 1e-5);
    assert_eq!(found["poses"], 4);
    assert_eq!(found["mask_iou"], 0.0, "a static scene covers none of the mover");
    assert!(found["depth_rel_median"].as_f64().unwrap() > 0.0);
    assert_eq!(found["per_frame"].as_array().unwrap().len(), 6, "three cameras at two times");
    // Measured: 16.03 dB and an SSIM of 0.294, both with the true focal length and with the scene's.
    assert!(found["psnr"].as_f64() > Some(15.7), "{found}");
    assert!(found["ssim"].as_f64() > Some(0.28), "{found}");
    assert_eq!(found["psnr"], found["psnr_own_focal"]);
    assert_eq!((&found["lpips"], &found["lpips_net"]), (&Value::Null, &Value::Null));

    // Cameras with a wrong focal length: with the true focal length the scene measures as before, and
    // only the second metric uses a lens that fits the scene's cameras.
    let folder = tempfile::tempdir().unwrap();
    let mut long = Scene::open(trained().join("scene.safetensors"), false).unwrap().scene;
    for SceneCamera { camera, .. } in &mut long.cameras {
        camera.intrinsics.fx *= 1.2;
        camera.intrinsics.fy *= 1.2;
    }
    long.save(folder.path().join("long")).unwrap();
    let truth = trained().join("clip");
    let off = json(folder.path(), &format!("eval long {}", truth.display()));
    let of = |found: &Value, key: &str| found[key].as_f64().unwrap();
    assert!((of(&off, "focal_error") - 0.2).abs() < 1e-5, "{off}");
    assert!((of(&off, "psnr") - of(&found, "psnr")).abs() < 1e-6, "{off}");
    // Measured: 17.08 dB, which would be 1.05 dB too high.
    assert!((of(&off, "psnr_own_focal") - of(&off, "psnr")).abs() > 0.4, "{off}");
}

/// A folder with ground truth whose held-out images, `1` and `2`, are renders of the trained scene. In
/// camera 2 the left third moves and is painted black; the right third is not covisible and is painted
/// white.
fn clip_of_its_own_scene() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut cameras =
        transforms::read_cameras(&trained().join("clip/truth/transforms.json")).unwrap();
    let names = |folder: &str| (0..4).map(|i| format!("{folder}/{i:04}.png")).collect::<Vec<_>>();
    fs::create_dir_all(at("truth/held_out")).unwrap();
    transforms::write(at("truth/transforms.json"), &cameras, &names("frames"), None).unwrap();
    let scene = trained().join("scene.safetensors");
    let mut all = Vec::new();
    for distance in ["1", "2"] {
        for camera in &mut cameras {
            camera.camera.view_from_world.translation.x += 0.1;
        }
        transforms::write(at("path.json"), &cameras, &names("x"), None).unwrap();
        let pictures = format!("truth/held_out/{distance}");
        let render = format!("render {} -o {pictures} --path path.json", scene.display());
        json(folder.path(), &render);
        all.extend(cameras.iter().copied());
    }
    let files = [names("1"), names("2")].concat();
    transforms::write(at("truth/held_out/transforms.json"), &all, &files, None).unwrap();
    for name in names("2") {
        let file = at("truth/held_out").join(&name);
        let mut picture = images::decode_rgb(&file, [0.0; 3], images::Orientation::Stored).unwrap();
        let [mut movers, mut covisible] = [Image::new(48, 27, 1), Image::new(48, 27, 1)];
        for y in 0..27 {
            for x in 0..48 {
                movers.at_mut(x, y)[0] = if x < 16 { 1.0 } else { 0.0 };
                covisible.at_mut(x, y)[0] = if x < 32 { 1.0 } else { 0.0 };
                match x {
                    0..16 => picture.at_mut(x, y).fill(0.0),
                    16..32 => {}
                    _ => picture.at_mut(x, y).fill(1.0),
                }
            }
        }
        write_png(&file, &picture).unwrap();
        for (kind, mask) in [("masks", movers), ("covisible", covisible)] {
            let file = at("truth/held_out").join(kind).join(&name);
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            write_mask(file, &mask).unwrap();
        }
    }
    folder
}

/// Whether the only error is rounding; an infinite PSNR is null.
fn equal(row: &Value) -> bool {
    row["psnr"].as_f64().is_none_or(|psnr| psnr > 45.0) && row["ssim"].as_f64() > Some(0.99)
}

#[test]
fn held_out_pictures_are_scored_by_region_and_distance() {
    let folder = clip_of_its_own_scene();
    let scene = trained().join("scene.safetensors");
    let eval = format!("eval {} truth", scene.display());
    let found = json(folder.path(), &format!("{eval} --pictures out"));
    documented("eval", &found);
    assert_eq!(found["held_out_fitted"], Value::Null, "not asked for");
    assert_eq!((&found["depth_rel_median"], &found["mask_iou"]), (&Value::Null, &Value::Null));
    let rows = found["held_out"].as_array().unwrap();
    let distances: Vec<&str> = rows.iter().map(|row| row["distance"].as_str().unwrap()).collect();
    assert_eq!(distances, ["1", "2", "all"]);
    let [one, two, all] = [0, 1, 2].map(|i| &rows[i]);
    documented("eval", one);
    assert!(equal(one), "{one}");
    for key in ["movers", "outside_movers", "covisible", "static_covisible", "not_filmed_share"] {
        assert_eq!(one[key], Value::Null, "{key}: there are no masks");
    }
    // SSIM windows at the region's edges include painted pixels; the region's pixels do not.
    let kept = &two["static_covisible"];
    assert!(kept["psnr"].as_f64().is_none_or(|psnr| psnr > 45.0), "{two}");
    assert!(kept["pictures"] == 4 && kept["ssim"].as_f64() > Some(0.6), "{two}");
    documented("eval", &two["movers"]);
    assert!((two["not_filmed_share"].as_f64().unwrap() - 1.0 / 3.0).abs() < 1e-6);
    let psnr = |row: &Value| row["psnr"].as_f64().unwrap();
    let painted = [&two["movers"], &two["outside_movers"], &two["covisible"], two].map(psnr);
    assert!(painted.iter().all(|psnr| *psnr < 20.0), "{two}");
    // Squared errors add up: the mover is half of the covisible region, and the other half has no error.
    assert!((psnr(&two["covisible"]) - psnr(&two["movers"]) - 10.0 * 2f64.log10()).abs() < 0.5);
    assert!(two["movers"]["worst"].as_f64() <= two["movers"]["psnr"].as_f64());
    assert_eq!((&all["pictures"], &all["movers"]["pictures"]), (&8.into(), &4.into()));
    assert_eq!(all["movers"]["psnr"], two["movers"]["psnr"]);

    let written = images::list(&folder.path().join("out")).unwrap();
    assert_eq!(written.len(), 8);
    let sheet = images::decode_rgb(&written[4], [0.0; 3], images::Orientation::Stored).unwrap();
    assert_eq!((sheet.width, sheet.height), (3 * 48, 27), "truth, render, error");
    for y in 0..27 {
        assert_eq!(sheet.at(3, y), [0.0; 3], "painted black");
        assert_eq!(sheet.at(48 + 3, y), sheet.at(96 + 3, y), "so that the render is the error");
    }
    let said = fails(folder.path(), 1, &format!("{eval} --pictures truth/held_out/1"));
    says(&said, &["truth/held_out/1", "reads"]);

    let text = run(folder.path(), &eval);
    says(&String::from_utf8(text.stdout).unwrap(), &["movers", "not filmed", "33.3 %"]);

    // An evaluation that fails partway leaves no images, not even the earlier ones.
    let last = folder.path().join("truth/held_out/2/0003.png");
    let whole = fs::read(&last).unwrap();
    fs::write(&last, &whole[..whole.len() / 2]).unwrap();
    let said = fails(folder.path(), 1, &format!("{eval} --pictures half"));
    says(&said, &["2/0003.png"]);
    assert!(!folder.path().join("half").exists());
}

/// Ground truth whose held-out cameras are slightly wrong: fitted poses match the images better.
#[test]
fn poses_are_fitted_to_held_out_pictures() {
    let folder = clip_of_its_own_scene();
    let file = folder.path().join("truth/held_out/transforms.json");
    let names = transforms::file_names(&file).unwrap();
    let mut cameras = transforms::read_cameras(&file).unwrap();
    for camera in &mut cameras {
        camera.camera.view_from_world.translation.y += 0.08;
    }
    transforms::write(&file, &cameras, &names, None).unwrap();
    let eval = format!("eval {} truth --fit-poses", trained().join("scene.safetensors").display());
    let found = json(folder.path(), &eval);
    for (row, region) in [(0, None), (1, Some("static_covisible"))] {
        let [off, fitted] = ["held_out", "held_out_fitted"].map(|key| {
            let row = &found[key][row];
            region.map_or(row, |region| &row[region])["psnr"].as_f64().unwrap_or(f64::INFINITY)
        });
        assert!(fitted > off + 6.0, "{off} dB, fitted {fitted} dB");
    }
}

#[test]
fn a_scene_is_measured_from_its_first_camera_at_other_times() {
    let folder = tempfile::tempdir().unwrap();
    let scene = trained().join("scene.safetensors");
    let render = format!("render {} -o views --path input", scene.display());
    json(folder.path(), &render);
    // The scene is static, so the first camera always sees the same image; frame 9 is not in the scene.
    fs::create_dir(folder.path().join("seen")).unwrap();
    for name in ["v000_t000.png", "v000_t001.png", "v000_t003.png", "v000_t009.png"] {
        fs::copy(folder.path().join("views/0000.png"), folder.path().join("seen").join(name))
            .unwrap();
    }
    let found = json(folder.path(), &format!("eval {} seen", scene.display()));
    let row = &found["held_out"][0];
    assert_eq!((&row["distance"], &row["pictures"]), (&"first_camera".into(), &2.into()));
    assert!(equal(row), "{row}");
    assert_eq!(found["ate_rmse"], Value::Null);
    // Another camera's view is a different image; the number in a name is the frame's if the option says
    // so.
    fs::rename(folder.path().join("views"), folder.path().join("others")).unwrap();
    let others = json(folder.path(), &format!("eval {} others --first-camera", scene.display()));
    let row = &others["held_out"][0];
    assert!(row["pictures"] == 3 && !equal(row), "{row}");
    write_png(folder.path().join("seen/v000_t002.png"), &Image::new(30, 27, 3)).unwrap();
    let said = fails(folder.path(), 1, &format!("eval {} seen", scene.display()));
    says(&said, &["v000_t002.png", "proportions"]);
}

/// A scene in another coordinate frame, rotated, translated and scaled, gets the same metrics.
#[test]
fn the_truth_is_carried_into_the_scenes_frame() {
    use splat4d::geometry::sim3::Sim3;
    let home = Scene::open(trained().join("scene.safetensors"), false).unwrap().scene;
    let moved_from_home = Sim3 {
        scale: 2.5,
        rotation: glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -0.9, 0.2),
        translation: DVec3::new(3.0, -2.0, 7.0),
    };
    let mut moved = home.clone();
    let g = &mut moved.gaussians;
    // With the constant band alone, colours do not depend on the rotation.
    let coefficients = g.sh.len() / g.len();
    g.sh = g.sh.iter().copied().step_by(coefficients).collect();
    g.sh_degree = 0;
    let mut flat = home.clone();
    (flat.gaussians.sh, flat.gaussians.sh_degree) = (g.sh.clone(), 0);
    for i in 0..g.len() {
        let position = glam::Vec3::from_array(g.positions[i]).as_dvec3();
        g.positions[i] = moved_from_home.apply(position).as_vec3().to_array();
        g.log_scales[i] = g.log_scales[i].map(|s| s + 2.5f32.ln());
        let [w, x, y, z] = g.rotations[i].map(f64::from);
        let q = moved_from_home.rotation * glam::DQuat::from_xyzw(x, y, z, w);
        g.rotations[i] = [q.w, q.x, q.y, q.z].map(|v| v as f32);
    }
    for SceneCamera { camera, .. } in &mut moved.cameras {
        let world_from_view = moved_from_home.apply_pose(&camera.view_from_world.inverse());
        camera.view_from_world = world_from_view.inverse();
    }
    let folder = tempfile::tempdir().unwrap();
    flat.save(folder.path().join("home")).unwrap();
    moved.save(folder.path().join("moved")).unwrap();
    let truth = trained().join("clip");
    let eval = |name: &str| json(folder.path(), &format!("eval {name} {}", truth.display()));
    let (at_home, away) = (eval("home"), eval("moved"));
    assert!((away["scale"].as_f64().unwrap() * 2.5 - 1.0).abs() < 1e-5, "{away}");
    let close = |key: &str, by: f64| {
        let [a, b] = [&at_home, &away].map(|found| found[key].as_f64().unwrap());
        assert!((a - b).abs() < by, "{key}: {a} at home, {b} away");
    };
    close("psnr", 0.02);
    close("ssim", 0.002);
    close("depth_rel_median", 0.002);
    assert!(away["ate_rmse"].as_f64().unwrap() < 1e-5);
}

#[test]
fn a_scene_is_measured_against_pictures() {
    let found = json(trained(), "eval scene.safetensors clip/truth/transforms.json --eval-every 3");
    let (here, there) = (found["psnr"].as_f64().unwrap(), TRAINED.1["psnr_test"].as_f64().unwrap());
    assert!((here - there).abs() < 1e-6, "as training measured: {here} and {there}");
    assert_eq!(found["per_frame"].as_array().unwrap().len(), 2);
    assert_eq!(found["ate_rmse"], Value::Null);
}

#[test]
fn trajectories_are_measured() {
    let folder = tempfile::tempdir().unwrap();
    let mut lines = ["# estimate\n".to_owned(), String::new()];
    for i in 0..20 {
        let t = f64::from(i) * 0.1;
        let (x, y, z) = (t, (2.0 * t).sin(), t * t);
        lines[0] += &format!("{t} {} {} {} 0 0 0 1\n", 3.0 * x + 1.0, 3.0 * y, 3.0 * z - 5.0);
        lines[1] += &format!("{} {x} {y} {z} 0 0 0 1\n", t + 0.001);
    }
    fs::write(folder.path().join("a.txt"), &lines[0]).unwrap();
    fs::write(folder.path().join("b.txt"), &lines[1]).unwrap();
    let found = json(folder.path(), "eval a.txt b.txt");
    assert!(found["ate_rmse"].as_f64().unwrap() < 1e-9, "{found}");
    assert!((found["scale"].as_f64().unwrap() - 1.0 / 3.0).abs() < 1e-9);
    assert_eq!(found["poses"], 20);
    let rigid = json(folder.path(), "eval a.txt b.txt --align se3");
    assert!(rigid["ate_rmse"].as_f64().unwrap() > 0.5);
    assert_eq!(found["ape_trans"]["rmse"], found["ate_rmse"]);
    assert_eq!(found["rpe_pairs"], 19);
    documented("eval", &found);
    let late = fails(folder.path(), 1, "eval a.txt b.txt --time-offset 5");
    says(&late, &["--time-offset", "--max-time-diff"]);
    // The option's former name.
    let said = fails(folder.path(), 1, "eval a.txt b.txt --max-difference 0.0001");
    says(&said, &["--max-time-diff"]);
    let part = fails(folder.path(), 1, "eval a.txt b.txt --rpe-delta 1.5");
    says(&part, &["--rpe-delta", "--rpe-unit"]);
    // A spacing of more poses than the trajectory has: no relative error, and a note.
    let none = json(folder.path(), "eval a.txt b.txt --rpe-delta 20");
    assert!(none["rpe_trans"].is_null() && none["rpe_trans_rmse"].is_null(), "{none}");
}

#[test]
fn trajectories_of_formats_without_times_pair_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let cams = folder.path().join("cams");
    fs::create_dir(&cams).unwrap();
    let (mut tum, mut kitti) = (String::new(), String::new());
    for i in 0..12u32 {
        let (x, y) = (f64::from(i) * 0.25, f64::from(i * i) * 0.125);
        tum += &format!("{} {x} {y} 2 0 0 0 1\n", 100 + i);
        kitti += &format!("1 0 0 {x} 0 1 0 {y} 0 0 1 2\n");
        // The matrix from world to camera, with the identity rotation.
        let k = [1120.0, 0.0, 511.5, 0.0, 1120.0, 217.5, 0.0, 0.0, 1.0];
        let m = [1.0, 0.0, 0.0, -x, 0.0, 1.0, 0.0, -y, 0.0, 0.0, 1.0, -2.0];
        let mut bytes = 202_021.25f32.to_le_bytes().to_vec();
        bytes.extend(k.iter().chain(&m).flat_map(|v| v.to_le_bytes()));
        fs::write(cams.join(format!("frame_{i:04}.cam")), bytes).unwrap();
    }
    fs::write(folder.path().join("tum.txt"), tum).unwrap();
    fs::write(folder.path().join("kitti.txt"), &kitti).unwrap();
    for pair in ["tum.txt cams", "kitti.txt tum.txt", "cams kitti.txt"] {
        let found = json(folder.path(), &format!("eval {pair} --align none"));
        assert_eq!(found["poses"], 12, "{pair}");
        assert!(found["ape_trans"]["max"].as_f64().unwrap() < 1e-12, "{pair}: {found}");
    }
    // With one pose fewer, the poses cannot be matched by order.
    let short: String = kitti.lines().skip(1).map(|line| format!("{line}\n")).collect();
    fs::write(folder.path().join("short.txt"), short).unwrap();
    let said = fails(folder.path(), 1, "eval short.txt tum.txt");
    says(&said, &["count from 0", "--time-offset"]);
    fs::write(cams.join("frame_0003.cam"), b"PIEH").unwrap();
    says(&fails(folder.path(), 1, "eval tum.txt cams"), &["frame_0003.cam", "172 bytes"]);
}

#[test]
fn a_reference_that_is_a_video_is_named() {
    fs::write(trained().join("reference.mp4"), b"\0\0\0 ftypisom\xff\xfe").unwrap();
    let output = run(trained(), "eval scene.safetensors reference.mp4");
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    says(&said, &["reference.mp4", "dataset", "a video or image has no known cameras"]);
    assert!(!said.contains("scene.safetensors"), "{said}");
}

#[test]
fn rendering_writes_what_the_renderer_gives() {
    let folder = tempfile::tempdir().unwrap();
    let path = cameras(3);
    let names: Vec<String> = (0..3).map(|i| format!("{i}.png")).collect();
    transforms::write(folder.path().join("path.json"), &path, &names, None).unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let found = json(
        folder.path(),
        "render blobs.ply -o out/views --path path.json --what colour,depth --exr --background 0.2,0.4,0.6",
    );
    documented("render", &found);
    assert_eq!((&found["frames"], &found["gaussians"]), (&3.into(), &9.into()));
    let device = common::device();
    let mut renderer = Renderer::new(&device, &Scene::of(blobs())).unwrap();
    for (i, shot) in path.iter().enumerate() {
        let expected = renderer.render(&shot.camera, shot.time).unwrap();
        let file = |ending: &str| folder.path().join(format!("out/views/{i:04}{ending}"));
        let float = exr::read_rgba(file(".exr")).unwrap();
        let apart =
            |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // The path was written to a file in decimal, and its axes were converted twice.
        assert!(apart(&float.pixels, &expected.rgba.pixels) < 1e-4);
        let depth = exr::read_depth(file("_depth.exr")).unwrap();
        assert!(apart(&depth.pixels, &expected.mean_depth().pixels) < 1e-3);
        let png = images::decode_rgb(&file(".png"), [0.0; 3], images::Orientation::Stored).unwrap();
        let over = expected.over([0.2, 0.4, 0.6]);
        let clamped: Vec<f32> = over.pixels.iter().map(|v| v.clamp(0.0, 1.0)).collect();
        assert!(apart(&png.pixels, &clamped) < 0.6 / 255.0 + 1e-4);
    }
    assert_eq!(content(&folder.path().join("out/views")).len(), 12);
}

#[test]
fn every_layer_is_written_as_a_picture_and_in_floats() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let all = "colour,depth,alpha,motion,flow,normal";
    let render = "render blobs.ply --path spiral --frames 3 --size 48x32 --background white";
    let found = json(folder.path(), &format!("{render} -o all --what {all} --exr"));
    documented("render", &found);
    // The last frame has no flow, in either format.
    assert_eq!(content(&folder.path().join("all")).len(), 2 * (6 * 3 - 1));
    let file = |name: &str| folder.path().join("all").join(name);
    let colour = exr::read_rgba(file("0001.exr")).unwrap();
    let normal = exr::read_rgba(file("0001_normal.exr")).unwrap();
    let flow = splat4d::data::flo::read(file("0001_flow.flo")).unwrap();
    let seen = |i: usize| colour.pixels[4 * i + 3] > 1e-3;
    let (mut shown, mut moved) = (0, 0.0f32);
    for i in 0..48 * 32 {
        let n = &normal.pixels[3 * i..3 * i + 3];
        let length = n.iter().map(|v| v * v).sum::<f32>().sqrt();
        assert!((length - f32::from(u8::from(seen(i)))).abs() < 1e-4, "{n:?}");
        assert_eq!(flow.pixels[2 * i].is_nan(), !seen(i));
        if seen(i) {
            shown += 1;
            moved = moved.max(flow.pixels[2 * i].hypot(flow.pixels[2 * i + 1]));
        }
    }
    assert!(shown > 100 && moved > 0.5 && moved < 48.0, "{shown} {moved}");
    // A single layer gives one folder of images, or a video.
    json(folder.path(), &format!("{render} -o depth --what depth"));
    assert!(content(&folder.path().join("depth")).iter().all(|p| p.ends_with("0000_depth.png")
        || p.ends_with("0001_depth.png")
        || p.ends_with("0002_depth.png")));
    json(folder.path(), &format!("{render} -o flow.mp4 --what flow"));
    says(
        &fails(folder.path(), 1, &format!("{render} -o x.mp4 --what depth,flow")),
        &["a video", "--what"],
    );
    let one = "render blobs.ply -o x --path dolly --frames 1 --what flow";
    says(&fails(folder.path(), 1, one), &["--what flow", "--frames"]);
    says(&fails(folder.path(), 2, &format!("{render} -o x --what colours")), &["normal"]);
}

#[test]
fn frames_a_second_come_with_their_error() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let bench = "render blobs.ply --bench --size 48x32 --frames 4";
    let best = json(folder.path(), bench);
    documented("render", &best);
    fs::write(folder.path().join("fast.json"), r#"{"alpha_cut": 0.2}"#).unwrap();
    let fast = json(folder.path(), &format!("{bench} --settings fast.json"));
    let number = |of: &Value, path: &str| of.pointer(path).and_then(Value::as_f64).unwrap();
    for found in [&best, &fast] {
        let rate = number(found, "/frames_per_second/median");
        let [low, high] =
            [0, 1].map(|i| number(found, &format!("/frames_per_second/quartiles/{i}")));
        assert!(low > 0.0 && low <= rate && rate <= high, "{found}");
        assert!((1e3 / rate / number(found, "/milliseconds/median") - 1.0).abs() < 0.5, "{found}");
        assert_eq!((&found["views"], &found["gaussians"]), (&3.into(), &9.into()));
    }
    assert!(number(&best, "/error/psnr") > 90.0, "{best}");
    assert!(number(&fast, "/error/psnr") < 60.0, "what is left out shows: {fast}");
    assert_eq!(number(&fast, "/settings/alpha_cut") as f32, 0.2);
    let text = run(folder.path(), &format!("{bench} --device software")).stdout;
    says(&String::from_utf8(text).unwrap(), &["frames a second", "error against the oracle"]);
    says(&fails(folder.path(), 2, &format!("{bench} -o x")), &["--output"]);
    says(&fails(folder.path(), 2, "render blobs.ply"), &["--output"]);
}

#[test]
fn sizes_focal_lengths_and_orbits() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let found = json(folder.path(), "render blobs.ply -o a --frames 3 --size 40x24 --times 0.5");
    assert_eq!(
        (&found["frames"], &found["width"], &found["height"]),
        (&3.into(), &40.into(), &24.into())
    );
    let bright = |name: &str| {
        let path = folder.path().join(name);
        let image = images::decode_rgb(&path, [0.0; 3], images::Orientation::Stored).unwrap();
        image.pixels.iter().filter(|v| **v > 0.05).count()
    };
    assert!(bright("a/0000.png") > 100, "the orbit shows the Gaussians");
    json(folder.path(), "render blobs.ply -o b --frames 1 --size 40x24 --focal 4");
    assert!(bright("b/0000.png") * 4 < bright("a/0000.png"), "a short lens shows them small");
    let views = json(trained(), "render scene.safetensors -o views --times 2");
    assert_eq!(views["frames"], 8, "four cameras at two times each");
}

#[test]
fn a_video_where_ffmpeg_is() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let render = "render blobs.ply -o new/orbit.mp4 --frames 4 --size 41x25";
    let there = Command::new("ffmpeg").arg("-version").output().is_ok();
    if there {
        json(folder.path(), render);
        let options = splat4d::data::ClipOptions::default();
        let clip = splat4d::data::Clip::open(folder.path().join("new/orbit.mp4"), &options);
        let clip = clip.unwrap();
        assert_eq!((clip.frames.len(), clip.width, clip.height), (4, 42, 26));
        assert_eq!(content(&folder.path().join("new")).len(), 1, "the images are gone");
        says(&fails(folder.path(), 1, &format!("{render} --exr")), &["--exr", "folder"]);
    }
    let empty = folder.path().join("nothing");
    let output = program()
        .current_dir(folder.path())
        .args(render.replace("new", "other").split_whitespace())
        .env("PATH", empty)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    says(&stderr(&output), &["ffmpeg", "Install"]);
    assert!(!folder.path().join("other").exists());
}

#[test]
fn wrong_usage_is_two() {
    let folder = tempfile::tempdir().unwrap();
    for arguments in [
        "frobnicate",
        "train",
        "train data",
        "train data -o x --steps many",
        "train data -o x --steps 0",
        "train data -o x --sh-degree 4",
        "train data -o x --density adaptive",
        "train data -o x --max-gaussians 9 --density even",
        "render x -o y --size 10",
        "render x -o y --times 3,4",
        "render x -o y --background red",
        "render x -o y --focal -3",
        "synth nothing -o x",
        "synth rigid",
        "info",
        "eval x",
        "devices --no-such-flag",
    ] {
        fails(folder.path(), 2, arguments);
    }
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("empty")).unwrap();
    fs::write(at("noise"), "this is no scene").unwrap();
    fs::write(at("noise.ply"), "ply\nformat nonsense 1.0\nend_header\n").unwrap();
    let missing = ["missing"];
    for (arguments, parts) in [
        ("train missing -o x", &missing[..]),
        ("render missing -o x", &missing),
        ("info missing", &missing),
        ("eval missing empty", &missing),
        ("eval noise missing", &missing),
        ("train empty -o x", &["empty", "transforms.json"]),
        ("train noise -o x", &["noise", "not a dataset"]),
        ("info noise", &["noise"]),
        ("info noise.ply", &["noise.ply"]),
        ("render noise -o x", &["noise"]),
        ("render noise.ply -o x", &["noise.ply"]),
        ("info empty", &["empty", "folder"]),
    ] {
        says(&fails(folder.path(), 1, arguments), parts);
    }
}

#[test]
#[cfg(target_os = "linux")]
fn sizes_are_checked_before_memory_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("set"), 3);
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    for arguments in [
        "render blobs.ply -o x --times 18446744073709551615",
        "render blobs.ply -o x --times 10000000000",
        "render blobs.ply -o x --frames 4294967295",
        "render blobs.ply -o x --focal 1e300",
        "train set -o x --control-points 18446744073709551615",
        "train set -o x --control-points 1000000000",
        "train set -o x --random-points 4294967295",
        "train set -o x --max-gaussians 18446744073709551615",
        "train set -o x --steps 4294967295",
        "reconstruct set -o x --width 100000",
        "synth rigid -o x --frames 4294967295",
    ] {
        says(&fails_within(folder.path(), 4096, 2, arguments), &[" to ", "expected"]);
    }
    let half_a_terabyte = "render blobs.ply -o x --frames 1000 --times 1001";
    let said = fails_within(folder.path(), 4096, 1, half_a_terabyte);
    says(&said, &["1,001,000 images", "--times", "--frames"]);
    for (arguments, parts) in [
        ("render blobs.ply -o x --frames 1 --size 65535x65535", &["65535×65535", "memory"][..]),
        ("train set -o x --random-points 100000000", &["100,000,000", "--random-points"]),
        ("train set -o x --max-gaussians 1000000000", &["1,000,000,000", "--max-gaussians"]),
        ("synth rigid -o x --frames 10000 --size 320x180", &["memory"]),
    ] {
        says(&fails_within(folder.path(), 4096, 1, arguments), parts);
    }
}

/// Memory limits from the point where the program barely loads up to where a software driver works.
#[test]
#[cfg(target_os = "linux")]
fn too_little_address_space_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("set"), 3);
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    fs::write(folder.path().join("a.txt"), "0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n").unwrap();
    for mebibytes in [250, 400, 550, 700, 850, 1000] {
        for arguments in [
            "devices",
            "render blobs.ply -o x --device software --frames 1",
            "train set -o x --device software --steps 1 --random-points 9",
            "reconstruct set -o x --device software",
            "eval blobs.ply set --device software",
            "validate --quick --device software",
            "bench --quick --filter scan --device software",
        ] {
            let said = fails_within(folder.path(), mebibytes, 1, arguments);
            says(&said, &["Vulkan device", "address space", "ulimit -v"]);
        }
        for arguments in ["info blobs.ply", "eval a.txt a.txt"] {
            let output = within(folder.path(), mebibytes, arguments);
            assert!(output.status.success(), "{mebibytes}, {arguments}: {}", stderr(&output));
        }
    }
    for mebibytes in [40, 60] {
        let said = fails_within(folder.path(), mebibytes, 1, "synth rigid -o x");
        says(&said, &["splat4d", "address space", "ulimit -v"]);
    }
}

#[test]
fn wide_splats_are_foreseen() {
    let folder = tempfile::tempdir().unwrap();
    let mut gaussians = blobs();
    for _ in 0..8 {
        gaussians = Gaussians {
            positions: gaussians.positions.repeat(2),
            log_scales: vec![[1.0; 3]; 2 * gaussians.len()],
            rotations: gaussians.rotations.repeat(2),
            opacity_logits: gaussians.opacity_logits.repeat(2),
            sh: gaussians.sh.repeat(2),
            ..gaussians
        };
    }
    ply::write(folder.path().join("wide.ply"), &gaussians).unwrap();
    let found = json(folder.path(), "render wide.ply -o x --frames 2 --size 160x96");
    let [foreseen, taken] =
        ["predicted_bytes", "peak_bytes"].map(|key| found[key].as_f64().unwrap());
    assert!((foreseen / taken - 1.0).abs() < 0.02, "{found}");
}

/// A few Gaussians in large frames cover many tiles each: the memory that training needs is reported once
/// the Gaussians are known.
#[test]
fn wide_splats_of_a_clip_are_foreseen() {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth rigid -o clip --frames 4 --size 640x400");
    let options = "--size 640 --steps 4 --max-gaussians 64 --control-points 6 --device software";
    let output = run(folder.path(), &format!("reconstruct clip/frames -o x {options} --json"));
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    let lines = said.lines().filter(|line| line.starts_with("training up to 64 Gaussians takes"));
    assert_eq!(lines.count(), 2, "{said}");
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    let [foreseen, taken] =
        ["predicted_bytes", "peak_bytes"].map(|key| found[key].as_f64().unwrap());
    assert!(foreseen >= taken, "{found}");
}

#[test]
#[cfg(target_os = "linux")]
fn trajectories_of_equal_timestamps_take_little_memory() {
    let folder = tempfile::tempdir().unwrap();
    let line = |i: usize| format!("5.5 {} {} 0 0 0 0 1\n", i % 7, i % 3);
    let text: String = (0..20_000).map(line).collect();
    fs::write(folder.path().join("a.txt"), text).unwrap();
    let output = within(folder.path(), 1024, "eval a.txt a.txt --json");
    assert!(output.status.success(), "{}", stderr(&output));
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(found["poses"], 20_000);
    assert!(found["ate_rmse"].as_f64() < Some(1e-9), "{found}");
}

#[test]
#[cfg(target_os = "linux")]
fn inputs_that_are_no_regular_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("set"), 3);
    ply::write(at("blobs.ply"), &blobs()).unwrap();
    fs::write(at("a.txt"), "0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n").unwrap();
    for pipe in ["pipe", "pipe.json"] {
        assert!(Command::new("mkfifo").arg(at(pipe)).status().unwrap().success());
    }
    // An endless file with a dataset's extension.
    std::os::unix::fs::symlink("/dev/zero", at("zero.json")).unwrap();
    for endless in ["/dev/zero", "pipe"] {
        for arguments in [
            "info IN",
            "render IN -o x",
            "render blobs.ply -o x --path IN",
            "render blobs.ply -o x --settings IN",
            "eval IN a.txt",
            "eval a.txt IN",
            "eval IN set",
            "bench cmp IN IN",
            "validate --device software --case IN",
            "train set -o x --settings IN",
            "reconstruct set -o x --intrinsics IN",
            "reconstruct set -o x --poses IN",
        ] {
            let arguments = arguments.replace("IN", endless);
            let said = fails_within(folder.path(), 4096, 1, &arguments);
            says(&said, &[endless, "no regular file"]);
        }
        says(
            &fails_within(folder.path(), 4096, 1, &format!("train {endless} -o x")),
            &[endless, "not a dataset"],
        );
    }
    for arguments in ["train zero.json -o x", "train pipe.json -o x", "eval blobs.ply pipe.json"] {
        says(&fails_within(folder.path(), 4096, 1, arguments), &["no regular file"]);
    }
    // Regular files that are larger than memory, or larger than the limit for their kind.
    for (name, size) in [("large.ply", 1u64 << 40), ("large.json", 1 << 30)] {
        fs::File::create(at(name)).unwrap().set_len(size).unwrap();
    }
    says(&fails_within(folder.path(), 4096, 1, "info large.ply"), &["large.ply", "memory"]);
    says(
        &fails_within(folder.path(), 4096, 1, "train large.json -o x"),
        &["large.json", "at most"],
    );
}

#[test]
fn what_does_not_fit_is_told_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("set"), 4);
    let said = fails(
        folder.path(),
        1,
        "train set -o x --random-points 50 --max-gaussians 1000000000 --density adaptive",
    );
    says(
        &said,
        &["1,000,000,000 Gaussians does not fit", "Gaussians would fit", "--max-gaussians"],
    );
    let said = fails(
        folder.path(),
        1,
        "train set -o x --random-points 50 --max-gaussians 1000000000 --view",
    );
    says(&said, &["with a page does not fit", "or leave out --view"]);
    // More Gaussians than one binding can hold the rotations of.
    let most = common::device().limits().storage_range / 16;
    if most < 1 << 25 {
        let number = (most + 1) as usize;
        let mut splat = [0; 32];
        splat[12..24].as_chunks_mut().0.fill(0.01f32.to_le_bytes());
        splat[24..].fill(200);
        fs::write(folder.path().join("large.splat"), splat.repeat(number)).unwrap();
        let said = fails(folder.path(), 1, "view large.splat --seconds 1");
        says(&said, &["Gaussians does not fit", "Gaussians would fit: leave Gaussians out"]);
    } else {
        eprintln!("not tested: a scene that `view` cannot show; {most} Gaussians fit this device");
    }
    let found = json(folder.path(), "train set -o x --random-points 50 --steps 2");
    let (foreseen, taken) = (&found["predicted_bytes"], &found["peak_bytes"]);
    assert!(foreseen.as_u64() > Some(1 << 20) && taken.as_u64() > Some(1 << 20), "{found}");
}

#[test]
fn bad_datasets_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("one"), 1);
    says(&fails(folder.path(), 1, "train one -o x"), &["one image"]);
    dataset(&at("broken"), 4);
    let whole = fs::read(at("broken/2.png")).unwrap();
    fs::write(at("broken/2.png"), &whole[..whole.len() / 2]).unwrap();
    says(&fails(folder.path(), 1, "train broken -o x"), &["2.png"]);
    dataset(&at("held"), 3);
    says(&fails(folder.path(), 1, "train held -o x --eval-every 1"), &["--eval-every"]);
    fs::write(at("held/transforms.json"), "{\"frames\": [").unwrap();
    says(&fails(folder.path(), 1, "train held -o x"), &["transforms.json", "line 1"]);
    // A PLY has no cameras to render from; the message says what to do.
    ply::write(at("blobs.ply"), &blobs()).unwrap();
    says(&fails(folder.path(), 1, "render blobs.ply -o x --path input"), &["--path orbit"]);
    says(&fails(folder.path(), 1, "render blobs.ply -o x --path none.json"), &["none.json"]);
    says(&fails(folder.path(), 1, "eval blobs.ply one/transforms.json --device none"), &["none"]);
}

#[test]
fn a_clip_in_which_nothing_moves_becomes_a_static_scene() {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth still -o clip --frames 6 --size 112x63");
    let arguments = "reconstruct clip -o scene.safetensors --steps 60 --max-gaussians 3000 \
                     --report report";
    let report = json(folder.path(), arguments);
    documented("reconstruct", &report);
    documented("reconstruct", &report["poses"]);
    documented("reconstruct", &report["intrinsics"]);
    assert_eq!((&report["control_points"], &report["frames"]), (&0.into(), &6.into()));
    let model = report["model"].as_array().unwrap();
    model.iter().for_each(|choice| documented("reconstruct", choice));
    let motion = model.iter().find(|choice| choice["what"] == "motion").unwrap();
    says(motion["chosen"].as_str().unwrap(), &["no control points"]);
    says(motion["because"].as_str().unwrap(), &["nothing moves"]);
    says(motion["saves"].as_str().unwrap(), &["training"]);
    assert_eq!(report["quality"], "standard");
    // Measured: 19.22 dB.
    assert!(report["psnr_input"].as_f64() > Some(18.2), "{report}");
    for file in ["sheet.png", "report.json", "poses.txt", "intrinsics.json"] {
        assert!(folder.path().join("report").join(file).is_file(), "{file}");
    }
    let found = json(folder.path(), "eval scene.safetensors clip/truth");
    // Measured: errors of 0.1 % of the path, 0.6 % of the focal length and 4 % of the depth; from cameras
    // offset by 8 % of the depth 18.38 dB, SSIM 0.508.
    assert!(found["ate_relative"].as_f64() < Some(0.02), "{found}");
    assert!(found["focal_error"].as_f64() < Some(0.04), "{found}");
    assert!(found["depth_rel_median"].as_f64() < Some(0.1), "{found}");
    let nearest = &found["held_out"][0];
    assert!(nearest["psnr"].as_f64() > Some(18.0), "{found}");
    assert!(nearest["ssim"].as_f64() > Some(0.46), "{found}");
    let path = json(folder.path(), "eval report/poses.txt clip/truth/poses.txt");
    assert!(
        (path["ate_rmse"].as_f64().unwrap() - found["ate_rmse"].as_f64().unwrap()).abs() < 1e-6
    );
}

#[test]
fn a_clip_is_tracked_for_other_programs() {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth rigid -o clip --frames 8 --size 112x63");
    let asked = "track clip/frames -o tracked --queries clip/truth/tracks.npz";
    let report = json(folder.path(), asked);
    documented("track", &report);
    documented("track", &report["poses"]);
    documented("track", &report["intrinsics"]);
    assert_eq!((&report["frames"], &report["exposure"]), (&8.into(), &Value::Null));
    let found = json(folder.path(), "eval tracked/tracks.npz clip/truth/tracks.npz");
    documented("eval", &found);
    documented("eval", &found["tracks"]);
    documented("eval", &found["tracks"]["movers"]);
    let jaccard = |what: &str| found["tracks"][what]["average_jaccard"].as_f64().unwrap();
    eprintln!("average Jaccard {:.3}, movers {:.3}", jaccard("all"), jaccard("movers"));
    assert_eq!(found["tracks"]["all"]["points"], report["tracks"]);
    assert!(jaccard("all") > 0.7 && jaccard("movers") > 0.5, "{found}");
    let text = run(folder.path(), "eval tracked/tracks.npz clip/truth/tracks.npz").stdout;
    says(&String::from_utf8(text).unwrap(), &["movers", "average Jaccard", "occlusion"]);
    // Other programs can train from the folder, as this program does.
    let train = "train tracked -o scene.safetensors --steps 5 --static --eval-every 0";
    assert_eq!(json(folder.path(), train)["images"], 8);
    told_as_colmap(&folder.path().join("tracked"), &report);
    told_on_a_page(&folder.path().join("tracked"), &report);
    // Point tracks from other programs are accepted.
    let also = "track clip -o again --tracks clip/truth/tracks.npz";
    let more = json(folder.path(), also)["poses"]["tracks"].as_u64();
    assert!(more > report["poses"]["tracks"].as_u64(), "{more:?}");
    // A folder that is not empty is not written to.
    says(&fails(folder.path(), 1, asked), &["tracked is not empty"]);
    let wrong = "track clip -o other --tracks clip/truth/poses.txt";
    says(&fails(folder.path(), 1, wrong), &["poses.txt", "is no .npz"]);
    assert!(!folder.path().join("other").exists());
}

/// Checks that the COLMAP model in a folder of `track`, opened as a dataset, agrees with the other files.
fn told_as_colmap(tracked: &Path, report: &Value) {
    let from_json = Dataset::open(tracked.join("transforms.json")).unwrap();
    let from_colmap = colmap::read(tracked, &colmap::find(tracked).unwrap()).unwrap();
    assert_eq!(from_json.frames.len(), from_colmap.frames.len());
    for (a, b) in from_json.frames.iter().zip(&from_colmap.frames) {
        assert_eq!(fs::canonicalize(&a.path).unwrap(), fs::canonicalize(&b.path).unwrap());
        let (k, l) = (a.camera.intrinsics, b.camera.intrinsics);
        assert_eq!((k.width, k.height), (l.width, l.height));
        assert!((k.fx - l.fx).abs() < 1e-9 && (k.cx - l.cx).abs() < 1e-9, "{k:?} {l:?}");
        let [at, there] = [&a.camera, &b.camera].map(|camera| camera.view_from_world);
        assert!(at.translation.abs_diff_eq(there.translation, 1e-9), "{at:?} {there:?}");
        assert!(at.rotation.dot(there.rotation).abs() > 1.0 - 1e-12, "{at:?} {there:?}");
    }
    let landmarks = report["landmarks"].as_u64().unwrap() as usize;
    assert!(landmarks > 300 && from_colmap.points.len() == landmarks, "{landmarks}");
    // An image's observations follow its name: every point has at least three observations.
    let images = fs::metadata(tracked.join("sparse/0/images.bin")).unwrap().len();
    assert!(images as usize > 3 * 24 * landmarks, "{images} bytes");
}

/// Checks that the metrics per frame exist, and a self-contained page that shows them.
fn told_on_a_page(tracked: &Path, report: &Value) {
    let per_frame = report["per_frame"].as_array().unwrap();
    assert_eq!(per_frame.len(), 8);
    documented("track", &per_frame[0]);
    let number = |frame: usize, key: &str| per_frame[frame][key].as_f64();
    assert_eq!((number(0, "position_std"), number(0, "rotation_std_deg")), (Some(0.0), Some(0.0)));
    for frame in 1..8 {
        let [agree, all] = ["inliers", "observations"].map(|key| number(frame, key).unwrap());
        assert!(all > 300.0 && agree > 0.8 * all && agree <= all, "{frame}: {agree} of {all}");
        assert!(number(frame, "rms") < Some(1.0), "{frame}: {per_frame:?}");
        for (key, most) in [("position_std", 0.02), ("rotation_std_deg", 0.3)] {
            let std = number(frame, key).unwrap();
            assert!(std > 1e-7 && std < most, "{frame}: {key} {std}");
        }
    }
    let page = fs::read_to_string(tracked.join("report.html")).unwrap();
    let wanted = ["Doubtful frames", "From above", "Residual", "±", "0007", "data:image/jpeg"];
    let page_lower = page.to_lowercase();
    wanted.iter().for_each(|w| assert!(page_lower.contains(&w.to_lowercase()), "{w}"));
    for elsewhere in ["http:", "https:", "<script", "src=\"/", "NaN", "inf<"] {
        assert!(!page.contains(elsewhere), "{elsewhere}");
    }
    assert!(page.len() < 4 << 20, "{} bytes", page.len());
}

/// In a clip with cuts one shot is tracked; with poses for each frame, the whole clip.
#[test]
fn a_clip_with_cuts_is_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    json(folder.path(), "synth still -o a --frames 8 --size 112x63");
    json(folder.path(), "synth crowd -o b --frames 5 --size 112x63 --seed 1");
    fs::create_dir(at("cut")).unwrap();
    let pictures = |clip: &str| images::list(&at(clip).join("frames")).unwrap();
    for (i, file) in [pictures("b"), pictures("a")].concat().iter().enumerate() {
        fs::copy(file, at("cut").join(format!("{i:02}.png"))).unwrap();
    }
    let report = json(folder.path(), "track cut -o tracked");
    documented("track", &report);
    assert_eq!(report["shots"], serde_json::json!([[0, 4], [5, 12]]));
    assert_eq!((&report["shot"], &report["frames"]), (&1.into(), &8.into()));
    assert_eq!(report["frame_names"][0], "05");
    let note = report["notes"][0].as_str().unwrap();
    says(note, &["2 shots", "0 (frames 0 to 4)", "shot 1, the longest", "by its number"]);
    let said = fails(folder.path(), 1, "reconstruct cut -o x --shot 2");
    says(&said, &["no shot 2", "1 (frames 5 to 12)"]);
    let said = fails(folder.path(), 1, "track cut -o x --shot 0 --poses a/truth/poses.txt");
    says(&said, &["8 poses", "5 frames of the clip's 13", "shot 0 (frames 0 to 4)"]);
    let said = fails(folder.path(), 1, "track cut -o x --poses a/truth/poses.txt");
    says(&said, &["seems to have 2 shots", "8 poses", "13 frames"]);
    let whole = json(folder.path(), "track cut -o given --shot 1 --poses a/truth/poses.txt");
    assert_eq!((&whole["shot"], &whole["frames"]), (&1.into(), &8.into()));
    let one = json(folder.path(), "track a -o one");
    assert_eq!((&one["shot"], &one["shots"]), (&Value::Null, &serde_json::json!([])));
}

#[test]
fn supplied_poses_stay_with_their_frames_when_one_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth still -o clip --frames 8 --size 96x54");
    let residual = |more: &str| {
        let report = json(
            folder.path(),
            &format!(
                "reconstruct clip/frames -o x --poses clip/truth/poses.txt --steps 2 \
                 --max-gaussians 200 {more}"
            ),
        );
        let of_skipped =
            |note: &Value| note.as_str().is_some_and(|note| note.contains("skipped 1 of 8"));
        let told = report["notes"].as_array().unwrap().iter().any(of_skipped);
        assert_eq!(told, !more.is_empty(), "a frame left out is a note: {}", report["notes"]);
        (report["frames"].as_u64(), report["poses"]["reprojection_rms"].as_f64().unwrap())
    };
    let (frames, whole) = residual("");
    assert_eq!(frames, Some(8));
    let frame = images::list(&folder.path().join("clip/frames")).unwrap().swap_remove(3);
    fs::write(frame, "no image").unwrap();
    let (frames, without) = residual("--skip-bad");
    assert_eq!(frames, Some(7));
    // Measured: 0.129 px on the whole clip, 0.127 px without the frame, 0.315 px with all poses after it
    // shifted by one frame.
    assert!(whole < 0.16 && without < 0.16, "{whole} px, {without} px without a frame");
}

#[test]
fn bad_clips_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let reconstruct = |what: &str| fails(folder.path(), 1, &format!("reconstruct {what} -o x"));
    let clip = |name: &str, sizes: &[(u32, u32)]| {
        fs::create_dir(at(name)).unwrap();
        for (i, (width, height)) in sizes.iter().enumerate() {
            let frame = picture(*width, *height, 3 * i as u32);
            write_png(at(name).join(format!("{i}.png")), &frame).unwrap();
        }
    };
    clip("empty", &[]);
    clip("one", &[(48, 32)]);
    clip("odd", &[(48, 32), (48, 32), (50, 32)]);
    clip("broken", &[(48, 32); 4]);
    let whole = fs::read(at("broken/2.png")).unwrap();
    fs::write(at("broken/2.png"), &whole[..whole.len() / 2]).unwrap();
    fs::write(at("noise.mp4"), "no video").unwrap();
    says(&reconstruct("missing"), &["missing"]);
    says(&reconstruct("empty"), &["empty", "no images"]);
    says(&reconstruct("one"), &["one frame only"]);
    says(&reconstruct("odd"), &["2.png", "50×32", "one size"]);
    says(&reconstruct("broken"), &["2.png", "skip_bad"]);
    reconstruct("noise.mp4");
    // Supplied inputs must match the clip.
    clip("fine", &[(48, 32); 4]);
    fs::write(at("poses.txt"), "0 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n").unwrap();
    says(&reconstruct("fine --poses poses.txt"), &["poses.txt", "2 poses", "4 frames"]);
    says(&reconstruct("fine --masks one"), &["one", "1 masks", "4 frames"]);
    says(&reconstruct("fine --flow empty --every 2"), &["--flow", "--every"]);
    fs::write(at("wide.json"), r#"{"focal": 50, "width": 99, "height": 32}"#).unwrap();
    says(&reconstruct("fine --intrinsics wide.json"), &["wide.json", "99×32"]);
    fails(folder.path(), 2, "reconstruct fine -o x --focal 50 --intrinsics wide.json");
    for few in [1, 2] {
        let said = fails(folder.path(), 2, &format!("reconstruct fine -o x --max-frames {few}"));
        says(&said, &["from 3 to"]);
    }
    clip("two", &[(48, 32); 2]);
    says(&reconstruct("two"), &["two", "2 frames only", "3 frames at least"]);
    // After a gap, a list that does not name the frame it leaves out cannot be assigned to frames.
    fs::write(at("poses.txt"), "0 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n2 0 0 2 0 0 0 1\n").unwrap();
    let said = reconstruct("broken --skip-bad --poses poses.txt");
    says(&said, &["poses.txt", "3 poses", "3 frames of the clip's 4", "1 left out"]);
    says(
        &reconstruct("broken --skip-bad --flow empty"),
        &["empty", "1 frames are left out", "--flow"],
    );
    says(&reconstruct("fine --masks broken"), &["2.png", "image"]);
}

/// A large image in a small file is refused before memory runs out; the number of images that are read at
/// a time depends on the available memory.
#[cfg(target_os = "linux")]
#[test]
fn pictures_too_large_for_memory_are_told() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("clip")).unwrap();
    let large = ::image::GrayImage::new(12_000, 12_000);
    large.save(folder.path().join("clip/0.png")).unwrap();
    for i in 1..3 {
        let (from, to) = (folder.path().join("clip/0.png"), format!("clip/{i}.png"));
        fs::hard_link(from, folder.path().join(to)).unwrap();
    }
    let limited = |kibibytes: u64| {
        let limited = format!(
            "ulimit -v {kibibytes}; exec {} reconstruct clip -o x --skip-bad --device software",
            env!("CARGO_BIN_EXE_splat4d")
        );
        let output =
            Command::new("sh").current_dir(folder.path()).args(["-c", &limited]).output().unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        said
    };
    let said = limited(1_800_000);
    says(&said, &[".png: an image of 12000×12000 needs", "B of memory", "are available"]);
    // One image at a time fits, two do not.
    let said = limited(4_000_000);
    says(&said, &["images of 12000×12000 take 2197.3 MiB of memory each while", "no parallax"]);
}

/// Puts an `ffmpeg` that runs a script first on the path.
#[cfg(unix)]
fn with_ffmpeg(folder: &Path, script: &str) -> std::ffi::OsString {
    use std::os::unix::fs::PermissionsExt;
    let own = folder.join("ffmpeg");
    fs::write(&own, format!("#!/bin/sh\n{script}\n")).unwrap();
    fs::set_permissions(&own, fs::Permissions::from_mode(0o755)).unwrap();
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let paths = std::iter::once(folder.to_path_buf()).chain(std::env::split_paths(&paths));
    std::env::join_paths(paths).unwrap()
}

/// Ctrl-C in a terminal reaches every program of the foreground group; ffmpeg's end is then not reported
/// as a failure.
#[cfg(unix)]
#[test]
fn ctrl_c_while_ffmpeg_works() {
    use std::os::unix::process::CommandExt;
    let tools = tempfile::tempdir().unwrap();
    let started = tools.path().join("started");
    let script = format!(
        "case \"$1\" in -version) exit 0;; esac\ntouch {}\nexec sleep 100",
        started.display()
    );
    let path = with_ffmpeg(tools.path(), &script);
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("clip.mp4"), "a video").unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let before = content(folder.path());
    for command in
        ["reconstruct clip.mp4 -o x", "render blobs.ply -o x.mp4 --frames 2 --size 16x16"]
    {
        let child = program()
            .current_dir(folder.path())
            .args(command.split(' '))
            .args(["--device", "software"])
            .env("PATH", &path)
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()
            .unwrap();
        let begun = std::time::Instant::now();
        while !started.exists() && begun.elapsed().as_secs() < 60 {
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        fs::remove_file(&started).unwrap();
        let group = format!("-{}", child.id());
        assert!(Command::new("kill").args(["-INT", "--", &group]).status().unwrap().success());
        let begun = std::time::Instant::now();
        let output = child.wait_with_output().unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(130), "{command}: {said}");
        says(&said, &["interrupted"]);
        assert!(begun.elapsed().as_secs() < 50, "{command}: it was not waited for");
        assert_eq!(content(folder.path()), before, "{command} leaves nothing behind");
    }
}

/// An ffmpeg that exists but does not run is not reported as missing.
#[cfg(unix)]
#[test]
fn an_ffmpeg_that_cannot_run_is_told() {
    let tools = tempfile::tempdir().unwrap();
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let render = |path: std::ffi::OsString| {
        let output = program()
            .current_dir(folder.path())
            .args("render blobs.ply -o x.mp4 --frames 2 --size 16x16".split(' '))
            .env("PATH", path)
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1));
        stderr(&output)
    };
    let said = render(with_ffmpeg(tools.path(), "echo 'no libavcodec' >&2; exit 127"));
    says(&said, &["ffmpeg", "no libavcodec"]);
    fs::write(tools.path().join("ffmpeg"), "").unwrap();
    fs::set_permissions(
        tools.path().join("ffmpeg"),
        std::os::unix::fs::PermissionsExt::from_mode(0o644),
    )
    .unwrap();
    let said = render(tools.path().into());
    says(&said, &["ffmpeg cannot be started", "denied"]);
    assert!(!said.contains("not found"));
}

/// An image that slides by looks like the view of a camera that only rotates; from an image that stays,
/// no scene can be made.
#[test]
fn a_clip_without_parallax_is_a_sphere_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut dice = support::Dice(5);
    let wide: Vec<f32> = (0..200 * 72).map(|_| dice.roll(1000) as f32 / 1000.0).collect();
    let soft = |x: usize, y: usize| {
        let near = |dx: usize, dy: usize| wide[(y + dy) * 200 + x + dx];
        (0..3)
            .flat_map(|dy| (0..3).map(move |dx| (dx, dy)))
            .map(|(dx, dy)| near(dx, dy))
            .sum::<f32>()
            / 9.0
    };
    for (name, slide) in [("slides", 4), ("stays", 0)] {
        fs::create_dir(folder.path().join(name)).unwrap();
        for frame in 0..5 {
            let mut image = splat4d::types::Image::new(96, 64, 3);
            for y in 0..64 {
                for x in 0..96 {
                    image.at_mut(x, y).fill(soft(x as usize + slide * frame, y as usize));
                }
            }
            write_png(folder.path().join(format!("{name}/{frame}.png")), &image).unwrap();
        }
    }
    let said = fails(folder.path(), 1, "reconstruct stays -o x");
    says(&said, &["parallax"]);
    let json = json(folder.path(), "track slides -o x");
    assert_eq!(json["poses"]["turns"], true, "{json}");
}

#[test]
fn damaged_scenes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let truncate = |from: &str, to: &str| {
        let bytes = fs::read(at(from)).unwrap();
        fs::write(at(to), &bytes[..bytes.len() - 10]).unwrap();
    };
    ply::write(at("good.ply"), &blobs()).unwrap();
    truncate("good.ply", "short.ply");
    Scene::of(blobs()).save(at("good.safetensors")).unwrap();
    truncate("good.safetensors", "short.safetensors");
    let mut bytes = fs::read(at("good.safetensors")).unwrap();
    let version = b"\"version\":\"2\"";
    let place = bytes.windows(version.len()).position(|w| w == version).unwrap();
    bytes[place + version.len() - 2] = b'7';
    fs::write(at("newer.safetensors"), &bytes).unwrap();
    for command in ["info FILE", "render FILE -o x", "eval FILE good.ply"] {
        let with = |file: &str| command.replace("FILE", file);
        if !command.starts_with("eval") {
            says(&fails(folder.path(), 1, &with("short.ply")), &["short.ply", "cut off"]);
        }
        fails(folder.path(), 1, &with("short.safetensors"));
        fails(folder.path(), 1, &with("newer.safetensors"));
    }
    says(&fails(folder.path(), 1, "info short.safetensors"), &["short.safetensors"]);
    says(&fails(folder.path(), 1, "info newer.safetensors"), &["newer.safetensors", "version 7"]);
}

#[test]
fn gaussians_that_are_not_finite_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let mut bad = blobs();
    bad.positions[3][1] = f32::NAN;
    bad.opacity_logits[5] = f32::NAN;
    // An opacity of 1, as 8-bit formats have it, is a good one.
    bad.opacity_logits[6] = f32::INFINITY;
    ply::write(folder.path().join("bad.ply"), &bad).unwrap();
    for command in ["info bad.ply", "render bad.ply -o x"] {
        says(&fails(folder.path(), 1, command), &["2 of 9", "drop_bad"]);
    }
    let found = json(folder.path(), "info bad.ply --drop-bad");
    assert_eq!((&found["gaussians"], &found["dropped"]), (&7.into(), &2.into()));
    let found = json(folder.path(), "render bad.ply -o x --drop-bad --frames 1 --size 32x20");
    assert_eq!(found["dropped"], 2);
}

#[test]
fn devices_that_are_not_there() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(folder.path().join("blobs.ply"), &blobs()).unwrap();
    let said = fails(folder.path(), 1, "render blobs.ply -o x --device no-such-card");
    says(&said, &["no-such-card", "there are"]);
    for command in ["devices", "render blobs.ply -o x"] {
        let none = folder.path().join("none.json");
        let output = program()
            .current_dir(folder.path())
            .args(command.split_whitespace())
            .env("VK_DRIVER_FILES", &none)
            .env("VK_ICD_FILENAMES", &none)
            .env_remove("VK_ADD_DRIVER_FILES")
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1));
        says(&stderr(&output), &["mesa-vulkan-drivers"]);
    }
}

#[test]
fn outputs_that_cannot_be_written() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    dataset(&at("data"), 3);
    fs::create_dir(at("dir")).unwrap();
    ply::write(at("file.ply"), &blobs()).unwrap();
    says(&fails(folder.path(), 1, "train data -o dir"), &["dir", "is a folder"]);
    says(&fails(folder.path(), 1, "train data -o file.ply/x"), &["file.ply"]);
    says(&fails(folder.path(), 1, "render file.ply -o file.ply"), &["file.ply", "folder"]);
    says(&fails(folder.path(), 1, "synth rigid -o data --frames 2 --size 16x16"), &["not empty"]);
    if cfg!(target_os = "linux") {
        // Fails before the work if files cannot be created in the folder.
        let said = fails(folder.path(), 1, "train data -o /proc/scene.safetensors");
        says(&said, &["/proc"]);
        // Fails after the work if the disk is full.
        let train = "train data -o /dev/full --steps 1 --random-points 50";
        says(&fails(folder.path(), 1, train), &["/dev/full", "space"]);
    }
}

/// With `--json`, an error is the single object on stdout.
#[test]
fn errors_for_machines() {
    let output = run(Path::new("."), "info missing --json");
    assert_eq!(output.status.code(), Some(1));
    let value: Value = serde_json::from_slice(&output.stdout).unwrap();
    says(value["error"].as_str().unwrap(), &["missing"]);
}

#[cfg(unix)]
#[test]
fn ctrl_c_leaves_nothing_half_written() {
    use std::io::{BufRead, BufReader};
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("data"), 3);
    let before = content(folder.path());
    let mut child = program()
        .current_dir(folder.path())
        .args("train data -o x --steps 1000000 --random-points 50 --device software".split(' '))
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    lines.find(|line| line.as_ref().unwrap().contains("to begin with")).unwrap().unwrap();
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let said: Vec<String> = lines.map(Result::unwrap).collect();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{said:?}");
    assert!(said.iter().any(|line| line.contains("interrupted")), "{said:?}");
    assert_eq!(content(folder.path()), before);
}

#[cfg(unix)]
#[test]
fn what_was_interrupted_is_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let train = "train clip/truth --steps 600 --random-points 400 --sh-degree 0 --eval-every 0 \
                 --control-points 12";
    let reconstruct = "reconstruct clip --steps 500 --max-gaussians 2000";
    json(folder.path(), "synth still -o clip --frames 6 --size 112x63");
    for command in [train, reconstruct] {
        // Writes as many checkpoints as possible, and sends Ctrl-C as soon as one of the training exists.
        let kept = folder.path().join("part.checkpoint/training");
        let mut child = program()
            .current_dir(folder.path())
            .args(format!("{command} -o part --checkpoint-every 1e-9").split_whitespace())
            .args(["--device", "software"])
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        while !kept.exists() {
            assert!(child.try_wait().unwrap().is_none(), "it ended without a checkpoint");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        let pid = child.id().to_string();
        assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
        let output = child.wait_with_output().unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(130), "{said}");
        says(&said, &["interrupted", "--resume", "part.checkpoint"]);
        assert!(!folder.path().join("part").exists());

        // Another command refuses the checkpoint, and damage is detected; neither changes it.
        let other = command.replace("--steps ", "--steps 1");
        let said = fails(folder.path(), 1, &format!("{other} -o part --resume --device software"));
        says(&said, &["part.checkpoint", "--steps was", "without resuming"]);
        let message = said.lines().last().unwrap();
        assert!(message.len() < 200, "only what has changed: {message}");
        let other = format!("{command} -o part --resume --device software --seed 7");
        says(&fails(folder.path(), 1, &other), &["--seed was 0 and is 7"]);
        let good = fs::read(&kept).unwrap();
        fs::write(&kept, &good[..good.len() / 2]).unwrap();
        let said =
            fails(folder.path(), 1, &format!("{command} -o part --resume --device software"));
        says(&said, &["part.checkpoint", "damaged or cut off"]);
        fs::write(&kept, &good).unwrap();

        json(folder.path(), &format!("{command} -o part --resume"));
        json(folder.path(), &format!("{command} -o whole --checkpoint-every 0"));
        assert!(!folder.path().join("part.checkpoint").exists());
        assert!(!folder.path().join("whole.checkpoint").exists());
        let open = |name| Scene::open(folder.path().join(name), false).unwrap().scene;
        let (part, whole) = (open("part"), open("whole"));
        assert!(part.gaussians == whole.gaussians, "{command}");
        assert_eq!((part.network, part.cameras), (whole.network, whole.cameras));
        let bytes = |name| fs::read(folder.path().join(name)).unwrap();
        assert!(bytes("part") == bytes("whole"), "{command}: the whole files are equal");
        fs::remove_file(folder.path().join("part")).unwrap();
    }
    // A script may always pass --resume: without a checkpoint it starts anew.
    let fresh = "train clip/truth -o fresh --steps 3 --random-points 50 --resume --device software";
    let output = run(folder.path(), fresh);
    assert!(output.status.success());
    says(&stderr(&output), &["fresh.checkpoint", "beginning anew"]);
}

/// File content counts, not file paths: a run resumes only with the same images, poses, masks, depth and
/// flow.
#[cfg(unix)]
#[test]
fn a_changed_input_is_not_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    json(folder.path(), "synth rigid -o clip --frames 5 --size 64x48");
    let command = "reconstruct clip/frames -o x --steps 100000 --max-gaussians 200 \
                   --poses clip/truth/poses.txt --masks clip/truth/masks --depth clip/truth/depth \
                   --flow clip/truth";
    let mut child = program()
        .current_dir(folder.path())
        .args(format!("{command} --checkpoint-every 1e-9").split_whitespace())
        .args(["--device", "software"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    while !at("x.checkpoint/training").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended without a checkpoint");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    let checkpoint = content(&at("x.checkpoint"));
    for (input, changed) in [
        ("the frames", "clip/frames"),
        ("--masks", "clip/truth/masks"),
        ("--depth", "clip/truth/depth"),
        ("--flow", "clip/truth/flow_forward"),
        ("--poses", "clip/truth/poses.txt"),
    ] {
        let (file, other) = match at(changed).is_file() {
            // The last frame gets the pose of the one before it.
            true => {
                let text = fs::read_to_string(at(changed)).unwrap();
                let [.., before, last] = text.lines().collect::<Vec<_>>()[..] else { panic!() };
                let (_, pose) = before.split_once(' ').unwrap();
                let (time, _) = last.split_once(' ').unwrap();
                (at(changed), text.replace(last, &format!("{time} {pose}")).into_bytes())
            }
            // The first frame's file gets another frame's content.
            false => {
                let entries = fs::read_dir(at(changed)).unwrap();
                let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
                files.sort();
                (files[0].clone(), fs::read(&files[2]).unwrap())
            }
        };
        let good = fs::read(&file).unwrap();
        assert!(good != other, "{input}: nothing is changed");
        fs::write(&file, other).unwrap();
        let resume = format!("{command} --resume --device software");
        let said = fails(folder.path(), 1, &resume);
        says(&said, &["x.checkpoint", input, "checksum"]);
        assert_eq!(content(&at("x.checkpoint")), checkpoint, "{input}: the checkpoint stays");
        fs::write(&file, good).unwrap();
    }
}

/// A run that is killed repeatedly, soon after each first checkpoint, in the tracking and in trainings of
/// a few steps, still finishes, with the same result.
#[cfg(unix)]
#[test]
fn what_is_killed_again_and_again_ends() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let command = "reconstruct clip --steps 40 --max-gaussians 1500 --control-points 16";
    json(folder.path(), "synth rigid -o clip --frames 6 --size 96x54");
    json(folder.path(), &format!("{command} -o whole --checkpoint-every 0"));
    let times = |folder: &Path| -> Vec<_> {
        content(folder).iter().filter_map(|p| fs::metadata(p).ok()?.modified().ok()).collect()
    };
    let training = || at("part.checkpoint").join("training").exists();
    let mut kept = BTreeSet::new();
    let mut killed = 0u64;
    let mut killed_in_training = 0u64;
    loop {
        let before =
            if at("part.checkpoint").exists() { times(&at("part.checkpoint")) } else { vec![] };
        let mut child = program()
            .current_dir(folder.path())
            .args(format!("{command} -o part --resume --checkpoint-every 0.1").split_whitespace())
            .args(["--device", "software"])
            .stderr(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let mut put_away = None;
        let ended = loop {
            std::thread::sleep(std::time::Duration::from_millis(20));
            // The run may have finished.
            if let Some(status) = child.try_wait().unwrap() {
                break Some(status);
            }
            if put_away.is_none()
                && at("part.checkpoint").exists()
                && times(&at("part.checkpoint")) != before
            {
                put_away = Some(std::time::Instant::now());
            }
            // On a busy machine the next part takes longer and comes in a later run. A training of so few
            // steps ends soon, so it is killed as soon as its first checkpoint exists.
            let pause = if training() { 20 * killed_in_training } else { 300 + 20 * killed };
            if put_away.is_some_and(|at| at.elapsed().as_millis() >= u128::from(pause)) {
                break None;
            }
        };
        if let Some(status) = ended {
            assert!(status.success(), "{status}");
            break;
        }
        // `kill` sends SIGKILL.
        child.kill().unwrap();
        child.wait().unwrap();
        killed += 1;
        assert!(killed < 200, "it never ends");
        for part in ["tracking", "training"] {
            if at("part.checkpoint").join(part).exists() {
                kept.insert(part);
            }
        }
        killed_in_training += u64::from(training());
    }
    assert!(killed >= 3 && kept.len() == 2, "killed {killed} times, with {kept:?}");
    assert!(!at("part.checkpoint").exists());
    let open = |name| Scene::open(at(name), false).unwrap().scene;
    let (part, whole) = (open("part"), open("whole"));
    assert!(part.gaussians == whole.gaussians && part.control_points == whole.control_points);
    assert_eq!((part.network, part.cameras), (whole.network, whole.cameras));
}

#[test]
fn a_real_dataset_goes_through() {
    let Some(fox) = support::shared("fox270") else { return };
    let folder = tempfile::tempdir().unwrap();
    let train = "-o fox.safetensors --steps 3 --size 60 --max-gaussians 500 --eval-every 20";
    let report = json(folder.path(), &format!("train {} {train}", fox.display()));
    assert_eq!(report["gaussians"], 500, "its points, thinned");
    assert!(report["held_out"].as_u64() >= Some(2));
    let found = json(folder.path(), "render fox.safetensors -o views --path orbit --frames 2");
    assert_eq!(found["frames"], 2);
}
