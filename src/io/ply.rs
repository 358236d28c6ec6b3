//! The PLY container: any element, any property order, ASCII and both byte orders.
//!
//! The readers of the formats interpret the properties: [`crate::scene::ply`] for 3D Gaussians, the
//! dataset readers for point clouds.

use std::path::Path;

use crate::error::excerpt;
use crate::{Error, Result};

/// A scalar type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    /// 8 bits, signed.
    I8,
    /// 8 bits, unsigned.
    U8,
    /// 16 bits, signed.
    I16,
    /// 16 bits, unsigned.
    U16,
    /// 32 bits, signed.
    I32,
    /// 32 bits, unsigned.
    U32,
    /// 32-bit float.
    F32,
    /// 64-bit float.
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Scalar> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// Decodes the value in the first [`Self::size`] bytes.
    fn decode(self, bytes: &[u8], order: Order) -> f64 {
        let mut raw = [0u8; 8];
        let size = self.size();
        raw[..size].copy_from_slice(&bytes[..size]);
        if order == Order::Big {
            raw[..size].reverse();
        }
        let word = u64::from_le_bytes(raw);
        match self {
            Scalar::I8 => f64::from(word as i8),
            Scalar::U8 => f64::from(word as u8),
            Scalar::I16 => f64::from(word as i16),
            Scalar::U16 => f64::from(word as u16),
            Scalar::I32 => f64::from(word as i32),
            Scalar::U32 => f64::from(word as u32),
            Scalar::F32 => f64::from(f32::from_bits(word as u32)),
            Scalar::F64 => f64::from_bits(word),
        }
    }
}

/// The type of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One value.
    Scalar(Scalar),
    /// A count of the first type, then as many values of the second.
    List(Scalar, Scalar),
}

/// A named column of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Property {
    /// Its name.
    pub name: String,
    /// Its type.
    pub kind: Kind,
}

/// A table of the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Element {
    /// Its name: `vertex`, `face`, …
    pub name: String,
    /// Number of rows that the header announces.
    pub count: u64,
    /// Its columns, in file order.
    pub properties: Vec<Property>,
}

impl Element {
    /// The index of a column.
    pub fn column(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Order {
    Ascii,
    Little,
    Big,
}

/// A PLY file whose header is parsed.
pub struct Ply<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    order: Order,
    body: usize,
    /// The tables, in file order.
    pub elements: Vec<Element>,
}

/// Whether the bytes begin as a PLY file does.
pub fn is_ply(bytes: &[u8]) -> bool {
    bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r")
}

impl<'a> Ply<'a> {
    /// Parses the header; `path` is used in error messages.
    pub fn parse(path: &'a Path, bytes: &'a [u8]) -> Result<Ply<'a>> {
        let bad = |what: String| Error::format(path, what);
        if !is_ply(bytes) {
            return Err(bad("is not a PLY file (it does not begin with `ply`)".into()));
        }
        let mut at = 0;
        let mut order = None;
        let mut elements: Vec<Element> = Vec::new();
        for number in 1.. {
            let rest = &bytes[at..];
            let length = rest.iter().position(|&b| b == b'\n').ok_or_else(|| {
                bad(format!("truncated: the header has no end_header (line {number})"))
            })?;
            at += length + 1;
            let line = std::str::from_utf8(&rest[..length])
                .map_err(|_| bad(format!("header line {number} is not text")))?;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            let odd = || bad(format!("header line {number} makes no sense: {}", excerpt(line)));
            match words.as_slice() {
                ["ply"] | ["comment", ..] | ["obj_info", ..] | [] => {}
                ["format", kind, _] => {
                    order = Some(match *kind {
                        "ascii" => Order::Ascii,
                        "binary_little_endian" => Order::Little,
                        "binary_big_endian" => Order::Big,
                        _ => return Err(odd()),
                    })
                }
                ["element", name, count] => elements.push(Element {
                    name: name.to_string(),
                    count: count.parse().map_err(|_| odd())?,
                    properties: Vec::new(),
                }),
                ["property", tail @ ..] => {
                    let (kind, name) = match tail {
                        ["list", count, item, name] => {
                            let count = Scalar::parse(count).ok_or_else(odd)?;
                            (Kind::List(count, Scalar::parse(item).ok_or_else(odd)?), name)
                        }
                        [kind, name] => (Kind::Scalar(Scalar::parse(kind).ok_or_else(odd)?), name),
                        _ => return Err(odd()),
                    };
                    let element = elements.last_mut().ok_or_else(odd)?;
                    element.properties.push(Property { name: name.to_string(), kind });
                }
                ["end_header"] => break,
                _ => return Err(odd()),
            }
        }
        let order = order.ok_or_else(|| bad("the header names no format".into()))?;
        Ok(Ply { path, bytes, order, body: at, elements })
    }

