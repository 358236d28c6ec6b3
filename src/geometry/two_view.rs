//! Relative pose of two images, for initialising a reconstruction and selecting keyframes.

use super::epipolar::{
    cheiral_pose, eight_point, essential_from_pose, fundamental_from_essential, in_front,
    sampson_squared,
};
use super::five_point::five_point;
use super::homography::{homography, transfer_squared};
use super::pnp::check_intrinsics;
use super::ransac::{Consensus, Estimator, RansacOptions, ransac};
use super::relative::refine_relative;
use super::sim3::align_points;
use super::triangulate::triangulate;
use crate::error::{Error, Result};
use crate::types::{Intrinsics, Pose};
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Kind of motion between two images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// The pixels do not move, so the camera is static.
    Static,
    /// A rotation explains the pixels: depth is unobservable, and the translation is reported as zero.
    PureRotation,
    /// One plane explains the pixels at this baseline; the pose is valid, a fundamental matrix would not be.
    Planar,
    /// A scene with depth, seen from two positions.
    General,
}

/// Options for comparing two images.
#[derive(Clone, Copy, Debug)]
pub struct TwoViewOptions {
    /// The robust search; its threshold is in pixels of Sampson or transfer distance.
    pub ransac: RansacOptions,
    /// Median displacement (pixels) below which the camera is static.
    pub static_px: f64,
    /// Median residual (pixels) after the best rotation below which the motion is a pure rotation.
    pub parallax_px: f64,
    /// Minimum share of the epipolar inliers that fit one homography for a planar scene.
    pub planar_ratio: f64,
}

impl Default for TwoViewOptions {
    fn default() -> Self {
        TwoViewOptions {
            ransac: RansacOptions::default(),
            static_px: 0.5,
            parallax_px: 1.0,
            planar_ratio: 0.9,
        }
    }
}

/// Relative pose of image b to image a.
#[derive(Clone, Debug)]
pub struct TwoView {
    /// Pose of frame b from frame a; the translation has length 1, or 0 for [`Motion::Static`] and
    /// [`Motion::PureRotation`].
    pub b_from_a: Pose,
    /// Kind of motion.
    pub motion: Motion,
    /// Per pair: whether it agrees with the pose (and its rays meet in front of both cameras, where there
    /// is a translation).
    pub inliers: Vec<bool>,
    /// Share of inliers among the usable pairs.
    pub inlier_ratio: f64,
    /// Root mean square Sampson distance of the inliers (transfer distance where there is no
    /// translation), pixels.
    pub rmse: f64,
    /// Median displacement of the pixels, pixels.
    pub displacement_px: f64,
    /// Median residual of the inliers after the best rotation, pixels: the parallax that determines depth.
    pub parallax_px: f64,
    /// Median angle between the inliers' rays, degrees; 0 where there is no translation.
    pub parallax_deg: f64,
    /// Share of the epipolar inliers that fit one homography.
    pub homography_ratio: f64,
}

/// Minimum number of pairs for a relative pose: five determine it, three more verify it.
const FEWEST: usize = 8;

/// The name in error messages.
const OP: &str = "two-view geometry";

