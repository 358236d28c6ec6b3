//! The native scene file, in the safetensors container.
//!
//! Tensors for N Gaussians, K spherical-harmonic coefficients, C control points and F cameras; f32
//! unless stated otherwise:
//!
//! | name | shape | what |
//! |---|---|---|
//! | `gaussians.position` | N, 3 | centres in the canonical frame |
//! | `gaussians.log_scale` | N, 3 | logarithms of the standard deviations |
//! | `gaussians.rotation` | N, 4 | `world_from_gaussian`, (w, x, y, z), any length |
//! | `gaussians.opacity_logit` | N | |
//! | `gaussians.sh` | N, K, 3 | lowest band first |
//! | `gaussians.motion_logit` | N | above 0: dynamic; absent in a static scene |
//! | `control_points.position` | C, 3 | absent where there are none, as the next |
//! | `control_points.log_radius` | C | |
//! | `control_points.path` | T, C, 8 | motions at T even times over [0, 1]: translation, value added to opacity logits (0, or −20 while the point is absent), rotation offset (w, x, y, z) from (1, 0, 0, 0); absent where the network alone moves them |
//! | `network.<i>.weight` | outputs, inputs | layer i of the deformation network ([`NetShape`]); absent in a static scene |
//! | `network.<i>.bias` | outputs | |
//! | `cameras.time` | F | f64, in [0, 1]; absent where no camera is known, as the next |
//! | `cameras.intrinsics` | F, 6 | f64: fx, fy, cx, cy, width, height in pixels |
//! | `cameras.view_from_world` | F, 7 | f64: qw, qx, qy, qz, tx, ty, tz; OpenCV's axes |
//!
//! Metadata (texts, as safetensors has them): `format` = `splat4d`; `version`; `generator`; and as JSON
//! `settings` (the fields of [`RenderSettings`]), `neighbours`, `background`, `up`, `network` (the
//! fields of [`NetShape`]) and `report`.
//!
//! A change that existing readers would misread increases `version`; additions that readers may
//! ignore (a new tensor, a new key) do not.

use std::collections::HashMap;
use std::io::Write;
use std::path::Path;

use glam::{DQuat, DVec3};
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use serde_json::{Map, Value, json};

use super::{Opened, Scene, SceneCamera, TWICE_MOVED, compact, packing, without_bad};
use crate::error::excerpt;
use crate::io;
use crate::types::{
    Camera, ControlPoints, DeformNet, Gaussians, Intrinsics, NetShape, Pose, RenderSettings, range,
    sh_coefficients,
};
use crate::{Error, Result};

/// Maximum magnitude of the exponent of a network's lowest frequency, a power of 2.
const MOST_OCTAVES: u32 = 100;

/// The version of the plain form that this crate writes. It reads versions up to that of the
/// compact form ([`mod@super::compact`]), 3.
pub const VERSION: u32 = 2;

/// The newest version that is read.
const NEWEST: u32 = compact::VERSION;

/// Maximum number of control points that a Gaussian follows; a static scene has 0.
const MOST_NEIGHBOURS: u32 = 16;

/// The values of a tensor to write.
pub(super) enum Values<'a> {
    F32(&'a [f32]),
    F64(Vec<f64>),
    Bytes(Vec<u8>),
}

pub(super) struct Tensor<'a> {
    pub name: String,
    pub shape: Vec<usize>,
    pub values: Values<'a>,
}

impl Tensor<'_> {
    fn bytes(&self) -> usize {
        match &self.values {
            Values::F32(values) => 4 * values.len(),
            Values::F64(values) => 8 * values.len(),
            Values::Bytes(values) => values.len(),
        }
    }
}

/// Writes a scene, atomically by rename. The output is deterministic.
///
/// # Errors
/// [`Error::Shape`] if the lengths of the scene's arrays are inconsistent; or the file cannot be
/// written.
pub fn write(path: &Path, scene: &Scene) -> Result<()> {
    let tensors = tensors(scene)?;
    io::write_atomically(path, |sink| put(metadata(scene), &tensors, sink))
}

