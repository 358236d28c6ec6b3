//! Checks that the player in exported pages is what its sources and the lock file build to. Needs Node.js
//! and the packages, which `tools/setup.sh test` installs beside the build directory.

#![cfg(feature = "cli")]

use std::collections::BTreeSet;
use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::Command;

use flate2::read::GzDecoder;

/// The files that the build script writes.
const BUILT: [&str; 3] = ["player.js.gz", "sorter.wasm.gz", "licences.txt"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        if path.is_file() {
            fs::copy(&path, to.join(path.file_name().unwrap())).unwrap();
        }
    }
}

/// A file's content; a `.gz` is decompressed, since zlib versions compress differently.
fn content(path: &Path) -> Vec<u8> {
    let bytes = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    if path.extension().is_some_and(|end| end == "gz") {
        let mut unpacked = Vec::new();
        GzDecoder::new(&bytes[..]).read_to_end(&mut unpacked).unwrap();
        return unpacked;
    }
    bytes
}

#[test]
fn the_player_is_what_its_sources_make() {
    let beside = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap().join("player");
    let ours = root().join("tools/player");
    let lock = |folder: &Path| fs::read_to_string(folder.join("package-lock.json")).ok();
    let modules = beside.join("node_modules");
    assert!(
        modules.exists() && lock(&beside) == lock(&ours),
        "{} does not hold the packages of tools/player/package-lock.json; tools/setup.sh test installs them",
        beside.display()
    );
    // The build runs on a copy, so that the source tree stays unchanged.
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("tools/player");
    copied(&ours, &copy);
    copied(&ours.join("src"), &copy.join("src"));
    copied(&root().join("src/view/page"), &folder.path().join("src/view/page"));
    std::os::unix::fs::symlink(&modules, copy.join("node_modules")).unwrap();
    let out = folder.path().join("out");
    let done = Command::new("node")
        .arg(copy.join("build.js"))
        .arg(&out)
        .output()
        .expect("node runs; tools/setup.sh test installs it");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let names = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().file_name());
    let names: BTreeSet<String> = names.map(|name| name.into_string().unwrap()).collect();
    assert_eq!(names, BUILT.map(String::from).into());
    for name in BUILT {
        let (kept, made) =
            (content(&root().join("src/scene/html").join(name)), content(&out.join(name)));
        assert!(
            kept == made,
            "src/scene/html/{name} is not what the sources make: run npm ci and npm run build in \
             tools/player, and commit what it writes"
        );
    }
}
