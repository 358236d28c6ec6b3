//! Single operations of the engine as functions. `python/splat4d/ops.py` exports them.

use crate::arrays::{self, Side::Any, Side::Exactly};
use crate::device::Device;
use crate::error::{out_of_range, raised};
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::gpu::{self, Buffer, Stream};
use splat4d::ops::adam::{Adam, AdamArgs};
use splat4d::ops::deform::{Skin, SkinArgs, SkinGradients, Skinned};
use splat4d::ops::loss::{Loss, LossArgs, LossSettings, Reference};
use splat4d::ops::render::Render;
use splat4d::ops::sort::{RadixSort, SortArgs};
use splat4d::types::{AdamSettings, Image, RenderSettings, range};

/// The photometric loss of a rendered image against an image, and its gradient.
///
/// `rgba`, shape (height, width, 4), is premultiplied colour and alpha, as `Rendered.rgba` has them. It is
/// composited over `background` and compared with `image`, (height, width, 3), float32 in [0, 1] or uint8.
/// `weights`, (height, width), in [0, 1], weights the pixels. `image` and `weights` are rounded to 8 bits. The
/// loss is `(1 - ssim_share) · mean |x − y| + ssim_share · mean (1 − SSIM)`; SSIM has Gaussian windows of
/// 11 × 11 pixels with a standard deviation of 1.5.
///
/// Returns the loss, and its gradient with respect to `rgba`: float32 of shape (height, width, 4).
///
/// Raises `ValueError` for wrong shapes, `splat4d.Error` for a number out of range or if the device fails.
#[pyfunction]
#[pyo3(signature = (device, rgba, image, *, weights = None, background = [0.0; 3], ssim_share = 0.2))]
pub fn loss<'py>(
    py: Python<'py>,
    device: &Device,
    rgba: &Bound<'py, PyAny>,
    image: &Bound<'py, PyAny>,
    weights: Option<&Bound<'py, PyAny>>,
    background: [f32; 3],
    ssim_share: f32,
) -> PyResult<(f64, Bound<'py, PyArray3<f32>>)> {
    let sides = [Any("height"), Any("width"), Exactly(4)];
    let (pixels, shape) = arrays::floats("rgba", rgba, &sides)?;
    let size = (side("rgba", shape[1])?, side("rgba", shape[0])?);
    let image = arrays::picture("image", image, size, 3)?;
    let weights =
        weights.map(|weights| arrays::picture("weights", weights, size, 1)).transpose()?;
    range::colour(background).map_err(|what| out_of_range(format!("background: {what}")))?;
    if !(0.0..=1.0).contains(&ssim_share) {
        return Err(out_of_range(format!("ssim_share is {ssim_share:?}: 0.0 to 1.0 expected")));
    }
    let settings = LossSettings { ssim_share, background, ..Default::default() };
    let device = &device.device;
    let (loss, gradient) = py
        .detach(|| compared(device, &settings, pixels.as_chunks().0, &image, weights.as_ref()))
        .map_err(raised)?;
    let shape = [image.height as usize, image.width as usize, 4];
    Ok((loss, arrays::block(py, gradient, shape)?))
}

fn side(name: &str, length: usize) -> PyResult<u32> {
    let what = |_| PyValueError::new_err(format!("{name}: a side of {length} pixels is too long"));
    u32::try_from(length).map_err(what)
}

fn compared(
    device: &gpu::Device,
    settings: &LossSettings,
    rgba: &[[f32; 4]],
    image: &Image,
    weights: Option<&Image>,
) -> splat4d::Result<(f64, Vec<f32>)> {
    let (width, height) = (image.width, image.height);
    let render = Render::plan(device, 0, 0, width, height, RenderSettings::default())?;
    let (mut rendered, mut gradients) = (render.pixels(device)?, render.pixel_gradients(device)?);
    let reference = Reference::new(device, image, weights)?;
    let loss = Loss::plan(device, width, height);
    let mut scratch = loss.scratch(device)?;
    let mut stream = device.stream()?;
    stream.upload(&mut rendered.rgba, rgba)?;
    let mut recorder = stream.record()?;
    let args = LossArgs {
        rendered: &rendered,
        reference: &reference,
        disparity: None,
        gradients: &mut gradients,
    };
    loss.record(&mut recorder, settings, args, &mut scratch)?;
    stream.submit(recorder)?;
    let terms = loss.value(&mut stream, &reference, None, &scratch)?;
    // Weights are bytes on the device. Without any weight there is nothing to compare.
    let weighted =
        weights.is_none_or(|weights| weights.pixels.iter().any(|weight| weight * 255.0 >= 0.5));
    let share = f64::from(settings.ssim_share);
    let value = (1.0 - share) * terms.l1 + share * (1.0 - terms.ssim);
    let gradient = stream.download(&gradients.rgba)?.into_flattened();
    Ok((if weighted { value } else { 0.0 }, gradient))
}

