//! `splat4d ablate` on a small synthetic clip.

#![cfg(feature = "cli")]

#[path = "support/program.rs"]
mod program;
mod support;

use std::fs;
use std::path::Path;

use program::{fails, json, run};
use serde_json::Value;
use support::says;

#[track_caller]
fn documented(help: &str, given: &Value) {
    for key in given.as_object().unwrap().keys() {
        assert!(help.contains(key.as_str()), "ablate --help does not name `{key}`");
    }
}

#[test]
fn components_are_left_out_one_at_a_time() {
    let folder = tempfile::tempdir().unwrap();
    json(folder.path(), "synth rigid -o clip --frames 6 --size 96x54 --seed 1");
    let found = json(
        folder.path(),
        "ablate clip --only motion,lifting --seeds 2 --steps 20 --max-gaussians 600 --report out",
    );
    let help = run(Path::new("."), "ablate --help").stdout;
    let help = String::from_utf8(help).unwrap();
    documented(&help, &found);
    let rows = found["rows"].as_array().unwrap();
    rows.iter().for_each(|row| documented(&help, row));
    let names: Vec<&str> = rows.iter().filter_map(|row| row["component"].as_str()).collect();
    assert_eq!(names, ["full", "motion", "lifting"]);
    let figure = |row: usize, key: &str, what: &str| {
        let value = rows[row]["summary"][key][what].as_f64();
        value.unwrap_or_else(|| panic!("row {row} has no {what} of {key}: {found}"))
    };
    for row in 0..3 {
        assert_eq!(rows[row]["runs"].as_array().unwrap().len(), 2, "a run for each seed");
        for key in ["input_psnr", "input_movers_psnr", "held_out_1_psnr"] {
            let (median, worst) = (figure(row, key, "median"), figure(row, key, "worst"));
            assert!((5.0..60.0).contains(&median) && worst <= median, "{row} {key} {found}");
        }
        assert!(figure(row, "seconds_train", "worst") >= figure(row, "seconds_train", "median"));
        assert!(figure(row, "peak_bytes", "median") > 1e5);
        assert!(figure(row, "gaussians", "worst") <= 600.0);
    }
    // Each switch has the effect that it names.
    assert_eq!(figure(0, "input_psnr", "change"), 0.0);
    assert!(figure(0, "control_points", "median") > 0.0);
    assert_eq!(figure(1, "control_points", "median"), 0.0);
    assert!(figure(1, "input_movers_psnr", "change") < 0.0, "{found}");
    assert_eq!(figure(1, "seconds_track", "change"), 0.0, "the track is shared");
    assert_ne!(figure(2, "held_out_1_psnr", "change"), 0.0, "{found}");
    assert_ne!(rows[0]["runs"][0], rows[0]["runs"][1], "seeds differ");

    let table = fs::read_to_string(folder.path().join("out/ablation.csv")).unwrap();
    says(&table, &["component,without,figure,seed,value", "lifting,", ",input_movers_psnr,1,"]);
    let page = fs::read_to_string(folder.path().join("out/index.html")).unwrap();
    says(&page, &["<svg", "lifting", "PSNR (dB) inside movers, input"]);
}

#[test]
fn what_cannot_be_ablated_is_told() {
    let folder = tempfile::tempdir().unwrap();
    says(&fails(folder.path(), 1, "ablate missing"), &["missing"]);
    says(&fails(folder.path(), 2, "ablate clip --only motion,magic"), &["magic", "lifting"]);
    fails(folder.path(), 2, "ablate clip --seeds 0");
    json(folder.path(), "synth rigid -o clip --frames 3 --size 32x18");
    fs::write(folder.path().join("file"), "x").unwrap();
    says(&fails(folder.path(), 1, "ablate clip --report file"), &["file", "folder"]);
}
