//! Projection of 3D Gaussians to splats on the image; the backward pass is in
//! [`project_backward`](super::project_backward).
//!
//! With `M = J W R S` (2×3: the projection's Jacobian, the view rotation, the Gaussian's rotation
//! and scales) the 2D covariance is `M Mᵀ + dilation·I`, and its determinant is the sum of the
//! squared 2×2 minors of M, plus `dilation · tr(M Mᵀ) + dilation²`: squares only, so needles do not
//! cancel. All of it is computed in units of the largest entry of M, so that scales from 1e-20 to
//! 1e20 neither overflow nor underflow in f32.
//!
//! The conic comes as the triangular factor of its half, [`tiles::power`]: from the variance of y,
//! and the variance of x where y is given, which is the determinant over the former.

use super::Real;
use super::linear::{Mat3, Vec3, dot, finite, max_abs, mul, mul_vec, normalise, rotation};
use super::sh;
use super::tiles::{self, TileRect};
use super::view::{Cloud, View};
use crate::types::RenderSettings;
use rayon::prelude::*;

/// Positions (in the camera's frame) and colours beyond this count as not finite: products of them in
/// the gradients would overflow f32.
pub const LARGEST: f64 = 1e18;

/// Shorter quaternions count as zero, and their Gaussian is culled.
pub const LEAST_QUATERNION: f64 = 1e-10;

/// A Gaussian projected to the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Splat<R> {
    /// Centre, pixels.
    pub mean: [R; 2],
    /// Half the inverse 2D covariance, [factored](tiles::power).
    pub conic: [R; 3],
    /// Opacity in [0, 1].
    pub opacity: R,
    /// z in the camera's frame.
    pub depth: R,
    /// RGB, clamped at 0.
    pub colour: Vec3<R>,
    /// The tiles of the bounding box of the region in which α reaches the cut.
    pub rect: TileRect,
    /// Number of tiles of `rect` that the splat overlaps.
    pub tile_count: u32,
}

impl<R: Real> Splat<R> {
    /// The power at which α falls to the cut: `ln(opacity / alpha_cut)`.
    pub fn reach(&self, settings: &RenderSettings) -> R {
        (self.opacity / R::of(f64::from(settings.alpha_cut))).ln()
    }

    /// The tiles that the splat overlaps, row by row.
    pub fn tiles(
        &self,
        settings: &RenderSettings,
        width: u32,
        height: u32,
    ) -> impl Iterator<Item = [u32; 2]> {
        let (mean, conic, reach) = (self.mean, self.conic, self.reach(settings));
        self.rect.tiles().filter(move |&tile| tiles::hit(mean, conic, reach, tile, width, height))
    }
}

/// The intermediate values of projection that the backward pass needs again.
pub(super) struct Geometry<R> {
    /// Centre in the camera's frame.
    pub point: Vec3<R>,
    /// Tangents x/z and y/z at which the Jacobian is taken.
    pub tangent: [R; 2],
    /// Whether they were clamped.
    pub clamped: [bool; 2],
    /// Length of the quaternion, and the quaternion normalised.
    pub quaternion: (R, [R; 4]),
    /// W R: columns are the Gaussian's axes in the camera's frame.
    pub axes: Mat3<R>,
    /// Standard deviations.
    pub scales: Vec3<R>,
    /// `J`, two rows.
    pub jacobian: [Vec3<R>; 2],
    /// The unit of length for what follows, pixels: the largest entry of M or √dilation.
    pub unit: R,
    /// M / unit.
    pub m: [Vec3<R>; 2],
    /// The factored conic in units of 1 / unit.
    pub conic: [R; 3],
    /// Covariance's diagonal in units of unit².
    pub variance: [R; 2],
    /// dilation / unit².
    pub dilation: R,
}

