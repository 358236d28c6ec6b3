//! Conversion between the axes of a file and those of this crate, which are right, down, front.

use std::path::Path;

use crate::{Error, Result};

/// The signs that convert a file's x, y and z to right, down and front.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Axes(pub [f32; 3]);

impl Default for Axes {
    /// The axes right, up, back: SPZ's default.
    fn default() -> Axes {
        Axes([1.0, -1.0, -1.0])
    }
}

impl Axes {
    /// The axes left, up, front: those of glTF splats.
    pub const GLTF: Axes = Axes([-1.0, -1.0, 1.0]);

    /// The axes with this number in Adobe's SPZ extension.
    pub fn named(path: &Path, number: u32) -> Result<Axes> {
        match number {
            0 => Ok(Axes::default()),
            // Left or right, down or up, back or front.
            1..=8 => {
                let bit = |place: u32| (number - 1) >> place & 1 == 1;
                let sign = |positive: bool| if positive { 1.0 } else { -1.0 };
                Ok(Axes([sign(bit(0)), sign(!bit(1)), sign(bit(2))]))
            }
            _ => {
                let what = format!(
                    "has axes of number {number}, in which y and z are swapped; they \
                    are not read"
                );
                Err(Error::format(path, what))
            }
        }
    }

    /// Converts a position or a direction.
    pub fn place(self, p: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| self.0[c] * p[c])
    }

    /// Converts a quaternion (w, x, y, z): the rotation R becomes F R F, with F the diagonal matrix
    /// of the signs.
    pub fn turn(self, q: [f32; 4]) -> [f32; 4] {
        let [x, y, z] = self.0;
        [q[0], y * z * q[1], x * z * q[2], x * y * q[3]]
    }

    /// The sign of a harmonic above the constant: the parity of its polynomial in the axes that are
    /// mirrored.
    pub fn harmonic(self, index: usize) -> f32 {
        /// Whether x, y and z occur an odd number of times.
        const ODD: [[bool; 3]; 15] = {
            const X: bool = true;
            const O: bool = false;
            [
                [O, X, O],
                [O, O, X],
                [X, O, O],
                [X, X, O],
                [O, X, X],
                [O, O, O],
                [X, O, X],
                [O, O, O],
                [O, X, O],
                [X, X, X],
                [O, X, O],
                [O, O, X],
                [X, O, O],
                [O, O, X],
                [X, O, O],
            ]
        };
        (0..3).filter(|&c| ODD[index][c]).map(|c| self.0[c]).product()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_axes() {
        let named = |number| Axes::named(Path::new("a.spz"), number).map(|axes| axes.0);
        assert_eq!(named(4).unwrap(), Axes::default().0, "right, up, back");
        assert_eq!(named(6).unwrap(), [1.0, 1.0, 1.0], "right, down, front");
        assert_eq!(named(7).unwrap(), [-1.0, -1.0, 1.0], "left, up, front");
        assert_eq!(named(1).unwrap(), [-1.0, 1.0, -1.0], "left, down, back");
        assert!(named(9).unwrap_err().to_string().contains("a.spz"));
    }
}
