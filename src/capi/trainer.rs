//! The trainer of the C interface.

use super::call::{
    Fault, Outcome, array, call, claim, destroy, exclusive, fault, give, grows, input, read,
    read_or_zero, shape, shared, size_of_host, splat4d_result, write,
};
use super::device::{device_of, splat4d_device};
use super::memory::{range_of, splat4d_buffer, splat4d_range};
use super::record::splat4d_recorder;
use super::renderer::{pixels_of, splat4d_pixels};
use super::scene::{
    camera_of, floats_of, gaussians_of, read_out, splat4d_camera, splat4d_gaussians,
    splat4d_gaussians_out, splat4d_scene,
};
use super::vulkan::VkBuffer;
use crate::Result;
use crate::gpu::{Buffer, Stream};
use crate::ops::render::PixelBuffers;
use crate::scene::Scene;
use crate::train::own_loss::{Differentiated, OwnGradients, Pass, Rendered, Updated};
use crate::train::{
    AdaptiveSettings, GrowthSettings, Progress, SceneOptimiser, TrainSettings, Trainer,
    TrainingView,
};
use crate::types::Image;

/// A trainer of Gaussians as a static scene.
pub struct splat4d_trainer {
    kind: Kind,
    pass: Option<Step>,
    /// The stream for reading gradients.
    stream: Stream,
    background: [f32; 3],
    sh_degree: u32,
}

enum Kind {
    /// With training views and the engine's loss.
    OnViews(Trainer),
    /// For a loss of the host's own.
    Alone(SceneOptimiser),
}

/// A step with the host's own loss.
enum Step {
    Rendered(Pass<Rendered>),
    Differentiated(Pass<Differentiated>),
    Updated(Pass<Updated>),
}

impl Kind {
    fn scene(&mut self) -> Result<&mut SceneOptimiser> {
        match self {
            Kind::OnViews(trainer) => trainer.scene(),
            Kind::Alone(scene) => Ok(scene),
        }
    }

    fn progress(&self) -> Progress {
        match self {
            Kind::OnViews(trainer) => trainer.progress(),
            Kind::Alone(scene) => scene.progress(),
        }
    }
}

impl Step {
    fn pixels<'a>(&self, scene: &'a mut SceneOptimiser) -> Result<&'a PixelBuffers> {
        match self {
            Step::Rendered(pass) => scene.pixels(pass),
            Step::Differentiated(pass) => scene.pixels(pass),
            Step::Updated(pass) => scene.pixels(pass),
        }
    }

    fn pose<'a>(&self, scene: &'a mut SceneOptimiser) -> Result<Option<&'a Buffer<f32>>> {
        match self {
            Step::Rendered(_) => Ok(None),
            Step::Differentiated(pass) => Ok(Some(scene.gradients(pass)?.pose)),
            Step::Updated(pass) => scene.pose_gradient(pass).map(Some),
        }
    }

    fn fits(&mut self, scene: &mut SceneOptimiser) -> Result<bool> {
        match self {
            Step::Rendered(pass) => scene.fits(pass),
            Step::Differentiated(pass) => scene.fits(pass),
            Step::Updated(pass) => scene.fits(pass),
        }
    }

    fn conclude(self, scene: &mut SceneOptimiser) -> Result<bool> {
        match self {
            Step::Rendered(pass) => scene.conclude(pass),
            Step::Differentiated(pass) => scene.conclude(pass),
            Step::Updated(pass) => scene.conclude(pass),
        }
    }
}

fn out_of_turn(what: &str) -> Fault {
    input(format!(
        "a step with a loss of your own: `{what}` comes in the order forward, backward, update, \
         conclude"
    ))
}

/// 3DGS-MCMC: dead Gaussians are relocated onto live ones, and the number grows up to
/// max_gaussians. The default.
pub const SPLAT4D_GROWTH_MCMC: u32 = 0;
/// 3D Gaussian Splatting: clone, split, prune.
pub const SPLAT4D_GROWTH_ADAPTIVE: u32 = 1;
/// No growth: the number of Gaussians stays constant.
pub const SPLAT4D_GROWTH_NONE: u32 = 2;

