//! The compact form of a scene's own file: the same tensors, most of them in few bits.
//!
//! A tensor that the metadata's entry `packed` names is of bytes, a zstd stream. What it unpacks to are
//! numbers of `bytes` bytes each, `shape` of them, column by column (the first axis runs fastest), and of
//! all numbers first the lowest byte, then the next. Without `step` they are halves; else whole numbers
//! without sign, and the value of number `n` in column `c` is `offset[c] + step[c] * n`. Metadata, other
//! tensors and what these values mean are those of the plain form ([`mod@super::file`]), but for
//! `gaussians.opacity`, the opacity itself, in place of its logit, and quaternions of unit length.
//!
//! | name | step |
//! |---|---|
//! | `gaussians.position` | a share of the smaller Gaussians' size |
//! | `gaussians.log_scale` | 1/32 |
//! | `gaussians.rotation` | 1/127 |
//! | `gaussians.opacity` | 1/255 |
//! | `gaussians.sh` | one level of an 8-bit colour for the constant, 1/64 for the rest |
//! | `gaussians.motion_logit` | what moves alone: −10 or 10 |
//! | `control_points.path` | halves, or floats where a half would be off by a quarter of such a size |
//! | `network.*` | halves |
//!
//! Harmonics of bands that are 0 throughout are left out, and the Gaussians lie along a Morton curve.

use std::borrow::Cow;
use std::io::Write;
use std::path::Path;

use half::f16;
use serde_json::{Map, Value, json};

use super::file::{self, Tensor, Values};
use super::{Scene, packing};
use crate::types::{Gaussians, SH_C0, sh_coefficients};
use crate::{Error, Result, io};

/// The version of the format that has packed tensors.
pub(super) const VERSION: u32 = 3;
/// Steps of a position in a Gaussian.
const STEPS: f32 = 64.0;
/// Motions may be off by so many of these.
const MOTION_STEPS: f32 = 16.0;
/// Of log scales.
const SCALE_STEP: f32 = 1.0 / 32.0;
/// Of the parts of a unit quaternion.
const ROTATION_STEP: f32 = 1.0 / 127.0;
/// Of harmonics above the constant.
const HARMONIC_STEP: f32 = 1.0 / 64.0;
/// Of the constant harmonic: a level of an 8-bit colour.
const CONSTANT_STEP: f32 = 1.0 / 255.0 / SH_C0;
/// The motion logits of what stands still and of what moves.
const MOTION: [f32; 2] = [-10.0, 10.0];
/// zstd's effort.
const EFFORT: i32 = 19;

/// Writes a scene in the compact form, by rename. The same scene gives the same bytes.
///
/// # Errors
/// Arrays of the scene do not belong together ([`Error::Shape`]), or the file cannot be written.
pub fn write(path: impl AsRef<Path>, scene: &Scene) -> Result<()> {
    let bytes = encoded(scene)?;
    io::write_atomically(path, |sink| sink.write_all(&bytes))
}

/// [`write`]'s bytes.
pub(super) fn encoded(scene: &Scene) -> Result<Vec<u8>> {
    file::check_lengths(&scene.gaussians)?;
    let scene = Scene { gaussians: reduced(&scene.gaussians), ..scene.clone() };
    let mut packed = Map::new();
    let mut tensors = Vec::new();
    for tensor in file::tensors(&scene)? {
        tensors.push(match steps(&tensor, &scene.gaussians) {
            None => tensor,
            Some(rule) => rule.pack(tensor, &mut packed)?,
        });
    }
    let mut metadata = file::metadata(&scene);
    metadata["version"] = json!(VERSION.to_string());
    metadata["packed"] = json!(Value::Object(packed).to_string());
    let mut bytes = Vec::new();
    file::put(metadata, &tensors, &mut bytes).map_err(|e| Error::Failed(e.to_string()))?;
    Ok(bytes)
}

/// The Gaussians in the order of a Morton curve, without bands that no step is left of.
fn reduced(g: &Gaussians) -> Gaussians {
    let mut out = packing::picked(g, &packing::morton_order(&g.positions));
    out.rotations.iter_mut().for_each(|q| *q = packing::largest(packing::unit(*q)).1);
    let bands = sh_coefficients(g.sh_degree);
    for rows in out.sh.chunks_exact_mut(bands) {
        for h in rows[1..].as_flattened_mut().iter_mut().filter(|h| h.abs() < 0.5 * HARMONIC_STEP) {
            *h = 0.0;
        }
    }
    let degree = out.used_sh_degree();
    out.at_degree(degree)
}

