//! `splat4d man`: writes the manual pages.

use std::io::Write;
use std::path::PathBuf;

use clap::{Args, Command, CommandFactory};
use clap_mangen::Man;
use serde_json::json;
use splat4d::{Error, Result, io};

use super::Cli;
use super::common::{Answer, path_text};
use super::outputs::Outputs;

const AFTER_HELP: &str = "\
splat4d.1 is of the whole program, splat4d-COMMAND.1 of each command. `man` finds them where
DIR is the man1 of a folder of its path.

Examples:
  splat4d man ~/.local/share/man/man1
  splat4d man pages && man pages/splat4d-render.1

JSON: pages (names of the files), output";

/// Write the manual pages
#[derive(Args)]
#[command(after_help = AFTER_HELP)]
pub struct ManArgs {
    /// The output folder
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

/// Runs the command.
pub fn run(args: &ManArgs) -> Result<Answer> {
    let mut command = Cli::command().disable_help_subcommand(true);
    command.build();
    let mut pages = Vec::new();
    add(&command, &mut pages)?;
    let names: Vec<&str> = pages.iter().map(|(name, _)| name.as_str()).collect();
    Outputs::default().folder(&args.folder, &names)?;
    for (name, page) in &pages {
        io::write_atomically(args.folder.join(name), |sink| sink.write_all(page))?;
    }
    let json = json!({ "pages": names, "output": path_text(&args.folder) });
    let text = format!("{} pages in {}\n", pages.len(), args.folder.display());
    Ok(Answer { json, text })
}

/// Adds the manual pages of a command and of its subcommands.
fn add(command: &Command, pages: &mut Vec<(String, Vec<u8>)>) -> Result<()> {
    let man = Man::new(command.clone());
    let mut page = Vec::new();
    man.render(&mut page).map_err(|error| {
        Error::Failed(format!("the page of {} cannot be made: {error}", command.get_name()))
    })?;
    pages.push((man.get_filename(), page));
    command.get_subcommands().try_for_each(|command| add(command, pages))
}
