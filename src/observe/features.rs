//! Keypoints that are detected in each image independently and described by descriptors, and tracks of
//! keypoints that are matched across frames. They link frames that no chain of flow connects.
//!
//! Flow follows a point until it is occluded or leaves the image; when the point reappears, a new track
//! begins. Cameras therefore drift where a video returns to where it began, and tracking is lost where flow
//! fails. Between neighbouring frames, descriptors add nothing to good flow, which is ten times as
//! accurate, so that only frames with few points in common are matched.

use glam::DVec2;
use rayon::prelude::*;

use super::PointTrack;
use crate::Result;
use crate::geometry::ransac::RansacOptions;
use crate::geometry::two_view::fundamental_ransac;
use crate::types::Image;

/// Acceptance rule for mutual nearest neighbours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rule {
    /// The inner product of the descriptors is at least this value; for networks that were trained with it.
    Product(f32),
    /// The angle between the descriptors is at most this share of the angle to the second-best match (Lowe
    /// 2004).
    Ratio(f32),
}

impl Rule {
    /// Number of matches between images of different content that may agree with one epipolar geometry by
    /// chance. Between images of different sides of an object, 36 of 112 agreed by the first rule and 13 of
    /// 83 by the second.
    fn chance(self) -> usize {
        match self {
            Rule::Product(_) => 45,
            Rule::Ratio(_) => 20,
        }
    }
}

/// Keypoints of an image with their descriptors.
#[derive(Clone, Debug, PartialEq)]
pub struct Features {
    /// Positions in pixels of the frame; the centre of the first pixel is at 0.5.
    pub pixels: Vec<DVec2>,
    /// Standard deviation of each pixel along each axis, pixels.
    pub noise: f32,
    /// Descriptors of unit length, all with the same number of values, concatenated in the order of the
    /// points. The inner product of two descriptors is larger the more similar the points look.
    pub descriptors: Vec<f32>,
    /// Rule by which two descriptors match.
    pub rule: Rule,
}

impl Default for Features {
    /// No keypoints.
    fn default() -> Features {
        let (pixels, descriptors) = (Vec::new(), Vec::new());
        Features { pixels, noise: 0.0, descriptors, rule: Rule::Product(1.0) }
    }
}

/// A source of keypoints.
pub trait FeatureSource {
    /// Returns the keypoints of frame `number`, whose image is `frame`.
    ///
    /// # Errors
    /// Whatever keeps the source from answering.
    fn features(&mut self, number: usize, frame: &Image) -> Result<Features>;
}

/// Two frames share enough points if they have at least `ENOUGH` in common and at least this share of the
/// points of the frame with fewer.
const SHARED: f64 = 0.03;
const ENOUGH: usize = 30;
/// Maximum number of frames of which all pairs are compared; longer clips are sampled at a stride.
const FRAMES: usize = 40;
/// Frames at most this far apart are always compared, to bridge the places where flow fails.
const NEIGHBOURS: usize = 2;
/// Minimum share of the matches that must agree with one epipolar geometry; a smaller share is chance.
const AGREE_SHARE: f64 = 0.33;
/// Inlier threshold of the epipolar geometry, in standard deviations.
const DEVIATIONS: f64 = 2.5;

