//! The benchmark: rows verify their results, a wrong result gets no time, and the budget is met on an
//! unseen view. No test here depends on how long anything takes.

#![cfg(feature = "cli")]

mod common;

use serde_json::Value;
use splat4d::bench::{self, Budget, Entry, ErrorMeasure, Job, Pace};
use splat4d::gpu::{Buffer, Device, Recorder};
use splat4d::ops::scan::{Scan, ScanArgs};
use splat4d::oracle::scan::exclusive;
use splat4d::report::{Accuracy, Curve, CurvePoint, Measurements, Place, Verdict, Work, compare};
use splat4d::scene::ply;
use splat4d::types::Tuning;
use splat4d::vk::Limits;
use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

/// The fewest repetitions that give a spread.
const PACE: Pace = Pace { total: Duration::ZERO, least: 5, most: 5 };

#[test]
fn every_row_verifies_and_has_a_time() {
    let device = common::device();
    let entries = bench::entries(true);
    let rows = bench::run(&device, &entries, None, PACE, 3, |_| Ok(())).unwrap();
    assert_eq!(rows.len(), entries.len());
    let mut failures = Vec::new();
    for row in &rows {
        println!(
            "{}: {:.3} of the bound in {}",
            row.name(),
            row.accuracy.of_bound,
            row.accuracy.output
        );
        if row.time().is_none() || row.accuracy.output == "nothing compared" {
            failures.push(format!("{}: {:?}", row.name(), row.accuracy));
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
    let peaks = bench::peaks(&rows);
    assert!(peaks.bytes.is_some_and(|b| b > 0.0) && peaks.operations.is_some_and(|o| o > 0.0));
    common::assert_valid(&device);
}

#[test]
fn full_rows_have_names_of_their_own() {
    for quick in [true, false] {
        let mut names: Vec<String> =
            bench::entries(quick).iter().map(|e| format!("{}, {}", e.id, e.size)).collect();
        let all = names.len();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), all, "two rows of one name");
    }
    let families = [
        "scan", "sort", "project", "bin", "raster", "loss", "deform", "mlp", "arap", "adam",
        "density", "pipeline", "roofline", "render",
    ];
    for family in families {
        let sizes = bench::entries(false).iter().filter(|e| e.id.starts_with(family)).count();
        assert!(sizes >= 2, "{family}: {sizes}");
    }
}

/// A device scan of values of which one is wrong, compared with the oracle on the right ones.
fn planted(device: &Device, wrong: u32) -> splat4d::Result<Job> {
    let right: Vec<u32> = (0..1000).collect();
    let mut values = right.clone();
    values[7] += wrong;
    let (count, input) = (device.upload("count", &[1000u32])?, device.upload("values", &values)?);
    let (mut prefix, mut total) = (device.buffer("prefix", 1000)?, device.buffer("total", 1)?);
    let (op, mut stream) = (Scan::plan(device, 1000)?, device.stream()?);
    let mut scratch = op.scratch(device)?;
    let mut record = move |recorder: &mut Recorder, prefix: &mut Buffer<u32>| {
        let args = ScanArgs {
            count: count.view(),
            count_at: 0,
            values: input.view(),
            prefix: prefix.view_mut(),
            total: total.view_mut(),
            total_at: 0,
        };
        op.record(recorder, args, &mut scratch)
    };
    let mut recorder = stream.record()?;
    record(&mut recorder, &mut prefix)?;
    stream.submit(recorder)?;
    let same = stream.download(&prefix)? == exclusive(&right);
    let of_bound = if same { 0.0 } else { f64::INFINITY };
    let accuracy = Accuracy { of_bound, error: of_bound, output: "prefix".into() };
    let work = Work { bytes: 8000, operations: 1000 };
    Job::recorded(device, accuracy, work, move |recorder| record(recorder, &mut prefix))
}