    /// The element with this name.
    pub fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|e| e.name == name)
    }

    /// Reads columns of one element, row-major, with the columns in the requested order. Memory
    /// stays within a small multiple of the file's size, whatever count the header announces.
    pub fn rows(&self, element: &str, columns: &[usize]) -> Result<Vec<f32>> {
        self.values(element, columns, |value| value as f32)
    }

    /// [`rows`](Self::rows) for integers that need all 32 bits; values out of range are clamped.
    pub fn words(&self, element: &str, columns: &[usize]) -> Result<Vec<u32>> {
        self.values(element, columns, |value| value as u32)
    }

    fn values<T: Copy + Default>(
        &self,
        element: &str,
        columns: &[usize],
        convert: fn(f64) -> T,
    ) -> Result<Vec<T>> {
        let mut rows = Vec::new();
        let mut slots = Vec::new();
        let mut body = Body { ply: self, at: self.body };
        for table in &self.elements {
            let wanted = table.name == element;
            slots.clear();
            slots.resize(table.properties.len(), None);
            if wanted {
                for (slot, &column) in columns.iter().enumerate() {
                    slots[column] = Some(slot);
                }
                body.check_room(table)?;
                rows.reserve_exact(table.count as usize * columns.len());
            }
            if table.properties.is_empty() {
                continue;
            }
            for row in 0..table.count {
                let start = rows.len();
                if wanted {
                    rows.resize(start + columns.len(), T::default());
                }
                for (property, slot) in table.properties.iter().zip(&slots) {
                    let short = || body_end(self.path, table, row, self.bytes.len());
                    match property.kind {
                        Kind::Scalar(kind) => {
                            let value = body.value(kind).map_err(|e| e.unwrap_or_else(short))?;
                            if let Some(slot) = slot {
                                rows[start + slot] = convert(value);
                            }
                        }
                        Kind::List(count, item) => {
                            let items = body.value(count).map_err(|e| e.unwrap_or_else(short))?;
                            for _ in 0..items.max(0.0) as u64 {
                                body.value(item).map_err(|e| e.unwrap_or_else(short))?;
                            }
                        }
                    }
                }
            }
            if wanted {
                return Ok(rows);
            }
        }
        Err(Error::format(self.path, format!("the PLY has no element `{element}`")))
    }
}

fn body_end(path: &Path, table: &Element, row: u64, size: usize) -> Error {
    Error::format(
        path,
        format!(
            "truncated: {} {row} of {} is cut off at byte {size}",
            excerpt(&table.name),
            table.count
        ),
    )
}

/// A read position in the values after the header.
struct Body<'a> {
    ply: &'a Ply<'a>,
    at: usize,
}

impl Body<'_> {
    /// Checks that the rest of the file can hold the number of rows that the header announces.
    fn check_room(&self, table: &Element) -> Result<()> {
        let least: usize = match self.ply.order {
            // At least a digit and a separator per value.
            Order::Ascii => 2 * table.properties.len(),
            _ => table
                .properties
                .iter()
                .map(|p| match p.kind {
                    Kind::Scalar(kind) | Kind::List(kind, _) => kind.size(),
                })
                .sum(),
        };
        // The last ASCII value needs no separator after it.
        let left = (self.ply.bytes.len() - self.at + 1) as u64;
        if table.count.checked_mul(least.max(1) as u64).is_none_or(|need| need > left) {
            let row = left / least.max(1) as u64;
            return Err(body_end(self.ply.path, table, row, self.ply.bytes.len()));
        }
        Ok(())
    }

    /// The next value; `Err(None)` at the end of the file.
    fn value(&mut self, kind: Scalar) -> std::result::Result<f64, Option<Error>> {
        let rest = &self.ply.bytes[self.at..];
        if self.ply.order != Order::Ascii {
            let bytes = rest.get(..kind.size()).ok_or(None)?;
            self.at += kind.size();
            return Ok(kind.decode(bytes, self.ply.order));
        }
        let start = rest.iter().position(|b| !b.is_ascii_whitespace()).ok_or(None)?;
        let word = &rest[start..];
        let length = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
        let value = std::str::from_utf8(&word[..length]).ok().and_then(|w| w.parse().ok());
        let at = self.at + start;
        self.at = at + length;
        value.ok_or_else(|| Some(Error::format(self.ply.path, format!("no number at byte {at}"))))
    }
}
