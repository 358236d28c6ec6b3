//! The valid range of each kind of number.
//!
//! Every number from outside is checked against its range before use: readers call the
//! `check` of the type that they fill ([`Intrinsics`](super::Intrinsics), [`Pose`](super::Pose),
//! [`Camera`](super::Camera), [`Gaussians`](super::Gaussians), …) and add the place in the file;
//! the renderer and the trainer call it on their arguments. A failed check returns a description of
//! the violation, as the end of an error message.
//!
//! | kind | range | why |
//! |---|---|---|
//! | places of cameras, first points | [`CAMERA_REACH`] from the origin | georeferenced coordinates in millimetres lie at 1e10 |
//! | places of Gaussians, control points | [`REACH`] | f32 squares them; training may leave the cameras' surroundings |
//! | rotations | unit length, or an orthonormal matrix, within [`ROTATION_TOLERANCE`] | rounding in text files, no more |
//! | scale left on a matrix | [`MATRIX_SCALE`] | exporters leave one there |
//! | image sides | [`SIDE`] | the number of pixels stays below 2³² |
//! | focal length, principal point | no ray beyond [`LARGEST_TANGENT`], at most [`LONGEST_FOCAL`] sides | a pinhole sees less than half a sphere |
//! | timestamps | [`LATEST`] | nanoseconds since 1970 are 1.7e18 |
//! | times of a scene | [0, 1]; to render, within [`MOMENT`] | so they are defined |
//! | colours | [0, 1] | so they are defined |
//! | log scales, log radii | [`LOG_SCALE`] | the logarithm of any f32 whose square is one too |
//! | logits, spherical harmonics, parts of a Gaussian's quaternion | [`HALF`] in size | renderers keep them in 16 bits |
//! | a network's weights | [`WEIGHT`] in size | trained ones lie below 100 |
//! | optical flow | [`FLOW`] in size, else unknown | Middlebury's mark for unknown is 1e10 |
//! | depth | [`DEPTH`], else unknown (0) or infinite | its inverse and its square are f32 |
//!
//! The range of a lens's distortion depends on the image: [`crate::data::Distortion::check`].

use glam::{DMat3, DQuat, DVec3};
use std::fmt::Debug;
use std::ops::RangeInclusive;

/// The result of a check; the error describes the violation.
pub type Check = std::result::Result<(), String>;

/// Farthest from the origin that a camera or a point of a dataset may lie.
pub const CAMERA_REACH: f64 = 1e12;
/// Farthest from the origin, along each axis, that a Gaussian or a control point may lie.
pub const REACH: f32 = 1e15;
/// Maximum deviation from 1 of the length of a quaternion or a direction, and of the scale of a
/// matrix that must have none.
pub const ROTATION_TOLERANCE: f64 = 0.05;
/// Maximum deviation of an entry of RᵀR from the identity, for a matrix R whose scale is divided
/// out.
const SHEAR: f64 = 1e-2;
/// Uniform scale that a matrix may carry beside its rotation.
pub const MATRIX_SCALE: RangeInclusive<f64> = 1e-6..=1e6;
/// Sides of an image, pixels.
pub const SIDE: RangeInclusive<u32> = 1..=65_535;
/// Tangent of the largest angle between the optical axis and a ray through the image: 87.5°, for a
/// field of view of 175°.
pub const LARGEST_TANGENT: f64 = 22.9;
/// Longest focal length, in units of the image's longer side: a field of view of 0.00006°.
pub const LONGEST_FOCAL: f64 = 1e6;
/// Largest timestamp before it is mapped to [0, 1], in size.
pub const LATEST: f64 = 1e20;
/// Largest magnitude of a time to render.
pub const MOMENT: f64 = 1e3;
/// Range of the natural logarithms of scales and radii.
pub const LOG_SCALE: RangeInclusive<f32> = -104.0..=43.0;
/// The largest 16-bit float.
pub const HALF: f32 = 65_504.0;
/// A Gaussian whose quaternion is shorter than this is not rendered.
const LEAST_QUATERNION: f32 = 1e-10;
/// Largest weight or bias of a deformation network, in size.
pub const WEIGHT: f32 = 1e6;
/// Largest component of a flow vector that is known, in size, pixels.
pub const FLOW: f32 = 1e9;
/// Range of known depths.
pub const DEPTH: RangeInclusive<f32> = 1e-15..=1e15;

/// Checks a timestamp.
pub fn timestamp(time: f64) -> Check {
    wanted(time.abs() <= LATEST, || format!("time {time:?} is not within ±{LATEST:e}"))
}

