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

/// The flags of commands that can be resumed.
#[derive(Args)]
pub struct CheckpointArgs {
    /// Go on from the last checkpoint of the same command, where there is one
    #[arg(long)]
    resume: bool,
    /// Seconds between checkpoints, which lie in OUTPUT.checkpoint until the work is done; 0: none
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0,
          value_parser = values::number(0.0..=values::MOST_SECONDS))]
    checkpoint_every: f64,
}

/// What a command's work depends on: each of its options under the option's name, so that a run that
/// resumes another can be told in these words what has changed.
pub fn identity<const N: usize>(entries: [(&str, String); N]) -> Identity {
    entries.map(|(name, value)| (name.to_owned(), value)).into()
}

/// An option's value as an entry of an identity.
pub fn shown(value: Option<impl ToString>) -> String {
    value.map_or_else(|| "none".into(), |value| value.to_string())
}

/// What an option's files hold, as an entry of an identity.
pub fn summed(value: Option<&(impl Serialize + ?Sized)>) -> String {
    shown(value.map(|value| format!("a file or folder with the checksum {}", checksum(value))))
}

impl CheckpointArgs {
    /// That checkpoints can lie where they would, before long work begins.
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

/// Where the checkpoints of the command lie that writes `output`.
fn folder(output: &Path) -> PathBuf {
    let mut folder = output.as_os_str().to_owned();
    folder.push(".checkpoint");
    folder.into()
}

/// What is put away of a command's work, and when.
pub struct Checkpoints {
    folder: PathBuf,
    identity: Identity,
    resume: bool,
    every: Duration,
    saved: Instant,
    /// Whether something to resume from is there.
    usable: bool,
    /// Whether what an earlier run has left is still to be replaced.
    stale: bool,
    /// Parts of the tracking that the next checkpoint puts away.
    waiting: BTreeMap<String, Vec<u8>>,
}

/// What may lie in the folder.
const PARTS: [&str; 2] = ["track", "training"];
/// A folder in it: the parts of a tracking under way, a file each.
const TRACKING: &str = "tracking";
/// Parts of the tracking wait for a checkpoint until they are so many bytes.
const MOST_WAITING: usize = 256 << 20;

impl Checkpoints {
    /// For the command that writes `output`; only checkpoints of the same identity are of use to it.
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

    /// What an earlier run has put away, if this one resumes it.
    pub fn load<T: DeserializeOwned>(&self, part: &'static str) -> Result<Option<T>> {
        let path = self.folder.join(part);
        if !self.resume || !path.exists() {
            return Ok(None);
        }
        read_state(&path, part, &self.identity).map(Some)
    }

    /// Whether it is time for a checkpoint.
    pub fn due(&self) -> bool {
        !self.every.is_zero() && self.saved.elapsed() >= self.every
    }

    /// Puts a part of the work away, unless checkpoints are off. Where that fails (a full disk), the
    /// work goes on: it is worth more than its checkpoint, and the one before is still there.
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

    /// Takes a part of the tracking, to be put away with the next checkpoint. It takes the place of
    /// those within it, whose names begin with its own and a `/`.
    pub fn keep(&mut self, part: &str, value: Vec<u8>) {
        let within = format!("{part}/");
        self.waiting.retain(|name, _| !name.starts_with(&within));
        self.waiting.insert(part.into(), value);
        if self.due() || self.waiting.values().map(Vec::len).sum::<usize>() > MOST_WAITING {
            self.put_away();
        }
    }

    /// A part of the tracking that an earlier run has put away, if this one resumes it.
    pub fn kept(&self, part: &str) -> Result<Option<Vec<u8>>> {
        let path = self.tracking_file(part);
        if !self.resume || !path.exists() {
            return Ok(None);
        }
        read_state(&path, TRACKING, &self.identity).map(Some)
    }

    /// The whole tracking is done: its parts are of no use any more.
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

    /// After a checkpoint was written or could not be.
    fn concluded(&mut self, written: Result<()>) {
        match written {
            Ok(()) => self.usable = true,
            Err(error) => {
                // Unless an earlier checkpoint lies there, the folder is empty.
                let _ = std::fs::remove_dir(self.folder.join(TRACKING));
                let _ = std::fs::remove_dir(&self.folder);
                say(&format!("note: no checkpoint could be written: {error}; going on"));
            }
        }
        self.saved = Instant::now();
    }

    /// Before the first checkpoint of a run that begins anew.
    fn replace_stale(&mut self) {
        if std::mem::take(&mut self.stale) {
            self.remove_all();
        }
    }

    /// Fails once the user has asked to stop, naming what to resume from.
    pub fn interrupt(&self) -> Result<()> {
        interrupt::stopped(self.usable.then(|| self.folder.clone()))
    }

    /// Takes the checkpoints away: the work is done, and one that stays does not undo it. A folder that
    /// holds anything else stays.
    pub fn remove(self) {
        self.remove_all();
    }

    fn remove_all(&self) {
        PARTS.iter().for_each(|part| remove_file(&self.folder.join(part)));
        self.remove_tracking();
        // A run that was killed while it wrote leaves the half of a file.
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

/// Removes a file, if it is there; one that stays is told.
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

    /// Options that decide where something is written, and when, but not what.
    const WITHOUT_EFFECT: [&str; 4] = ["output", "report", "resume", "checkpoint-every"];

    /// That a command's identity has an entry for each of its options.
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
