//! Chooses the rigid motion of a clip that belongs to the static world.
//!
//! If movers fill most of the image, the motion that most points agree with may be a mover's, or a compromise
//! between several motions. So rigid motions are extracted from the clip one after another, each from the
//! points that the previous ones do not explain. The tolerance is so small that no compromise holds over all
//! frames. The static world is then recognised as the background: it extends to the image borders, and other
//! motions occlude it more often than it occludes them.

use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::judgement::explained_by;
use super::{Cameras, Focal, Strictness, reconstruct};
use crate::observe::{PointTrack, TrackOptions};
use crate::track::Options;
use crate::track::observer::Work;
use crate::{Error, Result};

/// Approximate number of tracks that the search uses.
const TRACKS: usize = 3000;
/// Maximum number of times that the static world's cameras are solved for.
const AGAIN: u64 = 4;
/// Minimum factor by which each repetition must raise the explained share for another one to follow.
const GAIN: f64 = 1.01;
/// The search ends when the unexplained tracks have less than this share of the total prior weight.
const LEFT: f64 = 0.2;
/// Share of a track's observations above which cameras explain the track.
const EXPLAINED: f64 = 0.5;
/// Weight of occlusion order relative to the explained share: of being always occluded and never occluding.
const ORDER: f64 = 1.0;
/// Number of occlusion places at which the order counts half as much as with very many places.
const PLACES: f64 = 20.0;
/// Distance from the image border, in pixels, within which a track's end may mean that it left the image.
const MARGIN: f64 = 3.0;
/// Radius of a point's neighbourhood, in spacings of the tracked points.
const NEIGHBOURHOOD: f64 = 1.2;

/// The evidence that a rigid motion is that of the static world.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RigidMotion {
    /// The share of the observations that it explains; observations near the image borders have the largest
    /// weights.
    pub explained: f64,
    /// Number of places where something else occludes the points of this motion.
    pub hidden: usize,
    /// Number of places where the points of this motion occlude something else.
    pub hides: usize,
}

/// The rigid motions of a clip, and the index of the one chosen for the static world.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(in crate::track) struct Motions {
    pub found: Vec<RigidMotion>,
    pub chosen: usize,
    /// By track: its weight when two solutions for the static world are compared; 0 if another motion
    /// explains the track.
    pub weights: Vec<f64>,
}

/// Difference of scores below which the runner-up makes the choice doubtful.
const NEAR: f64 = 0.1;

/// The score of each motion; the static world's motion has the highest.
fn scores(found: &[RigidMotion]) -> Vec<f64> {
    let places: usize = found.iter().map(|motion| motion.hidden + motion.hides).sum();
    let score = |motion: &RigidMotion| {
        let order = (motion.hidden as f64 - motion.hides as f64) / (places as f64 + PLACES);
        motion.explained + ORDER * order
    };
    found.iter().map(score).collect()
}

impl Motions {
    /// The note on the chosen motion, with the reasons.
    pub fn note(&self) -> String {
        let RigidMotion { explained, hidden, hides } = self.found[self.chosen];
        let all = self.found.len();
        let chosen = format!(
            "the clip shows {all} rigid motion{} that may be the static world's; number {}, counted from 0, \
             was taken: it explains {:.0} % of what is seen, things near the picture's edges counting most, \
             is hidden by others at {hidden} places and hides them at {hides}",
            if all == 1 { "" } else { "s" },
            self.chosen,
            100.0 * explained,
        );
        let others = (0..all).filter(|m| *m != self.chosen);
        let scores = scores(&self.found);
        let next = others.max_by(|&a, &b| scores[a].total_cmp(&scores[b]));
        match next {
            Some(next) if scores[next] + NEAR > scores[self.chosen] => format!(
                "{chosen}; number {next} is nearly as likely, so the cameras are doubtful: it can be \
                 taken as the static one"
            ),
            _ => chosen,
        }
    }
}

/// An initial focal length, and the cameras that were found with it.
type Solution = (Focal, Cameras);

/// The inputs of the search for the static world.
#[derive(Clone, Copy)]
pub(in crate::track) struct Search<'a> {
    pub tracks: &'a [PointTrack],
    /// The prior weight of each track as static.
    pub prior: &'a [f64],
    pub options: &'a Options,
    pub size: (usize, usize),
    pub frames: usize,
}