/// Skinning on a device, and its inputs.
struct Posed {
    device: gpu::Device,
    stream: Stream,
    skin: Skin,
    inputs: Inputs,
}

/// The inputs of skinning, on the device.
struct Inputs {
    gaussian_from_dynamic: Buffer<u32>,
    positions: Buffer<f32>,
    rotations: Buffer<[f32; 4]>,
    opacity_logits: Buffer<f32>,
    nodes: Buffer<f32>,
    log_radii: Buffer<f32>,
    transforms: Buffer<[f32; 4]>,
}

/// The inputs of skinning, on the host.
struct Pose {
    positions: Vec<f32>,
    rotations: Vec<[f32; 4]>,
    opacity_logits: Vec<f32>,
    nodes: Vec<f32>,
    log_radii: Vec<f32>,
    transforms: Vec<[f32; 4]>,
    neighbours: usize,
}

impl Pose {
    fn of(
        positions: &Bound<'_, PyAny>,
        rotations: &Bound<'_, PyAny>,
        opacity_logits: &Bound<'_, PyAny>,
        control_positions: &Bound<'_, PyAny>,
        control_log_radii: &Bound<'_, PyAny>,
        motions: &Bound<'_, PyAny>,
        neighbours: usize,
    ) -> PyResult<Pose> {
        let positions: Vec<[f32; 3]> = arrays::rows("positions", positions)?;
        let nodes: Vec<[f32; 3]> = arrays::rows("control_positions", control_positions)?;
        let (n, m) = (Exactly(positions.len()), Exactly(nodes.len()));
        let motions = arrays::floats("motions", motions, &[m, Exactly(8)])?.0;
        Ok(Pose {
            rotations: arrays::in_rows(
                &arrays::floats("rotations", rotations, &[n, Exactly(4)])?.0,
            ),
            opacity_logits: arrays::floats("opacity_logits", opacity_logits, &[n])?.0,
            log_radii: arrays::floats("control_log_radii", control_log_radii, &[m])?.0,
            transforms: motions.as_chunks().0.iter().copied().flat_map(transform).collect(),
            positions: positions.into_flattened(),
            nodes: nodes.into_flattened(),
            neighbours,
        })
    }

    fn upload(self, device: &gpu::Device) -> splat4d::Result<Posed> {
        let (n, m) = (self.rotations.len(), self.log_radii.len());
        let all: Vec<u32> = (0..n as u32).collect();
        let mut skin = Skin::new(device, self.neighbours, n, m)?;
        let mut stream = device.stream()?;
        let inputs = Inputs {
            gaussian_from_dynamic: device.upload("all Gaussians", &all)?,
            positions: device.upload("positions", &self.positions)?,
            rotations: device.upload("rotations", &self.rotations)?,
            opacity_logits: device.upload("opacity logits", &self.opacity_logits)?,
            nodes: device.upload("control points", &self.nodes)?,
            log_radii: device.upload("log radii", &self.log_radii)?,
            transforms: device.upload("motions", &self.transforms)?,
        };
        let mut recorder = stream.record()?;
        skin.refresh(
            &mut recorder,
            inputs.gaussian_from_dynamic.view(),
            inputs.positions.view(),
            inputs.nodes.view(),
        )?;
        stream.submit(recorder)?;
        Ok(Posed { device: device.clone(), stream, skin, inputs })
    }
}

/// A row of `control_paths` as the device has it: there the quaternion is whole.
fn transform([x, y, z, opacity, w, i, j, k]: [f32; 8]) -> [[f32; 4]; 2] {
    [[x, y, z, opacity], [1.0 + w, i, j, k]]
}

/// Centres, quaternions and opacity logits, in rows.
type Moved = (Vec<f32>, Vec<f32>, Vec<f32>);
/// Gradients with respect to centres, quaternions, radii and motions.
type MovedGradients = (Vec<f32>, Vec<f32>, Vec<f32>, Vec<f32>);

