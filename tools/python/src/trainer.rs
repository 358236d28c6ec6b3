//! The classes of training: `View`, `Progress` and `Trainer`.

use crate::arrays;
use crate::camera::Camera;
use crate::deferred::{self, Array, Deferred, GradientSource, Shapes, Unread};
use crate::device::Device;
use crate::error::raised;
use crate::renderer::Rendered;
use crate::scene::Scene;
use crate::settings;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::gpu::{Buffer, Readback, Stream, Ticket};
use splat4d::train::own_loss::{Differentiated, OwnGradients, Pass, Rendered as Seen, Updated};
use splat4d::train::{self, MotionStart, SceneOptimiser, TrainSettings, TrainingView};
use splat4d::types::{Image, sh_coefficients};
use splat4d::{gpu, scene, types};
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::{Duration, Instant};

/// Longest run of steps between two checks for Ctrl-C and two progress callbacks.
const ATTENTION: Duration = Duration::from_millis(50);

/// A training view: a posed image to train on.
///
/// `image` has shape (height, width, 3), with the camera's height and width: red, green and blue, float32
/// in [0, 1] or uint8. `time` is in [0, 1]. `weights`, shape (height, width), are the weights of the pixels
/// in the loss, in [0, 1]; `mask`, of the same shape, is 1 where something moves, else 0.
///
/// Raises `ValueError` for wrong shapes.
#[pyclass(frozen, module = "splat4d", from_py_object)]
#[derive(Clone)]
pub struct View {
    view: Arc<TrainingView>,
}

#[pymethods]
impl View {
    #[new]
    #[pyo3(signature = (image, camera, time = 0.0, *, weights = None, mask = None))]
    fn new(
        image: &Bound<'_, PyAny>,
        camera: &Camera,
        time: f64,
        weights: Option<&Bound<'_, PyAny>>,
        mask: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<View> {
        let camera = camera.camera;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let map = |name, value: Option<&Bound<'_, PyAny>>| {
            value.map(|value| arrays::picture(name, value, size, 1)).transpose()
        };
        let view = TrainingView {
            camera,
            time,
            image: arrays::picture("image", image, size, 3)?,
            weights: map("weights", weights)?,
            disparity: None,
            mask: map("mask", mask)?,
            every: 1,
        };
        Ok(View { view: Arc::new(view) })
    }
}

/// The progress of a training run.
#[pyclass(frozen, get_all, module = "splat4d")]
pub struct Progress {
    /// Number of completed steps.
    step: u32,
    /// Total number of steps that the schedules are designed for.
    steps: u32,
    /// Number of Gaussians.
    gaussians: usize,
}

#[pymethods]
impl Progress {
    fn __repr__(&self) -> String {
        let Progress { step, steps, gaussians } = self;
        format!("Progress(step={step}, steps={steps}, gaussians={gaussians})")
    }
}

impl Progress {
    fn of(progress: train::Progress) -> Progress {
        let train::Progress { step, steps, gaussians } = progress;
        Progress { step, steps, gaussians }
    }
}

/// Trains the Gaussians of a scene on a device, and the scene's motion if it has one.
///
/// With `views`, each `step` trains on the next view. Without views, the caller computes the loss with
/// `forward`, `backward` and `update`. Without views, `extent` is the unit of the positions' learning rate:
/// about the distance of the outermost camera from the cameras' mean, in world units.
///
/// All settings are optional; defaults are in parentheses. `steps` (30000): the number of steps that the
/// schedules are designed for. `growth` (`"mcmc"`): `"mcmc"`, `"adaptive"`, or `None` to keep the number of
/// Gaussians. `max_gaussians`: the largest number of Gaussians. `sh_degree` (3): 0 to 3. `sh_interval`:
/// number of steps after which the next band of spherical harmonics is added; 0 uses all bands from the
/// first step. `ssim_share` (0.2): the share of SSIM in the loss. `background` (the scene's): red, green,
/// blue. `seed`. `rigidity_weight`. Learning rates: `position_rate`, `position_rate_last`,
/// `log_scale_rate`, `rotation_rate`, `opacity_rate`, `sh0_rate` and `sh_rest_rate`.
///
/// Raises `TypeError` for an unknown setting, `ValueError` for a scene of a higher degree than `sh_degree`,
/// `splat4d.Error` for numbers out of range or if the device runs out of memory.
#[pyclass(frozen, module = "splat4d")]
pub struct Trainer {
    state: Arc<Mutex<State>>,
    /// The initial scene; its cameras and `up` stay as they are.
    start: Arc<scene::Scene>,
    settings: TrainSettings,
}

