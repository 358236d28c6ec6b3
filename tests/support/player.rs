//! An exported page in a browser, and the image that the renderer gives in its place.

use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::{Camera, Image};

use crate::browser::Browser;

/// Opens a page and waits until it has read its scene.
#[track_caller]
pub fn opened(page: &Path, width: u32, height: u32) -> Browser {
    let mut opened = Browser::open_drawing(page, width, height);
    opened.wait_for("globalThis.splat4d?.ready");
    opened.evaluate("splat4d.ready.then(() => true)");
    opened
}

fn as_json(camera: &Camera) -> Value {
    let (k, pose) = (&camera.intrinsics, &camera.view_from_world);
    let (q, t) = (pose.rotation, pose.translation);
    json!({
        "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": k.width, "height": k.height,
        "view_from_world": [q.w, q.x, q.y, q.z, t.x, t.y, t.z],
    })
}

/// The image from `splat4d.shot`; without a camera, from the page's camera.
#[track_caller]
pub fn shot(
    page: &mut Browser,
    camera: Option<&Camera>,
    time: f64,
    width: u32,
    height: u32,
) -> Image {
    let camera = camera.map_or(Value::Null, as_json);
    let told = page.evaluate(&format!(
        "splat4d.shot({camera}, {time}, {width}, {height}).then(({{ data }}) => {{ let text = ''; \
         for (let i = 0; i < data.length; i += 4) \
         text += String.fromCharCode(data[i], data[i + 1], data[i + 2]); return btoa(text); }})"
    ));
    let bytes = STANDARD.decode(told.as_str().unwrap()).unwrap();
    let pixels = bytes.into_iter().map(|v| f32::from(v) / 255.0).collect();
    Image { width, height, channels: 3, pixels }
}

/// The renderer's image, clamped to the range of a screen.
pub fn truth(renderer: &mut Renderer, scene: &Scene, camera: &Camera, time: f64) -> Image {
    let mut image = renderer.render(camera, time).unwrap().over(scene.background);
    image.pixels.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    image
}
