//! What the user already has of a clip: poses, masks, depth, flow, brought to the frames taken.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use splat4d::data::{
    Clip, exr, flo, images, intrinsics, read_mask, tracks, trajectory, transforms,
};
use splat4d::observe::SuppliedFlow;
use splat4d::types::{Image, Intrinsics, Pose, Tracks};
use splat4d::{Error, Result};

/// Things that are supplied for a clip's frames: a list in the order of the frames, with the names
/// that say which frame each belongs to, where they have names.
struct Listed<'a> {
    path: &'a Path,
    /// What they are, for messages.
    what: &'static str,
    count: usize,
    names: Vec<String>,
}

impl Listed<'_> {
    /// For each frame taken, the place of what belongs to it: by name, if every frame finds its own;
    /// else by number, if there is one for each frame of the whole clip; else one by one, if there
    /// is one for each frame taken and none of those was left out.
    fn pair(&self, clip: &Clip) -> Result<Vec<usize>> {
        let (count, taken) = (self.count, clip.frames.len());
        let by_name: HashMap<&str, usize> =
            self.names.iter().enumerate().map(|(i, name)| (name.as_str(), i)).collect();
        let named: HashSet<&str> = clip.frames.iter().map(|frame| frame.name.as_str()).collect();
        let unique = by_name.len() == count && named.len() == taken;
        if unique && clip.total.is_none_or(|total| count <= total) {
            let found = clip.frames.iter().map(|frame| by_name.get(frame.name.as_str()).copied());
            if let Some(pairs) = found.collect::<Option<Vec<_>>>() {
                return Ok(pairs);
            }
        }
        if clip.total == Some(count) {
            return Ok(clip.frames.iter().map(|frame| frame.number).collect());
        }
        if clip.skipped == 0 && count == taken {
            return Ok((0..count).collect());
        }
        let of_clip = clip.total.map_or(String::new(), |total| format!(" of the clip's {total}"));
        let of_shot = of_shot(clip);
        let skipped = match clip.skipped {
            0 => String::new(),
            n => format!(" and {n} left out as damaged"),
        };
        let one_each = match (clip.skipped, clip.total) {
            (0, Some(_)) => "one for each frame of the clip or one for each frame taken",
            (0, None) => "one for each frame taken",
            (_, Some(_)) => "one for each frame of the clip, the damaged ones among them",
            (_, None) => "frames of which none is missing",
        };
        let names = if self.names.is_empty() { "" } else { ", or files named as the frames are" };
        Err(Error::format(
            self.path,
            format!(
                "holds {count} {}, and {taken} frames{of_clip} are taken{of_shot}{skipped}; give \
                 {one_each}{names}",
                self.what
            ),
        ))
    }
}

/// Which shot of a clip with cuts the frames are of, in words.
fn of_shot(clip: &Clip) -> String {
    clip.shot.map_or(String::new(), |number| {
        let shot = clip.shots[number];
        format!(", those of shot {number} (frames {} to {})", shot.first, shot.last)
    })
}

/// Poses (`view_from_world`) of a TUM trajectory or a `transforms.json`, one for each frame taken.
pub fn poses(path: &Path, clip: &Clip) -> Result<Vec<Pose>> {
    let (poses, names): (Vec<Pose>, _) = if path.extension().is_some_and(|e| e == "json") {
        let cameras = transforms::read_cameras(path)?;
        let names = transforms::file_names(path)?;
        (
            cameras.iter().map(|c| c.camera.view_from_world).collect(),
            names.iter().map(|name| stem(Path::new(name))).collect(),
        )
    } else {
        let poses = trajectory::read(path, None)?;
        (poses.iter().map(|p| p.world_from_view.inverse()).collect(), Vec::new())
    };
    let listed = Listed { path, what: "poses", count: poses.len(), names };
    Ok(listed.pair(clip)?.into_iter().map(|i| poses[i]).collect())
}

/// A file's name without its extension. `a.b` alone has none that a picture could have.
fn stem(file: &Path) -> String {
    let name = if images::has_image_extension(file) { file.file_stem() } else { file.file_name() };
    name.unwrap_or_default().to_string_lossy().into_owned()
}

/// Intrinsics of a file, at the size of the frames.
pub fn intrinsics(path: &Path, clip: &Clip) -> Result<Intrinsics> {
    let given = intrinsics::read(path)?;
    let aspect = |width: u32, height: u32| f64::from(width) / f64::from(height);
    let ratio = aspect(given.width, given.height) / aspect(clip.width, clip.height);
    // A resized frame's sides are whole pixels.
    if (ratio - 1.0).abs() > 2.0 / f64::from(clip.width.min(clip.height)) {
        let (width, height) = clip.original;
        return Err(Error::format(
            path,
            format!(
                "is of {}×{} pixels, and the frames, {width}×{height}, have other proportions",
                given.width, given.height
            ),
        ));
    }
    Ok(given.resized(clip.width, clip.height))
}

/// Motion masks of a folder of images, one for each frame taken, at the size of the frames.
pub fn masks(folder: &Path, clip: &Clip) -> Result<Vec<Image>> {
    of_folder(folder, images::list(folder)?, clip, "masks", |file| read_mask(file))
}

