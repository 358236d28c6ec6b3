//! Extrapolation of surfaces beyond the edges of what a frame shows: a guess.
//!
//! Static surfaces are continued a little beyond the frame's border, and behind nearer surfaces, as
//! planes: their inverse depth is extrapolated linearly. Their colour is that of the edge.

use super::mesh::{Cell, Frame, Grid, STILL};
use std::collections::VecDeque;

/// How far surfaces are continued, as a share of the frame's width.
const REACH: f64 = 0.08;
/// The weight of a guess; observed pixels have 1.
const WEIGHT: f32 = 0.5;
/// Share of the inverse depth by which a surface must be nearer, at least, for another one to be
/// continued behind it.
const BEHIND: f64 = 0.06;
/// Largest relative change of the inverse depth over the continuation. A steeper surface keeps its depth
/// instead: it is not a plane, or it is seen at too oblique an angle.
const STEEP: f64 = 0.15;

/// The continued surfaces of a frame beyond their edges, with the edges' own pixels.
pub(super) fn beyond(frame: &Frame<'_>) -> Grid {
    let reach = REACH * f64::from(frame.depth.width);
    let mut grid = Grid::of(frame, reach.ceil() as u32);
    let edge_of = edges(&grid, reach);
    let mut cells = vec![None; grid.cells.len()];
    for (i, edge) in edge_of.iter().enumerate() {
        let Some(edge) = *edge else { continue };
        cells[i] = grid.cells[edge].map(|cell| {
            // The pixel as far inside the surface as this one is beyond its edge.
            let ((x, y), (edge_x, edge_y)) = (grid.pixel(i), grid.pixel(edge));
            let within = grid.index((2 * edge_x - x, 2 * edge_y - y)).and_then(|i| grid.cells[i]);
            let within = within.filter(|within| within.surface == STILL);
            let change = within.map_or(0.0, |within| cell.inverse_depth - within.inverse_depth);
            let change = if change.abs() < STEEP * cell.inverse_depth { change } else { 0.0 };
            let inverse_depth = cell.inverse_depth + change;
            Cell { inverse_depth, weight: WEIGHT * cell.weight, ..cell }
        });
    }
    for edge in edge_of.into_iter().flatten() {
        cells[edge] = grid.cells[edge];
    }
    grid.cells = cells;
    grid
}

/// For each cell to which a surface is continued, the cell of the nearest edge, found from the edges
/// outwards.
fn edges(grid: &Grid, reach: f64) -> Vec<Option<usize>> {
    let beside = |i: usize| {
        let (x, y) = grid.pixel(i);
        [(1, 0), (-1, 0), (0, 1), (0, -1)]
            .into_iter()
            .filter_map(move |(dx, dy)| grid.index((x + dx, y + dy)))
    };
    let distance = |a: usize, b: usize| {
        let ((ax, ay), (bx, by)) = (grid.pixel(a), grid.pixel(b));
        ((ax - bx) as f64).hypot((ay - by) as f64)
    };
    let goes_on = |edge: usize, to: usize| {
        let surface = grid.cells[edge].filter(|cell| cell.surface == STILL && cell.weight > 0.0);
        surface.is_some_and(|surface| {
            let before = |cell: Cell| surface.inverse_depth < (1.0 - BEHIND) * cell.inverse_depth;
            grid.cells[to].is_none_or(before)
        })
    };
    let mut edge_of: Vec<Option<usize>> = vec![None; grid.cells.len()];
    // Cells, each with the edge cell whose surface may continue to its neighbours.
    let mut queue: VecDeque<(usize, usize)> = (0..grid.cells.len()).map(|i| (i, i)).collect();
    while let Some((i, edge)) = queue.pop_front() {
        for to in beside(i).filter(|to| goes_on(edge, *to)) {
            let far = distance(edge, to);
            if far <= reach && edge_of[to].is_none_or(|now| far < distance(now, to)) {
                edge_of[to] = Some(edge);
                queue.push_back((to, edge));
            }
        }
    }
    edge_of
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::views::TrainingView;
    use crate::types::{Camera, Image, Intrinsics, Pose};

    const SIZE: (u32, u32) = (64, 48);

    /// Inverse depth of ground that falls away towards the top, and of a card before it.
    fn inverse_depth(x: i64, y: i64) -> (f64, bool) {
        let card = (24..40).contains(&x) && (16..32).contains(&y);
        (if card { 0.8 } else { 0.3 + 0.002 * y as f64 }, card)
    }

    #[test]
    fn surfaces_go_on_over_the_border_and_behind_what_stands_before_them() {
        let (mut image, mut depth) = (Image::new(64, 48, 3), Image::new(64, 48, 1));
        let (mut disparity, mut mask) = (Image::new(64, 48, 2), Image::new(64, 48, 1));
        let columns = |x: i64| x as f32 / 64.0;
        // Something moves in the corner at the lower right.
        let moves = |x: i64, y: i64| x >= 56 && y >= 40;
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let (at_x, at_y) = (i64::from(x), i64::from(y));
                let d = inverse_depth(at_x, at_y).0 as f32;
                image.at_mut(x, y).fill(columns(at_x));
                depth.at_mut(x, y)[0] = d.recip();
                disparity.at_mut(x, y).copy_from_slice(&[d, 1.0]);
                mask.at_mut(x, y)[0] = f32::from(u8::from(moves(at_x, at_y)));
            }
        }
        let camera = Camera {
            intrinsics: Intrinsics::centred(60.0, SIZE.0, SIZE.1),
            view_from_world: Pose::IDENTITY,
        };
        let disparity = Some(disparity);
        let view = TrainingView {
            camera,
            time: 0.0,
            image,
            weights: None,
            disparity,
            mask: None,
            every: 1,
        };
        let owners = Image::new(64, 48, 1);
        let grid = beyond(&Frame {
            view: &view,
            depth: &depth,
            mask: &mask,
            owners: &owners,
            flanks: &[],
        });
        let at = |x: i64, y: i64| grid.cells[grid.index((x, y)).unwrap()];
        // 5.1 pixels.
        let reach = (REACH * 64.0) as i64;
        for i in 0..grid.cells.len() {
            let (x, y) = grid.pixel(i);
            let outside = [-x, x - 63, -y, y - 47].into_iter().max().unwrap();
            let inside_card = [x - 23, 40 - x, y - 15, 32 - y].into_iter().min().unwrap();
            let Some(cell) = grid.cells[i] else {
                let straight = (0..64).contains(&x) || (0..48).contains(&y);
                let near_mover = x >= 56 - reach && y >= 40 - reach;
                let bare = outside <= 0 || outside > reach || !straight || near_mover;
                assert!(bare && (inside_card <= 0 || inside_card > reach), "{x}, {y}");
                continue;
            };
            assert!(outside <= reach && inside_card <= reach, "{x}, {y}");
            // The plane is continued as if the card and the border were not there; the card is not
            // continued.
            assert!((cell.inverse_depth - (0.3 + 0.002 * y as f64)).abs() < 1e-6, "{x}, {y}");
            let guessed = outside > 0 || inside_card > 0;
            assert_eq!(cell.weight, if guessed { WEIGHT } else { 1.0 }, "{x}, {y}");
            assert_eq!(cell.surface, STILL);
        }
        assert_eq!(at(-2, 10).unwrap().colour, [columns(0); 3]);
        assert_eq!(at(24, 24).unwrap().colour, [columns(23); 3]);
        assert!(at(62, 49).is_none(), "what moves goes on");
        assert!(at(10, 10).is_none(), "only edges are kept");
    }
}