/// What a trainer has on its device.
pub struct State {
    device: gpu::Device,
    trainer: Kind,
    stream: Stream,
    own: Own,
    gradients: Option<PixelGradients>,
    /// Memory for the rendered colour, reused while the size of the image stays.
    colour: Option<Readback<[f32; 4]>>,
    /// Arrays of the step that Python may still read.
    unread: Vec<Weak<Unread>>,
}

enum Kind {
    /// With training views and the engine's loss.
    OnViews(train::Trainer),
    /// For a loss of the caller's own.
    Alone(SceneOptimiser),
}

impl Kind {
    fn scene(&mut self) -> splat4d::Result<&mut SceneOptimiser> {
        match self {
            Kind::OnViews(trainer) => trainer.scene(),
            Kind::Alone(scene) => Ok(scene),
        }
    }

    fn progress(&self) -> train::Progress {
        match self {
            Kind::OnViews(trainer) => trainer.progress(),
            Kind::Alone(scene) => scene.progress(),
        }
    }
}

/// A step with the caller's loss. What was submitted last need not have finished.
enum Own {
    Nothing,
    Forward(Pass<Seen>),
    Backward(Pass<Differentiated>, Ticket),
    Updated(Pass<Updated>, Ticket),
}

fn out_of_turn(what: &str) -> splat4d::Error {
    splat4d::Error::Input(format!(
        "a step with a loss of your own: `{what}` comes in the order forward, backward, update"
    ))
}

/// The caller's gradients with respect to the rendered image, on the device, for one image size.
struct PixelGradients {
    rgba: Buffer<[f32; 4]>,
    depth: Buffer<f32>,
}

impl State {
    /// Ends the step with the caller's loss, if one is in progress.
    fn end_own(&mut self) -> splat4d::Result<()> {
        self.keep()?;
        let State { trainer, stream, own, .. } = self;
        match std::mem::replace(own, Own::Nothing) {
            Own::Nothing => Ok(()),
            Own::Forward(pass) => trainer.scene()?.conclude(pass).map(drop),
            Own::Backward(pass, ticket) => {
                stream.wait(ticket)?;
                trainer.scene()?.conclude(pass).map(drop)
            }
            Own::Updated(pass, ticket) => {
                stream.wait(ticket)?;
                trainer.scene()?.conclude(pass).map(drop)
            }
        }
    }

    /// Ends the step with the caller's loss if its parameters have been updated: progress and scene then
    /// include it.
    fn end_update(&mut self) -> splat4d::Result<()> {
        match self.own {
            Own::Updated(..) => self.end_own(),
            _ => Ok(()),
        }
    }

    /// Copies the arrays of the step that Python may still read, before their memory changes.
    fn keep(&mut self) -> splat4d::Result<()> {
        for unread in std::mem::take(&mut self.unread) {
            let Some(unread) = unread.upgrade() else { continue };
            for (array, values) in unread.lock().expect("no holder panics").iter_mut() {
                if values.is_none() {
                    *values = Some(self.download(*array)?);
                }
            }
        }
        Ok(())
    }

    /// Notes arrays that Python may read later.
    fn defer(&mut self, arrays: impl Iterator<Item = Array>) -> Arc<Unread> {
        let unread = Arc::new(Unread::new(arrays.map(|array| (array, None)).collect()));
        self.unread.push(Arc::downgrade(&unread));
        unread
    }

