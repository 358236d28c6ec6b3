//! Checks that a constant which GLSL and Rust both spell has one value.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Parts of the crate whose constants the shaders share.
const SHARING: &[&str] = &["kernels", "ops", "oracle", "types"];

/// Constants of Rust, by file and name, that have another meaning than the shaders' of the same name.
pub const OTHERS: &[(&str, &str)] = &[
    // Words between two counters, not pixels between two patches.
    ("src/ops/adam.rs", "STRIDE"),
    // The oracle integrates in finer steps.
    ("src/oracle/density.rs", "STEP"),
    // Features and rows that an invocation of the network computes, not pixels.
    ("src/ops/mlp.rs", "TILE"),
    // The largest number that half precision holds, not half the window.
    ("src/types/range.rs", "HALF"),
];

/// A constant with its value.
#[derive(Clone, Debug, PartialEq)]
pub struct Constant {
    pub file: String,
    pub name: String,
    pub value: f64,
}

/// The numeric constants of the shaders.
pub fn of_shaders(root: &Path) -> Vec<Constant> {
    let folder = root.join("glsl");
    let sources = ["comp", "glsl"].into_iter().flat_map(|e| super::files(&folder, e));
    sources.flat_map(|path| of_file(root, &path)).collect()
}

/// The numeric constants of the parts of the crate that share them, tests left out.
pub fn of_crate(root: &Path) -> Vec<Constant> {
    let folders = SHARING.iter().map(|part| root.join("src").join(part));
    folders
        .flat_map(|folder| super::files(&folder, "rs"))
        .filter(|path| !path.to_string_lossy().ends_with("tests.rs"))
        .flat_map(|path| of_file(root, &path))
        .collect()
}

fn of_file(root: &Path, path: &Path) -> Vec<Constant> {
    let text = fs::read_to_string(path).expect("a readable source file");
    let file = path.strip_prefix(root).expect("below the root").display().to_string();
    let code = text.split("\nmod tests").next().expect("the text before the tests");
    let constants = constants(code).into_iter();
    constants.map(|(name, value)| Constant { file: file.clone(), name, value }).collect()
}

/// The constants of a source text in GLSL or Rust whose value is a product of numbers and of constants
/// above. A specialisation constant is none: the declaration of its kernel is held against the module.
pub fn constants(source: &str) -> BTreeMap<String, f64> {
    let mut found = BTreeMap::new();
    for line in source.lines() {
        let line = line.trim_start();
        let Some((_, definition)) = line.split_once("const ").filter(|(before, _)| {
            before.is_empty() || before.starts_with("pub ") || before.starts_with("pub(")
        }) else {
            continue;
        };
        let Some((declared, value)) = definition.split_once(" = ") else { continue };
        // `NAME: type` in Rust, `type NAME` in GLSL.
        let name = match declared.split_once(':') {
            Some((name, _)) => name,
            None => declared.rsplit(' ').next().expect("split gives a part"),
        };
        let value = value.split(';').next().expect("split gives a part");
        let factors = value.split('*').map(|factor| match found.get(factor.trim()) {
            Some(&known) => Some(known),
            None => number(factor.trim()),
        });
        if let Some(value) = factors.product::<Option<f64>>() {
            found.insert(name.to_owned(), value);
        }
    }
    found
}

/// A literal of GLSL or Rust.
fn number(text: &str) -> Option<f64> {
    if text == "u32::MAX" {
        return Some(f64::from(u32::MAX));
    }
    let text = text.replace('_', "");
    if let Some(digits) = text.strip_prefix("0x") {
        return u32::from_str_radix(digits.trim_end_matches('u'), 16).ok().map(f64::from);
    }
    text.trim_end_matches('u').parse().ok()
}

/// The constants of one name that differ, as messages. Those of [`OTHERS`] are left out.
pub fn differences(shaders: &[Constant], rust: &[Constant]) -> Vec<String> {
    let mut wrong = Vec::new();
    for glsl in shaders {
        let shares = |c: &&Constant| {
            c.name == glsl.name && !OTHERS.contains(&(c.file.as_str(), c.name.as_str()))
        };
        for other in rust.iter().chain(shaders).filter(shares) {
            if other.value != glsl.value {
                wrong.push(format!(
                    "{} is {} in {}, {} in {}",
                    glsl.name, glsl.value, glsl.file, other.value, other.file
                ));
            }
        }
    }
    wrong
}