/// Estimates the relative pose of two images from pixel pairs with outliers.
///
/// Five-point algorithm within RANSAC (MSAC, locally optimised on Sampson distances), compared with a pure
/// rotation and with a homography. `weights` (1 if absent) scale each pair's cost; pairs with a weight of 0
/// or non-finite values are left out.
///
/// # Errors
/// Differing lengths, invalid intrinsics, fewer than 8 usable pairs, no consensus of at least 8 pairs and a
/// share of `ransac.min_inlier_ratio`.
pub fn two_view(
    pixels_a: &[DVec2],
    pixels_b: &[DVec2],
    weights: Option<&[f64]>,
    ka: &Intrinsics,
    kb: &Intrinsics,
    options: &TwoViewOptions,
) -> Result<TwoView> {
    check_lengths(pixels_a.len(), pixels_b.len(), weights)?;
    check_intrinsics(ka)?;
    check_intrinsics(kb)?;
    let pairs = Pairs::gather(pixels_a, pixels_b, weights, ka, kb);
    let usable = pairs.pixels.len();
    if usable < FEWEST {
        return Err(Error::Failed(format!(
            "{OP}: {usable} usable pixel pairs of {}, needs {FEWEST}",
            pixels_a.len()
        )));
    }
    let failed = |found: usize| {
        Error::Failed(format!(
            "{OP}: the best relative pose agrees with {found} of {usable} pixel pairs within \
             {:.2} px; the images may not overlap, or most of them moves",
            options.ransac.threshold
        ))
    };
    let enough =
        |n: usize| n >= FEWEST && n as f64 >= options.ransac.min_inlier_ratio * usable as f64;
    let displacement_px = median(pairs.pixels.iter().map(|(a, b)| (*b - *a).length()).collect());
    let all: Vec<usize> = (0..usable).collect();
    if displacement_px < options.static_px {
        let still: Vec<usize> = all
            .iter()
            .copied()
            .filter(|&i| pairs.turned(DQuat::IDENTITY, i) < options.ransac.threshold)
            .collect();
        return Ok(pairs.without_translation(
            DQuat::IDENTITY,
            Motion::Static,
            still,
            displacement_px,
            pixels_a.len(),
        ));
    }
    let turn = ransac(&Turn(&pairs), &options.ransac, &[]);
    let epipolar =
        ransac(&Epipolar(&pairs), &options.ransac, &[]).map(|c| settle(&pairs, c, options));
    // The rotation is judged on the pairs that the pose explains, so that a mover does not add parallax.
    let explained = match &epipolar {
        Some(e) if enough(e.1.len()) => &e.1,
        _ => &all,
    };
    let parallax_px = turn.as_ref().map_or(f64::INFINITY, |t| {
        median(explained.iter().map(|&i| pairs.turned(t.model, i)).collect())
    });
    if let Some(turn) = &turn
        && parallax_px < options.parallax_px
        && enough(turn.inliers.len())
    {
        return Ok(pairs.without_translation(
            turn.model,
            Motion::PureRotation,
            turn.inliers.clone(),
            displacement_px,
            pixels_a.len(),
        ));
    }
    let (pose, inliers) = epipolar.ok_or_else(|| failed(0))?;
    if !enough(inliers.len()) {
        return Err(failed(inliers.len()));
    }
    let homography_ratio =
        pairs.on_a_plane(&inliers, &options.ransac) as f64 / inliers.len() as f64;
    let planar = homography_ratio >= options.planar_ratio;
    Ok(TwoView {
        b_from_a: pose,
        motion: if planar { Motion::Planar } else { Motion::General },
        inlier_ratio: inliers.len() as f64 / usable as f64,
        rmse: pairs.sampson_rms(&pose, &inliers),
        displacement_px,
        parallax_px,
        parallax_deg: pairs.median_angle(&pose, &inliers),
        homography_ratio,
        inliers: pairs.mask(&inliers, pixels_a.len()),
    })
}

/// The fundamental matrix of pixel pairs with outliers: eight-point algorithm within RANSAC, Sampson
/// distance in pixels. Inliers are indices into `pairs`. `None` for fewer than eight pairs or where no
/// sample gave a matrix.
pub fn fundamental_ransac(
    pairs: &[(DVec2, DVec2)],
    options: &RansacOptions,
) -> Option<Consensus<DMat3>> {
    ransac(&Fundamental(pairs), options, &[])
}

/// The rotation of a camera that maps pixels of one image to those of another, with outliers: two-pair
/// RANSAC, distances in image b, pixels. Inliers are indices into `pixels_a`; each pair is weighted. `None`
/// for fewer than two pairs or where no sample gave a rotation.
pub fn turn_ransac(
    pixels_a: &[DVec2],
    pixels_b: &[DVec2],
    weights: &[f64],
    k: &Intrinsics,
    options: &RansacOptions,
) -> Option<Consensus<DQuat>> {
    let pairs = Pairs::gather(pixels_a, pixels_b, Some(weights), k, k);
    let found = ransac(&Turn(&pairs), options, &[])?;
    let inliers = found.inliers.iter().map(|&i| pairs.origin[i]).collect();
    Some(Consensus { inliers, ..found })
}

