//! Scenes, Gaussians and cameras on the host.

use super::call::{
    Outcome, array, array_mut, call, claim, destroy, exclusive, give, grows, input, read, shape,
    shared, splat4d_result, text, write,
};
use crate::scene::Scene;
use crate::types::{Camera, Gaussians, Intrinsics, Pose, sh_coefficients};
use bytemuck::Pod;
use glam::{DQuat, DVec3};
use std::ffi::c_char;

/// A scene on the host.
pub struct splat4d_scene {
    pub(super) scene: Scene,
}

/// Gaussians of a static scene, one row of every array per Gaussian.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_gaussians {
    /// sizeof(splat4d_gaussians).
    pub struct_size: usize,
    /// Number of Gaussians.
    pub count: usize,
    /// Centres in the world: 3 per Gaussian.
    pub positions: *const f32,
    /// Natural logarithms of the standard deviations along the Gaussian's own axes: 3.
    pub log_scales: *const f32,
    /// world_from_gaussian quaternions w, x, y, z, which need not be normalised: 4.
    pub rotations: *const f32,
    /// Logits of the opacity: 1.
    pub opacity_logits: *const f32,
    /// Coefficients of the spherical harmonics, lowest band first, each red, green, blue:
    /// 3 * (sh_degree + 1)^2.
    pub sh: *const f32,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
}
grows!(splat4d_gaussians, sh_degree: u32);

/// Output arrays for Gaussians, laid out as in splat4d_gaussians. Null arrays are skipped.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_gaussians_out {
    /// sizeof(splat4d_gaussians_out).
    pub struct_size: usize,
    /// Capacity of the arrays, Gaussians.
    pub capacity: usize,
    /// 3 per Gaussian.
    pub positions: *mut f32,
    /// 3 per Gaussian.
    pub log_scales: *mut f32,
    /// 4 per Gaussian.
    pub rotations: *mut f32,
    /// 1 per Gaussian.
    pub opacity_logits: *mut f32,
    /// 3 * (sh_degree + 1)^2 per Gaussian.
    pub sh: *mut f32,
    /// The degree of `sh`; it must equal the degree of the Gaussians that are read.
    pub sh_degree: u32,
}
grows!(splat4d_gaussians_out, sh_degree: u32);

/// Properties of a scene.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_scene_info {
    /// sizeof(splat4d_scene_info).
    pub struct_size: usize,
    /// Number of Gaussians.
    pub count: usize,
    /// Degree of the spherical harmonics.
    pub sh_degree: u32,
    /// 1 if the scene is dynamic.
    pub is_dynamic: u32,
    /// Number of input cameras.
    pub camera_count: usize,
    /// Background colour: red, green, blue.
    pub background: [f32; 3],
}
grows!(splat4d_scene_info, background: [f32; 3]);

/// A pinhole camera. Axes: x right, y down, z forward; the first pixel's centre lies at (0.5, 0.5).
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_camera {
    /// sizeof(splat4d_camera).
    pub struct_size: usize,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels; 0 for fx.
    pub fy: f64,
    /// Principal point, x, from the left edge, pixels.
    pub cx: f64,
    /// Principal point, y, from the upper edge, pixels.
    pub cy: f64,
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
    /// view_from_world: a quaternion w, x, y, z, which need not be normalised; all 0 for no rotation.
    pub rotation: [f64; 4],
    /// view_from_world: x_view = rotation * x_world + translation.
    pub translation: [f64; 3],
}
grows!(splat4d_camera, translation: [f64; 3]);

/// Creates a static scene from Gaussians, which are copied. `scene` gets a handle, to be destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_create(
    gaussians: *const splat4d_gaussians,
    scene: *mut *mut splat4d_scene,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("scene", scene)?;
        give(scene, splat4d_scene { scene: Scene::of(gaussians_of(gaussians)?) });
        Ok(())
    })
}

/// Opens a scene file or a 3DGS PLY. If `drop_bad` is not 0, Gaussians that are not finite are left
/// out; otherwise they are an error. `scene` gets a handle, to be destroyed.
/// SPLAT4D_ERROR_UNSUPPORTED if the library was built without the feature `files`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_open(
    path: *const c_char,
    drop_bad: u32,
    scene: *mut *mut splat4d_scene,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("scene", scene)?;
        give(scene, splat4d_scene { scene: open(text("path", path)?, drop_bad != 0)? });
        Ok(())
    })
}

