//! Trajectory errors, compared with those that the `evo` package computes from the same files.
//!
//! `tools/setup.sh test` installs evo beside the build directory.

#[path = "support/python.rs"]
mod python;
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};

use python::answer;
use support::shared;

/// Largest difference allowed, absolute or relative.
const BOUND: f64 = 1e-9;
const ERRORS: [&str; 4] = ["ape_trans", "ape_rot_deg", "rpe_trans", "rpe_rot_deg"];

/// A case: two files and how they are compared; `fields` override the default fields.
fn case(name: &str, [estimate, reference]: &[Source; 2], fields: Value) -> Value {
    let mut case = json!({
        "align": "sim3", "align_first": 0, "max_time_diff": 0.01, "time_offset": 0.0,
        "rpe_delta": 1.0, "rpe_unit": "frames", "rpe_tolerance": 0.1, "rpe_all_pairs": false,
        "rpe_along_reference": false,
        "name": format!("{name} {fields}"),
        "estimate": estimate.path, "estimate_format": estimate.format,
        "reference": reference.path, "reference_format": reference.format,
        "timed": estimate.format != "kitti",
    });
    let fields = fields.as_object().unwrap().clone();
    case.as_object_mut().unwrap().extend(fields);
    case
}

/// A file, and evo's name of its format.
struct Source {
    path: PathBuf,
    format: &'static str,
}

/// Writes a trajectory of a rotating camera with `poses` poses, with errors of size `wrong`, in each
/// format.
fn written(folder: &Path, name: &str, poses: usize, wrong: f64) -> [Source; 3] {
    let mut text = [const { String::new() }; 3];
    text[2] =
        "#timestamp [ns], p_RS_R_x [m], p_y, p_z, q_RS_w [], q_x, q_y, q_z, v_x [m s^-1]\n".into();
    for i in 0..poses {
        let t = i as f64 * 0.1;
        let p = DVec3::new(3.0 * (0.7 * t).sin(), 2.0 * (0.4 * t).cos(), 0.5 * t)
            + wrong * DVec3::new((9.0 * t).sin(), (7.0 * t).cos(), (5.0 * t).sin());
        let turn = DVec3::new(0.2 + 0.3 * t.sin(), 0.1 + 0.2 * t, 0.1 + wrong * (4.0 * t).cos());
        let q = DQuat::from_scaled_axis(turn);
        let seconds = 1_403_636_579.763_555_5 + t + 0.02 * wrong;
        let ns = 1_403_636_579_763_555_584 + (i as i64) * 100_000_000;
        let (x, y, z) = (p.x, p.y, p.z);
        text[0] += &format!("{seconds} {x} {y} {z} {} {} {} {}\n", q.x, q.y, q.z, q.w);
        // With seven decimals the matrix is not exactly a rotation, as in real files of this format.
        let m = DMat3::from_quat(q);
        let row = |r: usize, last: f64| {
            let [a, b, c] = m.row(r).to_array();
            format!("{a:.7} {b:.7} {c:.7} {last:.7}")
        };
        text[1] += &format!("{} {} {}\n", row(0, x), row(1, y), row(2, z));
        text[2] += &format!("{ns},{x},{y},{z},{},{},{},{},0.5\n", q.w, q.x, q.y, q.z);
    }
    let files = ["tum", "kitti", "euroc"].into_iter().zip(text).map(|(format, text)| {
        let path = folder.join(format!("{name}.{format}"));
        fs::write(&path, text).unwrap();
        Source { path, format }
    });
    files.collect::<Vec<Source>>().try_into().ok().unwrap()
}

fn by_us(case: &Value) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat4d"));
    command.arg("eval").arg("--json");
    command.args(["estimate", "reference"].map(|key| case[key].as_str().unwrap()));
    let mut option = |key: &str| {
        let value = case[key].as_str().map_or_else(|| case[key].to_string(), str::to_owned);
        command.arg(format!("--{}={value}", key.replace('_', "-")));
    };
    for key in ["align", "align_first", "max_time_diff", "time_offset", "rpe_delta", "rpe_unit"] {
        option(key);
    }
    if case["rpe_all_pairs"] == true {
        option("rpe_tolerance");
        command.arg("--rpe-all-pairs");
    }
    if case["rpe_along_reference"] == true {
        command.arg("--rpe-along-reference");
    }
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}: {said}", case["name"]);
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Checks that all statistics of all errors agree within [`BOUND`].
fn same(case: &Value, ours: &Value, theirs: &Value) {
    let name = &case["name"];
    assert_eq!(ours["poses"], theirs["poses"], "{name}: paired poses");
    for error in ERRORS {
        let (ours, theirs) = (&ours[error], &theirs[error]);
        assert_eq!(ours.is_null(), theirs.is_null(), "{name}: {error}: {ours}, evo {theirs}");
        for (key, theirs) in theirs.as_object().into_iter().flatten() {
            let (ours, theirs) = (ours[key].as_f64().unwrap(), theirs.as_f64().unwrap());
            let off = (ours - theirs).abs();
            assert!(
                off <= BOUND || off <= BOUND * theirs.abs(),
                "{name}: {error} {key} is {ours}, evo's is {theirs}"
            );
        }
    }
}

