//! Runs this program as a child process, so that a crash or memory exhaustion of one job does not affect
//! the others.

use std::ffi::OsString;
use std::fs::File;
use std::process::{Command, ExitStatus, Output, Stdio};

use serde_json::Value;
use splat4d::{Error, Result};

use super::interrupt;

/// How a child process ended.
pub struct Ended {
    pub status: ExitStatus,
    /// Its JSON object; null if it printed none.
    pub answer: Value,
    /// Its messages, if they did not go elsewhere.
    pub messages: String,
}

/// Runs a command of this program with JSON output until it ends; its messages go to `log`.
///
/// # Errors
/// The command cannot be started; the user has requested a stop, which has stopped the child as well.
pub fn end_of(words: impl IntoIterator<Item = OsString>, log: impl Into<Stdio>) -> Result<Ended> {
    let program = std::env::current_exe().map_err(Error::io("splat4d"))?;
    let mut command = Command::new(&program);
    command.args(words).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
    let Output { status, stdout, stderr } =
        interrupt::run(&mut command).map_err(Error::io(program))?;
    let answer: Value = serde_json::from_slice(&stdout).unwrap_or_default();
    if !(status.success() && answer.is_object()) {
        interrupt::check()?;
    }
    Ok(Ended { status, answer, messages: String::from_utf8_lossy(&stderr).into_owned() })
}

/// Runs a command of this program with JSON output and returns its answer; its messages go to `log`.
///
/// # Errors
/// As of [`end_of`]; the command failed, with its reason.
pub fn run(words: impl IntoIterator<Item = OsString>, log: File) -> Result<Value> {
    let Ended { status, answer, .. } = end_of(words, log)?;
    if status.success() && answer.is_object() {
        return Ok(answer);
    }
    Err(Error::Failed(match answer["error"].as_str() {
        Some(error) => error.to_owned(),
        None => format!("its process ended without an answer ({status}); see its log"),
    }))
}
