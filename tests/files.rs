//! Clips (videos, folders of images) and their accompanying small files, intact and damaged.

mod support;

use std::fs;
use std::io::Write;
use std::path::Path;

use glam::{DQuat, DVec2, DVec3};
use splat4d::data::{
    Clip, ClipOptions, Distortion, Lens, Resize, Shot, ShotChoice, exif, exr, flo, images,
    intrinsics, read_mask, trajectory, video, write_mask, write_png,
};
use splat4d::eval::psnr;
use splat4d::io::write_atomically;
use splat4d::types::{Image, Intrinsics};
use splat4d::{Error, Result};
use support::{damage, message, picture, says, shared, some_camera};

#[test]
fn undistortion_undoes_the_lens() {
    // An image that is a smooth function of the viewing direction, seen through a lens with distortion.
    let k = Intrinsics { fx: 90.0, fy: 95.0, cx: 62.0, cy: 45.0, width: 120, height: 90 };
    let lens = Distortion { radial: [0.08, -0.03, 0.01, 0.0], tangential: [0.004, -0.003] };
    let colour = |d: DVec2| (0.5 + 0.4 * (6.0 * d.x).sin() * (5.0 * d.y).cos()) as f32;
    let mut bent = Image::new(120, 90, 1);
    let mut straight = bent.clone();
    for y in 0..90 {
        for x in 0..120 {
            let d = k.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).truncate();
            straight.at_mut(x, y)[0] = colour(d);
            // The direction that the lens projects to this pixel, by fixed-point iteration.
            let mut u = d;
            for _ in 0..60 {
                u += d - lens.distort(u);
            }
            assert!((lens.distort(u) - d).length() < 1e-10);
            bent.at_mut(x, y)[0] = colour(u);
        }
    }
    let camera = Lens { intrinsics: k, distortion: lens };
    let (found, valid) = camera.undistort(&bent, &k);
    let valid = valid.expect("k1 > 0 pushes corners out of the image");
    assert_eq!(valid.at(60, 45), [1.0]);
    assert_eq!(valid.at(0, 0), [0.0]);
    let mut worst = 0.0f32;
    for (i, _) in valid.pixels.iter().enumerate().filter(|(_, v)| **v == 1.0) {
        let (x, y) = (i as u32 % 120, i as u32 / 120);
        let d = k.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).truncate();
        let source = k.project(lens.distort(d).extend(1.0));
        // The outermost half pixel of the source repeats its edge.
        let inner = |v: f64, side: f64| v > 0.5 && v < side - 0.5;
        if inner(source.x, 120.0) && inner(source.y, 90.0) {
            worst = worst.max((found.pixels[i] - straight.pixels[i]).abs());
        }
    }
    // Bilinear sampling errs by h²/8 · |f''|, here (1/90)²/8 · 0.4 · (6² + 5²) ≈ 3.8e-4.
    assert!(worst < 5e-4, "{worst}");
    // Beyond the fold of a strong negative distortion polynomial there are no valid pixels.
    let fold = Distortion { radial: [-1.5, 0.0, 0.0, 0.0], tangential: [0.0; 2] };
    let (_, valid) = Lens { distortion: fold, ..camera }.undistort(&bent, &k);
    assert_eq!(valid.unwrap().at(119, 89), [0.0]);
}

// ---------------------------------------------------------------------------------------------
// Clips
// ---------------------------------------------------------------------------------------------