/// Settings of training. 0 selects the default of a field; a negative value stands for 0 itself.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_train_settings {
    /// sizeof(splat4d_train_settings).
    pub struct_size: usize,
    /// Number of steps of the schedules; 0 for 30000.
    pub steps: u32,
    /// SPLAT4D_GROWTH_*.
    pub growth: u32,
    /// Maximum number of Gaussians; 0 for a million.
    pub max_gaussians: usize,
    /// Bands of the spherical harmonics, 1 to 4 (the degree plus 1); 0 for 4.
    pub sh_bands: u32,
    /// Number of steps after which a further band is added; 0 for 1000, negative for all bands from
    /// the first step.
    pub sh_interval: i32,
    /// Weight of D-SSIM in the loss; 0 for 0.2, negative for none.
    pub ssim_share: f32,
    /// Background colour: red, green, blue.
    pub background: [f32; 3],
    /// Learning rates; 0 for those of 3D Gaussian Splatting, negative for none. This one is for
    /// positions at the first step, and the next at the last step, in units of the scene's extent.
    pub position_rate: f64,
    /// As above.
    pub position_rate_last: f64,
    /// As above.
    pub log_scale_rate: f64,
    /// As above.
    pub rotation_rate: f64,
    /// As above.
    pub opacity_rate: f64,
    /// As above: the constant spherical harmonic.
    pub sh0_rate: f64,
    /// As above: the other bands.
    pub sh_rest_rate: f64,
    /// Seed of the order of the training views and of all random numbers.
    pub seed: u64,
}
grows!(splat4d_train_settings, seed: u64);

/// A training view.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_view {
    /// sizeof(splat4d_view). It must be equal in all elements of an array, and is the distance
    /// between them.
    pub struct_size: usize,
    /// The camera, with the size of the image.
    pub camera: *const splat4d_camera,
    /// Red, green, blue in [0, 1]: 3 * width * height.
    pub rgb: *const f32,
    /// Weight of each pixel in [0, 1]: width * height; null for 1.
    pub weights: *const f32,
}
grows!(splat4d_view, weights: *const f32);

/// The progress of training.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_progress {
    /// sizeof(splat4d_progress).
    pub struct_size: usize,
    /// Number of steps done.
    pub step: u32,
    /// Degree of the spherical harmonics of the Gaussians that are read.
    pub sh_degree: u32,
    /// Number of Gaussians.
    pub count: usize,
}
grows!(splat4d_progress, count: usize);

/// The terms of the last step's loss.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_loss {
    /// sizeof(splat4d_loss).
    pub struct_size: usize,
    /// 1 if a loss is known; otherwise the other fields are 0.
    pub is_known: u32,
    /// Weighted mean of the absolute differences.
    pub l1: f64,
    /// Weighted mean of SSIM.
    pub ssim: f64,
}
grows!(splat4d_loss, ssim: f64);

/// Gradients on the device, in the layout of the parameters: floats, one row per Gaussian.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_gradients {
    /// sizeof(splat4d_gradients).
    pub struct_size: usize,
    /// 3 per Gaussian.
    pub positions: splat4d_range,
    /// 3 per Gaussian.
    pub log_scales: splat4d_range,
    /// 4 per Gaussian.
    pub rotations: splat4d_range,
    /// 1 per Gaussian.
    pub opacity_logits: splat4d_range,
    /// By band: 3, 9, 15, 21 per Gaussian; empty above the degree.
    pub sh: [splat4d_range; 4],
    /// With respect to the camera's pose, for a left perturbation of view_from_world: translation,
    /// rotation; 6 floats. Empty before backward.
    pub pose: splat4d_range,
}
grows!(splat4d_gradients, pose: splat4d_range);

/// Uploads Gaussians and training views to a device, to train a static scene. All data is copied.
/// `settings` may be null for the defaults. `trainer` gets a handle, to be destroyed.
///
/// Without views (`view_count` 0, for a loss of the host's own) `extent` is the unit of the positions'
/// learning rate: about the distance of the outermost camera from the mean of all. With views it is
/// computed from their cameras, and `extent` is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_create(
    device: *const splat4d_device,
    gaussians: *const splat4d_gaussians,
    views: *const splat4d_view,
    view_count: usize,
    extent: f64,
    settings: *const splat4d_train_settings,
    trainer: *mut *mut splat4d_trainer,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("trainer", trainer)?;
        let device = device_of(device)?;
        let gaussians = gaussians_of(gaussians)?;
        let settings = settings_of(&read_or_zero("settings", settings)?, gaussians.len())?;
        if gaussians.sh_degree > settings.sh_degree {
            return Err(shape(format!(
                "gaussians.sh_degree is {}: settings.sh_bands allows {}",
                gaussians.sh_degree, settings.sh_degree
            )));
        }
        let (background, sh_degree) = (settings.background, settings.sh_degree);
        let kind = match view_count {
            0 => {
                let scene = SceneOptimiser::new(device, &gaussians, None, extent, settings)?;
                Kind::Alone(scene)
            }
            _ => {
                let views = views_of(views, view_count)?;
                Kind::OnViews(Trainer::new(device, &views, &gaussians, None, settings)?)
            }
        };
        let stream = device.stream()?;
        give(trainer, splat4d_trainer { kind, pass: None, stream, background, sh_degree });
        Ok(())
    })
}

