//! Damaged copies of files and folders.

use std::fs;
use std::path::{Path, PathBuf};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::fixtures::files;
use crate::wild::WILD;

/// Copies a file, or a folder recursively, and damages or removes one file of the copy.
///
/// # Errors
/// The copy cannot be written.
pub fn copy(from: &Path, to: &Path, rng: &mut ChaCha8Rng) -> std::io::Result<()> {
    if from.is_file() {
        return fs::write(to, damaged(fs::read(from)?, rng));
    }
    let mut all: Vec<PathBuf> = Vec::new();
    files(from, &mut all);
    all.sort();
    // Text files are preferred: they affect the program more than pixels do.
    let texts: Vec<usize> = (0..all.len())
        .filter(|&i| all[i].extension().is_some_and(|e| e == "json" || e == "txt"))
        .collect();
    let victim = match texts.is_empty() || rng.random_range(0..2) == 0 {
        true => rng.random_range(0..all.len().max(1)),
        false => texts[rng.random_range(0..texts.len())],
    };
    for (i, file) in all.iter().enumerate() {
        let target = to.join(file.strip_prefix(from).unwrap_or(file));
        fs::create_dir_all(target.parent().unwrap_or(to))?;
        if i != victim {
            fs::copy(file, target)?;
        } else if rng.random_range(0..5) > 0 {
            fs::write(target, damaged(fs::read(file)?, rng))?;
        }
    }
    Ok(())
}

/// A few changes: bytes flipped, the end cut off, numbers made hostile, parts doubled or cut out.
fn damaged(mut bytes: Vec<u8>, rng: &mut ChaCha8Rng) -> Vec<u8> {
    for _ in 0..rng.random_range(1..4) {
        if bytes.is_empty() {
            return bytes;
        }
        // Headers are short and matter most, so half of the changes are at the start.
        let within = if rng.random_range(0..2) == 0 { bytes.len().min(512) } else { bytes.len() };
        let at = rng.random_range(0..within);
        let end = (at + rng.random_range(1..65)).min(bytes.len());
        match rng.random_range(0..7) {
            0 | 1 => bytes[at] = rng.random_range(0..=255),
            2 => bytes.truncate(at),
            3 => {
                let word = [0u32, 1, 0x7f7f_ffff, 0x7fc0_0000, u32::MAX][rng.random_range(0..5)];
                let end = (at + 4).min(bytes.len());
                bytes[at..end].copy_from_slice(&word.to_le_bytes()[..end - at]);
            }
            4 => {
                if let Some((start, end)) = number(&bytes, at) {
                    let other = WILD[rng.random_range(0..WILD.len())];
                    bytes.splice(start..end, other.bytes());
                }
            }
            5 => {
                let part = bytes[at..end].to_vec();
                bytes.splice(at..at, part);
            }
            _ => drop(bytes.drain(at..end)),
        }
    }
    bytes
}

/// Start and end of the first number in a text at or after byte `at`.
fn number(bytes: &[u8], at: usize) -> Option<(usize, usize)> {
    let of_number = |b: &u8| b.is_ascii_digit() || b"+-.eE".contains(b);
    let start = at + bytes[at..].iter().position(|b| b.is_ascii_digit())?;
    let start = start - bytes[..start].iter().rev().take_while(|b| of_number(b)).count();
    let length = bytes[start..].iter().take_while(|b| of_number(b)).count();
    Some((start, start + length))
}