    /// Waits for the device and reads an array of the step in progress.
    pub fn download(&mut self, array: Array) -> splat4d::Result<Vec<f32>> {
        let State { trainer, stream, own, .. } = self;
        let scene = trainer.scene()?;
        if array == Array::Depth {
            let pixels = match own {
                Own::Forward(pass) => scene.pixels(pass)?,
                Own::Backward(pass, _) => scene.pixels(pass)?,
                _ => return Err(deferred::gone(array)),
            };
            return stream.download(&pixels.depth);
        }
        let Own::Backward(pass, _) = own else { return Err(deferred::gone(array)) };
        let n = scene.progress().gaussians;
        let found = scene.gradients(pass)?;
        let by = found.gaussians;
        match (array, found.motion) {
            (Array::Positions, _) => stream.download_from(by.positions.range(0..3 * n)),
            (Array::LogScales, _) => stream.download_from(by.log_scales.range(0..3 * n)),
            (Array::Rotations, _) => stream.download_from(by.rotations.range(0..n).floats()),
            (Array::OpacityLogits, _) => stream.download_from(by.opacity_logits.range(0..n)),
            (Array::Sh, _) => Ok(by.download_sh(stream, n)?.into_flattened()),
            (Array::Pose, _) => stream.download(found.pose),
            (Array::ControlLogRadii, Some((_, log_radii))) => stream.download(log_radii),
            (Array::ControlPaths | Array::Network, Some((model, _))) => stream.download(model),
            (Array::Depth | Array::ControlLogRadii | Array::ControlPaths | Array::Network, _) => {
                Err(deferred::gone(array))
            }
        }
    }

    fn steps(&mut self, count: u32, until: Instant) -> splat4d::Result<u32> {
        self.end_own()?;
        let Kind::OnViews(trainer) = &mut self.trainer else {
            let what = "a step on the trainer's own images: there are none; see `Trainer.forward`";
            return Err(splat4d::Error::Input(what.into()));
        };
        let mut done = 0;
        while done < count {
            trainer.step()?;
            done += 1;
            if Instant::now() >= until {
                break;
            }
        }
        Ok(done)
    }

