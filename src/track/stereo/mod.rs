//! Inverse depths of the static world, from the frames of the whole clip.
//!
//! The accuracy of depth triangulated from flow is limited by the flow, which is smooth across edges. Once
//! the cameras are known, each pixel is searched along its epipolar line in near and far frames. The steps,
//! in order:
//!
//! | module | what it does |
//! |---|---|
//! | `views` | selects the frames that a frame is compared with, and the inverse depths to test |
//! | `patch` | the weights of a pixel's neighbours in its patch |
//! | `sweep` | the matching cost of each pixel on planes that face the camera, and on planes parallel to the ground |
//! | `semi_global` | selects planes so that neighbours agree except at colour edges |
//! | `refine` | refines inverse depths to fractions of a level |
//! | `agree` | cross-checks the inverse depths of several frames; contradicted values are rejected |
//! | `ground` | the plane that most of the ground lies on |

mod agree;
mod ground;
mod patch;
mod refine;
mod semi_global;
mod sweep;
mod views;

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Stage;
use super::cameras::Cameras;
use super::observer::Work;
use super::plate;
use super::residual::Seen;
use crate::Result;
use crate::observe::luminance::Luminance;
use crate::types::Image;
use agree::Maps;
pub(super) use ground::Ground;
use sweep::Planes;
use views::View;

/// Pixels within this distance of a mover are treated as the mover's, pixels.
const MARGIN: usize = 2;
/// Minimum number of other frames that must agree with an inverse depth: for a refined value, and for one
/// that only the sweep found.
const WITNESSES: (usize, usize) = (2, 1);
/// Relative deviation of an inverse depth that only the agreement of other frames supports; an upper bound
/// for refined values.
const AGREED: f32 = 0.3;
/// Memory limit in bytes of the frames that are swept at the same time.
const MEMORY: usize = 2 << 30;
/// Approximate number of frames that determine the ground's normal.
const LEVELLED_BY: usize = 8;
/// Maximum difference of the logarithm of depth between the two sweeps. On a surface without texture that is
/// not ground, the sweep along the ground's normal has a low cost at any depth.
const SAME_DEPTH: f32 = 0.1;
/// Shares of the work that are done after the sweep along the line of sight, and after that along the
/// ground's normal.
const SWEEPS: (f64, f64) = (0.55, 0.65);

/// Measures the inverse depths of all frames, starting from those of `flow`. The values of `flow` are kept at
/// movers (`masks`) and where no other frame shows a pixel. Support is 0 where no value is reliable. `part`
/// is the name under which finished frames are saved.
///
/// # Errors
/// What the observer of `work` returns.
pub(super) fn measure(
    frames: &[Image],
    cameras: &Cameras,
    masks: &[Image],
    flow: &[Seen],
    work: &mut Work,
    part: &str,
    shares: Range<f64>,
) -> Result<Measured> {
    let covered: Vec<Vec<bool>> = masks.par_iter().map(|mask| mask.near(MARGIN)).collect();
    let pictures: Vec<Vec<f32>> =
        frames.iter().zip(&covered).map(|(frame, mask)| sweep::luminance(frame, mask)).collect();
    let views: Vec<Vec<View>> =
        (0..frames.len()).map(|frame| views::views(cameras, frame)).collect();
    let levels: Vec<Vec<f64>> =
        views.iter().zip(flow).map(|(views, flow)| views::levels(flow, views)).collect();
    let clip = Clip {
        frames,
        cameras,
        covered: &covered,
        pictures: &pictures,
        views: &views,
        levels: &levels,
        flow,
    };
    let n = frames.len();
    let middle = shares.start + SWEEPS.1 * (shares.end - shares.start);
    let swept = clip.sweep(work, part, shares.start..middle)?;

    let smooth: Vec<Luminance> = frames.par_iter().map(Luminance::of).collect();
    let refine = |range: Range<usize>| {
        let of = |f: usize| {
            let pictures = refine::Pictures { frames, smooth: &smooth };
            refine::frame(pictures, cameras, &covered[f], &swept[f], &views[f], f)
        };
        range.map(of).collect()
    };
    let name = format!("{part}/refine");
    let refined: Vec<Seen> = work.frames(&name, n, refine, Stage::Depth, middle..shares.end)?;

    let mut seen = clip.agreed(&refined, &swept);
    let ground = Ground::find(cameras, &covered, &seen);
    if let Some(ground) = &ground {
        ground.settle(cameras, &covered, &mut seen);
    }
    Ok(Measured { seen, ground })
}

