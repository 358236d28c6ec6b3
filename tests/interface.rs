//! Checks that the shaders match the Rust declarations of kernels, that the crate's layers depend on each
//! other only as allowed, and that messages are in order. Needs no device.

#[path = "interface/constants.rs"]
mod constants;
#[path = "interface/layering.rs"]
mod layering;
#[path = "interface/messages.rs"]
mod messages;
#[path = "interface/reflect.rs"]
mod reflect;

use reflect::{Demands, Interface};
use rspirv::spirv::Capability;
use splat4d::gpu::{ConstantInfo, ConstantValue, Constants, Kernel, KernelInfo};
use splat4d::types::FlowSettings;
use splat4d::{check, kernels};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The smallest limits that kernels support: SwiftShader's, and Vulkan's guaranteed minima.
const MAX_BINDINGS: usize = 30;
const MAX_PARAMS: usize = 128;
const MAX_INVOCATIONS: u32 = 256;
const MAX_SHARED: u32 = 32 * 1024;

/// Capabilities that every device the engine opens has; others would exclude some devices.
const CAPABILITIES: &[Capability] = &[
    Capability::Shader,
    Capability::GroupNonUniform,
    Capability::GroupNonUniformArithmetic,
    Capability::GroupNonUniformBallot,
    Capability::GroupNonUniformShuffle,
];