#[test]
fn clip_of_a_folder() {
    let root = tempfile::tempdir().unwrap();
    let options = ClipOptions::default();
    assert!(matches!(Clip::open(root.path().join("no"), &options), Err(Error::Io { .. })));
    says(&message(Clip::open(root.path(), &options)), &["holds no images"]);
    let frames = root.path().join("frames");
    write_png(frames.join("f10.png"), &picture(40, 30, 10)).unwrap();
    fs::write(frames.join("readme.txt"), "no image").unwrap();
    says(&message(Clip::open(root.path(), &options)), &["one frame only"]);
    says(&message(Clip::open(frames.join("f10.png"), &options)), &["one frame only"]);
    for i in [2, 9, 11] {
        write_png(frames.join(format!("f{i}.png")), &picture(40, 30, i)).unwrap();
    }
    let names = |clip: &Clip| clip.frames.iter().map(|f| f.name.clone()).collect::<Vec<_>>();
    let clip = Clip::open(root.path(), &options).unwrap();
    assert_eq!(names(&clip), ["f2", "f9", "f10", "f11"]);
    assert_eq!((clip.width, clip.height, clip.focal), (40, 30, None));
    assert_eq!(clip.frames[3].time, 1.0);
    let exact = psnr(&clip.frames[0].image, &picture(40, 30, 2)).unwrap();
    assert!(exact > 50.0, "{exact}");
    write_png(frames.join("f12.png"), &picture(40, 30, 12)).unwrap();
    let some = ClipOptions { every: 2, size: Resize::Width(20), ..options };
    let clip = Clip::open(&frames, &some).unwrap();
    assert_eq!((names(&clip).join(" "), clip.height), ("f2 f10 f12".into(), 15));
    assert_eq!(clip.frames.iter().map(|f| f.number).collect::<Vec<_>>(), [0, 2, 4]);
    assert_eq!((clip.total, clip.frames[1].time), (Some(5), 0.5));
    let wide = ClipOptions { size: Resize::Width(100), ..options };
    assert_eq!(Clip::open(&frames, &wide).unwrap().width, 40, "nothing is enlarged");
    let three = ClipOptions { max_frames: Some(3), ..options };
    assert_eq!(names(&Clip::open(&frames, &three).unwrap()), ["f2", "f9", "f10"]);
    assert!(Clip::open(&frames, &ClipOptions { max_frames: Some(2), ..options }).is_err());
    let far = ClipOptions { every: 4, ..options };
    says(&message(Clip::open(&frames, &far)), &["2 frames only", "3 frames at least"]);
    says(&message(Clip::open(&frames, &ClipOptions { every: 9, ..options })), &["one frame only"]);
    assert!(Clip::open(&frames, &ClipOptions { every: 0, ..options }).is_err());

    fs::write(frames.join("f3.png"), b"\x89PNG\r\n\x1a\nbroken").unwrap();
    says(&message(Clip::open(&frames, &options)), &["f3.png", "skip_bad"]);
    let clip = Clip::open(&frames, &ClipOptions { skip_bad: true, ..options }).unwrap();
    assert_eq!(clip.frames.len(), 5);
    assert_eq!(clip.frames.iter().map(|f| f.number).collect::<Vec<_>>(), [0, 2, 3, 4, 5]);
    assert_eq!((clip.total, clip.skipped, clip.frames[1].time), (Some(6), 1, 0.4));
    says(&clip.notes[0], &["skipped 1 of 6", "f3.png"]);

    write_png(frames.join("f3.png"), &picture(40, 31, 3)).unwrap();
    says(&message(Clip::open(&frames, &options)), &["f3.png", "40×31", "f2.png", "40×30"]);
}

/// A frame that is not a complete image is an error that names it, or is left out with a note.
#[test]
fn bad_frames_of_a_folder_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for i in [1, 2, 4, 5] {
        write_png(at(&format!("{i}.png")), &picture(40, 30, i)).unwrap();
    }
    let options = ClipOptions::default();
    let skip = ClipOptions { skip_bad: true, ..options };
    let refused = |name: &str| {
        says(&message(Clip::open(folder.path(), &options)), &[name, "skip_bad"]);
        let clip = Clip::open(folder.path(), &skip).unwrap();
        assert_eq!(clip.frames.iter().map(|f| f.number).collect::<Vec<_>>(), [0, 1, 3, 4]);
        says(&clip.notes[0], &["skipped 1 of 5", name]);
    };
    // A truncated file of every supported image format.
    let whole = picture(40, 30, 3);
    let bytes = whole.pixels.iter().map(|v| (v * 255.0) as u8).collect();
    let whole = ::image::RgbImage::from_raw(40, 30, bytes).unwrap();
    for name in ["3.jpg", "3.bmp", "3.tif", "3.webp", "3.png"] {
        whole.save(at(name)).unwrap();
        assert_eq!(Clip::open(folder.path(), &options).unwrap().frames.len(), 5, "{name}");
        let bytes = fs::read(at(name)).unwrap();
        for part in [1, 2, 9] {
            fs::write(at(name), &bytes[..bytes.len() * part / 10]).unwrap();
            refused(name);
        }
        fs::remove_file(at(name)).unwrap();
    }
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("nowhere", at("3.png")).unwrap();
        refused("3.png");
        fs::remove_file(at("3.png")).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(at("3.png")).status().unwrap().success());
        refused("3.png");
        fs::remove_file(at("3.png")).unwrap();
        let pipe = at("pipe.mp4");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        says(&message(Clip::open(&pipe, &options)), &["pipe.mp4", "neither a file nor a folder"]);
        says(&message(Clip::open("/dev/zero", &options)), &["neither a file nor a folder"]);
    }
}

