//! Conversion of a frame to a network's input image, and of the network's outputs back to the frame.

use glam::DVec2;

use super::contract::{Fit, PictureRule};
use crate::data::images;
use crate::observe::pointmaps::Placement;
use crate::types::Image;

/// Position of a frame within a network's input image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Layout {
    /// The frame's size.
    frame: (u32, u32),
    /// The size that the frame is scaled to.
    scaled: (u32, u32),
    /// The pixel of the scaled frame that is the input image's first.
    first: (u32, u32),
    /// Size of the input image.
    pub picture: (u32, u32),
}

/// An axis of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Axis {
    /// To the right.
    X,
    /// Down.
    Y,
}

impl Layout {
    /// Layout by a network's rule, for frames of one size.
    pub fn new(rule: &PictureRule, (width, height): (u32, u32)) -> Layout {
        let sides = [f64::from(width), f64::from(height)];
        let told = (rule.size != [0; 2]).then_some(rule.size);
        let ratios =
            told.map(|told| [f64::from(told[0]) / sides[0], f64::from(told[1]) / sides[1]]);
        let factor = match (ratios, rule.fit, rule.shorter) {
            (Some([x, y]), Fit::Pad, _) => x.min(y),
            (Some([x, y]), _, _) => x.max(y),
            (None, _, 0) => 1.0,
            (None, _, shorter) => f64::from(shorter) / sides[0].min(sides[1]),
        };
        let near = sides.map(|side| (side * factor).round().max(1.0));
        let picture = told.unwrap_or_else(|| {
            let round = match rule.fit {
                Fit::Stretch => f64::round,
                Fit::Pad => f64::ceil,
                Fit::Crop => f64::floor,
            };
            let multiple = f64::from(rule.multiple);
            near.map(|side| (round(side / multiple) as u32).max(1) * rule.multiple)
        });
        let scaled = match rule.fit {
            Fit::Stretch => picture,
            Fit::Pad => [0, 1].map(|k| (near[k] as u32).min(picture[k])),
            // A frame that is smaller than one multiple is scaled up to it.
            Fit::Crop => [0, 1].map(|k| (near[k] as u32).max(picture[k])),
        };
        let first = match rule.fit {
            Fit::Crop => [0, 1].map(|k| (scaled[k] - picture[k]) / 2),
            Fit::Stretch | Fit::Pad => [0; 2],
        };
        Layout {
            frame: (width, height),
            scaled: scaled.into(),
            first: first.into(),
            picture: picture.into(),
        }
    }

    /// The input image of a frame: red, then green, then blue, row by row.
    pub fn picture(&self, rule: &PictureRule, frame: &Image) -> Vec<f32> {
        let scaled = images::resize(frame, self.scaled.0, self.scaled.1);
        let (width, height) = self.picture;
        let mut out = Vec::with_capacity(3 * width as usize * height as usize);
        for channel in 0..3 {
            for y in 0..height {
                for x in 0..width {
                    let at = scaled.at(
                        (x + self.first.0).min(self.scaled.0 - 1),
                        (y + self.first.1).min(self.scaled.1 - 1),
                    );
                    let value = rule.white * at[channel];
                    out.push((value - rule.mean[channel]) / rule.deviation[channel]);
                }
            }
        }
        out
    }

    /// Resamples an output to the pixels of the frame by nearest neighbour, because values on both sides of
    /// an edge have no meaningful mean. `planes` are channels of `size`, one after the other. In cropped
    /// margins the edge values are repeated.
    pub fn nearest(&self, planes: &[f32], size: (u32, u32)) -> Image {
        let (width, height) = self.frame;
        let plane = size.0 as usize * size.1 as usize;
        let channels = planes.len() / plane;
        let mut out = Image::new(width, height, channels as u32);
        let along = |axis: Axis, sides: (u32, u32)| match axis {
            Axis::X => sides.0,
            Axis::Y => sides.1,
        };
        // Position in the input image, then in the output, which may be coarser.
        let place = |axis: Axis, i: u32| {
            let side = |sides| f64::from(along(axis, sides));
            let at =
                self.picture_from_frame(axis, f64::from(i) + 0.5) * side(size) / side(self.picture);
            (at.max(0.0) as u32).min(along(axis, size) - 1) as usize
        };
        for y in 0..height {
            let row = place(Axis::Y, y) * size.0 as usize;
            for x in 0..width {
                let from = row + place(Axis::X, x);
                for (c, to) in out.at_mut(x, y).iter_mut().enumerate() {
                    *to = planes[c * plane + from];
                }
            }
        }
        out
    }

