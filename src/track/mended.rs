//! Repair of supplied masks that flicker or slip, from the masks of neighbouring frames and from measured
//! motion.

use glam::DVec2;
use rayon::prelude::*;

use super::Stage;
use super::masks::{Observed, all_odds, clean, edges, gather, relax};
use super::observer::Work;
use crate::Result;
use crate::observe::NeighbourFlow;
use crate::types::Image;

/// Log odds of a supplied mask, and of all neighbouring masks together.
const SUPPLIED: f32 = 1.5;
/// Weights of the masks at a distance of one frame and of two frames.
const AROUND: [f32; 2] = [1.0, 0.4];
/// Intersection over union of a supplied mask and its repaired version below which the supplied mask is
/// wrong.
const LEAST_OVERLAP: f64 = 0.7;

/// Supplied masks (0 or 1), repaired in frames whose mask contradicts both the neighbouring masks and the
/// measured motion: masks that flicker or slip. Regions that all masks omit stay static, whether they move or
/// not. Also returns the frames whose mask was replaced.
pub(super) fn mended(
    supplied: &[Image],
    observed: Observed<'_>,
    work: &mut Work,
    part: &str,
    shares: std::ops::Range<f64>,
) -> Result<(Vec<Image>, Vec<usize>)> {
    let Observed { frames, flow, .. } = observed;
    let odds = all_odds(observed, work, part, Stage::Masks, shares)?;
    let support = observed.support();
    let mend = |frame: usize| -> Option<Image> {
        let gathered = gather(flow, &odds, &support, frame);
        let around = around(flow, supplied, frame);
        let mut total = Vec::with_capacity(gathered.len());
        for (i, own) in gathered.iter().enumerate() {
            let said = if supplied[frame].pixels[i] > 0.5 { SUPPLIED } else { -SUPPLIED };
            let contradicted = said * around[i] < 0.0;
            total.push(if contradicted { said + SUPPLIED * around[i] + own } else { said });
        }
        let mut u = relax(&total, &edges(&frames[frame], flow, frame), flow.width);
        clean(&mut u, flow.width);
        u.iter_mut().for_each(|u| *u = u.round());
        let pairs = u.iter().zip(&supplied[frame].pixels);
        let (both, either) = pairs.fold((0, 0), |(both, either), (a, b)| {
            let (a, b) = (*a > 0.5, *b > 0.5);
            (both + usize::from(a && b), either + usize::from(a || b))
        });
        let wrong = (both as f64) < LEAST_OVERLAP * either as f64;
        wrong.then(|| Image { pixels: u, ..supplied[frame].clone() })
    };
    let mended: Vec<Option<Image>> = (0..frames.len()).into_par_iter().map(mend).collect();
    let changed = (0..frames.len()).filter(|&frame| mended[frame].is_some()).collect();
    let masks = mended.into_iter().zip(supplied).map(|(m, given)| m.unwrap_or(given.clone()));
    Ok((masks.collect(), changed))
}

/// The vote of the neighbouring masks on a frame's pixels, followed along the flow: from −1 (static) to 1
/// (moving).
fn around(flow: &NeighbourFlow, masks: &[Image], frame: usize) -> Vec<f32> {
    let follow = |i: usize| {
        let pixel = DVec2::new((i % flow.width) as f64 + 0.5, (i / flow.width) as f64 + 0.5);
        let (mut sum, mut total) = (0.0, 0.0);
        flow.follow(frame, pixel, AROUND.len(), |other, chain| {
            let x = (chain.pixel.x as usize).min(flow.width - 1);
            let y = (chain.pixel.y as usize).min(flow.height - 1);
            let weight = AROUND[other.abs_diff(frame) - 1] * chain.confidence;
            let moves = masks[other].pixels[y * flow.width + x] > 0.5;
            sum += if moves { weight } else { -weight };
            total += weight;
        });
        if total > 0.0 { sum / total } else { 0.0 }
    };
    (0..flow.width * flow.height).map(follow).collect()
}

#[cfg(test)]
mod tests {
    use super::super::residual::triangulate_frames;
    use super::super::sliding::*;
    use super::*;

    /// A square that moves down in front of a wall that slides by. The images have no content: only the flow
    /// shows that the square moves.
    #[test]
    fn only_what_is_contradicted_is_mended() {
        let square = |frame: usize, p: DVec2| {
            let (x, y) = (26.0 - 2.0 * frame as f64, 8.0 + 1.5 * frame as f64);
            within(p, (x, y), (x + 14.0, y + 14.0))
        };
        let down = DVec2::new(0.0, 1.5);
        let flow = flow(|frame, p| if square(frame, p) { wall() + down } else { wall() });
        let truth: Vec<Image> =
            (0..FRAMES).map(|f| map(|p| f32::from(u8::from(square(f, p))))).collect();
        let nothing = || map(|_| 0.0);
        let (cameras, frames) = (&cameras(STEP), &frames());
        let mend = |supplied: &[Image]| {
            working(|work| {
                let seen = triangulate_frames(cameras, &flow, work, "test", 0.0..0.5).unwrap();
                let observed = Observed { frames, cameras, flow: &flow, seen: &seen };
                mended(supplied, observed, work, "test", 0.5..1.0).unwrap()
            })
        };
        assert_eq!(mend(&truth), (truth.clone(), vec![]), "true masks are kept");
        let none = vec![nothing(); FRAMES];
        assert_eq!(mend(&none), (none.clone(), vec![]), "what all masks leave out stays out");
        let lacking = |frame: usize| if frame == 2 { nothing() } else { truth[frame].clone() };
        let (masks, changed) = mend(&(0..FRAMES).map(lacking).collect::<Vec<_>>());
        assert_eq!(changed, [2]);
        let pairs = || masks[2].pixels.iter().zip(&truth[2].pixels);
        let both = pairs().filter(|(a, b)| **a > 0.5 && **b > 0.5).count();
        let either = pairs().filter(|(a, b)| **a > 0.5 || **b > 0.5).count();
        assert!(both as f64 > 0.7 * either as f64, "{both} of {either}");
    }
}