#[test]
fn a_wrong_result_has_no_speed() {
    let device = common::device();
    let sound = Entry::new("scan/exclusive", "sound", |device, _| planted(device, 0));
    let row = bench::measure(&device, &sound, PACE, 0).unwrap();
    assert!(row.time().is_some() && row.bandwidth().is_some(), "{row:?}");
    let wrong = Entry::new("scan/exclusive", "planted", |device, _| planted(device, 1));
    let broken = Entry::new("scan/exclusive", "cannot run", |_, _| {
        Err(splat4d::Error::Input("no such scan".into()))
    });
    let late = Entry::new("scan/exclusive", "fails when timed", |_, _| {
        Ok(Job {
            accuracy: Accuracy { of_bound: 0.0, error: 0.0, output: "prefix".into() },
            work: Work::default(),
            place: Place::Device,
            reset: None,
            execute: Box::new(|| Err(splat4d::Error::Failed("it broke".into()))),
        })
    });
    for (entry, says) in [(wrong, "prefix"), (broken, "no such scan"), (late, "it broke")] {
        let row = bench::measure(&device, &entry, PACE, 0).unwrap();
        assert_eq!(row.time(), None, "{row:?}");
        assert_eq!((row.bandwidth(), row.throughput()), (None, None));
        assert!(row.accuracy.output.contains(says), "{row:?}");
        assert!(!row.accuracy.passed());
    }
    assert!(device.stop_meter().is_none(), "a failure leaves no meter running");
}

#[test]
fn a_run_compares_with_itself() {
    let device = common::device();
    let entries = bench::entries(true);
    let mut measured = Measurements::new(bench::machine(&device), bench::commit());
    measured.rows = bench::run(&device, &entries, Some("sort/"), PACE, 0, |_| Ok(())).unwrap();
    let names: Vec<&str> = measured.rows.iter().map(|row| row.id.as_str()).collect();
    let sorts =
        ["roofline/copy", "roofline/fma", "sort/pairs", "sort/radsort", "sort/sort_unstable"];
    assert_eq!(names, sorts, "what was asked for, and the peaks");
    let folder = tempfile::tempdir().unwrap();
    measured.write_report(folder.path()).unwrap();
    let read = Measurements::open(folder.path().join("bench.json")).unwrap();
    assert_eq!(read, measured);
    let all = compare(&measured, &read);
    assert!(all.iter().all(|c| c.verdict == Verdict::Noise && c.ratio == Some(1.0)), "{all:#?}");
    for file in ["index.html", "bench.csv"] {
        assert!(std::fs::metadata(folder.path().join(file)).unwrap().len() > 100);
    }
}

/// A profile's kernels are those of the op, and their times add up to no more than the whole.
#[test]
fn a_profile_takes_a_row_apart() {
    let device = common::device();
    let entries = bench::entries(true);
    let find = |id: &str| entries.iter().find(|entry| entry.id == id).unwrap();
    let profile = bench::profile(&device, find("sort/pairs"), PACE, 0).unwrap().unwrap();
    println!("{profile:#?}");
    assert_eq!(profile.executions, PACE.least);
    let count = |kernel: &str| {
        profile.kernels.iter().find(|k| k.kernel == kernel).map_or(0, |k| k.dispatches)
    };
    assert_eq!((count("sort/scatter"), count("raster/forward")), (4, 0));
    let sum: f64 = profile.kernels.iter().map(|k| k.time).sum();
    assert!(sum > 0.0 && sum <= 1.1 * profile.device && profile.device <= profile.wall);
    assert!(profile.kernels.is_sorted_by(|a, b| a.time >= b.time), "the dearest first");
    assert!((profile.kernels.iter().map(|k| k.share).sum::<f64>() - 1.0).abs() < 1e-9);
    assert!(bench::profile(&device, find("sort/radsort"), PACE, 0).unwrap().is_none());
    common::assert_valid(&device);
}

/// Every setting is in the sweep, has no error at its best value, and increasing errors beyond.
#[test]
fn curves_have_times_and_memory_and_say_what_is_left_out() {
    let device = common::device();
    let mut heard = 0;
    let hour = Duration::from_secs(3600);
    let mut each = |_: &Curve, point: &CurvePoint| {
        heard += 1;
        assert_eq!(point.left_out, None);
        Ok(())
    };
    let curves = bench::curves(&device, 3, true, hour, &mut each).unwrap();
    assert_eq!(heard, curves.iter().map(|curve| curve.points.len()).sum::<usize>());
    let axes: BTreeSet<&str> = curves.iter().map(|curve| curve.axis.as_str()).collect();
    assert_eq!(axes, ["Gaussians", "control points", "frames", "pixels"].into());
    for curve in &curves {
        assert!(curve.accuracy.passed(), "{}: {:?}", curve.pipeline, curve.accuracy);
        assert_eq!(curve.times().len(), curve.points.len());
        assert!(curve.memory_law().unwrap().exponent >= 0.0);
        for point in &curve.points {
            assert!(!point.kernels.is_empty());
            // The images may need more tiles than predicted, never fewer.
            let (foreseen, taken) = (point.foreseen.unwrap() as f64, point.taken.unwrap() as f64);
            assert!(taken > 0.9 * foreseen, "{}: {taken} of {foreseen}", curve.pipeline);
        }
    }
    // Without a time budget only the first point of each curve is measured; with small bindings, none.
    let small = device.with_limits(Limits { storage_range: 3 << 19, ..*device.limits() });
    let curves = bench::curves(&small, 3, true, Duration::ZERO, &mut |_, _| Ok(())).unwrap();
    let why = |text: &str| {
        let all = curves.iter().flat_map(|curve| &curve.points);
        all.filter(|p| p.left_out.as_ref().is_some_and(|why| why.contains(text))).count()
    };
    assert!(why("does not fit") > 0 && why("are left") > 0, "{curves:?}");
    common::assert_valid(&device);
}

