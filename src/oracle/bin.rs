//! Which splats each tile blends, and in which order.

use super::project::Splat;
use super::tiles::grid;
use super::{Real, scan, sort};
use crate::types::RenderSettings;

/// Every tile's splats, front to back.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bins {
    /// Number of tiles along x and y.
    pub grid: [u32; 2],
    /// The drawn splats by (depth, index).
    pub order: Vec<u32>,
    /// Where each splat of `order` starts among the pairs before they are sorted by tile.
    pub offsets: Vec<u32>,
    /// Tile of each pair, ascending: row · columns + column.
    pub tiles: Vec<u32>,
    /// Splat of each pair; within a tile front to back.
    pub splats: Vec<u32>,
    /// Per tile, begin and end of its pairs; `[0, 0]` for a tile without any.
    pub ranges: Vec<[u32; 2]>,
}

/// Orders the splats by the bits of their depth as f32 (depths are positive, so the bits ascend with
/// it) and then by index, emits a (tile, splat) pair for every tile that each reaches, and sorts the
/// pairs stably by tile.
pub fn bin<R: Real>(
    splats: &[Option<Splat<R>>],
    settings: &RenderSettings,
    width: u32,
    height: u32,
) -> Bins {
    let grid = grid(width, height);
    let drawn: Vec<u32> =
        (0..splats.len() as u32).filter(|&i| splats[i as usize].is_some()).collect();
    let at = |i: u32| splats[i as usize].as_ref().expect("only drawn splats are listed");
    let keys: Vec<u32> = drawn.iter().map(|&i| (at(i).depth.f64() as f32).to_bits()).collect();
    let (_, order) = sort::by_bits(&keys, &drawn, 0..32);

    let counts: Vec<u32> = order.iter().map(|&i| at(i).tile_count).collect();
    let offsets = scan::exclusive(&counts);
    let (mut tiles, mut owners) = (Vec::new(), Vec::new());
    for &i in &order {
        for [column, row] in at(i).tiles(settings, width, height) {
            tiles.push(row * grid[0] + column);
            owners.push(i);
        }
    }
    let (tiles, splats) = sort::by_bits(&tiles, &owners, 0..32);
    let mut ranges = vec![[0, 0]; grid[0] as usize * grid[1] as usize];
    for (pair, &tile) in tiles.iter().enumerate() {
        let range = &mut ranges[tile as usize];
        if range[0] == range[1] {
            range[0] = pair as u32;
        }
        range[1] = pair as u32 + 1;
    }
    Bins { grid, order, offsets, tiles, splats, ranges }
}