/// Checks that a time lies in [0, 1].
pub fn time(time: f64) -> Check {
    wanted((0.0..=1.0).contains(&time), || format!("time {time:?} is not in [0, 1]"))
}

/// Checks a time to render: motion is extrapolated beyond [0, 1], up to [`MOMENT`].
pub fn moment(time: f64) -> Check {
    wanted(time.abs() <= MOMENT, || format!("time {time:?} is not in [0, 1]"))
}

/// Checks that a colour lies in [0, 1].
pub fn colour(colour: [f32; 3]) -> Check {
    let inside = colour.iter().all(|c| (0.0..=1.0).contains(c));
    wanted(inside, || format!("colour {colour:?} is not in [0, 1]"))
}

/// Checks the position of a camera or of an initial point.
pub fn place(place: DVec3) -> Check {
    wanted(place.length() <= CAMERA_REACH, || {
        format!(
            "{:?} is not within {CAMERA_REACH:e} of the origin; move or scale the scene",
            place.to_array()
        )
    })
}

/// Checks that a direction is of unit length up to rounding.
pub fn unit(direction: DVec3) -> Check {
    wanted((direction.length() - 1.0).abs() <= ROTATION_TOLERANCE, || {
        format!("{:?} is no direction: its length is not 1", direction.to_array())
    })
}

/// Checks that a quaternion is of unit length up to rounding.
pub fn quaternion(rotation: DQuat) -> Check {
    let length = rotation.length();
    wanted((length - 1.0).abs() <= ROTATION_TOLERANCE, || {
        format!(
            "{:?} is no rotation: a quaternion of length {length:?}, 1 expected",
            rotation.to_array()
        )
    })
}

/// The rotation and the uniform scale of a matrix that is their product.
///
/// # Errors
/// A description: the length of a column is not in [`MATRIX_SCALE`], the columns differ in length
/// or are not orthogonal, or the matrix is a reflection.
pub fn rotation_and_scale(matrix: DMat3) -> Result<(DQuat, f64), String> {
    let columns = [matrix.x_axis, matrix.y_axis, matrix.z_axis];
    let scale = columns.iter().map(|c| c.length()).sum::<f64>() / 3.0;
    let refused = |what: String| Err(format!("is not a rigid transform: {what}"));
    if !MATRIX_SCALE.contains(&scale) {
        return refused(format!("its columns have a mean length of {scale:?}"));
    }
    let rotation = matrix * (1.0 / scale);
    let error = rotation.transpose() * rotation - DMat3::IDENTITY;
    // `max` is not used here because it ignores NaN.
    if !error.to_cols_array().iter().all(|e| e.abs() < SHEAR) {
        return refused("its columns are not of one length and at right angles".into());
    }
    if rotation.determinant() < 0.0 {
        return refused("it mirrors".into());
    }
    Ok((DQuat::from_mat3(&rotation).normalize(), scale))
}

/// Checks that a value lies within ±`most`; `what` names it.
pub(crate) fn within(what: &str, value: f32, most: f32) -> Check {
    wanted(value.abs() <= most, || format!("{what} {value:?} is not within ±{most:e}"))
}

/// Checks that a value lies in a range; `what` names it.
pub(crate) fn inside<T: PartialOrd + Debug>(
    what: &str,
    value: T,
    range: &RangeInclusive<T>,
) -> Check {
    wanted(range.contains(&value), || {
        format!("{what} {value:?} is not in [{:?}, {:?}]", range.start(), range.end())
    })
}

/// Checks that a Gaussian's quaternion, of any length, has a direction.
pub(crate) fn direction(q: [f32; 4]) -> Check {
    q.iter().try_for_each(|&part| within("rotation", part, HALF))?;
    let length = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    wanted(length >= f64::from(LEAST_QUATERNION), || format!("rotation {q:?} has no direction"))
}

