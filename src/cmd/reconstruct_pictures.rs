//! Images for the page of `reconstruct`: frames beside the scene's renders, and an orbit.

use rayon::prelude::*;
use splat4d::Result;
use splat4d::camera_path::{CameraPath, PathShape};
use splat4d::data::View;
use splat4d::gpu::Device;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::Image;

use super::interrupt;
use super::pictures::{DepthScale, address, brightest, grey, heat, shrunk};
use super::player::Lane;

/// Maximum number of frames shown.
const MOST: usize = 24;
/// Number of images of an orbit.
const ORBIT: usize = 24;
/// Maximum width of an image of the strip, pixels.
const WIDEST: u32 = 320;
/// Maximum width of an image of the orbit, pixels.
const ORBIT_WIDEST: u32 = 480;

/// Images on the page.
pub struct Pictures {
    /// Indices of the frames.
    pub frames: Vec<usize>,
    /// Input, render, error, movers, depth; each lane has one image per frame.
    pub lanes: Vec<Lane>,
    /// The error of the brightest colour.
    pub most_error: f64,
    /// Novel views.
    pub orbit: Lane,
}

/// Renders and encodes all images.
///
/// # Errors
/// A failed submission; an image cannot be encoded.
pub fn draw(device: &Device, scene: &Scene, views: &[View]) -> Result<Pictures> {
    let count = views.len().min(MOST);
    let mut frames: Vec<usize> =
        (0..count).map(|i| i * (views.len() - 1) / (count - 1).max(1)).collect();
    frames.dedup();
    let mut renderer = Renderer::new(device, scene)?;
    let (mut inputs, mut renders, mut moving) = (Vec::new(), Vec::new(), Vec::new());
    let (mut errors, mut depths) = (Vec::new(), Vec::new());
    for view in frames.iter().map(|&frame| &views[frame]) {
        interrupt::check()?;
        let rendered = renderer.render(&view.camera, view.time)?;
        let render = rendered.over(scene.background);
        errors.push(shrunk(&difference(&render, &view.image), WIDEST));
        inputs.push(shrunk(&view.image, WIDEST));
        renders.push(shrunk(&render, WIDEST));
        moving.push(shrunk(&grey(&renderer.moving()?), WIDEST));
        depths.push(shrunk(&rendered.mean_depth(), WIDEST));
    }
    let most_error = brightest(errors.iter(), 0.02);
    let scale = DepthScale::of(&depths);
    let errors: Vec<Image> = errors.iter().map(|error| heat(error, most_error)).collect();
    let black = |map: &Image| Image::new(map.width, map.height, 3);
    let shade = |map: &Image| scale.map_or_else(|| black(map), |scale| scale.shade(map));
    let depths: Vec<Image> = depths.iter().map(shade).collect();
    let lanes = [
        ("Input", inputs),
        ("Render", renders),
        ("Error", errors),
        ("What moves", moving),
        ("Depth, near is bright", depths),
    ];
    let lanes = lanes.map(|(title, pictures)| lane(title, &pictures));
    let orbit = lane("Views that the input did not have", &orbit(&mut renderer, scene)?)?;
    Ok(Pictures { frames, lanes: lanes.into_iter().collect::<Result<_>>()?, most_error, orbit })
}

fn orbit(renderer: &mut Renderer, scene: &Scene) -> Result<Vec<Image>> {
    let orbit = CameraPath::new(scene, PathShape::Orbit, ORBIT);
    let mut pictures = Vec::with_capacity(orbit.len());
    for i in 0..orbit.len() {
        interrupt::check()?;
        let mut shot = orbit.at(i);
        let k = &mut shot.camera.intrinsics;
        if k.width > ORBIT_WIDEST {
            let height =
                (u64::from(k.height) * u64::from(ORBIT_WIDEST) / u64::from(k.width)).max(1);
            *k = k.fitted(ORBIT_WIDEST, height as u32);
        }
        pictures.push(renderer.render(&shot.camera, shot.time)?.over(scene.background));
    }
    Ok(pictures)
}

fn lane(title: &str, pictures: &[Image]) -> Result<Lane> {
    let pictures = pictures.par_iter().map(address).collect::<Result<Vec<String>>>()?;
    Ok(Lane { title: title.into(), pictures })
}

/// Mean absolute difference of the channels, per pixel.
fn difference(a: &Image, b: &Image) -> Image {
    let pairs = a.pixels.chunks_exact(3).zip(b.pixels.chunks_exact(3));
    let mean = |(a, b): (&[f32], &[f32])| {
        a.iter().zip(b).map(|(a, b)| (a.clamp(0.0, 1.0) - b).abs()).sum::<f32>() / 3.0
    };
    Image { width: a.width, height: a.height, channels: 1, pixels: pairs.map(mean).collect() }
}

/// Peak host memory of the page's images for a clip of frames of a size, bytes.
pub fn bytes(frames: usize, (width, height): (u32, u32)) -> u64 {
    let shown = |widest: u32| {
        let w = u64::from(width.min(widest));
        w * (u64::from(height) * w / u64::from(width.max(1)))
    };
    // Five lanes with three floats per pixel, and one with one; the encoded text of an image is smaller.
    frames.min(MOST) as u64 * shown(WIDEST) * 80 + ORBIT as u64 * shown(ORBIT_WIDEST) * 16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_is_the_mean_over_channels() {
        let image =
            |pixels: [f32; 3]| Image { width: 1, height: 1, channels: 3, pixels: pixels.into() };
        let error = difference(&image([0.5, 1.4, 0.0]), &image([0.2, 1.0, 0.3]));
        assert!((error.pixels[0] - 0.2).abs() < 1e-6, "{error:?}");
        assert!(bytes(500, (1920, 1080)) < 256 << 20);
    }
}
