//! Gradients of [`project`](super::project::project) with respect to every parameter of the
//! Gaussians and to the camera.

use super::Real;
use super::linear::{
    Mat3, Vec3, add, cross, dot, mul_vec, normalise_backward, rotation_backward, scale, tmul_vec,
};
use super::project::{Geometry, Splat, geometry, sight, sigmoid};
use super::sh;
use super::view::{Cloud, View};
use crate::types::{RenderSettings, sh_coefficients};

/// Gradient of the loss with respect to a splat's attributes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SplatGradient<R> {
    /// With respect to the centre, per pixel.
    pub mean: [R; 2],
    /// With respect to the covariance, whitened by the conic's factor U: entries xx, xy, yy of the
    /// symmetric G for which `2 Uᵀ G U` is the gradient with respect to the covariance itself.
    pub covariance: [R; 3],
    /// With respect to the opacity.
    pub opacity: R,
    /// With respect to the depth.
    pub depth: R,
    /// With respect to the colour.
    pub colour: Vec3<R>,
}

/// Gradient of the loss with respect to the camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewGradient<R> {
    /// With respect to the twist ξ = (ρ, φ), translation first, of `view_from_world ← exp(ξ) ·
    /// view_from_world` at ξ = 0.
    pub twist: [R; 6],
    /// With respect to the focal lengths along x and y.
    pub focal: [R; 2],
    /// With respect to the principal point.
    pub centre: [R; 2],
}

/// The gradients accumulated through the centre and through the covariance.
struct PointGradient<R> {
    point: Vec3<R>,
    /// With respect to `W R S`, the scaled axes in the camera's frame.
    scaled_axes: Mat3<R>,
    log_scales: Vec3<R>,
    focal: [R; 2],
    centre: [R; 2],
}

/// Gradients with respect to the Gaussians and the camera, given those with respect to the splats
/// (`gradients[i]` is read only if `splats[i]` was drawn).
pub fn project_backward<R: Real>(
    cloud: &Cloud<R>,
    view: &View<R>,
    settings: &RenderSettings,
    splats: &[Option<Splat<R>>],
    gradients: &[SplatGradient<R>],
) -> (Cloud<R>, ViewGradient<R>) {
    let mut out = cloud.zeros_like();
    let mut camera = ViewGradient::default();
    for index in 0..cloud.len() {
        if splats[index].is_some() {
            one(cloud, index, view, settings, &gradients[index], &mut out, &mut camera);
        }
    }
    (out, camera)
}

fn one<R: Real>(
    cloud: &Cloud<R>,
    index: usize,
    view: &View<R>,
    settings: &RenderSettings,
    gradient: &SplatGradient<R>,
    out: &mut Cloud<R>,
    camera: &mut ViewGradient<R>,
) {
    let Some(g) = geometry(cloud, index, view, settings) else { return };
    let Some((distance, direction)) = sight(cloud.positions[index], view) else { return };

    let through = point_and_shape(&g, view, gradient);
    let (sh, sight) = colour(cloud, index, distance, direction, gradient.colour);

    out.positions[index] = add(tmul_vec(&view.rotation, through.point), sight);
    out.log_scales[index] = through.log_scales;
    // W R S = (W R) S, and R's own gradient is Wᵀ · (to W R).
    let mut to_rotation = [[R::zero(); 3]; 3];
    for axis in 0..3 {
        let column = std::array::from_fn(|row| through.scaled_axes[row][axis] * g.scales[axis]);
        let turned = tmul_vec(&view.rotation, column);
        for row in 0..3 {
            to_rotation[row][axis] = turned[row];
        }
    }
    let (length, unit) = g.quaternion;
    out.rotations[index] = normalise_backward(length, unit, rotation_backward(unit, &to_rotation));
    let logit = cloud.opacity_logits[index];
    out.opacity_logits[index] = gradient.opacity * sigmoid(logit) * sigmoid(-logit);
    let count = sh_coefficients(cloud.sh_degree);
    out.sh[index * count..(index + 1) * count].copy_from_slice(&sh[..count]);

    // A twist moves the point by ρ + φ × point, turns the axes by φ, and moves the camera's centre
    // by −Wᵀ ρ, which lengthens the line of sight by Wᵀ ρ.
    let rho = add(through.point, mul_vec(&view.rotation, sight));
    let mut phi = cross(g.point, through.point);
    for axis in 0..3 {
        let arm: Vec3<R> = std::array::from_fn(|row| g.axes[row][axis] * g.scales[axis]);
        let force = std::array::from_fn(|row| through.scaled_axes[row][axis]);
        phi = add(phi, cross(arm, force));
    }
    for k in 0..3 {
        camera.twist[k] += rho[k];
        camera.twist[3 + k] += phi[k];
    }
    camera.focal = add(camera.focal, through.focal);
    camera.centre = add(camera.centre, through.centre);
}

