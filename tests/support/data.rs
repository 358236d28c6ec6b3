//! Access to the real data sets, which lie beside the project.

use std::path::{Path, PathBuf};

/// A path in the real data; `None`, with a warning, if it is absent. With `SPLAT4D_REQUIRE_DATA=1`, which
/// `tools/test.sh` sets if the data is present, an absent path fails.
pub fn shared_data(name: &str) -> Option<PathBuf> {
    let base = match std::env::var_os("SPLAT4D_DATA") {
        Some(base) => PathBuf::from(base),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
    };
    let path = base.join(name);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var("SPLAT4D_REQUIRE_DATA").is_ok_and(|value| value == "1");
    assert!(!required, "SPLAT4D_REQUIRE_DATA=1, and {} is absent", path.display());
    println!("SKIPPED (no shared data): {name}");
    None
}
