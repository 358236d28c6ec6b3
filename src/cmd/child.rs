//! Runs this program as a child process, so that a crash or memory exhaustion of one job does not affect
//! the others.

use std::ffi::OsString;
use std::fs::File;
use std::process::{Command, Stdio};

use serde_json::Value;
use splat4d::{Error, Result};

use super::interrupt;

/// Runs a command of this program with JSON output and returns its answer; its messages go to `log`.
///
/// # Errors
/// The command failed, with its reason; it cannot be started; the user has requested a stop, which has
/// stopped the child as well.
pub fn run(words: impl IntoIterator<Item = OsString>, log: File) -> Result<Value> {
    let program = std::env::current_exe().map_err(Error::io("splat4d"))?;
    let mut command = Command::new(&program);
    command.args(words).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
    let output = interrupt::run(&mut command).map_err(Error::io(program))?;
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    if output.status.success() && answer.is_object() {
        return Ok(answer);
    }
    interrupt::check()?;
    Err(Error::Failed(match answer["error"].as_str() {
        Some(error) => error.to_owned(),
        None => format!("its process ended without an answer ({}); see its log", output.status),
    }))
}