impl Search<'_> {
    /// Finds the rigid motions of the clip and the cameras of the static world's motion: the one that the
    /// options select, else the one with the highest score. `first` are cameras from all observations, if
    /// any; they are kept if they explain the static world better.
    ///
    /// # Errors
    /// No motion was found, or the index in the options is not less than the number of motions; errors of the
    /// adjustment; whatever the observer of `work` returns.
    pub fn static_world(
        self,
        first: Option<Solution>,
        work: &mut Work,
    ) -> Result<(Solution, Motions)> {
        let (mut solutions, shares) = self.rigid_motions(work)?;
        let everything = vec![1.0; self.tracks.len()];
        let motions = self.judged(&shares)?;
        let (focal, mut cameras) = solutions.swap_remove(motions.chosen);
        cameras.adjust(self.tracks, &following(&shares[motions.chosen], &everything), &focal)?;
        cameras.strictness = Strictness::Usual;
        let explained = |cameras: &Cameras| cameras.explained(self.tracks, &motions.weights);
        let found = (focal, cameras);
        let best = match first {
            Some(first) if explained(&first.1) > explained(&found.1) => first,
            _ => found,
        };
        Ok((self.refined(best, &motions, work)?, motions))
    }

    /// Extracts rigid motions that each explain a part of the tracks, starting with all tracks. Also returns,
    /// by motion and track, the explained share of the track.
    fn rigid_motions(self, work: &mut Work) -> Result<(Vec<Solution>, Vec<Vec<f64>>)> {
        let mut weights = self.prior.to_vec();
        let (everything, all) = (vec![1.0; weights.len()], weights.iter().sum::<f64>());
        let (mut solutions, mut shares) = (Vec::new(), Vec::new());
        while solutions.len() < Options::MOST_MOTIONS && weights.iter().sum::<f64>() > LEFT * all {
            let part = format!("cameras/motion-{}", solutions.len());
            let (focal, cameras) = match self.solve_by_few(&weights, work, &part) {
                Ok(solution) => solution,
                Err(error) if work.ended || solutions.is_empty() => return Err(error),
                // The remaining tracks do not span all frames.
                Err(_) => break,
            };
            let explained = cameras.shares(self.tracks, &everything);
            for (weight, share) in weights.iter_mut().zip(&explained) {
                if *share > EXPLAINED {
                    *weight = 0.0;
                }
            }
            solutions.push((focal, cameras));
            shares.push(explained);
        }
        Ok((solutions, shares))
    }

    /// A strict solution from a subset of the weighted tracks, and from larger subsets if these do not lead
    /// through all frames.
    fn solve_by_few(self, weights: &[f64], work: &mut Work, part: &str) -> Result<Solution> {
        let mut stride = self.tracks.len().div_ceil(TRACKS).max(1);
        loop {
            let few: Vec<PointTrack> = self.tracks.iter().step_by(stride).cloned().collect();
            let weights: Vec<f64> = weights.iter().step_by(stride).copied().collect();
            let part = format!("{part}-{stride}");
            let search = Search { tracks: &few, ..self };
            match search.solve(&weights, self.options.seed, work, &part) {
                Err(_) if stride > 1 && !work.ended => stride /= 2,
                found => {
                    let (focal, mut cameras) = found?;
                    cameras.anchors = vec![None; self.tracks.len()];
                    return Ok((focal, cameras));
                }
            }
        }
    }

    /// A strict solution from the weighted tracks.
    fn solve(self, weights: &[f64], seed: u64, work: &mut Work, part: &str) -> Result<Solution> {
        let Search { tracks, options, size, frames, .. } = self;
        let strict = Strictness::Strict;
        let focal = Focal::choose(options, size, frames, tracks, weights, strict);
        let cameras = reconstruct(tracks, weights, &focal, frames, seed, strict, work, part)?;
        Ok((focal, cameras))
    }

    /// The evidence for each motion and the choice, from the explained share of each track.
    fn judged(self, shares: &[Vec<f64>]) -> Result<Motions> {
        let Search { tracks, prior, options, .. } = self;
        let best_of = |i: usize| {
            let explain = (0..shares.len()).filter(|&m| shares[m][i] > EXPLAINED);
            explain.max_by(|&a, &b| shares[a][i].total_cmp(&shares[b][i]).then(b.cmp(&a)))
        };
        let motion_of: Vec<Option<usize>> = (0..tracks.len()).map(best_of).collect();
        let ends = Ends::new(tracks, self.size, self.frames);
        let evidence = |m: usize| {
            let (hidden, hides) = ends.order(&motion_of, m);
            RigidMotion { explained: explained_by(tracks, prior, &shares[m]), hidden, hides }
        };
        let found: Vec<RigidMotion> = (0..shares.len()).map(evidence).collect();
        let scores = scores(&found);
        let best =
            (0..found.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b]).then(b.cmp(&a)));
        let chosen = options.static_motion.or(best).unwrap_or(0);
        if chosen >= found.len() {
            return Err(Error::Input(format!(
                "rigid motion {chosen} was asked for as the static world's, but the clip shows {}, \
                 counted from 0",
                found.len()
            )));
        }
        let of_others = |i: usize| motion_of[i].is_some_and(|m| m != chosen);
        let weights =
            (0..tracks.len()).map(|i| if of_others(i) { 0.0 } else { prior[i] }).collect();
        Ok(Motions { found, chosen, weights })
    }

    /// Refines the chosen motion's solution. The initial solution was found from few tracks, with a focal
    /// length from these and others. Now it is solved from the tracks that follow the motion, and from all
    /// tracks that no other motion explains, until the explained share no longer grows.
    fn refined(self, start: Solution, motions: &Motions, work: &mut Work) -> Result<Solution> {
        let Search { tracks, .. } = self;
        let everything = vec![1.0; tracks.len()];
        let mut best = start;
        let mut most = best.1.explained(tracks, &motions.weights);
        for again in 0..AGAIN {
            let before = most;
            let strictly = Cameras { strictness: Strictness::Strict, ..best.1.clone() };
            let follows = following(&strictly.shares(tracks, &everything), &motions.weights);
            for (name, weights) in [("follows", &follows), ("rest", &motions.weights)] {
                let part = format!("cameras/static-{again}-{name}");
                let seed = self.options.seed.wrapping_add(again);
                let (focal, mut cameras) = match self.solve(weights, seed, work, &part) {
                    Ok(solution) => solution,
                    Err(error) if work.ended => return Err(error),
                    Err(_) => continue,
                };
                cameras.strictness = Strictness::Usual;
                let explained = cameras.explained(tracks, &motions.weights);
                if explained > most {
                    (most, best) = (explained, (focal, cameras));
                }
            }
            if most < GAIN * before {
                break;
            }
        }
        Ok(best)
    }
}

