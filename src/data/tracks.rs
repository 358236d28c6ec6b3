//! Point tracks as `.npz`: each point's position in every frame, and its visibility.
//!
//! The format written is TAPIR's: `tracks` (points × frames × 2, x and y), `visibles` (points × frames) and
//! `query_points` (points × 3: frame, y, x), in pixels with the corner of the image at 0, and `size`
//! (width, height), to which they refer. Also read are `occluded` in place of `visibles`; CoTracker's
//! `pred_tracks` ([batch ×] frames × points × 2) and `pred_visibility`, whose pixel centres are at
//! integers; and an entry of TAP-Vid: `points` (points × frames × 2, as shares of width and height),
//! `occluded`, `video` (frames × height × width × 3). TAP-Vid stores its entries in one pickle, which can
//! execute arbitrary code and is not read; NumPy converts each to such an archive: `np.savez(name,
//! **pickle.load(file)[name])`.
//!
//! Source: data/README.md of google-deepmind/tapnet.

use std::io::{Cursor, Write};
use std::path::Path;

use glam::DVec2;
use npyz::WriterBuilder;
use zip::write::{SimpleFileOptions, ZipWriter};

use super::images;
use super::npy::{self, Array};
use crate::io;
use crate::types::{PointPath, Tracks, range};
use crate::{Error, Result};

/// First byte of a pickle.
const PICKLE: u8 = 0x80;

/// Reads point tracks.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file that is not an `.npz`, lacks an array, or has arrays with
/// inconsistent shapes.
pub fn read(path: impl AsRef<Path>) -> Result<Tracks> {
    let path = path.as_ref();
    let bytes = io::read(path)?;
    if bytes.first() == Some(&PICKLE) {
        let what = "is a pickle, which can run any program and is not read; write each of its entries as \
                    an .npz where you trust it: np.savez(name, **pickle.load(open(file, 'rb'))[name])";
        return Err(Error::format(path, what));
    }
    let mut archive = Archive { path, entries: npy::open(path, &bytes)?, bytes: bytes.len() };
    let Positions { array: tracks, centre, size: of_video } = archive.positions()?;
    let [points, frames, 2] = tracks.shape[..] else {
        let what = format!("its tracks are of shape {:?}, not points × frames × 2", tracks.shape);
        return Err(Error::format(path, what));
    };
    let fits = |array: Option<&Array>, shape: [usize; 2], name: &str| match array {
        Some(array) if array.shape != shape => Err(Error::format(
            path,
            format!("its {name} are of shape {:?}, its tracks ask for {shape:?}", array.shape),
        )),
        _ => Ok(()),
    };
    let seen = archive.visibilities()?;
    fits(seen.as_ref(), [points, frames], "visibilities")?;
    let queries = archive.array("query_points")?;
    fits(queries.as_ref(), [points, 3], "query points")?;
    let size = archive.size()?.or(of_video);
    let point = |i: usize| {
        let at = |frame: usize| {
            let k = 2 * (i * frames + frame);
            DVec2::new(tracks.values[k], tracks.values[k + 1]) + centre
        };
        let pixels: Vec<DVec2> = (0..frames).map(at).collect();
        let seen: Vec<bool> = (0..frames)
            .map(|frame| {
                let said = seen.as_ref().is_none_or(|seen| seen.values[i * frames + frame] > 0.5);
                said && pixels[frame].is_finite()
            })
            .collect();
        let query = match &queries {
            Some(queries) => {
                let [frame, y, x] = [0, 1, 2].map(|k| queries.values[3 * i + k]);
                if !(frame >= 0.0 && (frame as usize) < frames && x.is_finite() && y.is_finite()) {
                    let what = format!("query point {i} (frame {frame:?}) is outside of the clip");
                    return Err(Error::format(path, what));
                }
                (frame as usize, DVec2::new(x, y) + centre)
            }
            None => {
                let first = seen.iter().position(|seen| *seen).unwrap_or(0);
                (first, pixels.get(first).copied().unwrap_or_default())
            }
        };
        Ok(PointPath { query, pixels, seen })
    };
    Ok(Tracks { size, points: (0..points).map(point).collect::<Result<_>>()? })
}

/// An `.npz` file.
struct Archive<'a> {
    path: &'a Path,
    entries: npy::Archive<'a>,
    /// The file's size.
    bytes: usize,
}

/// Positions of points: points × frames × 2, pixels of an image of `size`, if it is known.
struct Positions {
    array: Array,
    /// What is to be added so that a pixel's centre is at a half.
    centre: f64,
    size: Option<(u32, u32)>,
}