/// Writes a scene file, atomically by rename. SPLAT4D_ERROR_UNSUPPORTED if the library was built
/// without the feature `files`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_save(
    scene: *const splat4d_scene,
    path: *const c_char,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe { save(&shared("scene", scene)?.scene, text("path", path)?) })
}

/// Gets the properties of a scene.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_get_info(
    scene: *const splat4d_scene,
    info: *mut splat4d_scene_info,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let scene = &shared("scene", scene)?.scene;
        let value = splat4d_scene_info {
            struct_size: 0,
            count: scene.gaussians.len(),
            sh_degree: scene.gaussians.sh_degree,
            is_dynamic: u32::from(scene.moves()),
            camera_count: scene.cameras.len(),
            background: scene.background,
        };
        write("info", info, value)
    })
}

/// Gets an input camera of the scene, and its time in [0, 1]. `time` may be null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_get_camera(
    scene: *const splat4d_scene,
    index: usize,
    camera: *mut splat4d_camera,
    time: *mut f64,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let cameras = &shared("scene", scene)?.scene.cameras;
        let found = cameras.get(index);
        let found = found
            .ok_or_else(|| input(format!("camera {index}: the scene has {}", cameras.len())))?;
        let (k, pose) = (found.camera.intrinsics, found.camera.view_from_world);
        let value = splat4d_camera {
            struct_size: 0,
            fx: k.fx,
            fy: k.fy,
            cx: k.cx,
            cy: k.cy,
            width: k.width,
            height: k.height,
            rotation: [pose.rotation.w, pose.rotation.x, pose.rotation.y, pose.rotation.z],
            translation: pose.translation.to_array(),
        };
        write("camera", camera, value)?;
        if !time.is_null() {
            *exclusive("time", time)? = found.time;
        }
        Ok(())
    })
}

/// Reads a scene's Gaussians; those of a dynamic scene are in the canonical frame.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_read(
    scene: *const splat4d_scene,
    gaussians: *mut splat4d_gaussians_out,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe { read_out(&shared("scene", scene)?.scene.gaussians, gaussians) })
}

/// Destroys the handle; null is allowed. Renderers and trainers made from the scene have copies.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_scene_destroy(scene: *mut splat4d_scene) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(scene) };
}

#[cfg(feature = "files")]
fn open(path: &str, drop_bad: bool) -> Outcome<Scene> {
    Ok(Scene::open(path, drop_bad)?.scene)
}

#[cfg(feature = "files")]
fn save(scene: &Scene, path: &str) -> Outcome {
    Ok(scene.save(path)?)
}

#[cfg(not(feature = "files"))]
fn open(path: &str, _: bool) -> Outcome<Scene> {
    Err(no_files(path))
}

#[cfg(not(feature = "files"))]
fn save(_: &Scene, path: &str) -> Outcome {
    Err(no_files(path))
}

#[cfg(not(feature = "files"))]
fn no_files(path: &str) -> super::call::Fault {
    let message = format!("{path}: this library was built without the feature `files`");
    super::call::fault(splat4d_result::SPLAT4D_ERROR_UNSUPPORTED, message)
}

/// Copies a host's Gaussians.
pub(super) unsafe fn gaussians_of(from: *const splat4d_gaussians) -> Outcome<Gaussians> {
    // SAFETY: guaranteed by the host.
    unsafe {
        let g = read("gaussians", from)?;
        if g.sh_degree > 3 {
            return Err(input(format!("gaussians.sh_degree is {}: 3 at most", g.sh_degree)));
        }
        let n = g.count;
        let coefficients = n.checked_mul(sh_coefficients(g.sh_degree));
        let coefficients = coefficients
            .ok_or_else(|| shape(format!("gaussians.count is {n}: more than memory")))?;
        Ok(Gaussians {
            positions: rows("gaussians.positions", g.positions, n)?,
            log_scales: rows("gaussians.log_scales", g.log_scales, n)?,
            rotations: rows("gaussians.rotations", g.rotations, n)?,
            opacity_logits: array("gaussians.opacity_logits", g.opacity_logits, n)?.to_vec(),
            sh_degree: g.sh_degree,
            sh: rows("gaussians.sh", g.sh, coefficients)?,
            motion_logits: Vec::new(),
        })
    }
}

