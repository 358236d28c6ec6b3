//! State files of this program: a value, the identity of its inputs, and a checksum.
//!
//! A file consists of a line with the format, its version and the kind of content; then, in
//! [postcard](https://docs.rs/postcard) encoding, the identity (the input and options that the
//! value belongs to) and the value; last the CRC-32 of all preceding bytes, little-endian. The
//! checksum is verified before anything is decoded.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{read, write_atomically};
use crate::{Error, Result};

/// Format version; increased whenever an older file would be misread.
const VERSION: u32 = 4;

/// The input and options that a value belongs to, by name; a value can only be reused under an
/// equal identity.
pub type Identity = BTreeMap<String, String>;

/// A checksum of any serialisable value, to distinguish inputs.
pub fn checksum<T: Serialize + ?Sized>(value: &T) -> String {
    let sum = postcard::serialize_with_flavor(value, Checksum(crc32fast::Hasher::new()));
    format!("{:08x}", sum.expect("a checksum takes any number of bytes"))
}

struct Checksum(crc32fast::Hasher);

impl postcard::ser_flavors::Flavor for Checksum {
    type Output = u32;

    fn try_push(&mut self, byte: u8) -> postcard::Result<()> {
        self.try_extend(&[byte])
    }

    fn try_extend(&mut self, bytes: &[u8]) -> postcard::Result<()> {
        self.0.update(bytes);
        Ok(())
    }

    fn finalize(self) -> postcard::Result<u32> {
        Ok(self.0.finalize())
    }
}

fn heading(kind: &str) -> String {
    format!("splat4d {kind} {VERSION}\n")
}

/// Writes a value with its identity, atomically by rename.
///
/// # Errors
/// The file cannot be written.
pub fn write_state<T: Serialize>(
    path: &Path,
    kind: &str,
    identity: &Identity,
    value: &T,
) -> Result<()> {
    let body = postcard::to_stdvec(&(identity, value))
        .map_err(|error| Error::format(path, format!("cannot be written: {error}")))?;
    let heading = heading(kind);
    let mut sum = crc32fast::Hasher::new();
    sum.update(heading.as_bytes());
    sum.update(&body);
    let sum = sum.finalize().to_le_bytes();
    write_atomically(path, |sink| {
        sink.write_all(heading.as_bytes())?;
        sink.write_all(&body)?;
        sink.write_all(&sum)
    })
}

/// Reads a value that was written with the same `kind` and `identity`.
///
/// # Errors
/// The file cannot be read, is of another kind or version, is damaged, or has another identity; in
/// the last case the error names the difference.
pub fn read_state<T: DeserializeOwned>(path: &Path, kind: &str, identity: &Identity) -> Result<T> {
    let bad = |what: String| Error::format(path, what);
    let bytes = read(path)?;
    let heading = heading(kind);
    let Some(rest) = bytes.strip_prefix(heading.as_bytes()) else {
        return Err(bad(format!(
            "is no {kind} of this version of splat4d (it does not begin with `{}`); start again \
             without resuming",
            heading.trim_end()
        )));
    };
    let intact = rest
        .split_last_chunk::<4>()
        .filter(|(_, sum)| crc32fast::hash(&bytes[..bytes.len() - 4]) == u32::from_le_bytes(**sum));
    let Some((body, _)) = intact else {
        return Err(bad(format!(
            "is damaged or cut off: the checksum of its {} bytes does not fit; start again without \
             resuming",
            bytes.len()
        )));
    };
    let undecoded = |error| bad(format!("cannot be decoded: {error}"));
    let (found, rest) = postcard::take_from_bytes::<Identity>(body).map_err(undecoded)?;
    if let Some(difference) = difference(&found, identity) {
        return Err(bad(format!(
            "belongs to other input or options: {difference}; give the same ones, or start again \
             without resuming"
        )));
    }
    match postcard::take_from_bytes(rest) {
        Ok((value, [])) => Ok(value),
        Ok((_, left)) => Err(bad(format!("has {} bytes too many", left.len()))),
        Err(error) => Err(undecoded(error)),
    }
}

/// A description of the first difference of two identities.
pub fn difference(found: &Identity, wanted: &Identity) -> Option<String> {
    let none = String::from("none");
    let names = found.keys().chain(wanted.keys());
    names.into_iter().find_map(|name| {
        let there = found.get(name).unwrap_or(&none);
        let here = wanted.get(name).unwrap_or(&none);
        (there != here).then(|| format!("{name} was {there} and is {here}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity(steps: u32) -> Identity {
        Identity::from([("steps".into(), steps.to_string())])
    }

    #[test]
    fn values_come_back_and_damage_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state");
        let value = (7u32, vec![[1.5f32, -0.0, f32::NAN]; 9], Some(String::from("text")));
        write_state(&path, "checkpoint", &identity(5), &value).unwrap();
        let back: (u32, Vec<[f32; 3]>, Option<String>) =
            read_state(&path, "checkpoint", &identity(5)).unwrap();
        let bits =
            |v: &[[f32; 3]]| v.as_flattened().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!((back.0, bits(&back.1), &back.2), (7, bits(&value.1), &value.2));

        let message = |error: Error| error.to_string();
        let read = |kind, steps| {
            message(
                read_state::<(u32, Vec<[f32; 3]>, Option<String>)>(&path, kind, &identity(steps))
                    .unwrap_err(),
            )
        };
        assert!(
            read("checkpoint", 6).contains("steps was 5 and is 6"),
            "{}",
            read("checkpoint", 6)
        );
        assert!(read("track", 5).contains("no track"));

        let whole = std::fs::read(&path).unwrap();
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] ^= 0x10;
            std::fs::write(&path, &damaged).unwrap();
            read("checkpoint", 5);
            std::fs::write(&path, &whole[..at]).unwrap();
            read("checkpoint", 5);
        }
    }
}
