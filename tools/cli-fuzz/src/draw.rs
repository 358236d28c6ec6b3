//! Random commands: a valid command of some kind, with a few changes.

use std::ffi::OsString;
use std::fs;
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::damage;
use crate::fixtures::{Fixtures, Kind};
use crate::grammar::Flag;
use crate::wild::WILD;

/// Path of the fixtures from the folder that a command runs in.
pub const INPUTS: &str = "in";

/// A word of a command.
#[derive(Clone, Debug)]
enum Word {
    /// A literal argument.
    Plain(OsString),
    /// An input of a kind.
    Input(Kind),
    /// Where to write: a file or a folder.
    Output(&'static str),
}

/// A valid command: its name and its arguments.
struct Base {
    command: &'static str,
    words: Vec<Word>,
}

/// Valid commands, each with options that keep it short; `<kind>` stands for an input and `>name` for an
/// output.
const BASES: [&str; 43] = [
    "reconstruct <clip> -o >scene.safetensors --size 32 --steps 3 --max-gaussians 150",
    "reconstruct <clip> -o >scene.safetensors --size 32 --steps 3 --max-gaussians 150 \
     --control-points 6 --report >report",
    "reconstruct <clip> -o >scene.safetensors --size 32 --steps 3 --poses <cameras> --masks <masks> \
     --intrinsics <intrinsics> --refine poses,focal --pinhole",
    "reconstruct <clip> -o >scene.safetensors --steps 3 --flow <flow> --depth <depth>",
    "batch <list> -o >jobs",
    "batch <list> -o >jobs --emit slurm --cpus 2 --memory 4 --gpus 1",
    "batch <list> -o >jobs --emit k8s --mount / --claim data --image splat4d",
    "track <clip> -o >tracked --size 32 --shot 0",
    "track <clip> -o >tracked --tracks <tracks> --queries <tracks>",
    "train <dataset> -o >scene.safetensors --steps 3 --random-points 80 --sh-degree 0 --static",
    "train <dataset> -o >scene.safetensors --steps 3 --random-points 80 --max-gaussians 120 \
     --density adaptive --report >report --settings <settings>",
    "train <dataset> -o >scene.safetensors --steps 3 --random-points 80 --view 8090 --host 127.0.0.1",
    "render <scene> -o >views --frames 2 --size 24x16",
    "render <scene> -o >views --path <cameras> --size 24x16 --exr --what colour,depth,alpha,motion,flow,normal",
    "render <scene> --bench --size 24x16 --path bullet --frames 2",
    "render <scene> -o >views.mp4 --frames 2 --size 24x16",
    "export <scene> -o >moment.ply --time 0.5",
    "export <scene> -o >scene.spz --drop bands",
    "export <scene> -o >moment.glb --time 0.5 --spz",
    "export <scene> -o >scene.html",
    "export <scene> -o >frames.zip --sequence --frames 2 --as splat --drop bands",
    "eval <scene> <dataset>",
    "eval <scene> <truth>",
    "eval <cameras> <cameras>",
    "eval <cameras> <cameras> --align scale --rpe-delta 0.1 --rpe-unit metres --rpe-all-pairs",
    "eval <tracks> <tracks>",
    "reconstruct <clip> -o >scene.safetensors --size 32 --steps 3 --max-gaussians 150 --models <models> \
     --onnx-threads 1",
    "track <clip> -o >tracked --models <models> --onnx-threads 1",
    "ablate <clip> --only motion --size 32 --steps 3 --max-gaussians 150 --models <models> --onnx-threads 1",
    "eval <scene> <dataset> --lpips <lpips> --onnx-threads 1",
    "ablate <clip> --only motion --size 32 --steps 3 --max-gaussians 150 --report >report",
    "info <scene>",
    "synth rigid -o >clip --frames 3 --size 24x16",
    "synth still -o >clip --frames 2 --size 64x16 --coded",
    "bench --quick --filter scan --report >report",
    "bench cmp <measurements> <measurements>",
    "validate --quick --filter scan",
    "validate --filter scan --junit >validate.xml --report >validate.html",
    "validate --fuzz 2",
    "validate --case <case>",
    "completions zsh",
    "man >pages",
    "view <scene> --frames <clip> --seconds 0.2",
];

/// Every command's name.
pub const COMMANDS: [&str; 18] = [
    "reconstruct",
    "batch",
    "track",
    "train",
    "render",
    "export",
    "eval",
    "ablate",
    "info",
    "devices",
    "doctor",
    "bench",
    "synth",
    "table",
    "validate",
    "completions",
    "man",
    "view",
];

/// A command to run, with the files it needs in its folder.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// The words after the program's name.
    pub words: Vec<OsString>,
    /// The command's name.
    pub command: String,
}