impl Inputs {
    fn args(&self) -> SkinArgs<'_> {
        SkinArgs {
            gaussian_from_dynamic: self.gaussian_from_dynamic.view(),
            positions: self.positions.view(),
            rotations: self.rotations.view(),
            opacity_logits: self.opacity_logits.view(),
            nodes: self.nodes.view(),
            log_radii: self.log_radii.view(),
            transforms: self.transforms.view(),
            time: 0,
            soft: None,
        }
    }
}

impl Posed {
    fn forward(mut self) -> splat4d::Result<Moved> {
        let n = self.inputs.rotations.len();
        let mut positions = self.device.buffer("moved positions", 3 * n)?;
        let mut rotations = self.device.buffer::<[f32; 4]>("moved rotations", n)?;
        let mut opacity_logits = self.device.buffer("moved opacities", n)?;
        let mut rigidity = self.device.buffer("rigidity", n)?;
        let mut recorder = self.stream.record()?;
        let out = Skinned {
            positions: positions.view_mut(),
            rotations: rotations.view_mut(),
            opacity_logits: opacity_logits.view_mut(),
            rigidity: rigidity.view_mut(),
        };
        self.skin.forward(&mut recorder, self.inputs.args(), out)?;
        self.stream.submit(recorder)?;
        let stream = &mut self.stream;
        let rotations = stream.download(&rotations)?.into_flattened();
        Ok((stream.download(&positions)?, rotations, stream.download(&opacity_logits)?))
    }

    fn backward(
        mut self,
        by_positions: &[f32],
        by_rotations: &[[f32; 4]],
    ) -> splat4d::Result<MovedGradients> {
        let device = &self.device;
        let mut by_positions = device.upload("position gradients", by_positions)?;
        let mut by_rotations = device.upload("rotation gradients", by_rotations)?;
        let mut by_motion_logits = device.buffer("motion gradients", 0)?;
        let mut by_transforms =
            device.buffer::<[f32; 4]>("transform gradients", self.inputs.transforms.len())?;
        let mut by_log_radii = device.buffer("radius gradients", self.inputs.log_radii.len())?;
        let mut recorder = self.stream.record()?;
        let gradients = SkinGradients {
            positions: by_positions.view_mut(),
            rotations: by_rotations.view_mut(),
            motion_logits: by_motion_logits.view_mut(),
            transforms: by_transforms.view_mut(),
            log_radii: by_log_radii.view_mut(),
            accumulate: false,
            rigid_scale: 0.0,
        };
        self.skin.backward(&mut recorder, self.inputs.args(), gradients)?;
        self.stream.submit(recorder)?;
        let stream = &mut self.stream;
        Ok((
            stream.download(&by_positions)?,
            stream.download(&by_rotations)?.into_flattened(),
            stream.download(&by_log_radii)?,
            stream.download(&by_transforms)?.into_flattened(),
        ))
    }
}

/// Centres, quaternions and opacity logits at a time.
type Deformed<'py> =
    (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>, Bound<'py, PyArray1<f32>>);

/// Moves Gaussians with their nearest control points (linear blend skinning).
///
/// `positions` (N, 3), `rotations` (N, 4) and `opacity_logits` (N,) are those of `Scene`, in the canonical frame;
/// `control_positions` (M, 3) and `control_log_radii` (M,) too. `motions`, shape (M, 8), are the control points'
/// motions at one time, in the layout of a time of `control_paths`: translation, opacity offset, and the
/// quaternion's offset from (1, 0, 0, 0). Each Gaussian follows its `neighbours` nearest control points, 1 to 8.
///
/// Returns the centres, quaternions and opacity logits at that time, float32 in the shapes of the inputs.
///
/// Raises `ValueError` for wrong shapes, `splat4d.Error` for a number out of range or if the device fails.
#[pyfunction]
#[pyo3(signature = (device, positions, rotations, opacity_logits, control_positions, control_log_radii,
    motions, *, neighbours = 4))]
