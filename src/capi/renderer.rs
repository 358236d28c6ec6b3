//! The renderer of the C interface.

use super::call::{
    call, claim, destroy, exclusive, give, grows, input, read, read_or_zero, shape, shared,
    splat4d_result, take, write,
};
use super::device::{device_of, splat4d_device};
use super::memory::{check_apart, range_of, splat4d_buffer, splat4d_range};
use super::record::splat4d_recorder;
use super::scene::{camera_of, copy_out, floats_of, splat4d_camera, splat4d_scene, time_of};
use crate::ops::render::PixelBuffers;
use crate::renderer::{Frame, Renderer, Target};

/// A renderer of one scene on a device. Successive images of the same size cost no allocation.
pub struct splat4d_renderer {
    renderer: Renderer,
}

/// A recorded frame.
pub struct splat4d_frame {
    frame: Frame,
}

/// Output arrays for an image in the host's memory. Null arrays are skipped.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_picture {
    /// sizeof(splat4d_picture).
    pub struct_size: usize,
    /// Premultiplied red, green, blue without background, and alpha: 4 * width * height.
    pub rgba: *mut f32,
    /// Capacity of `rgba`, floats.
    pub rgba_len: usize,
    /// Sum of alpha * T * z: width * height. The mean depth is this divided by alpha.
    pub depth: *mut f32,
    /// Capacity of `depth`, floats.
    pub depth_len: usize,
}
grows!(splat4d_picture, depth_len: usize);

/// The output buffers of a frame: buffers of the device, adopted ones included. An output that is
/// null goes to the renderer's own pixels.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_target {
    /// sizeof(splat4d_target).
    pub struct_size: usize,
    /// As in splat4d_picture: 16 bytes a pixel.
    pub rgba: *mut splat4d_buffer,
    /// As in splat4d_picture: 4 bytes a pixel.
    pub depth: *mut splat4d_buffer,
    /// The motion mask, 16 bytes per pixel: red is the part of alpha that comes from dynamic
    /// Gaussians, green and blue are 0, alpha is that of `rgba`. It costs a second blending pass.
    pub mask: *mut splat4d_buffer,
}
grows!(splat4d_target, mask: *mut splat4d_buffer);

/// The result of a frame that the device has rendered.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_drawn {
    /// sizeof(splat4d_drawn).
    pub struct_size: usize,
    /// 1 if every splat was rendered. Otherwise the farthest were left out, and the next frame has
    /// more capacity.
    pub is_whole: u32,
    /// Gaussians that were visible.
    pub visible: usize,
    /// Number of (splat, tile) pairs; 2³² − 1 stands for that many or more.
    pub intersections: usize,
}
grows!(splat4d_drawn, intersections: usize);

/// An image on the device, in buffers of the engine.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct splat4d_pixels {
    /// sizeof(splat4d_pixels).
    pub struct_size: usize,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// As in splat4d_picture.
    pub rgba: splat4d_range,
    /// As in splat4d_picture.
    pub depth: splat4d_range,
}
grows!(splat4d_pixels, depth: splat4d_range);

/// Uploads a scene to a device. `renderer` gets a handle, to be destroyed. The scene may be
/// destroyed afterwards.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_renderer_create(
    device: *const splat4d_device,
    scene: *const splat4d_scene,
    renderer: *mut *mut splat4d_renderer,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("renderer", renderer)?;
        let scene = &shared("scene", scene)?.scene;
        let made = Renderer::new(device_of(device)?, scene)?;
        give(renderer, splat4d_renderer { renderer: made });
        Ok(())
    })
}

/// Renders the scene as `camera` sees it at `time` in [0, 1], waits, and fills `picture`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_renderer_render(
    renderer: *mut splat4d_renderer,
    camera: *const splat4d_camera,
    time: f64,
    picture: *const splat4d_picture,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let renderer = &mut exclusive("renderer", renderer)?.renderer;
        let (camera, time) = (camera_of(camera)?, time_of(time)?);
        let picture = read("picture", picture)?;
        for (what, at, len, channels) in [
            ("rgba", picture.rgba, picture.rgba_len, 4),
            ("depth", picture.depth, picture.depth_len, 1),
        ] {
            let needed = floats_of(&camera, channels);
            if !at.is_null() && len < needed {
                let message = format!("picture.{what} has room for {len}: it takes {needed}");
                return Err(shape(message));
            }
        }
        let rendered = renderer.render(&camera, time)?;
        copy_out("picture.rgba", &rendered.rgba.pixels, picture.rgba)?;
        copy_out("picture.depth", &rendered.depth.pixels, picture.depth)
    })
}

