//! Checkpoints of long commands: the folder `OUTPUT.checkpoint` beside the output.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use serde::Serialize;
use serde::de::DeserializeOwned;
use splat4d::io::{Identity, checksum, read_state, write_state};
use splat4d::{Error, Result};

use super::common::say;
use super::{interrupt, values};

/// Options of commands that can be resumed.
#[derive(Args)]
pub struct CheckpointArgs {
    /// Resume from the last checkpoint of the same command, if there is one
    #[arg(long)]
    resume: bool,
    /// Seconds between checkpoints, which are kept in OUTPUT.checkpoint until the work is done; 0: no
    /// checkpoints
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0,
          value_parser = values::number(0.0..=values::MOST_SECONDS))]
    checkpoint_every: f64,
}

/// Everything that a command's result depends on: each of its options under the option's name, so that a
/// run that resumes another can report what has changed.
pub fn identity<const N: usize>(entries: [(&str, String); N]) -> Identity {
    entries.map(|(name, value)| (name.to_owned(), value)).into()
}

/// An option's value as an entry of an identity.
pub fn shown(value: Option<impl ToString>) -> String {
    value.map_or_else(|| "none".into(), |value| value.to_string())
}

/// Checksum of an option's file contents, as an entry of an identity.
pub fn summed(value: Option<&(impl Serialize + ?Sized)>) -> String {
    shown(value.map(|value| format!("a file or folder with the checksum {}", checksum(value))))
}

impl CheckpointArgs {
    /// Checks that checkpoints can be written, before long work begins.
    pub fn check(&self, output: &Path) -> Result<()> {
        let folder = folder(output);
        if (self.resume || self.checkpoint_every > 0.0)
            && std::fs::symlink_metadata(&folder).is_ok()
            && !folder.is_dir()
        {
            let what = "is no folder, and checkpoints are to lie in it; move it away, or go without \
                        them by --checkpoint-every 0";
            return Err(Error::format(folder, what));
        }
        Ok(())
    }
}

/// The checkpoint folder of the command that writes `output`.
fn folder(output: &Path) -> PathBuf {
    let mut folder = output.as_os_str().to_owned();
    folder.push(".checkpoint");
    folder.into()
}

/// Writes and reads the checkpoints of a command.
pub struct Checkpoints {
    folder: PathBuf,
    identity: Identity,
    resume: bool,
    every: Duration,
    saved: Instant,
    /// Whether there is a checkpoint to resume from.
    usable: bool,
    /// Whether the checkpoint of an earlier run still has to be replaced.
    stale: bool,
    /// Parts of the tracking for the next checkpoint.
    waiting: BTreeMap<String, Vec<u8>>,
}

/// Possible files in the folder.
const PARTS: [&str; 2] = ["track", "training"];
/// Subfolder for the parts of an unfinished tracking, one file each.
const TRACKING: &str = "tracking";
/// Size of the waiting parts above which a checkpoint is written, bytes.
const MOST_WAITING: usize = 256 << 20;

impl Checkpoints {
    /// Checkpoints of the command that writes `output`; only those with the same identity can be resumed.
    pub fn new(output: &Path, args: &CheckpointArgs, identity: Identity) -> Checkpoints {
        let folder = folder(output);
        let found = PARTS.iter().chain([&TRACKING]).any(|part| folder.join(part).exists());
        let shown = folder.display();
        match (args.resume, found) {
            (true, false) => {
                say(&format!("note: there is no {shown} to resume from; beginning anew"))
            }
            (false, true) => say(&format!(
                "note: {shown} is left of an earlier run and will be replaced; --resume goes on from it"
            )),
            _ => {}
        }
        Checkpoints {
            identity,
            resume: args.resume,
            every: Duration::from_secs_f64(args.checkpoint_every),
            saved: Instant::now(),
            usable: args.resume && found,
            stale: !args.resume && found,
            waiting: BTreeMap::new(),
            folder,
        }
    }

    /// Loads a part that an earlier run has written, if this run resumes it.
    pub fn load<T: DeserializeOwned>(&self, part: &'static str) -> Result<Option<T>> {
        let path = self.folder.join(part);
        if !self.resume || !path.exists() {
            return Ok(None);
        }
        read_state(&path, part, &self.identity).map(Some)
    }

    /// Whether the next checkpoint is due.
    pub fn due(&self) -> bool {
        !self.every.is_zero() && self.saved.elapsed() >= self.every
    }

    /// Writes a part of the work, unless checkpoints are off. If writing fails (for example on a full
    /// disk), the work continues, and the previous checkpoint remains.
    pub fn save<T: Serialize>(&mut self, part: &'static str, value: &T) {
        debug_assert!(PARTS.contains(&part));
        if self.every.is_zero() {
            return;
        }
        self.replace_stale();
        self.concluded(write_state(&self.folder.join(part), part, &self.identity, value));
    }

    /// Whether checkpoints are on.
    pub fn are_on(&self) -> bool {
        !self.every.is_zero()
    }

