//! The pixels of a mover in a frame, and what its contour borders on.

use glam::DVec2;

/// Ratio of inverse depths above which a static object next to a mover, compared with what the mover hides,
/// counts as hiding a part of the mover.
const NEARER: f32 = 1.15;
/// Distance to each side of a contour at which depths are compared, pixels. It is about the accuracy of depth
/// edges.
const BESIDE: i32 = 2;

/// The neighbour of a pixel of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    /// Another pixel of the object, by its index in the list.
    Own(usize),
    /// Something that the object hides: this side is on the object's outline.
    Hidden,
    /// The image border, or something that hides the object: the object continues there.
    Open,
}

/// The pixels of an object in an image, each with its four neighbours.
pub(super) struct Region {
    /// Indices of the pixels in the image, in increasing order.
    pub pixels: Vec<usize>,
    /// Their centres.
    pub centres: Vec<DVec2>,
    /// Their left, right, upper and lower neighbours.
    pub sides: Vec<[Side; 4]>,
}

impl Region {
    /// The pixels whose object in `owners` is `index`. `behind` is the inverse depth of the static
    /// world, behind the movers too.
    pub fn new(index: u16, owners: &[Option<u16>], behind: &[f32], width: usize) -> Region {
        let own = |i: usize| owners[i] == Some(index);
        let pixels: Vec<usize> = (0..owners.len()).filter(|i| own(*i)).collect();
        let side = |i: usize, across: (i32, i32)| match next(i, across, 1, width, owners.len()) {
            None => Side::Open,
            // The pixels are in order.
            Some(other) if own(other) => pixels.binary_search(&other).map_or(Side::Open, Side::Own),
            Some(other) if owners[other].is_some() || hides(i, across, behind, width) => Side::Open,
            Some(_) => Side::Hidden,
        };
        let sides = pixels.iter().map(|i| NEXT.map(|across| side(*i, across))).collect();
        let centre = |i: &usize| DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        Region { centres: pixels.iter().map(centre).collect(), pixels, sides }
    }

    /// The index in the list of the pixel that contains a point, or of the nearest pixel.
    pub fn place(&self, point: DVec2, width: usize) -> usize {
        let (x, y) = (point.x.max(0.0) as usize, point.y.max(0.0) as usize);
        let off = |p: &DVec2| p.distance_squared(point);
        self.pixels.binary_search(&(y * width + x)).unwrap_or_else(|_| {
            let nearest = self.centres.iter().enumerate();
            nearest.min_by(|a, b| off(a.1).total_cmp(&off(b.1))).map_or(0, |n| n.0)
        })
    }
}

/// Steps to the four neighbours of a pixel.
const NEXT: [(i32, i32); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// The pixel at a number of steps from a pixel, if it is inside the image.
fn next(i: usize, across: (i32, i32), steps: i32, width: usize, pixels: usize) -> Option<usize> {
    let (x, y) = ((i % width) as i32 + steps * across.0, (i / width) as i32 + steps * across.1);
    let inside = x >= 0 && y >= 0 && x < width as i32 && y < (pixels / width) as i32;
    inside.then(|| y as usize * width + x as usize)
}

/// Whether static objects directly outside a mover's contour hide a part of it: they are nearer than what the
/// mover hides directly inside. `i` is the last pixel inside, `across` the step out of it.
fn hides(i: usize, across: (i32, i32), behind: &[f32], width: usize) -> bool {
    let at = |steps: i32| next(i, across, steps, width, behind.len()).map(|i| behind[i]);
    at(BESIDE).zip(at(-BESIDE)).is_some_and(|(outside, inside)| outside > NEARER * inside)
}
