//! What the packages that are built on this platform demand: their licences are in the list of deny.toml, and
//! none needs a newer Rust than Cargo.toml states. Needs no device.

use serde_json::Value;
use spdx::{Expression, LicenseReq, Licensee};
use std::process::Command;

#[test]
fn every_dependency_has_an_allowed_licence() {
    let packages = packages();
    let policy = policy();
    assert!(packages.len() > 200, "{} packages: the list is not whole", packages.len());
    let refused: Vec<String> = packages
        .iter()
        .filter(|package| !policy.allows(&package.name, &package.licence))
        .map(|package| format!("{}: {}", package.name, package.licence))
        .collect();
    assert!(refused.is_empty(), "not allowed by deny.toml:\n{}", refused.join("\n"));
}

/// clippy holds the code itself against `rust-version`, by the versions of the standard library's items.
#[test]
fn no_dependency_needs_a_newer_rust() {
    let stated = rust_version(env!("CARGO_PKG_RUST_VERSION"));
    let packages = packages();
    let told = packages.iter().filter(|package| package.rust.is_some()).count();
    assert!(told > 100, "{told} packages state a version of Rust: the list is not whole");
    let newer: Vec<String> = packages
        .iter()
        .filter_map(|package| Some((package, package.rust.as_deref()?)))
        .filter(|(_, rust)| rust_version(rust) > stated)
        .map(|(package, rust)| format!("{} needs Rust {rust}", package.name))
        .collect();
    assert!(newer.is_empty(), "newer than rust-version in Cargo.toml:\n{}", newer.join("\n"));
}

/// `1.90` or `1.90.1` as numbers, of which missing ones are 0.
fn rust_version(text: &str) -> [u32; 3] {
    let mut parts = text.split('.').map(|part| part.parse().unwrap());
    std::array::from_fn(|_| parts.next().unwrap_or(0))
}

#[test]
fn alternatives_conjunctions_and_exceptions_are_understood() {
    let policy = policy();
    assert!(policy.allows("any", "GPL-3.0-only OR MIT"));
    assert!(policy.allows("any", "MIT/Apache-2.0"));
    assert!(!policy.allows("any", "GPL-3.0-only AND MIT"));
    assert!(!policy.allows("any", "GPL-3.0-only"));
    assert!(!policy.allows("any", ""));
    assert!(policy.allows("cbindgen", "MPL-2.0") && !policy.allows("any", "MPL-2.0"));
}

/// The licences of deny.toml: for all packages, and in addition for single ones.
struct Policy {
    allow: Vec<Licensee>,
    exceptions: Vec<(String, Vec<Licensee>)>,
}

impl Policy {
    /// Whether one of the combinations that an SPDX expression offers is allowed for a package.
    fn allows(&self, package: &str, licence: &str) -> bool {
        // Old manifests separate alternatives by a slash.
        let Ok(expression) = Expression::parse(&licence.replace('/', " OR ")) else { return false };
        let own = self.exceptions.iter().filter(|(name, _)| name == package).flat_map(|e| &e.1);
        let allowed: Vec<&Licensee> = self.allow.iter().chain(own).collect();
        expression.evaluate(|need: &LicenseReq| allowed.iter().any(|one| one.satisfies(need)))
    }
}

fn policy() -> Policy {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/deny.toml")).unwrap();
    let table: toml::Table = text.parse().unwrap();
    let listed = |value: &toml::Value| -> Vec<Licensee> {
        let names = value.as_array().unwrap().iter().map(|name| name.as_str().unwrap());
        names.map(|name| Licensee::parse(name).unwrap()).collect()
    };
    let licenses = &table["licenses"];
    let exception =
        |one: &toml::Value| (one["crate"].as_str().unwrap().to_owned(), listed(&one["allow"]));
    Policy {
        allow: listed(&licenses["allow"]),
        exceptions: licenses["exceptions"].as_array().unwrap().iter().map(exception).collect(),
    }
}

/// A package as its manifest describes it.
struct Package {
    name: String,
    /// An SPDX expression; empty if there is none.
    licence: String,
    /// The least version of Rust, if it is stated.
    rust: Option<String>,
}

/// Every package of the workspace's dependency tree on this platform. Packages of other platforms may not have
/// been downloaded.
fn packages() -> Vec<Package> {
    let version = run("RUSTC", "rustc", &["-vV"]);
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).unwrap();
    let metadata = run(
        "CARGO",
        "cargo",
        &["metadata", "--format-version", "1", "--locked", "--filter-platform", host],
    );
    let metadata: Value = serde_json::from_str(&metadata).unwrap();
    let package = |value: &Value| {
        let text = |key: &str| value[key].as_str().map(str::to_owned);
        Package {
            name: text("name").unwrap_or_default(),
            licence: text("license").unwrap_or_default(),
            rust: text("rust_version"),
        }
    };
    metadata["packages"].as_array().unwrap().iter().map(package).collect()
}

/// What a program of the toolchain prints; `variable` names another one to run.
fn run(variable: &str, program: &str, arguments: &[&str]) -> String {
    let program = std::env::var_os(variable).unwrap_or_else(|| program.into());
    let root = env!("CARGO_MANIFEST_DIR");
    let output = Command::new(program).args(arguments).current_dir(root).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}
