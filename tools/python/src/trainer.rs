//! The classes of training: `View`, `Progress` and `Trainer`.

use crate::arrays;
use crate::camera::Camera;
use crate::device::Device;
use crate::error::raised;
use crate::renderer::Rendered;
use crate::scene::Scene;
use crate::settings;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::gpu::{Buffer, Stream};
use splat4d::train::own_loss::{Differentiated, OwnGradients, Pass, Rendered as Seen};
use splat4d::train::{self, MotionStart, SceneOptimiser, TrainSettings, TrainingView};
use splat4d::types::{Gaussians, Image, sh_coefficients};
use splat4d::{gpu, renderer, scene, types};
use std::sync::{Arc, Mutex, MutexGuard};
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
    state: Mutex<State>,
    /// The initial scene; its cameras and `up` stay as they are.
    start: Arc<scene::Scene>,
    settings: TrainSettings,
}

struct State {
    device: gpu::Device,
    trainer: Kind,
    stream: Stream,
    own: Own,
    gradients: Option<PixelGradients>,
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

/// A step with the caller's loss.
enum Own {
    Nothing,
    Forward(Pass<Seen>),
    Backward(Pass<Differentiated>),
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

/// Gradients with respect to the parameters, on the host.
struct Gradients {
    gaussians: Gaussians,
    pose: Vec<f32>,
    motion: Option<MotionGradients>,
}

struct MotionGradients {
    /// With respect to the control points' paths, or to the network's parameters.
    model: Vec<f32>,
    log_radii: Vec<f32>,
}

impl State {
    /// Ends the step with the caller's loss, if one is in progress.
    fn end_own(&mut self) -> splat4d::Result<()> {
        match std::mem::replace(&mut self.own, Own::Nothing) {
            Own::Nothing => Ok(()),
            Own::Forward(pass) => self.trainer.scene()?.conclude(pass).map(drop),
            Own::Backward(pass) => self.trainer.scene()?.conclude(pass).map(drop),
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

    fn forward(
        &mut self,
        camera: &types::Camera,
        time: f64,
    ) -> splat4d::Result<renderer::Rendered> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        self.end_own()?;
        let State { trainer, stream, own, .. } = self;
        let scene = trainer.scene()?;
        let pass = loop {
            let mut recorder = stream.record()?;
            let mut pass = scene.forward(&mut recorder, camera, time)?;
            let ticket = stream.submit(recorder)?;
            stream.wait(ticket)?;
            if scene.fits(&mut pass)? {
                break pass;
            }
            scene.conclude(pass)?;
        };
        let pixels = scene.pixels(&pass)?;
        let rgba = stream.download(&pixels.rgba)?.into_flattened();
        let depth = stream.download(&pixels.depth)?;
        *own = Own::Forward(pass);
        Ok(renderer::Rendered {
            rgba: Image { width, height, channels: 4, pixels: rgba },
            depth: Image { width, height, channels: 1, pixels: depth },
        })
    }

    fn backward(&mut self, rgba: &[f32], depth: Option<&[f32]>) -> splat4d::Result<Gradients> {
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
        stream.wait(ticket)?;
        let count = scene.progress().gaussians;
        let found = scene.gradients(&pass)?;
        let gaussians = found.gaussians.download_first(stream, count)?;
        let pose = stream.download(found.pose)?;
        let motion = match found.motion {
            Some((model, log_radii)) => Some(MotionGradients {
                model: stream.download(model)?,
                log_radii: stream.download(log_radii)?,
            }),
            None => None,
        };
        *own = Own::Backward(pass);
        Ok(Gradients { gaussians, pose, motion })
    }

    fn update(&mut self) -> splat4d::Result<()> {
        let State { trainer, stream, own, .. } = self;
        let pass = match std::mem::replace(own, Own::Nothing) {
            Own::Backward(pass) => pass,
            other => {
                *own = other;
                return Err(out_of_turn("update"));
            }
        };
        let scene = trainer.scene()?;
        let mut recorder = stream.record()?;
        let pass = scene.update(&mut recorder, pass)?;
        let ticket = stream.submit(recorder)?;
        stream.wait(ticket)?;
        scene.conclude(pass).map(drop)
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
            Ok(State { device, trainer, stream, own: Own::Nothing, gradients: None })
        };
        let state = Mutex::new(py.detach(make).map_err(raised)?);
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

    /// The progress of training.
    #[getter]
    fn progress(&self, py: Python<'_>) -> Progress {
        Progress::of(py.detach(|| self.lock().trainer.progress()))
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
    /// A step that is already in progress ends without an update.
    ///
    /// Raises `splat4d.Error` for a time out of range, or if the device runs out of memory.
    #[pyo3(signature = (camera, time = 0.0))]
    fn forward(&self, py: Python<'_>, camera: &Camera, time: f64) -> PyResult<Rendered> {
        let camera = camera.camera;
        let rendered = py.detach(|| self.lock().forward(&camera, time)).map_err(raised)?;
        Rendered::of(py, rendered)
    }

    /// Continues the step after `forward`, given the gradient of the caller's loss with respect to the
    /// rendered image: `grad_rgba`, shape (height, width, 4), with respect to premultiplied colour and alpha,
    /// and `grad_depth`, shape (height, width), with respect to depth as in `Rendered.depth`.
    ///
    /// Returns the gradients with respect to the scene's arrays, with the names and shapes of
    /// `Scene.arrays()`: `positions`, `log_scales`, `rotations`, `opacity_logits`, `sh`, and in a moving
    /// scene `control_log_radii` and either `control_paths` or `network`, (W,). `pose`, (6,), is the
    /// gradient with respect to a left perturbation of `view_from_world`: translation, rotation. In a
    /// moving scene the rigidity term counts as part of the loss, unless `rigidity_weight=0`.
    ///
    /// Raises `ValueError` for wrong shapes, `splat4d.Error` unless `forward` was the last call of the step.
    #[pyo3(signature = (grad_rgba, grad_depth = None))]
    fn backward<'py>(
        &self,
        py: Python<'py>,
        grad_rgba: &Bound<'py, PyAny>,
        grad_depth: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
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
        let found = py.detach(|| self.lock().backward(&rgba, depth.as_deref())).map_err(raised)?;
        self.by_name(py, found)
    }

    /// Ends the step after `backward`: updates every parameter from these gradients, with the learning rates
    /// and regularisers of the settings.
    ///
    /// Raises `splat4d.Error` unless `backward` was the last call of the step.
    fn update(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.lock().update()).map_err(raised)
    }
}

impl Trainer {
    fn by_name<'py>(&self, py: Python<'py>, found: Gradients) -> PyResult<Bound<'py, PyDict>> {
        let Gradients { gaussians: g, pose, motion } = found;
        let dict = PyDict::new(py);
        let shape = [g.len(), sh_coefficients(g.sh_degree), 3];
        dict.set_item("positions", arrays::table(py, g.positions)?)?;
        dict.set_item("log_scales", arrays::table(py, g.log_scales)?)?;
        dict.set_item("rotations", arrays::table(py, g.rotations)?)?;
        dict.set_item("opacity_logits", arrays::line(py, g.opacity_logits))?;
        dict.set_item("sh", arrays::block(py, g.sh.into_flattened(), shape)?)?;
        dict.set_item("pose", arrays::line(py, pose))?;
        if let Some(MotionGradients { model, log_radii }) = motion {
            let points = log_radii.len();
            dict.set_item("control_log_radii", arrays::line(py, log_radii))?;
            match self.start.network {
                Some(_) => dict.set_item("network", arrays::line(py, model))?,
                None => {
                    let keys = model.len() / (8 * points);
                    dict.set_item("control_paths", arrays::block(py, model, [keys, points, 8])?)?;
                }
            }
        }
        Ok(dict)
    }
}