/// Records a frame. `target` may be null for the renderer's own pixels. `frame` gets a handle, to
/// be retired or destroyed when the device is done with the frame. Successive frames of the same
/// size allocate nothing on the device, if each is retired.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_renderer_record(
    renderer: *mut splat4d_renderer,
    recorder: *mut splat4d_recorder,
    camera: *const splat4d_camera,
    time: f64,
    target: *const splat4d_target,
    frame: *mut *mut splat4d_frame,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        claim("frame", frame)?;
        let renderer = &mut exclusive("renderer", renderer)?.renderer;
        let recorder = &mut exclusive("recorder", recorder)?.recorder;
        let (camera, time) = (camera_of(camera)?, time_of(time)?);
        let t = read_or_zero("target", target)?;
        let writes = [("rgba", t.rgba), ("depth", t.depth), ("mask", t.mask)];
        check_apart("target", &[], &writes)?;
        let buffer = |what: &str, at: *mut splat4d_buffer| {
            (!at.is_null()).then(|| exclusive(what, at)).transpose()
        };
        let target = Target {
            rgba: buffer("rgba", t.rgba)?.map(|b| b.words.view_mut_as()),
            depth: buffer("depth", t.depth)?.map(|b| b.words.view_mut_as()),
            mask: buffer("mask", t.mask)?.map(|b| b.words.view_mut_as()),
        };
        let recorded = renderer.record(recorder, &camera, time, target)?;
        give(frame, splat4d_frame { frame: recorded });
        Ok(())
    })
}

/// Retires a frame that the device is known to be done with: after splat4d_stream_wait for its
/// submission, or after the guard of the host's recording is destroyed; SPLAT4D_ERROR_INPUT if
/// called earlier. The frame is invalid afterwards, also if the call fails. `drawn` may be null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_renderer_retire(
    renderer: *mut splat4d_renderer,
    frame: *mut splat4d_frame,
    drawn: *mut splat4d_drawn,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let frame = take("frame", frame)?.frame;
        let found = exclusive("renderer", renderer)?.renderer.retire(frame)?;
        if drawn.is_null() {
            return Ok(());
        }
        let value = splat4d_drawn {
            struct_size: 0,
            is_whole: u32::from(found.is_whole()),
            visible: found.counts.visible,
            intersections: found.counts.intersections,
        };
        write("drawn", drawn, value)
    })
}

/// Gets the renderer's own pixels, for the host's own commands: the outputs of the last recorded
/// frame that had no target. They are valid until the next frame, or until the renderer is
/// destroyed. SPLAT4D_ERROR_INPUT before the first frame.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_renderer_get_pixels(
    renderer: *const splat4d_renderer,
    pixels: *mut splat4d_pixels,
) -> splat4d_result {
    // SAFETY: guaranteed by the host.
    call(|| unsafe {
        let found = shared("renderer", renderer)?.renderer.pixels();
        let found = found.ok_or_else(|| input("no frame has been recorded"))?;
        write("pixels", pixels, pixels_of(found))
    })
}

/// Destroys a frame that will not be retired; null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_frame_destroy(frame: *mut splat4d_frame) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(frame) };
}

/// Destroys the handle; null is allowed. Recorded work keeps the resources that it needs.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn splat4d_renderer_destroy(renderer: *mut splat4d_renderer) {
    // SAFETY: guaranteed by the host.
    unsafe { destroy(renderer) };
}

pub(super) fn pixels_of(pixels: &PixelBuffers) -> splat4d_pixels {
    splat4d_pixels {
        struct_size: 0,
        width: pixels.width,
        height: pixels.height,
        rgba: range_of(&pixels.rgba),
        depth: range_of(&pixels.depth),
    }
}
