//! `splat4d completions`: prints shell completion scripts.

use clap::{Args, CommandFactory};
use clap_complete::{Shell, generate};
use serde_json::json;
use splat4d::{Error, Result};

use super::Cli;
use super::common::Answer;

const AFTER_HELP: &str = "\
Where the script goes, for example:
  bash        ~/.local/share/bash-completion/completions/splat4d
  zsh         _splat4d, in a folder of $fpath
  fish        ~/.config/fish/completions/splat4d.fish
  powershell  a file that $PROFILE runs

Examples:
  splat4d completions bash > ~/.local/share/bash-completion/completions/splat4d
  splat4d completions fish | source

JSON: shell, script";

/// Print a shell script that completes commands and options
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Runs the command.
pub fn run(args: &CompletionsArgs) -> Result<Answer> {
    let mut script = Vec::new();
    generate(args.shell, &mut Cli::command(), "splat4d", &mut script);
    let script = String::from_utf8(script)
        .map_err(|error| Error::Failed(format!("the script is no text: {error}")))?;
    let json = json!({ "shell": args.shell.to_string(), "script": script });
    Ok(Answer { json, text: script })
}
