//! Checks of output paths before long work begins; they leave nothing behind.

use std::collections::HashMap;
use std::fs;
use std::io::{ErrorKind, Read};
use std::path::{Component, Path, PathBuf};

use splat4d::{Error, Result, io};

use super::interrupt;

/// The output files of a command.
#[derive(Default)]
pub struct Outputs(Vec<Output>);

struct Output {
    /// The path as given by the user.
    path: PathBuf,
    /// Final location: absolute, with links resolved.
    place: PathBuf,
}

impl Outputs {
    /// Adds a file after checking that it can be written.
    ///
    /// # Errors
    /// The path is a folder, cannot be written, or is the location of another output.
    pub fn file(mut self, path: &Path) -> Result<Outputs> {
        let place = try_file(path)?;
        let taken =
            |other: &&Output| other.place.starts_with(&place) || place.starts_with(&other.place);
        if let Some(other) = self.0.iter().find(taken) {
            let what = format!("and {} cannot both be written there", other.path.display());
            return Err(Error::format(path, what));
        }
        self.0.push(Output { path: path.to_path_buf(), place });
        Ok(self)
    }

    /// Adds files of some names in a folder, which need not exist yet.
    pub fn folder(self, folder: &Path, names: &[&str]) -> Result<Outputs> {
        if fs::metadata(folder).is_ok_and(|found| !found.is_dir()) {
            return Err(Error::format(folder, "is a file; name a folder to write into"));
        }
        names.iter().try_fold(self, |outputs, name| outputs.file(&folder.join(name)))
    }

    /// Checks that none of these files overwrites an input of the command.
    pub fn spare(&self, inputs: &Inputs) -> Result<()> {
        self.0.iter().try_for_each(|output| inputs.spared_by(&output.path))
    }
}

/// The inputs of a command.
#[derive(Default)]
pub struct Inputs {
    files: HashMap<FileId, PathBuf>,
    folders: Vec<(FileId, Folder)>,
}

/// A folder, and the extensions of the files in it that are read.
pub type Folder = (PathBuf, &'static [&'static str]);

impl Inputs {
    /// Inputs from files and folders; missing ones are ignored.
    pub fn new(
        files: impl IntoIterator<Item = PathBuf>,
        folders: impl IntoIterator<Item = Folder>,
    ) -> Inputs {
        let mut inputs = Inputs::default();
        inputs.extend(files);
        for (folder, extensions) in folders {
            let Some(id) = file_id(&folder) else { continue };
            let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
            let paths = entries.map(|entry| entry.path());
            inputs.extend(paths.filter(|path| has_extension(path, extensions)));
            inputs.folders.push((id, (folder, extensions)));
        }
        inputs
    }

    /// These inputs and others.
    pub fn and(mut self, others: Inputs) -> Inputs {
        self.files.extend(others.files);
        self.folders.extend(others.folders);
        self
    }

    /// A checksum of all inputs: the files' names and contents.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn checksum(&self) -> Result<String> {
        let mut files: Vec<&PathBuf> = self.files.values().collect();
        files.sort();
        let (mut sum, mut part) = (crc32fast::Hasher::new(), vec![0; 1 << 20]);
        for path in files {
            sum.update(path.file_name().unwrap_or_default().as_encoded_bytes());
            let mut file = io::open(path)?;
            loop {
                interrupt::check()?;
                match file.read(&mut part).map_err(Error::io(path))? {
                    0 => break,
                    count => sum.update(&part[..count]),
                }
            }
        }
        Ok(format!("{:08x}", sum.finalize()))
    }

    fn extend(&mut self, files: impl IntoIterator<Item = PathBuf>) {
        let known = files.into_iter().filter_map(|path| Some((file_id(&path)?, path)));
        self.files.extend(known.filter(|(_, path)| !path.is_dir()));
    }

    /// Checks that a file can be written without overwriting an input of the command, including through
    /// links.
    pub fn spared_by(&self, output: &Path) -> Result<()> {
        if let Some(input) = file_id(output).and_then(|id| self.files.get(&id)) {
            let what = match input == output {
                true => "is read by this command; it would be lost. Name another file".to_owned(),
                false => {
                    let input = input.display();
                    format!(
                        "is {input}, which this command reads; it would be lost. Name another file"
                    )
                }
            };
            return Err(Error::format(output, what));
        }
        let folder = match output.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let Some(id) = file_id(folder) else { return Ok(()) };
        let reads = |(of, (_, extensions)): &&(FileId, Folder)| {
            *of == id && has_extension(output, extensions)
        };
        match self.folders.iter().find(reads) {
            Some((_, (folder, _))) => Err(Error::format(
                output,
                format!(
                    "would lie among the files that this command reads in {}, as one of them from \
                     then on. Name another place",
                    folder.display()
                ),
            )),
            None => Ok(()),
        }
    }
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    let found = path.extension().unwrap_or_default();
    extensions.iter().any(|extension| found.eq_ignore_ascii_case(extension))
}

/// Identity of a file, independent of its path.
#[cfg(unix)]
type FileId = (u64, u64);
#[cfg(not(unix))]
type FileId = PathBuf;

#[cfg(unix)]
fn file_id(path: &Path) -> Option<FileId> {
    use std::os::unix::fs::MetadataExt;
    let found = fs::metadata(path).ok()?;
    (found.is_file() || found.is_dir()).then(|| (found.dev(), found.ino()))
}

#[cfg(not(unix))]
fn file_id(path: &Path) -> Option<FileId> {
    fs::canonicalize(path).ok()
}

