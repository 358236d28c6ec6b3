//! Checkpoints of long commands: the folder `OUTPUT.checkpoint` beside the output.

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
}

/// What may lie in the folder.
const PARTS: [&str; 2] = ["track", "training"];

impl Checkpoints {
    /// For the command that writes `output`; only checkpoints of the same identity are of use to it.
    pub fn new(output: &Path, args: &CheckpointArgs, identity: Identity) -> Checkpoints {
        let folder = folder(output);
        let found = PARTS.iter().any(|part| folder.join(part).exists());
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
        match write_state(&self.folder.join(part), part, &self.identity, value) {
            Ok(()) => self.usable = true,
            Err(error) => {
                // Unless an earlier checkpoint lies there, the folder is empty.
                let _ = std::fs::remove_dir(&self.folder);
                say(&format!("note: no checkpoint could be written: {error}; going on"));
            }
        }
        self.saved = Instant::now();
    }

    /// Fails once the user has asked to stop, naming what to resume from.
    pub fn interrupt(&self) -> Result<()> {
        interrupt::stopped(self.usable.then(|| self.folder.clone()))
    }

    /// Takes the checkpoints away: the work is done, and one that stays does not undo it. A folder that
    /// holds anything else stays.
    pub fn remove(self) {
        for path in PARTS.map(|part| self.folder.join(part)) {
            if path.exists()
                && let Err(error) = std::fs::remove_file(&path)
            {
                say(&format!("note: {} stays behind: {error}", path.display()));
            }
        }
        let _ = std::fs::remove_dir(&self.folder);
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
