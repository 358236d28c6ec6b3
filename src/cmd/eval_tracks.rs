//! Evaluates point tracks against true tracks of the same points, with the metrics of TAP-Vid.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fmt::Write;
use std::path::Path;

use serde_json::{Map, Value, json};
use splat4d::Result;
use splat4d::data::{read_mask, tracks};
use splat4d::eval::score_tracks;
use splat4d::types::Image;

/// The keys about point tracks.
pub fn measure(estimate: &Path, reference: &Path) -> Result<Map<String, Value>> {
    let (found, truth) = (tracks::read(estimate)?, tracks::read(reference)?);
    let found = match truth.size {
        Some(size) => found.resized(size),
        None => found,
    };
    let masks = reference.parent().unwrap_or(Path::new(".")).join("masks");
    let mut mask_of: BTreeMap<usize, Image> = BTreeMap::new();
    if masks.is_dir() {
        for point in &truth.points {
            let frame = point.query.0;
            if let Entry::Vacant(place) = mask_of.entry(frame) {
                place.insert(read_mask(masks.join(format!("{frame:04}.png")))?);
            }
        }
    }
    let moves = |i: usize| -> Option<bool> {
        let (frame, at) = truth.points[i].query;
        let mask = mask_of.get(&frame)?;
        let (x, y) = (at.x.max(0.0) as u32, at.y.max(0.0) as u32);
        Some(mask.at(x.min(mask.width - 1), y.min(mask.height - 1))[0] > 0.5)
    };
    let row = |counts: &dyn Fn(usize) -> bool| -> Result<Value> {
        let scores = score_tracks(&found, &truth, counts)?;
        Ok(scores.map_or(Value::Null, |scores| {
            json!({
                "average_jaccard": scores.average_jaccard,
                "position_accuracy": scores.position_accuracy(),
                "within": scores.within,
                "occlusion_accuracy": scores.occlusion_accuracy,
                "points": scores.points,
            })
        }))
    };
    let rows = json!({
        "all": row(&|_| true)?,
        "movers": row(&|i| moves(i) == Some(true))?,
        "static": row(&|i| moves(i) == Some(false))?,
    });
    Ok(Map::from_iter([("tracks".to_owned(), rows)]))
}

/// The scores as text.
pub fn table(found: &Value) -> String {
    let mut text = String::new();
    for (name, row) in found.as_object().into_iter().flatten().filter(|(_, row)| !row.is_null()) {
        let share = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
        let within: Vec<String> = row["within"]
            .as_array()
            .into_iter()
            .flatten()
            .map(|v| format!("{:.3}", share(v)))
            .collect();
        let _ = writeln!(
            text,
            "{name:8} average Jaccard {:.3}  position {:.3} ({})  occlusion {:.3}  {} points",
            share(&row["average_jaccard"]),
            share(&row["position_accuracy"]),
            within.join(" "),
            share(&row["occlusion_accuracy"]),
            row["points"],
        );
    }
    text
}
