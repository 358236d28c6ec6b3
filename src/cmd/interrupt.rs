//! Ctrl-C handling: the current work is completed and checkpointed; a second Ctrl-C exits at once.

use std::path::PathBuf;
use std::process::{Command, Output};
#[cfg(unix)]
use std::sync::atomic::AtomicU32;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::json;

use super::common::{print_json, say};
use splat4d::{Error, Result};

/// Exit code that shells report for a program ended by SIGINT.
pub const EXIT_CODE: u8 = 130;

static REQUESTED: AtomicBool = AtomicBool::new(false);
/// Whether the answer is being printed, or the program exits without one.
static ENDING: AtomicBool = AtomicBool::new(false);
/// Process id of the awaited child; 0 for none.
#[cfg(unix)]
static WAITED_FOR: AtomicU32 = AtomicU32::new(0);

/// Installs the handlers. Where the system does not allow it, Ctrl-C ends the program as usual. With
/// `json`, a program that exits at once still prints its one object.
pub fn watch(json: bool) {
    let installed = listen(move || {
        pass_on();
        if !REQUESTED.swap(true, Ordering::SeqCst) {
            return say("stopping; once more to stop at once");
        }
        if !ENDING.swap(true, Ordering::SeqCst) && json {
            // The program exits whether or not the output is read.
            let _ = print_json(&json!({ "error": "stopped at once" }));
        }
        exit_at_once();
    });
    if let Err(error) = installed {
        say(&format!("note: Ctrl-C ends without tidying up: {error}"));
    }
}

/// Exits while other threads are working. The exit handlers of drivers would free memory that those threads
/// use, so they must not run.
#[cfg(unix)]
fn exit_at_once() -> ! {
    signal_hook::low_level::exit(EXIT_CODE.into())
}

#[cfg(not(unix))]
fn exit_at_once() -> ! {
    std::process::exit(EXIT_CODE.into())
}

/// Calls `stop` on Ctrl-C, SIGTERM and SIGHUP. A file that grows beyond `ulimit -f` becomes a write error
/// and no longer ends the program.
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

/// Runs another process of this program. The system stops it together with this one.
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

/// Runs another process of this program, and stops it when this one is stopped. It has its own process
/// group, because otherwise a terminal's Ctrl-C would reach it as well, and a second signal ends it at
/// once.
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

/// Sends SIGINT to the awaited child, through a shell, because std has no way and others need unsafe code.
#[cfg(unix)]
fn pass_on() {
    let process = WAITED_FOR.load(Ordering::SeqCst);
    if process != 0 {
        // A child that has ended cannot receive the signal.
        let _ = shell("kill -s INT \"$0\"").arg(process.to_string()).status();
    }
}

/// A shell command without output.
#[cfg(unix)]
fn shell(script: &str) -> Command {
    use std::process::Stdio;
    let mut shell = Command::new("sh");
    shell.args(["-c", script]);
    shell.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    shell
}

/// Whether the program was started with hangups ignored, as by `nohup`. Child processes inherit ignored
/// signals, so a shell that sends itself one is used as a probe: POSIX has no other way without unsafe
/// code.
#[cfg(unix)]
fn hangups_are_ignored() -> bool {
    shell("kill -s HUP $$").status().is_ok_and(|status| status.success())
}

/// Called when the work is done or has failed: from now on, stdout belongs to the answer.
pub fn end() {
    if ENDING.swap(true, Ordering::SeqCst) {
        // The program is exiting at once.
        loop {
            std::thread::park();
        }
    }
}

/// Whether the user has requested a stop.
pub fn requested() -> bool {
    REQUESTED.load(Ordering::SeqCst)
}

/// Returns an error once the user has requested a stop.
pub fn check() -> Result<()> {
    stopped(None)
}

/// Returns an error once the user has requested a stop; it names the checkpoint.
pub fn stopped(checkpoint: Option<PathBuf>) -> Result<()> {
    if requested() { Err(Error::Interrupted { checkpoint }) } else { Ok(()) }
}
