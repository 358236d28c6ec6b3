//! Ctrl-C: the work at hand is finished and put away; a second one ends at once.

use std::path::PathBuf;
use std::process::{Command, Output};
#[cfg(unix)]
use std::sync::atomic::AtomicU32;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::json;

use super::common::{print_json, say};
use splat4d::{Error, Result};

/// What shells report for a program that SIGINT ended.
pub const EXIT_CODE: u8 = 130;

static REQUESTED: AtomicBool = AtomicBool::new(false);
/// Whether the answer is being printed, or the program ends without one.
static ENDING: AtomicBool = AtomicBool::new(false);
/// The process that is waited for, by its number; 0: none.
#[cfg(unix)]
static WAITED_FOR: AtomicU32 = AtomicU32::new(0);

/// Begins to listen. Where the system does not allow it, Ctrl-C ends the program as usual. With `json`
/// a program that is ended at once still gives its one object.
pub fn watch(json: bool) {
    let installed = listen(move || {
        pass_on();
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

/// Runs another process of this program. The system stops it as it stops this one.
#[cfg(not(unix))]
pub fn run(command: &mut Command) -> std::io::Result<Output> {
    command.output()
}

#[cfg(not(unix))]
fn pass_on() {}

#[cfg(not(unix))]
fn listen(stop: impl Fn() + Send + 'static) -> std::io::Result<()> {
    ctrlc::set_handler(stop).map_err(std::io::Error::other)
}

/// Runs another process of this program, and stops it as this one is stopped. It has a process group of
/// its own: a terminal's Ctrl-C would reach it besides, and a second one ends it at once.
#[cfg(unix)]
pub fn run(command: &mut Command) -> std::io::Result<Output> {
    use std::os::unix::process::CommandExt;
    let child = command.process_group(0).spawn()?;
    WAITED_FOR.store(child.id(), Ordering::SeqCst);
    if requested() {
        pass_on();
    }
    let output = child.wait_with_output();
    WAITED_FOR.store(0, Ordering::SeqCst);
    output
}

/// Sends Ctrl-C to the process that is waited for. By a shell: std has no way, and others need unsafe code.
#[cfg(unix)]
fn pass_on() {
    let process = WAITED_FOR.load(Ordering::SeqCst);
    if process != 0 {
        // One that has ended cannot be told, and need not.
        let _ = shell("kill -s INT \"$0\"").arg(process.to_string()).status();
    }
}

/// A shell that is to run this, and says nothing.
#[cfg(unix)]
fn shell(script: &str) -> Command {
    use std::process::Stdio;
    let mut shell = Command::new("sh");
    shell.args(["-c", script]);
    shell.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    shell
}

/// Whether whoever started this program had it ignore hangups, as `nohup` does. A program that ignores a
/// signal hands that on to those that it starts, so that a shell that sends itself one is asked: POSIX
/// has no other way that needs no unsafe code.
#[cfg(unix)]
fn hangups_are_ignored() -> bool {
    shell("kill -s HUP $$").status().is_ok_and(|status| status.success())
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