fn has_ffmpeg() -> bool {
    let found = std::process::Command::new("ffmpeg").arg("-version").output().is_ok();
    if !found {
        eprintln!("SKIPPED (no ffmpeg): decoding a video");
    }
    found
}

/// Makes a video with ffmpeg; `arguments` come between its input and its output.
fn video_of(path: &Path, source: &str, arguments: &str) {
    let made = std::process::Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", source])
        .args(arguments.split_whitespace())
        .arg(path)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

const MOVING: &str = "testsrc2=s=160x90:r=12:d=4";

/// A video with damaged or missing frames is an error, or its intact frames are used, with their frame
/// numbers.
#[test]
fn damaged_videos_are_told() {
    if !has_ffmpeg() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let options = ClipOptions::default();
    let skip = ClipOptions { skip_bad: true, ..options };
    let h264 = "-c:v libx264 -g 12 -bf 2 -threads 1 -flags +bitexact";
    for (name, arguments) in [
        ("a.mp4", format!("{h264} -movflags +faststart")),
        ("b.mkv", h264.to_string()),
        ("c.avi", "-c:v mjpeg -threads 1".to_string()),
    ] {
        let path = folder.path().join(name);
        video_of(&path, MOVING, &arguments);
        let whole = Clip::open(&path, &options).unwrap();
        assert_eq!(
            (whole.frames.len(), whole.total, whole.notes.len()),
            (48, Some(48), 0),
            "{name}"
        );
        let bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;

        // Bits are flipped in the middle.
        let mut bad = bytes.clone();
        bad[middle..middle + 40].iter_mut().for_each(|b| *b ^= 0x55);
        fs::write(&path, &bad).unwrap();
        let said = message(Clip::open(&path, &options));
        says(&said, &[name, "of 48 frames are damaged or lost", "skip_bad"]);
        let clip = Clip::open(&path, &skip).unwrap();
        assert!(clip.skipped > 0 && clip.frames.len() + clip.skipped == 48, "{name}");
        says(&clip.notes[0], &["of 48 frames are damaged", "left out"]);
        for frame in &clip.frames {
            assert!(frame.image == whole.frames[frame.number].image, "{name}: {}", frame.name);
        }
        // Frames that the damage does not affect are read without an error.
        let few = ClipOptions { max_frames: Some(4), ..options };
        assert_eq!(Clip::open(&path, &few).unwrap().frames.len(), 4, "{name}");

        // The end is missing.
        fs::write(&path, &bytes[..middle]).unwrap();
        says(&message(Clip::open(&path, &options)), &[name, "damaged", "skip_bad"]);
        let clip = Clip::open(&path, &skip).unwrap();
        assert!((10..40).contains(&clip.frames.len()) && clip.total != Some(clip.frames.len()));
        assert!(!clip.notes.is_empty());
        for frame in &clip.frames {
            assert!(frame.image == whole.frames[frame.number].image, "{name}: {}", frame.name);
        }

        // A hole: frames in the middle are missing.
        let mut bad = bytes.clone();
        bad[middle..middle * 6 / 5].fill(0);
        fs::write(&path, &bad).unwrap();
        says(&message(Clip::open(&path, &options)), &[name, "damaged", "skip_bad"]);
        assert!(Clip::open(&path, &skip).unwrap().frames.len() < 48);
    }
}

/// From a video with cuts one shot is used, with the frame numbers of the video; the same holds for a
/// folder.
#[test]
fn a_clip_with_cuts_has_shots() {
    if !has_ffmpeg() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mp4");
    let cut = "testsrc2=s=160x90:r=10:d=0.8[a];mandelbrot=s=160x90:r=10:start_scale=0.3,\
               trim=end_frame=12[b];[a][b]concat=n=2:v=1";
    video_of(&path, cut, "-c:v ffv1 -f matroska");
    let frames = folder.path().join("frames");
    fs::create_dir(&frames).unwrap();
    let written = std::process::Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(&path)
        .args(["-start_number", "0"])
        .arg(frames.join("%05d.png"))
        .status();
    assert!(written.unwrap().success());
    let shots = vec![Shot { first: 0, last: 7 }, Shot { first: 8, last: 19 }];
    let options = ClipOptions::default();
    for clip in [&path, &frames] {
        let open = |shot, every, max_frames| {
            Clip::open(clip, &ClipOptions { shot, every, max_frames, ..options })
        };
        let numbers = |clip: &Clip| clip.frames.iter().map(|f| f.number).collect::<Vec<_>>();
        let longest = open(ShotChoice::Longest, 1, None).unwrap();
        assert_eq!(longest.shots, shots);
        assert_eq!((longest.shot, longest.total), (Some(1), Some(20)));
        assert_eq!(numbers(&longest), (8..20).collect::<Vec<_>>());
        assert_eq!((longest.frames[0].name.as_str(), longest.frames[11].time), ("00008", 1.0));
        says(
            &longest.notes[0],
            &["2 shots", "frames 8 to 19", "shot 1", "longest", "by its number"],
        );
        let whole = open(ShotChoice::Whole, 1, None).unwrap();
        assert_eq!((whole.frames.len(), whole.shot, whole.shots.len()), (20, None, 2));
        for frame in &longest.frames {
            assert!(frame.image == whole.frames[frame.number].image, "{}", frame.name);
        }
        let first = open(ShotChoice::Number(0), 1, None).unwrap();
        assert_eq!((numbers(&first), first.shot), ((0..8).collect(), Some(0)));
        let few = open(ShotChoice::Number(1), 3, Some(3)).unwrap();
        assert_eq!(numbers(&few), [8, 11, 14]);
        let none = message(open(ShotChoice::Number(2), 1, None));
        says(&none, &["no shot 2", "0 (frames 0 to 7", "1 (frames 8 to 19"]);
        let too_few = message(open(ShotChoice::Number(0), 4, None));
        says(&too_few, &["2 frames only"]);
    }
    // A video also gives times.
    says(&Clip::open(&path, &options).unwrap().notes[0], &["8 to 19, 0.80 to 2.00 s"]);
}

/// Intact videos of the usual kinds are read without notes.
#[test]
fn whole_videos_are_read() {
    if !has_ffmpeg() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let h264 = "-c:v libx264 -g 12 -bf 2";
    for (name, source, arguments) in [
        ("vfr.mp4", MOVING, format!("-vf select=not(eq(mod(n\\,5)\\,3)) -vsync vfr {h264}")),
        ("odd.mkv", "testsrc2=s=161x91:r=12:d=4", "-c:v ffv1".to_string()),
        ("turned.mov", MOVING, format!("{h264} -metadata:s:v rotate=90")),
        (
            "fields.mp4",
            "testsrc2=s=160x96:r=12:d=4",
            format!("{h264} -flags +ilme+ildct -x264-params tff=1"),
        ),
        ("vp8.webm", MOVING, "-c:v libvpx -b:v 300k -auto-alt-ref 1".to_string()),
        ("vp9.webm", MOVING, "-c:v libvpx-vp9 -b:v 300k -deadline realtime".to_string()),
        ("mpeg4.avi", MOVING, "-c:v mpeg4 -bf 2".to_string()),
        ("stream.ts", MOVING, h264.to_string()),
        ("still.gif", MOVING, String::new()),
    ] {
        let path = folder.path().join(name);
        video_of(&path, source, &arguments);
        let clip = Clip::open(&path, &ClipOptions::default()).unwrap();
        let count = if name == "vfr.mp4" { 39 } else { 48 };
        assert_eq!((clip.frames.len(), clip.notes.len()), (count, 0), "{name}");
        let third = ClipOptions { every: 3, ..ClipOptions::default() };
        assert_eq!(Clip::open(&path, &third).unwrap().total, Some(count), "{name}");
    }
    // Audio is ignored, even if it is damaged; so are frames that an edit list hides.
    let sound = folder.path().join("sound.mkv");
    let made = "-f lavfi -i sine=d=4 -c:v libx264 -g 12 -c:a ac3";
    video_of(&sound, MOVING, made);
    assert_eq!(Clip::open(&sound, &ClipOptions::default()).unwrap().frames.len(), 48);
    let cut = folder.path().join("cut.mp4");
    let made = std::process::Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-ss", "1.5", "-i"])
        .arg(&sound)
        .args(["-an", "-c", "copy"])
        .arg(&cut)
        .status();
    assert!(made.unwrap().success());
    let clip = Clip::open(&cut, &ClipOptions::default()).unwrap();
    assert!((28..=36).contains(&clip.frames.len()) && clip.notes.is_empty());
}

/// Reading stops promptly when the caller asks for it.
#[test]
fn reading_a_video_can_be_stopped() {
    if !has_ffmpeg() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    video_of(&path, MOVING, "-c:v libx264");
    let stop = || Err(Error::Interrupted { checkpoint: None });
    for clip in [path.as_path(), folder.path()] {
        for i in 0..3 {
            write_png(folder.path().join(format!("{i}.png")), &picture(40, 30, i)).unwrap();
        }
        let stopped = Clip::open_while(clip, &ClipOptions::default(), &stop);
        assert!(matches!(stopped, Err(Error::Interrupted { .. })));
    }
}

#[test]
fn clip_of_a_video() {
    let Some(path) = shared("cotracker_videos/apple.mp4") else { return };
    let options = ClipOptions { every: 10, size: Resize::Width(324), ..ClipOptions::default() };
    let none = std::ffi::OsStr::new("no-such-program");
    let text = message(video::decode_with(none, none, &path, &options, &|| Ok(())));
    says(&text, &["apple.mp4", "ffmpeg", "apt-get install ffmpeg", "extract the frames"]);
    // A program that exists but cannot be run is not reported as missing.
    #[cfg(unix)]
    {
        let folder = tempfile::tempdir().unwrap();
        let locked = folder.path().join("locked");
        fs::write(&locked, "").unwrap();
        let text =
            message(video::decode_with(locked.as_os_str(), none, &path, &options, &|| Ok(())));
        says(&text, &["apple.mp4", "locked", "cannot be started", "denied"]);
    }
    if !has_ffmpeg() {
        return;
    }
    let clip = Clip::open(&path, &options).unwrap();
    assert_eq!((clip.frames.len(), clip.width, clip.height), (5, 324, 180));
    assert_eq!(clip.frames[4].number, 40);
    assert_eq!(clip.frames[1].name, "00010");
    assert!(clip.rate.is_some_and(|rate| rate > 0.5 && rate < 10.0), "{:?}", clip.rate);
    assert!(clip.frames.iter().all(|f| f.image.pixels.iter().any(|&v| v > 0.3)));
    let three = ClipOptions { max_frames: Some(3), ..options };
    assert_eq!(Clip::open(&path, &three).unwrap().frames.len(), 3);
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken.mp4");
    fs::write(&broken, b"no video").unwrap();
    says(&message(Clip::open(&broken, &options)), &["broken.mp4", "ffmpeg cannot read"]);
    // An ffmpeg before version 5.1, which does not have -fps_mode.
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let old = folder.path().join("ffmpeg");
        let script = "#!/bin/sh\ncase \"$*\" in *fps_mode*) \
            echo \"Unrecognized option 'fps_mode'.\" >&2; echo 'Option not found' >&2; exit 1;; esac\n\
            exec ffmpeg \"$@\"\n";
        fs::write(&old, script).unwrap();
        fs::set_permissions(&old, fs::Permissions::from_mode(0o755)).unwrap();
        let decoded = video::decode_with(old.as_os_str(), none, &path, &three, &|| Ok(())).unwrap();
        assert_eq!((decoded.frames.len(), decoded.rate), (3, None));
    }
}