/// An error with this text unless the condition holds. The condition must be false for NaN.
pub(crate) fn wanted(holds: bool, words: impl FnOnce() -> String) -> Check {
    if holds { Ok(()) } else { Err(words()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Camera, ControlPoints, DeformNet, Gaussians, Intrinsics, NetShape, Pose};

    const WILD: [f64; 6] = [1e19, 1e300, -1e300, f64::NAN, f64::INFINITY, f64::NEG_INFINITY];

    #[test]
    fn what_is_in_use_is_legal() {
        // A million units from the origin, UTM in millimetres, a path of micrometres.
        for far in [0.0, 1e-6, 1e6, 1e10] {
            place(DVec3::splat(far)).unwrap();
        }
        timestamp(1.7e18).unwrap();
        // 1° and 170°, a crop far from the axis, a satellite's.
        for (focal, cx) in [(11_500.0, 100.0), (9.0, 100.0), (1e6, -4e4), (2e8, 100.0)] {
            let k = Intrinsics { cx, ..Intrinsics::centred(focal, 200, 100) };
            k.check().unwrap();
        }
        Gaussians::one(3).check(0).unwrap();
    }

    #[test]
    fn wild_numbers_are_refused_everywhere() {
        let good = Intrinsics::centred(100.0, 64, 48);
        good.check().unwrap();
        for v in WILD {
            assert!(place(DVec3::new(0.0, v, 0.0)).is_err(), "{v}");
            assert!(v == 1e19 || timestamp(v).is_err(), "{v}");
            assert!(time(v).is_err() && colour([0.0, v as f32, 0.0]).is_err(), "{v}");
            assert!(quaternion(DQuat::from_xyzw(0.0, 0.0, v, 1.0)).is_err(), "{v}");
            let matrix = DMat3::from_cols(DVec3::X, DVec3::Y, DVec3::new(0.0, v, 1.0));
            assert!(rotation_and_scale(matrix).is_err(), "{v}");
            assert!(rotation_and_scale(DMat3::from_diagonal(DVec3::splat(v))).is_err(), "{v}");
            for k in [
                Intrinsics { fx: v, ..good },
                Intrinsics { fy: v, ..good },
                Intrinsics { cx: v, ..good },
                Intrinsics { cy: v, ..good },
            ] {
                assert!(k.check().is_err(), "{k:?}");
            }
            let pose = Pose { translation: DVec3::new(v, 0.0, 0.0), ..Pose::IDENTITY };
            assert!(Camera { intrinsics: good, view_from_world: pose }.check().is_err(), "{v}");
            let v = v as f32;
            let one = || Gaussians::one(0);
            for g in [
                Gaussians { positions: vec![[0.0, 0.0, v]], ..one() },
                Gaussians { log_scales: vec![[0.0, 0.0, v]], ..one() },
                Gaussians { rotations: vec![[1.0, 0.0, 0.0, v]], ..one() },
                Gaussians { opacity_logits: vec![v], ..one() },
                Gaussians { sh: vec![[v, 0.0, 0.0]], ..one() },
                Gaussians { motion_logits: vec![v], ..one() },
            ] {
                assert!(g.check(0).is_err(), "{g:?}");
            }
            let points =
                ControlPoints { positions: vec![[v; 3]], log_radii: vec![0.0], paths: vec![] };
            assert!(points.check().is_err(), "{v}");
            let points =
                ControlPoints { positions: vec![[0.0; 3]], log_radii: vec![v], paths: vec![] };
            assert!(points.check().is_err(), "{v}");
            let shape = NetShape { depth: 1, width: 16, ..NetShape::PAPER };
            let mut network = DeformNet::random(shape, 0);
            network.check().unwrap();
            network.parameters[5] = v;
            assert!(network.check().is_err(), "{v}");
        }
        let nowhere = Gaussians { rotations: vec![[0.0; 4]], ..Gaussians::one(0) };
        assert!(nowhere.check(0).is_err());
        for k in [
            Intrinsics { width: 0, ..good },
            Intrinsics { height: 65_536, ..good },
            Intrinsics::centred(0.0, 64, 48),
            Intrinsics::centred(1.0, 1920, 1080),
        ] {
            assert!(k.check().is_err(), "{k:?}");
        }
    }

    #[test]
    fn matrices_are_rotations_with_a_scale() {
        let turn = DMat3::from_rotation_y(0.7);
        let (rotation, scale) = rotation_and_scale(turn * 0.33).unwrap();
        assert!((scale - 0.33).abs() < 1e-12 && rotation.is_normalized());
        assert!(
            (DMat3::from_quat(rotation) - turn).to_cols_array().iter().all(|e| e.abs() < 1e-12)
        );
        let sheared = turn * DMat3::from_cols(DVec3::X, DVec3::new(0.5, 1.0, 0.0), DVec3::Z);
        assert!((sheared.determinant() - 1.0).abs() < 1e-12);
        for bad in [DMat3::ZERO, sheared, DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0))] {
            assert!(rotation_and_scale(bad).unwrap_err().contains("not a rigid transform"));
        }
    }
}