    /// Resamples one channel of an output of size `size` to the pixels of the frame bilinearly; for values
    /// that are smooth over the image, such as log odds.
    pub fn smooth(&self, plane: &[f32], size: (u32, u32)) -> Image {
        let plane = Image { width: size.0, height: size.1, channels: 1, pixels: plane.to_vec() };
        let place = |axis: Axis, i: u32, side: u32, picture: u32| {
            let at = self.picture_from_frame(axis, f64::from(i) + 0.5);
            at * f64::from(side) / f64::from(picture)
        };
        let (width, height) = self.frame;
        let mut out = Image::new(width, height, 1);
        for y in 0..height {
            let v = place(Axis::Y, y, size.1, self.picture.1);
            for x in 0..width {
                out.at_mut(x, y)[0] = plane.between(place(Axis::X, x, size.0, self.picture.0), v);
            }
        }
        out
    }

    /// The inverse: resamples one channel of the frame bilinearly to a plane of `size` that covers the
    /// input image. Outside the frame its edge is repeated, as in the input image.
    pub fn in_picture(&self, image: &Image, size: (u32, u32)) -> Vec<f32> {
        let place = |i: u32, side: u32, picture: u32, frame: u32, scaled: u32, first: u32| {
            let at = (f64::from(i) + 0.5) * f64::from(picture) / f64::from(side);
            (at + f64::from(first)) * f64::from(frame) / f64::from(scaled)
        };
        let x = |i| place(i, size.0, self.picture.0, self.frame.0, self.scaled.0, self.first.0);
        let y = |i| place(i, size.1, self.picture.1, self.frame.1, self.scaled.1, self.first.1);
        let row = |j| (0..size.0).map(move |i| image.between(x(i), y(j)));
        (0..size.1).flat_map(row).collect()
    }

    /// Converts a position in the frame to one in the input image.
    pub fn picture_from_frame(&self, axis: Axis, at: f64) -> f64 {
        let (frame, scaled, first) = match axis {
            Axis::X => (self.frame.0, self.scaled.0, self.first.0),
            Axis::Y => (self.frame.1, self.scaled.1, self.first.1),
        };
        at * f64::from(scaled) / f64::from(frame) - f64::from(first)
    }

    /// Position of the input image within the frame.
    pub fn placement(&self) -> Placement {
        let pair = |(x, y): (u32, u32)| DVec2::new(x.into(), y.into());
        let scale = pair(self.frame) / pair(self.scaled);
        Placement {
            frame: self.frame,
            picture: self.picture,
            scale,
            corner: scale * pair(self.first),
        }
    }