#[test]
fn exif_focal_length() {
    use ::exif::experimental::Writer;
    use ::exif::{Field, In, Rational, Tag, Value};
    let folder = tempfile::tempdir().unwrap();
    let with = |name: &str, fields: &[Field]| {
        let mut jpeg = std::io::Cursor::new(Vec::new());
        let grey = ::image::RgbImage::new(400, 300);
        grey.write_to(&mut jpeg, ::image::ImageFormat::Jpeg).unwrap();
        let mut tiff = std::io::Cursor::new(Vec::new());
        let mut writer = Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        writer.write(&mut tiff, false).unwrap();
        let (jpeg, tiff) = (jpeg.into_inner(), tiff.into_inner());
        let mut file = jpeg[..2].to_vec();
        file.extend([0xff, 0xe1]);
        file.extend((tiff.len() as u16 + 8).to_be_bytes());
        file.extend(b"Exif\0\0");
        file.extend(tiff);
        file.extend(&jpeg[2..]);
        let path = folder.path().join(name);
        fs::write(&path, file).unwrap();
        path
    };
    let field = |tag, value| Field { tag, ifd_num: In::PRIMARY, value };
    let ratio = |num, denom| Value::Rational(vec![Rational { num, denom }]);
    let film = with("film.jpg", &[field(Tag::FocalLengthIn35mmFilm, Value::Short(vec![26]))]);
    // The diagonal is 500 pixels in the image and 43.27 mm on 35 mm film.
    let focal = exif::focal(&film, 400, 300).unwrap();
    assert!((focal - 26.0 / 43.2666 * 500.0).abs() < 0.01, "{focal}");
    let sensor = with(
        "sensor.jpg",
        &[
            field(Tag::FocalLength, ratio(50, 10)),
            field(Tag::FocalPlaneXResolution, ratio(5080, 1)),
            field(Tag::FocalPlaneResolutionUnit, Value::Short(vec![2])),
            field(Tag::PixelXDimension, Value::Long(vec![800])),
        ],
    );
    // 5 mm at 200 pixels per millimetre, for an image twice as wide.
    assert_eq!(exif::focal(&sensor, 400, 300), Some(500.0));
    let zero = with("zero.jpg", &[field(Tag::FocalLength, ratio(1, 0))]);
    assert_eq!(exif::focal(&zero, 400, 300), None);
    assert_eq!(exif::focal(&folder.path().join("absent.jpg"), 400, 300), None);

    fs::remove_file(sensor).unwrap();
    fs::remove_file(&zero).unwrap();
    for other in ["second.jpg", "third.jpg"] {
        fs::copy(&film, folder.path().join(other)).unwrap();
    }
    let half = ClipOptions { size: Resize::Width(200), ..ClipOptions::default() };
    let clip = Clip::open(folder.path(), &half).unwrap();
    assert!((clip.focal.unwrap() - focal / 2.0).abs() < 1e-9);

    // A portrait photo: EXIF has its orientation, and the clip applies it.
    let turned = tempfile::tempdir().unwrap();
    for name in ["1.jpg", "2.jpg", "3.jpg"] {
        let path = with(name, &[field(Tag::Orientation, Value::Short(vec![6]))]);
        fs::rename(&path, turned.path().join(name)).unwrap();
    }
    let clip = Clip::open(turned.path(), &ClipOptions::default()).unwrap();
    assert_eq!((clip.width, clip.height), (300, 400));
}