    /// Adds a part of the tracking to the next checkpoint. It replaces the parts below it, whose names
    /// begin with its name and a `/`.
    pub fn keep(&mut self, part: &str, value: Vec<u8>) {
        let within = format!("{part}/");
        self.waiting.retain(|name, _| !name.starts_with(&within));
        self.waiting.insert(part.into(), value);
        if self.due() || self.waiting.values().map(Vec::len).sum::<usize>() > MOST_WAITING {
            self.put_away();
        }
    }

    /// Loads a part of the tracking that an earlier run has written, if this run resumes it.
    pub fn kept(&self, part: &str) -> Result<Option<Vec<u8>>> {
        let path = self.tracking_file(part);
        if !self.resume || !path.exists() {
            return Ok(None);
        }
        read_state(&path, TRACKING, &self.identity).map(Some)
    }

    /// Writes the completed tracking, which makes its parts obsolete.
    pub fn tracked<T: Serialize>(&mut self, track: &T) {
        self.waiting.clear();
        self.save("track", track);
        if self.folder.join("track").exists() {
            self.remove_tracking();
        }
    }

    fn tracking_file(&self, part: &str) -> PathBuf {
        self.folder.join(TRACKING).join(part.replace('/', "."))
    }

    fn put_away(&mut self) {
        self.replace_stale();
        let parts = std::mem::take(&mut self.waiting);
        let written = parts.iter().try_for_each(|(part, value)| {
            write_state(&self.tracking_file(part), TRACKING, &self.identity, value)
        });
        if written.is_ok() {
            let outer: Vec<String> =
                parts.keys().map(|part| format!("{}.", part.replace('/', "."))).collect();
            for file in
                std::fs::read_dir(self.folder.join(TRACKING)).into_iter().flatten().flatten()
            {
                let name = file.file_name().to_string_lossy().into_owned();
                if outer.iter().any(|outer| name.starts_with(outer)) {
                    remove_file(&file.path());
                }
            }
        }
        self.concluded(written);
    }

    /// Called after a checkpoint was written or failed.
    fn concluded(&mut self, written: Result<()>) {
        match written {
            Ok(()) => self.usable = true,
            Err(error) => {
                // The folder is empty unless it contains an earlier checkpoint.
                let _ = std::fs::remove_dir(self.folder.join(TRACKING));
                let _ = std::fs::remove_dir(&self.folder);
                say(&format!("note: no checkpoint could be written: {error}; going on"));
            }
        }
        self.saved = Instant::now();
    }

    /// Called before the first checkpoint of a run that does not resume.
    fn replace_stale(&mut self) {
        if std::mem::take(&mut self.stale) {
            self.remove_all();
        }
    }

    /// Returns an error once the user has requested a stop; it names the checkpoint.
    pub fn interrupt(&self) -> Result<()> {
        interrupt::stopped(self.usable.then(|| self.folder.clone()))
    }

    /// Removes the checkpoints after the work is done; errors are not fatal. A folder with other contents
    /// is kept.
    pub fn remove(self) {
        self.remove_all();
    }

    fn remove_all(&self) {
        PARTS.iter().for_each(|part| remove_file(&self.folder.join(part)));
        self.remove_tracking();
        // A run that was killed while writing leaves a partial file.
        for file in std::fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let name = file.file_name().to_string_lossy().into_owned();
            if name.starts_with(".splat4d-") && name.ends_with(".part") {
                remove_file(&file.path());
            }
        }
        let _ = std::fs::remove_dir(&self.folder);
    }

    fn remove_tracking(&self) {
        let folder = self.folder.join(TRACKING);
        for file in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            remove_file(&file.path());
        }
        let _ = std::fs::remove_dir(&folder);
    }
}

/// Removes a file if it exists; a failure is reported.
fn remove_file(path: &Path) {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            say(&format!("note: {} stays behind: {error}", path.display()));
        }
        _ => {}
    }
}

#[cfg(test)]
pub mod tests {
    use super::super::{Cli, Command, Common};
    use super::*;
    use clap::{CommandFactory, Parser};

    /// Options that affect where and when something is written, but not the result.
    const WITHOUT_EFFECT: [&str; 4] = ["output", "report", "resume", "checkpoint-every"];

    /// Asserts that a command's identity has an entry for each of its options.
    pub fn names_every_option(
        arguments: &[&str],
        without_effect: &[&str],
        identity: impl Fn(&Command, &Common) -> Identity,
    ) {
        let cli = Cli::try_parse_from(["splat4d"].iter().chain(arguments)).unwrap();
        let found = identity(&cli.command, &cli.common);
        let declared = Cli::command();
        let declared = declared.find_subcommand(arguments[0]).unwrap();
        let names = declared.get_arguments().filter_map(|argument| argument.get_long());
        for name in names.chain(["seed"]) {
            let entry = format!("--{name}");
            let named = found.keys().any(|key| key.split([' ', ',']).any(|word| word == entry));
            let none = WITHOUT_EFFECT.contains(&name) || without_effect.contains(&name);
            assert!(named != none, "{entry} in {found:?}");
        }
    }
}
