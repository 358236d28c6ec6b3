//! The command line under test, and small inputs for it.

// Each test binary uses its own part.
#![allow(dead_code)]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use glam::DVec3;
use serde_json::Value;
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::data::write_png;
use splat4d::geometry::look_at;
use splat4d::types::{Camera, Gaussians, Intrinsics};

use crate::support::picture;

/// The program, on the device under test.
pub fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat4d"));
    command.stdin(Stdio::null());
    command
}

/// Runs the program in a folder, with arguments separated by spaces.
pub fn run(folder: &Path, arguments: &str) -> Output {
    program().current_dir(folder).args(arguments.split_whitespace()).output().unwrap()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Runs the program with `--json` and returns the single object on stdout.
#[track_caller]
pub fn json(folder: &Path, arguments: &str) -> Value {
    let device = std::env::var("SPLAT4D_DEVICE").unwrap_or("software".into());
    let output = run(folder, &format!("{arguments} --json --device {device}"));
    assert!(output.status.success(), "{arguments}: {}", stderr(&output));
    let value: Value = serde_json::from_slice(&output.stdout).expect("one JSON value on stdout");
    assert!(value.is_object());
    value
}

/// Runs a command that must fail with exit code `code`, and returns its message. The command must leave
/// the folder's list of files unchanged.
#[track_caller]
pub fn fails(folder: &Path, code: i32, arguments: &str) -> String {
    let before = content(folder);
    let output = run(folder, arguments);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{arguments}: {said}");
    assert!(output.stdout.is_empty(), "{arguments}: nothing on stdout");
    assert!(said.contains("error: "), "{arguments}: {said}");
    assert_eq!(content(folder), before, "{arguments} leaves nothing behind");
    said
}

/// Every file below a folder.
pub fn content(folder: &Path) -> BTreeSet<PathBuf> {
    let mut found = BTreeSet::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(content(&path));
        }
        found.insert(path);
    }
    found
}

/// A few Gaussians in front of a camera at the origin that looks along z.
pub fn blobs() -> Gaussians {
    let positions: Vec<[f32; 3]> =
        (0..9).map(|i| [(i % 3) as f32 - 1.0, (i / 3) as f32 - 1.0, 4.0]).collect();
    let n = positions.len();
    Gaussians {
        log_scales: vec![[-1.5, -1.2, -1.0]; n],
        rotations: vec![[0.9, 0.1, 0.3, -0.2]; n],
        opacity_logits: vec![1.0; n],
        sh_degree: 0,
        sh: (0..n).map(|i| [i as f32 * 0.2 - 1.0, 0.7, 1.0 - i as f32 * 0.3]).collect(),
        motion_logits: Vec::new(),
        positions,
    }
}

pub fn cameras(count: usize) -> Vec<TimedCamera> {
    (0..count)
        .map(|i| TimedCamera {
            time: i as f64 / (count - 1).max(1) as f64,
            camera: Camera {
                intrinsics: Intrinsics::centred(40.0, 48, 32),
                view_from_world: look_at(
                    DVec3::new(0.4 * i as f64 - 0.5, 0.2, 0.0),
                    DVec3::new(0.0, 0.0, 4.0),
                    DVec3::NEG_Y,
                ),
            },
        })
        .collect()
}

/// Copies the files of a folder, and of the folders in it.
pub fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let to = to.join(path.file_name().unwrap());
        match path.is_dir() {
            true => copy(&path, &to),
            false => assert!(fs::copy(&path, &to).is_ok()),
        }
    }
}

/// Writes a dataset into a folder: `pictures` images and their cameras.
pub fn dataset(folder: &Path, pictures: usize) {
    let names: Vec<String> = (0..pictures).map(|i| format!("{i}.png")).collect();
    for (i, name) in names.iter().enumerate() {
        write_png(folder.join(name), &picture(48, 32, i as u32)).unwrap();
    }
    transforms::write(folder.join("transforms.json"), &cameras(pictures), &names, None).unwrap();
}