    /// Renders. Returns the colour and what is known of the depth.
    fn forward(
        &mut self,
        camera: &types::Camera,
        time: f64,
    ) -> splat4d::Result<(Image, Arc<Unread>)> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        self.end_own()?;
        let State { device, trainer, stream, own, colour, .. } = self;
        let scene = trainer.scene()?;
        let rgba = loop {
            let mut recorder = stream.record()?;
            let mut pass = scene.forward(&mut recorder, camera, time)?;
            let pixels = &scene.pixels(&pass)?.rgba;
            let before = colour.take().filter(|before| before.len() == pixels.len());
            let mut readback = match before {
                Some(before) => before,
                None => device.readback(pixels.len())?,
            };
            recorder.read_back(pixels.view(), &readback);
            let ticket = stream.submit(recorder)?;
            stream.wait(ticket)?;
            let rgba = scene.fits(&mut pass)?.then(|| readback.read()).transpose()?;
            *colour = Some(readback);
            match rgba {
                Some(rgba) => {
                    *own = Own::Forward(pass);
                    break rgba;
                }
                None => scene.conclude(pass)?,
            };
        };
        let rgba = Image { width, height, channels: 4, pixels: rgba.into_flattened() };
        Ok((rgba, self.defer([Array::Depth].into_iter())))
    }

    /// Computes the gradients, without waiting for them. Returns the arrays, with their shapes, and what is
    /// known of them.
    fn backward(
        &mut self,
        rgba: &[f32],
        depth: Option<&[f32]>,
        with_network: bool,
    ) -> splat4d::Result<(Shapes, Arc<Unread>)> {
        let rgba: &[[f32; 4]] = rgba.as_chunks().0;
        let fits = |by: &PixelGradients| by.rgba.len() == rgba.len();
        if !self.gradients.as_ref().is_some_and(fits) {
            self.gradients = Some(PixelGradients {
                rgba: self.device.buffer("gradient by colour", rgba.len())?,
                depth: self.device.buffer("gradient by depth", rgba.len())?,
            });
        }
        let State { trainer, stream, own, gradients, .. } = self;
        let Own::Forward(pass) = std::mem::replace(own, Own::Nothing) else {
            return Err(out_of_turn("backward"));
        };
        let scene = trainer.scene()?;
        let by = gradients.as_mut().expect("made above");
        stream.upload(&mut by.rgba, rgba)?;
        if let Some(depth) = depth {
            stream.upload(&mut by.depth, depth)?;
        }
        let mut recorder = stream.record()?;
        let depth = depth.map(|_| by.depth.view());
        let by = OwnGradients { rgba: by.rgba.view(), depth };
        let pass = scene.backward(&mut recorder, pass, by)?;
        let ticket = stream.submit(recorder)?;
        let n = scene.progress().gaussians;
        let found = scene.gradients(&pass)?;
        let mut shapes = vec![
            (Array::Positions, vec![n, 3]),
            (Array::LogScales, vec![n, 3]),
            (Array::Rotations, vec![n, 4]),
            (Array::OpacityLogits, vec![n]),
            (Array::Sh, vec![n, sh_coefficients(found.gaussians.sh_degree), 3]),
            (Array::Pose, vec![found.pose.len()]),
        ];
        if let Some((model, log_radii)) = found.motion {
            let points = log_radii.len();
            shapes.push((Array::ControlLogRadii, vec![points]));
            shapes.push(match with_network {
                true => (Array::Network, vec![model.len()]),
                false => (Array::ControlPaths, vec![model.len() / (8 * points), points, 8]),
            });
        }
        *own = Own::Backward(pass, ticket);
        let unread = self.defer(shapes.iter().map(|(array, _)| *array));
        Ok((shapes, unread))
    }

    /// Updates the parameters, without waiting for it.
    fn update(&mut self) -> splat4d::Result<()> {
        if !matches!(self.own, Own::Backward(..)) {
            return Err(out_of_turn("update"));
        }
        // The regularisers are added to the gradients in place.
        self.keep()?;
        let State { trainer, stream, own, .. } = self;
        let Own::Backward(pass, _) = std::mem::replace(own, Own::Nothing) else {
            return Err(out_of_turn("update"));
        };
        let mut recorder = stream.record()?;
        let pass = trainer.scene()?.update(&mut recorder, pass)?;
        let ticket = stream.submit(recorder)?;
        *own = Own::Updated(pass, ticket);
        Ok(())
    }
}

impl Drop for State {
    fn drop(&mut self) {
        // Python may still read arrays of the last step. After a failure they are gone, which reading them says.
        let _ = self.keep();
    }
}

impl Trainer {
    /// Locks the state. Must be called without the GIL: another thread may hold the lock and wait for the
    /// GIL.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no holder panics")
    }
}

