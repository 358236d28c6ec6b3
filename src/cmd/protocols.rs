//! The protocols of published tables: the scenes in a folder, the commands for each, and the metrics in
//! their answers.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::Value;
use splat4d::data::layout::{self, Layout};
use splat4d::data::{images, poses_bounds, sintel};
use splat4d::report::{Better, Figure, PublishedRow};
use splat4d::{Error, Result};

use super::staged::{Cameras, Source, Staged};
use super::{eval_first, published};

/// A published table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Protocol {
    /// NVIDIA Dynamic Scenes, 12 frames, frame t from camera t, poses unknown; test: camera 0 at the other
    /// times. DIR is a scene, or a folder of scenes: each with its frames (images, images_2, input_images
    /// or similar) and a folder of images v000_t001.png, … (gt)
    Nvidia,
    /// D-NeRF, poses given, its own test split. DIR is a scene with transforms_train.json, or a folder of
    /// such scenes
    Dnerf,
    /// HyperNeRF's scenes with a validation rig, poses unknown: trained on the training images of the
    /// dataset's split, tested on the others. DIR is a scene with scene.json, dataset.json and camera, or a
    /// folder of such scenes
    HypernerfVrig,
    /// DyCheck's iPhone captures, poses unknown, evaluated on pixels that training images also saw. DIR as
    /// for HyperNeRF
    Dycheck,
    /// DyNeRF (Neural 3D Video), poses unknown: trained on the video of one static camera, tested on other
    /// cameras. DIR is a scene with poses_bounds.npy and cam00.mp4, … or cam00/images, …, or a folder of
    /// such scenes
    DynerfMono,
    /// MPI Sintel, cameras of 14 sequences of the final pass. DIR contains final and camdata_left, or is
    /// the folder above (training)
    SintelPose,
}

/// Choices that a protocol leaves open.
pub struct Choices {
    /// Maximum length of the longer side of the images.
    pub size: Option<u32>,
    /// Whether test images are also evaluated from poses fitted to them.
    pub fit_poses: bool,
    /// Training and test cameras of a set of static cameras.
    pub cameras: Cameras,
    /// Options of `eval` for LPIPS.
    pub lpips: Vec<OsString>,
    /// Further options of the command that reconstructs the scene.
    pub making: Vec<OsString>,
}

/// Processing of one scene: commands in order, whose outputs are in `folder`.
pub struct Work {
    pub scene: String,
    pub folder: PathBuf,
    /// The dataset that is first laid out as a clip with ground truth.
    pub staged: Option<Source>,
    pub steps: Vec<Step>,
}

/// A command; its answer is stored under its name.
pub struct Step {
    pub name: &'static str,
    pub arguments: Vec<OsString>,
}