#[test]
fn knobs_cost_accuracy() {
    let device = common::device();
    let (scene, shots) = bench::still_scene(5, 2000, 120, 68);
    let sweep = bench::sweep(&device, "still", &scene, &shots, PACE, &mut |_| Ok(())).unwrap();
    let worst = |knob: &str| {
        let of = sweep.points.iter().filter(|p| p.knob == knob).map(|p| p.error.rmse);
        of.reduce(f64::max).unwrap_or_else(|| panic!("{knob} is not swept"))
    };
    let best = worst("");
    println!("best {best:e}");
    assert!(best < 1e-4, "{best:e}");
    for knob in ["α cut", "T stop", "depth bits", "half-packed SH", "SH degree"] {
        println!("{knob} {:e}", worst(knob));
        assert!(worst(knob) > 1.5 * best, "{knob}: {:e}", worst(knob));
        assert!(worst(knob) < 0.5, "{knob} breaks the image: {:e}", worst(knob));
    }
    // Another division of the work changes results by rounding only.
    assert!(worst("raster") < best + 1e-5, "raster: {:e}", worst("raster"));
    assert!(bench::sweep(&device, "none", &scene, &[], PACE, &mut |_| Ok(())).is_err());
    common::assert_valid(&device);
}

#[test]
fn a_moving_scene_has_its_own_knobs() {
    let device = common::device();
    let sweep = bench::sweep_motion(&device, 2, true, PACE, &mut |_| Ok(())).unwrap();
    let of = |knob: &str| sweep.points.iter().filter(|p| p.knob == knob).collect::<Vec<_>>();
    let best = of("")[0].error.rmse;
    assert!(best < 1e-3, "{best:e}");
    for knob in ["neighbours", "network width"] {
        assert!(of(knob).len() >= 2, "{knob}");
        for point in of(knob) {
            println!("{knob} {}: {:e}", point.value, point.error.rmse);
            assert!(point.error.rmse > best && point.error.rmse < 0.5, "{point:?}");
        }
    }
    common::assert_valid(&device);
}

/// The settings are chosen on two views; the third is unseen.
#[test]
fn the_budget_is_met_on_an_unseen_view() {
    let device = common::device();
    let (scene, mut shots) = bench::still_scene(6, 3000, 160, 90);
    let mut third = shots[1];
    third.camera.view_from_world.translation += glam::DVec3::new(-0.25, 0.1, 0.05);
    shots.push(third);
    for (error, measure) in [(4e-3, ErrorMeasure::Rmse), (1e-2, ErrorMeasure::Max)] {
        let budget = Budget { error, measure };
        let mut turns = 0;
        let (tuning, choice) =
            bench::choose(&device, "still", &scene, &shots, budget, PACE, &mut |_| {
                turns += 1;
                Ok(())
            })
            .unwrap();
        println!("{measure:?} {error}: {turns} turns, {choice:?}");
        assert!(choice.met && measure.of(&choice.error) <= error, "{choice:?}");
        assert_eq!(choice.views, 2);
        let written: Tuning = serde_json::from_value(choice.settings).unwrap();
        assert_eq!(written, tuning, "what is printed is what is chosen");
        assert_eq!(turns > 0, tuning != Tuning::default());
    }
    let budget = Budget { error: 0.0, measure: ErrorMeasure::Rmse };
    assert!(bench::choose(&device, "x", &scene, &shots, budget, PACE, &mut |_| Ok(())).is_err());
    let budget = Budget { error: 0.1, ..budget };
    let one = &shots[..1];
    assert!(bench::choose(&device, "x", &scene, one, budget, PACE, &mut |_| Ok(())).is_err());
    common::assert_valid(&device);
}