/// Draws the command with the given number; `folder` is the empty folder that it will run in.
///
/// # Errors
/// A file that the command is to be given cannot be written.
pub fn draw(
    fixtures: &Fixtures,
    flags: &[(String, Vec<Flag>)],
    folder: &Path,
    seed: u64,
    number: u64,
) -> std::io::Result<Drawn> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(number);
    let mut artist = Artist { fixtures, folder, rng, files: 0 };
    let base = artist.base();
    let known = flags.iter().find(|(name, _)| name == base.command);
    let known: &[Flag] = known.map_or(&[], |(_, flags)| flags);
    artist.command(base, known)
}

struct Artist<'a> {
    fixtures: &'a Fixtures,
    folder: &'a Path,
    rng: ChaCha8Rng,
    /// Number of files made so far.
    files: usize,
}

impl Artist<'_> {
    fn below(&mut self, n: usize) -> usize {
        self.rng.random_range(0..n)
    }

    /// True with probability 1 / `n`.
    fn once_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    fn pick<T: Clone>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())].clone()
    }

    fn base(&mut self) -> Base {
        if self.once_in(40) {
            return Base { command: self.pick(&["devices", "doctor"]), words: Vec::new() };
        }
        let text = self.pick(&BASES);
        let mut words = text.split_whitespace();
        let name = words.next().unwrap_or_default();
        let word = |word: &'static str| match (word.strip_prefix('<'), word.strip_prefix('>')) {
            (Some(kind), _) => Word::Input(kind_of(kind.trim_end_matches('>'))),
            (_, Some(output)) => Word::Output(output),
            _ => Word::Plain(word.into()),
        };
        Base { command: name, words: words.map(word).collect() }
    }

    fn command(&mut self, base: Base, known: &[Flag]) -> std::io::Result<Drawn> {
        let mut words: Vec<OsString> = Vec::new();
        let mut inputs: Vec<OsString> = Vec::new();
        // Inputs are drawn first: an output may be one of them.
        let given: Vec<Option<OsString>> = base
            .words
            .iter()
            .map(|word| match word {
                Word::Input(kind) => self.input(*kind).map(Some),
                _ => Ok(None),
            })
            .collect::<std::io::Result<_>>()?;
        inputs.extend(given.iter().flatten().cloned());
        for (word, given) in base.words.iter().zip(given) {
            words.push(match word {
                Word::Plain(text) => text.clone(),
                Word::Input(_) => given.unwrap_or_default(),
                Word::Output(name) => self.output(name, &inputs)?,
            });
        }
        for _ in 0..self.pick(&[0, 1, 1, 1, 2, 3]) {
            self.option(&mut words, known)?;
        }
        match self.below(40) {
            0 if !words.is_empty() => drop(words.remove(self.rng.random_range(0..words.len()))),
            1 if !words.is_empty() => {
                let again = self.pick(&words);
                words.push(again);
            }
            2 => words.push("left-over".into()),
            3 => words.push("--no-such-option".into()),
            _ => {}
        }
        if self.once_in(2) {
            words.push("--json".into());
        }
        words.insert(0, base.command.into());
        Ok(Drawn { words, command: base.command.to_owned() })
    }

    /// Sets an option; replaces its value if the option is present.
    fn option(&mut self, words: &mut Vec<OsString>, known: &[Flag]) -> std::io::Result<()> {
        if known.is_empty() {
            return Ok(());
        }
        let flag = self.pick(known);
        let Some(what) = &flag.value else {
            words.push(flag.name.into());
            return Ok(());
        };
        // Outputs are drawn with the command.
        if flag.name == "--output" {
            return Ok(());
        }
        let value = match () {
            () if flag.name == "--report" => self.output("report", &[])?,
            () if flag.name == "--pictures" => self.output("pictures", &[])?,
            () if flag.name == "--junit" => self.output("validate.xml", &[])?,
            () if what.contains("FILE") || what.contains("DIR") => {
                let kind = self.kind_for(&flag.name);
                self.input(kind)?
            }
            () => self.value(what),
        };
        match words.iter().position(|word| word.to_str() == Some(&flag.name)) {
            Some(at) if at + 1 < words.len() => words[at + 1] = value,
            _ => words.extend([flag.name.into(), value]),
        }
        Ok(())
    }

    fn kind_for(&mut self, flag: &str) -> Kind {
        match flag {
            "--intrinsics" => Kind::Intrinsics,
            "--poses" | "--path" => Kind::Cameras,
            "--masks" => Kind::Masks,
            "--depth" => Kind::Depth,
            "--flow" => Kind::Flow,
            "--tracks" | "--queries" => Kind::Tracks,
            "--settings" => Kind::Settings,
            "--models" => Kind::Models,
            "--lpips" => Kind::Lpips,
            "--case" => Kind::Case,
            _ => {
                let all: Vec<Kind> = self.fixtures.all.iter().map(|f| f.kind).collect();
                self.pick(&all)
            }
        }
    }

    /// A value that is not a path: small, hostile, or of another type.
    fn value(&mut self, what: &str) -> OsString {
        if self.once_in(12) {
            let odd = ["", " ", "-", "--", "x", "1e", "0x10", "½", "1,2", "3x", "\u{1b}[31m", "%s"];
            return self.pick(&odd).into();
        }
        let number = |artist: &mut Self| -> String {
            match artist.below(3) {
                0 => artist.pick(&WILD).to_owned(),
                _ => artist.pick(&["1", "2", "3", "5", "0.5", "16", "20"]).to_owned(),
            }
        };
        let parts = match what {
            "WxH" => [number(self), number(self)].join("x"),
            "R,G,B" => [number(self), number(self), number(self)].join(","),
            "TIMES" => match self.below(2) {
                0 => number(self),
                _ => [number(self), "0".into()].join(","),
            },
            "DEVICE" => self
                .pick(&["best", "software", "gpu", "discrete", "0", "9", "llvm", "nothing"])
                .into(),
            "ENGINE" => self.pick(&["snakemake", "slurm", "k8s", "nothing"]).into(),
            "TEXT" => self.pick(&["scan", "sort/", "nothing", ""]).into(),
            _ => number(self),
        };
        parts.into()
    }

    /// A path to read from: usually a valid file, else one that is damaged, of another kind, or not a
    /// file.
    fn input(&mut self, kind: Kind) -> std::io::Result<OsString> {
        let fitting: Vec<PathBuf> =
            self.fixtures.of(kind).into_iter().map(|f| f.path.clone()).collect();
        let any: Vec<PathBuf> = self.fixtures.all.iter().map(|f| f.path.clone()).collect();
        let good = |path: PathBuf| Path::new(INPUTS).join(path).into_os_string();
        Ok(match self.below(10) {
            0..=4 => good(self.pick(&fitting)),
            5..=7 => {
                let from = self.fixtures.root.join(self.pick(&fitting));
                let target = self.fresh(&from);
                damage::copy(&from, &self.folder.join(&target), &mut self.rng)?;
                target
            }
            8 => good(self.pick(&any)),
            _ => self.odd()?,
        })
    }

    /// A new name in the command's folder, with the extension of a file, sometimes an odd one.
    fn fresh(&mut self, like: &Path) -> OsString {
        self.files += 1;
        let mut name = match self.below(8) {
            0 => OsString::from_vec(b"odd \xff\xfe name".to_vec()),
            1 => OsString::from("100%d of it"),
            2 => OsString::from("-dash"),
            3 => OsString::from("line\nbreak"),
            _ => OsString::from("damaged"),
        };
        name.push(self.files.to_string());
        if let Some(extension) = like.extension() {
            name.push(".");
            name.push(extension);
        }
        // A name that begins with a dash is an option to every program.
        let mut path = OsString::from("./");
        path.push(name);
        path
    }

    /// A path that is not a file with content.
    fn odd(&mut self) -> std::io::Result<OsString> {
        let at = |name: &str| self.folder.join(name);
        let absent = |name: &str| at(name).symlink_metadata().is_err();
        match self.rng.random_range(0..9) {
            0 => Ok("missing".into()),
            1 => Ok("/dev/null".into()),
            2 => Ok("/dev/zero".into()),
            3 => {
                if absent("empty.json") {
                    fs::write(at("empty.json"), "")?;
                }
                Ok("empty.json".into())
            }
            4 => {
                fs::create_dir_all(at("hollow"))?;
                Ok("hollow".into())
            }
            5 => {
                if absent("loop") {
                    symlink("loop", at("loop"))?;
                }
                Ok("loop".into())
            }
            6 => {
                if absent("pipe") {
                    Command::new("mkfifo").arg(at("pipe")).status()?;
                }
                Ok("pipe".into())
            }
            7 => Ok("".into()),
            _ => Ok("n".repeat(300).into()),
        }
    }

    /// A path to write to: usually a new one in `out`, else one where nothing can or should be written.
    fn output(&mut self, name: &str, inputs: &[OsString]) -> std::io::Result<OsString> {
        let new = format!("out/{name}");
        // New files are allowed in a folder that is read.
        let is_file = |path: &&OsString| !self.folder.join(path).is_dir();
        let files: Vec<OsString> = inputs.iter().filter(is_file).cloned().collect();
        Ok(match self.below(16) {
            0 if !files.is_empty() => self.pick(&files),
            1 => format!("{new}/").into(),
            2 => OsString::from_vec([b"out/\xff", name.as_bytes()].concat()),
            3 => format!("out/50%d/{name}").into(),
            4 => format!("out/{}{name}", "n".repeat(300)).into(),
            5 => "/dev/full".into(),
            6 => "/dev/null".into(),
            7 => {
                fs::write(self.folder.join("file"), "something")?;
                format!("file/{name}").into()
            }
            _ => new.into(),
        })
    }
}

fn kind_of(name: &str) -> Kind {
    match name {
        "clip" => Kind::Clip,
        "list" => Kind::List,
        "dataset" => Kind::Dataset,
        "scene" => Kind::Scene,
        "cameras" => Kind::Cameras,
        "intrinsics" => Kind::Intrinsics,
        "masks" => Kind::Masks,
        "depth" => Kind::Depth,
        "flow" => Kind::Flow,
        "tracks" => Kind::Tracks,
        "settings" => Kind::Settings,
        "measurements" => Kind::Measurements,
        "case" => Kind::Case,
        "truth" => Kind::Truth,
        "models" => Kind::Models,
        "lpips" => Kind::Lpips,
        other => unreachable!("a good command names the input `{other}`"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_input_of_a_good_command_has_a_kind() {
        for base in BASES {
            for word in base.split_whitespace().filter(|word| word.starts_with('<')) {
                kind_of(word.trim_matches(['<', '>']));
            }
        }
    }
}
