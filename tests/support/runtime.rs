//! The ONNX Runtime that `tools/setup.sh test` installs beside the build.

use std::path::{Path, PathBuf};

/// Its library: `lib/python*/site-packages/onnxruntime/capi/libonnxruntime.so*` in the environment that the setup
/// makes, else what `ORT_DYLIB_PATH` names.
pub fn library() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap().join("onnxruntime");
    within(&beside).or_else(|| std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from))
}

fn within(environment: &Path) -> Option<PathBuf> {
    let python = std::fs::read_dir(environment.join("lib")).ok()?.flatten().next()?.path();
    let files = std::fs::read_dir(python.join("site-packages/onnxruntime/capi")).ok()?.flatten();
    let library = |path: &PathBuf| path.to_string_lossy().contains("/libonnxruntime.so");
    files.map(|entry| entry.path()).find(library)
}
