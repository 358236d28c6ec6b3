//! Small valid inputs of every kind that the program reads.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use glam::{DQuat, DVec3};
use splat4d::check::fuzz::{draw, file};
use splat4d::data::intrinsics;
use splat4d::data::trajectory::{self, TimedPose};
use splat4d::data::transforms::{self, TimedCamera};
use splat4d::scene::ply;
use splat4d::types::{Camera, Gaussians, Intrinsics, Pose};

/// The kind of input at a path; an option takes one kind, and is tested with the others too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Images or a video, without cameras.
    Clip,
    /// Jobs of `batch`.
    List,
    /// Images with cameras.
    Dataset,
    /// A scene file or a PLY.
    Scene,
    /// Cameras: a trajectory or a `transforms.json`.
    Cameras,
    /// Intrinsics as JSON.
    Intrinsics,
    /// A folder of masks.
    Masks,
    /// A folder of depth maps.
    Depth,
    /// A folder of optical flow.
    Flow,
    /// Settings that `bench` writes.
    Settings,
    /// Results of `bench`.
    Measurements,
    /// A scene that `validate --fuzz` writes.
    Case,
    /// A clip's ground truth.
    Truth,
    /// Point tracks of a clip.
    Tracks,
    /// A folder of networks with models.toml.
    Models,
    /// A network for LPIPS.
    Lpips,
}

/// A valid input.
#[derive(Clone, Debug)]
pub struct Fixture {
    /// Its kind.
    pub kind: Kind,
    /// Its path relative to the fixtures' folder.
    pub path: PathBuf,
}

/// Jobs of `batch` on the clips beside it.
const LIST: &str = "[defaults]\nsize = 32\nsteps = 3\nmax-gaussians = 150\n\n\
    [[job]]\nname = \"a\"\ninput = \"clip/frames\"\nposes = \"clip/truth/poses.txt\"\n\
    refine = [\"poses\"]\n\n\
    [[job]]\nname = \"b\"\ninput = \"tripod/frames\"\ncontrol-points = 6\npinhole = true\n";

/// The networks of `models/all` and their files.
const NETWORKS: [(&str, &str); 7] = [
    ("depth", "coded_depth"),
    ("flow", "coded_flow"),
    ("mask_encoder", "coded_mask_encoder"),
    ("mask_decoder", "coded_mask_decoder"),
    ("pointmap_encoder", "coded_pointmap_encoder"),
    ("pointmap_decoder", "coded_pointmap_decoder"),
    ("features", "features"),
];

/// Every file with its size and modification time.
pub type State = Vec<(PathBuf, u64, Option<std::time::SystemTime>)>;

/// The fixtures' folder and what it holds.
pub struct Fixtures {
    /// The folder.
    pub root: PathBuf,
    /// Every input.
    pub all: Vec<Fixture>,
}