pub fn deform<'py>(
    py: Python<'py>,
    device: &Device,
    positions: &Bound<'py, PyAny>,
    rotations: &Bound<'py, PyAny>,
    opacity_logits: &Bound<'py, PyAny>,
    control_positions: &Bound<'py, PyAny>,
    control_log_radii: &Bound<'py, PyAny>,
    motions: &Bound<'py, PyAny>,
    neighbours: usize,
) -> PyResult<Deformed<'py>> {
    let pose = Pose::of(
        positions,
        rotations,
        opacity_logits,
        control_positions,
        control_log_radii,
        motions,
        neighbours,
    )?;
    let device = &device.device;
    let moved = py.detach(|| pose.upload(device)?.forward()).map_err(raised)?;
    let (positions, rotations, opacity_logits) = moved;
    Ok((
        arrays::table(py, arrays::in_rows::<3>(&positions))?,
        arrays::table(py, arrays::in_rows::<4>(&rotations))?,
        arrays::line(py, opacity_logits),
    ))
}

/// The backward pass of `deform`, for the same inputs.
///
/// `grad_positions` (N, 3) and `grad_rotations` (N, 4) are the gradients of a loss with respect to the centres and
/// quaternions that `deform` returns. Returns, by name, the gradients with respect to `positions`, `rotations`,
/// `control_log_radii` and `motions`, in their shapes. As in training, the choice of the nearest control points
/// and their weights count as constant where a centre moves: the gradient with respect to `positions` is exact for
/// one neighbour. The opacity offset gets none, and the gradient with respect to `opacity_logits` is that with
/// respect to the moved ones.
///
/// Raises as `deform` does.
#[pyfunction]
#[pyo3(signature = (device, grad_positions, grad_rotations, positions, rotations, opacity_logits,
    control_positions, control_log_radii, motions, *, neighbours = 4))]
pub fn deform_backward<'py>(
    py: Python<'py>,
    device: &Device,
    grad_positions: &Bound<'py, PyAny>,
    grad_rotations: &Bound<'py, PyAny>,
    positions: &Bound<'py, PyAny>,
    rotations: &Bound<'py, PyAny>,
    opacity_logits: &Bound<'py, PyAny>,
    control_positions: &Bound<'py, PyAny>,
    control_log_radii: &Bound<'py, PyAny>,
    motions: &Bound<'py, PyAny>,
    neighbours: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let pose = Pose::of(
        positions,
        rotations,
        opacity_logits,
        control_positions,
        control_log_radii,
        motions,
        neighbours,
    )?;
    let n = Exactly(pose.rotations.len());
    let by_positions = arrays::floats("grad_positions", grad_positions, &[n, Exactly(3)])?.0;
    let by_rotations = arrays::floats("grad_rotations", grad_rotations, &[n, Exactly(4)])?.0;
    let device = &device.device;
    let found = py
        .detach(|| pose.upload(device)?.backward(&by_positions, by_rotations.as_chunks().0))
        .map_err(raised)?;
    let (positions, rotations, log_radii, motions) = found;
    let dict = PyDict::new(py);
    dict.set_item("positions", arrays::table(py, arrays::in_rows::<3>(&positions))?)?;
    dict.set_item("rotations", arrays::table(py, arrays::in_rows::<4>(&rotations))?)?;
    dict.set_item("control_log_radii", arrays::line(py, log_radii))?;
    dict.set_item("motions", arrays::table(py, arrays::in_rows::<8>(&motions))?)?;
    Ok(dict)
}

/// Parameters and moments after a step.
type Stepped<'py> =
    (Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyArrayDyn<f32>>);

/// One step of Adam with bias correction.
///
/// `parameters`, `gradients`, and the moments `first` and `second`, which are 0 before the first step, have one
/// shape. `step` counts from 1. A gradient that is not finite leaves its parameter and moments as they are.
///
/// Returns the new parameters and moments: three float32 arrays of that shape.
///
/// Raises `ValueError` for wrong shapes, `splat4d.Error` for step 0 or if the device fails.
#[pyfunction]
#[pyo3(signature = (device, parameters, gradients, first, second, *, step, rate = 1e-3, beta1 = 0.9,
    beta2 = 0.999, epsilon = 1e-15))]
