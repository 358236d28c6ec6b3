//! Gaussians as binary glTF 2.0 with `KHR_gaussian_splatting`, written only.
//!
//! The file has one point primitive with an accessor per attribute: `POSITION`, `COLOR_0` (for
//! programs that render points: the linear colour of the constant harmonic, and the opacity, in 8
//! bits) and those of the extension: `ROTATION` (x, y, z, w, of unit length), `SCALE` (standard
//! deviations), `OPACITY` in [0, 1], `SH_DEGREE_l_COEF_n`. All but `COLOR_0` are f32. glTF's axes
//! are left, up and front: x and y change their signs relative to this crate.
//!
//! With the extension `KHR_gaussian_splatting_compression_spz_2` the Gaussians are an SPZ of version 2 in one
//! buffer view, with SPZ's own axes, and the accessors are without data: readers map what they unpack to
//! left, up and front. Both extensions are then required to read the file.
//!
//! Source: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting, the release candidate as of
//! July 2026; KHR_gaussian_splatting_compression_spz_2, the draft that CesiumJS reads.

use std::io::Write;
use std::path::Path;

use serde_json::{Map, Value, json};

use super::axes::Axes;
use super::{packing, spz};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result, io};

/// glTF component types: unsigned byte and float.
const BYTE: u32 = 5121;
const FLOAT: u32 = 5126;
/// glTF buffer-view target of vertex attributes (ARRAY_BUFFER).
const ARRAY: u32 = 34962;
/// Name of the extension.
const NAME: &str = "KHR_gaussian_splatting";
/// Name of the extension in it for an SPZ.
const SPZ: &str = "KHR_gaussian_splatting_compression_spz_2";
/// Size of the headers of the file and of its two chunks, bytes.
const HEADERS: usize = 28;

/// A vertex attribute: its name, its number of components and its values.
struct Attribute<'a> {
    name: String,
    parts: usize,
    values: Values<'a>,
}

enum Values<'a> {
    Float(Box<dyn Fn(usize) -> [f32; 4] + 'a>),
    Byte(Box<dyn Fn(usize) -> [u8; 4] + 'a>),
}

/// Writes Gaussians, atomically by rename. Motion logits are not written.
///
/// # Errors
/// [`Error::Shape`] if arrays differ in length; [`Error::Input`] without Gaussians, since glTF
/// forbids empty accessors, or for more than the format's 4 GiB; [`Error::Io`].
pub fn write(path: impl AsRef<Path>, gaussians: &Gaussians) -> Result<()> {
    super::file::check_lengths(gaussians)?;
    check(gaussians)?;
    io::write_atomically(path, |sink| encode(gaussians, sink))
}

/// Checks that glTF can hold these Gaussians.
pub(super) fn check(g: &Gaussians) -> Result<()> {
    if g.is_empty() {
        return Err(Error::Input("glTF does not hold a scene without Gaussians".into()));
    }
    let size = g.len() as u64 * (48 + 12 * sh_coefficients(g.sh_degree) as u64);
    match size < u64::from(u32::MAX) - (1 << 20) {
        true => Ok(()),
        false => {
            let what =
                "the scene is larger than the 4 GiB of a .glb; export fewer Gaussians or bands";
            Err(Error::Input(what.into()))
        }
    }
}

/// Encodes the file; [`check`] must have passed.
pub(super) fn encode(g: &Gaussians, sink: &mut dyn Write) -> std::io::Result<()> {
    let attributes = attributes(g);
    let size: usize = attributes.iter().map(|a| a.size() * g.len()).sum();
    begin(&header(g, &attributes, None), size, sink)?;
    for attribute in &attributes {
        for i in 0..g.len() {
            match &attribute.values {
                Values::Byte(of) => sink.write_all(&of(i)[..attribute.parts])?,
                Values::Float(of) => {
                    for value in &of(i)[..attribute.parts] {
                        sink.write_all(&value.to_le_bytes())?;
                    }
                }
            }
        }
    }
    Ok(())
}

/// The bytes of a file whose Gaussians are an SPZ, and the number of Gaussians in it.
///
/// # Errors
/// As for [`spz::write`].
pub(super) fn compressed(g: &Gaussians) -> Result<(Vec<u8>, usize)> {
    let (mut packed, count) = spz::encoded(g, spz::Version::V2, &[])?;
    // The header tells the bounds of what is unpacked.
    let unpacked = spz::parse(Path::new("an SPZ"), &packed, false)?.scene.gaussians;
    let header = header(&unpacked, &attributes(&unpacked), Some(packed.len()));
    packed.resize(packed.len().next_multiple_of(4), 0);
    let mut bytes = Vec::new();
    begin(&header, packed.len(), &mut bytes).map_err(Error::io("memory"))?;
    bytes.extend(packed);
    Ok((bytes, count))
}

/// Writes all before the binary chunk's data of `size` bytes, a multiple of 4.
fn begin(header: &Value, size: usize, sink: &mut dyn Write) -> std::io::Result<()> {
    let json = header.to_string();
    let json = format!("{json:<width$}", width = json.len().next_multiple_of(4));
    let mut word = |value: usize| sink.write_all(&(value as u32).to_le_bytes());
    word(0x4654_6c67)?;
    word(2)?;
    word(HEADERS + json.len() + size)?;
    word(json.len())?;
    word(0x4e4f_534a)?;
    sink.write_all(json.as_bytes())?;
    let mut word = |value: usize| sink.write_all(&(value as u32).to_le_bytes());
    word(size)?;
    word(0x004e_4942)
}

impl Attribute<'_> {
    /// Bytes per Gaussian.
    fn size(&self) -> usize {
        self.parts * if matches!(self.values, Values::Byte(_)) { 1 } else { 4 }
    }
}