// ---------------------------------------------------------------------------------------------
// Small files
// ---------------------------------------------------------------------------------------------

#[test]
fn natural_order() {
    let mut names = ["b1", "a10", "a2", "a02", "a", "a2b", "a1x2"];
    names.sort_by(|a, b| images::natural(a, b));
    assert_eq!(names, ["a", "a1x2", "a02", "a2", "a2b", "a10", "b1"]);
}

#[test]
fn sizes() {
    assert_eq!(Resize::Longest(100).target(400, 300), (100, 75));
    assert_eq!(Resize::Longest(500).target(400, 300), (400, 300));
    assert_eq!(Resize::Width(200).target(400, 301), (200, 151));
    assert_eq!(Resize::Width(800).target(400, 301), (400, 301));
    assert_eq!(Resize::Width(1).target(4000, 3), (1, 1));
    assert_eq!(Resize::Width(100_000).target(400, 301), (400, 301), "images only shrink");
    assert_eq!(Resize::To(0, 7).target(4, 3), (1, 7));
    // Halving preserves means: each result is an average, so a constant image stays constant.
    let mut flat = Image::new(64, 48, 3);
    flat.pixels.fill(0.37);
    let half = images::resize(&flat, 32, 24);
    assert!(half.pixels.iter().all(|v| (v - 0.37).abs() < 1e-5));
}

