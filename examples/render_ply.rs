//! Renders a 3DGS PLY (or any scene file that the engine reads) from one camera into a PNG.
//!
//! ```sh
//! cargo run --release --example render_ply -- scene.ply view.png
//! ```
//!
//! The camera looks along +z (OpenCV axes: x right, y down, z forward) at the middle of the scene, from
//! a distance at which all of it is in view.

use splat4d::data::write_png;
use splat4d::gpu::{Device, Request};
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::{Camera, Intrinsics, Pose};

fn main() -> splat4d::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let (Some(input), Some(output)) = (arguments.next(), arguments.next()) else {
        return Err(splat4d::Error::Input("usage: render_ply SCENE IMAGE.png".into()));
    };
    // `true`: Gaussians with NaN or infinite values are left out and counted.
    let opened = Scene::open(&input, true)?;
    println!("{} Gaussians, {} left out", opened.scene.gaussians.len(), opened.dropped);

    let device = Device::open(&Request::default())?;
    println!("device: {}", device.info().name);
    let mut renderer = Renderer::new(&device, &opened.scene)?;
    let image = renderer.render(&camera_for(&opened.scene), 0.0)?;
    write_png(&output, &image.over(opened.scene.background))
}

/// The input's first camera where the scene has cameras; else one that sees the middle 90 % of the Gaussians.
fn camera_for(scene: &Scene) -> Camera {
    if let Some(first) = scene.cameras.first() {
        return first.camera;
    }
    let range = |axis: usize| {
        let mut values: Vec<f32> = scene.gaussians.positions.iter().map(|p| p[axis]).collect();
        values.sort_by(f32::total_cmp);
        let at = |share: f64| f64::from(values[(share * (values.len() - 1) as f64) as usize]);
        (at(0.05), at(0.95))
    };
    let [x, y, z] = [range(0), range(1), range(2)];
    let (width, height, focal) = (960, 540, 800.0);
    let radius = 0.5 * (x.1 - x.0).hypot(y.1 - y.0).hypot(z.1 - z.0);
    let distance = radius * focal / (0.5 * f64::from(height)) + radius;
    let middle = |(low, high): (f64, f64)| 0.5 * (low + high);
    let translation = glam::dvec3(-middle(x), -middle(y), distance - middle(z));
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera {
        intrinsics: Intrinsics { fx: focal, fy: focal, cx, cy, width, height },
        view_from_world: Pose { translation, ..Pose::IDENTITY },
    }
}