#[pymethods]
impl Trainer {
    #[new]
    #[pyo3(signature = (device, scene, views = Vec::new(), *, extent = 1.0, **settings))]
    fn new(
        py: Python<'_>,
        device: &Device,
        scene: &Scene,
        views: Vec<View>,
        extent: f64,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Trainer> {
        let start = scene.scene.clone();
        let mut chosen = settings::of(settings, start.gaussians.len())?;
        if !settings.is_some_and(|given| given.contains("background").unwrap_or(false)) {
            chosen.background = start.background;
        }
        chosen.render = start.settings;
        let (degree, most) = (start.gaussians.sh_degree, chosen.sh_degree);
        if degree > most {
            let what = format!("sh_degree: expected at least the scene's {degree}, got {most}");
            return Err(PyValueError::new_err(what));
        }
        let device = device.device.clone();
        let motion = start.moves().then(|| MotionStart {
            points: start.control_points.clone(),
            network: start.network.clone(),
            neighbours: start.neighbours as usize,
        });
        let make = || {
            let (gaussians, motion, settings) = (&start.gaussians, motion.as_ref(), chosen.clone());
            let views: Vec<TrainingView> =
                views.iter().map(|view| TrainingView::clone(&view.view)).collect();
            let trainer = match views.is_empty() {
                true => {
                    Kind::Alone(SceneOptimiser::new(&device, gaussians, motion, extent, settings)?)
                }
                false => Kind::OnViews(train::Trainer::new(
                    &device, &views, gaussians, motion, settings,
                )?),
            };
            let stream = device.stream()?;
            Ok(State {
                device,
                trainer,
                stream,
                own: Own::Nothing,
                gradients: None,
                colour: None,
                unread: Vec::new(),
            })
        };
        let state = Arc::new(Mutex::new(py.detach(make).map_err(raised)?));
        Ok(Trainer { state, start: scene.scene.clone(), settings: chosen })
    }

    /// Does one step on the next view with the engine's loss. May return before the device has finished.
    ///
    /// Raises `splat4d.Error` without views, or if the device fails.
    fn step(&self, py: Python<'_>) -> PyResult<()> {
        self.steps(py, 1, None)
    }

    /// Does `count` steps. `progress` is called with a `Progress` about twenty times per second and after the
    /// last step; an exception that it raises stops the loop. Ctrl-C stops it with `KeyboardInterrupt`. In
    /// both cases the completed steps count, and the trainer stays usable.
    ///
    /// Raises as `step` does.
    #[pyo3(signature = (count, *, progress = None))]
    fn steps(
        &self,
        py: Python<'_>,
        count: u32,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut left = count;
        while left > 0 {
            let batch = || {
                let mut state = self.lock();
                let done = state.steps(left, Instant::now() + ATTENTION)?;
                Ok((done, state.trainer.progress()))
            };
            let (done, now) = py.detach(batch).map_err(raised)?;
            left -= done;
            py.check_signals()?;
            if let Some(progress) = progress {
                progress.call1((Progress::of(now),))?;
            }
        }
        Ok(())
    }

    /// The progress of training. Waits for the device after `update`.
    #[getter]
    fn progress(&self, py: Python<'_>) -> PyResult<Progress> {
        let read = || {
            let mut state = self.lock();
            state.end_update()?;
            Ok(state.trainer.progress())
        };
        Ok(Progress::of(py.detach(read).map_err(raised)?))
    }

    /// Waits for the device and returns the terms of the last step's loss by name: `l1`, `ssim` and
    /// `disparity`. `None` before the first step, and if the last step has to be repeated.
    fn loss<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let read = || match &mut self.lock().trainer {
            Kind::OnViews(trainer) => trainer.loss(),
            Kind::Alone(_) => Ok(None),
        };
        let found = py.detach(read).map_err(raised)?;
        let Some(found) = found else { return Ok(None) };
        let dict = PyDict::new(py);
        dict.set_item("l1", found.l1)?;
        dict.set_item("ssim", found.ssim)?;
        dict.set_item("disparity", found.disparity)?;
        Ok(Some(dict))
    }

    /// Waits for the device and measures the PSNR in dB of the last step's render, from before that step's
    /// update, against its training view. `None` where `loss` gives `None`, for a view whose weights are
    /// all 0, and after a step in which the mask loss has overwritten the render.
    fn psnr(&self, py: Python<'_>) -> PyResult<Option<f64>> {
        let read = || match &mut self.lock().trainer {
            Kind::OnViews(trainer) => trainer.psnr(),
            Kind::Alone(_) => Ok(None),
        };
        py.detach(read).map_err(raised)
    }

