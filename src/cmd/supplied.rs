//! User-supplied data of a clip (poses, masks, depth, flow), assigned to the selected frames.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use splat4d::data::layout::{self, Layout};
use splat4d::data::trajectory::{Format, QuaternionOrder};
use splat4d::data::{
    Clip, Dataset, cam, colmap, depth, flow, images, intrinsics, monst3r, read_mask, tracks,
    trajectory, transforms,
};
use splat4d::observe::SuppliedFlow;
use splat4d::types::{Image, Intrinsics, Pose, Tracks};
use splat4d::{Error, Result};

use super::common::say;

/// Items that are supplied for a clip's frames: a list in the order of the frames, with names that identify
/// the frames, if there are any.
struct Listed<'a> {
    path: &'a Path,
    /// Kind of the items, for messages.
    what: &'static str,
    count: usize,
    names: Vec<String>,
}

impl Listed<'_> {
    /// Index of the item for each selected frame: by name, if every frame has a match; else by number, if
    /// there is one for each frame of the whole clip; else in order, if there is one for each selected
    /// frame and none of those was skipped.
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
        let unnamed = clip.frames.iter().find(|frame| !by_name.contains_key(frame.name.as_str()));
        let names = match (self.names.is_empty(), unnamed) {
            (true, _) => String::new(),
            (false, None) => ", or files named as the frames are".to_owned(),
            (false, Some(frame)) => {
                format!(", or files named as the frames are (none is named {})", frame.name)
            }
        };
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

/// The shot of a clip with cuts that the frames belong to, in words.
fn of_shot(clip: &Clip) -> String {
    clip.shot.map_or(String::new(), |number| {
        let shot = clip.shots[number];
        format!(", those of shot {number} (frames {} to {})", shot.first, shot.last)
    })
}