pub fn adam<'py>(
    py: Python<'py>,
    device: &Device,
    parameters: &Bound<'py, PyAny>,
    gradients: &Bound<'py, PyAny>,
    first: &Bound<'py, PyAny>,
    second: &Bound<'py, PyAny>,
    step: u32,
    rate: f64,
    beta1: f64,
    beta2: f64,
    epsilon: f64,
) -> PyResult<Stepped<'py>> {
    let shape = arrays::shape(parameters)?;
    let sides: Vec<_> = shape.iter().copied().map(Exactly).collect();
    let floats = |name, value| Ok::<_, PyErr>(arrays::floats(name, value, &sides)?.0);
    let host =
        [floats("parameters", parameters)?, floats("first", first)?, floats("second", second)?];
    let gradients = floats("gradients", gradients)?;
    let settings = AdamSettings { rate, beta1, beta2, epsilon, step };
    let device = &device.device;
    let [parameters, first, second] =
        py.detach(|| stepped(device, &settings, &gradients, &host)).map_err(raised)?;
    let shaped = |numbers: Vec<f32>| arrays::line(py, numbers).reshape(&shape[..]);
    Ok((shaped(parameters)?, shaped(first)?, shaped(second)?))
}

fn stepped(
    device: &gpu::Device,
    settings: &AdamSettings,
    gradients: &[f32],
    [parameters, first, second]: &[Vec<f32>; 3],
) -> splat4d::Result<[Vec<f32>; 3]> {
    let gradients = device.upload("gradients", gradients)?;
    let mut parameters = device.upload("parameters", parameters)?;
    let mut first = device.upload("first moments", first)?;
    let mut second = device.upload("second moments", second)?;
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    let args = AdamArgs {
        gradients: gradients.view(),
        parameters: parameters.view_mut(),
        first: first.view_mut(),
        second: second.view_mut(),
        visible: None,
    };
    Adam::new(device)?.record(&mut recorder, settings, args)?;
    stream.submit(recorder)?;
    Ok([stream.download(&parameters)?, stream.download(&first)?, stream.download(&second)?])
}

/// Keys and payload.
type Sorted<'py> = (Bound<'py, PyArray1<u32>>, Bound<'py, PyArray1<u32>>);

/// A stable sort of keys and their payload, ascending.
///
/// `keys` and `payload`, both (N,), are integers in [0, 2³²); without `payload` it is 0, 1, … N − 1, so that the
/// sorted payload is the order. Only the bits `bits[0]` to `bits[1] - 1` of the keys count, from the lowest, and
/// pairs whose bits are equal keep their order.
///
/// Returns the sorted keys and the sorted payload, uint32.
///
/// Raises `ValueError` for wrong shapes and for what is not such an integer, `splat4d.Error` for bits out of range
/// or if the device fails.
#[pyfunction]
#[pyo3(signature = (device, keys, payload = None, *, bits = (0, 32)))]
pub fn sort<'py>(
    py: Python<'py>,
    device: &Device,
    keys: &Bound<'py, PyAny>,
    payload: Option<&Bound<'py, PyAny>>,
    bits: (u32, u32),
) -> PyResult<Sorted<'py>> {
    let keys = arrays::words("keys", keys, Any("N"))?;
    let payload = match payload {
        Some(payload) => arrays::words("payload", payload, Exactly(keys.len()))?,
        None => (0..keys.len() as u32).collect(),
    };
    let device = &device.device;
    let (keys, payload) = py.detach(|| sorted(device, &keys, &payload, bits)).map_err(raised)?;
    Ok((arrays::line(py, keys), arrays::line(py, payload)))
}

fn sorted(
    device: &gpu::Device,
    keys: &[u32],
    payload: &[u32],
    (low, high): (u32, u32),
) -> splat4d::Result<(Vec<u32>, Vec<u32>)> {
    let sort = RadixSort::plan(device, keys.len(), low..high)?;
    let mut scratch = sort.scratch(device)?;
    let count = device.upload("count", &[keys.len() as u32])?;
    let mut sorted_keys = device.buffer("sorted keys", keys.len())?;
    let mut sorted_payload = device.buffer("sorted payload", keys.len())?;
    let (keys, payload) = (device.upload("keys", keys)?, device.upload("payload", payload)?);
    let mut stream = device.stream()?;
    let mut recorder = stream.record()?;
    let args = SortArgs {
        count: count.view(),
        count_at: 0,
        keys: keys.view(),
        payload: payload.view(),
        sorted_keys: sorted_keys.view_mut(),
        sorted_payload: sorted_payload.view_mut(),
    };
    sort.record(&mut recorder, args, &mut scratch)?;
    stream.submit(recorder)?;
    Ok((stream.download(&sorted_keys)?, stream.download(&sorted_payload)?))
}
