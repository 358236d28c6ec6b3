//! Ctrl-C: the work at hand is finished and put away; a second one ends at once.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::json;

use super::common::{print_json, say};
use splat4d::{Error, Result};

/// What shells report for a program that SIGINT ended.
pub const EXIT_CODE: u8 = 130;

static REQUESTED: AtomicBool = AtomicBool::new(false);
/// Whether the answer is being printed, or the program ends without one.
static ENDING: AtomicBool = AtomicBool::new(false);

/// Begins to listen. Where the system does not allow it, Ctrl-C ends the program as usual. With `json`
/// a program that is ended at once still gives its one object.
pub fn watch(json: bool) {
    let installed = listen(move || {
        if !REQUESTED.swap(true, Ordering::SeqCst) {
            return say("stopping; once more to stop at once");
        }
        if !ENDING.swap(true, Ordering::SeqCst) && json {
            // Whether or not anyone reads it, this is the end.
            let _ = print_json(&json!({ "error": "stopped at once" }));
        }
        exit_at_once();
    });
    if let Err(error) = installed {
        say(&format!("note: Ctrl-C ends without tidying up: {error}"));
    }
}

/// Ends the program while other threads work: what drivers run at an ordinary exit would take their
/// memory from under them.
#[cfg(unix)]
fn exit_at_once() -> ! {
    signal_hook::low_level::exit(EXIT_CODE.into())
}

#[cfg(not(unix))]
fn exit_at_once() -> ! {
    std::process::exit(EXIT_CODE.into())
}

/// Calls `stop` on Ctrl-C, SIGTERM and SIGHUP. A file that grows beyond `ulimit -f` is an error of its
/// writer and no longer ends the program.
#[cfg(unix)]
fn listen(stop: impl Fn() + Send + 'static) -> std::io::Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
    let mut signals = signal_hook::iterator::Signals::new([SIGINT, SIGTERM, SIGXFSZ])?;
    if !hangups_are_ignored() {
        signals.add_signal(SIGHUP)?;
    }
    let listen = move || signals.forever().filter(|&signal| signal != SIGXFSZ).for_each(|_| stop());
    std::thread::Builder::new().name("signals".into()).spawn(listen).map(drop)
}

#[cfg(not(unix))]
fn listen(stop: impl Fn() + Send + 'static) -> std::io::Result<()> {
    ctrlc::set_handler(stop).map_err(std::io::Error::other)
}

/// Whether whoever started this program had it ignore hangups, as `nohup` does. A program that ignores a
/// signal hands that on to those that it starts, so that a shell that sends itself one is asked: POSIX
/// has no other way that needs no unsafe code.
#[cfg(unix)]
fn hangups_are_ignored() -> bool {
    use std::process::{Command, Stdio};
    let mut shell = Command::new("sh");
    shell.args(["-c", "kill -s HUP $$"]);
    let ended = shell.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status();
    ended.is_ok_and(|status| status.success())
}

/// The work is done or has failed: from now on, stdout belongs to its answer.
pub fn end() {
    if ENDING.swap(true, Ordering::SeqCst) {
        // The program is being ended at once.
        loop {
            std::thread::park();
        }
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
