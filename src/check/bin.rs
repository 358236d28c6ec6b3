//! Check cases of binning; the reference uses the splats that the device itself has projected.

use super::scene::{Forward, Frame, UPRIGHT, join, one, plain_camera, random, skew_camera};
use super::{Case, Harness};
use crate::error::Result;
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::render::Render;
use crate::oracle::tiles::{TileRect, grid, hit};
use crate::oracle::{scan, sort};
use crate::types::{Camera, Gaussians, RenderSettings};
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "bin/lists", run: lists },
    Case { id: "bin/equal_depths", run: equal_depths },
    Case { id: "bin/depth_bits", run: depth_bits },
    Case { id: "bin/image_sizes", run: image_sizes },
    Case { id: "bin/overflow", run: overflow },
    Case { id: "bin/saturation", run: saturation },
];

/// Tolerance of the power at the cut, from rounding in the conic and the power. Within it, a tile
/// may be listed or not.
const BAND: f64 = 1e-4;

/// The tiles that the splat certainly overlaps, and those that it may overlap.
fn tiles(out: &Forward, splat: usize, width: u32, height: u32) -> [Vec<u32>; 2] {
    let [x, y, ..] = out.means[splat].map(f64::from);
    let [a, b, e, limit] = out.conics[splat].map(f64::from);
    // Row norms of the inverse of [a b; 0 e], for the half extents.
    let deviation = [(1.0 + (b / e).powi(2)).sqrt() / a, 1.0 / e];
    [limit - BAND, limit + BAND].map(|reach| {
        let extent = deviation.map(|d| d * reach.max(0.0).sqrt());
        TileRect::around([x, y], extent, width, height)
            .tiles()
            .filter(|&tile| hit([x, y], [a, b, e], reach, tile, width, height))
            .map(|[column, row]| row * grid(width, height)[0] + column)
            .collect()
    })
}

/// The total number of pairs, saturated to 32 bits.
fn pairs(counts: &[u32]) -> u32 {
    counts.iter().fold(0, |sum, &count| sum.saturating_add(count))
}

/// Compares all results of binning, for a frame with capacity for `capacity` intersections.
fn compare(
    harness: &mut Harness,
    what: &str,
    out: &Forward,
    width: u32,
    height: u32,
    capacity: usize,
) {
    // Order: by depth, ties by index.
    let drawn: Vec<u32> =
        (0..out.visible.len() as u32).filter(|&i| out.visible[i as usize] != 0).collect();
    let keys: Vec<u32> = drawn.iter().map(|&i| out.means[i as usize][2].to_bits()).collect();
    let order = sort::by_bits(&keys, &drawn, 0..32).1;
    harness.exact(&format!("{what}: order"), &out.splat_from_rank, &order);

    // Offsets; nothing is written past the last.
    let mut counts: Vec<u32> = order.iter().map(|&i| out.tile_counts[i as usize]).collect();
    counts.resize(out.visible.len(), 0);
    harness.exact(&format!("{what}: offsets"), &out.emitted_from_rank, &scan::exclusive(&counts));
    let total = pairs(&counts);
    harness.exact(&format!("{what}: counts"), &out.counts, &[drawn.len() as u32, total]);
    harness.exact(&format!("{what}: fits"), &[out.fits], &[total as usize <= capacity]);

    // Emission: every splat writes the tiles that it overlaps, row by row, to its own range.
    let m = (total as usize).min(capacity);
    let tile_count = grid(width, height).iter().product::<u32>();
    let (mut right, mut phantoms) = (out.tiles.len() == m, 0);
    for (rank, &splat) in order.iter().enumerate() {
        let begin = (out.emitted_from_rank[rank] as usize).min(m);
        let end = (begin + counts[rank] as usize).min(m);
        right &= out.splat_from_emitted[begin..end].iter().all(|&s| s == splat);
        let emitted = &out.tiles[begin..end];
        phantoms += emitted.iter().filter(|&&t| t >= tile_count).count();
        let [surely, maybe] = tiles(out, splat as usize, width, height);
        right &= emitted.windows(2).all(|w| w[0] < w[1]);
        right &= emitted.iter().all(|tile| maybe.contains(tile));
        if end - begin == counts[rank] as usize {
            right &= surely.iter().all(|tile| emitted.contains(tile));
        }
    }
    harness.holds(&format!("{what}: emitted tiles"), right);
    harness.exact(&format!("{what}: counted and not emitted"), &[phantoms], &[0]);

    // Sorted by tile, stably; the ranges follow.
    let numbers: Vec<u32> = (0..m as u32).collect();
    let (tiles, intersections) = sort::by_bits(&out.tiles, &numbers, 0..32);
    harness.exact(&format!("{what}: sorted tiles"), &out.sorted_tiles, &tiles);
    harness.exact(&format!("{what}: intersections"), &out.emitted_from_sorted, &intersections);
    let ranges: Vec<[u32; 2]> = (0..tile_count)
        .map(|tile| {
            let begin = tiles.partition_point(|&t| t < tile) as u32;
            let end = tiles.partition_point(|&t| t <= tile) as u32;
            if begin == end { [0, 0] } else { [begin, end] }
        })
        .collect();
    harness.exact(&format!("{what}: ranges"), &out.ranges[..ranges.len()], &ranges);
}