/// The weights of the tracks that cameras explain, from the explained share of each; 0 for the others.
fn following(shares: &[f64], weights: &[f64]) -> Vec<f64> {
    let weight = |(share, weight): (&f64, &f64)| if *share > EXPLAINED { *weight } else { 0.0 };
    shares.iter().zip(weights).map(weight).collect()
}

/// The ends of tracks, and the tracks that are seen there instead.
struct Ends {
    /// For each end of a track inside the image: the track, and the track nearest to its extrapolated
    /// position in the next frame, or in the frame before its first.
    replaced: Vec<(usize, usize)>,
}

impl Ends {
    fn new(tracks: &[PointTrack], (width, height): (usize, usize), frames: usize) -> Ends {
        let radius = NEIGHBOURHOOD * TrackOptions::for_size(width, height).spacing as f64;
        let columns = (width as f64 / radius) as usize + 1;
        let rows = (height as f64 / radius) as usize + 1;
        let cell = |p: DVec2| {
            let x = ((p.x / radius) as usize).min(columns - 1);
            let y = ((p.y / radius) as usize).min(rows - 1);
            (x, y)
        };
        let mut of_cell: Vec<Vec<Vec<usize>>> = vec![vec![Vec::new(); columns * rows]; frames];
        for (i, track) in tracks.iter().enumerate() {
            for (frame, pixel) in track.frames.iter().zip(&track.pixels) {
                let (x, y) = cell(*pixel);
                of_cell[*frame][y * columns + x].push(i);
            }
        }
        let (right, lower) = (width as f64 - MARGIN, height as f64 - MARGIN);
        let inside = |p: DVec2| p.x > MARGIN && p.y > MARGIN && p.x < right && p.y < lower;
        let nearest = |frame: usize, place: DVec2| {
            let (x, y) = cell(place);
            let (xs, ys) =
                (x.saturating_sub(1)..(x + 2).min(columns), y.saturating_sub(1)..(y + 2).min(rows));
            let cells = ys.flat_map(|y| xs.clone().map(move |x| y * columns + x));
            cells
                .flat_map(|c| of_cell[frame][c].iter().copied())
                .filter_map(|j| Some((tracks[j].at(frame)?.distance(place), j)))
                .filter(|(distance, _)| *distance < radius)
                .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
        };
        let replaced = (0..tracks.len())
            .into_par_iter()
            .flat_map_iter(|i| {
                let pixels = &tracks[i].pixels;
                let beyond = |last: usize, before: usize| 2.0 * pixels[last] - pixels[before];
                let n = pixels.len();
                let seen = &tracks[i].frames;
                // The position can be extrapolated only from two consecutive frames.
                let goes_on = |k: usize| n > 2 && seen[k] + 1 == seen[k + 1];
                let after = goes_on(n - 2).then(|| (tracks[i].end(), beyond(n - 1, n - 2)));
                let earlier = tracks[i].first().checked_sub(1).filter(|_| goes_on(0));
                let ends = after.into_iter().chain(earlier.map(|frame| (frame, beyond(0, 1))));
                ends.filter(|(frame, place)| *frame < frames && inside(*place))
                    .filter_map(|(frame, place)| Some((i, nearest(frame, place)?.1)))
                    .collect::<Vec<_>>()
            })
            .collect();
        Ends { replaced }
    }

