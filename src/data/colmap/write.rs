//! Writes a COLMAP model in binary form.

use std::io::Write;
use std::path::Path;

use glam::{DVec2, DVec3};

use super::{Lens, MODELS, Registered};
use crate::error::excerpt;
use crate::{Error, Result, io};

/// A triangulated point with its observations.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackedPoint {
    /// Position in the world.
    pub position: DVec3,
    /// RGB, encoded values in [0, 1].
    pub colour: [f32; 3],
    /// Mean reprojection error, pixels; `None` for a point without observations.
    pub error: Option<f64>,
    /// Observations: index of the image, and the pixel, with the image's corner at 0.
    pub observations: Vec<(usize, DVec2)>,
}

/// Observation of a point, as `images.bin` lists it.
struct Observed {
    pixel: DVec2,
    point: usize,
}

/// Writes `cameras.bin`, `images.bin` and `points3D.bin` to an existing folder, each by rename. Cameras are
/// `PINHOLE`, or `OPENCV` where there is distortion; their ids are those that the images refer to. Images
/// and points are numbered from 1 in their order.
///
/// # Errors
/// An image refers to a missing lens or has a name that cannot be written, a point refers to a missing
/// image, a lens has more than four distortion coefficients, a value is not finite; writing fails.
pub fn write_model(
    folder: &Path,
    lenses: &[(u32, Lens)],
    images: &[Registered],
    points: &[TrackedPoint],
) -> Result<()> {
    check(folder, lenses, images, points)?;
    let cameras: Vec<(u32, &Lens, Model)> = lenses
        .iter()
        .map(|(id, lens)| Ok((*id, lens, model(folder, lens)?)))
        .collect::<Result<_>>()?;
    // Each image lists its own observations; a point refers to them by their index in that list.
    let mut seen: Vec<Vec<Observed>> = images.iter().map(|_| Vec::new()).collect();
    let mut places: Vec<Vec<(u32, u32)>> = Vec::with_capacity(points.len());
    for (number, point) in points.iter().enumerate() {
        let place = |&(image, pixel): &(usize, DVec2)| {
            seen[image].push(Observed { pixel, point: number });
            (image as u32 + 1, seen[image].len() as u32 - 1)
        };
        places.push(point.observations.iter().map(place).collect());
    }
    io::write_atomically(folder.join("cameras.bin"), |sink| {
        sink.write_all(&(cameras.len() as u64).to_le_bytes())?;
        for (id, lens, Model { id: model, parameters }) in &cameras {
            sink.write_all(&id.to_le_bytes())?;
            sink.write_all(&model.to_le_bytes())?;
            sink.write_all(&u64::from(lens.intrinsics.width).to_le_bytes())?;
            sink.write_all(&u64::from(lens.intrinsics.height).to_le_bytes())?;
            floats(sink, parameters)?;
        }
        Ok(())
    })?;
    io::write_atomically(folder.join("images.bin"), |sink| {
        sink.write_all(&(images.len() as u64).to_le_bytes())?;
        for (i, (image, seen)) in images.iter().zip(&seen).enumerate() {
            let Registered { name, camera, view_from_world } = image;
            let (q, t) = (view_from_world.rotation, view_from_world.translation);
            sink.write_all(&(i as u32 + 1).to_le_bytes())?;
            floats(sink, &[q.w, q.x, q.y, q.z, t.x, t.y, t.z])?;
            sink.write_all(&camera.to_le_bytes())?;
            sink.write_all(name.as_bytes())?;
            sink.write_all(&[0])?;
            sink.write_all(&(seen.len() as u64).to_le_bytes())?;
            for Observed { pixel, point } in seen {
                floats(sink, &pixel.to_array())?;
                sink.write_all(&(*point as u64 + 1).to_le_bytes())?;
            }
        }
        Ok(())
    })?;
    io::write_atomically(folder.join("points3D.bin"), |sink| {
        sink.write_all(&(points.len() as u64).to_le_bytes())?;
        for (i, (point, places)) in points.iter().zip(&places).enumerate() {
            sink.write_all(&(i as u64 + 1).to_le_bytes())?;
            floats(sink, &point.position.to_array())?;
            sink.write_all(&point.colour.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8))?;
            floats(sink, &[point.error.unwrap_or(-1.0)])?;
            sink.write_all(&(places.len() as u64).to_le_bytes())?;
            for (image, place) in places {
                sink.write_all(&image.to_le_bytes())?;
                sink.write_all(&place.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

/// Id and parameters of a camera model.
struct Model {
    id: i32,
    parameters: Vec<f64>,
}

fn model(folder: &Path, lens: &Lens) -> Result<Model> {
    let k = &lens.intrinsics;
    let mut parameters = vec![k.fx, k.fy, k.cx, k.cy];
    let [k1, k2, k3, k4] = lens.distortion.radial;
    if k3 != 0.0 || k4 != 0.0 {
        let what = "a lens with k3 or k4 has no camera model of COLMAP's that is written; undistort \
                    the images first";
        return Err(Error::format(folder, what));
    }
    let name = match lens.distortion.is_none() {
        true => "PINHOLE",
        false => {
            parameters.extend([k1, k2].iter().chain(&lens.distortion.tangential));
            "OPENCV"
        }
    };
    let id = MODELS.iter().position(|model| *model == (name, parameters.len()));
    let id = id.ok_or_else(|| Error::format(folder, format!("there is no camera model {name}")))?;
    Ok(Model { id: id as i32, parameters })
}

fn check(
    folder: &Path,
    lenses: &[(u32, Lens)],
    images: &[Registered],
    points: &[TrackedPoint],
) -> Result<()> {
    let bad = |what: String| Err(Error::format(folder, what));
    for (id, lens) in lenses {
        if let Err(what) = lens.intrinsics.check() {
            return bad(format!("camera {id}: {what}"));
        }
    }
    for image in images {
        let name = excerpt(&image.name);
        if image.name.is_empty() || image.name.contains('\0') {
            return bad(format!("an image cannot be called {name}"));
        }
        if !lenses.iter().any(|(id, _)| *id == image.camera) {
            return bad(format!("image {name} names camera {}, which is absent", image.camera));
        }
        if let Err(what) = image.view_from_world.check() {
            return bad(format!("image {name}: {what}"));
        }
    }
    for (i, point) in points.iter().enumerate() {
        let seen = point.observations.iter();
        let finite = point.position.is_finite()
            && point.error.is_none_or(f64::is_finite)
            && seen.clone().all(|(_, pixel)| pixel.is_finite());
        if !finite {
            return bad(format!("point {i} is not finite: {point:?}"));
        }
        if let Some((image, _)) = seen.clone().find(|(image, _)| *image >= images.len()) {
            return bad(format!("point {i} was seen by image {image} of {}", images.len()));
        }
    }
    Ok(())
}

fn floats(sink: &mut dyn Write, values: &[f64]) -> std::io::Result<()> {
    values.iter().try_for_each(|value| sink.write_all(&value.to_le_bytes()))
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::super::read_model;
    use super::*;
    use crate::data::Distortion;
    use crate::types::{Intrinsics, Pose};

    fn lens(distortion: Distortion) -> Lens {
        let intrinsics =
            Intrinsics { fx: 300.5, fy: 299.0, cx: 161.0, cy: 88.25, width: 320, height: 180 };
        Lens { intrinsics, distortion }
    }

    fn images() -> Vec<Registered> {
        let image = |i: usize| Registered {
            name: format!("shot {i}.png"),
            camera: 7,
            view_from_world: Pose::new(
                DQuat::from_xyzw(0.1, -0.2, 0.3, 0.4 + i as f64).normalize(),
                DVec3::new(0.5, -1.25, i as f64),
            ),
        };
        (0..3).map(image).collect()
    }

    fn point(x: f64, observations: &[(usize, DVec2)]) -> TrackedPoint {
        TrackedPoint {
            position: DVec3::new(x, 0.5, 4.0),
            colour: [1.0, 0.2, 0.0],
            error: (!observations.is_empty()).then_some(0.25),
            observations: observations.to_vec(),
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let bent = Distortion { radial: [0.01, -0.002, 0.0, 0.0], tangential: [1e-4, 2e-4] };
        for lens in [lens(Distortion::default()), lens(bent)] {
            let seen = [(2, DVec2::new(3.5, 4.25)), (0, DVec2::new(9.0, 8.0))];
            let points = [point(-1.0, &seen), point(2.0, &seen[..1]), point(3.0, &[])];
            write_model(folder.path(), &[(7, lens)], &images(), &points).unwrap();
            let found = read_model(folder.path()).unwrap();
            assert_eq!(found.lenses[&7], lens);
            assert_eq!(found.images, images());
            assert_eq!((found.points.len(), found.left_out), (3, 0));
            assert_eq!(found.points[0].position, [-1.0, 0.5, 4.0]);
            assert_eq!(found.points[0].colour, [1.0, 51.0 / 255.0, 0.0]);
        }
    }

    #[test]
    fn points_and_images_name_each_other() {
        let folder = tempfile::tempdir().unwrap();
        let at = |x: f64| DVec2::new(x, 1.0);
        let points = [point(0.0, &[(2, at(5.0)), (1, at(6.0))]), point(1.0, &[(2, at(7.0))])];
        write_model(folder.path(), &[(7, lens(Distortion::default()))], &images(), &points)
            .unwrap();
        // Numbers of images and points begin with 1, indices in an image's list with 0.
        let bytes = std::fs::read(folder.path().join("points3D.bin")).unwrap();
        let tracks: Vec<u8> =
            [2u64.to_le_bytes().to_vec(), [3u32, 0, 2, 0].map(u32::to_le_bytes).concat()].concat();
        assert_eq!(bytes[8 + 8 + 24 + 3 + 8..][..24], tracks);
        assert_eq!(bytes[bytes.len() - 8..], [3u32, 1].map(u32::to_le_bytes).concat());
        let bytes = std::fs::read(folder.path().join("images.bin")).unwrap();
        let last = [7f64.to_le_bytes(), 1f64.to_le_bytes(), 2u64.to_le_bytes()].concat();
        assert_eq!(bytes[bytes.len() - 24..], last);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let pinhole = lens(Distortion::default());
        let message = |lens: Lens, images: &[Registered], points: &[TrackedPoint]| {
            write_model(folder.path(), &[(7, lens)], images, points).unwrap_err().to_string()
        };
        let mut other = images();
        other[1].camera = 8;
        assert!(message(pinhole, &other, &[]).contains("camera 8"));
        other[1].name = "a\0b".into();
        assert!(message(pinhole, &other, &[]).contains("cannot be called"));
        let far = point(0.0, &[(3, DVec2::ONE)]);
        assert!(message(pinhole, &images(), &[far]).contains("image 3 of 3"));
        assert!(message(pinhole, &images(), &[point(f64::NAN, &[])]).contains("not finite"));
        let odd = Distortion { radial: [0.0, 0.0, 0.1, 0.0], ..Distortion::default() };
        assert!(message(lens(odd), &images(), &[]).contains("k3"));
        assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none(), "nothing is left");
    }
}