/// Depth maps of a folder of EXR files, one for each frame taken, at the size of the frames.
pub fn depth(folder: &Path, clip: &Clip) -> Result<Vec<Image>> {
    of_folder(folder, files(folder, "exr")?, clip, "depth maps", |file| exr::read_depth(file))
}

/// Points followed through the clip, one place for each frame taken, at the size of the frames.
pub fn tracks(path: &Path, clip: &Clip) -> Result<Tracks> {
    let found = tracks::read(path)?;
    let listed =
        Listed { path, what: "places of each point", count: found.frames(), names: Vec::new() };
    let pairs = listed.pair(clip)?;
    let size = found.size.unwrap_or(clip.original);
    let mut taken = Tracks { size: Some(size), ..found }.resized((clip.width, clip.height));
    for point in &mut taken.points {
        point.pixels = pairs.iter().map(|i| point.pixels[*i]).collect();
        point.seen = pairs.iter().map(|i| point.seen[*i]).collect();
        let query = pairs.iter().position(|i| *i == point.query.0);
        let first = query.or_else(|| point.seen.iter().position(|seen| *seen)).unwrap_or(0);
        point.query = (first, point.pixels[first]);
    }
    Ok(taken)
}

/// Reads, of a folder's files, those of the frames taken.
fn of_folder(
    folder: &Path,
    files: Vec<PathBuf>,
    clip: &Clip,
    what: &'static str,
    read: impl Fn(&Path) -> Result<Image>,
) -> Result<Vec<Image>> {
    let names = files.iter().map(|f| f.file_stem().unwrap_or_default().to_string_lossy());
    let names = names.map(|name| name.into_owned()).collect();
    let listed = Listed { path: folder, what, count: files.len(), names };
    let read = |i: usize| Ok(nearest(&read(&files[i])?, clip.width, clip.height));
    listed.pair(clip)?.into_iter().map(read).collect()
}

/// Optical flow of a folder, as `synth` lays it out or as [`SuppliedFlow::open`] reads it, through
/// the frames taken.
pub fn flow(folder: &Path, clip: &Clip) -> Result<SuppliedFlow> {
    let taken = clip.frames.len();
    if clip.skipped > 0 {
        return Err(Error::format(
            folder,
            format!(
                "leads from each frame to the next, and {} frames are left out as damaged; leave \
                 out --flow, or mend the frames",
                clip.skipped
            ),
        ));
    }
    let both = ["flow_forward", "flow_backward"].map(|name| folder.join(name));
    let flow = if both.iter().all(|inner| inner.is_dir()) {
        let [forward, backward] = both.map(|inner| files(&inner, "flo"));
        let (forward, backward) = (forward?, backward?);
        if forward.len() != backward.len() {
            return Err(Error::format(
                folder,
                format!(
                    "holds {} forward and {} backward fields; give as many of each",
                    forward.len(),
                    backward.len()
                ),
            ));
        }
        let read = |files: &[PathBuf]| files.iter().map(flo::read).collect::<Result<Vec<_>>>();
        SuppliedFlow::new(read(&forward)?, read(&backward)?)?
    } else {
        SuppliedFlow::open(folder)?
    };
    let leads_through = flow.pairs() + 1;
    if leads_through == taken {
        return Ok(flow);
    }
    if Some(leads_through) == clip.total {
        return Ok(flow.from_frame(clip.frames[0].number));
    }
    Err(Error::format(
        folder,
        format!(
            "holds {} fields each way, and {taken} frames are taken{}; give one less than there are \
             frames",
            flow.pairs(),
            of_shot(clip)
        ),
    ))
}