/// The result of stereo.
pub(super) struct Measured {
    /// The static world, frame by frame.
    pub seen: Vec<Seen>,
    /// The ground, if it was found.
    pub ground: Option<Ground>,
}

/// The inputs of a sweep.
struct Clip<'a> {
    frames: &'a [Image],
    cameras: &'a Cameras,
    /// The pixels that movers cover.
    covered: &'a [Vec<bool>],
    /// Luminance from [`sweep::luminance`].
    pictures: &'a [Vec<f32>],
    views: &'a [Vec<View>],
    levels: &'a [Vec<f64>],
    flow: &'a [Seen],
}

/// The result of a sweep over the planes of one direction.
#[derive(Serialize, Deserialize)]
struct Swept {
    seen: Seen,
    /// The cost of each pixel's inverse depth, summed over the directions of semi-global matching.
    costs: Vec<i16>,
}

impl Clip<'_> {
    /// The inverse depths of all frames from a sweep of planes that face the camera and, if the ground is
    /// found in them, from a sweep along its normal.
    fn sweep(&self, work: &mut Work, part: &str, shares: Range<f64>) -> Result<Vec<Seen>> {
        let n = self.frames.len();
        let middle = shares.start + SWEEPS.0 / SWEEPS.1 * (shares.end - shares.start);
        let of_range = |range: Range<usize>| self.limited(range.collect(), |f| self.swept(f));
        let stage = Stage::Depth;
        let facing: Vec<Swept> =
            work.frames(&format!("{part}/sweep"), n, of_range, stage, shares.start..middle)?;
        let (mut seen, costs): (Vec<Seen>, Vec<Vec<i16>>) =
            facing.into_iter().map(|swept| (swept.seen, swept.costs)).unzip();
        let Some(ground) = Ground::find(self.cameras, self.covered, &self.agreed(&seen, &seen))
        else {
            return Ok(seen);
        };
        let some: Vec<usize> = (0..n).step_by(n.div_ceil(LEVELLED_BY)).collect();
        let ground = ground.levelled(self.cameras, |ground| {
            self.limited(some.clone(), |f| (f, self.ground(ground, f, &seen[f], &costs[f])))
        });
        let of_range = |range: Range<usize>| {
            self.limited(range.collect(), |f| self.ground(&ground, f, &seen[f], &costs[f]))
        };
        let grounds: Vec<Seen> =
            work.frames(&format!("{part}/ground"), n, of_range, stage, middle..shares.end)?;
        for (seen, ground) in seen.iter_mut().zip(&grounds) {
            for i in (0..ground.support.len()).filter(|i| ground.support[*i] > 0.0) {
                seen.inverse_depth[i] = ground.inverse_depth[i];
                seen.deviation[i] = ground.deviation[i];
            }
        }
        Ok(seen)
    }

    /// Runs `of` for some frames, as many at a time as memory allows.
    fn limited<T: Send>(&self, frames: Vec<usize>, of: impl Fn(usize) -> T + Sync) -> Vec<T> {
        let pixels = self.pictures.first().map_or(0, Vec::len);
        let at_once = (MEMORY / sweep::memory(pixels).max(1)).max(1);
        let chunks = frames.chunks(at_once);
        chunks.flat_map(|some| some.par_iter().map(|f| of(*f)).collect::<Vec<_>>()).collect()
    }

    /// The inverse depths of all frames that [`believed`] selects from the measured ones and those of the sweep.
    fn agreed(&self, measured: &[Seen], swept: &[Seen]) -> Vec<Seen> {
        let maps = Maps {
            cameras: self.cameras,
            seen: measured,
            covered: self.covered,
            views: self.views,
            levels: self.levels,
        };
        (0..swept.len()).map(|f| believed(&maps, &swept[f], &self.flow[f], f)).collect()
    }

    /// Whether a frame can be compared with others.
    fn has_patches(&self, frame: usize) -> bool {
        let image = &self.frames[frame];
        let no_patch = image.width.min(image.height) as usize <= 2 * patch::RADIUS;
        self.levels[frame].len() >= 2 && !no_patch
    }

    /// A frame's inverse depths from planes that face the camera; those of flow if there is nothing to
    /// compare with.
    fn swept(&self, frame: usize) -> Swept {
        let (levels, flow) = (&self.levels[frame], &self.flow[frame]);
        let n = flow.inverse_depth.len();
        if !self.has_patches(frame) {
            return Swept { seen: flow.clone(), costs: vec![0; n] };
        }
        let prefer = |volume: &mut sweep::Volume| {
            let known = |i: &usize| !self.pictures[frame][*i].is_nan() && views::certain(flow, *i);
            for i in (0..n).filter(known) {
                volume.prefer(i, views::nearest(levels, f64::from(flow.inverse_depth[i])));
            }
        };
        self.matched(frame, &Planes::facing(levels.clone()), prefer)
    }

    /// The inverse depths of the pixels that lie on planes parallel to the ground; the support is 0 elsewhere.
    /// These pixels match such planes at a lower cost than planes that face the camera, which `facing` and
    /// `facing_costs` are from, at nearly the same inverse depth (plane sweeps in several directions: Gallup
    /// et al. 2007). On planes that face the camera, the ground is a staircase that semi-global matching makes
    /// too flat.
    fn ground(&self, ground: &Ground, frame: usize, facing: &Seen, facing_costs: &[i16]) -> Seen {
        let base = ground.from(&self.cameras.poses[frame]).filter(|_| self.has_patches(frame));
        let Some(base) = base else {
            let support = vec![0.0; facing_costs.len()];
            return Seen { support, ..facing.clone() };
        };
        let planes = Planes { base, levels: ground::levels() };
        let Swept { mut seen, costs } = self.matched(frame, &planes, |_| ());
        for i in 0..costs.len() {
            // This is also false above the horizon, where inverse depths on the planes are negative.
            let off = (seen.inverse_depth[i] / facing.inverse_depth[i]).ln().abs();
            let cheaper = costs[i] < facing_costs[i];
            let is_ground = cheaper && off < SAME_DEPTH && !self.pictures[frame][i].is_nan();
            seen.support[i] = f32::from(is_ground);
        }
        seen
    }

    /// The best plane for each pixel of a frame. `adjust` changes the costs before the planes are selected.
    fn matched(&self, frame: usize, planes: &Planes, adjust: impl Fn(&mut sweep::Volume)) -> Swept {
        let (image, k) = (&self.frames[frame], &self.cameras.intrinsics);
        let Planes { base, levels } = planes;
        let views = &self.views[frame];
        let mut volume = sweep::volume(image, self.pictures, self.cameras, frame, views, planes);
        adjust(&mut volume);
        let n = self.flow[frame].inverse_depth.len();
        let mut seen = Seen {
            inverse_depth: vec![0.0; n],
            deviation: vec![0.0; n],
            score: vec![0.0; n],
            support: vec![1.0; n],
        };
        let mut costs = vec![0; n];
        let sums = semi_global::sums(&volume, image);
        for (i, sums) in sums.chunks_exact(levels.len()).enumerate() {
            let (level, cost) = semi_global::best(sums);
            let low = (level as usize).min(levels.len() - 2);
            let step = levels[low + 1] - levels[low];
            let scale = base.dot(k.ray(plate::centre(i, k.width as usize)));
            let d = scale * (levels[low] + step * (level - low as f64));
            seen.inverse_depth[i] = d as f32;
            seen.deviation[i] = (0.5 * step * scale.abs()) as f32;
            costs[i] = cost;
        }
        Swept { seen, costs }
    }
}

