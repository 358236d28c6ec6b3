//! Alternating estimation of cameras and masks, each from the other's result.

use serde::{Deserialize, Serialize};

use super::cameras::{self, Cameras, Focal, Motions, Standpoint, Strictness};
use super::observer::Work;
use super::{Options, Stage, masks, mended, residual, share, still};
use crate::data::Lens;
use crate::observe::{NeighbourFlow, PointTrack};
use crate::types::Image;
use crate::{Error, Result};

/// The inputs of cameras and masks.
#[derive(Clone, Copy)]
pub(super) struct Known<'a> {
    pub frames: &'a [Image],
    pub options: &'a Options,
    pub flow: &'a NeighbourFlow,
    pub tracks: &'a [PointTrack],
    /// Supplied masks.
    pub supplied: Option<&'a [Image]>,
}

/// The state before and after a round of masks and cameras.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct SoFar {
    pub focal: Focal,
    pub cameras: Cameras,
    pub masks: Vec<Image>,
    /// The weight of each track as static.
    pub weights: Vec<f64>,
    /// The rigid motions that the static world was chosen from, if the choice was ambiguous.
    pub motions: Option<Motions>,
    /// The comparison with the cameras that start from a network's guess, if there is one.
    pub guess: Option<Guessed>,
}

/// The explained shares of the observations: with cameras that start from a network's guess, and with cameras
/// from the video alone.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Guessed {
    pub begun: f64,
    pub alone: f64,
}

impl Guessed {
    /// Whether the cameras that start from the guess are kept. If both explain about the same share, they are
    /// preferred, because the network uses more information than the tracks contain.
    pub fn is_kept(&self) -> bool {
        self.begun >= ALIKE * self.alone
    }
}