fn float<'a>(name: String, parts: usize, of: Box<dyn Fn(usize) -> [f32; 4] + 'a>) -> Attribute<'a> {
    Attribute { name, parts, values: Values::Float(of) }
}

fn attributes(g: &Gaussians) -> Vec<Attribute<'_>> {
    let (axes, bands) = (Axes::GLTF, sh_coefficients(g.sh_degree));
    let three = |[x, y, z]: [f32; 3]| [x, y, z, 0.0];
    let colour = move |i: usize| {
        let [red, green, blue] =
            packing::colour(g.sh[i * bands]).map(|c| packing::byte(linear(c.clamp(0.0, 1.0))));
        [red, green, blue, packing::byte(packing::opacity(g.opacity_logits[i]))]
    };
    let mut all = vec![
        float("POSITION".into(), 3, Box::new(move |i| three(axes.place(g.positions[i])))),
        Attribute { name: "COLOR_0".into(), parts: 4, values: Values::Byte(Box::new(colour)) },
        float(
            format!("{NAME}:ROTATION"),
            4,
            Box::new(move |i| {
                let [w, x, y, z] = axes.turn(packing::unit(g.rotations[i]));
                [x, y, z, w]
            }),
        ),
        float(format!("{NAME}:SCALE"), 3, Box::new(move |i| three(g.log_scales[i].map(f32::exp)))),
        float(
            format!("{NAME}:OPACITY"),
            1,
            Box::new(move |i| [packing::opacity(g.opacity_logits[i]), 0.0, 0.0, 0.0]),
        ),
    ];
    for degree in 0..=g.sh_degree {
        let first = (degree * degree) as usize;
        for n in 0..2 * degree as usize + 1 {
            let k = first + n;
            let sign = if k == 0 { 1.0 } else { axes.harmonic(k - 1) };
            all.push(float(
                format!("{NAME}:SH_DEGREE_{degree}_COEF_{n}"),
                3,
                Box::new(move |i| three(g.sh[i * bands + k].map(|h| sign * h))),
            ));
        }
    }
    all
}

/// The sRGB transfer function from encoded to linear values.
fn linear(value: f32) -> f32 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// The JSON; `spz` is the size of the SPZ that holds the attributes, if one does.
fn header(g: &Gaussians, attributes: &[Attribute<'_>], spz: Option<usize>) -> Value {
    let mut at = 0;
    let (mut views, mut accessors, mut names) = (Vec::new(), Vec::new(), Map::new());
    for (index, attribute) in attributes.iter().enumerate() {
        let is_byte = matches!(attribute.values, Values::Byte(_));
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][attribute.parts - 1];
        let mut accessor = json!({
            "componentType": if is_byte { BYTE } else { FLOAT },
            "count": g.len(),
            "type": kind,
        });
        if spz.is_none() {
            let size = attribute.size() * g.len();
            views.push(
                json!({ "buffer": 0, "byteOffset": at, "byteLength": size, "target": ARRAY }),
            );
            accessor["bufferView"] = json!(index);
            at += size;
        }
        if is_byte {
            accessor["normalized"] = json!(true);
        }
        // glTF requires the bounds of positions.
        if let (0, Values::Float(of)) = (index, &attribute.values) {
            let fold = |start: f32, with: fn(f32, f32) -> f32| -> [f32; 3] {
                (0..g.len())
                    .fold([start; 3], |bound, i| std::array::from_fn(|c| with(bound[c], of(i)[c])))
            };
            accessor["min"] = json!(fold(f32::INFINITY, f32::min));
            accessor["max"] = json!(fold(f32::NEG_INFINITY, f32::max));
        }
        accessors.push(accessor);
        names.insert(attribute.name.clone(), json!(index));
    }
    let mut splatting = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    });
    if let Some(size) = spz {
        views.push(json!({ "buffer": 0, "byteLength": size }));
        splatting["extensions"] = json!({ SPZ: { "bufferView": 0 } });
    }
    let mut json = json!({
        "asset": { "version": "2.0", "generator": concat!("splat4d ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{
            "attributes": names,
            "mode": 0,
            "extensions": { NAME: splatting },
        }] }],
        "buffers": [{ "byteLength": spz.unwrap_or(at) }],
        "bufferViews": views,
        "accessors": accessors,
    });
    if spz.is_some() {
        json["extensionsUsed"] = json!([NAME, SPZ]);
        json["extensionsRequired"] = json!([NAME, SPZ]);
    }
    json
}
