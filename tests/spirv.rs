//! Checks by the manifest's hashes that the committed modules belong to the committed sources. Nothing is
//! compiled; `tools check` compiles and compares byte by byte.

use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

const ADVICE: &str = "run `cargo run --release -p tools -- build`";

#[test]
fn the_manifest_matches_sources_and_modules() {
    let manifest: toml::Table = read_text("spirv/manifest.toml").parse().unwrap();
    let flags = manifest["flags"].as_str().unwrap();
    let kernels = manifest["kernels"].as_table().unwrap();
    assert!(!kernels.is_empty());
    let mut wrong = Vec::new();
    for (name, entry) in kernels {
        let files: Vec<&str> =
            entry["files"].as_array().unwrap().iter().map(|file| file.as_str().unwrap()).collect();
        if files.first() != Some(&format!("glsl/{name}.comp").as_str()) {
            wrong.push(format!("{name}: its own source is not the first of its files"));
            continue;
        }
        let listed: BTreeSet<String> = files[1..].iter().map(|&file| file.to_owned()).collect();
        let named = includes(files[0]);
        if listed != named {
            wrong.push(format!(
                "{name}: the sources include {named:?}, the manifest says {listed:?}"
            ));
        }
        let mut source = Sha256::new();
        source.update(flags);
        for file in &files {
            source.update(read(file));
        }
        if hex(&source.finalize()) != entry["source"].as_str().unwrap() {
            wrong.push(format!("{name}: glsl/ has changed since it was compiled; {ADVICE}"));
        }
        let module = read(&format!("spirv/{name}.spv"));
        if hex(&Sha256::digest(module)) != entry["spirv"].as_str().unwrap() {
            wrong.push(format!("{name}: spirv/{name}.spv is not what was compiled; {ADVICE}"));
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

#[test]
fn no_include_is_left_over() {
    let manifest: toml::Table = read_text("spirv/manifest.toml").parse().unwrap();
    let used: BTreeSet<String> = manifest["kernels"]
        .as_table()
        .unwrap()
        .values()
        .flat_map(|entry| entry["files"].as_array().unwrap())
        .map(|file| file.as_str().unwrap().to_owned())
        .collect();
    for entry in fs::read_dir(root().join("glsl/common")).unwrap() {
        let name = entry.unwrap().file_name();
        let path = format!("glsl/common/{}", name.to_string_lossy());
        assert!(used.contains(&path), "no kernel includes {path}");
    }
}

/// All files that a file includes, directly and indirectly. An include that the preprocessor skips counts
/// here but not for the compiler; the shaders have none.
fn includes(file: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut open = vec![file.to_owned()];
    while let Some(file) = open.pop() {
        for line in read_text(&file).lines() {
            let Some(rest) = line.trim_start().strip_prefix("#include") else { continue };
            let name = rest.split('"').nth(1).expect("#include \"…\"");
            let path = format!("glsl/{name}");
            if found.insert(path.clone()) {
                open.push(path);
            }
        }
    }
    found
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

fn read(path: &str) -> Vec<u8> {
    fs::read(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn read_text(path: &str) -> String {
    String::from_utf8(read(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