/// Writes metadata and tensors.
pub(super) fn put(
    metadata: Value,
    tensors: &[Tensor<'_>],
    sink: &mut dyn Write,
) -> std::io::Result<()> {
    let mut header = Map::new();
    header.insert("__metadata__".into(), metadata);
    let mut at = 0;
    for tensor in tensors {
        let end = at + tensor.bytes();
        let dtype = match tensor.values {
            Values::F32(_) => "F32",
            Values::F64(_) => "F64",
            Values::Bytes(_) => "U8",
        };
        header.insert(
            tensor.name.clone(),
            json!({ "dtype": dtype, "shape": tensor.shape, "data_offsets": [at, end] }),
        );
        at = end;
    }
    let mut header = Value::Object(header).to_string().into_bytes();
    // Readers that map the file expect the tensors to begin at a multiple of 8.
    header.resize(header.len().next_multiple_of(8), b' ');
    sink.write_all(&(header.len() as u64).to_le_bytes())?;
    sink.write_all(&header)?;
    for tensor in tensors {
        match &tensor.values {
            Values::F32(v) => v.iter().try_for_each(|v| sink.write_all(&v.to_le_bytes()))?,
            Values::F64(v) => v.iter().try_for_each(|v| sink.write_all(&v.to_le_bytes()))?,
            Values::Bytes(v) => sink.write_all(v)?,
        }
    }
    Ok(())
}

pub(super) fn metadata(scene: &Scene) -> Value {
    let RenderSettings { near, dilation, alpha_cut, alpha_cap, transmittance_stop, tangent_clamp } =
        scene.settings;
    let settings = json!({
        "near": near,
        "dilation": dilation,
        "alpha_cut": alpha_cut,
        "alpha_cap": alpha_cap,
        "transmittance_stop": transmittance_stop,
        "tangent_clamp": tangent_clamp,
    });
    let mut metadata = json!({
        "format": "splat4d",
        "version": VERSION.to_string(),
        "generator": concat!("splat4d ", env!("CARGO_PKG_VERSION")),
        "settings": settings.to_string(),
        "neighbours": scene.neighbours.to_string(),
        "background": json!(scene.background).to_string(),
        "up": json!(scene.up).to_string(),
        "report": scene.report.to_string(),
    });
    if let Some(DeformNet { shape, .. }) = &scene.network {
        let shape = json!({
            "depth": shape.depth,
            "width": shape.width,
            "skip": shape.skip,
            "position_frequencies": shape.position_frequencies,
            "time_frequencies": shape.time_frequencies,
            "position_octave": shape.position_octave,
        });
        metadata["network"] = json!(shape.to_string());
    }
    metadata
}

/// Checks that the arrays of the Gaussians have consistent lengths.
pub(super) fn check_lengths(g: &Gaussians) -> Result<()> {
    let n = g.len();
    let rows = [
        ("log_scales", g.log_scales.len(), n),
        ("rotations", g.rotations.len(), n),
        ("opacity_logits", g.opacity_logits.len(), n),
        ("sh", g.sh.len(), n * sh_coefficients(g.sh_degree)),
        ("motion_logits", g.motion_logits.len(), if g.motion_logits.is_empty() { 0 } else { n }),
    ];
    for (arg, actual, expected) in rows {
        check_length(arg, actual, expected)?;
    }
    Ok(())
}

fn check_length(arg: &'static str, actual: usize, expected: usize) -> Result<()> {
    match actual == expected {
        true => Ok(()),
        false => Err(Error::Shape { op: "scene", arg, expected: expected.to_string(), actual }),
    }
}

pub(super) fn tensors(scene: &Scene) -> Result<Vec<Tensor<'_>>> {
    let (g, c) = (&scene.gaussians, &scene.control_points);
    check_lengths(g)?;
    check_length("control_points.log_radii", c.log_radii.len(), c.len())?;
    check_length("control_points.paths", c.paths.len(), c.keys() * c.len())?;
    let mut tensors = Vec::new();
    // The f64 tensors come first, so that every tensor is aligned to its element type.
    let cameras = &scene.cameras;
    if !cameras.is_empty() {
        let mut put = |name: &str, shape: Vec<usize>, values: Vec<f64>| {
            tensors.push(Tensor { name: name.into(), shape, values: Values::F64(values) })
        };
        let f = cameras.len();
        put("cameras.time", vec![f], cameras.iter().map(|c| c.time).collect());
        let inner = |c: &SceneCamera| {
            let k = &c.camera.intrinsics;
            [k.fx, k.fy, k.cx, k.cy, f64::from(k.width), f64::from(k.height)]
        };
        put("cameras.intrinsics", vec![f, 6], cameras.iter().flat_map(inner).collect());
        let outer = |c: &SceneCamera| {
            let (q, t) = (c.camera.view_from_world.rotation, c.camera.view_from_world.translation);
            [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
        };
        put("cameras.view_from_world", vec![f, 7], cameras.iter().flat_map(outer).collect());
    }
    let n = g.len();
    let mut put = |name: String, shape: Vec<usize>, values| {
        tensors.push(Tensor { name, shape, values: Values::F32(values) })
    };
    put("gaussians.position".into(), vec![n, 3], g.positions.as_flattened());
    put("gaussians.log_scale".into(), vec![n, 3], g.log_scales.as_flattened());
    put("gaussians.rotation".into(), vec![n, 4], g.rotations.as_flattened());
    put("gaussians.opacity_logit".into(), vec![n], &g.opacity_logits);
    let k = sh_coefficients(g.sh_degree);
    put("gaussians.sh".into(), vec![n, k, 3], g.sh.as_flattened());
    if !g.motion_logits.is_empty() {
        put("gaussians.motion_logit".into(), vec![n], &g.motion_logits);
    }
    if !c.is_empty() {
        put("control_points.position".into(), vec![c.len(), 3], c.positions.as_flattened());
        put("control_points.log_radius".into(), vec![c.len()], &c.log_radii);
        if !c.paths.is_empty() {
            let shape = vec![c.keys(), c.len(), 8];
            put("control_points.path".into(), shape, c.paths.as_flattened());
        }
    }
    if let Some(net) = &scene.network {
        check_length("network.parameters", net.parameters.len(), net.shape.parameters())?;
        let mut at = 0;
        for (i, (inputs, outputs)) in net.shape.layers().into_iter().enumerate() {
            let (weights, rest) = net.parameters[at..].split_at(inputs * outputs);
            put(format!("network.{i}.weight"), vec![outputs, inputs], weights);
            put(format!("network.{i}.bias"), vec![outputs], &rest[..outputs]);
            at += (inputs + 1) * outputs;
        }
    }
    Ok(tensors)
}

/// Parses the bytes of a scene file; `path` is used in error messages.
///
/// # Errors
/// The file is truncated or damaged, has a newer version, lacks a tensor, or holds values that are
/// not finite. With `drop_bad`, Gaussians with such values are left out instead.
pub fn parse(path: &Path, bytes: &[u8], drop_bad: bool) -> Result<Opened> {
    check_header(path, bytes)?;
    let bad = |what: String| Error::format(path, what);
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| damaged(path, bytes, &e))?;
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| damaged(path, bytes, &e))?;
    let metadata = header.metadata().clone().unwrap_or_default();
    let mut file = File { path, metadata, tensors, packed: Value::Null, size: bytes.len() };
    if file.metadata.contains_key("packed") {
        file.packed = file.json("packed")?;
    }

    let position = file.f32("gaussians.position")?;
    let n = position.rows(3)?;
    let sh = file.f32("gaussians.sh")?;
    let k = sh.shape.get(1).copied().unwrap_or(0);
    let sh_degree = (0..=3).find(|&d| sh_coefficients(d) == k).ok_or_else(|| {
        bad(format!("gaussians.sh has {k} coefficients; 1, 4, 9 or 16 are valid"))
    })?;
    let motion_logits = match file.has("gaussians.motion_logit") {
        true => file.f32("gaussians.motion_logit")?.exactly(&[n])?,
        false => Vec::new(),
    };
    let mut gaussians = Gaussians {
        positions: arrays(&position.exactly(&[n, 3])?),
        log_scales: arrays(&file.f32("gaussians.log_scale")?.exactly(&[n, 3])?),
        rotations: arrays(&file.f32("gaussians.rotation")?.exactly(&[n, 4])?),
        opacity_logits: file.opacity_logits(n)?,
        sh_degree,
        sh: arrays(&sh.exactly(&[n, k, 3])?),
        motion_logits,
    };
    let dropped = without_bad(path, &mut gaussians, drop_bad)?;
    let neighbours = file.json("neighbours")?.as_u64().and_then(|n| u32::try_from(n).ok());
    let neighbours = neighbours.filter(|n| *n <= MOST_NEIGHBOURS);
    let (control_points, network) = (file.control_points()?, file.network()?);
    if network.is_some() && !control_points.paths.is_empty() {
        return Err(bad(TWICE_MOVED.into()));
    }
    let scene = Scene {
        gaussians,
        control_points,
        network,
        settings: file.settings()?,
        neighbours: neighbours.ok_or_else(|| {
            bad(format!("metadata `neighbours` is no number up to {MOST_NEIGHBOURS}"))
        })?,
        cameras: file.cameras()?,
        background: file.three("background", [0.0; 3], range::colour)?,
        up: file.three("up", [0.0, -1.0, 0.0], |up| range::unit(up.map(f64::from).into()))?,
        report: match file.metadata.contains_key("report") {
            true => file.json("report")?,
            false => Value::Null,
        },
    };
    Ok(Opened { scene, dropped })
}