/// Does one step on the next training view with the engine's own loss. Returns before the device is
/// done.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_step(trainer: *mut splat4d_trainer) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        match &mut exclusive("trainer", trainer)?.kind {
            Kind::OnViews(trainer) => Ok(trainer.step()?),
            Kind::Alone(_) => {
                let what = "a step on the trainer's own images: there are none; see \
                            splat4d_trainer_forward";
                Err(input(what))
            }
        }
    })
}

/// Waits, and gets the last step's loss.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_get_loss(
    trainer: *mut splat4d_trainer,
    loss: *mut splat4d_loss,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let trainer = exclusive("trainer", trainer)?;
        size_of_host("loss", loss)?;
        let mut value = splat4d_loss { struct_size: 0, is_known: 0, l1: 0.0, ssim: 0.0 };
        if let Kind::OnViews(trainer) = &mut trainer.kind
            && let Some(found) = trainer.loss()?
        {
            value = splat4d_loss { is_known: 1, l1: found.l1, ssim: found.ssim, ..value };
        }
        write("loss", loss, value)
    })
}

/// Gets the progress of training.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_get_progress(
    trainer: *const splat4d_trainer,
    progress: *mut splat4d_progress,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let trainer = shared("trainer", trainer)?;
        let found = trainer.kind.progress();
        let (step, sh_degree, count) = (found.step, trainer.sh_degree, found.gaussians);
        write("progress", progress, splat4d_progress { struct_size: 0, step, sh_degree, count })
    })
}

/// Waits for the steps in flight, and reads the Gaussians.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_read(
    trainer: *mut splat4d_trainer,
    gaussians: *mut splat4d_gaussians_out,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let kind = &mut exclusive("trainer", trainer)?.kind;
        size_of_host("gaussians", gaussians)?;
        read_out(&kind.scene()?.gaussians()?, gaussians)
    })
}

/// Waits for the steps in flight, and creates a scene from the Gaussians. `scene` gets a handle, to
/// be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_get_scene(
    trainer: *mut splat4d_trainer,
    scene: *mut *mut splat4d_scene,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("scene", scene)?;
        let splat4d_trainer { kind, background, .. } = exclusive("trainer", trainer)?;
        let mut made = Scene::of(kind.scene()?.gaussians()?);
        made.background = *background;
        give(scene, splat4d_scene { scene: made });
        Ok(())
    })
}

/// Begins a step with the host's own loss: records the rendering of the image that `camera` sees.
/// Then, in this order and in this or later recordings, call splat4d_trainer_backward,
/// splat4d_trainer_update if the parameters are to be updated, and when the device is done
/// splat4d_trainer_conclude.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_forward(
    trainer: *mut splat4d_trainer,
    recorder: *mut splat4d_recorder,
    camera: *const splat4d_camera,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, .. } = exclusive("trainer", trainer)?;
        let recorder = &mut exclusive("recorder", recorder)?.recorder;
        *pass = Some(Step::Rendered(kind.scene()?.forward(recorder, &camera_of(camera)?, 0.0)?));
        Ok(())
    })
}

/// Gets the pixel buffers of the current step's image, for the host's own commands.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_get_pixels(
    trainer: *mut splat4d_trainer,
    pixels: *mut splat4d_pixels,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, .. } = exclusive("trainer", trainer)?;
        let pass = pass.as_ref().ok_or_else(|| out_of_turn("pixels"))?;
        write("pixels", pixels, pixels_of(pass.pixels(kind.scene()?)?))
    })
}

