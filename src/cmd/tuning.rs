//! Settings files that trade accuracy for speed: `bench` writes them, `render` and `train` read them.

use std::path::Path;

use splat4d::error::excerpt;
use splat4d::types::Tuning;
use splat4d::{Error, Result, io};

/// Writes settings, by rename.
pub fn write(path: &Path, tuning: &Tuning) -> Result<()> {
    io::write_atomically(path, |sink| {
        serde_json::to_writer_pretty(sink, tuning).map_err(std::io::Error::other)
    })
}

/// Reads settings; without a file, the most accurate ones.
pub fn read(path: Option<&Path>) -> Result<Tuning> {
    let Some(path) = path else { return Ok(Tuning::default()) };
    let tuning: Tuning = serde_json::from_value(io::read_json(path)?).map_err(|e| {
        Error::format(path, format!("is no file of settings: {}", excerpt(&e.to_string())))
    })?;
    tuning.check().map_err(|e| Error::format(path, e.to_string()))?;
    Ok(tuning)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_come_back_and_mistakes_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fast.json");
        let fast = Tuning { depth_bits: 16, alpha_cut: Some(0.02), ..Tuning::default() };
        write(&path, &fast).unwrap();
        assert_eq!(read(Some(&path)).unwrap(), fast);
        assert_eq!(read(None).unwrap(), Tuning::default());
        for (text, named) in [
            (r#"{"depth_bits": 99}"#, "depth_bits"),
            (r#"{"depht_bits": 9}"#, "depht_bits"),
            ("[1", "JSON"),
        ] {
            std::fs::write(&path, text).unwrap();
            let message = read(Some(&path)).unwrap_err().to_string();
            assert!(message.contains(named) && message.contains("fast.json"), "{message}");
        }
    }
}