unsafe fn rows<const N: usize>(what: &str, at: *const f32, len: usize) -> Outcome<Vec<[f32; N]>> {
    // SAFETY: guaranteed by the host; an array has the alignment of its elements.
    Ok(unsafe { array(what, at.cast::<[f32; N]>(), len) }?.to_vec())
}

/// Copies Gaussians to a host's arrays.
pub(super) unsafe fn read_out(from: &Gaussians, to: *mut splat4d_gaussians_out) -> Outcome {
    // SAFETY: guaranteed by the host, here and below.
    let to = unsafe { read("gaussians", to.cast_const()) }?;
    if to.capacity < from.len() {
        let (room, count) = (to.capacity, from.len());
        return Err(shape(format!("gaussians.capacity is {room}: there are {count}")));
    }
    if !to.sh.is_null() && to.sh_degree != from.sh_degree {
        let (given, degree) = (to.sh_degree, from.sh_degree);
        return Err(shape(format!("gaussians.sh_degree is {given}: the degree is {degree}")));
    }
    // SAFETY: as above.
    unsafe {
        copy_out("gaussians.positions", from.positions.as_flattened(), to.positions)?;
        copy_out("gaussians.log_scales", from.log_scales.as_flattened(), to.log_scales)?;
        copy_out("gaussians.rotations", from.rotations.as_flattened(), to.rotations)?;
        copy_out("gaussians.opacity_logits", &from.opacity_logits, to.opacity_logits)?;
        copy_out("gaussians.sh", from.sh.as_flattened(), to.sh)
    }
}

/// Copies to a host's array unless it is null; the host guarantees that it is long enough.
pub(super) unsafe fn copy_out<T: Pod>(what: &str, from: &[T], to: *mut T) -> Outcome {
    if !to.is_null() {
        // SAFETY: guaranteed by the host.
        unsafe { array_mut(what, to, from.len()) }?.copy_from_slice(from);
    }
    Ok(())
}

/// A host's camera.
pub(super) unsafe fn camera_of(from: *const splat4d_camera) -> Outcome<Camera> {
    // SAFETY: guaranteed by the host.
    let c = unsafe { read("camera", from) }?;
    let fy = if c.fy == 0.0 { c.fx } else { c.fy };
    let positive = |f: f64| f.is_finite() && f > 0.0;
    if !(positive(c.fx) && positive(fy) && c.cx.is_finite() && c.cy.is_finite()) {
        let (fx, cx, cy) = (c.fx, c.cx, c.cy);
        let message = format!("camera: fx {fx}, fy {fy}, cx {cx}, cy {cy} make no camera");
        return Err(input(message));
    }
    if c.width == 0 || c.height == 0 {
        let (width, height) = (c.width, c.height);
        return Err(input(format!("camera: an image of {width} x {height} pixels")));
    }
    let [w, x, y, z] = c.rotation;
    let rotation = match c.rotation == [0.0; 4] {
        true => DQuat::IDENTITY,
        false => DQuat::from_xyzw(x, y, z, w),
    };
    let (length, translation) = (rotation.length(), DVec3::from_array(c.translation));
    if !(length.is_finite() && length > 1e-6 && translation.is_finite()) {
        return Err(input("camera: rotation and translation make no pose"));
    }
    // Normalising a unit quaternion again would change its last bits.
    let unit = (length - 1.0).abs() < 1e-12;
    let rotation = if unit { rotation } else { rotation.normalize() };
    Ok(Camera {
        intrinsics: Intrinsics {
            fx: c.fx,
            fy,
            cx: c.cx,
            cy: c.cy,
            width: c.width,
            height: c.height,
        },
        view_from_world: Pose { rotation, translation },
    })
}

/// Number of floats in an image of a camera, with `channels` floats per pixel.
pub(super) fn floats_of(camera: &Camera, channels: usize) -> usize {
    let Intrinsics { width, height, .. } = camera.intrinsics;
    // Saturates: such a number exceeds any memory.
    (width as usize).saturating_mul(height as usize).saturating_mul(channels)
}

pub(super) fn time_of(time: f64) -> Outcome<f64> {
    match time.is_finite() {
        true => Ok(time),
        false => Err(input(format!("time is {time}"))),
    }
}
