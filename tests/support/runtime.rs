//! The ONNX Runtime that `tools/setup.sh test` installs beside the build directory.

use std::path::{Path, PathBuf};

/// Path of the runtime's library: `lib/python*/site-packages/onnxruntime/capi/libonnxruntime.so*` in the
/// environment of `tools/setup.sh`, else the path in `ORT_DYLIB_PATH`.
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