    /// Frame pixels per pixel of the input image, along both axes.
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
        assert_eq!(picture(rule(16, 0, Fit::Crop), (161, 95)), (160, 80));
        assert_eq!(picture(rule(16, 0, Fit::Crop), (5, 33)), (16, 32));
    }

    #[test]
    fn a_picture_of_a_told_size_is_stretched_padded_or_cut() {
        let layout = |fit, size| {
            let rule = PictureRule { size: [64, 32], ..rule(1, 0, fit) };
            Layout::new(&rule, size)
        };
        let told = |layout: Layout| (layout.scaled, layout.first, layout.picture);
        assert_eq!(told(layout(Fit::Stretch, (100, 20))), ((64, 32), (0, 0), (64, 32)));
        assert_eq!(told(layout(Fit::Pad, (100, 20))), ((64, 13), (0, 0), (64, 32)));
        assert_eq!(told(layout(Fit::Crop, (100, 20))), ((160, 32), (48, 0), (64, 32)));
        assert_eq!(told(layout(Fit::Crop, (64, 33))), ((64, 33), (0, 0), (64, 32)));
    }

    #[test]
    fn what_is_cut_off_is_cut_off_on_both_sides() {
        let rule = rule(4, 0, Fit::Crop);
        let mut frame = Image::new(7, 4, 3);
        for (i, c) in frame.pixels.chunks_exact_mut(3).enumerate() {
            c[0] = (i % 7) as f32;
        }
        let layout = Layout::new(&rule, (7, 4));
        let picture = layout.picture(&rule, &frame);
        assert_eq!(picture[..4], [1.0, 2.0, 3.0, 4.0]);
        // In the cropped margins the edge is repeated.
        let back = layout.nearest(&picture[..16], layout.picture);
        let row: Vec<f32> = (0..7).map(|x| back.at(x, 2)[0]).collect();
        assert_eq!(row, [1.0, 1.0, 2.0, 3.0, 4.0, 4.0, 4.0]);
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
            // Each pixel encodes its position in the input image.
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
    fn smooth_channels_come_to_the_frame_and_back() {
        let ramp = |width: u32, height: u32, by: [f32; 2]| {
            let mut out = Image::new(width, height, 1);
            for (i, value) in out.pixels.iter_mut().enumerate() {
                let (x, y) = (i as u32 % width, i as u32 / width);
                *value = by[0] * (x as f32 + 0.5) + by[1] * (y as f32 + 0.5);
            }
            out
        };
        // The frame in an input of 64 × 32: stretched; as 40 × 32 of it with its edge repeated; with 24
        // rows of 56 cropped.
        for (fit, frame) in [(Fit::Stretch, (24, 30)), (Fit::Pad, (20, 16)), (Fit::Crop, (32, 44))]
        {
            let layout = Layout::new(&PictureRule { size: [64, 32], ..rule(1, 0, fit) }, frame);
            // A plane four times as coarse as the input image.
            let size = (16, 8);
            let image = ramp(frame.0, frame.1, [1.0, 0.5]);
            let plane = layout.in_picture(&image, size);
            let back = layout.smooth(&plane, size);
            let mut known = 0;
            for y in 0..frame.1 {
                for x in 0..frame.0 {
                    let at = |axis, i: u32| layout.picture_from_frame(axis, f64::from(i) + 0.5);
                    let (u, v) = (at(Axis::X, x), at(Axis::Y, y));
                    // Near edges, values are constant over half a coarse pixel, and over one more where the
                    // edge is repeated.
                    let inner = |at: f64, side: f64| at >= 2.0 && at <= side;
                    let sides = [0, 1].map(|k| {
                        let (scaled, picture) = (layout.scaled, layout.picture);
                        let [s, p] = [[scaled.0, scaled.1][k], [picture.0, picture.1][k]];
                        f64::from(s.min(p)) - 6.0
                    });
                    if inner(u, sides[0]) && inner(v, sides[1]) {
                        known += 1;
                        let expected = image.at(x, y)[0];
                        let told = back.at(x, y)[0];
                        assert!(
                            (told - expected).abs() < 1e-4,
                            "{fit:?} {x} {y}: {told} {expected}"
                        );
                    }
                }
            }
            assert!(known > 80, "{fit:?}: {known}");
        }
        // At the same size nothing is interpolated.
        let layout = Layout::new(&PictureRule { size: [7, 5], ..rule(1, 0, Fit::Stretch) }, (7, 5));
        let image = ramp(7, 5, [0.3, -2.0]);
        assert_eq!(layout.in_picture(&image, (7, 5)), image.pixels);
        assert_eq!(layout.smooth(&image.pixels, (7, 5)), image);
    }

    #[test]
    fn a_coarser_output_covers_the_frame() {
        let layout = Layout::new(&rule(8, 0, Fit::Stretch), (16, 8));
        let back = layout.nearest(&[1.0, 2.0], (2, 1));
        assert_eq!((back.at(7, 3)[0], back.at(8, 3)[0]), (1.0, 2.0));
    }
}
