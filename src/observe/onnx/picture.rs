//! A frame as a network takes it, and what the network says brought back to the frame.

use super::contract::{Fit, PictureRule};
use crate::data::images;
use crate::types::Image;

/// How a frame lies in a network's picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Layout {
    /// The frame's size.
    frame: (u32, u32),
    /// The size that the frame is scaled to; the picture begins with it.
    scaled: (u32, u32),
    /// The picture's size.
    pub picture: (u32, u32),
}

impl Layout {
    /// By a network's rule, for frames of a size.
    pub fn new(rule: &PictureRule, (width, height): (u32, u32)) -> Layout {
        let factor = match rule.shorter {
            0 => 1.0,
            shorter => f64::from(shorter) / f64::from(width.min(height)),
        };
        let near = |side: u32| (f64::from(side) * factor).round().max(1.0);
        let whole = |side: f64, round: fn(f64) -> f64| {
            (round(side / f64::from(rule.multiple)) as u32).max(1) * rule.multiple
        };
        let sides = [near(width), near(height)];
        let (scaled, picture) = match rule.fit {
            Fit::Stretch => {
                let sides = sides.map(|side| whole(side, f64::round));
                (sides, sides)
            }
            Fit::Pad => (sides.map(|side| side as u32), sides.map(|side| whole(side, f64::ceil))),
        };
        Layout { frame: (width, height), scaled: scaled.into(), picture: picture.into() }
    }

    /// A frame's picture: red, then green, then blue, row by row.
    pub fn picture(&self, rule: &PictureRule, frame: &Image) -> Vec<f32> {
        let scaled = images::resize(frame, self.scaled.0, self.scaled.1);
        let (width, height) = self.picture;
        let mut out = Vec::with_capacity(3 * width as usize * height as usize);
        for channel in 0..3 {
            for y in 0..height {
                for x in 0..width {
                    let at = scaled.at(x.min(self.scaled.0 - 1), y.min(self.scaled.1 - 1));
                    let value = rule.white * at[channel];
                    out.push((value - rule.mean[channel]) / rule.deviation[channel]);
                }
            }
        }
        out
    }

    /// What a network says of each pixel of the frame, by the nearest of its own pixels: the values on both
    /// sides of an edge have no meaningful mean. `planes` are channels of `size` one after the other.
    pub fn nearest(&self, planes: &[f32], size: (u32, u32)) -> Image {
        let (width, height) = self.frame;
        let plane = size.0 as usize * size.1 as usize;
        let channels = planes.len() / plane;
        let mut out = Image::new(width, height, channels as u32);
        for y in 0..height {
            for x in 0..width {
                let place = |i: u32, frame: u32, scaled: u32, picture: u32, size: u32| {
                    // Of the picture's pixels, then of the output's, which may be coarser.
                    let at = (f64::from(i) + 0.5) * f64::from(scaled) / f64::from(frame);
                    ((at * f64::from(size) / f64::from(picture)) as u32).min(size - 1) as usize
                };
                let column = place(x, width, self.scaled.0, self.picture.0, size.0);
                let row = place(y, height, self.scaled.1, self.picture.1, size.1);
                let from = row * size.0 as usize + column;
                for (c, to) in out.at_mut(x, y).iter_mut().enumerate() {
                    *to = planes[c * plane + from];
                }
            }
        }
        out
    }

    /// Pixels of the frame in a pixel of the picture, along both axes.
    pub fn frame_from_picture(&self) -> [f32; 2] {
        let ratio = |frame: u32, scaled: u32| (f64::from(frame) / f64::from(scaled)) as f32;
        [ratio(self.frame.0, self.scaled.0), ratio(self.frame.1, self.scaled.1)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule(multiple: u32, shorter: u32, fit: Fit) -> PictureRule {
        PictureRule { multiple, shorter, fit, ..PictureRule::default() }
    }

    #[test]
    fn sides_are_multiples() {
        let picture = |rule, size| Layout::new(&rule, size).picture;
        assert_eq!(picture(rule(1, 0, Fit::Stretch), (37, 21)), (37, 21));
        assert_eq!(picture(rule(14, 0, Fit::Stretch), (320, 180)), (322, 182));
        assert_eq!(picture(rule(14, 518, Fit::Stretch), (320, 180)), (924, 518));
        assert_eq!(picture(rule(14, 518, Fit::Stretch), (180, 320)), (518, 924));
        assert_eq!(picture(rule(8, 0, Fit::Pad), (321, 180)), (328, 184));
        assert_eq!(picture(rule(64, 0, Fit::Stretch), (5, 3)), (64, 64));
    }

    #[test]
    fn a_frame_is_normalised_and_padded() {
        let rule = PictureRule {
            white: 255.0,
            mean: [255.0, 0.0, 51.0],
            deviation: [255.0, 1.0, 2.0],
            ..rule(4, 0, Fit::Pad)
        };
        let mut frame = Image::new(3, 2, 3);
        frame.at_mut(2, 1).copy_from_slice(&[1.0, 0.5, 0.2]);
        let layout = Layout::new(&rule, (3, 2));
        let picture = layout.picture(&rule, &frame);
        assert_eq!(picture.len(), 3 * 16);
        // The last pixel is repeated to the right and below.
        for i in [4 + 2, 4 + 3, 12 + 3] {
            assert!(picture[i].abs() < 1e-6, "{i}: {}", picture[i]);
            assert!((picture[16 + i] - 127.5).abs() < 1e-4, "{}", picture[16 + i]);
            assert!(picture[32 + i].abs() < 1e-5, "{}", picture[32 + i]);
        }
        assert_eq!((picture[0], picture[16], picture[32]), (-1.0, 0.0, -25.5));
    }

    #[test]
    fn what_the_network_says_comes_back_to_its_pixel() {
        for (fit, size) in [(Fit::Pad, (13, 9)), (Fit::Stretch, (13, 9)), (Fit::Stretch, (9, 13))] {
            let layout = Layout::new(&rule(4, 0, fit), size);
            let (w, h) = layout.picture;
            // Each pixel says where it is in the picture.
            let columns = (0..w * h).map(|i| (i % w) as f32 + 0.5);
            let rows = (0..w * h).map(|i| (i / w) as f32 + 0.5);
            let planes: Vec<f32> = columns.chain(rows).collect();
            let back = layout.nearest(&planes, (w, h));
            let [by_x, by_y] = layout.frame_from_picture();
            for y in 0..size.1 {
                for x in 0..size.0 {
                    let at = back.at(x, y);
                    let (u, v) = (at[0] * by_x - 0.5, at[1] * by_y - 0.5);
                    let off = ((u - x as f32) / by_x).abs().max(((v - y as f32) / by_y).abs());
                    assert!(off <= 0.501, "{fit:?} {x} {y}: {u} {v}");
                }
            }
        }
    }

    #[test]
    fn a_coarser_output_covers_the_frame() {
        let layout = Layout::new(&rule(8, 0, Fit::Stretch), (16, 8));
        let back = layout.nearest(&[1.0, 2.0], (2, 1));
        assert_eq!((back.at(7, 3)[0], back.at(8, 3)[0]), (1.0, 2.0));
    }
}
