//! Density control: relocation (3DGS-MCMC), and the classical decisions with their compaction.

use super::{sizes, thousands};
use crate::bench::job::{Entry, Job};
use crate::check::density::{AdaptationWorkload, RelocationWorkload};

pub(super) fn entries(quick: bool) -> Vec<Entry> {
    let mut all = Vec::new();
    for n in sizes(quick, &[10_000usize, 200_000]) {
        let size = format!("{} Gaussians", thousands(n));
        all.push(Entry::new("density/relocate", size.clone(), move |d, seed| {
            Job::of(d, seed, |h| RelocationWorkload::random(h, n))
        }));
        all.push(Entry::new("density/adapt", size, move |d, seed| {
            Job::of(d, seed, |h| AdaptationWorkload::random(h, n))
        }));
    }
    all
}