/// Runs the command line in a folder, on the device under test; returns stdout as JSON.
#[track_caller]
fn json(folder: &Path, arguments: &str) -> Value {
    let output = program(folder, arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments}: {said}");
    serde_json::from_slice(&output.stdout).expect("one JSON value on stdout")
}

fn program(folder: &Path, arguments: &str) -> Output {
    let device = std::env::var("SPLAT4D_DEVICE").unwrap_or("software".into());
    Command::new(env!("CARGO_BIN_EXE_splat4d"))
        .current_dir(folder)
        .args(arguments.split_whitespace())
        .args(["--json", "--device", &device])
        .output()
        .unwrap()
}

#[test]
fn the_command_writes_a_report_and_compares() {
    let folder = tempfile::tempdir().unwrap();
    let run = json(folder.path(), "bench --quick --filter sort/ --report out");
    let rows = run["rows"].as_array().unwrap();
    assert!(rows.len() == 5 && run["sweeps"].as_array().unwrap().is_empty());
    assert!(rows.iter().all(|row| row["time"].as_array().is_some_and(|t| t.len() >= 5)));
    assert_eq!(run["missed"], 0);
    let read = Measurements::open(folder.path().join("out/bench.json")).unwrap();
    assert_eq!(read.rows.len(), rows.len());
    let page = std::fs::read_to_string(folder.path().join("out/index.html")).unwrap();
    assert!(page.contains("sort/pairs") && page.contains(&read.machine.driver));
    let all = json(folder.path(), "bench cmp out/bench.json out/bench.json");
    assert_eq!(all["noise"], rows.len());
    assert_eq!(
        (&all["faster"], &all["slower"], &all["incomparable"]),
        (&0.into(), &0.into(), &0.into())
    );
}

#[test]
fn chosen_settings_go_from_bench_to_render() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, _) = bench::still_scene(7, 1500, 96, 64);
    ply::write(folder.path().join("scene.ply"), &scene.gaussians).unwrap();
    let run = json(
        folder.path(),
        "bench --quick --scene scene.ply --size 96x64 --error-budget 0.01 --settings fast.json",
    );
    let choice = &run["choice"];
    assert_eq!(choice["met"], true, "{choice}");
    assert!(choice["error"]["rmse"].as_f64().unwrap() <= 0.01);
    let fast = std::fs::read_to_string(folder.path().join("fast.json")).unwrap();
    let fast: Tuning = serde_json::from_str(&fast).unwrap();
    assert_eq!(serde_json::to_value(fast).unwrap(), choice["settings"]);
    let render = "render scene.ply --path orbit --frames 1 --size 48x32 -o";
    std::fs::write(folder.path().join("flat.json"), r#"{"sh_degree": 0}"#).unwrap();
    json(folder.path(), &format!("{render} exact"));
    json(folder.path(), &format!("{render} fast --settings fast.json"));
    json(folder.path(), &format!("{render} flat --settings flat.json"));
    let picture = |name: &str| std::fs::read(folder.path().join(name).join("0000.png")).unwrap();
    assert!(picture("exact") != picture("flat"), "the settings reach the renderer");

    // No setting meets this budget; the exit code reports that too.
    let nothing = "bench --scene scene.ply --size 64x48 --quick --error-budget 1e-30";
    let output = program(folder.path(), nothing);
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(answer["choice"]["met"], false);
}

#[test]
fn wrong_use_is_named() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("bad.json"), r#"{"alpha_cutt": 0.1}"#).unwrap();
    for (arguments, code, says) in [
        ("bench --error-budget 0.1", 2, "--scene"),
        ("bench --settings x.json", 2, "--error-budget"),
        ("bench --filter nonsense", 1, "nonsense"),
        ("bench --scene nothing.ply", 1, "nothing.ply"),
        ("bench cmp bad.json bad.json", 1, "`splat4d bench`"),
        ("render x.ply -o out --settings bad.json", 1, "alpha_cutt"),
    ] {
        let output = program(folder.path(), arguments);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{arguments}: {said}");
        assert!(said.contains(says), "{arguments}: {said}");
    }
}