    /// Waits for the device and returns the current scene, with the cameras of the initial scene.
    fn scene(&self, py: Python<'_>) -> PyResult<Scene> {
        let read = || {
            let state = &mut self.lock();
            state.end_update()?;
            let scene = state.trainer.scene()?;
            Ok((scene.gaussians()?, scene.motion()?))
        };
        let (gaussians, motion) = py.detach(read).map_err(raised)?;
        let mut made = scene::Scene {
            gaussians,
            settings: self.settings.render,
            neighbours: self.start.neighbours,
            cameras: self.start.cameras.clone(),
            background: self.settings.background,
            up: self.start.up,
            ..Default::default()
        };
        if let Some((points, network)) = motion {
            (made.control_points, made.network) = (points, network);
        }
        Ok(Scene::of(made))
    }

    /// Begins a step with the caller's loss: renders the image that `camera` sees at `time`, in [0, 1].
    /// A step that is already in progress ends without an update. The depth is copied from the device when it
    /// is read, at the latest when the step ends.
    ///
    /// Raises `splat4d.Error` for a time out of range, or if the device runs out of memory.
    #[pyo3(signature = (camera, time = 0.0))]
    fn forward(&self, py: Python<'_>, camera: &Camera, time: f64) -> PyResult<Rendered> {
        let camera = camera.camera;
        let (rgba, unread) = py.detach(|| self.lock().forward(&camera, time)).map_err(raised)?;
        let shape = vec![rgba.height as usize, rgba.width as usize];
        let depth = Deferred::new(&self.state, vec![(Array::Depth, shape)], unread);
        Rendered::with_depth(py, rgba, depth)
    }

    /// Continues the step after `forward`, given the gradient of the caller's loss with respect to the
    /// rendered image: `grad_rgba`, shape (height, width, 4), with respect to premultiplied colour and alpha,
    /// and `grad_depth`, shape (height, width), with respect to depth as in `Rendered.depth`.
    ///
    /// Returns the gradients with respect to the scene's arrays as a mapping, with the names and shapes of
    /// `Scene.arrays()`: `positions`, `log_scales`, `rotations`, `opacity_logits`, `sh`, and in a moving
    /// scene `control_log_radii` and either `control_paths` or `network`, (W,). `pose`, (6,), is the
    /// gradient with respect to a left perturbation of `view_from_world`: translation, rotation. In a
    /// moving scene the rigidity term counts as part of the loss, unless `rigidity_weight=0`. May return
    /// before the device has finished: each array is copied from the device when it is read.
    ///
    /// Raises `ValueError` for wrong shapes, `splat4d.Error` unless `forward` was the last call of the step.
    #[pyo3(signature = (grad_rgba, grad_depth = None))]
    fn backward<'py>(
        &self,
        py: Python<'py>,
        grad_rgba: &Bound<'py, PyAny>,
        grad_depth: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let size = || match &self.lock().own {
            Own::Forward(pass) => Some(pass.size()),
            _ => None,
        };
        let Some((width, height)) = py.detach(size) else {
            return Err(crate::error::out_of_range("backward comes after forward".into()));
        };
        let sides = [arrays::Side::Exactly(height as usize), arrays::Side::Exactly(width as usize)];
        let four = arrays::Side::Exactly(4);
        let rgba = arrays::floats("grad_rgba", grad_rgba, &[sides[0], sides[1], four])?.0;
        let depth = match grad_depth {
            Some(depth) => Some(arrays::floats("grad_depth", depth, &sides)?.0),
            None => None,
        };
        let with_network = self.start.network.is_some();
        let differentiate = || self.lock().backward(&rgba, depth.as_deref(), with_network);
        let (shapes, unread) = py.detach(differentiate).map_err(raised)?;
        let source = GradientSource { deferred: Deferred::new(&self.state, shapes, unread) };
        py.import("splat4d._gradients")?.call_method1("Gradients", (source,))
    }

    /// Ends the step after `backward`: updates every parameter from these gradients, with the learning rates
    /// and regularisers of the settings. May return before the device has finished.
    ///
    /// Raises `splat4d.Error` unless `backward` was the last call of the step.
    fn update(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.lock().update()).map_err(raised)
    }
}
