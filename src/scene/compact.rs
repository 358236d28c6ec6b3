//! The compact form of the native scene file: the same tensors, most of them quantised.
//!
//! A tensor with an entry in the metadata's `packed` is stored as bytes of a zstd stream. The
//! stream unpacks to numbers of `bytes` bytes each, in the given `shape`, column-major (the first
//! axis runs fastest), as byte planes: first the lowest byte of all numbers, then the next. Without
//! `step` the numbers are 16-bit floats. With it, they are unsigned integers, and number `n` in
//! column `c` stands for `offset[c] + step[c] * n`. Metadata, other tensors and the meaning of the
//! values are those of the plain form ([`mod@super::file`]), with two differences:
//! `gaussians.opacity` holds the opacity in place of its logit, and quaternions are of unit length.
//!
//! | name | step |
//! |---|---|
//! | `gaussians.position` | a fraction of the size of the smaller Gaussians |
//! | `gaussians.log_scale` | 1/32 |
//! | `gaussians.rotation` | 1/127 |
//! | `gaussians.opacity` | 1/255 |
//! | `gaussians.sh` | one level of an 8-bit colour for the constant, 1/64 for the rest |
//! | `gaussians.motion_logit` | −10 (static) or 10 (dynamic) |
//! | `control_points.path` | 16-bit floats, or f32 if these err by more than a quarter of that size |
//! | `network.*` | 16-bit floats |
//!
//! Spherical-harmonic bands that are zero for all Gaussians are left out. The Gaussians are in
//! Morton order.

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
/// Quantisation steps of a position per size of a small Gaussian.
const STEPS: f32 = 64.0;
/// Maximum error of motions, in position steps.
const MOTION_STEPS: f32 = 16.0;
/// Quantisation step of log scales.
const SCALE_STEP: f32 = 1.0 / 32.0;
/// Quantisation step of the components of a unit quaternion.
const ROTATION_STEP: f32 = 1.0 / 127.0;
/// Quantisation step of harmonics above the constant.
const HARMONIC_STEP: f32 = 1.0 / 64.0;
/// Quantisation step of the constant harmonic: one level of an 8-bit colour.
const CONSTANT_STEP: f32 = 1.0 / 255.0 / SH_C0;
/// The motion logits of static and of dynamic Gaussians.
const MOTION: [f32; 2] = [-10.0, 10.0];
/// zstd compression level.
const EFFORT: i32 = 19;

/// Writes a scene in the compact form, atomically by rename. The output is deterministic.
///
/// # Errors
/// [`Error::Shape`] if the lengths of the scene's arrays are inconsistent; or the file cannot be
/// written.
pub fn write(path: impl AsRef<Path>, scene: &Scene) -> Result<()> {
    let bytes = encoded(scene)?;
    io::write_atomically(path, |sink| sink.write_all(&bytes))
}

/// Encodes the file.
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

/// The Gaussians in Morton order, without bands that quantise to zero.
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
    /// Uniform quantisation with one step per column.
    Steps(Vec<f32>),
    /// Opacity logits, stored as opacities.
    Opacity,
    /// Motion logits, reduced to whether they are above 0.
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
        // 16-bit floats are too coarse for large displacements.
        "control_points.path" if half_error(tensor) <= MOTION_STEPS * place_step(g) => Rule::Half,
        name if name.starts_with("network.") => Rule::Half,
        _ => return None,
    })
}

/// The rounding error of the largest value of a tensor as a 16-bit float.
fn half_error(tensor: &Tensor<'_>) -> f32 {
    let Values::F32(values) = &tensor.values else { return 0.0 };
    let translations = values.chunks_exact(8).flat_map(|motion| &motion[..3]);
    translations.fold(0.0f32, |far, v| far.max(v.abs())) / 2048.0
}

/// The quantisation step of positions: a fraction of the 10th percentile of the Gaussians' sizes,
/// but at least the resolution of 32 bits over the scene.
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
        let mut least = vec![f32::INFINITY; columns];
        for row in values.chunks_exact(columns) {
            least.iter_mut().zip(row).for_each(|(least, v)| *least = least.min(*v));
        }
        // Offsets are whole multiples of the step, so that 0 stays 0; opacities and motion start at
        // their own minimum.
        let offset = |(least, step): (f32, &f32)| match self {
            Rule::Opacity => 0.0,
            Rule::Motion => MOTION[0],
            _ if least.is_finite() => (least / step).floor() * step,
            _ => 0.0,
        };
        let offsets = least.into_iter().zip(&*steps).map(offset).map(decimal).collect::<Vec<_>>();
        let steps: Vec<f64> = steps.iter().copied().map(decimal).collect();
        let number = |(at, v): (usize, &f32)| {
            let c = at % columns;
            ((f64::from(*v) - offsets[c]) / steps[c]).round() as u32
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

/// The number whose decimal text is the shortest that gives this number as f32: the metadata is text, and the
/// text of the f32's exact value is twice as long.
fn decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or_else(|_| f64::from(value))
}

/// Stores numbers column-major as byte planes, the lowest byte of all numbers first.
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