/// Checks that a file can be written, and returns its location.
fn try_file(path: &Path) -> Result<PathBuf> {
    let named = path.as_os_str().as_encoded_bytes();
    let ends = |end: &str| named.ends_with(end.as_bytes());
    if path.file_name().is_none() || ends("/") || ends("/.") || ends(std::path::MAIN_SEPARATOR_STR)
    {
        return Err(Error::format(path, "names a folder; name the file to write"));
    }
    match fs::metadata(path) {
        Ok(found) if found.is_dir() => {
            return Err(Error::format(path, "is a folder; name the file to write"));
        }
        // Pipes and devices are written in place. A pipe is not opened here, because its reader would
        // interpret the close as the end.
        Ok(found) if is_pipe(&found) => return Ok(path.to_path_buf()),
        Ok(found) if !found.is_file() => {
            let device = fs::File::options().write(true).open(path);
            return device.map(|_| path.to_path_buf()).map_err(Error::io(path));
        }
        _ => {}
    }
    let target = io::follow_links(path).map_err(Error::io(path))?;
    try_beside(path, &target)
}

#[cfg(unix)]
fn is_pipe(found: &fs::Metadata) -> bool {
    std::os::unix::fs::FileTypeExt::is_fifo(&found.file_type())
}

#[cfg(not(unix))]
fn is_pipe(_: &fs::Metadata) -> bool {
    false
}

/// Creates the file, and its missing parent folders, in a temporary folder beside their final location,
/// because the same conditions prevent both. Returns the final location.
fn try_beside(output: &Path, target: &Path) -> Result<PathBuf> {
    let mut folder = target.parent().unwrap_or(Path::new(""));
    let folder = loop {
        let here = if folder == Path::new("") { Path::new(".") } else { folder };
        match fs::metadata(here) {
            Ok(found) if found.is_dir() => break here,
            Ok(_) => return Err(Error::format(output, format!("{} is a file", here.display()))),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                if here.is_symlink() {
                    let what = format!("{} is a symbolic link to nothing", here.display());
                    return Err(Error::format(output, what));
                }
                folder = here.parent().ok_or_else(|| Error::io(output)(error))?;
            }
            Err(error) => return Err(Error::io(output)(error)),
        }
    };
    let refused = |error: std::io::Error| Error::Io {
        path: output.to_path_buf(),
        source: std::io::Error::new(
            error.kind(),
            format!("cannot write into {}: {}", folder.display(), plain(&error)),
        ),
    };
    let missing = target.strip_prefix(folder).unwrap_or(target);
    let trial = tempfile::Builder::new().prefix(".splat4d-").tempdir_in(folder).map_err(refused)?;
    // A path with `..` would lead out of the temporary folder.
    if !missing.components().any(|part| part == Component::ParentDir) {
        let file = trial.path().join(missing);
        let made = file.parent().map_or(Ok(()), fs::create_dir_all);
        made.and_then(|()| fs::File::create_new(&file)).map_err(refused)?;
    }
    Ok(fs::canonicalize(folder).map_err(Error::io(output))?.join(missing))
}

/// The system's message without the temporary file's name.
fn plain(error: &std::io::Error) -> String {
    let text = error.to_string();
    text.split(" at path ").next().unwrap_or(&text).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &Path) -> Result<Outputs> {
        Outputs::default().file(path)
    }

    fn message<T>(result: Result<T>) -> String {
        result.err().expect("an error").to_string()
    }

    #[test]
    fn outputs_are_tried_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let inside = folder.path().join("a/b/scene.safetensors");
        file(&inside).unwrap();
        Outputs::default().folder(&inside, &["x"]).unwrap();
        file(&folder.path().join("missing/../../x")).unwrap();
        let long = |length: usize| folder.path().join("new").join("n".repeat(length));
        file(&long(255)).unwrap();
        assert!(message(file(&long(256))).contains("too long"));
        for folder_like in ["new/", "new/.", "new/..", "a.mp4/"] {
            let message = message(file(&folder.path().join(folder_like)));
            assert!(message.contains("name the file"), "{folder_like}: {message}");
        }
        assert!(fs::read_dir(folder.path()).unwrap().next().is_none(), "nothing is left");
        let there = folder.path().join("file");
        fs::write(&there, "x").unwrap();
        file(&there).unwrap();
        assert!(message(Outputs::default().folder(&there, &["x"])).contains("name a folder"));
        assert!(file(&there.join("below")).is_err());
        assert!(message(file(folder.path())).contains("is a folder"));
        assert_eq!(fs::read(&there).unwrap(), b"x");
    }

    #[test]
    fn two_outputs_need_two_places() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let both = |a: &str, b: &str| file(&at(a)).unwrap().file(&at(b));
        both("x", "y").unwrap();
        both("x", "x.y").unwrap();
        for (a, b) in [("x", "x"), ("x", "./x"), ("x", "x/y"), ("new/x/y", "new/x")] {
            assert!(message(both(a, b)).contains("both"), "{a} {b}");
        }
    }

    #[test]
    fn inputs_are_spared() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("set")).unwrap();
        for name in ["set/1.png", "set/notes.txt"] {
            fs::write(at(name), name).unwrap();
        }
        fs::hard_link(at("set/1.png"), at("hard")).unwrap();
        let inputs = Inputs::new([at("set/1.png")], [(at("set"), &["png"][..])]);
        let spared = |name: &str| inputs.spared_by(&at(name));
        for name in ["set/1.png", "set/../set/1.png", "hard"] {
            assert!(message(spared(name)).contains("set/1.png"), "{name}");
        }
        assert!(message(spared("set/new.png")).contains("among the files"));
        for name in ["set/new", "set/notes.txt", "1.png", "set/inner/1.png"] {
            spared(name).unwrap();
        }
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink("set", at("soft")).unwrap();
            assert!(message(spared("soft/1.png")).contains("set/1.png"));
            assert!(message(spared("soft/2.png")).contains("among the files"));
        }
    }
}
