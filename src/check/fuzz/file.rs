//! Fuzz scenes as JSON files. Non-finite numbers are strings: `"NaN"`, `"inf"`, `"-inf"`.

use super::FuzzScene;
use crate::error::{Error, Result};
use crate::types::{Camera, Gaussians, Intrinsics, Pose, sh_coefficients};
use glam::{DQuat, DVec3};
use serde_json::{Map, Value, json};
use std::path::Path;

/// The scene as JSON text.
pub fn text(scene: &FuzzScene) -> String {
    let (g, k, pose) = (&scene.gaussians, scene.camera.intrinsics, scene.camera.view_from_world);
    let floats = |values: &[f32]| list(values.iter().map(|&v| f64::from(v)));
    let value = json!({
        "positions": floats(g.positions.as_flattened()),
        "log_scales": floats(g.log_scales.as_flattened()),
        "rotations": floats(g.rotations.as_flattened()),
        "opacity_logits": floats(&g.opacity_logits),
        "sh_degree": g.sh_degree,
        "sh": floats(g.sh.as_flattened()),
        "image": [k.width, k.height],
        "intrinsics": list([k.fx, k.fy, k.cx, k.cy]),
        "rotation_wxyz": list([pose.rotation.w, pose.rotation.x, pose.rotation.y, pose.rotation.z]),
        "translation": list(pose.translation.to_array()),
        "seed": scene.seed,
    });
    let mut text = serde_json::to_string_pretty(&value).expect("plain JSON");
    text.push('\n');
    text
}

fn list(values: impl IntoIterator<Item = f64>) -> Value {
    let one = |v: f64| if v.is_finite() { json!(v) } else { json!(v.to_string()) };
    values.into_iter().map(one).collect()
}

/// Reads a scene's file.
///
/// # Errors
/// [`Error::Io`], or [`Error::Format`] that names the key.
pub fn read(path: &Path) -> Result<FuzzScene> {
    let text = crate::io::read_text(path)?;
    parse(&path.to_string_lossy(), &text)
}

/// Parses a scene's text; `name` is used in error messages.
///
/// # Errors
/// [`Error::Format`] that names the key.
pub fn parse(name: &str, text: &str) -> Result<FuzzScene> {
    let wrong = |what: String| Error::format(name, what);
    let value: Value = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
    let object = value.as_object().ok_or_else(|| wrong("is no JSON object".into()))?;
    let numbers = |key: &str, count: usize| -> Result<Vec<f64>> {
        let found =
            numbers(object, key).ok_or_else(|| wrong(format!("{key} is no list of numbers")))?;
        if found.len() != count {
            return Err(wrong(format!("{key} has {} numbers, expected {count}", found.len())));
        }
        Ok(found)
    };
    let whole = |key: &str| -> Result<u64> {
        let number = object.get(key).and_then(Value::as_u64);
        number.ok_or_else(|| wrong(format!("{key} is no whole number")))
    };
    let count = object.get("opacity_logits").and_then(Value::as_array).map_or(0, Vec::len);
    let degree = whole("sh_degree")?;
    if degree > 3 {
        return Err(wrong(format!("sh_degree is {degree}, at most 3 is possible")));
    }
    let floats = |key: &str, count: usize| -> Result<Vec<f32>> {
        Ok(numbers(key, count)?.into_iter().map(|v| v as f32).collect())
    };
    let rows = |key: &str, count: usize| -> Result<Vec<[f32; 3]>> {
        let flat = floats(key, 3 * count)?;
        Ok(flat.chunks_exact(3).map(|row| [row[0], row[1], row[2]]).collect())
    };
    let rotations = floats("rotations", 4 * count)?;
    let gaussians = Gaussians {
        positions: rows("positions", count)?,
        log_scales: rows("log_scales", count)?,
        rotations: rotations.chunks_exact(4).map(|q| [q[0], q[1], q[2], q[3]]).collect(),
        opacity_logits: floats("opacity_logits", count)?,
        sh_degree: degree as u32,
        sh: rows("sh", count * sh_coefficients(degree as u32))?,
        motion_logits: Vec::new(),
    };
    let image = numbers("image", 2)?;
    if image.iter().any(|&side| !(1.0..=4096.0).contains(&side) || side.fract() != 0.0) {
        return Err(wrong(format!("image {image:?} is no size from 1 to 4096")));
    }
    let (k, q, t) =
        (numbers("intrinsics", 4)?, numbers("rotation_wxyz", 4)?, numbers("translation", 3)?);
    let camera = Camera {
        intrinsics: Intrinsics {
            fx: k[0],
            fy: k[1],
            cx: k[2],
            cy: k[3],
            width: image[0] as u32,
            height: image[1] as u32,
        },
        // Not normalised: the file may test an invalid rotation.
        view_from_world: Pose {
            rotation: DQuat::from_xyzw(q[1], q[2], q[3], q[0]),
            translation: DVec3::from_slice(&t),
        },
    };
    Ok(FuzzScene { gaussians, camera, seed: whole("seed")? })
}

fn numbers(object: &Map<String, Value>, key: &str) -> Option<Vec<f64>> {
    let one = |value: &Value| match value {
        Value::String(text) => text.parse().ok(),
        other => other.as_f64(),
    };
    object.get(key)?.as_array()?.iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::fuzz::draw;

    fn bits(scene: &FuzzScene) -> Vec<u64> {
        let g = &scene.gaussians;
        let floats = g.positions.as_flattened().iter().chain(g.log_scales.as_flattened());
        let floats = floats.chain(g.rotations.as_flattened()).chain(&g.opacity_logits);
        let bits = |v: &f32| if v.is_nan() { 0 } else { u64::from(v.to_bits()) };
        let k = scene.camera.intrinsics;
        let wide = [k.fx, k.fy, k.cx, k.cy, scene.camera.view_from_world.rotation.w];
        let wide = wide.map(|v| if v.is_nan() { 0 } else { v.to_bits() });
        floats.chain(g.sh.as_flattened()).map(bits).chain(wide).collect()
    }

    #[test]
    fn every_scene_comes_back_as_it_was() {
        for index in 0..300 {
            let scene = draw(3, index);
            let again = parse("a scene", &text(&scene)).unwrap();
            assert_eq!(bits(&scene), bits(&again), "{index}");
            assert_eq!(scene.seed, again.seed);
        }
    }

    #[test]
    fn broken_files_are_named_by_their_key() {
        let good = text(&draw(3, 1));
        let wrong = |from: &str, to: &str| {
            parse("x.json", &good.replacen(from, to, 1)).unwrap_err().to_string()
        };
        assert!(wrong("\"rotations\"", "\"turns\"").contains("rotations is no list"));
        assert!(wrong("\"sh_degree\": ", "\"sh_degree\": 7").contains("sh_degree is"));
        assert!(wrong("\"seed\"", "\"seeds\"").contains("seed is no whole number"));
        assert!(wrong("\"translation\": [", "\"translation\": [1.0, ").contains("expected 3"));
        assert!(parse("x.json", "{").unwrap_err().to_string().starts_with("x.json: "));
        assert!(parse("x.json", "[]").unwrap_err().to_string().contains("no JSON object"));
    }
}
