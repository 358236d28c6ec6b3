//! Binning: the list of splats of each tile, in blending order.

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
    pub splat_from_rank: Vec<u32>,
    /// Index of the first pair of each splat of `splat_from_rank`, before the pairs are sorted by tile.
    pub emitted_from_rank: Vec<u32>,
    /// Tile of each pair, ascending: row · columns + column.
    pub tiles: Vec<u32>,
    /// Splat of each pair; within a tile front to back.
    pub splat_from_sorted: Vec<u32>,
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
    let (_, splat_from_rank) = sort::by_bits(&keys, &drawn, 0..32);

    let counts: Vec<u32> = splat_from_rank.iter().map(|&i| at(i).tile_count).collect();
    let emitted_from_rank = scan::exclusive(&counts);
    let (mut tiles, mut owners) = (Vec::new(), Vec::new());
    for &i in &splat_from_rank {
        for [column, row] in at(i).tiles(settings, width, height) {
            tiles.push(row * grid[0] + column);
            owners.push(i);
        }
    }
    let (tiles, splat_from_sorted) = sort::by_bits(&tiles, &owners, 0..32);
    let mut ranges = vec![[0, 0]; grid[0] as usize * grid[1] as usize];
    for (pair, &tile) in tiles.iter().enumerate() {
        let range = &mut ranges[tile as usize];
        if range[0] == range[1] {
            range[0] = pair as u32;
        }
        range[1] = pair as u32 + 1;
    }
    Bins { grid, splat_from_rank, emitted_from_rank, tiles, splat_from_sorted, ranges }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::oracle::tiles::TileRect;

    const SETTINGS: RenderSettings = RenderSettings {
        near: 0.01,
        dilation: 0.3,
        alpha_cut: 1.0 / 255.0,
        alpha_cap: 0.999,
        transmittance_stop: 1e-4,
        tangent_clamp: 1.3,
    };

    /// A round splat of opacity 1 and variance `variance`.
    fn round(mean: [f64; 2], variance: f64, depth: f64, size: [u32; 2]) -> Option<Splat<f64>> {
        let mut splat = Splat {
            mean,
            conic: [(0.5 / variance).sqrt(), 0.0, (0.5 / variance).sqrt()],
            opacity: 1.0,
            depth,
            colour: [0.5; 3],
            rect: TileRect::default(),
            tile_count: 0,
        };
        let extent = (2.0 * splat.reach(&SETTINGS) * variance).sqrt();
        splat.rect = TileRect::around(mean, [extent; 2], size[0], size[1]);
        splat.tile_count = splat.tiles(&SETTINGS, size[0], size[1]).count() as u32;
        Some(splat)
    }

    #[test]
    fn tiles_list_their_splats_front_to_back() {
        let size = [40, 20];
        let splats = vec![
            round([8.0, 8.0], 1.0, 3.0, size),
            None,
            round([16.0, 8.0], 4.0, 2.0, size),
            round([8.0, 8.0], 1.0, 2.0, size),
            round([38.0, 18.0], 0.5, 1.0, size),
        ];
        let bins = bin(&splats, &SETTINGS, size[0], size[1]);
        assert_eq!(bins.grid, [3, 2]);
        assert_eq!(bins.splat_from_rank, [4, 2, 3, 0]);
        assert_eq!(bins.emitted_from_rank, [0, 1, 3, 4]);
        assert_eq!(bins.tiles, [0, 0, 0, 1, 5]);
        assert_eq!(bins.splat_from_sorted, [2, 3, 0, 2, 4]);
        assert_eq!(bins.ranges, [[0, 3], [3, 4], [0, 0], [0, 0], [0, 0], [4, 5]]);
    }

    #[test]
    fn more_than_65535_tiles() {
        let size = [4112, 4112];
        let splats =
            vec![round([4111.5, 4111.5], 1.0, 1.0, size), round([2056.0, 2056.0], 1e12, 2.0, size)];
        let bins = bin(&splats, &SETTINGS, size[0], size[1]);
        assert_eq!(bins.ranges.len(), 257 * 257);
        assert_eq!(bins.splat_from_sorted.len(), 257 * 257 + 1);
        assert_eq!(bins.ranges[257 * 257 - 1], [257 * 257 - 1, 257 * 257 + 1]);
        assert_eq!(bins.splat_from_sorted[257 * 257 - 1..], [0, 1]);
    }

    #[test]
    fn nothing_to_draw() {
        let bins = bin::<f64>(&[None, None], &SETTINGS, 17, 3);
        assert!(bins.splat_from_rank.is_empty() && bins.tiles.is_empty());
        assert_eq!(bins.ranges, [[0, 0], [0, 0]]);
    }
}