fn run(
    harness: &mut Harness,
    what: &str,
    scene: &Gaussians,
    camera: &Camera,
    capacity: usize,
) -> Result<Forward> {
    let (device, settings) = (harness.device.clone(), RenderSettings::default());
    let stream = &mut harness.stream;
    let out = Frame::new(&device, stream, scene, camera, capacity, settings)?.forward(stream)?;
    let k = camera.intrinsics;
    compare(harness, what, &out, k.width, k.height, capacity);
    Ok(out)
}

fn lists(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(171, 115);
    for count in [0, 1, 2, 64, 257, 4000] {
        let scene = random(&mut harness.rng, count, 0, &camera);
        run(harness, &format!("{count} Gaussians"), &scene, &camera, 1 << 15)?;
    }
    Ok(())
}

/// Ties break by index, however many there are.
fn equal_depths(harness: &mut Harness) -> Result<()> {
    let camera = plain_camera(40.0, 50, 40);
    let parts: Vec<_> = (0..700)
        .map(|i| {
            let at = [harness.rng.random_range(-0.5..0.5), 0.1, [2.0, 3.0][i % 7 / 5]];
            one(at, [-3.0; 3], UPRIGHT, 1.0)
        })
        .collect();
    run(harness, "two depths", &join(&parts), &camera, 1 << 13).map(drop)
}

/// Fewer depth bits: splats are sorted by the remaining bits, ties break by index.
fn depth_bits(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(171, 115);
    let scene = random(&mut harness.rng, 3000, 0, &camera);
    for bits in [31, 30, 24, 17, 16, 9, 8, 1] {
        let (device, stream) = (harness.device.clone(), &mut harness.stream);
        let buffers = GaussianBuffers::from_host(stream, &scene)?;
        let render = Render::plan(&device, 3000, 1 << 15, 171, 115, RenderSettings::default())?
            .with_depth_bits(&device, bits)?;
        let mut frame = render.frame(&device)?;
        let mut recorder = stream.record()?;
        frame.forward(&mut recorder, &camera, buffers.views(), Default::default())?;
        stream.submit(recorder)?;
        let visible = stream.download(&frame.scratch.visible)?;
        let means = stream.download(&frame.scratch.means)?;
        let drawn: Vec<u32> = (0..3000u32).filter(|&i| visible[i as usize] != 0).collect();
        let keys: Vec<u32> = drawn.iter().map(|&i| means[i as usize][2].to_bits()).collect();
        let order = sort::by_bits(&keys, &drawn, 31 - bits..31).1;
        let got = stream.download(&frame.scratch.splat_from_rank)?;
        harness.exact(&format!("{bits} bits: order"), &got[..drawn.len()], &order);
    }
    let render = Render::plan(&harness.device, 1, 1, 16, 16, RenderSettings::default())?;
    for bits in [0, 32] {
        let refused = render.clone().with_depth_bits(&harness.device, bits).is_err();
        harness.holds(&format!("{bits} bits are refused"), refused);
    }
    Ok(())
}