impl Fixtures {
    /// Writes all fixtures below `root` with the program and the crate's writers; fixtures of an earlier
    /// run are removed.
    ///
    /// # Errors
    /// The program fails on valid input, or a file cannot be written.
    pub fn write(program: &Path, root: &Path) -> Result<Fixtures, String> {
        if root.exists() {
            fs::remove_dir_all(root).map_err(|e| format!("{}: {e}", root.display()))?;
        }
        fs::create_dir_all(root).map_err(|e| format!("{}: {e}", root.display()))?;
        let run = |arguments: &str| run(program, root, arguments);
        run("synth rigid -o clip --frames 5 --size 40x24 --seed 3")?;
        run("synth still -o coded --coded --frames 4 --size 64x36 --seed 5")?;
        run("synth tripod -o tripod --frames 4 --size 40x24 --seed 4")?;
        run(
            "train clip/truth -o scene.safetensors --steps 4 --random-points 60 --sh-degree 1 --static",
        )?;
        run(
            "train clip/truth -o moving.safetensors --steps 4 --random-points 60 --control-points 6 \
             --sh-degree 0",
        )?;
        run("bench --quick --filter scan --report bench")?;
        let mut all = Vec::new();
        let mut add = |kind, path: &str| all.push(Fixture { kind, path: path.into() });
        add(Kind::Clip, "clip/frames");
        add(Kind::Clip, "tripod/frames");
        add(Kind::Clip, "coded/frames");
        add(Kind::Truth, "clip/truth");
        add(Kind::Dataset, "clip/truth");
        add(Kind::Dataset, "clip/truth/transforms.json");
        add(Kind::Cameras, "clip/truth/transforms.json");
        add(Kind::Cameras, "clip/truth/poses.txt");
        add(Kind::Masks, "clip/truth/masks");
        add(Kind::Depth, "clip/truth/depth");
        add(Kind::Flow, "clip/truth");
        add(Kind::Tracks, "clip/truth/tracks.npz");
        add(Kind::Scene, "scene.safetensors");
        add(Kind::Scene, "moving.safetensors");
        add(Kind::Measurements, "bench/bench.json");
        let written = || -> splat4d::Result<()> {
            ply::write(root.join("blobs.ply"), &blobs())?;
            let cameras = cameras();
            let names: Vec<String> = (0..cameras.len()).map(|i| format!("{i}.png")).collect();
            transforms::write(root.join("path.json"), &cameras, &names, None)?;
            let poses: Vec<TimedPose> = cameras
                .iter()
                .map(|c| TimedPose {
                    time: c.time,
                    world_from_view: c.camera.view_from_world.inverse(),
                })
                .collect();
            trajectory::write(root.join("trajectory.txt"), &poses)?;
            intrinsics::write(root.join("intrinsics.json"), &Intrinsics::centred(36.0, 40, 24))
        };
        written().map_err(|e| format!("a fixture cannot be written: {e}"))?;
        add(Kind::Scene, "blobs.ply");
        add(Kind::Cameras, "path.json");
        add(Kind::Cameras, "trajectory.txt");
        add(Kind::Intrinsics, "intrinsics.json");
        let text = |name: &str, text: &str| {
            fs::write(root.join(name), text).map_err(|e| format!("{name}: {e}"))
        };
        text("kitti.txt", &"1 0 0 0.5 0 1 0 0 0 0 1 0\n".repeat(5))?;
        add(Kind::Cameras, "kitti.txt");
        text("euroc.csv", &"1403636579763555584,0.5,0,0,1,0,0,0\n".repeat(5))?;
        add(Kind::Cameras, "euroc.csv");
        text("case.json", &file::text(&draw(3, 5)))?;
        add(Kind::Case, "case.json");
        text("settings.json", "{\"sh_degree\": 1, \"alpha_cut\": 0.01}\n")?;
        add(Kind::Settings, "settings.json");
        text("list.toml", LIST)?;
        add(Kind::List, "list.toml");
        colmap(root).map_err(|e| format!("the COLMAP model: {e}"))?;
        networks(root).map_err(|e| format!("the networks: {e}"))?;
        add(Kind::Models, "models/all");
        add(Kind::Models, "models/flow");
        add(Kind::Lpips, "models/lpips.onnx");
        add(Kind::Dataset, "colmap");
        add(Kind::Cameras, "colmap");
        if video(root) {
            add(Kind::Clip, "clip.mp4");
        }
        Ok(Fixtures { root: root.to_path_buf(), all })
    }

    /// The inputs of a kind.
    pub fn of(&self, kind: Kind) -> Vec<&Fixture> {
        self.all.iter().filter(|fixture| fixture.kind == kind).collect()
    }

    /// The current state of all files, to detect whether an input was changed.
    pub fn state(&self) -> State {
        let mut found = Vec::new();
        files(&self.root, &mut found);
        found.sort();
        found
            .into_iter()
            .map(|path| {
                let known = fs::symlink_metadata(&path);
                let length = known.as_ref().map_or(0, |m| m.len());
                (path, length, known.ok().and_then(|m| m.modified().ok()))
            })
            .collect()
    }
}

/// Every file below a folder, without following links.
pub fn files(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => files(&path, into),
            _ => into.push(path),
        }
    }
}