/// Records the computation of the gradients with respect to every parameter and the camera's pose,
/// given those of the host's loss with respect to the image: `by_rgba`, with respect to
/// premultiplied colour and alpha, 16 bytes per pixel; `by_depth`, 4 bytes per pixel, null if the
/// loss does not use the depth. Where buffers are too short, the step has ended without an update.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_backward(
    trainer: *mut splat4d_trainer,
    recorder: *mut splat4d_recorder,
    by_rgba: *const splat4d_buffer,
    by_depth: *const splat4d_buffer,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, .. } = exclusive("trainer", trainer)?;
        let recorder = &mut exclusive("recorder", recorder)?.recorder;
        let depth = match by_depth.is_null() {
            true => None,
            false => Some(shared("by_depth", by_depth)?.words.view_as()),
        };
        let rgba = shared("by_rgba", by_rgba)?.words.view_as();
        let Some(Step::Rendered(rendered)) = pass.take_if(|p| matches!(p, Step::Rendered(_)))
        else {
            return Err(out_of_turn("backward"));
        };
        let by = OwnGradients { rgba, depth };
        *pass = Some(Step::Differentiated(kind.scene()?.backward(recorder, rendered, by)?));
        Ok(())
    })
}

/// Records the update of every parameter with these gradients; the gradients of density control's
/// regularisers are added to them. A frame that exceeded the capacity changes nothing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_update(
    trainer: *mut splat4d_trainer,
    recorder: *mut splat4d_recorder,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, .. } = exclusive("trainer", trainer)?;
        let recorder = &mut exclusive("recorder", recorder)?.recorder;
        let found = pass.take_if(|p| matches!(p, Step::Differentiated(_)));
        let Some(Step::Differentiated(found)) = found else { return Err(out_of_turn("update")) };
        *pass = Some(Step::Updated(kind.scene()?.update(recorder, found)?));
        Ok(())
    })
}

/// Ends the step when the device is known to be done with the recorded work: after
/// splat4d_stream_wait for the submissions, or after the guards of the host's recordings are
/// destroyed. If called earlier, it returns SPLAT4D_ERROR_INPUT and the step stays open.
/// `fitted`, which may be null, gets 0 if the frame exceeded the capacity: no parameter was
/// updated, the capacity is larger now, and the step should be repeated.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_conclude(
    trainer: *mut splat4d_trainer,
    fitted: *mut u32,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, .. } = exclusive("trainer", trainer)?;
        let scene = kind.scene()?;
        // While the device has not finished, this fails, and the step stays open.
        pass.as_mut().ok_or_else(|| out_of_turn("conclude"))?.fits(scene)?;
        let whole = pass.take().expect("seen above").conclude(scene)?;
        if !fitted.is_null() {
            *exclusive("fitted", fitted)? = u32::from(whole);
        }
        Ok(())
    })
}

/// Gets the buffers of the gradients of the last backward, for the host's own commands. They are
/// valid as long as the trainer lives; that of the pose until the image's size changes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_get_gradients(
    trainer: *mut splat4d_trainer,
    gradients: *mut splat4d_gradients,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, .. } = exclusive("trainer", trainer)?;
        let scene = kind.scene()?;
        let g = scene.gradient_buffers();
        let none = splat4d_range { buffer: VkBuffer::null(), offset: 0, bytes: 0 };
        let mut value = splat4d_gradients {
            struct_size: 0,
            positions: range_of(&g.positions),
            log_scales: range_of(&g.log_scales),
            rotations: range_of(&g.rotations),
            opacity_logits: range_of(&g.opacity_logits),
            sh: [&g.sh[0], &g.sh[1], &g.sh[2], &g.sh[3]]
                .map(|band| if band.is_empty() { none } else { range_of(band) }),
            pose: none,
        };
        if let Some(pass) = pass
            && let Some(pose) = pass.pose(scene)?
        {
            value.pose = range_of(pose);
        }
        write("gradients", gradients, value)
    })
}

/// Reads the gradients of the last backward, which the device must have finished: with respect to
/// the parameters, and to the camera's pose (6 floats; SPLAT4D_ERROR_INPUT outside of a step).
/// Either may be null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_read_gradients(
    trainer: *mut splat4d_trainer,
    gradients: *mut splat4d_gaussians_out,
    pose: *mut f32,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let splat4d_trainer { kind, pass, stream, .. } = exclusive("trainer", trainer)?;
        let scene = kind.scene()?;
        if !gradients.is_null() {
            size_of_host("gradients", gradients)?;
            let count = scene.progress().gaussians;
            read_out(&scene.gradient_buffers().download_first(stream, count)?, gradients)?;
        }
        if !pose.is_null() {
            let pass = pass.as_ref().ok_or_else(|| out_of_turn("pose gradient"))?;
            let found = pass.pose(scene)?.ok_or_else(|| out_of_turn("pose gradient"))?;
            let found = stream.download(found)?;
            super::scene::copy_out("pose", &found, pose)?;
        }
        Ok(())
    })
}

