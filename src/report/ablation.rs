//! Contribution of each component of a reconstruction: runs with one component disabled, compared with the
//! full run.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;
use serde_json::{Value, json};

use super::Machine;
use super::ablation_page::page;
use super::csv::record;
use crate::{Result, io};

/// The ablation of one clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Ablation {
    /// Version of the crate.
    pub version: String,
    /// Name of the clip.
    pub clip: String,
    /// Number of frames.
    pub frames: usize,
    /// Width and height of the frames, pixels.
    pub size: [u32; 2],
    /// Training steps of the last stage.
    pub steps: u32,
    /// Random seeds; each row was run once with each of them.
    pub seeds: Vec<u64>,
    /// The machine that it ran on.
    pub machine: Machine,
    /// The metrics of each run.
    pub figures: Vec<Figure>,
    /// The full run, then the runs with one component disabled.
    pub rows: Vec<AblationRow>,
}

/// A metric that is measured for every run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Figure {
    /// Machine-readable key.
    pub key: String,
    /// Human-readable title, with its unit.
    pub title: String,
    /// Which direction is better.
    pub better: Better,
}

/// The direction in which a metric improves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Better {
    /// Larger is better, as for PSNR and SSIM.
    More,
    /// Smaller is better, as for seconds and bytes.
    Less,
}

/// The runs without one component, one per seed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AblationRow {
    /// The disabled component; `full` for the run with all of them.
    pub component: String,
    /// Effect of disabling the component, in words.
    pub without: String,
    /// Per seed, metrics by key; a metric that could not be measured is absent.
    pub runs: Vec<BTreeMap<String, f64>>,
    /// Reason of a failure, if a run failed; then there are no metrics.
    pub failed: Option<String>,
}

/// A metric summarised over the seeds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Median over the seeds.
    pub median: f64,
    /// Worst value over the seeds.
    pub worst: f64,
    /// Median over the seeds of the difference from the full run with the same seed.
    pub change: Option<f64>,
}

impl Ablation {
    /// The files that [`Ablation::write_report`] writes to its folder.
    pub const REPORT_FILES: [&str; 2] = ["ablation.csv", "index.html"];

    /// A metric of a row, summarised over the seeds; `None` where it is missing for a run.
    pub fn summary(&self, row: &AblationRow, figure: &Figure) -> Option<Summary> {
        let of = |row: &AblationRow| -> Option<Vec<f64>> {
            let values: Option<Vec<f64>> =
                row.runs.iter().map(|run| run.get(&figure.key).copied()).collect();
            values.filter(|values| !values.is_empty())
        };
        let values = of(row)?;
        let full = self.rows.first().and_then(of).filter(|full| full.len() == values.len());
        let change =
            full.map(|full| median(values.iter().zip(&full).map(|(a, b)| a - b).collect()));
        let worst = match figure.better {
            Better::More => values.iter().copied().fold(f64::INFINITY, f64::min),
            Better::Less => values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        };
        Some(Summary { median: median(values), worst, change })
    }

    /// The ablation as JSON, with each row's `summary` by metric.
    pub fn json(&self) -> Value {
        let mut json = json!(self);
        for (i, row) in self.rows.iter().enumerate() {
            let summary: BTreeMap<&str, Option<Summary>> =
                self.figures.iter().map(|f| (f.key.as_str(), self.summary(row, f))).collect();
            json["rows"][i]["summary"] = json!(summary);
        }
        json
    }

    /// CSV with a line for each row, metric and seed (RFC 4180).
    pub fn csv(&self) -> String {
        let mut table = String::new();
        record(&mut table, ["component", "without", "figure", "seed", "value"].map(str::to_owned));
        for row in &self.rows {
            for figure in &self.figures {
                for (seed, run) in self.seeds.iter().zip(&row.runs) {
                    let Some(value) = run.get(&figure.key) else { continue };
                    let AblationRow { component, without, .. } = row;
                    let (seed, value) = (seed.to_string(), value.to_string());
                    let key = figure.key.clone();
                    record(&mut table, [component.clone(), without.clone(), key, seed, value]);
                }
            }
        }
        table
    }

    /// Writes `ablation.csv` and `index.html` to a folder, by rename.
    ///
    /// # Errors
    /// The folder cannot be written, or a plot could not be drawn.
    pub fn write_report(&self, folder: impl AsRef<Path>) -> Result<()> {
        use std::io::Write;
        let [table, whole] = Ablation::REPORT_FILES.map(|name| folder.as_ref().join(name));
        let (csv, page) = (self.csv(), page(self)?);
        io::write_atomically(table, |s| s.write_all(csv.as_bytes()))?;
        io::write_atomically(whole, |s| s.write_all(page.as_bytes()))
    }
}

/// The median; there is at least one value.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    match values.len() % 2 {
        1 => values[half],
        _ => 0.5 * (values[half - 1] + values[half]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(component: &str, psnr: &[f64]) -> AblationRow {
        AblationRow {
            component: component.into(),
            without: "a, \"b\" & <c>".into(),
            runs: psnr.iter().map(|&v| [("psnr".into(), v)].into()).collect(),
            failed: None,
        }
    }

    fn ablation(rows: Vec<AblationRow>) -> Ablation {
        let figure =
            |better, key: &str| Figure { key: key.into(), title: "PSNR, dB".into(), better };
        Ablation {
            version: "1".into(),
            clip: "clip".into(),
            frames: 3,
            size: [4, 3],
            steps: 2,
            seeds: vec![0, 1, 2],
            machine: Machine::default(),
            figures: vec![figure(Better::More, "psnr"), figure(Better::Less, "seconds")],
            rows,
        }
    }

    #[test]
    fn a_component_is_judged_seed_by_seed() {
        let found = ablation(vec![row("full", &[20.0, 30.0, 40.0]), row("x", &[19.0, 31.0, 35.0])]);
        let [psnr, seconds] = &found.figures[..] else { panic!() };
        let summary = found.summary(&found.rows[1], psnr).unwrap();
        assert_eq!(summary, Summary { median: 31.0, worst: 19.0, change: Some(-1.0) });
        assert_eq!(found.summary(&found.rows[1], seconds), None, "not measured");
        assert_eq!(found.json()["rows"][1]["summary"]["psnr"]["change"], -1.0);
        assert_eq!(found.json()["rows"][1]["summary"]["seconds"], Value::Null);
    }

    #[test]
    fn a_run_that_failed_has_no_figures() {
        let failed = AblationRow { failed: Some("why".into()), ..row("x", &[]) };
        let found = ablation(vec![row("full", &[20.0, 30.0, 40.0]), failed]);
        assert_eq!(found.summary(&found.rows[1], &found.figures[0]), None);
        assert!(page(&found).unwrap().contains("why"));
    }

    #[test]
    fn the_report_quotes_what_it_must() {
        let found = ablation(vec![row("full", &[20.0, 30.0, 40.0]), row("x", &[19.0, 31.0, 35.0])]);
        let lines: Vec<String> = found.csv().split("\r\n").map(str::to_owned).collect();
        assert_eq!(lines[0], "component,without,figure,seed,value");
        assert_eq!(lines[4], "x,\"a, \"\"b\"\" & <c>\",psnr,0,19");
        assert_eq!(lines.len(), 8, "a line for each run, the header, the end of the last");
        let page = page(&found).unwrap();
        assert!(page.contains("&lt;c&gt;") && !page.contains("<c>"));
        assert!(page.contains("<svg") && page.contains("−1.00"), "{page}");
    }
}
