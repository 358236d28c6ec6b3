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

/// Result with an error message about a job; the caller adds which one.
type Told<T> = std::result::Result<T, String>;

/// Options that only `batch` sets.
const SET_HERE: [&str; 6] = ["output", "report", "resume", "json", "help", "version"];
/// Maximum length of a job's name, which is a prefix of file names.
const MOST_NAME: usize = 100;

/// The parsed list file.
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
    /// Name and prefix of all its output files.
    pub name: String,
    /// Parsed options of the job.
    pub args: ReconstructArgs,
    /// The input files and folders of its command line, the clip last.
    pub reads: Vec<PathBuf>,
    output: PathBuf,
    options: Vec<OsString>,
    /// The clip and the options as listed.
    listed: Identity,
}

impl Job {
    /// Path of an additional output file in the batch's folder, by its suffix.
    pub fn file(&self, end: &str) -> PathBuf {
        self.output.join(format!("{}{end}", self.name))
    }

    /// Path of its scene file.
    pub fn scene(&self) -> PathBuf {
        self.file(".safetensors")
    }

    /// The words after the program's name, including some `further` options.
    pub fn words(&self, further: &[&str]) -> Vec<OsString> {
        words(&self.options, further, self.reads.last().expect("the clip"))
    }

    /// Everything that its result depends on: the listed options, and the contents of all input files.
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

/// Reads the jobs of a list, which write to the folder `output`. The device and the seed are `common`'s
/// where the list does not set them.
///
/// # Errors
/// The file cannot be read or is not a list; a job without a name or input, or with an invalid command line.
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
    // A command has the global options only after this call.
    cli.build();
    let declared: Vec<&Arg> =
        cli.find_subcommand("reconstruct").expect("a command").get_arguments().collect();
    let base = path.parent().unwrap_or(Path::new(""));
    let drafter = Drafter { declared, base, output };
    let mut usual = Table::new();
    // TOML integers have 63 bits.
    usual.insert("seed".into(), common.seed.to_string().into());
    usual.insert("device".into(), common.device.clone().into());
    usual.extend(list.defaults);
    let mut jobs = Vec::new();
    // By name, because not all file systems distinguish upper and lower case.
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

/// A job's name, which must be valid as a prefix of file names on all systems.
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

/// Converts list entries to command lines.
struct Drafter<'a> {
    /// The arguments of `reconstruct`.
    declared: Vec<&'a Arg>,
    /// Base folder of relative paths in the list.
    base: &'a Path,
    output: &'a Path,
}

impl Drafter<'_> {
    /// A job with the given name; its own options override the `usual` ones.
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

    /// A path of the list; an empty one stays empty, so that the parser rejects it.
    fn path(&self, text: &str) -> PathBuf {
        if text.is_empty() { PathBuf::new() } else { self.base.join(text) }
    }
}

fn takes_path(argument: &Arg) -> bool {
    argument.get_value_parser().type_id() == TypeId::of::<PathBuf>()
}

/// A value in command-line form; lists are comma-separated.
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

/// A value without the quotes of a string.
fn shown(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