impl Protocol {
    /// Title of the table.
    pub fn title(self) -> &'static str {
        match self {
            Protocol::Nvidia => "NVIDIA Dynamic Scenes, 12 frames, poses unknown",
            Protocol::Dnerf => "D-NeRF, poses given",
            Protocol::HypernerfVrig => "HyperNeRF, validation rig, poses unknown",
            Protocol::Dycheck => "DyCheck, iPhone captures, poses unknown",
            Protocol::DynerfMono => "DyNeRF, one camera, poses unknown",
            Protocol::SintelPose => "MPI Sintel, camera poses",
        }
    }

    /// The protocol in words, with the choices, for a number of scenes.
    pub fn caption(self, choices: &Choices, scenes: usize) -> Vec<String> {
        let size = match choices.size {
            Some(size) => format!("Images have {size} pixels on their longer side."),
            None => "Images are of the size that the quality preset or the set gives.".into(),
        };
        let rule = match self {
            Protocol::Nvidia => {
                "Trained on the frames of a moving camera; tested with what the first camera sees at \
                 the other times, from that frame's own pose and focal length, nothing aligned or \
                 fitted. PSNR, SSIM and MS-SSIM are means over the test images, of 8 bits."
            }
            Protocol::Dnerf => {
                "Trained on the train split with the given poses; tested on the test split. PSNR, SSIM \
                 and MS-SSIM are means over the test images, unrounded."
            }
            Protocol::HypernerfVrig | Protocol::Dycheck => {
                "Trained on the training images without their poses; tested with the set's test \
                 images, from its cameras brought to the scene by a similarity: rotation from the \
                 training cameras' orientations, scale and translation from their centres. PSNR, SSIM and \
                 MS-SSIM are means over the test images, of 8 bits."
            }
            Protocol::DynerfMono => {
                "Trained on one camera's video without its pose; tested with what other cameras saw at \
                 the same times, from their calibrated places beside it. A camera that stands still does not \
                 tell the scale: that one number is fitted to test images of each scene, nothing else. \
                 PSNR, SSIM and MS-SSIM are means over the test images, of 8 bits."
            }
            Protocol::SintelPose => {
                "Intrinsics and poses unknown, all frames of the final pass. ATE: root mean square of \
                 the centres' distances after a similarity, in the set's unit. RPE: of all pairs of \
                 neighbouring frames after the same similarity; rotations in degrees."
            }
        };
        let mut lines = vec![rule.to_owned(), size];
        if self == Protocol::SintelPose && scenes < sintel::SEQUENCES.len() {
            lines.push(format!(
                "{scenes} of the {} sequences that published means are over.",
                sintel::SEQUENCES.len()
            ));
        }
        if self == Protocol::HypernerfVrig {
            lines.push(
                "Published means are over broom2, vrig-3dprinter, vrig-chicken and vrig-peel-banana, at \
                 960×540 as their papers say."
                    .into(),
            );
        }
        if self == Protocol::DynerfMono {
            let Cameras { train, test } = &choices.cameras;
            let test: Vec<&str> = test.iter().map(String::as_str).collect();
            lines.push(format!("Trained on {train}, tested with {}.", test.join(", ")));
            lines.push(
                "Published figures do not say which cameras, scenes and size they are of.".into(),
            );
        }
        if self == Protocol::Dycheck {
            lines.push(
                "The columns `covisible` are of the pixels that training images saw as well, as the \
                 set's masks say."
                    .into(),
            );
        }
        if choices.fit_poses {
            lines.push(
                "The columns `fitted` are of test poses that were fitted to the test images."
                    .into(),
            );
        }
        if !choices.making.is_empty() {
            let options: Vec<String> =
                choices.making.iter().map(|word| word.to_string_lossy().into_owned()).collect();
            lines.push(format!("Made with {}.", options.join(" ")));
        }
        lines
    }

    /// The columns of the table.
    pub fn figures(self, choices: &Choices) -> Vec<Figure> {
        let of = |key: &str, title: &str, better| Figure {
            key: key.into(),
            title: title.into(),
            better,
        };
        if self == Protocol::SintelPose {
            return vec![
                of("ate", "ATE", Better::Less),
                of("rpe_trans", "RPE trans", Better::Less),
                of("rpe_rot", "RPE rot, °", Better::Less),
                of("pose_minutes", "poses, min", Better::Less),
            ];
        }
        let mut figures = vec![
            of("psnr", "PSNR, dB", Better::More),
            of("ssim", "SSIM", Better::More),
            of("ms_ssim", "MS-SSIM", Better::More),
        ];
        if self == Protocol::Dycheck {
            figures.push(of("covisible_psnr", "PSNR covisible, dB", Better::More));
            figures.push(of("covisible_ssim", "SSIM covisible", Better::More));
        }
        if !choices.lpips.is_empty() {
            figures.push(of("lpips", "LPIPS", Better::Less));
        }
        if choices.fit_poses {
            figures.push(of("fitted_psnr", "PSNR fitted, dB", Better::More));
            figures.push(of("fitted_ssim", "SSIM fitted", Better::More));
        }
        if self == Protocol::Dnerf {
            figures.push(of("train_minutes", "training, min", Better::Less));
        } else {
            figures.extend([
                of("pose_minutes", "poses, min", Better::Less),
                of("train_minutes", "training, min", Better::Less),
                of("minutes", "both, min", Better::Less),
            ]);
        }
        figures.extend([of("fps", "frames/s", Better::More), of("storage_mb", "MB", Better::Less)]);
        figures
    }

    /// Published results.
    pub fn published(self) -> Vec<PublishedRow> {
        published::rows(match self {
            Protocol::Nvidia => published::NVIDIA,
            Protocol::Dnerf => published::DNERF,
            Protocol::HypernerfVrig => published::HYPERNERF,
            // No results were found for the same protocol, without given poses.
            Protocol::Dycheck => &[],
            Protocol::DynerfMono => published::DYNERF,
            Protocol::SintelPose => published::SINTEL,
        })
    }

    /// The processing of each scene in a folder, in the order of their names.
    ///
    /// # Errors
    /// The folder cannot be read, or contains no scene of this protocol.
    pub fn works(self, folder: &Path, output: &Path, choices: &Choices) -> Result<Vec<Work>> {
        std::fs::metadata(folder).map_err(Error::io(folder))?;
        let works: Vec<Work> = match self {
            Protocol::Nvidia => scenes(folder, frames_and_test)?
                .into_iter()
                .map(|(scene, (frames, test))| {
                    let eval = vec![test.into_os_string(), "--first-camera".into()];
                    choices.scene_work(&output.join(&scene), scene, ("reconstruct", &frames), eval)
                })
                .collect(),
            Protocol::Dnerf => scenes(folder, split)?
                .into_iter()
                .map(|(scene, set)| {
                    let eval =
                        [set.as_os_str().to_owned()].into_iter().chain(choices.sized()).collect();
                    choices.scene_work(&output.join(&scene), scene, ("train", &set), eval)
                })
                .collect(),
            Protocol::HypernerfVrig | Protocol::Dycheck => scenes(folder, nerfies)?
                .into_iter()
                .map(|(scene, set)| choices.staged_work(&output.join(&scene), scene, set, None))
                .collect(),
            Protocol::DynerfMono => scenes(folder, standing)?
                .into_iter()
                .map(|(scene, (set, names))| {
                    let cameras = Some(choices.of_these(&set, &names)?);
                    Ok(choices.staged_work(&output.join(&scene), scene, set, cameras))
                })
                .collect::<Result<_>>()?,
            Protocol::SintelPose => sequences(folder)?
                .into_iter()
                .map(|(scene, (frames, cameras))| {
                    choices.pose_work(&output.join(&scene), scene, &frames, &cameras)
                })
                .collect(),
        };
        if works.is_empty() {
            let what = format!("holds no scene of this table; looked for {}", self.needs());
            return Err(Error::format(folder, what));
        }
        Ok(works)
    }

    /// Required contents of a scene's folder.
    fn needs(self) -> &'static str {
        match self {
            Protocol::Nvidia => "a folder of frames and one of images named v000_t001.png, …",
            Protocol::Dnerf => "transforms_train.json and transforms_test.json",
            Protocol::HypernerfVrig | Protocol::Dycheck => "scene.json, dataset.json and camera/",
            Protocol::DynerfMono => "poses_bounds.npy and cam00.mp4, … or cam00/images, …",
            Protocol::SintelPose => "final/alley_2, … and camdata_left/alley_2, …",
        }
    }
}