/// How a tensor is packed.
enum Rule {
    /// Steps of each column.
    Steps(Vec<f32>),
    /// The logits become opacities.
    Opacity,
    /// What is above 0, and what is not.
    Motion,
    Half,
}

fn steps(tensor: &Tensor<'_>, g: &Gaussians) -> Option<Rule> {
    if !matches!(tensor.values, Values::F32(_)) {
        return None;
    }
    let columns: usize = tensor.shape.iter().skip(1).product();
    Some(match &tensor.name[..] {
        "gaussians.position" => Rule::Steps(vec![place_step(g); 3]),
        "gaussians.log_scale" => Rule::Steps(vec![SCALE_STEP; 3]),
        "gaussians.rotation" => Rule::Steps(vec![ROTATION_STEP; 4]),
        "gaussians.opacity_logit" => Rule::Opacity,
        "gaussians.motion_logit" => Rule::Motion,
        "gaussians.sh" => {
            let step = |c: usize| if c < 3 { CONSTANT_STEP } else { HARMONIC_STEP };
            Rule::Steps((0..columns).map(step).collect())
        }
        // Halves are too coarse for what is far from its canonical place.
        "control_points.path" if half_error(tensor) <= MOTION_STEPS * place_step(g) => Rule::Half,
        name if name.starts_with("network.") => Rule::Half,
        _ => return None,
    })
}

/// By how much the largest value of a tensor may be off as a half.
fn half_error(tensor: &Tensor<'_>) -> f32 {
    let Values::F32(values) = &tensor.values else { return 0.0 };
    let translations = values.chunks_exact(8).flat_map(|motion| &motion[..3]);
    translations.fold(0.0f32, |far, v| far.max(v.abs())) / 2048.0
}

/// A share of the size of the smaller Gaussians, one of ten of which is smaller; no less than what 32
/// bits tell apart.
fn place_step(g: &Gaussians) -> f32 {
    let largest = |s: &[f32; 3]| s[0].max(s[1]).max(s[2]);
    let mut sizes: Vec<f32> = g.log_scales.iter().map(largest).collect();
    if sizes.is_empty() {
        return 1.0;
    }
    let tenth = sizes.len() / 10;
    let (_, size, _) = sizes.select_nth_unstable_by(tenth, f32::total_cmp);
    let far = g.positions.as_flattened().iter().fold(0.0f32, |far, v| far.max(v.abs()));
    (size.exp() / STEPS).max(far / 1e9).max(f32::MIN_POSITIVE)
}

impl Rule {
    fn pack<'a>(&self, tensor: Tensor<'a>, packed: &mut Map<String, Value>) -> Result<Tensor<'a>> {
        let Values::F32(values) = tensor.values else { return Ok(tensor) };
        let (mut name, shape) = (tensor.name, tensor.shape);
        let columns = shape.iter().skip(1).product::<usize>().max(1);
        let (values, steps) = match self {
            Rule::Half => {
                let numbers =
                    values.iter().map(|v| u32::from(f16::from_f32(*v).to_bits())).collect();
                let bytes = planes(numbers, columns, 2);
                packed.insert(name.clone(), json!({ "shape": shape, "bytes": 2 }));
                return stream(name, &bytes);
            }
            Rule::Steps(steps) => (Cow::Borrowed(values), Cow::Borrowed(&steps[..])),
            Rule::Opacity => {
                name = "gaussians.opacity".into();
                let opacities = values.iter().map(|v| packing::opacity(*v)).collect();
                (Cow::Owned(opacities), Cow::Owned(vec![1.0 / 255.0]))
            }
            Rule::Motion => {
                let which = values.iter().map(|v| MOTION[usize::from(*v > 0.0)]).collect();
                (Cow::Owned(which), Cow::Owned(vec![MOTION[1] - MOTION[0]]))
            }
        };
        let mut offsets = vec![f32::INFINITY; columns];
        for row in values.chunks_exact(columns) {
            offsets.iter_mut().zip(row).for_each(|(least, v)| *least = least.min(*v));
        }
        // Whole steps from 0, so that 0 stays 0; opacities and motion begin at their own least.
        for (offset, step) in offsets.iter_mut().zip(&*steps) {
            *offset = match self {
                Rule::Opacity => 0.0,
                Rule::Motion => MOTION[0],
                _ if offset.is_finite() => (*offset / step).floor() * step,
                _ => 0.0,
            };
        }
        let number = |(at, v): (usize, &f32)| {
            let c = at % columns;
            ((f64::from(*v) - f64::from(offsets[c])) / f64::from(steps[c])).round() as u32
        };
        let numbers: Vec<u32> = values.iter().enumerate().map(number).collect();
        let most = numbers.iter().copied().max().unwrap_or(0);
        let bytes = (1..4).find(|bytes| most >> (8 * bytes) == 0).unwrap_or(4);
        let stored = planes(numbers, columns, bytes);
        packed.insert(
            name.clone(),
            json!({ "shape": shape, "bytes": bytes, "offset": offsets, "step": steps }),
        );
        stream(name, &stored)
    }
}

