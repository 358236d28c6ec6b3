//! Output of the jobs of `splat4d batch` for workflow engines: Snakemake, Slurm, Kubernetes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use splat4d::{Error, Result, io};

use super::batch_list::Job;
use super::common::{Answer, path_text};
use super::values;

/// The engine that runs the jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Engine {
    /// A Snakefile
    Snakemake,
    /// An array job, with a file that lists its jobs
    Slurm,
    /// A Kubernetes Job per job
    K8s,
}

impl Engine {
    /// The files that are written for the engine.
    pub fn files(self) -> &'static [&'static str] {
        match self {
            Engine::Snakemake => &["Snakefile"],
            Engine::Slurm => &["jobs.sbatch", "jobs.tsv"],
            Engine::K8s => &["jobs.yaml"],
        }
    }
}

/// Options for jobs that another engine runs.
#[derive(Args)]
pub struct EmitArgs {
    /// Write the jobs for this engine to the output folder instead of running them
    #[arg(long, value_name = "ENGINE", value_enum)]
    emit: Option<Engine>,
    /// CPU cores per job
    #[arg(long, value_name = "N", requires = "emit", value_parser = values::whole::<u32>(1..=4096))]
    cpus: Option<u32>,
    /// Memory per job, GiB
    #[arg(long, value_name = "GIB", requires = "emit",
          value_parser = values::whole::<u32>(1..=65_536))]
    memory: Option<u32>,
    /// GPUs per job [default: none]
    #[arg(long, value_name = "N", requires = "emit", value_parser = values::whole::<u32>(1..=64))]
    gpus: Option<u32>,
    /// Kubernetes: the container image
    #[arg(long, value_name = "NAME", requires = "mount", default_value = "splat4d",
          value_parser = values::image)]
    image: String,
    /// Kubernetes: the folder that contains all inputs and the output, mounted at the same path in the
    /// container; a folder of the nodes (hostPath), unless --claim is given
    #[arg(long, value_name = "DIR", requires = "emit", required_if_eq("emit", "k8s"))]
    mount: Option<PathBuf>,
    /// Kubernetes: the persistent volume claim with the contents of --mount
    #[arg(long, value_name = "NAME", requires = "mount", value_parser = values::claim)]
    claim: Option<String>,
}

impl EmitArgs {
    /// The engine, if one is requested.
    pub fn engine(&self) -> Result<Option<Engine>> {
        if self.mount.is_some() && self.emit != Some(Engine::K8s) {
            let what = "--mount, --image and --claim are of --emit k8s";
            return Err(Error::Input(what.into()));
        }
        Ok(self.emit)
    }
}

/// A job as text, from which these files are made.
struct Emitted<'a> {
    name: &'a str,
    /// The words after the program's name.
    words: Vec<String>,
    /// The files that it reads.
    reads: Vec<String>,
}

/// Writes the jobs for an engine to a folder.
///
/// # Errors
/// A path that is not Unicode or contains control characters, or lies outside of the mounted folder; a full
/// disk.
pub fn write(engine: Engine, args: &EmitArgs, jobs: &[Job], folder: &Path) -> Result<Answer> {
    let text = plain(folder)?;
    let jobs = jobs.iter().map(emitted).collect::<Result<Vec<_>>>()?;
    let contents = match engine {
        Engine::Snakemake => vec![snakefile(args, &jobs, &text)?],
        Engine::Slurm => vec![sbatch(args, &jobs, &text), table(&jobs)],
        Engine::K8s => vec![manifests(args, &jobs, &text)?],
    };
    let files: Vec<PathBuf> = engine.files().iter().map(|name| folder.join(name)).collect();
    for (file, content) in files.iter().zip(contents) {
        io::write_atomically(file, |sink| std::io::Write::write_all(sink, content.as_bytes()))?;
    }
    let name = engine.to_possible_value().expect("none is hidden");
    let json = json!({
        "emit": name.get_name(),
        "files": files.iter().map(|file| path_text(file)).collect::<Vec<_>>(),
        "jobs": jobs.len(),
        "output": path_text(folder),
    });
    let how = match engine {
        Engine::Snakemake => "snakemake --keep-going --cores N --snakefile",
        Engine::Slurm => "sbatch",
        Engine::K8s => "kubectl create -f",
    };
    let text = format!(
        "{} jobs; run them with: {how} {}\n",
        jobs.len(),
        quoted(&files[0].display().to_string())
    );
    Ok(Answer { json, text })
}

