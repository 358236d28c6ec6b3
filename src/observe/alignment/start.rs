//! Initial estimate of the alignment: closed-form similarities per pair, joined along a tree.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::{CLOSE, LEAST, Problem, State};
use crate::geometry::sim3::{Sim3, align_points};
use crate::observe::pointmaps::{Pair, quantile};
use crate::types::Pose;
use crate::{Error, Result};

/// Rounds of reweighting.
const ROUNDS: usize = 15;
/// Lower bound of a residual in the reweighting: in pixels for the focal length, relative to the usual
/// depth for distances.
const LEAST_PIXELS: f64 = 1e-8;
const LEAST_DISTANCE: f64 = 1e-6;

/// The focal length as the median over the frames, and its deviation between them; `None` where no frame
/// determines one.
pub(super) fn focal(problem: &Problem) -> Option<(f64, f64)> {
    let focals: Vec<f64> = problem
        .told
        .par_iter()
        .filter_map(|told| {
            let own = told.iter().filter(|(_, k)| *k == 0);
            let seen = own.flat_map(|(e, _)| {
                let view = &problem.pairs[*e].views[0];
                let places = (0..view.points.len()).filter(|i| view.weights[*i] > 0.0);
                places.map(|i| (problem.offsets[i], view.points[i], view.weights[i]))
            });
            let seen = seen.map(|(offset, x, weight)| (offset, DVec2::new(x.x, x.y) / x.z, weight));
            weiszfeld(&seen.collect::<Vec<_>>())
        })
        .collect();
    if focals.is_empty() {
        return None;
    }
    let focal = quantile(focals.clone(), 0.5);
    let spread = quantile(focals.iter().map(|f| (f - focal).abs()).collect(), 0.5);
    Some((focal, 1.4826 * spread / focal))
}

/// The focal length with the least weighted sum of distances |pixel − f · slope|, by an iteratively
/// reweighted mean (Weiszfeld 1937).
fn weiszfeld(seen: &[(DVec2, DVec2, f64)]) -> Option<f64> {
    let mut focal = None;
    for _ in 0..=ROUNDS {
        let (mut above, mut below) = (0.0, 0.0);
        for (offset, slope, weight) in seen {
            let residual = focal.map_or(1.0, |f: f64| (*offset - f * *slope).length());
            let weight = weight / residual.max(LEAST_PIXELS);
            above += weight * offset.dot(*slope);
            below += weight * slope.dot(*slope);
        }
        focal = Some(above / below).filter(|f| *f > 0.0 && f.is_finite());
        focal?;
    }
    focal
}

/// The similarity that maps the points of a pair's backward map to those of its forward map, from the
/// pixels of both frames; `None` where too few points are confident in both.
fn there_from_back(there: &Pair, back: &Pair) -> Option<Sim3> {
    let (mut from, mut to, mut weights) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..2 {
        let (a, b) = (&there.views[k], &back.views[1 - k]);
        for i in 0..a.points.len() {
            let weight = a.weights[i] * b.weights[i];
            if weight > 0.0 {
                to.push(a.points[i]);
                from.push(b.points[i]);
                weights.push(weight);
            }
        }
    }
    if from.len() < LEAST {
        return None;
    }
    let least = LEAST_DISTANCE * quantile(to.iter().map(|x| x.length()).collect(), 0.5);
    let mut reweighted = weights.clone();
    let mut found = Sim3::IDENTITY;
    for _ in 0..ROUNDS {
        let aligned = align_points(&from, &to, Some(&reweighted), true).ok()?;
        found = aligned.reference_from_estimate;
        // Cauchy weights with the median deviation as their width, which gives outliers almost no weight.
        let offs: Vec<f64> =
            from.iter().zip(&to).map(|(x, y)| found.apply(*x).distance(*y)).collect();
        let width = quantile(offs.clone(), 0.5).max(least);
        for ((reweighted, weight), off) in reweighted.iter_mut().zip(&weights).zip(&offs) {
            *reweighted = weight / (1.0 + (off / width).powi(2));
        }
    }
    (found.scale > 0.0 && found.scale.is_finite()).then_some(found)
}

/// Logarithm of the factor that scales a pair's own depths to known ones.
fn scale(depths: &[f64], pair: &Pair) -> Option<f64> {
    let view = &pair.views[0];
    let ratio = |i: usize| {
        let used = depths[i] > 0.0 && view.weights[i] > 0.0;
        used.then(|| (depths[i] / view.points[i].z).ln())
    };
    let ratios: Vec<f64> = (0..depths.len()).filter_map(ratio).collect();
    (ratios.len() >= LEAST).then(|| quantile(ratios, 0.5))
}

