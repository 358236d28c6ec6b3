//! The book, `tools/book`: every chapter is listed, links and inclusions resolve, the messages that it quotes are those
//! of the program, and its commands are the program's. The cheap ones run, on a small clip.

#![cfg(feature = "cli")]

#[path = "support/program.rs"]
mod program;
mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use program::{copy, program, run, stderr};

/// Programs in the book's shell blocks that are not run here.
const OTHERS: [&str; 5] = ["cargo", "docker", "out/venv/bin/pip", "pip", "python3"];

fn crate_folder() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn book() -> PathBuf {
    crate_folder().join("tools/book/src")
}

#[track_caller]
fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The targets of the links in a text.
fn links(text: &str) -> Vec<&str> {
    text.split("](").skip(1).filter_map(|rest| rest.split(')').next()).collect()
}

/// The chapters' file names, in the book's order.
fn chapters() -> Vec<String> {
    links(&read(&book().join("SUMMARY.md"))).into_iter().map(str::to_owned).collect()
}

/// The lines between a file's marks `ANCHOR: name` and `ANCHOR_END: name`.
#[track_caller]
fn part(path: &Path, name: &str) -> String {
    let text = read(path);
    let is = |line: &str, mark: &str| {
        line.split(mark).nth(1).is_some_and(|rest| rest.split_whitespace().next() == Some(name))
    };
    let lines = text.lines().skip_while(|line| !is(line, "ANCHOR:")).skip(1);
    let found: Vec<&str> = lines
        .take_while(|line| !is(line, "ANCHOR_END:"))
        .filter(|line| !line.contains("ANCHOR"))
        .collect();
    assert!(
        text.lines().any(|line| is(line, "ANCHOR_END:")),
        "{}: {name} does not end",
        path.display()
    );
    assert!(!found.concat().trim().is_empty(), "{}: no part {name}", path.display());
    found.join("\n")
}

/// A chapter with what it includes.
#[track_caller]
fn chapter(name: &str) -> String {
    let include = |line: &str| -> String {
        let Some(what) = line.strip_prefix("{{#include ").and_then(|rest| rest.strip_suffix("}}"))
        else {
            assert!(!line.contains("{{"), "{name}: {line}");
            return line.to_owned();
        };
        let (path, part_name) = what.split_once(':').expect("PATH:PART");
        part(&book().join(path), part_name)
    };
    read(&book().join(name)).lines().map(include).collect::<Vec<_>>().join("\n")
}

/// The lines of a text's fenced blocks of a kind.
fn fenced(text: &str, kind: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut fence = None;
    for line in text.lines() {
        match (line.strip_prefix("```"), fence) {
            (Some(info), None) => fence = Some(info),
            (Some(_), Some(_)) => fence = None,
            (None, Some(info)) if info == kind => found.push(line.to_owned()),
            (None, _) => {}
        }
    }
    assert!(fence.is_none(), "a block does not end");
    found
}

/// The commands of all shell blocks in the book's order, as (chapter, words); comments are left out.
fn commands() -> Vec<(String, Vec<String>)> {
    let mut found = Vec::new();
    for name in chapters() {
        for line in fenced(&chapter(&name), "sh") {
            let line = line.split(" #").next().unwrap_or_default();
            let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
            if !words.is_empty() {
                found.push((name.clone(), words));
            }
        }
    }
    found
}

#[test]
fn every_chapter_is_listed() {
    let files = fs::read_dir(book()).unwrap().map(|entry| entry.unwrap().file_name());
    let files: BTreeSet<String> =
        files.map(|name| name.into_string().unwrap()).filter(|name| name != "SUMMARY.md").collect();
    assert_eq!(chapters().into_iter().collect::<BTreeSet<_>>(), files);
}

#[test]
fn links_resolve() {
    let mut count = 0;
    for name in chapters() {
        let text = chapter(&name);
        assert!(text.starts_with("# "), "{name} has no title");
        for link in links(&text).into_iter().filter(|link| !link.starts_with("https://")) {
            assert!(book().join(link).is_file(), "{name}: {link}");
            count += 1;
        }
    }
    assert!(count > 2);
}

/// All sources of the library and the program, with text literals that go over several lines in one.
fn sources(folder: &Path, text: &mut String) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.extension().is_some_and(|ending| ending == "rs") {
            true => {
                let mut parts = read(&path);
                parts = parts.split("\\\n").map(str::trim_start).collect();
                text.push_str(&parts);
            }
            false if path.is_dir() => sources(&path, text),
            false => {}
        }
    }
}

#[test]
fn quoted_messages_are_those_of_the_program() {
    let mut source = String::new();
    sources(&crate_folder().join("src"), &mut source);
    let quoted: Vec<String> =
        chapters().iter().flat_map(|name| fenced(&chapter(name), "text,message")).collect();
    assert!(quoted.len() > 5);
    for message in quoted {
        // Between the values, which … stands for.
        let parts: Vec<&str> = message.split('…').map(str::trim).collect();
        assert!(parts.iter().any(|part| part.len() > 20), "{message}: too short to find");
        for part in parts {
            assert!(source.contains(part), "{message}: the sources do not say {part:?}");
        }
    }
}

