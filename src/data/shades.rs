//! Colour-coded flow and normals for display.

use crate::types::Image;

/// Colour of unknown values.
pub const UNKNOWN: [f32; 3] = [0.5; 3];

/// Normals as colours: right is red, down is green, away from the camera is blue, each from -1 to 1;
/// unknown normals are black.
pub fn normals(map: &Image) -> Image {
    let mut image = map.clone();
    for normal in image.pixels.chunks_exact_mut(3).filter(|n| n.iter().any(|v| *v != 0.0)) {
        normal.iter_mut().for_each(|v| *v = 0.5 + 0.5 * *v);
    }
    image
}

/// Flow as colours: the direction as hue (right is red), the length as saturation up to `most` pixels;
/// static pixels are white, unknown ones grey.
pub fn flow(map: &Image, most: f64) -> Image {
    let mut image = Image::new(map.width, map.height, 3);
    for (out, v) in image.pixels.chunks_exact_mut(3).zip(map.pixels.chunks_exact(2)) {
        let length = v[0].hypot(v[1]);
        if length.is_nan() {
            out.copy_from_slice(&UNKNOWN);
            continue;
        }
        let turn = v[1].atan2(v[0]) / std::f32::consts::TAU;
        let share = (length / most as f32).min(1.0);
        for (out, shift) in out.iter_mut().zip([0.0, 4.0, 2.0]) {
            let hue = ((6.0 * turn + shift).rem_euclid(6.0) - 3.0).abs() - 1.0;
            *out = 1.0 - share * (1.0 - hue.clamp(0.0, 1.0));
        }
    }
    image
}

/// Lengths of flow vectors, one channel.
pub fn lengths(flow: &Image) -> Image {
    let pixels = flow.pixels.chunks_exact(2).map(|v| v[0].hypot(v[1])).collect();
    Image { channels: 1, pixels, ..*flow }
}

/// A round number above nearly all values, at least `least`.
pub fn brightest<'a>(maps: impl Iterator<Item = &'a Image>, least: f64) -> f64 {
    let mut all: Vec<f32> = maps
        .flat_map(|image| image.pixels.iter().copied().step_by(7).filter(|v| v.is_finite()))
        .collect();
    let at = all.len().saturating_sub(1) * 99 / 100;
    let most = match all.is_empty() {
        true => least,
        false => f64::from(*all.select_nth_unstable_by(at, f32::total_cmp).1).max(least),
    };
    let power = 10f64.powf(most.log10().floor());
    [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|m| *m >= most).unwrap_or(most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flow_has_the_colour_of_its_direction() {
        let pixels = vec![0.0, 0.0, 4.0, 0.0, -9.0, 0.0, f32::NAN, 1.0, 0.0, 2.0];
        let drawn = flow(&Image { width: 5, height: 1, channels: 2, pixels }, 4.0);
        assert_eq!(drawn.at(0, 0), [1.0; 3]);
        assert_eq!(drawn.at(1, 0), [1.0, 0.0, 0.0]);
        assert_eq!(drawn.at(2, 0), [0.0, 1.0, 1.0]);
        assert_eq!(drawn.at(3, 0), UNKNOWN);
        // Downwards, half of the largest displayed length.
        let down = drawn.at(4, 0);
        assert!(down[1] == 1.0 && down[0] > 0.5 && down[0] < 1.0 && down[2] == 0.5, "{down:?}");
    }

    #[test]
    fn normals_are_coloured_where_there_are_any() {
        let map =
            Image { width: 2, height: 1, channels: 3, pixels: vec![0.0, 0.0, -1.0, 0.0, 0.0, 0.0] };
        assert_eq!(normals(&map).pixels, [0.5, 0.5, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn the_brightest_is_a_round_number() {
        let even = Image { width: 70, height: 1, channels: 1, pixels: vec![3.7; 70] };
        assert_eq!(brightest([&even].into_iter(), 1.0), 5.0);
        assert_eq!(brightest(std::iter::empty(), 1.0), 1.0);
    }
}