impl Archive<'_> {
    fn array(&mut self, name: &str) -> Result<Option<Array>> {
        npy::entry(self.path, &mut self.entries, self.bytes, name)
    }

    fn positions(&mut self) -> Result<Positions> {
        if let Some(array) = self.array("tracks")? {
            return Ok(Positions { array, centre: 0.0, size: None });
        }
        if let Some(tracks) = self.array("pred_tracks")? {
            return Ok(Positions {
                array: swapped(self.path, tracks, 2)?,
                centre: 0.5,
                size: None,
            });
        }
        if let Some(mut array) = self.array("points")? {
            let shape = npy::shape(self.path, &mut self.entries, "video")?;
            let (width, height) = video_size(self.path, shape)?;
            let sides = [f64::from(width), f64::from(height)];
            array.values.iter_mut().zip(sides.iter().cycle()).for_each(|(v, side)| *v *= side);
            return Ok(Positions { array, centre: 0.0, size: Some((width, height)) });
        }
        let what =
            "holds neither `tracks` (points × frames × 2) nor `pred_tracks` nor TAP-Vid's `points`";
        Err(Error::format(self.path, what))
    }

    /// Per point and frame: above 0.5 where the point is visible.
    fn visibilities(&mut self) -> Result<Option<Array>> {
        if let Some(visibles) = self.array("visibles")? {
            return Ok(Some(visibles));
        }
        if let Some(occluded) = self.array("occluded")? {
            let values = occluded.values.iter().map(|o| 1.0 - o).collect();
            return Ok(Some(Array { values, ..occluded }));
        }
        let visibility = self.array("pred_visibility")?;
        visibility.map(|visibility| swapped(self.path, visibility, 0)).transpose()
    }

    /// Width and height of the images that the positions refer to.
    fn size(&mut self) -> Result<Option<(u32, u32)>> {
        let Some(size) = self.array("size")? else { return Ok(None) };
        let side = |k: usize| size.values.get(k).map(|v| *v as u32);
        let known = side(0)
            .zip(side(1))
            .filter(|(w, h)| range::SIDE.contains(w) && range::SIDE.contains(h));
        let refused =
            || Error::format(self.path, format!("a size of {:?} makes no sense", size.values));
        known.ok_or_else(refused).map(Some)
    }
}

/// Width and height of TAP-Vid's frames, from the shape of its array `video`.
fn video_size(path: &Path, shape: Option<Vec<usize>>) -> Result<(u32, u32)> {
    let size = match shape.as_deref() {
        Some(&[_, height, width, 3]) => images::sides(width, height),
        _ => None,
    };
    size.ok_or_else(|| {
        let what = "holds `points`, which are shares of an image's sides, and no `video` (frames × height × \
                    width × 3) that tells the sides";
        Error::format(path, what)
    })
}

/// Transposes [batch ×] frames × points × … to points × frames × …, with `each` values per entry (0: one
/// value without an axis).
fn swapped(path: &Path, array: Array, each: usize) -> Result<Array> {
    let Array { mut shape, values } = array;
    let axes = if each == 0 { 2 } else { 3 };
    if shape.len() == axes + 1 && shape[0] == 1 {
        shape.remove(0);
    }
    if shape.len() != axes || (axes == 3 && shape[2] != each) {
        let what = format!("its predictions are of shape {shape:?}; one clip's was expected");
        return Err(Error::format(path, what));
    }
    let (frames, points, each) = (shape[0], shape[1], each.max(1));
    let mut out = Vec::with_capacity(values.len());
    for point in 0..points {
        for frame in 0..frames {
            let from = (frame * points + point) * each;
            out.extend_from_slice(&values[from..from + each]);
        }
    }
    shape.swap(0, 1);
    Ok(Array { shape, values: out })
}

/// Writes point tracks, by rename.
///
/// # Errors
/// [`Error::Io`]; [`Error::Shape`] where points differ in the number of their frames.
pub fn write(path: impl AsRef<Path>, tracks: &Tracks) -> Result<()> {
    let path = path.as_ref();
    let (points, frames) = (tracks.points.len(), tracks.frames());
    let odd = |point: &&PointPath| point.pixels.len() != frames || point.seen.len() != frames;
    if let Some(odd) = tracks.points.iter().find(odd) {
        return Err(Error::Shape {
            op: "tracks::write",
            arg: "points",
            expected: format!("{frames} frames for each"),
            actual: odd.pixels.len().min(odd.seen.len()),
        });
    }
    let each = || tracks.points.iter();
    let pixels: Vec<f32> =
        each().flat_map(|p| p.pixels.iter().flat_map(|at| at.as_vec2().to_array())).collect();
    let seen: Vec<bool> = each().flat_map(|p| p.seen.iter().copied()).collect();
    let queries: Vec<f32> =
        each().flat_map(|p| [p.query.0 as f32, p.query.1.y as f32, p.query.1.x as f32]).collect();
    let (n, t) = (points as u64, frames as u64);
    let mut bytes = ZipWriter::new(Cursor::new(Vec::new()));
    let filled = (|| {
        entry(&mut bytes, "tracks", &[n, t, 2], pixels)?;
        entry(&mut bytes, "visibles", &[n, t], seen)?;
        entry(&mut bytes, "query_points", &[n, 3], queries)?;
        if let Some((width, height)) = tracks.size {
            entry(&mut bytes, "size", &[2], vec![i64::from(width), i64::from(height)])?;
        }
        bytes.finish().map_err(std::io::Error::from)
    })();
    let bytes = filled.map_err(Error::io(path))?.into_inner();
    io::write_atomically(path, |sink| sink.write_all(&bytes))
}

