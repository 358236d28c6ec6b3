//! The options of every command, read from the program's `--help`, so that new options are drawn without
//! being listed here.

use std::path::Path;
use std::process::Command;

/// An option of a command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Flag {
    /// Its name, with dashes.
    pub name: String,
    /// The name of its value in the help; `None` for a switch.
    pub value: Option<String>,
}

/// The options of a command.
///
/// # Errors
/// The program cannot be started, or its help lists no options.
pub fn flags(program: &Path, command: &str) -> Result<Vec<Flag>, String> {
    let output = Command::new(program)
        .args([command, "--help"])
        .output()
        .map_err(|e| format!("{} cannot be started: {e}", program.display()))?;
    let found = parse(&String::from_utf8_lossy(&output.stdout));
    match found.is_empty() {
        true => Err(format!("`splat4d {command} --help` lists no options")),
        false => Ok(found),
    }
}

fn parse(help: &str) -> Vec<Flag> {
    let flag = |line: &str| {
        let line = line.strip_prefix("  ")?.trim_start();
        // `-o, --output <FILE>  …` or `--json  …`
        let line = match line.split_once(", --") {
            Some((short, rest)) if short.len() == 2 && short.starts_with('-') => rest,
            _ => line.strip_prefix("--")?,
        };
        let name = line.split([' ', '\n']).next()?;
        let rest = line[name.len()..].trim_start_matches(' ');
        let value = match line[name.len()..].starts_with(" <") {
            true => rest.strip_prefix('<').and_then(|v| v.split_once('>')).map(|(v, _)| v.into()),
            false => None,
        };
        (name != "help" && name != "version").then(|| Flag { name: format!("--{name}"), value })
    };
    help.lines().filter_map(flag).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_read_from_help() {
        let help = "Options:\n  -o, --output <DIR|FILE>  Where to\n      --exr  Write more\n\
                    \x20     --size <WxH>\n          Size; --not-an-option\n  -h, --help  Print\n";
        let flag = |name: &str, value: Option<&str>| Flag {
            name: name.into(),
            value: value.map(str::to_owned),
        };
        let wanted =
            [flag("--output", Some("DIR|FILE")), flag("--exr", None), flag("--size", Some("WxH"))];
        assert_eq!(parse(help), wanted);
    }
}