#[test]
fn alpha_lies_over_the_background() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let pixels = vec![1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.2];
    write_png(&path, &Image { width: 3, height: 1, channels: 4, pixels }).unwrap();
    let image = images::decode_rgb(&path, [0.0, 0.5, 1.0], images::Orientation::Stored).unwrap();
    assert_eq!(image.at(0, 0), [1.0, 0.0, 0.0]);
    assert_eq!(image.at(1, 0), [0.0, 0.5, 1.0]);
    let third = image.at(2, 0);
    assert!(third.iter().zip([0.0, 0.6, 0.8]).all(|(a, b)| (a - b).abs() < 1e-6), "{third:?}");
}

#[test]
fn png_and_masks() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let values = [0.0, 1.0, 0.5, -3.0, 7.0, f32::NAN];
    let image = Image { width: 2, height: 1, channels: 3, pixels: values.to_vec() };
    write_png(&path, &image).unwrap();
    let back = images::decode_rgb(&path, [0.0; 3], images::Orientation::Stored).unwrap();
    assert_eq!(back.pixels, [0.0, 1.0, 128.0 / 255.0, 0.0, 1.0, 0.0]);
    let mask = Image { width: 3, height: 1, channels: 1, pixels: vec![1.0, 0.0, 0.7] };
    write_mask(&path, &mask).unwrap();
    assert_eq!(read_mask(&path).unwrap().pixels, [1.0, 0.0, 1.0]);
    assert!(write_png(&path, &Image::new(2, 2, 2)).is_err());
    let Some(path) = shared("davis16_camel/Annotations/480p/camel/00000.png") else { return };
    let mask = read_mask(path).unwrap();
    let share = mask.pixels.iter().sum::<f32>() / mask.pixels.len() as f32;
    assert!((mask.width, mask.height) == (854, 480) && (0.05..0.5).contains(&share), "{share}");
}