/// Checks format and version, before anything that a newer version may have changed.
fn check_header(path: &Path, bytes: &[u8]) -> Result<()> {
    let bad = |what: String| Error::format(path, what);
    let unknown = || bad("is neither a splat4d scene (safetensors) nor a PLY file, nor SPZ".into());
    let length = match bytes.first_chunk::<8>() {
        Some(length) => u64::from_le_bytes(*length),
        None => return Err(bad(format!("is cut off: {} bytes are no scene", bytes.len()))),
    };
    let body = &bytes[8..];
    if body.first().is_some_and(|&b| b != b'{') {
        return Err(unknown());
    }
    let header = usize::try_from(length).ok().and_then(|length| body.get(..length));
    let header = header.ok_or_else(|| {
        bad(format!("is cut off: its header has {length} bytes, {} follow", body.len()))
    })?;
    let header: Value = serde_json::from_slice(header).map_err(|e| {
        bad(format!("is damaged: its header is not JSON ({})", excerpt(&e.to_string())))
    })?;
    let metadata = &header["__metadata__"];
    if metadata["format"] != "splat4d" {
        return Err(bad("is a safetensors file, but not a splat4d scene".into()));
    }
    let version = metadata["version"].as_str().and_then(|v| v.parse::<u32>().ok());
    match version {
        None | Some(0) => Err(bad("is damaged: its header has no version".into())),
        Some(version) if version > NEWEST => Err(bad(format!(
            "was written by a newer splat4d (format version {version}); this one reads up to \
             version {NEWEST}. Update splat4d"
        ))),
        Some(_) => Ok(()),
    }
}

