//! The exponential map of SE(3) and SO(3), and the adjoint.
//!
//! A twist ξ = (ρ, ω) holds the translation part first. Poses are perturbed from the left:
//! `exp(ξ) · a_from_b`, so ξ is expressed in frame a. (Solà et al., "A micro Lie theory", 2018.)

use crate::types::Pose;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, Matrix6, Vector6};

/// Twist (translation, rotation), in the frame that the pose maps to.
pub type Twist = Vector6<f64>;

/// Angle in radians below which series replace closed forms, which would lose digits to cancellation.
const SMALL_ANGLE: f64 = 1e-4;

/// The skew-symmetric matrix with `skew(a) b = a × b`.
pub fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, v.z, -v.y),
        DVec3::new(-v.z, 0.0, v.x),
        DVec3::new(v.y, -v.x, 0.0),
    )
}

/// The rotation by |ω| radians about ω.
pub fn exp_so3(omega: DVec3) -> DQuat {
    let angle = omega.length();
    let half = 0.5 * angle;
    // sin(θ/2)/θ
    let factor = if angle < SMALL_ANGLE { 0.5 - angle * angle / 48.0 } else { half.sin() / angle };
    let v = omega * factor;
    DQuat::from_xyzw(v.x, v.y, v.z, half.cos()).normalize()
}

/// The rotation vector of a unit quaternion, |ω| ≤ π.
pub fn log_so3(rotation: DQuat) -> DVec3 {
    // The equivalent quaternion with w ≥ 0, which gives the shorter rotation.
    let q = if rotation.w < 0.0 { -rotation } else { rotation };
    let v = DVec3::new(q.x, q.y, q.z);
    let sine = v.length();
    let factor = if sine < SMALL_ANGLE {
        2.0 / q.w - 2.0 * sine * sine / (3.0 * q.w.powi(3))
    } else {
        2.0 * sine.atan2(q.w) / sine
    };
    v * factor
}

/// The left Jacobian of SO(3): `exp(ω + δ) ≈ exp(J δ) exp(ω)`; it also maps ρ to the translation.
pub fn left_jacobian_so3(omega: DVec3) -> DMat3 {
    let angle2 = omega.length_squared();
    let angle = angle2.sqrt();
    let (b, c) = if angle < SMALL_ANGLE {
        (0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0)
    } else {
        ((1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
    };
    let w = skew(omega);
    DMat3::IDENTITY + w * b + w * w * c
}

/// The pose of a twist (exponential map).
pub fn exp(twist: &Twist) -> Pose {
    let (rho, omega) = parts(twist);
    Pose { rotation: exp_so3(omega), translation: left_jacobian_so3(omega) * rho }
}

/// The twist of a pose (logarithmic map).
pub fn log(pose: &Pose) -> Twist {
    let omega = log_so3(pose.rotation);
    let rho = left_jacobian_so3(omega).inverse() * pose.translation;
    Twist::new(rho.x, rho.y, rho.z, omega.x, omega.y, omega.z)
}

/// `exp(ξ) · pose`, the left perturbation that all Jacobians of this crate refer to.
pub fn retract(pose: &Pose, twist: &Twist) -> Pose {
    exp(twist) * *pose
}

/// `Ad(T)` with `T exp(ξ) = exp(Ad(T) ξ) T`.
pub fn adjoint(pose: &Pose) -> Matrix6<f64> {
    let r = pose.rotation_matrix();
    let tr = skew(pose.translation) * r;
    let mut ad = Matrix6::zeros();
    ad.fixed_view_mut::<3, 3>(0, 0).copy_from(&matrix3(&r));
    ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&matrix3(&tr));
    ad.fixed_view_mut::<3, 3>(3, 3).copy_from(&matrix3(&r));
    ad
}

/// The angle between two rotations, radians in [0, π].
pub fn angle_between(a: DQuat, b: DQuat) -> f64 {
    log_so3(a * b.conjugate()).length()
}

/// glam's 3×3 as nalgebra's.
pub(crate) fn matrix3(m: &DMat3) -> Matrix3<f64> {
    Matrix3::from_column_slice(&m.to_cols_array())
}

fn parts(twist: &Twist) -> (DVec3, DVec3) {
    (DVec3::new(twist[0], twist[1], twist[2]), DVec3::new(twist[3], twist[4], twist[5]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(omega: [f64; 3], t: [f64; 3]) -> Pose {
        Pose::new(exp_so3(omega.into()), t.into())
    }

    #[test]
    fn log_inverts_exp_from_tiny_to_nearly_pi() {
        let axis = DVec3::new(0.3, -0.5, 0.8).normalize();
        for angle in [0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 0.1, 1.0, 3.0, 3.13] {
            let w = axis * angle;
            let twist = Twist::new(1.0, -2.0, 0.5, w.x, w.y, w.z);
            let back = log(&exp(&twist));
            assert!((back - twist).norm() < 1e-9, "angle {angle}: {back} {twist}");
        }
    }

    #[test]
    fn log_takes_the_short_way_for_either_sign_of_the_quaternion() {
        let q = exp_so3(DVec3::new(0.2, 0.1, -0.3));
        assert!((log_so3(q) - log_so3(-q)).length() < 1e-14);
    }

    #[test]
    fn adjoint_moves_a_twist_across_a_pose() {
        let t = pose([0.4, -0.2, 0.9], [1.0, 2.0, -3.0]);
        let xi = Twist::new(0.1, 0.2, -0.3, 0.05, -0.04, 0.3);
        let left = t * exp(&xi);
        let right = exp(&(adjoint(&t) * xi)) * t;
        assert!((log(&(left * right.inverse()))).norm() < 1e-12);
    }

    #[test]
    fn left_jacobian_matches_central_differences() {
        for omega in [DVec3::new(0.4, -0.7, 0.2), DVec3::new(1e-5, 2e-5, -1e-5)] {
            let j = left_jacobian_so3(omega);
            let h = 1e-6;
            for k in 0..3 {
                let mut d = DVec3::ZERO;
                d[k] = h;
                let plus = log_so3(exp_so3(omega + d) * exp_so3(omega).conjugate());
                let minus = log_so3(exp_so3(omega - d) * exp_so3(omega).conjugate());
                let numeric = (plus - minus) / (2.0 * h);
                assert!((numeric - j.col(k)).length() < 1e-8, "{numeric} {}", j.col(k));
            }
        }
    }
}