/// Pairs of frames, `first < second`, that share few tracked points. In long clips, only frames at a stride
/// are paired, and near neighbours.
pub fn unlinked(tracks: &[PointTrack], frames: usize) -> Vec<(usize, usize)> {
    let stride = frames.div_ceil(FRAMES).max(1);
    let keys = frames.div_ceil(stride);
    let (mut seen, mut near) = (vec![0usize; frames], vec![[0usize; NEIGHBOURS]; frames]);
    let mut far = vec![0usize; keys * keys];
    for track in tracks {
        for (k, &a) in track.frames.iter().enumerate() {
            seen[a] += 1;
            let next = track.frames[k + 1..].iter().map(|b| b - a);
            next.take_while(|gap| *gap <= NEIGHBOURS).for_each(|gap| near[a][gap - 1] += 1);
        }
        let at: Vec<usize> =
            track.frames.iter().filter(|f| f.is_multiple_of(stride)).map(|f| f / stride).collect();
        for (k, a) in at.iter().enumerate() {
            at[k + 1..].iter().for_each(|b| far[a * keys + b] += 1);
        }
    }
    let key = |f: usize| f.is_multiple_of(stride).then_some(f / stride);
    let shared = |a: usize, b: usize| match (b - a <= NEIGHBOURS, key(a).zip(key(b))) {
        (true, _) => Some(near[a][b - a - 1]),
        (false, Some((i, j))) => Some(far[i * keys + j]),
        (false, None) => None,
    };
    let linked = |a: usize, b: usize, both: usize| {
        both >= ENOUGH && both as f64 >= SHARED * seen[a].min(seen[b]) as f64
    };
    let pairs = (0..frames).flat_map(|a| (a + 1..frames).map(move |b| (a, b)));
    pairs.filter(|&(a, b)| shared(a, b).is_some_and(|both| !linked(a, b, both))).collect()
}

/// Tracks of keypoints that are matched across the frames of `pairs`, in at least three frames each.
/// `features` holds those of all frames; it may be empty for frames in no pair. The result is a
/// deterministic function of the arguments.
pub fn linked(features: &[Features], pairs: &[(usize, usize)], seed: u64) -> Vec<PointTrack> {
    let found: Vec<Vec<(usize, usize)>> =
        pairs.par_iter().map(|&(a, b)| verified(&features[a], &features[b], seed)).collect();
    let first: Vec<usize> = features
        .iter()
        .scan(0, |sum, of| {
            *sum += of.pixels.len();
            Some(*sum - of.pixels.len())
        })
        .collect();
    let count = features.iter().map(|of| of.pixels.len()).sum();
    let mut groups = Groups::new(count);
    // Pairs with more agreeing matches come first, so that they win where two matches contradict each other.
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by_key(|p| (std::cmp::Reverse(found[*p].len()), *p));
    let frame_of: Vec<usize> =
        features.iter().enumerate().flat_map(|(f, of)| of.pixels.iter().map(move |_| f)).collect();
    for p in order {
        let (a, b) = pairs[p];
        for &(i, j) in &found[p] {
            groups.join(first[a] + i, first[b] + j, &frame_of);
        }
    }
    groups
        .members
        .into_iter()
        .filter(|members| members.len() > 2)
        .map(|members| {
            let of = |node: &usize| (frame_of[*node], node - first[frame_of[*node]]);
            let pixels = members.iter().map(of).map(|(f, i)| features[f].pixels[i]).collect();
            let noise = members.iter().map(of).map(|(f, _)| features[f].noise);
            PointTrack {
                frames: members.iter().map(|node| frame_of[*node]).collect(),
                pixels,
                deviation: vec![0.0; members.len()],
                noise: noise.fold(0.0, f32::max),
            }
        })
        .collect()
}

/// Groups of points that are the same, with at most one point per frame.
struct Groups {
    group_of: Vec<usize>,
    /// Members of each group, in the order of their frames; empty for a group that was merged into another.
    members: Vec<Vec<usize>>,
}

impl Groups {
    fn new(count: usize) -> Groups {
        Groups { group_of: (0..count).collect(), members: (0..count).map(|i| vec![i]).collect() }
    }

    /// Merges the groups of two points, unless a frame would then see the point twice.
    fn join(&mut self, a: usize, b: usize, frame_of: &[usize]) {
        let [a, b] = [self.group_of[a], self.group_of[b]];
        if a == b {
            return;
        }
        let [mut joined, other] = [a, b].map(|group| self.members[group].clone());
        joined.extend(other);
        joined.sort_by_key(|node| frame_of[*node]);
        if joined.windows(2).any(|two| frame_of[two[0]] == frame_of[two[1]]) {
            return;
        }
        joined.iter().for_each(|node| self.group_of[*node] = a);
        (self.members[a], self.members[b]) = (joined, Vec::new());
    }
}

