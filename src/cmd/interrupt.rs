//! Ctrl-C: the work at hand is finished and put away; a second one ends at once.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use super::common::say;
use splat4d::{Error, Result};

/// What shells report for a program that SIGINT ended.
pub const EXIT_CODE: u8 = 130;

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// Begins to listen. Where the system does not allow it, Ctrl-C ends the program as usual.
pub fn watch() {
    let installed = ctrlc::set_handler(|| {
        if REQUESTED.swap(true, Ordering::SeqCst) {
            std::process::exit(EXIT_CODE.into());
        }
        say("stopping; once more to stop at once");
    });
    if let Err(error) = installed {
        say(&format!("note: Ctrl-C ends without tidying up: {error}"));
    }
}

/// Whether the user has asked to stop.
pub fn requested() -> bool {
    REQUESTED.load(Ordering::SeqCst)
}

/// Fails once the user has asked to stop.
pub fn check() -> Result<()> {
    stopped(None)
}

/// Fails once the user has asked to stop, naming what to resume from.
pub fn stopped(checkpoint: Option<PathBuf>) -> Result<()> {
    if requested() { Err(Error::Interrupted { checkpoint }) } else { Ok(()) }
}
