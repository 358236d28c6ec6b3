//! The list that `splat4d batch` reads: its jobs, each a command line of `reconstruct` that the program's
//! own parser has accepted.

use std::any::TypeId;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::{Arg, CommandFactory, Parser};
use serde::Deserialize;
use splat4d::error::excerpt;
use splat4d::io::{self, Identity};
use splat4d::{Error, Result};
use toml::{Table, Value};

use super::common::Common;
use super::reconstruct::ReconstructArgs;
use super::{Cli, Command, usage_error};

/// What may be wrong with a job, in words; the caller says of which.
type Told<T> = std::result::Result<T, String>;

/// What a job's command line has from `batch` alone.
const SET_HERE: [&str; 6] = ["output", "report", "resume", "json", "help", "version"];
/// Characters of a job's name, which begins file names.
const MOST_NAME: usize = 100;

/// The file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    #[serde(default)]
    defaults: Table,
    #[serde(default)]
    job: Vec<Table>,
}

/// One reconstruction.
pub struct Job {
    /// Begins the names of all that it writes.
    pub name: String,
    /// What its command line says.
    pub args: ReconstructArgs,
    /// The files and folders that its command line names to be read, the clip last.
    pub reads: Vec<PathBuf>,
    output: PathBuf,
    options: Vec<OsString>,
    /// The clip and the options as the list has them.
    listed: Identity,
}

impl Job {
    /// What it writes beside others into the batch's folder, by the end of its name.
    pub fn file(&self, end: &str) -> PathBuf {
        self.output.join(format!("{}{end}", self.name))
    }

    /// Its scene's file.
    pub fn scene(&self) -> PathBuf {
        self.file(".safetensors")
    }

    /// The words after the program's name, some `further` options among them.
    pub fn words(&self, further: &[&str]) -> Vec<OsString> {
        words(&self.options, further, self.reads.last().expect("the clip"))
    }

    /// What its result depends on: the options as they are listed, and what all files that it reads hold.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn identity(&self) -> Result<Identity> {
        let mut identity = self.listed.clone();
        identity.insert("the checksum of all that is read".into(), self.args.inputs().checksum()?);
        Ok(identity)
    }
}

fn words(options: &[OsString], further: &[&str], clip: &Path) -> Vec<OsString> {
    let mut words: Vec<OsString> = vec!["reconstruct".into()];
    words.extend_from_slice(options);
    words.extend(further.iter().map(OsString::from));
    words.extend(["--".into(), clip.into()]);
    words
}

/// Reads the jobs of a list, which write into the folder `output`. The device and the seed are `common`'s
/// where the list does not say.
///
/// # Errors
/// The file cannot be read or is no list; a job without name or input, or whose command line would be
/// refused.
pub fn read(path: &Path, output: &Path, common: &Common) -> Result<Vec<Job>> {
    let text = io::read_text(path)?;
    let list: List = toml::from_str(&text).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        let (line, what) = (before.matches('\n').count() + 1, excerpt(error.message()));
        Error::format(path, format!("line {line}: {what}"))
    })?;
    if list.job.is_empty() {
        return Err(Error::format(path, "lists no job; add a [[job]] with `name` and `input`"));
    }
    let mut cli = Cli::command();
    // Only then a command has the options that all share.
    cli.build();
    let declared: Vec<&Arg> =
        cli.find_subcommand("reconstruct").expect("a command").get_arguments().collect();
    let base = path.parent().unwrap_or(Path::new(""));
    let drafter = Drafter { declared, base, output };
    let mut usual = Table::new();
    // A TOML number has 63 bits.
    usual.insert("seed".into(), common.seed.to_string().into());
    usual.insert("device".into(), common.device.clone().into());
    usual.extend(list.defaults);
    let mut jobs = Vec::new();
    // By name, in which upper and lower case do not tell files apart everywhere.
    let mut numbers: BTreeMap<String, usize> = BTreeMap::new();
    for (i, table) in list.job.into_iter().enumerate() {
        let number = i + 1;
        let name = name(&table)
            .map_err(|what| Error::format(path, format!("job {number} of the list: {what}")))?;
        if let Some(first) = numbers.insert(name.to_lowercase(), number) {
            let what = format!(
                "jobs {first} and {number} of the list are both called `{name}`; each needs a name of \
                 its own, in more than upper and lower case"
            );
            return Err(Error::format(path, what));
        }
        let job = drafter.job(name.clone(), usual.clone(), table);
        jobs.push(job.map_err(|what| Error::format(path, format!("job `{name}`: {what}")))?);
    }
    Ok(jobs)
}

