//! The scale of a scene with a static camera. Its poses do not determine the scale. Where no depth is
//! known, images of other cameras do: the parallax in them is their distance over the depth.

use splat4d::Result;
use splat4d::data::{Resize, View};
use splat4d::geometry::sim3::Sim3;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::{Camera, Image};

use super::common::say;
use super::interrupt;

/// Range of the searched ratio of another camera's distance to the scene depth: below it, parallax is
/// invisible; above it, the views hardly overlap.
const RATIOS: (f64, f64) = (0.003, 3.0);
/// Number of ratios in the first round; neighbours differ by a fifth.
const GRID: usize = 38;
/// Number of golden-section refinements of the interval between neighbours: to a relative precision of
/// about a thousandth.
const REFINEMENTS: usize = 12;

/// An image of another camera.
pub struct Sight {
    /// The downscaled image, with its camera in the ground truth's frame.
    pub view: View,
    /// Time in the scene.
    pub time: f64,
    /// Distance of the camera from the static one, in the ground truth's unit.
    pub aside: f64,
}

impl Sight {
    /// Maximum size of the compared images: one parameter needs no fine detail, and coarse images have a
    /// wider basin of convergence.
    pub const SIZE: Resize = Resize::Longest(320);
    /// Maximum number of images; more are not needed for one parameter.
    pub const MOST: usize = 12;
}

/// The scale with the least squared error over all images; `scaled` gives the alignment at a scale. `None`
/// where it is undetermined: no other camera has an offset, or the scene is empty.
pub fn by_pictures(
    renderer: &mut Renderer,
    scene: &Scene,
    sights: &[Sight],
    scaled: &dyn Fn(f64) -> Sim3,
) -> Result<Option<f64>> {
    let Some(own) = scene.cameras.get(scene.cameras.len() / 2) else { return Ok(None) };
    let depth = renderer.render(&own.camera, own.time)?.mean_depth();
    let depth = median(depth.pixels.iter().map(|d| f64::from(*d)).filter(|d| *d > 0.0));
    let aside = median(sights.iter().map(|sight| sight.aside).filter(|aside| *aside > 0.0));
    let Some((depth, aside)) = depth.zip(aside) else { return Ok(None) };
    say(
        "note: the camera stood still; the scale is the one at which the scene looks most like held-out images",
    );
    let scale = |ratio: f64| aside / (ratio * depth);
    let error = |ratio: f64| -> Result<f64> {
        interrupt::check()?;
        let scene_from_truth = scaled(scale(ratio)).inverse();
        let mut sum = 0.0;
        for Sight { view, time, .. } in sights {
            let place = scene_from_truth.apply_pose(&view.camera.view_from_world.inverse());
            let camera = Camera { view_from_world: place.inverse(), ..view.camera };
            let picture = renderer.render(&camera, *time)?.over(scene.background);
            sum += squared_error(&picture, &view.image);
        }
        Ok(sum)
    };
    Ok(Some(scale(least(RATIOS, GRID, error)?)))
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Mean squared difference.
fn squared_error(a: &Image, b: &Image) -> f64 {
    let pairs = a.pixels.iter().zip(&b.pixels);
    let sum: f64 = pairs.map(|(x, y)| f64::from(x.clamp(0.0, 1.0) - y).powi(2)).sum();
    sum / a.pixels.len() as f64
}

/// Minimises a function of a positive number between two bounds: the best point of a logarithmic grid,
/// refined by golden-section search between its neighbours.
fn least(
    (low, high): (f64, f64),
    grid: usize,
    mut of: impl FnMut(f64) -> Result<f64>,
) -> Result<f64> {
    let step = (high / low).ln() / (grid - 1) as f64;
    let at = |k: f64| low * (k * step).exp();
    let mut best = (0.0, f64::INFINITY);
    for k in 0..grid {
        let value = of(at(k as f64))?;
        if value < best.1 {
            best = (k as f64, value);
        }
    }
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    let (mut a, mut b) = ((best.0 - 1.0).max(0.0), (best.0 + 1.0).min((grid - 1) as f64));
    let (mut x, mut y) = (b - golden * (b - a), a + golden * (b - a));
    let (mut of_x, mut of_y) = (of(at(x))?, of(at(y))?);
    for _ in 0..REFINEMENTS {
        if of_x < of_y {
            (b, y, of_y) = (y, x, of_x);
            x = b - golden * (b - a);
            of_x = of(at(x))?;
        } else {
            (a, x, of_x) = (x, y, of_y);
            y = a + golden * (b - a);
            of_y = of(at(y))?;
        }
    }
    Ok(at((a + b) / 2.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_of_several_valleys_is_found() {
        // A shallow minimum at 0.01, a deep one at 0.5.
        let valley = |x: f64, at: f64, depth: f64| -depth * (-(x / at).ln().powi(2) / 0.1).exp();
        let of = |x: f64| Ok(valley(x, 0.01, 1.0) + valley(x, 0.5, 2.0));
        let found = least(RATIOS, GRID, of).unwrap();
        assert!((found / 0.5 - 1.0).abs() < 1e-3, "{found}");
        // A minimum at a bound.
        let end = least(RATIOS, GRID, Ok).unwrap();
        assert!((end / RATIOS.0 - 1.0).abs() < 1e-2, "{end}");
        assert!(least(RATIOS, GRID, |_| Err(splat4d::Error::Failed("no".into()))).is_err());
    }
}