#[test]
fn options_are_those_of_the_program() {
    let mut help = BTreeMap::new();
    let mut checked = 0;
    for (chapter, words) in commands() {
        if words[0] != "splat4d" {
            let known = OTHERS.contains(&&words[0][..]) || crate_folder().join(&words[0]).is_file();
            assert!(known || words[0].starts_with("out/venv/"), "{chapter}: {words:?}");
            continue;
        }
        let text = help.entry(words[1].clone()).or_insert_with(|| {
            let output = run(Path::new("."), &format!("{} --help", words[1]));
            assert!(output.status.success(), "{chapter}: {words:?}: {}", stderr(&output));
            String::from_utf8(output.stdout).unwrap()
        });
        let options = words.iter().filter(|word| word.starts_with("--"));
        for option in options.map(|word| word.split('=').next().unwrap_or(word)) {
            let listed = text
                .split(|c: char| !c.is_ascii_alphanumeric() && c != '-')
                .any(|word| word == option);
            assert!(listed, "{chapter}: {words:?}: {} has no {option}", words[1]);
            checked += 1;
        }
    }
    assert!(checked > 30 && help.len() > 9, "{checked} options of {} commands", help.len());
}

/// Options with their values.
type Options = &'static [[&'static str; 2]];

/// Options that make a command cheap: those that are added where they are not given, and those that replace only what
/// is given. `None` for commands that take minutes or do not end.
fn cheap(words: &[String]) -> Option<(Options, Options)> {
    let given = |word: &str| words.iter().any(|other| other == word);
    Some(match &words[1][..] {
        "view" | "bench" => return None,
        "validate" if !given("--seconds") => return None,
        "validate" => (&[["--seconds", "1"]], &[]),
        "synth" => (&[["--frames", "6"], ["--size", "112x63"]], &[]),
        "reconstruct" => (&[["--quality", "draft"], ["--steps", "20"], ["--size", "112"]], &[]),
        "track" => (&[["--size", "112"]], &[]),
        "train" => (&[["--steps", "20"], ["--size", "112"]], &[["--max-gaussians", "2000"]]),
        "render" => (&[["--size", "64x48"]], &[["--frames", "3"]]),
        _ => (&[], &[]),
    })
}

/// The command's arguments, made cheap.
fn arguments(words: &[String]) -> Option<Vec<String>> {
    let (always, replaced) = cheap(words)?;
    let mut arguments = words[1..].to_vec();
    for (added, [option, value]) in
        always.iter().map(|o| (true, o)).chain(replaced.iter().map(|o| (false, o)))
    {
        match arguments.iter().position(|word| word == option) {
            Some(at) => arguments[at + 1] = (*value).to_owned(),
            None if added => arguments.extend([*option, *value].map(str::to_owned)),
            None => {}
        }
    }
    Some(arguments)
}

/// Runs a command and fails where it does.
#[track_caller]
fn succeeds(folder: &Path, arguments: &[String]) {
    let device = std::env::var("SPLAT4D_DEVICE").unwrap_or("software".into());
    let output =
        program().current_dir(folder).args(arguments).args(["--device", &device]).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
}

#[test]
fn commands_run() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    // What the reader brings along: a video, for which a folder of frames stands, as reading videos is tested with the
    // command line; a capture with a COLMAP model; and settings that `bench` would take minutes to find.
    for words in ["splat4d synth rigid -o own/clip", "splat4d track own/clip -o own/tracked"] {
        let words: Vec<String> = words.split_whitespace().map(str::to_owned).collect();
        succeeds(folder.path(), &arguments(&words).unwrap());
    }
    copy(&at("own/clip/frames"), &at("video.mp4"));
    copy(&at("own/tracked/images"), &at("capture/images"));
    copy(&at("own/tracked/sparse"), &at("capture/sparse"));
    fs::write(at("fast.json"), "{}").unwrap();
    let has_ffmpeg = Command::new("ffmpeg").arg("-version").output().is_ok();

    let mut count = 0;
    for (chapter, words) in commands().into_iter().filter(|(_, words)| words[0] == "splat4d") {
        let Some(arguments) = arguments(&words) else { continue };
        let writes_video =
            arguments.windows(2).any(|two| two[0] == "-o" && two[1].ends_with(".mp4"));
        if writes_video && !has_ffmpeg {
            println!("SKIPPED (no ffmpeg): {words:?}");
            continue;
        }
        println!("{chapter}: {arguments:?}");
        succeeds(folder.path(), &arguments);
        count += 1;
    }
    assert!(count > 25, "{count} commands ran");
}
