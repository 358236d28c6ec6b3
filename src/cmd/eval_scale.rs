//! The scale of a scene whose camera stood still. Its poses do not tell it, and where no depth is known, pictures
//! of other cameras do: how far these see things shifted is their distance over the depth.

use splat4d::Result;
use splat4d::data::{Resize, View};
use splat4d::geometry::sim3::Sim3;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::{Camera, Image};

use super::common::say;
use super::interrupt;

/// Distances of other cameras over the depth of what they see, between which a scale is looked for: below, nothing
/// is seen to shift; beyond, little of the same is seen.
const RATIOS: (f64, f64) = (0.003, 3.0);
/// Ratios of the first round: neighbours differ by a fifth.
const GRID: usize = 38;
/// Halvings, about, of the interval between neighbours: a scale within a thousandth.
const REFINEMENTS: usize = 12;

/// A picture of another camera.
pub struct Sight {
    /// The picture, small, with its camera in the truth's frame.
    pub view: View,
    /// The scene's time.
    pub time: f64,
    /// The camera's distance from the one that stood still, in the truth's unit.
    pub aside: f64,
}

impl Sight {
    /// Pictures are compared at most at this size: one number needs no fine detail, and coarse pictures lead to it
    /// from farther away.
    pub const SIZE: Resize = Resize::Longest(320);
    /// As many are enough for one number.
    pub const MOST: usize = 12;
}

/// The scale of the least squared error over all pictures, `scaled` being the alignment of a scale; `None` where
/// nothing tells it: no other camera stands aside, or the scene shows nothing.
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
        "note: the camera stood still; the scale is the one at which the scene looks most like held-out pictures",
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

/// Where a function of a positive number is least between two: the best of a logarithmic grid, refined by the
/// golden section between its neighbours.
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
        // A shallow valley at 0.01, a deep one at 0.5.
        let valley = |x: f64, at: f64, depth: f64| -depth * (-(x / at).ln().powi(2) / 0.1).exp();
        let of = |x: f64| Ok(valley(x, 0.01, 1.0) + valley(x, 0.5, 2.0));
        let found = least(RATIOS, GRID, of).unwrap();
        assert!((found / 0.5 - 1.0).abs() < 1e-3, "{found}");
        // At an end, too.
        let end = least(RATIOS, GRID, Ok).unwrap();
        assert!((end / RATIOS.0 - 1.0).abs() < 1e-2, "{end}");
        assert!(least(RATIOS, GRID, |_| Err(splat4d::Error::Failed("no".into()))).is_err());
    }
}