/// A job's name, which is fit to begin a file's name anywhere.
fn name(table: &Table) -> Told<String> {
    let Some(name) = table.get("name") else {
        return Err("it has no `name`, by which its files are called".into());
    };
    let is_fit = |name: &&str| {
        let fit = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        (1..=MOST_NAME).contains(&name.len())
            && name.chars().all(fit)
            && !name.starts_with(['.', '-'])
    };
    name.as_str().filter(is_fit).map(str::to_owned).ok_or_else(|| {
        let name = excerpt(&name.to_string());
        format!(
            "{name} cannot be a name: it begins files, so that up to {MOST_NAME} letters without accents, \
             digits, `-`, `_` and `.` are expected, and neither `.` nor `-` in the first place"
        )
    })
}

/// Makes command lines of what stands in the list.
struct Drafter<'a> {
    /// The arguments of `reconstruct`.
    declared: Vec<&'a Arg>,
    /// What paths in the list are relative to.
    base: &'a Path,
    output: &'a Path,
}

impl Drafter<'_> {
    /// A job of a name, with its own options over the `usual` ones.
    fn job(&self, name: String, usual: Table, mut own: Table) -> Told<Job> {
        own.remove("name");
        let clip = own.remove("input").ok_or("it has no `input`, the clip to reconstruct")?;
        let clip = text(&clip).map_err(|what| format!("input: {what}"))?;
        let mut listed = Identity::from([("input".into(), clip.clone())]);
        let (mut options, mut reads) = (Vec::new(), Vec::new());
        let mut all = usual;
        all.extend(own);
        for (key, value) in &all {
            let of_key = |what: String| format!("{}: {what}", excerpt(key));
            if key.chars().any(char::is_control) {
                return Err(of_key("no option has control characters in its name".to_owned()));
            }
            if SET_HERE.contains(&key.as_str()) {
                return Err(of_key("is set by batch itself; take it out".to_owned()));
            }
            let argument = self.declared.iter().find(|a| a.get_long() == Some(key)).copied();
            if argument.is_some_and(|argument| !argument.get_action().takes_values()) {
                match value
                    .as_bool()
                    .ok_or_else(|| of_key("true or false is expected".to_owned()))?
                {
                    true => options.push(format!("--{key}").into()),
                    false => continue,
                }
            } else {
                let text = text(value).map_err(of_key)?;
                let mut option = OsString::from(format!("--{key}="));
                match argument.filter(|argument| takes_path(argument)) {
                    Some(_) => {
                        reads.push(self.path(&text));
                        option.push(self.path(&text));
                    }
                    None => option.push(&text),
                }
                options.push(option);
            }
            listed.insert(key.clone(), shown(value));
        }
        for (option, end) in [("--output=", ".safetensors"), ("--report=", ".report")] {
            let mut option = OsString::from(option);
            option.push(self.output.join(format!("{name}{end}")));
            options.push(option);
        }
        reads.push(self.path(&clip));
        let line = words(&options, &["--json", "--resume"], &self.path(&clip));
        let parsed = Cli::try_parse_from([OsString::from("splat4d")].into_iter().chain(line));
        let Command::Reconstruct(args) = parsed.map_err(|error| usage_error(&error))?.command
        else {
            unreachable!("the line begins with its name")
        };
        args.check().map_err(|error| error.to_string())?;
        Ok(Job { name, args, reads, output: self.output.to_path_buf(), options, listed })
    }

    /// A path of the list; none stays none, for the parser to refuse.
    fn path(&self, text: &str) -> PathBuf {
        if text.is_empty() { PathBuf::new() } else { self.base.join(text) }
    }
}

fn takes_path(argument: &Arg) -> bool {
    argument.get_value_parser().type_id() == TypeId::of::<PathBuf>()
}

/// A value as it stands on a command line; a list's with commas between.
fn text(value: &Value) -> Told<String> {
    let text = match value {
        Value::Array(values) if !values.iter().any(Value::is_array) => {
            values.iter().map(text).collect::<Told<Vec<_>>>()?.join(",")
        }
        Value::String(_) | Value::Integer(_) | Value::Float(_) | Value::Boolean(_) => shown(value),
        _ => return Err("a text, a number, true or false, or a list of these is expected".into()),
    };
    match text.chars().any(char::is_control) {
        true => Err("no value has control characters in it".into()),
        false => Ok(text),
    }
}

/// A value without the quotes of a text.
fn shown(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
