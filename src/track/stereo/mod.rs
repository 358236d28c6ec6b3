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
//! | `sweep` | the matching cost of each pixel at each inverse depth |
//! | `semi_global` | selects inverse depths so that neighbours agree except at colour edges |
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

use rayon::prelude::*;

use super::Stage;
use super::cameras::Cameras;
use super::observer::Work;
use super::residual::Seen;
use crate::Result;
use crate::observe::luminance::Luminance;
use crate::types::Image;
use agree::Maps;
pub(super) use ground::Ground;
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
/// Share of the work that the sweep takes.
const SWEEP: f64 = 0.6;

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
    shares: std::ops::Range<f64>,
) -> Result<Measured> {
    let covered: Vec<Vec<bool>> = masks.par_iter().map(|mask| mask.near(MARGIN)).collect();
    let pictures: Vec<Vec<f32>> =
        frames.iter().zip(&covered).map(|(frame, mask)| sweep::luminance(frame, mask)).collect();
    let views: Vec<Vec<View>> =
        (0..frames.len()).map(|frame| views::views(cameras, frame)).collect();
    let levels: Vec<Vec<f64>> =
        views.iter().zip(flow).map(|(views, flow)| views::levels(flow, views)).collect();
    let clip = Clip { frames, cameras, pictures: &pictures, views: &views, levels: &levels, flow };
    let middle = shares.start + SWEEP * (shares.end - shares.start);

    let pixels = pictures.first().map_or(0, Vec::len);
    let at_once = (MEMORY / sweep::memory(pixels).max(1)).max(1);
    let sweep = |range: std::ops::Range<usize>| {
        let frames: Vec<usize> = range.collect();
        let some = frames.chunks(at_once);
        some.flat_map(|some| some.par_iter().map(|f| clip.swept(*f)).collect::<Vec<_>>()).collect()
    };
    let (name, n) = (format!("{part}/sweep"), frames.len());
    let swept: Vec<Seen> = work.frames(&name, n, sweep, Stage::Depth, shares.start..middle)?;

    let smooth: Vec<Luminance> = frames.par_iter().map(Luminance::of).collect();
    let refine = |range: std::ops::Range<usize>| {
        let of = |f: usize| {
            let pictures = refine::Pictures { frames, smooth: &smooth };
            refine::frame(pictures, cameras, &covered[f], &swept[f], &views[f], f)
        };
        range.map(of).collect()
    };
    let name = format!("{part}/refine");
    let refined: Vec<Seen> = work.frames(&name, n, refine, Stage::Depth, middle..shares.end)?;

    let maps = Maps { cameras, seen: &refined, covered: &covered, views: &views, levels: &levels };
    let mut seen: Vec<Seen> = (0..n).map(|f| believed(&maps, &swept[f], &flow[f], f)).collect();
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
    /// Luminance from [`sweep::luminance`].
    pictures: &'a [Vec<f32>],
    views: &'a [Vec<View>],
    levels: &'a [Vec<f64>],
    flow: &'a [Seen],
}

impl Clip<'_> {
    /// A frame's inverse depths at the best levels; those of flow if there is nothing to compare with.
    fn swept(&self, frame: usize) -> Seen {
        let (levels, flow) = (&self.levels[frame], &self.flow[frame]);
        let image = &self.frames[frame];
        let no_patch = image.width.min(image.height) as usize <= 2 * patch::RADIUS;
        if levels.len() < 2 || no_patch {
            return flow.clone();
        }
        let views = &self.views[frame];
        let mut volume = sweep::volume(image, self.pictures, self.cameras, frame, views, levels);
        let n = flow.inverse_depth.len();
        for i in (0..n).filter(|i| !self.pictures[frame][*i].is_nan() && views::certain(flow, *i)) {
            volume.prefer(i, views::nearest(levels, f64::from(flow.inverse_depth[i])));
        }
        let mut out = Seen {
            inverse_depth: vec![0.0; n],
            deviation: vec![0.0; n],
            score: vec![0.0; n],
            support: vec![1.0; n],
        };
        let sums = semi_global::sums(&volume, image);
        for (i, sums) in sums.chunks_exact(levels.len()).enumerate() {
            let level = semi_global::best(sums);
            let low = (level as usize).min(levels.len() - 2);
            let step = levels[low + 1] - levels[low];
            out.inverse_depth[i] = (levels[low] + step * (level - low as f64)) as f32;
            out.deviation[i] = (0.5 * step) as f32;
        }
        out
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