/// Selects each pixel's value: the refined inverse depth if other frames agree, else that of the sweep if a
/// frame agrees, else that of flow, with support 0 if a frame contradicts it.
fn believed(maps: &Maps, swept: &Seen, flow: &Seen, frame: usize) -> Seen {
    let refined = &maps.seen[frame];
    let pixel = |i: usize| {
        let agreed = |seen: &Seen, witnesses| {
            let said = (seen.inverse_depth[i], seen.deviation[i]);
            let known = seen.support[i] > 0.0;
            known.then(|| maps.agreed(frame, i, said, witnesses)).flatten()
        };
        if let Some(d) = agreed(refined, WITNESSES.0) {
            return (d, refined.deviation[i].min(AGREED * d), 0.0, 1.0);
        }
        if let Some(d) = agreed(swept, WITNESSES.1) {
            return (d, AGREED * d, 0.0, 1.0);
        }
        let support = agreed(flow, 0).map_or(0.0, |_| flow.support[i]);
        (flow.inverse_depth[i], flow.deviation[i], flow.score[i], support)
    };
    let n = refined.inverse_depth.len();
    let pixels: Vec<(f32, f32, f32, f32)> = (0..n).into_par_iter().map(pixel).collect();
    Seen {
        inverse_depth: pixels.iter().map(|p| p.0).collect(),
        deviation: pixels.iter().map(|p| p.1).collect(),
        score: pixels.iter().map(|p| p.2).collect(),
        support: pixels.iter().map(|p| p.3).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::quantile;
    use super::super::sliding::*;
    use super::*;

    /// A flow result for the wall with an error of a tenth everywhere.
    fn wrong() -> Vec<Seen> {
        let n = (WIDTH * HEIGHT) as usize;
        let seen = Seen {
            inverse_depth: vec![(1.1 / WALL) as f32; n],
            deviation: vec![(0.02 / WALL) as f32; n],
            score: vec![1.0; n],
            support: vec![2.0; n],
        };
        vec![seen; FRAMES]
    }

    fn measured(frames: &[Image], masks: &[Image], flow: &[Seen]) -> Seen {
        let cameras = cameras(STEP);
        let found = working(|work| measure(frames, &cameras, masks, flow, work, "test", 0.0..1.0));
        found.unwrap().seen.swap_remove(2)
    }

    fn still() -> Vec<Image> {
        (0..FRAMES).map(|_| map(|_| 0.0)).collect()
    }

    #[test]
    fn a_painted_wall_is_found_at_its_distance() {
        let seen = measured(&painted(), &still(), &wrong());
        for i in 0..seen.inverse_depth.len() {
            if within(centre(i), (16.0, 6.0), (48.0, 34.0)) {
                let d = f64::from(seen.inverse_depth[i]) * WALL;
                assert!((d - 1.0).abs() < 0.02, "{}: {d}", centre(i));
                assert!(seen.support[i] > 0.0 && f64::from(seen.deviation[i]) * WALL < 0.1);
            }
        }
    }

    #[test]
    fn a_post_before_the_wall_keeps_its_edges() {
        // At half the distance the post moves past twice as fast.
        let (left, right) = (36.0, 44.0);
        let frames: Vec<Image> = painted()
            .into_iter()
            .enumerate()
            .map(|(frame, mut image)| {
                let by = 2.0 * wall().x * frame as f64;
                for (i, out) in image.pixels.chunks_exact_mut(3).enumerate() {
                    let at = centre(i);
                    if at.x - by > left && at.x - by < right {
                        let wave = (1.1 * (at.x - by)).sin() * (0.9 * at.y).cos();
                        out.copy_from_slice(&[0.7 + 0.2 * wave as f32, 0.2, 0.1]);
                    }
                }
                image
            })
            .collect();
        // Flow assigns the surroundings of the post to the post.
        let mut flow = wrong();
        for (frame, seen) in flow.iter_mut().enumerate() {
            let by = 2.0 * wall().x * frame as f64;
            for (i, d) in seen.inverse_depth.iter_mut().enumerate() {
                if centre(i).x - by > left - 4.0 && centre(i).x - by < right + 4.0 {
                    *d = (2.1 / WALL) as f32;
                }
            }
        }
        let seen = measured(&frames, &still(), &flow);
        let shift = 2.0 * wall().x * 2.0;
        let (mut wrong, mut all) = (0, 0);
        for i in 0..seen.inverse_depth.len() {
            let at = centre(i);
            let edge = (at.x - left - shift).abs().min((at.x - right - shift).abs());
            if within(at, (12.0, 4.0), (52.0, 36.0)) && edge > 1.0 {
                let post = at.x > left + shift && at.x < right + shift;
                let expected = if post { 2.0 / WALL } else { 1.0 / WALL };
                let off = f64::from(seen.inverse_depth[i]) / expected - 1.0;
                wrong += usize::from(seen.support[i] > 0.0 && off.abs() > 0.05);
                all += 1;
            }
        }
        assert!(wrong * 25 < all, "{wrong} of {all}");
    }

    #[test]
    fn ground_is_measured_along_its_normal() {
        // The ground falls away from the wall towards the camera. Its texture is faint, and flow makes it too
        // flat.
        let k = cameras(STEP).intrinsics;
        let inverse_depth = |i: usize| 1.0 / WALL + 1.6 * k.ray(centre(i)).y.max(0.0);
        let is_ground = |i: usize| inverse_depth(i) > 1.0 / WALL;
        let frames: Vec<Image> = painted()
            .into_iter()
            .enumerate()
            .map(|(frame, mut image)| {
                for (i, out) in image.pixels.chunks_exact_mut(3).enumerate() {
                    let p = k.ray(centre(i)) / inverse_depth(i);
                    if is_ground(i) {
                        let x = p.x + STEP * frame as f64;
                        let wave = (30.0 * x + p.z).sin() * (4.0 * p.z - x).cos();
                        out.fill((0.3 + 0.03 * wave) as f32);
                    }
                }
                image
            })
            .collect();
        let mut flow = wrong();
        for seen in &mut flow {
            for i in (0..seen.support.len()).filter(|i| is_ground(*i)) {
                let d = inverse_depth(i);
                seen.inverse_depth[i] = (0.45 + 0.85 * (d - 0.45)) as f32;
                seen.deviation[i] = (0.02 * d) as f32;
            }
        }
        let seen = measured(&frames, &still(), &flow);
        let off = |i: usize| (f64::from(seen.inverse_depth[i]) / inverse_depth(i)).ln();
        let rows = |low: f64, high: f64| {
            let inside = |i: &usize| within(centre(*i), (4.0, low), (60.0, high)) && is_ground(*i);
            (0..seen.support.len()).filter(inside).map(off).collect::<Vec<f64>>()
        };
        let (far, near) = (quantile(rows(23.0, 29.0), 0.5), quantile(rows(32.0, 37.0), 0.5));
        let typical = quantile(rows(23.0, 37.0).iter().map(|off| off.abs()).collect(), 0.5);
        assert!(far.abs() < 0.01 && near.abs() < 0.01 && typical < 0.01, "{far} {near} {typical}");
    }

    #[test]
    fn movers_and_blank_walls_keep_what_flow_said() {
        let moving: Vec<Image> = (0..FRAMES).map(|_| map(|_| 1.0)).collect();
        let start = &wrong()[0];
        let seen = measured(&painted(), &moving, &wrong());
        assert_eq!((&seen.inverse_depth, &seen.support), (&start.inverse_depth, &start.support));
        let seen = measured(&frames(), &still(), &wrong());
        for i in 0..seen.inverse_depth.len() {
            let off = (seen.inverse_depth[i] / start.inverse_depth[i] - 1.0).abs();
            assert!(off < 0.02, "{}: {off}", centre(i));
        }
    }

    #[test]
    fn a_camera_that_stands_keeps_what_flow_said() {
        let (frames, cameras) = (painted(), cameras(0.0));
        let found =
            working(|work| measure(&frames, &cameras, &still(), &wrong(), work, "test", 0.0..1.0));
        assert_eq!(found.unwrap().seen[2].inverse_depth, wrong()[2].inverse_depth);
    }
}