/// Mutual nearest neighbours of two frames that agree with one epipolar geometry.
fn verified(a: &Features, b: &Features, seed: u64) -> Vec<(usize, usize)> {
    let matches = mutual(a, b);
    let pixels: Vec<(DVec2, DVec2)> =
        matches.iter().map(|&(i, j)| (a.pixels[i], b.pixels[j])).collect();
    let threshold = DEVIATIONS * f64::from(a.noise.hypot(b.noise));
    let options = RansacOptions { threshold, seed, ..Default::default() };
    let Some(found) = fundamental_ransac(&pixels, &options) else { return Vec::new() };
    let agree = found.inliers.len();
    if agree < a.rule.chance() || (agree as f64) < AGREE_SHARE * matches.len() as f64 {
        return Vec::new();
    }
    found.inliers.iter().map(|&i| matches[i]).collect()
}

/// Mutual nearest neighbours of two frames that pass the acceptance rule of the first one.
pub fn mutual(a: &Features, b: &Features) -> Vec<(usize, usize)> {
    let length = a.descriptors.len() / a.pixels.len().max(1);
    if length == 0 || b.pixels.is_empty() || b.descriptors.len() != length * b.pixels.len() {
        return Vec::new();
    }
    let mut backward = vec![(0, f32::NEG_INFINITY); b.pixels.len()];
    let mut forward = Vec::with_capacity(a.pixels.len());
    for (i, of) in a.descriptors.chunks_exact(length).enumerate() {
        let (mut best, mut second) = ((0, f32::NEG_INFINITY), f32::NEG_INFINITY);
        for (j, other) in b.descriptors.chunks_exact(length).enumerate() {
            let alike = product(of, other);
            if alike > best.1 {
                (best, second) = ((j, alike), best.1);
            } else if alike > second {
                second = alike;
            }
            if alike > backward[j].1 {
                backward[j] = (i, alike);
            }
        }
        forward.push((best, second));
    }
    let angle = |product: f32| product.clamp(-1.0, 1.0).acos();
    let same = |best: f32, second: f32| match a.rule {
        Rule::Product(least) => best >= least,
        Rule::Ratio(most) => angle(best) < most * angle(second),
    };
    let returns = |(i, ((j, best), second)): (usize, ((usize, f32), f32))| {
        (backward[j].0 == i && same(best, second)).then_some((i, j))
    };
    forward.into_iter().enumerate().filter_map(returns).collect()
}

