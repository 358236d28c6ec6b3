//! Validation detects faults: for ten kernels, a module with one planted fault makes the cases of that
//! kernel's family fail. The lists behind `splat4d validate` are complete.

mod common;

use std::collections::BTreeSet;

use rspirv::binary::Assemble;
use rspirv::dr::{Instruction, Module, load_words};
use rspirv::spirv::Op;
use splat4d::check::{self, Case};
use splat4d::gpu::{ConstantValue, Device, Profile};
use splat4d::kernels;

fn cases() -> impl Iterator<Item = &'static Case> {
    check::ALL.iter().flat_map(|cases| cases.iter())
}

/// A fault, planted in those places of its kind that `places` lists; in all of them if it is empty.
struct Fault {
    kernel: &'static str,
    what: &'static str,
    from: Op,
    to: Option<Op>,
    places: &'static [usize],
}

const fn fault(
    kernel: &'static str,
    what: &'static str,
    from: Op,
    to: Option<Op>,
    places: &'static [usize],
) -> Fault {
    Fault { kernel, what, from, to, places }
}

const FAULTS: &[Fault] = &[
    // Not in `scan/downsweep`: its sums pass from earlier subgroups to later ones, and a software device
    // that runs them one after the other gets correct results without a barrier. Totals pass in both
    // directions.
    fault("scan/single", "a dropped barrier", Op::ControlBarrier, None, &[]),
    fault("scan/downsweep", "a sign", Op::IAdd, Some(Op::ISub), &[0]),
    fault("loss/ssim", "a dropped barrier", Op::ControlBarrier, None, &[]),
    fault("sort/scatter", "a sign", Op::IAdd, Some(Op::ISub), &[0]),
    fault("sort/count", "a wrong shift", Op::ShiftRightLogical, Some(Op::ShiftLeftLogical), &[]),
    fault("project/forward", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("project/backward", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("bin/emit", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("raster/forward", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("raster/backward", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("raster/backward_narrow", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("loss/gradient", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("mlp/weights", "a sign", Op::IAdd, Some(Op::ISub), &[0]),
    fault("arap/fit", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("adam/step", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("deform/skin", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("flow/halve", "an off-by-one", Op::IAdd, Some(Op::ISub), &[0]),
    fault("texel/unorm8", "a sign", Op::FSub, Some(Op::FAdd), &[0]),
    fault("texel/half", "a wrong shift", Op::ShiftRightLogical, Some(Op::ShiftLeftLogical), &[]),
];

/// The module with the fault, and the number of changed instructions.
fn planted(spirv: &[u8], fault: &Fault) -> (Vec<u8>, usize) {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(spirv);
    let mut module: Module = load_words(&words).expect("the crate's own module");
    let (mut seen, mut changed) = (0, 0);
    for block in module.functions.iter_mut().flat_map(|f| &mut f.blocks) {
        block.instructions.retain_mut(|instruction| {
            if instruction.class.opcode != fault.from {
                return true;
            }
            let here = fault.places.is_empty() || fault.places.contains(&seen);
            seen += 1;
            if !here {
                return true;
            }
            changed += 1;
            match fault.to {
                Some(to) => {
                    let operands = std::mem::take(&mut instruction.operands);
                    let (kind, id) = (instruction.result_type, instruction.result_id);
                    *instruction = Instruction::new(to, kind, id, operands);
                    true
                }
                None => false,
            }
        });
    }
    (bytemuck::cast_slice(&module.assemble()).to_vec(), changed)
}

/// Whether a case of the kernel's family that runs the kernel fails.
fn family_fails(device: &Device, kernel: &str) -> bool {
    let family = kernel.split('/').next();
    let mut ran = false;
    let failed = cases().filter(|case| case.id.split('/').next() == family).any(|case| {
        let outcome = check::run(case, device, 0);
        let runs_it = outcome.dispatched.iter().any(|dispatched| dispatched.kernel == kernel);
        ran |= runs_it;
        runs_it && !outcome.passed()
    });
    assert!(ran, "no case of its family runs {kernel}");
    failed
}

#[test]
fn a_fault_planted_in_a_kernel_makes_its_cases_fail() {
    let device = common::device();
    let mut unnoticed = Vec::new();
    for fault in FAULTS {
        let info = kernels::ALL.iter().find(|k| k.name == fault.kernel).expect("a kernel");
        let (module, changed) = planted(info.spirv, fault);
        assert!(changed > 0, "{}: nothing to plant {} in", fault.kernel, fault.what);
        // SAFETY: bindings, push constants and workgroup size are unchanged, and software drivers were
        // observed to survive faults of this kind.
        let faulty = unsafe { device.with_module(fault.kernel, module) };
        match family_fails(&faulty, fault.kernel) {
            true => println!("{}: {} in {changed} places is noticed", fault.kernel, fault.what),
            false => unnoticed.push(format!("{}: {}", fault.kernel, fault.what)),
        }
    }
    assert!(unnoticed.is_empty(), "not noticed:\n{}", unnoticed.join("\n"));
    assert!(FAULTS.iter().map(|f| f.kernel).collect::<BTreeSet<_>>().len() >= 10);
}

/// The same procedure with the crate's unmodified module, disassembled and reassembled: validation
/// detects the fault, not the replacement.
#[test]
fn a_module_without_a_fault_passes() {
    let device = common::device();
    for name in ["raster/forward", "sort/scatter"] {
        let info = kernels::ALL.iter().find(|k| k.name == name).expect("a kernel");
        let same = fault(name, "nothing", Op::Nop, None, &[]);
        let (module, changed) = planted(info.spirv, &same);
        assert_eq!(changed, 0);
        // SAFETY: it is the kernel's module, reassembled.
        let same = unsafe { device.with_module(name, module) };
        assert!(!family_fails(&same, name), "{name}");
    }
}

#[test]
fn hard_and_quick_lists_name_cases() {
    let ids: BTreeSet<&str> = cases().map(|case| case.id).collect();
    let mut wrong = Vec::new();
    for (input, listed) in check::HARD {
        if listed.is_empty() {
            wrong.push(format!("no case shows: {input}"));
        }
        for id in listed.iter().filter(|id| !ids.contains(*id)) {
            wrong.push(format!("{input}: there is no case {id}"));
        }
    }
    for id in check::QUICK.iter().filter(|id| !ids.contains(*id)) {
        wrong.push(format!("quick: there is no case {id}"));
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// What the quick set was seen to dispatch: every kernel, and every switch among its specialisation
/// constants on and off. Those that depend on the profile are such switches.
#[test]
fn the_quick_set_covers_every_variant_of_every_kernel() {
    let device = common::device();
    let mut covered = BTreeSet::new();
    for case in cases().filter(|case| check::QUICK.contains(&case.id)) {
        let outcome = check::run(case, &device, 0);
        assert!(outcome.passed(), "{outcome:#?}");
        covered.extend(outcome.dispatched);
    }
    let mut wrong = Vec::new();
    for kernel in kernels::ALL {
        let seen: Vec<_> = covered.iter().filter(|seen| seen.kernel == kernel.name).collect();
        if seen.is_empty() {
            wrong.push(format!("no case runs {}", kernel.name));
        }
        // Each profile runs one of the two modules of the backward pass, with the constants of its own.
        if kernel.name.starts_with("raster/backward") {
            continue;
        }
        for constant in kernel.constants {
            if !matches!(constant.default, ConstantValue::Bool(_)) {
                continue;
            }
            for value in [true, false] {
                let word = ConstantValue::Bool(value).word();
                if seen.iter().all(|seen| seen.constants[constant.id as usize] != word) {
                    wrong.push(format!(
                        "no case runs {} with {}: {value}",
                        kernel.name, constant.name
                    ));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
    common::assert_valid(&device);
}

/// Under either profile one of the two ways to scan takes a number of values below the capacity.
#[test]
fn both_scans_run_with_a_count_below_the_capacity() {
    let case = cases().find(|case| case.id == "scan/count_below_capacity").expect("the case");
    let outcome = check::run(case, &common::device(), 0);
    let under = |profile: Profile| -> Vec<&str> {
        let own = outcome.dispatched.iter().filter(|seen| seen.profile == profile.name());
        own.map(|seen| seen.kernel).collect()
    };
    assert_eq!(under(Profile::SOFTWARE), ["scan/single"]);
    let four = ["indirect/arguments", "scan/downsweep", "scan/reduce", "scan/spine"];
    assert_eq!(under(Profile::GPU), four);
}

/// Pipelines that require a subgroup size are valid and right, with workgroups that are smaller than a
/// subgroup, as large, and larger.
#[test]
fn cases_pass_with_a_required_subgroup_size() {
    let device = common::device();
    let families = ["indirect/", "mlp/", "raster/", "scan/", "sort/"];
    let chosen = |case: &&Case| {
        check::QUICK.contains(&case.id) && families.iter().any(|family| case.id.starts_with(family))
    };
    for &size in device.subgroup_sizes() {
        let requiring = device.with_subgroup_size(size).unwrap();
        for case in cases().filter(chosen) {
            let outcome = check::run(case, &requiring, 3);
            assert!(outcome.passed(), "subgroups of {size}: {outcome:#?}");
        }
    }
    common::assert_valid(&device);
}

/// The families whose ops return gradients.
#[test]
fn every_differentiable_op_is_held_against_central_differences() {
    for family in ["arap", "deform", "density", "loss", "mlp", "render"] {
        let id = format!("{family}/central_differences");
        assert!(cases().any(|case| case.id == id), "there is no case {id}");
    }
}

/// A driver's fault in a case likewise ends the case, not the run.
#[test]
fn a_panic_in_a_case_is_a_failure_with_words() {
    fn panics(_: &mut check::Harness) -> splat4d::Result<()> {
        panic!("on purpose")
    }
    let case = Case { id: "test/panics", run: panics };
    let outcome = check::run(&case, &common::device(), 0);
    assert!(!outcome.passed());
    assert_eq!(outcome.error.unwrap().to_string(), "panicked: on purpose");
}

#[cfg(feature = "cli")]
mod command {
    use serde_json::Value;
    use std::process::{Command, Output};

    fn validate(arguments: &[&str]) -> Output {
        let device = std::env::var("SPLAT4D_DEVICE").unwrap_or("software".into());
        let mut command = Command::new(env!("CARGO_BIN_EXE_splat4d"));
        command.args(["validate", "--json", "--device", &device]).args(arguments);
        command.output().unwrap()
    }

    fn json(output: &Output) -> Value {
        serde_json::from_slice(&output.stdout).expect("one JSON value on stdout")
    }

    #[test]
    fn prints_a_row_for_each_case() {
        let output = validate(&["--filter", "scan/", "--filter", "adam/steps", "--seed", "5"]);
        assert_eq!(output.status.code(), Some(0));
        let answer = json(&output);
        let rows = answer["rows"].as_array().unwrap();
        assert_eq!((&answer["cases"], &answer["failed"]), (&rows.len().into(), &0.into()));
        assert!(rows.len() >= 4 && answer["devices"][0]["driver"].is_string());
        for row in rows {
            assert_eq!((&row["result"], &row["seed"]), (&"passed".into(), &5.into()));
            assert!(row["comparisons"].as_u64().unwrap() > 1, "{row}");
        }
        let steps = rows.iter().find(|row| row["case"] == "adam/steps").unwrap();
        let worst = &steps["worst"];
        for key in ["absolute", "relative", "of_bound", "oracle_f32_absolute"] {
            assert!(worst[key].is_number(), "{key}: {worst}");
        }
        assert!(worst["bound"]["absolute"].is_number(), "{worst}");
    }

    #[test]
    fn stops_when_its_time_is_over() {
        let output = validate(&["--seconds", "0.5"]);
        assert_eq!(output.status.code(), Some(0));
        let answer = json(&output);
        let [ran, left_out] = ["cases", "left_out"].map(|key| answer[key].as_u64().unwrap());
        let all: usize = splat4d::check::ALL.iter().map(|cases| cases.len()).sum();
        assert!(ran > 0 && left_out > 0, "{ran} and {left_out}");
        assert_eq!(ran + left_out, all as u64);
    }

    #[test]
    fn a_junit_report_holds_every_case() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("validate.xml");
        let output =
            validate(&["--filter", "scan/", "--seed", "5", "--junit", file.to_str().unwrap()]);
        assert_eq!(output.status.code(), Some(0));
        let answer = json(&output);
        let text = std::fs::read_to_string(&file).unwrap();
        let report = quick_junit::Report::deserialize_from_str(&text).unwrap();
        assert_eq!(
            (report.tests, report.failures, report.errors),
            (answer["cases"].as_u64().unwrap() as usize, 0, 0)
        );
        let [suite] = &report.test_suites[..] else { panic!("one device: {text}") };
        assert!(suite.name.as_str().contains(answer["devices"][0]["driver"].as_str().unwrap()));
        for (case, row) in suite.test_cases.iter().zip(answer["rows"].as_array().unwrap()) {
            assert_eq!(case.name.as_str(), row["case"]);
            assert_eq!(case.assertions.map(|n| n as u64), row["comparisons"].as_u64());
        }
        let output = validate(&["--filter", "scan/", "--junit", folder.path().to_str().unwrap()]);
        assert_eq!(output.status.code(), Some(1));
        assert!(json(&output)["error"].as_str().unwrap().contains("is a folder"));
    }

    #[test]
    fn a_page_holds_device_and_cases() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("page.html");
        let file = file.to_str().unwrap();
        let output = validate(&["--filter", "scan/", "--seed", "5", "--report", file]);
        assert_eq!(output.status.code(), Some(0));
        let answer = json(&output);
        let page = std::fs::read_to_string(file).unwrap();
        let text = |value: &Value| splat4d::report::escape(value.as_str().unwrap());
        for key in ["name", "driver"] {
            let value = text(&answer["devices"][0][key]);
            assert!(page.contains(&value), "{value}");
        }
        for row in answer["rows"].as_array().unwrap() {
            assert!(page.contains(&text(&row["case"])), "{row}");
        }
        for part in ["all with scan/ in their name", "Subgroup size", "Vulkan loader", "None of"] {
            assert!(page.contains(part), "{part}");
        }
        let output = validate(&["--filter", "scan/", "--report", file, "--junit", file]);
        assert_eq!(output.status.code(), Some(1));
        let error = json(&output)["error"].as_str().unwrap().to_owned();
        assert!(error.contains("cannot both be written there"), "{error}");
    }

    #[test]
    fn says_which_families_there_are() {
        let output = validate(&["--filter", "nonsense"]);
        assert_eq!(output.status.code(), Some(1));
        let error = json(&output)["error"].as_str().unwrap().to_owned();
        assert!(error.contains("FAMILY/CASE") && error.contains("raster"), "{error}");
    }

    #[test]
    fn fuzzes_and_repeats_a_scene() {
        let output = validate(&["--fuzz", "20", "--seed", "2"]);
        assert_eq!(output.status.code(), Some(0));
        assert_eq!(json(&output)["cases"], 20);
        let cases = concat!(env!("CARGO_MANIFEST_DIR"), "/src/check/fuzz/cases");
        let output = validate(&["--case", &format!("{cases}/ordinary.json")]);
        assert_eq!(output.status.code(), Some(0));
        assert_eq!(json(&output)["rows"][0]["what"], Value::Null);
        let output = validate(&["--case", &format!("{cases}/missing.json")]);
        assert_eq!(output.status.code(), Some(1));
        assert!(json(&output)["error"].as_str().unwrap().contains("missing.json"));
    }
}