impl Choices {
    fn sized(&self) -> Vec<OsString> {
        self.size.map_or(Vec::new(), |size| vec!["--size".into(), size.to_string().into()])
    }

    /// Processing of a scene that a command reconstructs from an input, `eval` evaluates with these
    /// arguments, and `render` renders from its input cameras.
    fn scene_work(
        &self,
        folder: &Path,
        scene: String,
        (command, input): (&'static str, &Path),
        eval: Vec<OsString>,
    ) -> Work {
        let file = folder.join("scene.safetensors");
        let words = |command: &str, path: &Path| vec![OsString::from(command), path.into()];
        let option = |name: &str, value: PathBuf| [OsString::from(name), value.into()];
        let mut make = words(command, input);
        make.extend(option("-o", file.clone()));
        make.extend(option("--report", folder.join("report")));
        make.push("--resume".into());
        make.extend(self.sized());
        make.extend(self.making.iter().cloned());
        let mut measure = words("eval", &file);
        measure.extend(eval);
        measure.extend(option("--pictures", folder.join("pictures")));
        measure.extend(self.lpips.iter().cloned());
        if self.fit_poses {
            measure.push("--fit-poses".into());
        }
        let mut render = words("render", &file);
        render.extend(option("-o", folder.join("views")));
        let steps = [(command, make), ("eval", measure), ("render", render)]
            .map(|(name, arguments)| Step { name, arguments });
        Work { scene, folder: folder.to_path_buf(), staged: None, steps: steps.into() }
    }

    /// Processing of a dataset whose poses are withheld; without `cameras` it must have its own split.
    fn staged_work(
        &self,
        folder: &Path,
        scene: String,
        dataset: PathBuf,
        cameras: Option<Cameras>,
    ) -> Work {
        let staged = Staged::within(folder);
        let eval = vec![staged.truth.into_os_string()];
        let work = self.scene_work(folder, scene, ("reconstruct", &staged.frames), eval);
        Work { staged: Some(Source { dataset, size: self.size, cameras }), ..work }
    }

    /// The chosen cameras, which must belong to a dataset.
    fn of_these(&self, set: &Path, names: &[String]) -> Result<Cameras> {
        let Cameras { train, test } = &self.cameras;
        let chosen = [("--train-camera", train)].into_iter();
        let chosen = chosen.chain(test.iter().map(|name| ("--test-cameras", name)));
        for (option, name) in chosen {
            if !names.contains(name) {
                let what = format!("has no {name} ({option}); there are {}", names.join(", "));
                return Err(Error::format(set, what));
            }
        }
        Ok(self.cameras.clone())
    }

    /// Processing of a clip for which only the cameras are estimated.
    fn pose_work(&self, folder: &Path, scene: String, frames: &Path, cameras: &Path) -> Work {
        let tracked = folder.join("tracked");
        let mut track: Vec<OsString> = vec!["track".into(), frames.into()];
        track.extend(["-o".into(), tracked.clone().into()]);
        track.extend(self.sized());
        track.extend(self.making.iter().cloned());
        let eval = ["eval".into(), tracked.join("poses.txt").into(), cameras.into()];
        let eval =
            eval.into_iter().chain(["--align", "sim3", "--rpe-all-pairs"].map(OsString::from));
        let steps = [("track", track), ("eval", eval.collect())]
            .map(|(name, arguments)| Step { name, arguments });
        Work { scene, folder: folder.to_path_buf(), staged: None, steps: steps.into() }
    }
}

/// The metrics in a scene's answers, by step; the scene's file is in `folder`.
pub fn figures(answers: &BTreeMap<&'static str, Value>, folder: &Path) -> BTreeMap<String, f64> {
    let at = |step: &str, key: &str| answers.get(step).map_or(&Value::Null, |found| &found[key]);
    let mut found = BTreeMap::new();
    let mut add = |key: &str, value: Option<f64>| {
        found.extend(value.map(|value| (key.to_owned(), value)));
    };
    let measured = [
        ("psnr", "psnr"),
        ("ssim", "ssim"),
        ("ms_ssim", "ms_ssim"),
        ("lpips", "lpips"),
        ("ate", "ate_rmse"),
        ("rpe_trans", "rpe_trans_rmse"),
        ("rpe_rot", "rpe_rot_deg_rmse"),
    ];
    for (key, of) in measured {
        add(key, at("eval", of).as_f64());
    }
    // The last row is over all images.
    let row = |key: &str| at("eval", key).as_array().and_then(|rows| rows.last());
    let (held_out, fitted) = (row("held_out"), row("held_out_fitted"));
    for of in ["psnr", "ssim"] {
        add(&format!("fitted_{of}"), fitted.and_then(|row| row[of].as_f64()));
        let covisible = held_out.and_then(|row| row["covisible"][of].as_f64());
        add(&format!("covisible_{of}"), covisible);
    }
    for step in ["reconstruct", "train", "track"] {
        let minutes = |stages: &[&str]| {
            let seconds = |stage: &&str| at(step, "seconds")[*stage].as_f64();
            let known: Vec<f64> = stages.iter().filter_map(seconds).collect();
            (!known.is_empty()).then(|| known.iter().sum::<f64>() / 60.0)
        };
        let poses = minutes(&["flow", "cameras", "masks", "depth"]);
        let training = minutes(&["static", "joint", "train"]);
        add("pose_minutes", poses);
        add("train_minutes", training);
        add("minutes", poses.zip(training).map(|(poses, training)| poses + training));
    }
    add("fps", at("render", "milliseconds_per_frame").as_f64().map(|ms| 1e3 / ms));
    let size = std::fs::metadata(folder.join("scene.safetensors")).ok();
    add("storage_mb", size.map(|file| file.len() as f64 / 1e6));
    found
}

/// The result of `of` for a folder itself, or for its subfolders, by name in order.
fn scenes<T>(folder: &Path, of: impl Fn(&Path) -> Result<Option<T>>) -> Result<Vec<(String, T)>> {
    if let Some(found) = of(folder)? {
        let whole = std::fs::canonicalize(folder).map_err(Error::io(folder))?;
        let name = whole.file_name().map_or("scene".into(), |name| name.to_string_lossy());
        return Ok(vec![(name.into_owned(), found)]);
    }
    let mut found = Vec::new();
    for path in folders(folder)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        found.extend(of(&path)?.map(|scene| (name, scene)));
    }
    Ok(found)
}