/// Waits for the steps in flight, and destroys the handle; null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_trainer_destroy(trainer: *mut splat4d_trainer) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(trainer) };
}

fn settings_of(from: &splat4d_train_settings, gaussians: usize) -> Outcome<TrainSettings> {
    let mut to = TrainSettings::default();
    if from.steps != 0 {
        to.steps = from.steps;
    }
    if from.max_gaussians != 0 {
        to.max_gaussians = from.max_gaussians;
    }
    match from.growth {
        SPLAT4D_GROWTH_MCMC => {}
        SPLAT4D_GROWTH_ADAPTIVE => {
            to.growth = Some(GrowthSettings::Adaptive(AdaptiveSettings::scaled_to(to.steps)));
        }
        SPLAT4D_GROWTH_NONE => (to.growth, to.max_gaussians) = (None, gaussians),
        other => return Err(input(format!("settings.growth is {other}"))),
    }
    match from.sh_bands {
        0 => {}
        1..=4 => to.sh_degree = from.sh_bands - 1,
        bands => return Err(input(format!("settings.sh_bands is {bands}: 1 to 4"))),
    }
    if from.sh_interval != 0 {
        to.sh_interval = u32::try_from(from.sh_interval).unwrap_or(0);
    }
    let wide = |name: &str, value: f64, default: f64| match value {
        _ if !value.is_finite() => Err(input(format!("settings.{name} is {value}"))),
        0.0 => Ok(default),
        _ => Ok(value.max(0.0)),
    };
    let ssim = wide("ssim_share", from.ssim_share.into(), to.ssim_share.into())?;
    if ssim > 1.0 {
        return Err(input(format!("settings.ssim_share is {ssim}: 1 at most")));
    }
    if from.ssim_share != 0.0 {
        to.ssim_share = ssim as f32;
    }
    to.background = from.background;
    let rates = &mut to.rates;
    for (name, value, rate) in [
        ("position_rate", from.position_rate, &mut rates.position),
        ("position_rate_last", from.position_rate_last, &mut rates.position_last),
        ("log_scale_rate", from.log_scale_rate, &mut rates.log_scale),
        ("rotation_rate", from.rotation_rate, &mut rates.rotation),
        ("opacity_rate", from.opacity_rate, &mut rates.opacity),
        ("sh0_rate", from.sh0_rate, &mut rates.sh0),
        ("sh_rest_rate", from.sh_rest_rate, &mut rates.sh_rest),
    ] {
        *rate = wide(name, value, *rate)?;
    }
    to.seed = from.seed;
    Ok(to)
}

unsafe fn views_of(at: *const splat4d_view, count: usize) -> Outcome<Vec<TrainingView>> {
    // SAFETY: guaranteed by the host, throughout: each element begins with its size.
    unsafe {
        let apart = size_of_host("views", at)?;
        (0..count)
            .map(|i| {
                let at = at.byte_add(i * apart);
                if size_of_host("views", at)? != apart {
                    let message = format!("views[{i}]: struct_size differs from the first's");
                    return Err(fault(splat4d_result::SPLAT4D_ERROR_STRUCT_SIZE, message));
                }
                let view = read("views", at)?;
                let camera = camera_of(view.camera)?;
                let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
                let image = |what: &str, from: *const f32, channels: u32| -> Outcome<Image> {
                    let len = floats_of(&camera, channels as usize);
                    let pixels = array(what, from, len)?.to_vec();
                    Ok(Image { width, height, channels, pixels })
                };
                let weights = match view.weights.is_null() {
                    true => None,
                    false => Some(image("views.weights", view.weights, 1)?),
                };
                let image = image("views.rgb", view.rgb, 3)?;
                Ok(TrainingView {
                    camera,
                    time: 0.0,
                    image,
                    weights,
                    disparity: None,
                    mask: None,
                    every: 1,
                })
            })
            .collect()
    }
}
