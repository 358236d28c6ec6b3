//! This program run by itself: a job's crash or memory does not take the others with it.

use std::ffi::OsString;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use splat4d::{Error, Result};

use super::interrupt;

/// How often it is asked whether the child has ended, or the user wants to stop.
const PATIENCE: Duration = Duration::from_millis(50);

/// Runs a command of this program and gives its JSON; what it says goes to `log`. Ctrl-C stops it, as it stops
/// by itself.
///
/// # Errors
/// The command failed, with the reason that its JSON gives; it cannot be started, or the log not be written;
/// the user has asked to stop.
pub fn run(arguments: &[OsString], log: &Path) -> Result<Value> {
    let program = std::env::current_exe().map_err(Error::io("this program"))?;
    let said = File::create(log).map_err(Error::io(log))?;
    let mut child = Command::new(&program)
        .args(arguments)
        .arg("--json")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(said)
        .spawn()
        .map_err(Error::io(&program))?;
    let stdout = child.stdout.take();
    // A pipe that nobody reads would stop the child once it is full.
    let reader = std::thread::spawn(move || {
        let mut text = String::new();
        let read = stdout.map(|mut stdout| stdout.read_to_string(&mut text));
        read.transpose().map(|_| text)
    });
    let ended = wait(&mut child).map_err(Error::io(&program));
    let text = reader.join();
    let status = ended?;
    interrupt::check()?;
    let text = text.unwrap_or_else(|_| Ok(String::new())).map_err(Error::io(&program))?;
    let answer: Option<Value> = serde_json::from_str(&text).ok();
    let log = log.display();
    match (answer, status.success()) {
        (Some(answer), true) => Ok(answer),
        (Some(answer), false) if answer["error"].is_string() => {
            let why = answer["error"].as_str().unwrap_or_default();
            Err(Error::Failed(format!("{why} (see {log})")))
        }
        _ => Err(Error::Failed(format!("it ended with {status} and no answer (see {log})"))),
    }
}

/// Waits for the child's end; once the user has asked to stop, asks it to stop as well.
fn wait(child: &mut Child) -> std::io::Result<std::process::ExitStatus> {
    let mut told = false;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if interrupt::requested() && !told {
            stop(child)?;
            told = true;
        }
        std::thread::sleep(PATIENCE);
    }
}

/// Asks a child to stop. One at a terminal has had the same Ctrl-C already, and a second would end it at once: it
/// gets SIGTERM only where there is no terminal that sends signals to both.
#[cfg(unix)]
fn stop(child: &mut Child) -> std::io::Result<()> {
    use std::io::IsTerminal;
    if std::io::stderr().is_terminal() {
        return Ok(());
    }
    let id = child.id().to_string();
    Command::new("kill").args(["-s", "TERM", &id]).stderr(Stdio::null()).status().map(drop)
}

#[cfg(not(unix))]
fn stop(child: &mut Child) -> std::io::Result<()> {
    child.kill()
}