/// The subfolders of a folder, in the order of their names.
fn folders(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(Error::io(folder))?;
    let mut found: Vec<PathBuf> =
        entries.flatten().map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    found.sort();
    Ok(found)
}

/// The frames and the test images of an NVIDIA scene: subfolders, recognised by the names of their files.
/// Of several folders of frames (`images`, `images_2`), the one with the largest images is used.
fn frames_and_test(scene: &Path) -> Result<Option<(PathBuf, PathBuf)>> {
    let (mut frames, mut test): (Vec<(u32, PathBuf)>, Option<PathBuf>) = (Vec::new(), None);
    for folder in folders(scene)? {
        let pictures = images::list(&folder)?;
        let Some(first) = pictures.first() else { continue };
        let width = images::dimensions(first, images::Orientation::Stored)?.0;
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if pictures.iter().all(|picture| eval_first::is_named(picture)) {
            test = Some(folder);
        } else if name.contains("images") {
            frames.push((width, folder));
        }
    }
    let frames = frames.into_iter().max_by_key(|(width, _)| *width).map(|(_, folder)| folder);
    Ok(frames.zip(test))
}

fn split(scene: &Path) -> Result<Option<PathBuf>> {
    let is_there = |split: &str| scene.join(format!("transforms_{split}.json")).is_file();
    Ok((is_there("train") && is_there("test")).then(|| scene.to_path_buf()))
}

