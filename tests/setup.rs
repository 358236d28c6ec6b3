//! What `tools/setup.sh` does about Rust: which versions it accepts, and that it installs a newer one, says so
//! before, and does neither if it must not. Needs no network: the programs that it would run are stand-ins.

#![cfg(unix)]

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The version that the crate wants: major and minor.
const WANTED: &str = env!("CARGO_PKG_RUST_VERSION");

/// Programs that setup.sh itself uses, and those whose absence it would otherwise repair.
const TOOLS: &[&str] = &[
    "bash", "sh", "cat", "cc", "chmod", "curl", "cut", "dirname", "env", "ffmpeg", "head", "id",
    "mkdir", "sed", "sort",
];

/// A home and a path on which nothing but stand-ins is found.
struct Machine {
    folder: tempfile::TempDir,
}

/// What setup.sh printed, and whether it succeeded.
struct Outcome {
    text: String,
    succeeded: bool,
}

impl Machine {
    /// With a Rust of `version` on the path, if any.
    fn with_rust(version: Option<&str>) -> Self {
        let machine = Self { folder: tempfile::tempdir().unwrap() };
        fs::create_dir(machine.bin()).unwrap();
        let path = std::env::var_os("PATH").unwrap();
        for tool in TOOLS.iter().filter(|tool| **tool != "curl") {
            let found = std::env::split_paths(&path)
                .map(|folder| folder.join(tool))
                .find(|file| file.exists());
            symlink(
                found.unwrap_or_else(|| panic!("{tool} is on the path")),
                machine.bin().join(tool),
            )
            .unwrap();
        }
        // If something else is missing here, the test says so and installs nothing.
        machine.program("apt-get", "exit 0");
        if let Some(version) = version {
            machine.program("cargo", "exit 0");
            machine.program("rustc", &format!("echo 'rustc {version} (0123456 2026-01-01)'"));
        }
        machine
    }

    fn bin(&self) -> PathBuf {
        self.folder.path().join("bin")
    }

    fn program(&self, name: &str, body: &str) {
        let file = self.bin().join(name);
        fs::write(&file, format!("#!/bin/sh\n{body}\n")).unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
    }

    /// A `curl` that gives an installer, which puts a Rust of `version` into the home and prints its arguments.
    fn with_installer(self, version: &str) -> Self {
        let script = format!(
            "cat <<'END'\n\
             echo \"installer: $*\"\n\
             mkdir -p \"$CARGO_HOME/bin\"\n\
             echo \"PATH=$CARGO_HOME/bin:\\$PATH\" >\"$CARGO_HOME/env\"\n\
             printf '#!/bin/sh\\necho rustc {version}\\n' >\"$CARGO_HOME/bin/rustc\"\n\
             printf '#!/bin/sh\\n' >\"$CARGO_HOME/bin/cargo\"\n\
             chmod 755 \"$CARGO_HOME/bin/rustc\" \"$CARGO_HOME/bin/cargo\"\n\
             END"
        );
        self.program("curl", &script);
        self
    }

    fn setup(&self, variables: &[(&str, &str)]) -> Outcome {
        let home = self.folder.path();
        let output = Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/setup.sh"))
            .arg("run")
            .env_clear()
            .env("PATH", self.bin())
            .env("HOME", home)
            .env("CARGO_HOME", home.join("cargo"))
            .envs(variables.iter().copied())
            .output()
            .unwrap();
        let text = [output.stdout, output.stderr].concat();
        Outcome { text: String::from_utf8(text).unwrap(), succeeded: output.status.success() }
    }
}

/// A version of the wanted major number with another minor one.
fn version(minor: impl Fn(u32) -> u32, rest: &str) -> String {
    let (major, wanted) = WANTED.split_once('.').unwrap();
    format!("{major}.{}{rest}", minor(wanted.parse().unwrap()))
}

#[test]
fn a_new_enough_rust_is_left_alone() {
    for found in [
        version(|minor| minor, ".0"),
        version(|minor| minor, ".0-nightly"),
        version(|minor| minor + 1, ".2"),
        // Numbers are compared, not text.
        version(|minor| 10 * minor, ".0"),
        "2.0.0".to_owned(),
    ] {
        let outcome = Machine::with_rust(Some(&found)).setup(&[]);
        assert!(outcome.succeeded, "{found}: {}", outcome.text);
        assert!(outcome.text.contains(&format!("is there (Rust {found})")), "{}", outcome.text);
    }
}

#[test]
fn a_missing_or_old_rust_is_replaced_and_that_is_said() {
    let new = version(|minor| minor, ".1");
    for found in [
        None,
        Some(version(|minor| minor - 1, ".9")),
        Some(version(|minor| minor / 10, ".0")),
        Some("0.99.0".to_owned()),
    ] {
        let outcome = Machine::with_rust(found.as_deref()).with_installer(&new).setup(&[]);
        assert!(outcome.succeeded, "{found:?}: {}", outcome.text);
        let said = outcome.text.find("running its own installer").expect("an announcement");
        let ran =
            outcome.text.find("installer: -y --profile minimal").expect("the minimal profile");
        assert!(said < ran, "{}", outcome.text);
        assert!(outcome.text.contains(&format!("is there (Rust {new})")), "{}", outcome.text);
    }
}

#[test]
fn rustup_updates_what_it_installed() {
    let machine = Machine::with_rust(Some("1.0.0"));
    let rustc = machine.bin().join("rustc");
    let update = format!(
        "echo \"rustup: $*\"\nprintf '#!/bin/sh\\necho rustc 9.0.0\\n' >'{}'",
        rustc.display()
    );
    machine.program("rustup", &update);
    let outcome = machine.setup(&[]);
    assert!(outcome.succeeded, "{}", outcome.text);
    assert!(outcome.text.contains("\nrustup: update stable\n"), "{}", outcome.text);

    // The selected toolchain may be another than the updated one.
    machine.program("rustc", "echo rustc 1.0.0");
    machine.program("rustup", "exit 0");
    let outcome = machine.setup(&[]);
    assert!(
        !outcome.succeeded && outcome.text.contains("rustup default stable"),
        "{}",
        outcome.text
    );
}

#[test]
fn nothing_is_installed_where_that_is_forbidden() {
    for (found, why) in [(None, "or newer is missing"), (Some("1.0.0"), "Rust 1.0.0 is too old")] {
        let machine = Machine::with_rust(found).with_installer("9.0.0");
        let outcome = machine.setup(&[("SPLAT4D_NO_RUSTUP", "1")]);
        assert!(!outcome.succeeded, "{}", outcome.text);
        assert!(
            outcome.text.contains(why) && outcome.text.contains("https://sh.rustup.rs"),
            "{}",
            outcome.text
        );
        assert!(!machine.folder.path().join("cargo").exists());
    }
}