/// The geometry of a Gaussian; `None` if the Gaussian cannot be drawn.
pub(super) fn geometry<R: Real>(
    cloud: &Cloud<R>,
    index: usize,
    view: &View<R>,
    settings: &RenderSettings,
) -> Option<Geometry<R>> {
    let setting = |x: f32| R::of(f64::from(x));
    let point = mul_vec(&view.rotation, view.sight(cloud.positions[index]));
    let scales = cloud.log_scales[index].map(R::exp);
    let usable = finite(point)
        && max_abs(point) <= R::of(LARGEST)
        && point[2] > setting(settings.near)
        && finite(cloud.log_scales[index])
        && finite(scales)
        && finite(cloud.rotations[index]);
    if !usable {
        return None;
    }
    let quaternion = normalise(cloud.rotations[index])
        .filter(|(length, _)| *length >= R::of(LEAST_QUATERNION) && length.is_finite())?;

    let z = point[2];
    let size = [view.width, view.height].map(|n| R::of(f64::from(n)));
    let mut tangent = [point[0] / z, point[1] / z];
    let mut clamped = [false; 2];
    for k in 0..2 {
        // The margin beyond the image's edges, for any position of the principal point.
        let margin =
            (setting(settings.tangent_clamp) - R::one()) * R::of(0.5) * size[k] / view.focal[k];
        let low = -view.centre[k] / view.focal[k] - margin;
        let high = (size[k] - view.centre[k]) / view.focal[k] + margin;
        let inside = tangent[k].max(low).min(high);
        clamped[k] = inside != tangent[k];
        tangent[k] = inside;
    }
    let (sx, sy) = (view.focal[0] / z, view.focal[1] / z);
    let jacobian = [[sx, R::zero(), -sx * tangent[0]], [R::zero(), sy, -sy * tangent[1]]];

    let axes = mul(&view.rotation, &rotation(quaternion.1));
    let m: [Vec3<R>; 2] = std::array::from_fn(|row| {
        std::array::from_fn(|axis| {
            scales[axis] * (0..3).map(|k| jacobian[row][k] * axes[k][axis]).sum::<R>()
        })
    });
    let unit = max_abs(m[0]).max(max_abs(m[1])).max(setting(settings.dilation).sqrt());
    if !(finite(m[0]) && finite(m[1]) && unit > R::zero() && unit.is_finite()) {
        return None;
    }
    let m = m.map(|row| row.map(|x| x / unit));
    let dilation = setting(settings.dilation) / unit / unit;
    let variance = [dot(m[0], m[0]) + dilation, dot(m[1], m[1]) + dilation];
    let covariance = dot(m[0], m[1]);
    let minor = |i: usize, j: usize| m[0][i] * m[1][j] - m[0][j] * m[1][i];
    let minors = [minor(0, 1), minor(0, 2), minor(1, 2)];
    let determinant =
        dot(minors, minors) + dilation * (dot(m[0], m[0]) + dot(m[1], m[1])) + dilation * dilation;
    if !(determinant > R::zero() && determinant.is_finite() && variance[1] > R::zero()) {
        return None;
    }
    let half = R::of(0.5);
    let a = (half * (variance[1] / determinant)).sqrt();
    let conic = [a, -(covariance / variance[1]) * a, (half / variance[1]).sqrt()];
    Some(Geometry {
        point,
        tangent,
        clamped,
        quaternion,
        axes,
        scales,
        jacobian,
        unit,
        m,
        conic,
        variance,
        dilation,
    })
}

/// Logistic function, exact at both ends.
pub(super) fn sigmoid<R: Real>(x: R) -> R {
    if x >= R::zero() {
        R::one() / (R::one() + (-x).exp())
    } else {
        let e = x.exp();
        e / (R::one() + e)
    }
}

/// The vector from the camera's centre to the Gaussian, world frame: its length and direction.
pub(super) fn sight<R: Real>(position: Vec3<R>, view: &View<R>) -> Option<(R, Vec3<R>)> {
    normalise(view.sight(position))
}

fn splat<R: Real>(
    cloud: &Cloud<R>,
    index: usize,
    view: &View<R>,
    settings: &RenderSettings,
) -> Option<Splat<R>> {
    let opacity = sigmoid(cloud.opacity_logits[index]);
    if !cloud.opacity_logits[index].is_finite() || opacity < R::of(f64::from(settings.alpha_cut)) {
        return None;
    }
    let g = geometry(cloud, index, view, settings)?;
    let mean: [R; 2] =
        std::array::from_fn(|k| view.focal[k] * g.point[k] / g.point[2] + view.centre[k]);
    let conic = g.conic.map(|x| x / g.unit);
    if !(finite(mean) && finite(conic)) {
        return None;
    }
    let reach = (opacity / R::of(f64::from(settings.alpha_cut))).ln();
    let extent = g.variance.map(|v| g.unit * (R::of(2.0) * reach * v).sqrt());
    let rect = TileRect::around(mean, extent, view.width, view.height);

    let (_, direction) = sight(cloud.positions[index], view)?;
    let colour = sh::colour(cloud.sh_of(index), direction);
    let small = cloud.sh_of(index).iter().all(|&c| max_abs(c) <= R::of(LARGEST));
    if !finite(colour) || !small {
        return None;
    }
    let colour = colour.map(|c| c.max(R::zero()));
    let mut splat = Splat { mean, conic, opacity, depth: g.point[2], colour, rect, tile_count: 0 };
    splat.tile_count = splat.tiles(settings, view.width, view.height).count() as u32;
    (splat.tile_count > 0).then_some(splat)
}

/// Projects every Gaussian; `None` for the culled: nearer than the near plane, more transparent than
/// the cut, outside the image, reaching no tile, or with anything that is not finite.
///
/// The 2D covariance is EWA splatting's, with the Jacobian taken at tangents clamped to the field of
/// view times `tangent_clamp`; colours are spherical harmonics along the line of sight plus 0.5,
/// clamped at 0.
pub fn project<R: Real>(
    cloud: &Cloud<R>,
    view: &View<R>,
    settings: &RenderSettings,
) -> Vec<Option<Splat<R>>> {
    let one = |index| splat(cloud, index, view, settings);
    (0..cloud.len()).into_par_iter().map(one).collect()
}