/// The gradient through the centre, the depth and the covariance.
fn point_and_shape<R: Real>(
    g: &Geometry<R>,
    view: &View<R>,
    gradient: &SplatGradient<R>,
) -> PointGradient<R> {
    let [x, y, z] = g.point;
    let (two, four) = (R::of(2.0), R::of(4.0));

    // Centre: focal · x/z + centre.
    let mut point = [
        gradient.mean[0] * view.focal[0] / z,
        gradient.mean[1] * view.focal[1] / z,
        gradient.depth,
    ];
    point[2] -= (point[0] * x + point[1] * y) / z;
    let mut focal = [gradient.mean[0] * x / z, gradient.mean[1] * y / z];
    let mut centre = gradient.mean;

    // Covariance Σ = M Mᵀ + d I: dL/dM = 2 (dL/dΣ) M = 4 Uᵀ G (U M). The first row of U M is what is
    // left of M's first row when the second explains its share: (r_y × (r_x × r_y) + d r_x) / Σ_yy,
    // where the parts that cancel in a needle drop out.
    let normal = cross(g.m[0], g.m[1]);
    let rest = add(cross(g.m[1], normal), scale(g.m[0], g.dilation));
    let [a, b, e] = g.conic;
    let white: [[R; 2]; 3] =
        std::array::from_fn(|i| [a * (rest[i] / g.variance[1]), e * g.m[1][i]]);
    let [xx, xy, yy] = gradient.covariance;
    let to_white = white.map(|[h, k]| [xx * h + xy * k, xy * h + yy * k]);
    let mut to_m = [[R::zero(); 3]; 2];
    for i in 0..3 {
        let [h, k] = to_white[i];
        to_m[0][i] = four * a * h / g.unit;
        to_m[1][i] = four * (b * h + e * k) / g.unit;
    }

    // M = J N with N = W R S; column i of M is proportional to exp(log scale i).
    let log_scales = std::array::from_fn(|i| four * dot(white[i], to_white[i]));
    let scaled_axes: Mat3<R> = std::array::from_fn(|row| {
        std::array::from_fn(|axis| {
            g.jacobian[0][row] * to_m[0][axis] + g.jacobian[1][row] * to_m[1][axis]
        })
    });
    let to_j: [Vec3<R>; 2] = std::array::from_fn(|row| {
        std::array::from_fn(|k| (0..3).map(|i| to_m[row][i] * g.axes[k][i] * g.scales[i]).sum())
    });

    // Row k of J is (f/z) (e_k − u e_z), u the tangent, held where it is clamped.
    for k in 0..2 {
        let (f, u) = (view.focal[k], g.tangent[k]);
        let (diagonal, slant) = (to_j[k][k], to_j[k][2]);
        point[2] -= diagonal * f / (z * z);
        focal[k] += diagonal / z;
        if g.clamped[k] {
            // f · u is then a distance from the principal point to the margin's end: free of f.
            point[2] += slant * f * u / (z * z);
            centre[k] += slant / z;
        } else {
            point[k] -= slant * f / (z * z);
            point[2] += two * slant * f * u / (z * z);
            focal[k] -= slant * u / z;
        }
    }
    PointGradient { point, scaled_axes, log_scales, focal, centre }
}

/// The gradient through the colour: with respect to the SH coefficients, and to the unnormalised
/// line of sight.
fn colour<R: Real>(
    cloud: &Cloud<R>,
    index: usize,
    distance: R,
    direction: Vec3<R>,
    gradient: Vec3<R>,
) -> ([Vec3<R>; 16], Vec3<R>) {
    let coefficients = cloud.sh_of(index);
    let seen = sh::colour(coefficients, direction);
    let gated: Vec3<R> =
        std::array::from_fn(|c| if seen[c] > R::zero() { gradient[c] } else { R::zero() });
    let basis = sh::basis(direction);
    let slopes = sh::basis_gradient(direction);
    let mut to_direction = [R::zero(); 3];
    for (coefficient, slope) in coefficients.iter().zip(slopes) {
        to_direction = add(to_direction, scale(slope, dot(gated, *coefficient)));
    }
    (basis.map(|b| scale(gated, b)), normalise_backward(distance, direction, to_direction))
}