fn damaged(path: &Path, bytes: &[u8], error: &SafeTensorError) -> Error {
    let what = match error {
        SafeTensorError::MetadataIncompleteBuffer => {
            let size = bytes.len();
            format!("is cut off: it has {size} bytes, and its header announces another size")
        }
        other => format!("is damaged: its header: {}", excerpt(&other.to_string())),
    };
    Error::format(path, what)
}

/// An opened file.
struct File<'a> {
    path: &'a Path,
    metadata: HashMap<String, String>,
    tensors: SafeTensors<'a>,
    /// The `packed` entry of the metadata, in the compact form.
    packed: Value,
    /// Size of the file, bytes.
    size: usize,
}

/// A tensor that was read.
struct Read<'a, T> {
    path: &'a Path,
    name: &'a str,
    shape: Vec<usize>,
    values: Vec<T>,
}

impl<T> Read<'_, T> {
    /// The number of rows, for a tensor with this number of columns.
    fn rows(&self, columns: usize) -> Result<usize> {
        match self.shape[..] {
            [rows, found] if found == columns => Ok(rows),
            _ => Err(self.unlike(&format!("[rows, {columns}]"))),
        }
    }

    /// The values, if the tensor has this shape.
    fn exactly(self, shape: &[usize]) -> Result<Vec<T>> {
        match self.shape == shape {
            true => Ok(self.values),
            false => Err(self.unlike(&format!("{shape:?}"))),
        }
    }

    fn unlike(&self, expected: &str) -> Error {
        let what = format!("{} has the shape {:?}, expected {expected}", self.name, self.shape);
        Error::format(self.path, what)
    }
}

fn arrays<const N: usize>(values: &[f32]) -> Vec<[f32; N]> {
    values.as_chunks::<N>().0.to_vec()
}

impl<'a> File<'a> {
    fn has(&self, name: &str) -> bool {
        self.tensors.tensor(name).is_ok()
    }