fn image_sizes(harness: &mut Harness) -> Result<()> {
    for (width, height) in [(1, 1), (17, 3), (16, 16), (3, 33), (4097, 2)] {
        let camera = plain_camera(30.0, width, height);
        let wide = one([0.0, 0.0, 2.0], [5.0; 3], UPRIGHT, 1.0);
        let small = one([0.01, 0.01, 3.0], [-4.0; 3], UPRIGHT, 2.0);
        let what = format!("{width}×{height}");
        let out = run(harness, &what, &join(&[wide, small]), &camera, 1024)?;
        let tiles = grid(width, height).iter().product::<u32>();
        harness.exact(
            &format!("{what}: the wide one reaches every tile"),
            &[out.tile_counts[0]],
            &[tiles],
        );
    }
    Ok(())
}

/// Too little capacity: the count is complete, the nearest splats are kept, and nothing is written
/// out of bounds.
fn overflow(harness: &mut Harness) -> Result<()> {
    let camera = skew_camera(171, 115);
    let scene = random(&mut harness.rng, 2000, 0, &camera);
    let whole = run(harness, "room for all", &scene, &camera, 1 << 14)?;
    let total = whole.counts[1] as usize;
    harness.holds("the whole scene fits", total < 1 << 14);
    for capacity in [0, 1, 255, 1000, total - 1, total] {
        let what = format!("room for {capacity}");
        let out = run(harness, &what, &scene, &camera, capacity)?;
        harness.exact(&format!("{what}: counts"), &out.counts, &whole.counts);
        harness.exact(&format!("{what}: nearest"), &out.tiles, &whole.tiles[..capacity]);
        harness.exact(
            &format!("{what}: whose"),
            &out.splat_from_emitted,
            &whole.splat_from_emitted[..capacity],
        );
    }
    Ok(())
}

/// More pairs than 32 bits can count: neither the count nor the capacity test may wrap.
fn saturation(harness: &mut Harness) -> Result<()> {
    let (device, stream) = (harness.device.clone(), &mut harness.stream);
    let capacity = 1 << 12;
    let mut found = Vec::new();
    for counts in [
        vec![u32::MAX],
        vec![u32::MAX, 1],
        vec![1 << 31, (1 << 31) - 1],
        vec![1 << 31; 2],
        vec![1 << 31; 3],
        vec![0xffff * 0xffff; 300],
        vec![500_000; 9000],
        vec![2000, 2000],
        [vec![u32::MAX], vec![0; 500], vec![2000]].concat(),
    ] {
        let len = counts.len();
        let render = Render::plan(&device, len, capacity, 40, 30, RenderSettings::default())?;
        let mut frame = render.frame(&device)?;
        // Splats with empty rectangles: none of the counted pairs is emitted.
        let splats = frame.splats_mut();
        let mut recorder = stream.record()?;
        recorder.fill(splats.means, 0);
        recorder.fill(splats.conics, 0);
        recorder.fill(splats.rectangles, 0);
        stream.submit(recorder)?;
        let visible: Vec<u32> = counts.iter().map(|&count| count.min(1)).collect();
        stream.upload(&mut frame.scratch.visible, &visible)?;
        stream.upload(&mut frame.scratch.tile_counts, &counts)?;
        let mut recorder = stream.record()?;
        frame.bin(&mut recorder, len)?;
        stream.submit(recorder)?;
        let intersections = frame.counts(stream)?.intersections as u32;
        let fits = stream.download(&frame.scratch.fits)? == [1];
        let what = format!("{len} splats, the first on {} tiles", counts[0]);
        found.push((what, pairs(&counts), intersections, fits));
    }
    for (what, total, intersections, fits) in found {
        harness.exact(&format!("{what}: pairs"), &[intersections], &[total]);
        harness.exact(&format!("{what}: fits"), &[fits], &[total as usize <= capacity]);
    }
    Ok(())
}