    /// Number of places where the tracks of a motion are occluded by others, and number of places where they
    /// occlude others.
    fn order(&self, motions: &[Option<usize>], motion: usize) -> (usize, usize) {
        let count = |hidden: bool| {
            let counts = |(i, j): &&(usize, usize)| {
                let [behind, before] = [*i, *j].map(|i| motions[i]);
                behind != before && (if hidden { behind } else { before }) == Some(motion)
            };
            self.replaced.iter().filter(counts).count()
        };
        (count(true), count(false))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A static wall, and in front of it a board that moves by 3 pixels per frame: points of the wall are
    /// seen until the board arrives, and again after it has passed.
    fn board_before_wall(frames: usize) -> (Vec<PointTrack>, Vec<Option<usize>>) {
        let (mut tracks, mut motions) = (Vec::new(), Vec::new());
        let mut add = |first: usize, pixels: Vec<DVec2>, motion: usize| {
            if pixels.len() > 1 {
                let deviation = vec![0.1; pixels.len()];
                tracks.push(PointTrack::followed(first, pixels, deviation));
                motions.push(Some(motion));
            }
        };
        let board = |frame: usize| 20.0 + 3.0 * frame as f64..60.0 + 3.0 * frame as f64;
        for y in (5..90).step_by(5).map(f64::from) {
            for x in (5..160).step_by(5).map(f64::from) {
                let seen = |frame: &usize| !board(*frame).contains(&x);
                let until = (0..frames).take_while(seen).count();
                add(0, vec![DVec2::new(x, y); until], 0);
                let again = (0..frames).rev().take_while(seen).count();
                if until < frames {
                    add(frames - again, vec![DVec2::new(x, y); again], 0);
                }
                if board(0).contains(&x) {
                    let along = |frame: usize| DVec2::new(x + 3.0 * frame as f64, y);
                    add(0, (0..frames).map(along).collect(), 1);
                }
            }
        }
        (tracks, motions)
    }

    #[test]
    fn what_stands_behind_is_hidden() {
        let frames = 12;
        let (tracks, motions) = board_before_wall(frames);
        let ends = Ends::new(&tracks, (160, 90), frames);
        let (hidden, hides) = ends.order(&motions, 0);
        assert!(hidden > 100 && hides == 0, "the wall: {hidden}, {hides}");
        assert_eq!(ends.order(&motions, 1), (hides, hidden), "the board");
        // A track of the same motion, or of no motion, is no occlusion.
        assert_eq!(ends.order(&vec![Some(0); tracks.len()], 0), (0, 0));
        assert_eq!(ends.order(&vec![None; tracks.len()], 0), (0, 0));
    }

    #[test]
    fn a_background_beats_what_is_larger() {
        let background = RigidMotion { explained: 0.2, hidden: 1107, hides: 189 };
        let walker = RigidMotion { explained: 0.22, hidden: 500, hides: 540 };
        let found = vec![walker, background];
        let scores = scores(&found);
        assert!(scores[1] > scores[0] + NEAR, "{scores:?}");
        let note = |found: Vec<RigidMotion>| Motions { found, chosen: 1, weights: vec![] }.note();
        let sure = note(found);
        assert!(sure.contains("number 1") && !sure.contains("doubtful"), "{sure}");
        // Without occlusions, only the explained share decides.
        let alike = |explained| RigidMotion { explained, hidden: 0, hides: 0 };
        let doubtful = note(vec![alike(0.21), alike(0.22)]);
        assert!(doubtful.contains("number 0 is nearly as likely"), "{doubtful}");
    }
}
