//! Compiles every `glsl/**/*.comp` to the same path under `spirv/` and writes `spirv/manifest.toml`; compiles
//! the shaders of `examples/`, each to the file beside it; and checks that what is committed is what the
//! sources give.
//!
//! `cargo run --release -p tools -- build [KERNEL …]` writes; nothing is written unless every
//! shader compiles. `cargo run --release -p tools -- check` compiles to memory and compares.

use sha2::{Digest, Sha256};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// What a shader is compiled with; part of every hash. SPIR-V 1.5 because naga rejects what 1.6
/// emits.
const FLAGS: &str = "vulkan1.3 spv1.5 werror";

#[derive(serde::Serialize, serde::Deserialize, PartialEq)]
struct Manifest {
    /// Name and version of the compiler.
    compiler: String,
    flags: String,
    /// By kernel name, `family/stem`.
    kernels: BTreeMap<String, Entry>,
}

#[derive(serde::Serialize, serde::Deserialize, PartialEq)]
struct Entry {
    /// SHA-256 over the source and its includes, in the order of their names.
    source: String,
    /// The files of `glsl/` that the hash covers.
    files: Vec<String>,
    /// SHA-256 of the module.
    spirv: String,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let result = match arguments.first().map(String::as_str) {
        Some("build") => build(),
        Some("check") => check(),
        _ => Err("usage: tools build | tools check   (run in the repository's root)".into()),
    };
    match result {
        Ok(message) => {
            println!("{message}");
            ExitCode::SUCCESS
        }
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}

/// Compiles everything, then writes modules and manifest.
fn build() -> Result<String, String> {
    let (manifest, modules) = compile_all()?;
    let examples = compile_examples()?;
    for (name, module) in &modules {
        let path = spirv_path(name);
        if fs::read(&path).is_ok_and(|old| old == *module) {
            continue;
        }
        fs::create_dir_all(path.parent().expect("a kernel has a family")).map_err(text)?;
        fs::write(&path, module).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    for (path, module) in &examples {
        fs::write(path, module).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    for name in committed_modules()? {
        if !modules.contains_key(&name) {
            fs::remove_file(spirv_path(&name)).map_err(text)?;
        }
    }
    let toml = toml::to_string(&manifest).map_err(text)?;
    fs::write("spirv/manifest.toml", toml).map_err(text)?;
    Ok(format!("{} shaders compiled", modules.len() + examples.len()))
}

/// Compiles everything and compares with what is committed.
fn check() -> Result<String, String> {
    let (manifest, modules) = compile_all()?;
    let committed = fs::read_to_string("spirv/manifest.toml").map_err(text)?;
    let committed: Manifest = toml::from_str(&committed).map_err(text)?;
    let mut wrong = Vec::new();
    for (name, module) in &modules {
        if !fs::read(spirv_path(name)).is_ok_and(|old| old == *module) {
            wrong.push(name.clone());
        }
    }
    wrong.extend(committed_modules()?.into_iter().filter(|name| !modules.contains_key(name)));
    let examples = compile_examples()?;
    for (path, module) in &examples {
        if !fs::read(path).is_ok_and(|old| old == *module) {
            wrong.push(path.display().to_string());
        }
    }
    if !wrong.is_empty() {
        return Err(format!(
            "the committed modules do not match their sources for {}; run `cargo run --release -p tools -- build`",
            wrong.join(", ")
        ));
    }
    if committed != manifest {
        return Err("spirv/manifest.toml is stale; run the tools' build".into());
    }
    Ok(format!("{} shaders match", modules.len() + examples.len()))
}

fn compile_all() -> Result<(Manifest, BTreeMap<String, Vec<u8>>), String> {
    let compiler = shaderc::Compiler::new().map_err(text)?;
    let mut kernels = BTreeMap::new();
    let mut modules = BTreeMap::new();
    let mut failures = Vec::new();
    for source in files_with_extension("glsl", "comp")? {
        let name = stem(&source, "glsl");
        match compile(&compiler, &source) {
            Ok((entry, module)) => {
                kernels.insert(name.clone(), entry);
                modules.insert(name, module);
            }
            Err(message) => failures.push(message),
        }
    }
    if !failures.is_empty() {
        return Err(failures.join("\n"));
    }
    let (version, revision) = shaderc::get_spirv_version();
    let compiler =
        format!("shaderc, SPIR-V {}.{} r{revision}", version >> 16, (version >> 8) & 0xff);
    Ok((Manifest { compiler, flags: FLAGS.into(), kernels }, modules))
}

/// The compiled modules of `examples/`, by path.
fn compile_examples() -> Result<BTreeMap<PathBuf, Vec<u8>>, String> {
    let compiler = shaderc::Compiler::new().map_err(text)?;
    let mut modules = BTreeMap::new();
    for source in files_with_extension("examples", "comp")? {
        modules.insert(source.with_extension("spv"), compile(&compiler, &source)?.1);
    }
    Ok(modules)
}

fn compile(compiler: &shaderc::Compiler, source: &Path) -> Result<(Entry, Vec<u8>), String> {
    let text_of =
        |path: &Path| fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()));
    let glsl = text_of(source)?;
    let included = RefCell::new(BTreeSet::new());
    let mut options = shaderc::CompileOptions::new().map_err(text)?;
    options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_3 as u32);
    options.set_target_spirv(shaderc::SpirvVersion::V1_5);
    // Optimisation is left to the drivers, which know their device: merging and unrolling here makes a
    // training step on software drivers an eighth slower.
    options.set_optimization_level(shaderc::OptimizationLevel::Zero);
    options.set_warnings_as_errors();
    options.set_include_callback(|requested, _, _, _| {
        // Every include is relative to glsl/, whichever file includes it.
        let path = Path::new("glsl").join(requested);
        let content = text_of(&path)?;
        included.borrow_mut().insert(path.clone());
        Ok(shaderc::ResolvedInclude { resolved_name: path.display().to_string(), content })
    });
    let artifact = compiler
        .compile_into_spirv(
            &glsl,
            shaderc::ShaderKind::Compute,
            &source.display().to_string(),
            "main",
            Some(&options),
        )
        .map_err(text)?;
    let module = artifact.as_binary_u8().to_vec();
    drop(options);

    let mut files = vec![source.to_path_buf()];
    files.extend(included.into_inner());
    let mut hash = Sha256::new();
    hash.update(FLAGS);
    for file in &files {
        hash.update(text_of(file)?);
    }
    let entry = Entry {
        source: hex(&hash.finalize()),
        files: files.iter().map(|f| f.display().to_string()).collect(),
        spirv: hex(&Sha256::digest(&module)),
    };
    Ok((entry, module))
}

fn committed_modules() -> Result<Vec<String>, String> {
    let files = files_with_extension("spirv", "spv")?;
    Ok(files.iter().map(|path| stem(path, "spirv")).collect())
}

fn files_with_extension(root: &str, extension: &str) -> Result<Vec<PathBuf>, String> {
    let mut files = Vec::new();
    for entry in walkdir::WalkDir::new(root) {
        let entry = entry.map_err(text)?;
        if entry.path().extension().is_some_and(|e| e == extension) {
            files.push(entry.into_path());
        }
    }
    files.sort();
    Ok(files)
}

fn stem(path: &Path, root: &str) -> String {
    let inner = path.strip_prefix(root).expect("found below the root");
    inner.with_extension("").display().to_string()
}

fn spirv_path(name: &str) -> PathBuf {
    Path::new("spirv").join(name).with_extension("spv")
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}