/// Final refinement: the pose on all its inliers until they no longer change, with the one of its four
/// decompositions that has most of them in front.
fn settle(
    pairs: &Pairs,
    consensus: Consensus<Relative>,
    options: &TwoViewOptions,
) -> (Pose, Vec<usize>) {
    let mut pose = consensus.model.pose;
    let mut inliers = consensus.inliers;
    let limit = options.ransac.threshold.powi(2);
    for _ in 0..3 {
        let subset: Vec<_> = inliers.iter().map(|&i| pairs.pixels[i]).collect();
        let weights: Vec<f64> = inliers.iter().map(|&i| pairs.weights[i]).collect();
        let width = options.ransac.threshold;
        (pose, _) =
            refine_relative(&pose, &pairs.ka, &pairs.kb, &subset, Some(&weights), width, 20);
        let rays: Vec<_> = inliers.iter().map(|&i| pairs.rays[i]).collect();
        if let Some((best, _)) = cheiral_pose(&essential_from_pose(&pose), &rays) {
            pose = best;
        }
        let f = fundamental_from_essential(&essential_from_pose(&pose), &pairs.ka, &pairs.kb);
        let next: Vec<usize> = (0..pairs.pixels.len())
            .filter(|&i| sampson_squared(&f, pairs.pixels[i].0, pairs.pixels[i].1) < limit)
            .collect();
        let settled = next == inliers;
        inliers = next;
        if settled {
            break;
        }
    }
    inliers.retain(|&i| pairs.meets(&pose, i));
    (pose, inliers)
}

/// The usable pairs.
/// Checks the lengths of the second image's pixels and of the weights against the first image's pixels.
fn check_lengths(first: usize, second: usize, weights: Option<&[f64]>) -> Result<()> {
    for (arg, actual) in [("pixels of b", second), ("weights", weights.map_or(first, <[f64]>::len))]
    {
        if actual != first {
            let expected = format!("{first}, one for each pixel of the first image");
            return Err(Error::Shape { op: OP, arg, expected, actual });
        }
    }
    Ok(())
}

struct Pairs {
    pixels: Vec<(DVec2, DVec2)>,
    rays: Vec<(DVec3, DVec3)>,
    weights: Vec<f64>,
    origin: Vec<usize>,
    ka: Intrinsics,
    kb: Intrinsics,
}

impl Pairs {
    fn gather(
        a: &[DVec2],
        b: &[DVec2],
        weights: Option<&[f64]>,
        ka: &Intrinsics,
        kb: &Intrinsics,
    ) -> Pairs {
        let mut pairs = Pairs {
            pixels: vec![],
            rays: vec![],
            weights: vec![],
            origin: vec![],
            ka: *ka,
            kb: *kb,
        };
        for i in 0..a.len() {
            let w = weights.map_or(1.0, |w| w[i]);
            if a[i].is_finite() && b[i].is_finite() && w.is_finite() && w > 0.0 {
                pairs.pixels.push((a[i], b[i]));
                pairs.rays.push((ka.ray(a[i]), kb.ray(b[i])));
                pairs.weights.push(w);
                pairs.origin.push(i);
            }
        }
        pairs
    }

    fn mask(&self, inliers: &[usize], total: usize) -> Vec<bool> {
        let mut mask = vec![false; total];
        inliers.iter().for_each(|&i| mask[self.origin[i]] = true);
        mask
    }

    /// Distance in image b between a pixel and its partner after a rotation, pixels.
    fn turned(&self, b_from_a: DQuat, i: usize) -> f64 {
        let p = b_from_a * self.rays[i].0;
        if p.z > 1e-9 { (self.kb.project(p) - self.pixels[i].1).length() } else { f64::INFINITY }
    }