/// The depths of its first frame that a pair gives.
fn own_depths(pair: &Pair, factor: f64) -> Vec<f64> {
    let view = &pair.views[0];
    let depth = |(x, weight): (&DVec3, &f64)| if *weight > 0.0 { factor * x.z } else { 0.0 };
    view.points.iter().zip(&view.weights).map(depth).collect()
}

/// Poses, factors and depths along the maximum spanning tree of the pairs' confidence scores.
///
/// # Errors
/// A frame is connected to no other one.
pub(super) fn start(problem: &Problem, focal: f64) -> Result<State> {
    let Problem { pairs, told, .. } = problem;
    let frames = told.len();
    // A link is numbered by the first of the two directions.
    let links: Vec<Option<Sim3>> =
        pairs.par_chunks_exact(2).map(|both| there_from_back(both[0], both[1])).collect();
    let score = |link: usize| pairs[2 * link].score + pairs[2 * link + 1].score;
    // Scores are positive, and positive floats order like their bits.
    let entry = |link: usize| (score(link).to_bits(), Reverse(link));
    let usable = |link: &usize| links[*link].is_some();
    let root = (0..links.len()).filter(usable).max_by_key(|link| entry(*link));
    let root = root.map_or(0, |link| pairs[2 * link].frames[0]);
    let mut poses: Vec<Option<Pose>> = vec![None; frames];
    let mut depths: Vec<Vec<f64>> = vec![Vec::new(); frames];
    poses[root] = Some(Pose::IDENTITY);
    let from_root = told[root].iter().find(|(_, k)| *k == 0);
    depths[root] = from_root.map_or(Vec::new(), |(e, _)| own_depths(pairs[*e], 1.0));
    // Prim's algorithm (1957).
    let links_of = |frame: usize| told[frame].iter().map(|(e, _)| e / 2).filter(usable).map(entry);
    let mut open: BinaryHeap<(u64, Reverse<usize>)> = links_of(root).collect();
    while let Some((_, Reverse(link))) = open.pop() {
        if pairs[2 * link].frames.iter().all(|f| poses[*f].is_some()) {
            continue;
        }
        // From the known frame to the new one.
        let (there, back) = (pairs[2 * link], pairs[2 * link + 1]);
        let similarity = links[link].unwrap_or(Sim3::IDENTITY);
        let (here, there, known_from_new) = match poses[there.frames[0]] {
            Some(_) => (there, back, similarity),
            None => (back, there, similarity.inverse()),
        };
        let [known, new] = here.frames;
        let factor = scale(&depths[known], here).unwrap_or(0.0).exp();
        let relative =
            Pose::new(known_from_new.rotation, factor * known_from_new.translation).inverse();
        poses[new] = poses[known].map(|pose| relative * pose);
        depths[new] = own_depths(there, factor * known_from_new.scale);
        open.extend(links_of(new));
    }
    if let Some(lost) = poses.iter().position(Option::is_none) {
        return Err(Error::Failed(format!(
            "no pointmaps that are believed lead to frame {lost} from the others"
        )));
    }
    let poses: Vec<Pose> = poses.into_iter().flatten().collect();
    let scales: Vec<f64> =
        pairs.iter().map(|pair| scale(&depths[pair.frames[0]], pair).unwrap_or(0.0)).collect();
    let mut state = State { poses, focal, scales, inverse: Vec::new(), close: CLOSE[0] };
    state.inverse = medians(problem, &state);
    Ok(state)
}

/// Median over the maps of each inverse depth; 0 where no map gives one.
fn medians(problem: &Problem, state: &State) -> Vec<Vec<f64>> {
    let of_frame = |told: &super::Told| {
        let views: Vec<Pose> =
            told.iter().map(|view| problem.view_from_pair(state, *view)).collect();
        let at = |i: usize| {
            let says = |((e, k), pose): (&(usize, usize), &Pose)| {
                let view = &problem.pairs[*e].views[*k];
                let z = pose.apply(state.scales[*e].exp() * view.points[i]).z;
                (view.weights[i] > 0.0 && z > 0.0).then(|| z.recip())
            };
            quantile(told.iter().zip(&views).filter_map(says).collect(), 0.5)
        };
        (0..problem.offsets.len()).map(at).collect()
    };
    problem.told.par_iter().map(of_frame).collect()
}