fn entry<T: npyz::AutoSerialize>(
    archive: &mut ZipWriter<Cursor<Vec<u8>>>,
    name: &str,
    shape: &[u64],
    values: Vec<T>,
) -> std::io::Result<()> {
    // A fixed time makes the file's bytes reproducible.
    let options = SimpleFileOptions::default().last_modified_time(zip::DateTime::default());
    archive.start_file(format!("{name}.npy"), options)?;
    let options = npyz::WriteOptions::new().default_dtype();
    let mut writer = options.shape(shape).writer(archive).begin_nd()?;
    writer.extend(values)?;
    writer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tracks() -> Tracks {
        let point = |i: usize| PointPath {
            query: (i, DVec2::new(i as f64 + 0.25, 2.5)),
            pixels: (0..4).map(|t| DVec2::new((t + i) as f64 + 0.25, 2.5 - t as f64)).collect(),
            seen: (0..4).map(|t| t != i).collect(),
        };
        Tracks { size: Some((64, 48)), points: (0..3).map(point).collect() }
    }

    fn file(fill: impl FnOnce(&mut ZipWriter<Cursor<Vec<u8>>>)) -> tempfile::NamedTempFile {
        let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
        fill(&mut archive);
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), archive.finish().unwrap().into_inner()).unwrap();
        file
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tracks.npz");
        write(&path, &tracks()).unwrap();
        assert_eq!(read(&path).unwrap(), tracks());
        let first = std::fs::read(&path).unwrap();
        write(&path, &tracks()).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), first);
        let half = tracks().resized((32, 24));
        assert_eq!(half.points[1].pixels[2], tracks().points[1].pixels[2] * 0.5);
        write(&path, &Tracks::default()).unwrap();
        assert_eq!(read(&path).unwrap(), Tracks::default());
    }

    #[test]
    fn what_cotracker_gives_is_read() {
        let truth = tracks();
        let file = file(|archive| {
            let at = |frame: usize, point: usize| truth.points[point].pixels[frame] - 0.5;
            let order = || (0..4).flat_map(|frame| (0..3).map(move |point| (frame, point)));
            let pixels = order().flat_map(|(f, p)| at(f, p).as_vec2().to_array()).collect();
            let seen = order().map(|(f, p)| truth.points[p].seen[f]).collect();
            entry::<f32>(archive, "pred_tracks", &[1, 4, 3, 2], pixels).unwrap();
            entry::<bool>(archive, "pred_visibility", &[1, 4, 3], seen).unwrap();
        });
        let found = read(file.path()).unwrap();
        assert_eq!(found.size, None);
        for (found, truth) in found.points.iter().zip(&truth.points) {
            assert_eq!((&found.pixels, &found.seen), (&truth.pixels, &truth.seen));
            // The first frame in which the point is visible.
            assert!(found.seen[found.query.0] && !found.seen[..found.query.0].contains(&true));
        }
    }

    #[test]
    fn what_does_not_fit_is_told() {
        let told = |file: &tempfile::NamedTempFile, what: &str| {
            let error = read(file.path()).unwrap_err().to_string();
            assert!(error.contains(what), "{error}");
        };
        told(&file(|_| ()), "neither `tracks`");
        let flat = |archive: &mut ZipWriter<_>| entry(archive, "tracks", &[4], vec![0.0f32; 4]);
        told(&file(|archive| flat(archive).unwrap()), "of shape [4]");
        let with = |name: &str, shape: &[u64], count: usize| {
            file(|archive| {
                entry(archive, "tracks", &[2, 3, 2], vec![0.0f32; 12]).unwrap();
                entry(archive, name, shape, vec![1.0f64; count]).unwrap();
            })
        };
        told(&with("visibles", &[3, 2], 6), "its visibilities are of shape [3, 2]");
        told(&with("query_points", &[2, 2], 4), "its query points are of shape [2, 2]");
        told(&with("size", &[1], 1), "a size of [1.0]");
        let mut far = vec![0.0f32; 6];
        far[3] = 3.0;
        let far = file(|archive| {
            entry(archive, "tracks", &[2, 3, 2], vec![0.0f32; 12]).unwrap();
            entry(archive, "query_points", &[2, 3], far).unwrap();
        });
        told(&far, "query point 1 (frame 3.0) is outside of the clip");
        let long = file(|archive| {
            archive.start_file("tracks.npy", SimpleFileOptions::default()).unwrap();
            archive.write_all(b"\x93NUMPY\x02\x00\xff\xff\xff\xff").unwrap();
        });
        told(&long, "a header of a length that makes no sense");
        let none = tempfile::NamedTempFile::new().unwrap();
        told(&none, "is no .npz");
        assert!(
            write(
                "/none",
                &Tracks {
                    size: None,
                    points: vec![
                        PointPath {
                            pixels: vec![DVec2::ZERO],
                            seen: vec![true],
                            ..PointPath::default()
                        },
                        PointPath::default(),
                    ],
                }
            )
            .is_err()
        );
    }
}