/// The cameras of a file or folder for the selected frames.
pub struct Cameras {
    /// `view_from_world` of each frame.
    pub poses: Vec<Pose>,
    /// Common intrinsics of all frames at their size, if the file has them.
    pub intrinsics: Option<Intrinsics>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Cameras as listed, each with its intrinsics if present.
#[derive(Default)]
struct Found {
    poses: Vec<Pose>,
    names: Vec<String>,
    intrinsics: Vec<Intrinsics>,
    distorted: bool,
    notes: Vec<String>,
}

/// Reads cameras from a trajectory (TUM, KITTI, EuRoC), a `transforms.json`, or a folder: a COLMAP model,
/// Sintel's `.cam` files, MonST3R's output, a folder with a `transforms.json`, or a dataset with named
/// images.
pub fn cameras(path: &Path, clip: &Clip) -> Result<Cameras> {
    let Found { poses, names, intrinsics, distorted, mut notes } = find(path, clip)?;
    let listed = Listed { path, what: "poses", count: poses.len(), names };
    let pairs = listed.pair(clip)?;
    let told: Vec<Intrinsics> = pairs.iter().filter_map(|i| intrinsics.get(*i).copied()).collect();
    let place = path.display();
    if distorted {
        notes.push(format!(
            "the lens distortion of {place} is not used: what the clip shows of it is taken off the \
             frames"
        ));
    }
    let intrinsics = match told.first() {
        Some(first) if !told.iter().all(|k| same(k, first)) => {
            notes.push(format!(
                "the intrinsics of {place} differ from frame to frame and are not used; one camera for \
                 all frames is found instead"
            ));
            None
        }
        Some(first) if !fits(first, clip) => {
            notes.push(format!(
                "the intrinsics of {place} are of {}×{} pixels, of other proportions than the frames, \
                 and are not used",
                first.width, first.height
            ));
            None
        }
        Some(first) => Some(first.resized(clip.width, clip.height)),
        None => None,
    };
    Ok(Cameras { poses: pairs.into_iter().map(|i| poses[i]).collect(), intrinsics, notes })
}

fn find(path: &Path, clip: &Clip) -> Result<Found> {
    if !path.is_dir() {
        if path.extension().is_some_and(|e| e == "json") {
            return of_transforms(path);
        }
        let found = trajectory::open(path, None)?;
        let poses = found.poses().iter().map(|p| p.world_from_view.inverse()).collect();
        let mut notes = Vec::new();
        if found.format != Format::Euroc && found.order == Some(QuaternionOrder::Wxyz) {
            notes.push(format!("the quaternions of {} are read as (w, x, y, z)", path.display()));
        }
        return Ok(Found { poses, notes, ..Found::default() });
    }
    if monst3r::is_output(path) {
        let poses = monst3r::poses(path)?.iter().map(|p| p.world_from_view.inverse()).collect();
        let intrinsics = monst3r::intrinsics(path)?.unwrap_or_default();
        return Ok(Found { poses, intrinsics, ..Found::default() });
    }
    let cams = cam::list(path)?;
    if !cams.is_empty() {
        let (width, height) = clip.original;
        let mut found = Found::default();
        for file in &cams {
            let read = cam::read(file)?;
            found.poses.push(read.pose);
            found.names.push(stem_of(file));
            let k = read.intrinsics(width, height).map_err(|what| Error::format(file, what))?;
            found.intrinsics.push(k);
        }
        return Ok(found);
    }
    let transforms = path.join("transforms.json");
    if transforms.is_file() {
        return of_transforms(&transforms);
    }
    if let Some(model) = colmap::find(path) {
        return of_colmap(&model);
    }
    if let Ok(Layout::Nerfies(..) | Layout::PosesBounds(..) | Layout::Sintel(..)) =
        layout::find(path)
    {
        return of_dataset(path, clip);
    }
    Err(Error::format(
        path,
        "holds no cameras: neither a COLMAP model (cameras.bin or .txt, also in sparse/0) nor \
         transforms.json, .cam files, MonST3R's pred_traj.txt, scene.json with dataset.json (Nerfies), \
         poses_bounds.npy or a sequence of MPI Sintel",
    ))
}

/// A dataset's cameras of the clip's frames, matched by image names.
fn of_dataset(path: &Path, clip: &Clip) -> Result<Found> {
    let set = Dataset::open(path)?;
    let names: HashSet<&str> = clip.frames.iter().map(|frame| frame.name.as_str()).collect();
    let mut found = Found { notes: set.notes, ..Found::default() };
    for frame in &set.frames {
        let name = stem_of(&frame.path);
        if names.contains(name.as_str()) {
            found.poses.push(frame.camera.view_from_world);
            found.intrinsics.push(frame.camera.intrinsics);
            found.distorted |= !frame.distortion.is_none();
            found.names.push(name);
        }
    }
    Ok(found)
}

fn of_transforms(path: &Path) -> Result<Found> {
    let cameras = transforms::read_cameras(path)?;
    let names = transforms::file_names(path)?;
    Ok(Found {
        poses: cameras.iter().map(|c| c.camera.view_from_world).collect(),
        names: names.iter().map(|name| stem(Path::new(name))).collect(),
        intrinsics: cameras.iter().map(|c| c.camera.intrinsics).collect(),
        distorted: transforms::distortions(path)?.iter().any(|bend| !bend.is_none()),
        notes: Vec::new(),
    })
}

fn of_colmap(folder: &Path) -> Result<Found> {
    let colmap::Model { lenses, mut images, .. } = colmap::read_model(folder)?;
    images.sort_by(|a, b| images::natural(&a.name, &b.name));
    let mut found = Found::default();
    for image in images {
        let lens = lenses.get(&image.camera).ok_or_else(|| {
            let what = format!("image {} names a camera that is absent", image.name);
            Error::format(folder, what)
        })?;
        found.poses.push(image.view_from_world);
        found.names.push(stem(Path::new(&image.name)));
        found.intrinsics.push(lens.intrinsics);
        found.distorted |= !lens.distortion.is_none();
    }
    Ok(found)
}

/// Whether two cameras are the same up to the variation of separate estimates.
fn same(a: &Intrinsics, b: &Intrinsics) -> bool {
    let near = |a: f64, b: f64, of: f64| (a - b).abs() <= 1e-3 * of;
    let (w, h) = (f64::from(b.width), f64::from(b.height));
    (a.width, a.height) == (b.width, b.height)
        && near(a.fx, b.fx, b.fx)
        && near(a.fy, b.fy, b.fy)
        && near(a.cx, b.cx, w)
        && near(a.cy, b.cy, h)
}

/// Whether intrinsics are for an image of the frames' proportions, up to rounding of the sides.
fn fits(given: &Intrinsics, clip: &Clip) -> bool {
    let aspect = |width: u32, height: u32| f64::from(width) / f64::from(height);
    let ratio = aspect(given.width, given.height) / aspect(clip.width, clip.height);
    let least = clip.width.min(clip.height).min(given.width.min(given.height));
    (ratio - 1.0).abs() <= 2.0 / f64::from(least)
}

/// A file's name without its image extension; other extensions, as in `a.b`, are kept.
fn stem(file: &Path) -> String {
    let name = if images::has_image_extension(file) { file.file_stem() } else { file.file_name() };
    name.unwrap_or_default().to_string_lossy().into_owned()
}

/// A file's name without its extension, whatever that is.
fn stem_of(file: &Path) -> String {
    file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Reads intrinsics from a file and scales them to the size of the frames.
pub fn intrinsics(path: &Path, clip: &Clip) -> Result<Intrinsics> {
    let given = intrinsics::read(path)?;
    let bent = intrinsics::distorted_by(path)?;
    if !bent.is_empty() {
        say(&format!(
            "note: {} of {} are not used: what the clip shows of the lens's distortion is taken off the frames",
            bent.join(", "),
            path.display()
        ));
    }
    if !fits(&given, clip) {
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

/// Reads motion masks from a folder of images or MonST3R's folder, one for each selected frame, at the size
/// of the frames.
pub fn masks(folder: &Path, clip: &Clip) -> Result<Vec<Image>> {
    let files = match monst3r::is_output(folder) {
        true => monst3r::masks(folder)?,
        false => images::list(folder)?,
    };
    of_folder(folder, files, clip, "masks", |file| read_mask(file))
}

/// Reads depth maps from a folder, one for each selected frame, at the size of the frames; `read` reads one
/// file.
pub fn depth(
    folder: &Path,
    clip: &Clip,
    read: impl Fn(&Path) -> Result<Image>,
) -> Result<Vec<Image>> {
    let files = match monst3r::is_output(folder) {
        true => monst3r::depth(folder)?,
        false => first_of(folder, &depth::EXTENSIONS)?,
    };
    of_folder(folder, files, clip, "depth maps", read)
}

/// Reads point tracks with one position for each selected frame, at the size of the frames.
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

/// Reads the files of a folder that belong to the selected frames.
fn of_folder(
    folder: &Path,
    files: Vec<PathBuf>,
    clip: &Clip,
    what: &'static str,
    read: impl Fn(&Path) -> Result<Image>,
) -> Result<Vec<Image>> {
    let names = files.iter().map(|file| stem_of(file)).collect();
    let listed = Listed { path: folder, what, count: files.len(), names };
    let read = |i: usize| Ok(nearest(&read(&files[i])?, clip.width, clip.height));
    listed.pair(clip)?.into_iter().map(read).collect()
}

/// Reads optical flow through the selected frames from a folder, in the layout of `synth` or of
/// [`SuppliedFlow::open`].
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
        let [forward, backward] = both.map(|inner| first_of(&inner, &flow::EXTENSIONS));
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
        let read = |files: &[PathBuf]| files.iter().map(flow::read).collect::<Result<Vec<_>>>();
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

/// The files with the first of these extensions that occurs.
fn first_of(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>> {
    for extension in extensions {
        let found = files(folder, extension)?;
        if !found.is_empty() {
            return Ok(found);
        }
    }
    Ok(Vec::new())
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

/// Resizes by nearest neighbour: depths on both sides of an edge have no meaningful mean.
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
    use glam::{DQuat, DVec3};
    use splat4d::data::{ClipFrame, Shot};

    /// A clip with the given total, of which the frames with these numbers are selected.
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
        // After a gap, only numbers of the whole clip or names are reliable.
        let gap = clip(Some(5), &[0, 1, 3, 4], 1);
        assert_eq!(pair(5, &[], &gap).unwrap(), [0, 1, 3, 4]);
        let message = pair(4, &[], &gap).unwrap_err().to_string();
        assert!(message.contains("4 poses") && message.contains("1 left out"), "{message}");
        assert_eq!(pair(4, &["f0", "f1", "f3", "f4"], &gap).unwrap(), [0, 1, 2, 3]);
        assert_eq!(pair(5, &["f4", "f3", "f2", "f1", "f0"], &gap).unwrap(), [4, 3, 1, 0]);
        assert_eq!(pair(5, &["a", "b", "c", "d", "e"], &gap).unwrap(), [0, 1, 3, 4]);
        assert!(pair(4, &["f0", "f0", "f3", "f4"], &gap).is_err());
        // More items than the clip has frames, whatever their names.
        assert!(pair(6, &["f0", "f1", "f2", "f3", "f4", "f5"], &gap).is_err());
        // For a shot: by the whole clip's numbers, or in order.
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
                splat4d::data::flo::write(file, &field).unwrap();
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

    /// A clip of four frames of 64×48, half of their original size.
    fn four() -> Clip {
        let mut four = clip(Some(4), &[0, 1, 2, 3], 0);
        (four.width, four.height, four.original) = (64, 48, (128, 96));
        four
    }

    /// The camera of a frame, as written to each kind of file: at (n, 2, 0), rotated by half a turn about x.
    fn camera(n: usize) -> Pose {
        let turn = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
        Pose::new(turn, DVec3::new(n as f64, 2.0, 0.0)).inverse()
    }

    #[track_caller]
    fn found(path: &Path, focal: Option<f64>) -> Vec<String> {
        let Cameras { poses, intrinsics, notes } = cameras(path, &four()).unwrap();
        for (n, pose) in poses.iter().enumerate() {
            let off = pose.inverse() * camera(n);
            assert!(off.translation.length() < 1e-9, "{n}: {pose:?}");
            assert!(off.rotation.w.abs() > 1.0 - 1e-12, "{n}: {pose:?}");
        }
        assert_eq!(poses.len(), 4);
        assert_eq!(intrinsics.map(|k| k.fx), focal, "{notes:?}");
        assert!(intrinsics.is_none_or(|k| (k.width, k.height) == (64, 48)));
        notes
    }

    #[test]
    fn cameras_of_every_kind() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let write = |name: &str, text: String| std::fs::write(at(name), text).unwrap();
        let each = |line: &dyn Fn(usize) -> String| (0..4).map(line).collect::<String>();
        write("kitti.txt", each(&|n| format!("1 0 0 {n} 0 -1 0 2 0 0 -1 0\n")));
        found(&at("kitti.txt"), None);
        let euroc =
            |n| format!("{},{n},2,0,0,1,0,0,9,9,9\n", 1_403_636_579_763_555_584_u64 + n as u64);
        write("euroc.csv", each(&euroc));
        found(&at("euroc.csv"), None);

        // COLMAP: world to camera, by name, in any order, one more than there are frames.
        std::fs::create_dir_all(at("colmap/sparse/0")).unwrap();
        let lens = |model: &str| write("colmap/sparse/0/cameras.txt", format!("1 {model}\n"));
        lens("PINHOLE 128 96 100 100 64 48");
        let image = |n: usize| {
            let t = camera(n).translation;
            format!("{} 0 1 0 0 {} {} {} 1 left/f{n}.png\n\n", 9 - n, t.x, t.y, t.z)
        };
        let images = [3, 1, 0, 2].map(image).concat();
        write("colmap/sparse/0/images.txt", images.clone());
        assert!(found(&at("colmap"), Some(50.0)).is_empty());
        found(&at("colmap/sparse/0"), Some(50.0));
        lens("OPENCV 128 96 100 100 64 48 0.1 0 0 0");
        assert!(found(&at("colmap"), Some(50.0))[0].contains("distortion"));
        lens("PINHOLE 128 128 100 100 64 64");
        assert!(found(&at("colmap"), None)[0].contains("other proportions"));
        write("colmap/sparse/0/images.txt", images.replace("/f", "/g"));
        found(&at("colmap"), None);
        write("colmap/sparse/0/images.txt", [3, 1, 0].map(image).concat());
        let said = cameras(&at("colmap"), &four()).err().unwrap().to_string();
        assert!(said.contains("3 poses") && said.contains("none is named f2"), "{said}");

        // MonST3R, at half of the frames' original size.
        std::fs::create_dir(at("monst3r")).unwrap();
        write("monst3r/pred_traj.txt", each(&|n| format!("{n}.0 {n} 2 0 0 1 0 0\n")));
        found(&at("monst3r"), None);
        let matrix = |_| "60.0 0.0 32.0 0.0 60.0 24.0 0.0 0.0 1.0\n".to_owned();
        write("monst3r/pred_intrinsics.txt", each(&matrix));
        found(&at("monst3r"), Some(60.0));
        let lens = |n| format!("{} 0 32 0 60 24 0 0 1\n", 60 + n);
        write("monst3r/pred_intrinsics.txt", each(&lens));
        assert!(found(&at("monst3r"), None)[0].contains("differ"));
        write("monst3r/pred_intrinsics.txt", "60 0 32\n".into());
        let said = cameras(&at("monst3r"), &four()).err().unwrap().to_string();
        assert!(said.contains("pred_intrinsics.txt: line 1"), "{said}");
        for i in 0..4 {
            std::fs::write(at(&format!("monst3r/conf_{i}.npy")), "not read").unwrap();
            let mask = Image { pixels: vec![i as f32 % 2.0], ..Image::new(1, 1, 1) };
            let name = format!("monst3r/dynamic_mask_{i}.png");
            splat4d::data::write_mask(at(&name), &mask).unwrap();
            std::fs::copy(at(&name), at(&format!("monst3r/frame_{i:04}.png"))).unwrap();
        }
        let masks = masks(&at("monst3r"), &four()).unwrap();
        assert_eq!(masks.len(), 4);
        assert!(masks[1].pixels[0] == 1.0 && masks[1].width == 64 && masks[2].pixels[0] == 0.0);

        // Sintel.
        std::fs::create_dir(at("cams")).unwrap();
        for n in 0..4 {
            let t = camera(n).translation;
            let k = [100.0, 0.0, 63.5, 0.0, 100.0, 47.5, 0.0, 0.0, 1.0];
            let m = [1.0, 0.0, 0.0, t.x, 0.0, -1.0, 0.0, t.y, 0.0, 0.0, -1.0, t.z];
            let mut bytes = 202_021.25f32.to_le_bytes().to_vec();
            bytes.extend(k.iter().chain(&m).flat_map(|v: &f64| v.to_le_bytes()));
            std::fs::write(at(&format!("cams/frame_{:04}.cam", n + 1)), bytes).unwrap();
        }
        assert!(found(&at("cams"), Some(50.0)).is_empty());

        std::fs::create_dir(at("none")).unwrap();
        let said = cameras(&at("none"), &four()).err().unwrap().to_string();
        assert!(said.contains("COLMAP") && said.contains("pred_traj.txt"), "{said}");
    }
}