#[test]
fn trajectories() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("poses.txt");
    let poses: Vec<_> = (0..4)
        .map(|i| trajectory::TimedPose {
            time: 1.0 / 3.0 + f64::from(i),
            world_from_view: some_camera(i).view_from_world,
        })
        .collect();
    trajectory::write(&path, &poses).unwrap();
    for (a, b) in trajectory::read(&path, None).unwrap().iter().zip(&poses) {
        assert_eq!(
            (a.time, a.world_from_view.translation),
            (b.time, b.world_from_view.translation)
        );
        assert!(a.world_from_view.rotation.dot(b.world_from_view.rotation) > 1.0 - 1e-14);
    }
    let read = |text: &str, order| {
        fs::write(&path, text).unwrap();
        trajectory::read(&path, order)
    };
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let turn_z = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
    let second = |r: Result<Vec<trajectory::TimedPose>>| r.unwrap()[1].world_from_view.rotation;
    // The order (w, x, y, z) is recognised by the identity at the start, by a comment, or given by the
    // caller.
    let text = format!("0 0 0 0 1 0 0 0\n1 0 0 0 {half} 0 0 {half}\n");
    assert!(second(read(&text, None)).dot(turn_z) > 1.0 - 1e-12);
    let text = format!("# t x y z qw qx qy qz\n0 0 0 0 0 1 0 0\n1,0,0,0,{half},0,0,{half}\n");
    assert!(second(read(&text, None)).dot(turn_z) > 1.0 - 1e-12);
    let text = format!("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 {half} {half}\n");
    assert!(second(read(&text, None)).dot(turn_z) > 1.0 - 1e-12);
    let order = Some(trajectory::QuaternionOrder::Wxyz);
    assert!(second(read(&text, order)).dot(turn_z) < 0.9);
    // Files with seven columns, and KITTI's twelve.
    let seven = read("1 2 3 0 0 0 1\n4 5 6 0 0 0 1\n", None).unwrap();
    assert_eq!((seven[1].time, seven[1].world_from_view.translation.y), (1.0, 5.0));
    let kitti = read("0 -1 0 7 1 0 0 8 0 0 1 9\n", None).unwrap();
    assert!(kitti[0].world_from_view.rotation.dot(turn_z) > 1.0 - 1e-12);
    assert_eq!(kitti[0].world_from_view.translation, DVec3::new(7.0, 8.0, 9.0));
    for bad in [
        "",
        "# only words\n",
        "1 2 3\n",
        "0 0 0 0 0 0 0 x\n",
        "0 0 0 0 0 0 0 0\n",
        "0 0 0 nan 0 0 0 1\n",
        "0 0 0 0 0 0 0 1\n1 2\n",
    ] {
        says(&message(read(bad, None)), &["poses.txt"]);
    }
    let Some(real) = shared("evo_traj/freiburg1_xyz-groundtruth.txt") else { return };
    let real = trajectory::read(real, None).unwrap();
    assert!(real.len() > 1000 && real.windows(2).all(|w| w[0].time < w[1].time));
}