    fn tensor(&self, name: &str, dtype: Dtype) -> Result<(Vec<usize>, &'a [u8])> {
        let bad = |what: String| Error::format(self.path, what);
        let tensor =
            self.tensors.tensor(name).map_err(|_| bad(format!("lacks the tensor {name}")))?;
        match tensor.dtype() == dtype {
            true => Ok((tensor.shape().to_vec(), tensor.data())),
            false => Err(bad(format!("{name} is {:?}, expected {dtype:?}", tensor.dtype()))),
        }
    }

    fn f32<'b>(&'b self, name: &'b str) -> Result<Read<'b, f32>> {
        if let Some(entry) = self.packed.get(name) {
            let (_, data) = self.tensor(name, Dtype::U8)?;
            let (shape, values) = compact::unpacked(self.path, name, entry, data, self.size)?;
            return Ok(Read { path: self.path, name, shape, values });
        }
        let (shape, data) = self.tensor(name, Dtype::F32)?;
        let values = data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        Ok(Read { path: self.path, name, shape, values })
    }

    /// Reads the opacity logits; the compact form stores opacities instead.
    fn opacity_logits(&self, n: usize) -> Result<Vec<f32>> {
        if !self.has("gaussians.opacity") {
            return self.f32("gaussians.opacity_logit")?.exactly(&[n]);
        }
        let opacities = self.f32("gaussians.opacity")?.exactly(&[n])?;
        Ok(opacities.into_iter().map(packing::logit_of).collect())
    }

    /// Reads a tensor whose values must all be finite.
    fn finite_f32<'b>(&'b self, name: &'b str) -> Result<Read<'b, f32>> {
        let read = self.f32(name)?;
        self.check_finite(name, read.values.iter().filter(|v| !v.is_finite()).count())?;
        Ok(read)
    }

    fn finite_f64<'b>(&'b self, name: &'b str) -> Result<Read<'b, f64>> {
        let (shape, data) = self.tensor(name, Dtype::F64)?;
        let values: Vec<f64> = data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
        self.check_finite(name, values.iter().filter(|v| !v.is_finite()).count())?;
        Ok(Read { path: self.path, name, shape, values })
    }

    fn check_finite(&self, name: &str, bad: usize) -> Result<()> {
        match bad {
            0 => Ok(()),
            _ => Err(Error::format(
                self.path,
                format!("{name} holds {bad} NaN or infinite values; the scene cannot be used"),
            )),
        }
    }

    /// Parses a metadata entry as JSON.
    fn json(&self, key: &str) -> Result<Value> {
        let bad = |what: String| Error::format(self.path, what);
        let text =
            self.metadata.get(key).ok_or_else(|| bad(format!("its metadata lacks `{key}`")))?;
        serde_json::from_str(text)
            .map_err(|e| bad(format!("metadata `{key}` is not JSON: {}", excerpt(&e.to_string()))))
    }

    /// Reads three numbers of the metadata.
    fn three(
        &self,
        key: &str,
        default: [f32; 3],
        check: fn([f32; 3]) -> range::Check,
    ) -> Result<[f32; 3]> {
        if !self.metadata.contains_key(key) {
            return Ok(default);
        }
        let value = self.json(key)?;
        let bad = |what: String| Error::format(self.path, format!("metadata `{key}`{what}"));
        let mut three = [0.0; 3];
        for (i, slot) in three.iter_mut().enumerate() {
            let number = value.get(i).and_then(Value::as_f64).map(|v| v as f32);
            *slot = number.ok_or_else(|| bad(" is not three numbers".into()))?;
        }
        check(three).map_err(|what| bad(format!(": {what}")))?;
        Ok(three)
    }

    fn settings(&self) -> Result<RenderSettings> {
        let value = self.json("settings")?;
        let field = |key: &str| {
            let number = value.get(key).and_then(Value::as_f64).map(|v| v as f32);
            number.ok_or_else(|| {
                let what = format!("metadata `settings` has no valid `{key}`");
                Error::format(self.path, what)
            })
        };
        let settings = RenderSettings {
            near: field("near")?,
            dilation: field("dilation")?,
            alpha_cut: field("alpha_cut")?,
            alpha_cap: field("alpha_cap")?,
            transmittance_stop: field("transmittance_stop")?,
            tangent_clamp: field("tangent_clamp")?,
        };
        let bad = |what| Error::format(self.path, format!("metadata `settings`: {what}"));
        settings.check().map_err(bad)?;
        Ok(settings)
    }