fn nerfies(scene: &Path) -> Result<Option<PathBuf>> {
    let is_there = matches!(layout::find(scene), Ok(Layout::Nerfies(_, None)));
    Ok(is_there.then(|| scene.to_path_buf()))
}

/// A set of static cameras, with their names.
fn standing(scene: &Path) -> Result<Option<(PathBuf, Vec<String>)>> {
    let names = poses_bounds::camera_names(scene)?;
    Ok((!names.is_empty()).then(|| (scene.to_path_buf(), names)))
}

/// The frames and cameras of the existing [`sintel::SEQUENCES`].
fn sequences(folder: &Path) -> Result<Vec<(String, (PathBuf, PathBuf))>> {
    let roots = [folder.to_path_buf(), folder.join("training")];
    let holds = |root: &&PathBuf| root.join("final").is_dir() && root.join("camdata_left").is_dir();
    let Some(root) = roots.iter().find(holds) else { return Ok(Vec::new()) };
    let places = |name: &str| (root.join("final").join(name), root.join("camdata_left").join(name));
    let found = sintel::SEQUENCES.map(|name| (name.to_owned(), places(name)));
    Ok(found
        .into_iter()
        .filter(|(_, (frames, cameras))| frames.is_dir() && cameras.is_dir())
        .collect())
}
