//! Python packages that `tools/setup.sh test` installs beside the build.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A Python that runs `probe`: that of an environment of the setup's, else the user's. Where there is none
/// the test fails: a comparison that is passed over compares nothing.
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