/// Numbers column by column, of all of them first the lowest byte.
fn planes(numbers: Vec<u32>, columns: usize, bytes: usize) -> Vec<u8> {
    let plane = |byte: usize| {
        let column = |c: usize| numbers[c.min(numbers.len())..].iter().step_by(columns);
        let numbers = (0..columns).flat_map(column).collect::<Vec<_>>();
        numbers.into_iter().map(move |n| (n >> (8 * byte)) as u8)
    };
    (0..bytes).flat_map(plane).collect()
}

fn stream<'a>(name: String, bytes: &[u8]) -> Result<Tensor<'a>> {
    let packed = zstd::bulk::compress(bytes, EFFORT)
        .map_err(|e| Error::Failed(format!("compressing failed: {e}")))?;
    Ok(Tensor { name, shape: vec![packed.len()], values: Values::Bytes(packed) })
}

/// The shape and the values of a packed tensor, by its entry in the metadata.
pub(super) fn unpacked(
    path: &Path,
    name: &str,
    entry: &Value,
    data: &[u8],
    file: usize,
) -> Result<(Vec<usize>, Vec<f32>)> {
    let bad = || Error::format(path, format!("metadata `packed` has no valid entry for {name}"));
    let shape = entry["shape"].as_array().filter(|axes| !axes.is_empty()).ok_or_else(bad)?;
    let axis = |v: &Value| v.as_u64().and_then(|v| usize::try_from(v).ok());
    let shape: Vec<usize> = shape.iter().map(axis).collect::<Option<_>>().ok_or_else(bad)?;
    let product = |axes: &[usize]| axes.iter().try_fold(1usize, |p, &v| p.checked_mul(v));
    let columns = product(&shape[1..]).filter(|c| *c > 0 || shape[0] == 0).ok_or_else(bad)?.max(1);
    let count = product(&shape).ok_or_else(bad)?;
    let bytes = entry["bytes"].as_u64().filter(|b| (1..=4).contains(b)).ok_or_else(bad)? as usize;
    let size = count.checked_mul(bytes).ok_or_else(bad)?;
    packing::check_room(path, size as u64, file)?;
    let stored =
        zstd::bulk::decompress(data, size).map_err(|e| packing::unpacking(path, name, &e))?;
    if stored.len() != size {
        let what = format!("{name} unpacks to {} bytes of {size}", stored.len());
        return Err(Error::format(path, what));
    }
    let rows = count / columns;
    let number = |at: usize| {
        let place = at % columns * rows + at / columns;
        (0..bytes).fold(0u32, |n, byte| n | u32::from(stored[byte * count + place]) << (8 * byte))
    };
    if entry.get("step").is_none() {
        if bytes != 2 {
            return Err(bad());
        }
        let half = |at| f16::from_bits(number(at) as u16).to_f32();
        return Ok((shape, (0..count).map(half).collect()));
    }
    let of_columns = |key: &str| -> Result<Vec<f64>> {
        let values = entry[key].as_array().filter(|list| list.len() == columns).ok_or_else(bad)?;
        values.iter().map(Value::as_f64).collect::<Option<_>>().ok_or_else(bad)
    };
    let (offsets, steps) = (of_columns("offset")?, of_columns("step")?);
    let value = |at: usize| {
        let c = at % columns;
        (offsets[c] + steps[c] * f64::from(number(at))) as f32
    };
    Ok((shape, (0..count).map(value).collect()))
}