    /// Whether a pair's rays meet in front of both cameras. Rays whose divergence noise can explain count
    /// as meeting at infinity.
    fn meets(&self, pose: &Pose, i: usize) -> bool {
        let (a, b) = self.rays[i];
        in_front(pose, a, b) || self.turned(pose.rotation, i) < 1.0
    }

    /// The number of inliers that fit the best homography of all pairs.
    fn on_a_plane(&self, inliers: &[usize], options: &RansacOptions) -> usize {
        ransac(&Plane(self), options, &[]).map_or(0, |h| {
            let inverse = h.model.inverse();
            let limit = options.threshold.powi(2);
            let fits = |i: usize| {
                let (a, b) = self.pixels[i];
                transfer_squared(&h.model, &inverse, a, b) < limit
            };
            inliers.iter().filter(|&&i| fits(i)).count()
        })
    }

    /// Root mean square Sampson distance, pixels.
    fn sampson_rms(&self, pose: &Pose, inliers: &[usize]) -> f64 {
        let f = fundamental_from_essential(&essential_from_pose(pose), &self.ka, &self.kb);
        let squared = |&i: &usize| sampson_squared(&f, self.pixels[i].0, self.pixels[i].1);
        (inliers.iter().map(squared).sum::<f64>() / inliers.len() as f64).sqrt()
    }

    /// Median angle between the rays of the pairs that meet, degrees.
    fn median_angle(&self, pose: &Pose, inliers: &[usize]) -> f64 {
        let rays = |i: usize| [(Pose::IDENTITY, self.rays[i].0), (*pose, self.rays[i].1)];
        let met = inliers.iter().filter_map(|&i| triangulate(&rays(i)));
        median(met.map(|t| t.parallax.to_degrees()).collect())
    }

    fn without_translation(
        &self,
        rotation: DQuat,
        motion: Motion,
        inliers: Vec<usize>,
        displacement_px: f64,
        total: usize,
    ) -> TwoView {
        let residuals: Vec<f64> = inliers.iter().map(|&i| self.turned(rotation, i)).collect();
        let squared: f64 = residuals.iter().map(|r| r * r).sum();
        TwoView {
            b_from_a: Pose { rotation, translation: DVec3::ZERO },
            motion,
            inlier_ratio: inliers.len() as f64 / self.pixels.len() as f64,
            rmse: (squared / inliers.len().max(1) as f64).sqrt(),
            displacement_px,
            parallax_px: median(residuals),
            parallax_deg: 0.0,
            homography_ratio: 1.0,
            inliers: self.mask(&inliers, total),
        }
    }
}

/// The median; 0 without values.
fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// A relative pose with the matrix of its Sampson distances.
#[derive(Clone)]
struct Relative {
    pose: Pose,
    fundamental: DMat3,
}

struct Epipolar<'a>(&'a Pairs);

impl Epipolar<'_> {
    fn model(&self, pose: Pose) -> Relative {
        let e = essential_from_pose(&pose);
        Relative { pose, fundamental: fundamental_from_essential(&e, &self.0.ka, &self.0.kb) }
    }
}

impl Estimator for Epipolar<'_> {
    type Model = Relative;
    const SAMPLE: usize = 5;
    const LOCAL_SAMPLE: usize = 14;

    fn len(&self) -> usize {
        self.0.pixels.len()
    }

    fn minimal(&self, sample: &[usize], out: &mut Vec<Relative>) {
        let rays: Vec<_> = sample.iter().map(|&i| self.0.rays[i]).collect();
        for e in five_point(&rays) {
            // The rays of an outlier-free sample meet in front of both cameras, except possibly for one
            // distant point.
            if let Some((pose, count)) = cheiral_pose(&e, &rays)
                && count + 1 >= sample.len()
            {
                out.push(self.model(pose));
            }
        }
    }

    fn squared_error(&self, model: &Relative, i: usize) -> f64 {
        sampson_squared(&model.fundamental, self.0.pixels[i].0, self.0.pixels[i].1)
    }

    fn refine(&self, model: &Relative, sample: &[usize]) -> Option<Relative> {
        let pairs: Vec<_> = sample.iter().map(|&i| self.0.pixels[i]).collect();
        let weights: Vec<_> = sample.iter().map(|&i| self.0.weights[i]).collect();
        let refined =
            refine_relative(&model.pose, &self.0.ka, &self.0.kb, &pairs, Some(&weights), 1.0, 5);
        Some(self.model(refined.0))
    }

    fn weight(&self, i: usize) -> f64 {
        self.0.weights[i]
    }
}