/// The files with an extension, in the natural order of their names.
fn files(folder: &Path, extension: &str) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension)) {
            files.push(path);
        }
    }
    files.sort_by(|a, b| images::natural(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(files)
}

/// Another size without mixing values: depths on both sides of an edge have no meaningful mean.
fn nearest(image: &Image, width: u32, height: u32) -> Image {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let mut out = Image::new(width, height, image.channels);
    let place = |i: u32, new: u32, old: u32| {
        (((f64::from(i) + 0.5) * f64::from(old) / f64::from(new)) as u32).min(old - 1)
    };
    for y in 0..height {
        for x in 0..width {
            let from = (place(x, width, image.width), place(y, height, image.height));
            out.at_mut(x, y).copy_from_slice(image.at(from.0, from.1));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::data::{ClipFrame, Shot};

    /// A clip of so many frames, those of these numbers taken.
    fn clip(total: Option<usize>, numbers: &[usize], skipped: usize) -> Clip {
        let frame = |&number: &usize| ClipFrame {
            name: format!("f{number}"),
            number,
            time: 0.0,
            image: Image::new(1, 1, 3),
        };
        Clip {
            frames: numbers.iter().map(frame).collect(),
            total,
            skipped,
            shots: Vec::new(),
            shot: None,
            width: 1,
            height: 1,
            original: (1, 1),
            rate: None,
            focal: None,
            notes: Vec::new(),
        }
    }

    #[test]
    fn what_is_supplied_stays_with_its_frame() {
        let path = Path::new("poses.txt");
        let pair = |count: usize, names: &[&str], clip: &Clip| {
            let names = names.iter().map(|name| name.to_string()).collect();
            Listed { path, what: "poses", count, names }.pair(clip)
        };
        let all = clip(Some(4), &[0, 1, 2, 3], 0);
        assert_eq!(pair(4, &[], &all).unwrap(), [0, 1, 2, 3]);
        let third = clip(Some(10), &[0, 3, 6, 9], 0);
        assert_eq!(pair(4, &[], &third).unwrap(), [0, 1, 2, 3]);
        assert_eq!(pair(10, &[], &third).unwrap(), [0, 3, 6, 9]);
        for count in [0, 3, 5, 9, 11] {
            let message = pair(count, &[], &third).unwrap_err().to_string();
            let both = [format!("holds {count} poses"), "4 frames of the clip's 10".into()];
            assert!(both.iter().all(|part| message.contains(part)), "{message}");
        }
        // After a gap, only the whole clip's numbers are certain, or names.
        let gap = clip(Some(5), &[0, 1, 3, 4], 1);
        assert_eq!(pair(5, &[], &gap).unwrap(), [0, 1, 3, 4]);
        let message = pair(4, &[], &gap).unwrap_err().to_string();
        assert!(message.contains("4 poses") && message.contains("1 left out"), "{message}");
        assert_eq!(pair(4, &["f0", "f1", "f3", "f4"], &gap).unwrap(), [0, 1, 2, 3]);
        assert_eq!(pair(5, &["f4", "f3", "f2", "f1", "f0"], &gap).unwrap(), [4, 3, 1, 0]);
        assert_eq!(pair(5, &["a", "b", "c", "d", "e"], &gap).unwrap(), [0, 1, 3, 4]);
        assert!(pair(4, &["f0", "f0", "f3", "f4"], &gap).is_err());
        // More than the clip has, whatever they are called.
        assert!(pair(6, &["f0", "f1", "f2", "f3", "f4", "f5"], &gap).is_err());
        // Of a shot: by the whole clip's numbers, or one by one.
        let mut shot = clip(Some(9), &[5, 6, 7, 8], 0);
        (shot.shots, shot.shot) =
            (vec![Shot { first: 0, last: 4 }, Shot { first: 5, last: 8 }], Some(1));
        assert_eq!(pair(9, &[], &shot).unwrap(), [5, 6, 7, 8]);
        assert_eq!(pair(4, &[], &shot).unwrap(), [0, 1, 2, 3]);
        let message = pair(5, &[], &shot).unwrap_err().to_string();
        assert!(message.contains("are taken, those of shot 1 (frames 5 to 8)"), "{message}");
        let unknown = clip(None, &[0, 1, 3], 1);
        assert!(pair(4, &[], &unknown).is_err() && pair(3, &[], &unknown).is_err());
    }

    #[test]
    fn flow_of_the_whole_clip_serves_a_shot() {
        let folder = tempfile::tempdir().unwrap();
        for direction in ["forward", "backward"] {
            std::fs::create_dir(folder.path().join(direction)).unwrap();
            for i in 0..5u16 {
                let field =
                    Image { width: 1, height: 1, channels: 2, pixels: vec![f32::from(i); 2] };
                let file = folder.path().join(direction).join(format!("{i}.flo"));
                flo::write(file, &field).unwrap();
            }
        }
        let first = |clip: &Clip| {
            let mut flow = flow(folder.path(), clip)?;
            splat4d::observe::FlowSource::pair(&mut flow, 0)
        };
        for (total, numbers, value) in [
            (6, vec![3, 4, 5], Some(3.0)),
            (9, vec![3, 4, 5, 6, 7, 8], Some(0.0)),
            (9, vec![6, 7, 8], None),
        ] {
            let mut clip = clip(Some(total), &numbers, 0);
            clip.shots =
                vec![Shot { first: 0, last: 2 }, Shot { first: numbers[0], last: total - 1 }];
            clip.shot = Some(1);
            match (first(&clip), value) {
                (Ok(pair), Some(value)) => assert_eq!(pair.forward.pixels[0], value),
                (Err(error), None) => assert!(error.to_string().contains("shot 1"), "{error}"),
                (other, _) => panic!("{:?}", other.map(|pair| pair.forward)),
            }
        }
    }

    #[test]
    fn names_of_cameras() {
        for (file, name) in
            [("./train/r_0.png", "r_0"), ("r_0", "r_0"), ("a/frame_0.5", "frame_0.5")]
        {
            assert_eq!(stem(Path::new(file)), name);
        }
    }

    #[test]
    fn resizing_does_not_mix() {
        let image = Image { width: 2, height: 1, channels: 1, pixels: vec![1.0, 9.0] };
        assert_eq!(nearest(&image, 4, 2).pixels, [1.0, 1.0, 9.0, 9.0, 1.0, 1.0, 9.0, 9.0]);
        assert_eq!(nearest(&image, 1, 1).pixels.len(), 1);
    }
}