impl Known<'_> {
    /// The lens, if the clip shows that it is not a pinhole, and the cameras with it.
    pub fn lens(self, so_far: &SoFar) -> Result<Option<(Lens, Cameras)>> {
        let SoFar { cameras, weights, focal, motions, .. } = so_far;
        match self.options.lens && motions.is_none() {
            true => cameras.lens(self.tracks, weights, focal),
            false => Ok(None),
        }
    }

    /// Cameras before masks are known.
    pub fn first_cameras(self, work: &mut Work) -> Result<SoFar> {
        let Known { options, flow, tracks, supplied, .. } = self;
        let size = (flow.width, flow.height);
        let weights: Vec<f64> = match supplied {
            Some(masks) => masks::static_weights(tracks, masks),
            None => tracks.iter().map(|t| still::border_prior(t, size)).collect(),
        };
        if let Some(masks) = supplied {
            demand_static(masks, &weights)?;
        }
        let found = options.poses.is_none() && options.static_motion.is_none();
        let tripod = found && still::is_fixed(tracks, &weights, flow);
        let usual = Strictness::Usual;
        let mut focal = Focal::choose(options, size, flow.frames, tracks, &weights, usual);
        let (mut searched, mut guessed) = (None, None);
        let cameras = if tripod {
            Cameras::fixed(&focal, flow, tracks.len())
        } else if let Some(poses) = &options.poses {
            Cameras::supplied(poses, options.refined.poses, &focal, tracks, &weights)?
        } else {
            let (n, part) = (flow.frames, "cameras/posing");
            if found {
                still::refuse_zoom(tracks, &weights, flow)?;
            }
            let first =
                cameras::reconstruct(tracks, &weights, &focal, n, options.seed, usual, work, part);
            let first = match first {
                Err(error) if work.ended => return Err(error),
                first => first,
            };
            let explained = |cameras: &Cameras| cameras.explained(tracks, &weights);
            let begun = options.guess.as_ref().filter(|_| found).and_then(|guess| {
                let focal = Focal::of_guess(options, guess, size);
                let cameras = Cameras::begun(&guess.poses, &focal, tracks, &weights).ok()?;
                Some((focal, cameras))
            });
            let first = match begun {
                Some((of_guess, begun)) => {
                    let alone = first.as_ref().map_or(0.0, explained);
                    let shares = Guessed { begun: explained(&begun), alone };
                    guessed = Some(shares);
                    if shares.is_kept() {
                        focal = of_guess;
                        Ok(begun)
                    } else {
                        first
                    }
                }
                None => first,
            };
            let moving = first.as_ref().map_or(0.0, explained);
            let turning = found
                .then(|| Cameras::turning(tracks, &weights, &focal, n, options.seed).ok())
                .flatten();
            match (first, turning) {
                (_, Some(turning)) if explained(&turning) > TURNS * moving.max(PLAIN) => turning,
                (first, _) if supplied.is_some() => first?,
                (Ok(first), _) if found && moving > PLAIN => first,
                (first, _) => {
                    let first = first.ok().map(|cameras| (focal.clone(), cameras));
                    let search =
                        cameras::Search { tracks, prior: &weights, options, size, frames: n };
                    let (solution, motions) = search.static_world(first, work)?;
                    searched = Some(motions);
                    focal = solution.0;
                    solution.1
                }
            }
        };
        let masks = supplied.map(<[Image]>::to_vec).unwrap_or_default();
        let plain = cameras.standpoint == Standpoint::Moves && searched.is_none();
        let guess = guessed.filter(|_| plain);
        Ok(SoFar { focal, cameras, masks, weights, motions: searched, guess })
    }

    /// Supplied masks, repaired where they slip or flicker, and the frames that were repaired.
    pub fn mend(
        self,
        masks: &[Image],
        cameras: &Cameras,
        work: &mut Work,
    ) -> Result<(Vec<Image>, Vec<usize>)> {
        let Known { frames, flow, .. } = self;
        let seen = residual::triangulate_frames(cameras, flow, work, "mended", 0.0..0.2)?;
        let observed = masks::Observed { frames, cameras, flow, seen: &seen };
        mended::mended(masks, observed, work, "mended", 0.2..0.4)
    }

    /// Updates the masks from the cameras, then the cameras from the masks.
    pub fn round(
        self,
        so_far: SoFar,
        work: &mut Work,
        part: &str,
        shares: std::ops::Range<f64>,
    ) -> Result<SoFar> {
        let Known { frames, options, flow, tracks, supplied } = self;
        let SoFar { mut focal, mut cameras, mut masks, mut weights, motions, mut guess } = so_far;
        if supplied.is_none() {
            let middle = 0.5 * (shares.start + shares.end);
            let first = shares.start..middle;
            let seen = residual::triangulate_frames(&cameras, flow, work, part, first)?;
            let second = middle..shares.end;
            let observed = masks::Observed { frames, cameras: &cameras, flow, seen: &seen };
            masks = masks::segment(observed, None, work, part, second)?;
        }
        work.progress(Stage::Masks, shares.end)?;
        if cameras.standpoint != Standpoint::Fixed {
            weights = masks::static_weights(tracks, &masks);
            // If much of the image moves, the masks may be worse than the cameras.
            let before = motions.is_some().then(|| cameras.clone());
            let parallax = cameras.have_parallax();
            let kept = cameras.adjust(tracks, &weights, &focal).map(|()| cameras);
            // The first cameras may be a compromise with the movers' motion, which adjustment does not leave.
            // New cameras are therefore reconstructed from the static tracks.
            cameras = if parallax && options.poses.is_none() && supplied.is_none() {
                let part = format!("{part}/posing");
                let (seed, n, usual) = (options.seed, flow.frames, Strictness::Usual);
                let size = (flow.width, flow.height);
                let chosen = Focal::choose(options, size, n, tracks, &weights, usual);
                let afresh =
                    cameras::reconstruct(tracks, &weights, &chosen, n, seed, usual, work, &part);
                // Masks made with some cameras do not exclude movers that agree with those cameras.
                let judges = motions.as_ref().map_or(&weights, |motions| &motions.weights);
                let explained = |cameras: &Cameras| cameras.explained(tracks, judges);
                // Cameras that start from a network's guess are not such a compromise.
                let told = guess.as_ref().is_some_and(Guessed::is_kept);
                let crowded = share(&masks) >= CROWDED && motions.is_none() && !told;
                let factor = if told { ALIKE } else { 1.0 };
                let kept = match (kept, before) {
                    (Ok(kept), Some(before)) if explained(&before) > explained(&kept) => Ok(before),
                    (kept, _) => kept,
                };
                match (kept, afresh) {
                    (_, Err(error)) if work.ended => return Err(error),
                    (Ok(kept), Ok(afresh))
                        if !crowded && explained(&kept) >= factor * explained(&afresh) =>
                    {
                        kept
                    }
                    (_, Ok(afresh)) => {
                        focal = chosen;
                        guess = guess.filter(|shares| !shares.is_kept());
                        afresh
                    }
                    (kept, Err(_)) => kept?,
                }
            } else {
                kept?
            };
            work.progress(Stage::Cameras, 1.0)?;
        }
        Ok(SoFar { focal, cameras, masks, weights, motions, guess })
    }
}

/// Explained share of the observations, weighted by the prior, above which cameras are those of the static
/// world. Correct cameras explain 0.27 to 0.39 where walkers fill three quarters of the image, and 0.54 or
/// more of hand-held clips with one or two movers.
const PLAIN: f64 = 0.45;
/// A rotating camera is chosen if it explains more than this share of what a moving camera explains. A moving
/// camera has a depth for each point, with which it can fit noise and movers. On clips with parallax a
/// rotation explains at most half as much.
const TURNS: f64 = 0.85;
/// Ratio of explained shares above which two solutions count as equally good.
const ALIKE: f64 = 0.99;
/// Share of moving pixels above which the first cameras are never kept: masks that were made with them do not
/// exclude movers that agree with the compromise.
const CROWDED: f64 = 0.3;
/// Checks that supplied masks leave enough static points to estimate cameras.
fn demand_static(masks: &[Image], weights: &[f64]) -> Result<()> {
    // Two views need eight points.
    let stay = weights.iter().filter(|weight| **weight > 0.05).count();
    if stay >= 8 {
        return Ok(());
    }
    Err(Error::Input(format!(
        "the masks leave nothing static to find cameras by: they say that {:.1} % of the pixels \
         move, and {stay} of {} points that were followed stand still; white is what moves",
        100.0 * share(masks),
        weights.len()
    )))
}
