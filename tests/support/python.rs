//! Python packages that `tools/setup.sh test` installs beside the build directory.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::Value;

/// Runs a script of `tests/support` with `asked` as JSON on its standard input, and returns the JSON that
/// it prints.
#[allow(dead_code, reason = "each test binary uses its own part")]
pub fn answer(environment: &str, probe: &str, script: &str, asked: &Value) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/support").join(script);
    let mut child = Command::new(python(environment, probe))
        .arg(&script)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(asked.to_string().as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{} failed", script.display());
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A Python that can run `probe`: that of an environment of `tools/setup.sh`, else the user's. Without
/// one the test fails, since a skipped comparison would test nothing.
pub fn python(environment: &str, probe: &str) -> PathBuf {
    let beside = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap().join(environment);
    let beside = beside.join("bin/python");
    let fits = |python: &PathBuf| {
        let mut command = Command::new(python);
        command.args(["-c", probe]).stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success())
    };
    [beside.clone(), "python3".into()].into_iter().find(fits).unwrap_or_else(|| {
        panic!(
            "neither {} nor python3 runs `{probe}`; tools/setup.sh test installs what is missing",
            beside.display()
        )
    })
}