#[test]
fn shaders_offer_what_rust_declares() {
    let mut wrong = Vec::new();
    for kernel in kernels::ALL {
        match reflect::by_rspirv(kernel.spirv) {
            Ok((interface, demands)) => {
                wrong.extend(differences(kernel, &interface, "rspirv"));
                wrong.extend(excesses(kernel, &demands));
            }
            Err(error) => wrong.push(format!("{}: {error}", kernel.name)),
        }
        match reflect::by_naga(kernel.spirv) {
            Ok(interface) => wrong.extend(differences(kernel, &interface, "naga")),
            Err(error) => wrong.push(format!("{}: naga: {error}", kernel.name)),
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// The differences between a module and its declaration.
fn differences(kernel: &KernelInfo, shader: &Interface, reader: &str) -> Vec<String> {
    let mut wrong = Vec::new();
    if shader.workgroup != kernel.workgroup {
        wrong.push(format!(
            "the workgroup is {:?} in GLSL, {:?} in Rust",
            shader.workgroup, kernel.workgroup
        ));
    }
    for (at, binding) in kernel.bindings.iter().enumerate() {
        let Some(storage) = shader.bindings.get(&(at as u32)) else {
            wrong.push(format!("binding {at} ({}): the shader does not use it", binding.name));
            continue;
        };
        if storage.stride as usize != binding.stride {
            wrong.push(format!(
                "binding {at} ({}): an element has {} bytes in GLSL, {} in Rust",
                binding.name, storage.stride, binding.stride
            ));
        }
        if storage.access.is_some_and(|access| access != binding.access) {
            wrong.push(format!(
                "binding {at} ({}): {:?} in GLSL, {:?} in Rust",
                binding.name,
                storage.access.expect("just seen"),
                binding.access
            ));
        }
    }
    for at in shader.bindings.keys().filter(|&&at| at as usize >= kernel.bindings.len()) {
        wrong.push(format!("binding {at}: Rust does not declare it"));
    }
    let declared: Vec<(u32, u32)> =
        kernel.params.iter().map(|p| (p.offset as u32, p.size as u32)).collect();
    if shader.params != declared {
        let names: Vec<_> = kernel.params.iter().map(|p| p.name).collect();
        wrong.push(format!(
            "push constants {names:?} as (offset, size): {:?} in GLSL, {declared:?} in Rust",
            shader.params
        ));
    }
    for constant in kernel.constants {
        let ConstantInfo { name, id, default } = *constant;
        let Some(found) = shader.constants.get(&id) else {
            wrong.push(format!("constant {id} ({name}): the shader has none of this id"));
            continue;
        };
        if found.default != default {
            wrong.push(format!(
                "constant {id} ({name}): the default is {:?} in GLSL, {default:?} in Rust",
                found.default
            ));
        }
        if found.name.as_ref().is_some_and(|found| *found != name.to_uppercase()) {
            wrong.push(format!(
                "constant {id} ({name}): it is called {} in GLSL",
                found.name.as_deref().expect("just seen")
            ));
        }
    }
    for id in shader.constants.keys() {
        if kernel.constants.iter().all(|constant| constant.id != *id) {
            wrong.push(format!("constant {id}: Rust does not declare it"));
        }
    }
    wrong.iter().map(|what| format!("{} ({reader}): {what}", kernel.name)).collect()
}

/// Demands of a kernel that exceed the smallest device's limits.
fn excesses(kernel: &KernelInfo, demands: &Demands) -> Vec<String> {
    let mut wrong = Vec::new();
    let mut limit = |what: &str, is: usize, most: usize| {
        if is > most {
            wrong.push(format!("{}: {is} {what}, at most {most}", kernel.name));
        }
    };
    limit("bindings", kernel.bindings.len(), MAX_BINDINGS);
    limit("bytes of push constants", kernel.params.iter().map(|p| p.size).sum(), MAX_PARAMS);
    limit(
        "invocations",
        kernel.workgroup.iter().product::<u32>() as usize,
        MAX_INVOCATIONS as usize,
    );
    limit("bytes of shared memory", demands.shared as usize, MAX_SHARED as usize);
    for capability in demands.capabilities.iter().filter(|c| !CAPABILITIES.contains(c)) {
        wrong.push(format!("{}: needs {capability:?}", kernel.name));
    }
    wrong
}

#[test]
fn a_drifted_declaration_is_noticed() {
    let truth = kernels::ALL
        .iter()
        .find(|kernel| kernel.name == "indirect/arguments")
        .expect("the kernel that this test bends");
    let (shader, _) = reflect::by_rspirv(truth.spirv).unwrap();
    let naga = reflect::by_naga(truth.spirv).unwrap();
    let complaints = |bent: KernelInfo| {
        (differences(&bent, &shader, "rspirv").len(), differences(&bent, &naga, "naga").len())
    };
    assert_eq!(complaints(*truth), (0, 0));
    assert_eq!(complaints(KernelInfo { workgroup: [2, 1, 1], ..*truth }), (1, 1));
    assert_eq!(complaints(KernelInfo { bindings: &truth.bindings[..1], ..*truth }), (1, 1));
    assert_eq!(complaints(KernelInfo { params: &truth.params[..4], ..*truth }), (1, 1));
    // Only the instructions show which bindings are read and which are written.
    let swapped = [truth.bindings[1], truth.bindings[0]];
    assert_eq!(complaints(KernelInfo { bindings: swapped.to_vec().leak(), ..*truth }), (2, 0));
    let mut wider = truth.bindings.to_vec();
    wider[1].stride = 16;
    assert_eq!(complaints(KernelInfo { bindings: wider.leak(), ..*truth }), (1, 1));
    let mut more = truth.bindings.to_vec();
    more.push(truth.bindings[0]);
    assert_eq!(complaints(KernelInfo { bindings: more.leak(), ..*truth }), (1, 1));
    let mut moved = truth.params.to_vec();
    moved[4].offset += 4;
    assert_eq!(complaints(KernelInfo { params: moved.leak(), ..*truth }), (1, 1));
}

#[test]
fn a_drifted_constant_is_noticed() {
    let truth = kernels::ALL
        .iter()
        .find(|kernel| kernel.name == "adam/step")
        .expect("the kernel whose constants this test bends");
    let (shader, _) = reflect::by_rspirv(truth.spirv).unwrap();
    let naga = reflect::by_naga(truth.spirv).unwrap();
    let complaints = |bend: &dyn Fn(&mut Vec<ConstantInfo>)| {
        let mut constants = truth.constants.to_vec();
        bend(&mut constants);
        let bent = KernelInfo { constants: constants.leak(), ..*truth };
        (differences(&bent, &shader, "rspirv").len(), differences(&bent, &naga, "naga").len())
    };
    assert_eq!(complaints(&|_| ()), (0, 0));
    assert_eq!(complaints(&|constants| constants[0].name = "any_row"), (1, 1));
    assert_eq!(complaints(&|constants| constants[1].default = ConstantValue::U32(2)), (1, 1));
    assert_eq!(complaints(&|constants| constants[1].default = ConstantValue::I32(1)), (1, 1));
    assert_eq!(complaints(&|constants| constants[2].default = ConstantValue::Bool(false)), (1, 1));
    // The shader has no constant 4, and Rust does not declare constant 3.
    assert_eq!(complaints(&|constants| constants[3].id = 4), (2, 2));
    assert_eq!(complaints(&|constants| constants.truncate(3)), (1, 1));
    let next = ConstantInfo { name: "next", id: 4, default: ConstantValue::F32(0.0) };
    assert_eq!(complaints(&|constants| constants.push(next)), (1, 1));
}

/// The numbering, the types and the words that Vulkan takes.
#[test]
fn constants_are_numbered_in_order_and_give_their_bits() {
    // Each type once; the shaders have no signed and no float constants.
    let words = [
        ConstantValue::bool(true),
        ConstantValue::u32(7),
        ConstantValue::i32(-1),
        ConstantValue::f32(1.5),
    ]
    .map(ConstantValue::word);
    assert_eq!(words, [1, 7, u32::MAX, 0x3fc0_0000]);
    for kernel in kernels::ALL {
        let ids: Vec<u32> = kernel.constants.iter().map(|constant| constant.id).collect();
        assert_eq!(ids, (0..ids.len() as u32).collect::<Vec<_>>(), "{}", kernel.name);
    }
    let constants = kernels::adam::StepConstants { row: 9, ..Default::default() };
    assert_eq!(constants.words(), [0, 9, 1, 0]);
    let defaults: Vec<u32> = kernels::adam::Step::INFO
        .constants
        .iter()
        .map(|constant| constant.default.word())
        .collect();
    assert_eq!(kernels::adam::StepConstants::default().words(), *defaults);
}

#[test]
fn constants_that_glsl_and_rust_share_agree() {
    let (shaders, rust) = (constants::of_shaders(&root()), constants::of_crate(&root()));
    let wrong = constants::differences(&shaders, &rust);
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));

    let named = |all: &[constants::Constant]| -> BTreeSet<String> {
        all.iter().map(|constant| constant.name.clone()).collect()
    };
    let (in_shaders, in_rust) = (named(&shaders), named(&rust));
    assert!(in_shaders.intersection(&in_rust).count() >= 20, "{in_shaders:?} {in_rust:?}");
    for &(file, name) in constants::OTHERS {
        let is_there = rust.iter().any(|c| c.file == file && c.name == name);
        assert!(is_there && in_shaders.contains(name), "{file} {name} need not be an exception");
    }

    // What the shaders derive from the same numbers has names of its own.
    let in_glsl = |file: &str, name: &str| {
        let found = shaders.iter().find(|c| c.file == file && c.name == name);
        found.unwrap_or_else(|| panic!("{file} has no {name}")).value
    };
    let labels = 2.0 * f64::from(FlowSettings::MAX_START_RADIUS) + 1.0;
    assert_eq!(in_glsl("glsl/flow/path.comp", "MAX_LABELS"), labels * labels);
    let invocations = f64::from(kernels::roofline::Copy::INFO.workgroup[0]);
    assert_eq!(
        in_glsl("glsl/roofline/copy.comp", "EACH") * invocations,
        f64::from(kernels::roofline::COPY_PER_GROUP)
    );
}

#[test]
fn a_drifted_shared_constant_is_noticed() {
    let glsl = "const uint BLOCK = 4096u;\nconst float LARGEST = 1e18;\nconst vec2 V = vec2(1.0);\n\
                layout(constant_id = 0) const uint K = 4u;\n    const uint NONE = 0xffffffffu;";
    let rust = "pub const BLOCK: u32 = 4_096;\npub(crate) const LARGEST: f64 = 1e17;\n\
                const SIDE: u32 = 3;\nconst AREA: u32 = SIDE * SIDE;\nconst NONE: u32 = u32::MAX;\n\
                const NAME: &str = \"K\";";
    let listed = |file: &str, source: &str| -> Vec<constants::Constant> {
        let constants = constants::constants(source).into_iter();
        constants
            .map(|(name, value)| constants::Constant { file: file.to_owned(), name, value })
            .collect()
    };
    let (shaders, crate_) = (listed("a.glsl", glsl), listed("a.rs", rust));
    let names = |all: &[constants::Constant]| -> Vec<(String, f64)> {
        all.iter().map(|c| (c.name.clone(), c.value)).collect()
    };
    let none = ("NONE".to_owned(), 4_294_967_295.0);
    assert_eq!(
        names(&shaders),
        [("BLOCK".to_owned(), 4096.0), ("LARGEST".to_owned(), 1e18), none.clone()]
    );
    assert_eq!(
        names(&crate_),
        [
            ("AREA".to_owned(), 9.0),
            ("BLOCK".to_owned(), 4096.0),
            ("LARGEST".to_owned(), 1e17),
            none,
            ("SIDE".to_owned(), 3.0),
        ]
    );
    let wrong = constants::differences(&shaders, &crate_);
    assert_eq!(wrong.len(), 1, "{wrong:?}");
    assert!(wrong[0].contains("LARGEST"), "{wrong:?}");
}

/// Only `io` opens input files, so that what it refuses (pipes, devices, sizes beyond memory) is refused
/// everywhere.
#[test]
fn inputs_are_opened_in_one_place() {
    // Exceptions: system files, the cache that the engine writes, and tests.
    let others = ["io/mod.rs", "io/memory.rs", "vk/cache_file.rs", "cmd/interrupt.rs"];
    let src = root().join("src");
    let files = files(&src, "rs");
    assert!(files.len() > 100);
    for path in files {
        let name = path.strip_prefix(&src).unwrap().to_str().unwrap().replace('\\', "/");
        if others.contains(&name.as_str()) || name.ends_with("_tests.rs") {
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        let code = text.split("\nmod tests").next().unwrap();
        for opener in ["File::open(", "fs::read(", "read_to_string(", "ImageReader::open("] {
            assert!(!code.contains(opener), "{name} calls {opener}…); call io::open or io::read");
        }
    }
}

#[test]
fn one_stem_names_a_kernel_everywhere() {
    let listed: Vec<String> = kernels::ALL.iter().map(|k| k.name.to_owned()).collect();
    let all: BTreeSet<String> = listed.iter().cloned().collect();
    assert_eq!(all.len(), listed.len(), "a kernel is listed twice in kernels::ALL");

    let manifest = std::fs::read_to_string(root().join("spirv/manifest.toml")).unwrap();
    let manifest: toml::Table = manifest.parse().unwrap();
    let entries = manifest["kernels"].as_table().unwrap().keys().cloned().collect();
    let mut wrong = Vec::new();
    for (place, names) in [
        ("glsl/*.comp", stems("glsl", "comp")),
        ("spirv/*.spv", stems("spirv", "spv")),
        ("spirv/manifest.toml", entries),
    ] {
        for name in all.difference(&names) {
            wrong.push(format!("{name} is in kernels::ALL but not in {place}"));
        }
        for name in names.difference(&all) {
            wrong.push(format!("{name} is in {place} but not in kernels::ALL"));
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

#[test]
fn cases_have_names_of_their_own_and_every_family_a_test_for_each() {
    let mut wrong = Vec::new();
    let mut ids = BTreeSet::new();
    for case in check::ALL.iter().flat_map(|cases| cases.iter()) {
        if !ids.insert(case.id) {
            wrong.push(format!("two cases are called {}", case.id));
        }
    }
    // Its macro holds that each case of the family has its test.
    for family in check::ALL.iter().filter_map(|cases| cases[0].id.split('/').next()) {
        let file = format!("tests/{family}.rs");
        let text = std::fs::read_to_string(root().join(&file)).unwrap_or_default();
        if !text.contains(&format!("common::cases! {{ \"{family}\"")) {
            wrong.push(format!("{file} has no common::cases! of {family}"));
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

#[test]
fn parts_see_only_what_lies_below() {
    let breaches = layering::breaches(&root().join("src"));
    assert!(breaches.is_empty(), "\n{}", breaches.join("\n"));
}

#[test]
fn the_table_has_no_circle() {
    // A part may only see parts listed before it, so there are no cycles.
    for (at, (room, seen)) in layering::MAY_SEE.iter().enumerate() {
        for part in *seen {
            let place = layering::MAY_SEE.iter().position(|(name, _)| name == part);
            assert!(place.is_some_and(|place| place < at), "{room} sees {part}");
        }
    }
}

#[test]
fn breaches_are_noticed_in_every_spelling() {
    let reexports = BTreeMap::from([("Error".to_owned(), "error".to_owned())]);
    let breaches = |path: &str, source: &str| {
        layering::breaches_of(Path::new(path), source, &reexports, false)
    };
    for (path, source) in [
        ("oracle/sort.rs", "use crate::gpu::Buffer;"),
        ("oracle/sort.rs", "use crate::{types::Pose, vk::{Limits, Timeline}};"),
        ("oracle/sort.rs", "fn f() { g(crate::kernels::ALL) }"),
        ("oracle/sort.rs", "use super::super::gpu;"),
        ("oracle/deep/sort.rs", "use super::super::super::gpu;"),
        ("oracle/sort.rs", "mod inner { use super::super::super::gpu; }"),
        ("oracle/sort.rs", "#[cfg(test)] mod tests { use crate::gpu::Device; }"),
        ("oracle/mod.rs", "use super::gpu::Device;"),
        ("oracle/mod.rs", "use crate::*;"),
        ("oracle/mod.rs", "use crate as engine;"),
        ("types/mod.rs", "macro_rules! m { () => { $crate::io::read } }"),
        ("gpu/mod.rs", "pub use ash::vk;"),
        ("gpu/mod.rs", "fn f() { let x = unsafe { g() }; }"),
        ("error.rs", "use crate::types::Pose;"),
        ("cmd/mod.rs", "use crate::types::Pose;"),
        ("main.rs", "use crate::gpu::Device;"),
        ("new/mod.rs", ""),
    ] {
        assert_eq!(breaches(path, source).len(), 1, "{path}: {source}");
    }
    for (path, source) in [
        ("oracle/sort.rs", "use crate::{Error, types::Pose}; use super::Real;"),
        ("oracle/sort.rs", "// crate::gpu\n/// crate::vk\nconst S: &str = \"crate::gpu\";"),
        ("oracle/sort.rs", "mod tests { use super::super::Real; }"),
        (
            "oracle/sort.rs",
            "pub(crate) fn f() {} pub(super) fn g() {} pub(in crate::oracle) fn h() {}",
        ),
        ("geometry/a.rs", "#[cfg(test)]\nmod tests { use crate::oracle::sort; }"),
        ("vk/device.rs", "use ash::vk; fn f() { unsafe { g() } }"),
        ("main.rs", "mod cmd; use splat4d::gpu::Device; fn main() { crate::cmd::run() }"),
        ("lib.rs", "pub use crate::error::Error;"),
    ] {
        assert_eq!(breaches(path, source), Vec::<String>::new(), "{path}: {source}");
    }
    let in_test_file = |path: &str, source: &str| {
        layering::breaches_of(Path::new(path), source, &reexports, true).len()
    };
    assert_eq!(in_test_file("geometry/cases.rs", "use crate::oracle::sort;"), 0);
    assert_eq!(in_test_file("geometry/cases.rs", "use crate::gpu::Device;"), 1);
    assert_eq!(in_test_file("gpu/cases.rs", "use crate::oracle::sort;"), 1);
}

#[test]
fn messages_have_no_gaps() {
    let gaps = messages::gaps(&root().join("src"));
    assert!(gaps.is_empty(), "\n{}", gaps.join("\n"));
}

#[test]
fn library_messages_name_no_options() {
    let options = messages::options(&root().join("src"));
    assert!(options.is_empty(), "\n{}", options.join("\n"));
    for text in ["give --focal", "(--focal gives it)", "choose another `--port`"] {
        assert!(messages::names_option(text), "{text}");
    }
    for text in ["--always", "a -- b", "one--two", "-x", "give the focal length"] {
        assert!(!messages::names_option(text), "{text}");
    }
}

#[test]
fn gaps_are_noticed_where_text_is_not_laid_out() {
    let lines = |source: &str, laid_out: bool| -> Vec<usize> {
        messages::gaps_of(source, laid_out).into_iter().map(|(line, _)| line).collect()
    };
    for source in [
        "fn f() { g(\"one  two\") }",
        "fn f() { g(\"one;\n   two\") }",
        "fn f() { g(r#\"one\ttwo\"#) }",
        "fn f() { let what = \"one\n two\"; }",
        "#[error(\"one  two\")] enum E {}",
    ] {
        assert_eq!(lines(source, false), [1], "{source}");
        assert_eq!(lines(source, true), Vec::<usize>::new(), "{source}");
    }
    for source in [
        "fn f() { Err(Error::Input(\"one  two\".into())) }",
        "fn f() { return Err(format!(\"one  {x}\")) }",
        "fn f() { Error::Shape { op, expected: format!(\"one  {x}\") } }",
    ] {
        assert_eq!((lines(source, false), lines(source, true)), (vec![1], vec![1]), "{source}");
    }
    for source in [
        "fn f() { g(\"one \\\n   two\") }",
        "/// one  two\nfn f() { g(\"  one\\n\") }",
        "#[cfg(test)]\nmod tests { fn f() { g(\"one  two\") } }",
        "fn f() { g(b\"one  two\") }",
    ] {
        assert_eq!(lines(source, false), Vec::<usize>::new(), "{source}");
    }
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// `family/stem` of every file with an extension below a folder.
fn stems(folder: &str, extension: &str) -> BTreeSet<String> {
    let folder = root().join(folder);
    let stem = |path: PathBuf| {
        let inner = path.strip_prefix(&folder).expect("below the folder").with_extension("");
        inner.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("/")
    };
    files(&folder, extension).into_iter().map(stem).collect()
}

/// Every file with an extension below a folder, sorted.
fn files(folder: &Path, extension: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let entries = std::fs::read_dir(folder)
        .unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        .map(|entry| entry.expect("a readable entry").path());
    for path in entries {
        if path.is_dir() {
            found.extend(files(&path, extension));
        } else if path.extension().is_some_and(|e| e == extension) {
            found.push(path);
        }
    }
    found.sort();
    found
}