#[test]
fn flow_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.flo");
    let mut flow = Image::new(5, 3, 2);
    flow.pixels.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32 * 0.7 - 3.0);
    flo::write(&path, &flow).unwrap();
    assert_eq!(flo::read(&path).unwrap(), flow);
    assert!(flo::write(&path, &Image::new(5, 3, 3)).is_err());
    let original = fs::read(&path).unwrap();
    assert_eq!(&original[..4], b"PIEH");
    damage(&original, &path, true, |path| flo::read(path).is_ok());
}

#[test]
fn exr_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let mut depth = Image::new(7, 5, 1);
    depth.pixels.iter_mut().enumerate().for_each(|(i, v)| *v = 0.1 + i as f32 * 1e3);
    depth.pixels[3] = f32::INFINITY;
    exr::write_depth(&path, &depth).unwrap();
    assert_eq!(exr::read_depth(&path).unwrap(), depth);
    says(&message(exr::read_rgba(&path)), &["no channels R, G, B", "Z"]);
    let mut colour = Image::new(6, 4, 4);
    colour.pixels.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32 * 0.01 - 0.2);
    exr::write_rgba(&path, &colour).unwrap();
    assert_eq!(exr::read_rgba(&path).unwrap(), colour);
    assert!(exr::write_depth(&path, &colour).is_err());
    fs::write(&path, b"no exr").unwrap();
    says(&message(exr::read_depth(&path)), &["a.exr", "not a readable EXR"]);
    exr::write_depth(&path, &depth).unwrap();
    let original = fs::read(&path).unwrap();
    damage(&original, &path, true, |path| exr::read_depth(path).is_ok());
}

#[test]
fn intrinsics_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("k.json");
    let k = some_camera(0).intrinsics;
    intrinsics::write(&path, &k).unwrap();
    assert_eq!(intrinsics::read(&path).unwrap(), k);
    fs::write(&path, r#"{"focal": 50, "w": 40, "h": 30}"#).unwrap();
    assert_eq!(intrinsics::read(&path).unwrap(), Intrinsics::centred(50.0, 40, 30));
    for (text, part) in [
        (r#"{"w": 40, "h": 30}"#, "`fx` is missing"),
        (r#"{"fx": 0, "w": 40, "h": 30}"#, "`fx` = 0"),
        (r#"{"fx": "x", "w": 40, "h": 30}"#, "`fx` is not a number"),
        (r#"{"fx": 5, "w": 40}"#, "`height` is missing"),
        ("[1]", "`fx` is missing"),
    ] {
        fs::write(&path, text).unwrap();
        says(&message(intrinsics::read(&path)), &["k.json", part]);
    }
}

#[test]
fn writing_leaves_nothing_half_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("new/folder/a.txt");
    write_atomically(&path, |sink| sink.write_all(b"old")).unwrap();
    let failed = write_atomically(&path, |sink| {
        sink.write_all(&[b'x'; 1 << 20])?;
        Err(std::io::Error::from(std::io::ErrorKind::StorageFull))
    });
    says(&message(failed), &["a.txt"]);
    assert_eq!(fs::read(&path).unwrap(), b"old");
    assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    says(&message(write_atomically(folder.path(), |_| Ok(()))), &["is a folder"]);
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::fs::PermissionsExt;
        let usual = folder.path().join("usual");
        fs::write(&usual, "").unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&path), mode(&usual));
        // A full disk is an error, and a device is not replaced by a file.
        use std::os::unix::fs::FileTypeExt;
        let full = write_atomically("/dev/full", |sink| sink.write_all(b"x"));
        says(&message(full), &["/dev/full", "No space left"]);
        assert!(fs::metadata("/dev/full").unwrap().file_type().is_char_device());
    }
}