struct Turn<'a>(&'a Pairs);

impl Turn<'_> {
    fn fit(&self, sample: &[usize]) -> Option<DQuat> {
        let unit = |pick: fn(&(DVec3, DVec3)) -> DVec3| -> Vec<DVec3> {
            // With the origin as an additional point of large weight, Umeyama's rotation is Kabsch's.
            sample
                .iter()
                .flat_map(|&i| {
                    let d = pick(&self.0.rays[i]).normalize_or_zero();
                    [d, -d]
                })
                .collect()
        };
        let found = align_points(&unit(|r| r.0), &unit(|r| r.1), None, false).ok()?;
        Some(found.reference_from_estimate.rotation)
    }
}

impl Estimator for Turn<'_> {
    type Model = DQuat;
    const SAMPLE: usize = 2;
    const LOCAL_SAMPLE: usize = 14;

    fn len(&self) -> usize {
        self.0.pixels.len()
    }

    fn minimal(&self, sample: &[usize], out: &mut Vec<DQuat>) {
        out.extend(self.fit(sample));
    }

    fn squared_error(&self, model: &DQuat, i: usize) -> f64 {
        self.0.turned(*model, i).powi(2)
    }

    fn refine(&self, _: &DQuat, sample: &[usize]) -> Option<DQuat> {
        self.fit(sample)
    }

    fn weight(&self, i: usize) -> f64 {
        self.0.weights[i]
    }
}

struct Plane<'a>(&'a Pairs);

impl Plane<'_> {
    fn fit(&self, sample: &[usize]) -> Option<DMat3> {
        let pairs: Vec<_> = sample.iter().map(|&i| self.0.pixels[i]).collect();
        homography(&pairs, None)
    }
}

impl Estimator for Plane<'_> {
    type Model = DMat3;
    const SAMPLE: usize = 4;
    const LOCAL_SAMPLE: usize = 14;

    fn len(&self) -> usize {
        self.0.pixels.len()
    }

    fn minimal(&self, sample: &[usize], out: &mut Vec<DMat3>) {
        out.extend(self.fit(sample));
    }

    fn squared_error(&self, h: &DMat3, i: usize) -> f64 {
        let (a, b) = self.0.pixels[i];
        transfer_squared(h, &h.inverse(), a, b)
    }

    fn refine(&self, _: &DMat3, sample: &[usize]) -> Option<DMat3> {
        self.fit(sample)
    }

    fn weight(&self, i: usize) -> f64 {
        self.0.weights[i]
    }
}

struct Fundamental<'a>(&'a [(DVec2, DVec2)]);

impl Estimator for Fundamental<'_> {
    type Model = DMat3;
    const SAMPLE: usize = 8;
    const LOCAL_SAMPLE: usize = 24;

    fn len(&self) -> usize {
        self.0.len()
    }

    fn minimal(&self, sample: &[usize], out: &mut Vec<DMat3>) {
        let pairs: Vec<_> = sample.iter().map(|&i| self.0[i]).collect();
        out.extend(eight_point(&pairs, None));
    }

    fn squared_error(&self, f: &DMat3, i: usize) -> f64 {
        sampson_squared(f, self.0[i].0, self.0[i].1)
    }

    fn refine(&self, _: &DMat3, sample: &[usize]) -> Option<DMat3> {
        let pairs: Vec<_> = sample.iter().map(|&i| self.0[i]).collect();
        eight_point(&pairs, None)
    }
}

#[cfg(test)]
mod tests;
