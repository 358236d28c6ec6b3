//! Benchmarks of the motion model: nearest control points, skinning, the deformation network,
//! rigidity.

use super::{NARROW, sizes, thousands};
use crate::bench::job::{Entry, Job};
use crate::check::Pass;
use crate::check::arap::ArapWorkload;
use crate::check::deform::{NearestWorkload, SkinWorkload};
use crate::check::mlp::MlpWorkload;
use crate::types::NetShape;

/// Number of control points in the skinning rows.
const NODES: usize = 512;

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for n in sizes(quick, &[10_000usize, 100_000]) {
        let size = format!("{} Gaussians, {NODES} nodes", thousands(n));
        all.push(Entry::new("deform/nearest", size.clone(), move |d, seed| {
            Job::of(d, seed, |h| NearestWorkload::random(h, n, NODES))
        }));
        for (id, pass) in [("deform/skin", Pass::Forward), ("deform/skin_backward", Pass::Backward)]
        {
            all.push(Entry::new(id, size.clone(), move |d, seed| {
                Job::of(d, seed, |h| SkinWorkload::random(h, n, NODES, pass))
            }));
        }
    }
    for (name, shape, rows) in sizes(
        quick,
        &[("64 wide", NARROW, 512), ("64 wide", NARROW, 1536), ("256 wide", NetShape::PAPER, 512)],
    ) {
        let size = format!("{name}, {} layers, {rows} rows", shape.depth);
        for (id, pass) in [("mlp/forward", Pass::Forward), ("mlp/backward", Pass::Backward)] {
            all.push(Entry::new(id, size.clone(), move |d, seed| {
                Job::of(d, seed, |h| MlpWorkload::random(h, shape, rows, pass))
            }));
        }
    }
    for nodes in sizes(quick, &[512usize, 2048]) {
        all.push(Entry::new("arap/energy", format!("{nodes} nodes, 10 edges"), move |d, seed| {
            Job::of(d, seed, |h| ArapWorkload::random(h, nodes, 10))
        }));
    }
    all
}