#[test]
fn errors_of_trajectories_equal_evos() {
    let folder = tempfile::tempdir().unwrap();
    let estimate = written(folder.path(), "estimate", 60, 0.03);
    let reference = written(folder.path(), "reference", 67, 0.0);
    let short = written(folder.path(), "short", 60, 0.0);
    let [tum, _, euroc] = estimate;
    let [tum_reference, _, euroc_reference] = reference;
    let [.., kitti, _] = written(folder.path(), "kitti", 60, 0.02);
    let [_, kitti_reference, _] = short;
    let aligns = ["none", "origin", "scale", "se3", "sim3"];
    let mut cases = Vec::new();
    for (name, pair) in [
        ("TUM", [tum, tum_reference]),
        ("KITTI", [kitti, kitti_reference]),
        ("EuRoC", [euroc, euroc_reference]),
    ] {
        cases.extend(aligns.map(|align| case(name, &pair, json!({ "align": align }))));
        cases.extend(
            [
                json!({ "align_first": 9, "align": "se3" }),
                json!({ "rpe_delta": 7.0 }),
                json!({ "rpe_delta": 7.0, "rpe_all_pairs": true }),
                json!({ "rpe_delta": 1.0, "rpe_unit": "metres" }),
                json!({ "rpe_delta": 1.0, "rpe_unit": "metres", "rpe_along_reference": true }),
                json!({ "rpe_delta": 1.0, "rpe_unit": "metres", "rpe_all_pairs": true }),
                json!({ "rpe_delta": 12.0, "rpe_unit": "degrees" }),
                json!({ "rpe_delta": 12.0, "rpe_unit": "degrees", "rpe_along_reference": true }),
                json!({ "rpe_delta": 1e6 }),
                json!({ "max_time_diff": 0.04, "time_offset": 0.03 }),
                json!({ "max_time_diff": 0.04, "time_offset": -0.13 }),
            ]
            .map(|fields| case(name, &pair, fields)),
        );
    }
    let real = |format, estimate: &str, reference: &str| -> Option<[Source; 2]> {
        let source = |name: &str| {
            shared(&format!("evo_traj/{name}.txt")).map(|path| Source { path, format })
        };
        Some([source(estimate)?, source(reference)?])
    };
    if let Some(pair) = real("kitti", "KITTI_00_ORB", "KITTI_00_gt") {
        cases.push(case("KITTI 00", &pair, json!({ "align": "se3" })));
        let metres = json!({ "rpe_delta": 100.0, "rpe_unit": "metres", "rpe_all_pairs": true });
        cases.push(case("KITTI 00", &pair, metres));
    }
    for (estimate, reference) in [
        ("fr2_desk_ORB_kf_mono", "fr2_desk_groundtruth"),
        ("freiburg1_xyz-ORB_kf_mono", "freiburg1_xyz-groundtruth"),
        ("freiburg1_xyz-rgbdslam_drift", "freiburg1_xyz-groundtruth"),
    ] {
        if let Some(pair) = real("tum", estimate, reference) {
            let case = |align: &str| case(estimate, &pair, json!({ "align": align }));
            cases.extend(["none", "se3", "sim3"].map(case));
        }
    }
    // All cases at once: evo's start takes longer than most of them.
    let theirs = answer("evo", "import evo.main_rpe", "by_evo.py", &json!(cases));
    let theirs = theirs.as_array().unwrap();
    assert_eq!(theirs.len(), cases.len());
    for (case, theirs) in cases.iter().zip(theirs) {
        let ours = by_us(case);
        same(case, &ours, theirs);
        let published = match case["name"].as_str().unwrap() {
            "KITTI 00 {\"align\":\"se3\"}" => 1.3034497145650266,
            name if name.starts_with("KITTI 00") && name.contains("metres") => 0.9377090736114027,
            _ => continue,
        };
        assert!((ours["ate_rmse"].as_f64().unwrap() - published).abs() < BOUND, "{ours}");
    }
}