fn emitted(job: &Job) -> Result<Emitted<'_>> {
    let words = job.words(&["--resume"]);
    Ok(Emitted {
        name: &job.name,
        words: words.iter().map(|word| plain(Path::new(word))).collect::<Result<_>>()?,
        reads: job.reads.iter().map(|path| plain(path)).collect::<Result<_>>()?,
    })
}

/// A word as text that all of these file formats can represent.
fn plain(word: &Path) -> Result<String> {
    let text = word.to_str().filter(|text| !text.chars().any(char::is_control));
    text.map(str::to_owned).ok_or_else(|| {
        let what = "a path with control characters, or that is not Unicode, cannot be written for \
                    another engine; rename it";
        Error::format(word, what)
    })
}

/// One rule for all jobs. The inputs of a job are declared if they exist: the job itself reports missing
/// ones, and the other jobs continue.
fn snakefile(args: &EmitArgs, jobs: &[Emitted<'_>], folder: &str) -> Result<String> {
    // Snakemake interprets braces as wildcards, and they cannot be escaped here.
    if folder.contains(['{', '}']) {
        let what = "Snakemake takes the braces in its path for a wildcard; name another folder";
        return Err(Error::format(folder, what));
    }
    let entry = |job: &Emitted<'_>| {
        let reads: Vec<&String> =
            job.reads.iter().filter(|path| !path.contains(['{', '}'])).collect();
        (job.name.to_owned(), json!({ "reads": reads, "words": job.words }))
    };
    let all: BTreeMap<String, Value> = jobs.iter().map(entry).collect();
    let mut resources = Vec::new();
    resources.extend(args.memory.map(|gib| format!("mem_mb={}", u64::from(gib) * 1024)));
    resources.extend(args.gpus.map(|gpus| format!("gpu={gpus}")));
    let resources = match resources.is_empty() {
        true => String::new(),
        false => format!("    resources:\n        {},\n", resources.join(",\n        ")),
    };
    let pattern = |end: &str| json!(format!("{folder}/{{job}}{end}"));
    Ok(format!(
        r#"# Written by `splat4d batch --emit snakemake`. To run it, with splat4d in PATH:
#   snakemake --snakefile FILE --cores N --keep-going
# A job that was stopped goes on from its checkpoint.
import os

FOLDER = {folder}
JOBS = {jobs:#}


rule all:
    localrule: True
    input:
        lambda wildcards: [f"{{FOLDER}}/{{job}}.safetensors" for job in JOBS],


rule reconstruct:
    input:
        # What is missing is told by the job itself, and the others go on.
        lambda wildcards: [path for path in JOBS[wildcards.job]["reads"] if os.path.exists(path)],
    output:
        scene={scene},
        report={report},
    log:
        {log},
    params:
        words=lambda wildcards: JOBS[wildcards.job]["words"],
    threads: {threads}
{resources}    wildcard_constraints:
        job="[^/]+",
    shell:
        "splat4d {{params.words:q}} > {{log:q}} 2>&1"
"#,
        folder = json!(folder),
        jobs = json!(all),
        scene = pattern(".safetensors"),
        report = pattern(".report/report.json"),
        log = pattern(".log"),
        threads = args.cpus.unwrap_or(1),
    ))
}

/// An array job. The program replaces the shell, so that it receives Slurm's signal: it then writes a
/// checkpoint, and resumes when the array is submitted again.
fn sbatch(args: &EmitArgs, jobs: &[Emitted<'_>], folder: &str) -> String {
    let mut options = format!("#SBATCH --array=1-{}\n", jobs.len());
    options.extend(args.cpus.map(|cpus| format!("#SBATCH --cpus-per-task={cpus}\n")));
    options.extend(args.memory.map(|gib| format!("#SBATCH --mem={gib}G\n")));
    options.extend(args.gpus.map(|gpus| format!("#SBATCH --gres=gpu:{gpus}\n")));
    format!(
        r#"#!/bin/bash
# Written by `splat4d batch --emit slurm`: job N of the array is line N of jobs.tsv.
# A job that was stopped goes on from its checkpoint when it is submitted again.
#SBATCH --job-name=splat4d
{options}# Before the time limit, so that the state can be put away.
#SBATCH --signal=B:TERM@60
set -euo pipefail

folder={folder}
line=$(sed -n "${{SLURM_ARRAY_TASK_ID}}p" "$folder/jobs.tsv")
if [[ -z $line ]]; then
    echo "there is no job $SLURM_ARRAY_TASK_ID in $folder/jobs.tsv" >&2
    exit 2
fi
# The job's name, and the words of its command line.
IFS=$'\t' read -r -a words <<<"$line"
exec splat4d "${{words[@]:1}}" >>"$folder/${{words[0]}}.log" 2>&1
"#,
        folder = quoted(folder),
    )
}

/// A line for each job: its name and the words of its command line, separated by tabs, which no word
/// contains.
fn table(jobs: &[Emitted<'_>]) -> String {
    let line = |job: &Emitted<'_>| format!("{}\t{}\n", job.name, job.words.join("\t"));
    jobs.iter().map(line).collect()
}

/// Quotes a word for a shell.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// A document for each job, in JSON, which is a subset of YAML.
fn manifests(args: &EmitArgs, jobs: &[Emitted<'_>], folder: &str) -> Result<String> {
    let mount = std::path::absolute(args.mount.as_deref().unwrap_or(Path::new("/")))
        .map_err(Error::io("--mount"))?;
    let reads = jobs.iter().flat_map(|job| &job.reads).map(String::as_str);
    let outside = reads.chain([folder]).map(Path::new).find(|path| !path.starts_with(&mount));
    if let Some(path) = outside {
        let what =
            format!("does not lie in --mount {}, and no container would see it", mount.display());
        return Err(Error::format(path, what));
    }
    let mount = plain(&mount)?;
    let volume = match &args.claim {
        Some(claim) => json!({ "name": "data", "persistentVolumeClaim": { "claimName": claim } }),
        None => json!({ "name": "data", "hostPath": { "path": mount, "type": "Directory" } }),
    };
    let memory = args.memory.map(|gib| ("memory", json!(format!("{gib}Gi"))));
    let cpus = args.cpus.map(|cpus| ("cpu", json!(cpus.to_string())));
    let gpus = args.gpus.map(|gpus| ("nvidia.com/gpu", json!(gpus.to_string())));
    let requests: BTreeMap<&str, Value> = cpus.into_iter().chain(memory.clone()).collect();
    let limits: BTreeMap<&str, Value> = gpus.into_iter().chain(memory).collect();
    let mut taken = BTreeSet::new();
    let documents = jobs.iter().map(|job| {
        // Kubernetes would substitute a variable for $(NAME).
        let words: Vec<String> = job.words.iter().map(|word| word.replace("$(", "$$(")).collect();
        let document = json!({
            "apiVersion": "batch/v1",
            "kind": "Job",
            "metadata": {
                "name": dns_name(job.name, &mut taken),
                "labels": { "app.kubernetes.io/name": "splat4d" },
                "annotations": { "splat4d/job": job.name },
            },
            "spec": {
                // A job that a node failure has stopped resumes from its checkpoint.
                "backoffLimit": 2,
                "template": {
                    "metadata": { "labels": { "app.kubernetes.io/name": "splat4d" } },
                    "spec": {
                        "restartPolicy": "Never",
                        "containers": [{
                            "name": "splat4d",
                            "image": args.image,
                            "command": ["splat4d"],
                            "args": words,
                            "resources": { "requests": requests, "limits": limits },
                            "volumeMounts": [{ "name": "data", "mountPath": mount }],
                        }],
                        "volumes": [volume],
                    },
                },
            },
        });
        format!("---\n{document:#}\n")
    });
    Ok(documents.collect())
}

/// A unique Kubernetes name (DNS-1123: at most 63 lower-case letters, digits and dashes).
fn dns_name(name: &str, taken: &mut BTreeSet<String>) -> String {
    let fit = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' };
    let name: String = name.chars().map(fit).collect();
    let numbered = |number: usize| {
        let end = if number == 1 { String::new() } else { format!("-{number}") };
        let room = 63 - "splat4d-".len() - end.len();
        let kept = name[..name.len().min(room)].trim_matches('-');
        format!("{}{end}", format!("splat4d-{kept}").trim_end_matches('-'))
    };
    let free =
        (1..).map(numbered).find(|name| !taken.contains(name)).expect("there are more numbers");
    taken.insert(free.clone());
    free
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_for_kubernetes() {
        let mut taken = BTreeSet::new();
        let long = "Long_".repeat(20);
        let names = ["Bear.1", "bear-1", "bear_1", "_x-", "___", &long, &long];
        let made = names.map(|name| dns_name(name, &mut taken));
        assert_eq!(
            made[..4],
            ["splat4d-bear-1", "splat4d-bear-1-2", "splat4d-bear-1-3", "splat4d-x"]
        );
        for name in &made {
            let claim = values::claim(name);
            assert!(name.len() <= 63 && !name.contains('.') && claim.is_ok(), "{name}: {claim:?}");
        }
        assert_eq!(taken.len(), names.len());
    }
}