fn run(program: &Path, folder: &Path, arguments: &str) -> Result<(), String> {
    let output = Command::new(program)
        .current_dir(folder)
        .args(arguments.split_whitespace())
        .args(["--device", "software"])
        .stdin(Stdio::null())
        .output()
        .map_err(|e| format!("{} cannot be started: {e}", program.display()))?;
    // A row of the benchmark that exceeds its bound is not a failure here.
    if output.status.success() || arguments.starts_with("bench") {
        return Ok(());
    }
    Err(format!("`splat4d {arguments}` fails: {}", String::from_utf8_lossy(&output.stderr)))
}

fn blobs() -> Gaussians {
    let n = 9;
    Gaussians {
        positions: (0..n).map(|i| [(i % 3) as f32 - 1.0, (i / 3) as f32 - 1.0, 4.0]).collect(),
        log_scales: vec![[-1.5, -1.2, -1.0]; n],
        rotations: vec![[0.9, 0.1, 0.3, -0.2]; n],
        opacity_logits: vec![1.0; n],
        sh_degree: 0,
        sh: vec![[0.3, 0.7, -0.4]; n],
        motion_logits: Vec::new(),
    }
}

fn cameras() -> Vec<TimedCamera> {
    (0..5)
        .map(|i| TimedCamera {
            time: f64::from(i) / 4.0,
            camera: Camera {
                intrinsics: Intrinsics::centred(36.0, 40, 24),
                view_from_world: Pose::new(
                    DQuat::from_rotation_y(0.02 * f64::from(i)),
                    DVec3::new(-0.1 * f64::from(i), 0.0, 0.2),
                ),
            },
        })
        .collect()
}

/// Writes a COLMAP text model of the clip's images.
fn colmap(root: &Path) -> std::io::Result<()> {
    let folder = root.join("colmap");
    fs::create_dir_all(folder.join("sparse/0"))?;
    fs::create_dir_all(folder.join("images"))?;
    let mut images = String::from("# Image list\n");
    for i in 0..4 {
        let name = format!("{i}.png");
        let mut from: Vec<PathBuf> = Vec::new();
        files(&root.join("clip/frames"), &mut from);
        from.sort();
        fs::copy(&from[i], folder.join("images").join(&name))?;
        images += &format!("{} 1 0 0 0 {} 0 0 1 {name}\n1 2 -1 3 4 -1\n", i + 1, 0.1 * i as f64);
    }
    fs::write(folder.join("sparse/0/images.txt"), images)?;
    fs::write(folder.join("sparse/0/cameras.txt"), "1 PINHOLE 40 24 36 36 20 12\n")?;
    let points: String = (0..30)
        .map(|i| format!("{i} {} {} 4 200 100 50 0.5 1 2\n", i % 6 - 3, i / 6 - 2))
        .collect();
    fs::write(folder.join("sparse/0/points3D.txt"), points)
}

/// Writes folders of networks with exact outputs: one with all of them, and one with flow alone.
fn networks(root: &Path) -> std::io::Result<()> {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/models");
    let all: Vec<_> = NETWORKS.into_iter().collect();
    let flow = vec![("flow", "flow")];
    for (folder, networks) in [("models/all", all), ("models/flow", flow)] {
        let folder = root.join(folder);
        fs::create_dir_all(&folder)?;
        let mut list = String::new();
        for (name, file) in networks {
            let file = format!("{file}.onnx");
            fs::copy(models.join(&file), folder.join(&file))?;
            list += &format!("[{name}]\nfile = \"{file}\"\n");
        }
        fs::write(folder.join("models.toml"), list)?;
    }
    fs::copy(models.join("lpips.onnx"), root.join("models/lpips.onnx")).map(drop)
}

/// Writes the clip as a video, if ffmpeg is installed.
fn video(root: &Path) -> bool {
    let mut pattern = OsString::from(root.join("clip/frames"));
    pattern.push("/*.png");
    Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-y", "-framerate", "10", "-pattern_type", "glob", "-i"])
        .arg(pattern)
        .args(["-pix_fmt", "yuv420p"])
        .arg(root.join("clip.mp4"))
        .stdin(Stdio::null())
        .output()
        .is_ok_and(|output| output.status.success())
}