/// Inner product, written in lanes so that it vectorises.
fn product(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 8;
    let mut sums = [0.0f32; LANES];
    let (whole_a, rest_a) = a.as_chunks::<LANES>();
    let (whole_b, rest_b) = b.as_chunks::<LANES>();
    for (a, b) in whole_a.iter().zip(whole_b) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let rest: f32 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::types::{Intrinsics, Pose};

    const POINTS: usize = 120;
    const LENGTH: usize = 16;

    fn descriptor(rng: &mut ChaCha8Rng) -> Vec<f32> {
        let values: Vec<f32> = (0..LENGTH).map(|_| rng.random_range(-1.0..1.0)).collect();
        let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
        values.iter().map(|v| v / length).collect()
    }

    /// Frames' views of points in space, each in a different order, with as many points that no other frame
    /// sees; and the number of each point.
    fn seen(frames: usize) -> (Vec<Features>, Vec<Vec<usize>>) {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let k = Intrinsics::centred(300.0, 320, 180);
        let mut side = |most: f64| rng.random_range(-most..most);
        let points: Vec<DVec3> =
            (0..POINTS).map(|_| DVec3::new(side(0.8), side(0.4), 3.0 + side(0.8))).collect();
        let known: Vec<Vec<f32>> = (0..POINTS).map(|_| descriptor(&mut rng)).collect();
        (0..frames)
            .map(|f| {
                let turn = DQuat::from_rotation_y(0.02 * f as f64);
                let pose =
                    Pose { rotation: turn, translation: DVec3::new(0.1 * f as f64, 0.0, 0.0) };
                let rule = Rule::Product(0.82);
                let mut found = Features { noise: 0.3, rule, ..Features::default() };
                let numbers: Vec<usize> =
                    (0..2 * POINTS).map(|i| (i * 7 + 3 * f) % (2 * POINTS)).collect();
                for &number in &numbers {
                    let (pixel, described) = match points.get(number) {
                        Some(point) => (k.project(pose.apply(*point)), known[number].clone()),
                        None => {
                            let [x, y] = [320.0, 180.0].map(|side| rng.random_range(0.0..side));
                            (DVec2::new(x, y), descriptor(&mut rng))
                        }
                    };
                    found.pixels.push(pixel);
                    found.descriptors.extend(described);
                }
                (found, numbers)
            })
            .unzip()
    }

    #[test]
    fn points_are_linked_over_frames_that_flow_does_not() {
        let (features, numbers) = seen(5);
        // Frame 2 is in no pair and must not affect the tracks.
        let pairs = [(0, 1), (0, 3), (1, 3), (0, 4), (3, 4)];
        let tracks = linked(&features, &pairs, 0);
        assert_eq!(tracks.len(), POINTS);
        for track in &tracks {
            assert_eq!(track.frames, [0, 1, 3, 4]);
            assert_eq!((track.noise, &track.deviation[..]), (0.3, &[0.0; 4][..]));
            let number = |f: usize| {
                let at = track.at(f).unwrap();
                numbers[f][features[f].pixels.iter().position(|pixel| *pixel == at).unwrap()]
            };
            assert!(number(0) < POINTS && [1, 3, 4].iter().all(|f| number(*f) == number(0)));
        }
        assert!(
            linked(&features, &[(0, 1)], 0).is_empty(),
            "two frames tell no more than flow does"
        );
        assert_eq!(linked(&features, &pairs, 0), tracks);
    }

    #[test]
    fn what_only_looks_alike_is_no_link() {
        let (mut features, _) = seen(3);
        // The same descriptors, at positions that no epipolar geometry explains.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for pixel in &mut features[1].pixels {
            *pixel = DVec2::new(rng.random_range(0.0..320.0), rng.random_range(0.0..180.0));
        }
        assert!(mutual(&features[0], &features[1]).len() >= POINTS);
        assert!(verified(&features[0], &features[1], 0).is_empty());
        assert!(verified(&features[0], &features[2], 0).len() >= POINTS);
        assert!(mutual(&features[0], &Features::default()).is_empty());
    }

    #[test]
    fn a_frame_sees_a_point_once() {
        // Points 0 and 1 of frame 0, one of frame 1, one of frame 2.
        let frame_of = [0, 0, 1, 2];
        let mut groups = Groups::new(4);
        groups.join(0, 2, &frame_of);
        groups.join(1, 3, &frame_of);
        groups.join(2, 3, &frame_of);
        groups.members.retain(|members| !members.is_empty());
        assert_eq!(groups.members, [[0, 2], [1, 3]]);
    }

    #[test]
    fn frames_that_flow_links_are_not_compared() {
        let track = |first: usize, end: usize| {
            let n = end - first;
            PointTrack::followed(first, vec![DVec2::ONE; n], vec![0.1; n])
        };
        // Many points through frames 0 to 2, as many from 3 on, a few through all.
        let mut tracks = vec![track(0, 3); 200];
        tracks.extend(vec![track(3, 5); 200]);
        tracks.extend(vec![track(0, 5); 9]);
        let across = [(0, 3), (0, 4), (1, 3), (1, 4), (2, 3), (2, 4)];
        assert_eq!(unlinked(&tracks, 5), across);
        assert!(unlinked(&vec![track(0, 90); 100], 90).is_empty());
        // In a long clip, frames are compared if they are at the stride, or next to each other.
        let pairs = unlinked(&[], 130);
        assert!(pairs.contains(&(1, 2)) && pairs.contains(&(0, 128)) && !pairs.contains(&(1, 7)));
        assert!(pairs.len() < 1500, "{}", pairs.len());
    }
}