    fn control_points(&self) -> Result<ControlPoints> {
        if !self.has("control_points.position") {
            return Ok(ControlPoints::default());
        }
        let positions = self.finite_f32("control_points.position")?;
        let c = positions.rows(3)?;
        let log_radii = self.finite_f32("control_points.log_radius")?.exactly(&[c])?;
        let paths = match self.has("control_points.path") {
            true => {
                let paths = self.finite_f32("control_points.path")?;
                let keys = paths.shape.first().copied().unwrap_or(0);
                arrays(&paths.exactly(&[keys, c, 8])?)
            }
            false => Vec::new(),
        };
        let points = ControlPoints { positions: arrays(&positions.values), log_radii, paths };
        points.check().map_err(|what| Error::format(self.path, what))?;
        Ok(points)
    }

    fn network(&self) -> Result<Option<DeformNet>> {
        if !self.metadata.contains_key("network") {
            return Ok(None);
        }
        let value = self.json("network")?;
        // The limits are far beyond practical values; they only keep a damaged number from
        // exhausting the memory.
        let field = |key: &str, most: u64| {
            let number = value.get(key).and_then(Value::as_u64).filter(|&v| v <= most);
            number.map(|v| v as u32).ok_or_else(|| {
                Error::format(self.path, format!("metadata `network` has no valid `{key}`"))
            })
        };
        let shape = NetShape {
            depth: field("depth", 256)?,
            width: field("width", 1 << 14)?,
            skip: field("skip", u64::from(u32::MAX) - 1)?,
            position_frequencies: field("position_frequencies", 64)?,
            time_frequencies: field("time_frequencies", 64)?,
            // Absent in files of versions in which it was fixed.
            position_octave: match value.get("position_octave") {
                None => 0,
                Some(octave) => octave
                    .as_i64()
                    .and_then(|octave| i32::try_from(octave).ok())
                    .filter(|octave| octave.unsigned_abs() <= MOST_OCTAVES)
                    .ok_or_else(|| {
                        let what = "metadata `network` has no valid `position_octave`";
                        Error::format(self.path, what)
                    })?,
            },
        };
        let mut parameters = Vec::new();
        for (i, (inputs, outputs)) in shape.layers().into_iter().enumerate() {
            let name = format!("network.{i}.weight");
            parameters.extend(self.finite_f32(&name)?.exactly(&[outputs, inputs])?);
            let name = format!("network.{i}.bias");
            parameters.extend(self.finite_f32(&name)?.exactly(&[outputs])?);
        }
        let network = DeformNet { shape, parameters };
        network.check().map_err(|what| Error::format(self.path, what))?;
        Ok(Some(network))
    }

    fn cameras(&self) -> Result<Vec<SceneCamera>> {
        if !self.has("cameras.time") {
            return Ok(Vec::new());
        }
        let inner = self.finite_f64("cameras.intrinsics")?;
        let f = inner.rows(6)?;
        let times = self.finite_f64("cameras.time")?.exactly(&[f])?;
        let outer = self.finite_f64("cameras.view_from_world")?.exactly(&[f, 7])?;
        let rows = inner.values.chunks_exact(6).zip(outer.chunks_exact(7));
        rows.zip(times)
            .enumerate()
            .map(|(i, ((k, p), time))| {
                let bad = |what| Error::format(self.path, format!("camera {i}: {what}"));
                let rotation = DQuat::from_xyzw(p[1], p[2], p[3], p[0]);
                range::quaternion(rotation).map_err(bad)?;
                let intrinsics = Intrinsics {
                    fx: k[0],
                    fy: k[1],
                    cx: k[2],
                    cy: k[3],
                    width: k[4] as u32,
                    height: k[5] as u32,
                };
                // Normalising a unit quaternion again would change its last bits.
                let unit = (rotation.length() - 1.0).abs() < 1e-12;
                let rotation = if unit { rotation } else { rotation.normalize() };
                let view_from_world = Pose { rotation, translation: DVec3::new(p[4], p[5], p[6]) };
                let camera = Camera { intrinsics, view_from_world };
                camera.check().and_then(|()| range::time(time)).map_err(bad)?;
                Ok(SceneCamera { time, camera })
            })
            .collect()
    }
}
