//! Results on the scenes of a dataset under one protocol, beside published results.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;
use serde_json::{Value, json};

use super::csv::record;
use super::{Figure, Machine, table_latex, table_page};
use crate::{Result, io};

/// The result table of a protocol.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ResultTable {
    /// Version of the crate.
    pub version: String,
    /// Title of the table.
    pub title: String,
    /// The protocol, and the choices where it is ambiguous; one sentence each.
    pub caption: Vec<String>,
    /// The machine that it ran on.
    pub machine: Machine,
    /// The columns.
    pub figures: Vec<Figure>,
    /// One row per scene.
    pub rows: Vec<SceneRow>,
    /// Published results.
    pub published: Vec<PublishedRow>,
}

/// Results of one scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneRow {
    /// Name of the scene.
    pub scene: String,
    /// Values by [`Figure::key`]; metrics that do not apply are absent.
    pub figures: BTreeMap<String, f64>,
    /// Reason of a failure, if the scene failed; then there are no values.
    pub failed: Option<String>,
}

/// Published results of a method.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PublishedRow {
    /// Name of the method.
    pub method: String,
    /// What the values refer to: a scene, or a mean.
    pub of: String,
    /// Values by [`Figure::key`].
    pub figures: BTreeMap<String, f64>,
    /// Source of the values, and differences in the protocol.
    pub source: String,
}

impl ResultTable {
    /// The files that [`ResultTable::write_report`] writes.
    pub const REPORT_FILES: [&'static str; 3] = ["table.csv", "table.tex", "index.html"];

    /// Number of failed scenes.
    pub fn failed(&self) -> usize {
        self.rows.iter().filter(|row| row.failed.is_some()).count()
    }

    /// Mean of a metric over the scenes; `None` where a scene failed or lacks it, because a mean over some
    /// scenes is not comparable with one over all.
    pub fn mean(&self, figure: &Figure) -> Option<f64> {
        let values: Option<Vec<f64>> =
            self.rows.iter().map(|row| row.figures.get(&figure.key).copied()).collect();
        let values = values.filter(|values| !values.is_empty())?;
        Some(values.iter().sum::<f64>() / values.len() as f64)
    }

    /// The table as JSON, with `failed` and `mean` by metric.
    pub fn json(&self) -> Value {
        let mut json = json!(self);
        let means: BTreeMap<&str, Option<f64>> =
            self.figures.iter().map(|figure| (figure.key.as_str(), self.mean(figure))).collect();
        json["mean"] = json!(means);
        json["failed"] = json!(self.failed());
        json
    }

    /// CSV with a line for each metric of a scene, of the mean and of the published results (RFC 4180).
    pub fn csv(&self) -> String {
        let mut table = String::new();
        record(&mut table, ["kind", "name", "of", "figure", "value", "remark"].map(str::to_owned));
        let mut add = |kind: &str, name: &str, of: &str, key: &str, value: f64, remark: &str| {
            let value = value.to_string();
            record(&mut table, [kind, name, of, key, &value, remark].map(str::to_owned));
        };
        for row in &self.rows {
            for (key, value) in &row.figures {
                add("scene", "splat4d", &row.scene, key, *value, "");
            }
            if let Some(why) = &row.failed {
                add("failed", "splat4d", &row.scene, "", f64::NAN, why);
            }
        }
        for figure in &self.figures {
            if let Some(mean) = self.mean(figure) {
                add("mean", "splat4d", "all scenes", &figure.key, mean, "");
            }
        }
        for row in &self.published {
            for (key, value) in &row.figures {
                add("published", &row.method, &row.of, key, *value, &row.source);
            }
        }
        table
    }

    /// The printed rows: name, what the values refer to, one cell per metric, and whether the row is a
    /// failed scene.
    pub(super) fn cells(&self) -> Vec<Cells> {
        let of = |figures: &BTreeMap<String, f64>| -> Vec<String> {
            let cell = |figure: &Figure| {
                figures.get(&figure.key).map_or("–".to_owned(), |value| shown(figure, *value))
            };
            self.figures.iter().map(cell).collect()
        };
        let published = self.published.iter().map(|row| Cells {
            name: row.method.clone(),
            of: row.of.clone(),
            cells: of(&row.figures),
            remark: row.source.clone(),
            failed: false,
        });
        let scenes = self.rows.iter().map(|row| Cells {
            name: "splat4d".into(),
            of: row.scene.clone(),
            cells: of(&row.figures),
            remark: row.failed.as_ref().map_or(String::new(), |why| format!("failed: {why}")),
            failed: row.failed.is_some(),
        });
        let mean = |figure: &Figure| {
            self.mean(figure).map_or("–".to_owned(), |value| shown(figure, value))
        };
        let all = (self.rows.len() > 1).then(|| Cells {
            name: "splat4d".into(),
            of: format!("mean of {}", self.rows.len()),
            cells: self.figures.iter().map(mean).collect(),
            remark: match self.failed() {
                0 => String::new(),
                failed => format!("{failed} of {} scenes failed", self.rows.len()),
            },
            failed: self.failed() > 0,
        });
        published.chain(scenes).chain(all).collect()
    }

    /// The table as plain text, without the published results.
    pub fn text(&self) -> String {
        use std::fmt::Write;
        let mut text = format!("{}\n", self.title);
        for line in &self.caption {
            let _ = writeln!(text, "{line}");
        }
        let _ = write!(text, "{:24}", "");
        for figure in &self.figures {
            let _ = write!(text, "{:>16}", figure.title);
        }
        text.push('\n');
        for row in self.cells().iter().filter(|row| row.name == "splat4d") {
            let _ = write!(text, "{:24}", row.of);
            for cell in &row.cells {
                let _ = write!(text, "{cell:>16}");
            }
            let _ = writeln!(text, "  {}", row.remark);
        }
        text
    }

    /// Writes `table.csv`, `table.tex` and `index.html` to a folder, by rename.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn write_report(&self, folder: impl AsRef<Path>) -> Result<()> {
        use std::io::Write;
        let written = [self.csv(), table_latex::latex(self), table_page::page(self)];
        for (name, text) in ResultTable::REPORT_FILES.iter().zip(written) {
            io::write_atomically(folder.as_ref().join(name), |s| s.write_all(text.as_bytes()))?;
        }
        Ok(())
    }
}

/// A printed row.
pub(super) struct Cells {
    pub name: String,
    pub of: String,
    pub cells: Vec<String>,
    pub remark: String,
    pub failed: bool,
}

/// A value with its meaningful digits.
fn shown(figure: &Figure, value: f64) -> String {
    let digits = match figure.key.as_str() {
        key if key.contains("psnr") => 2,
        key if key.contains("ssim") || key.contains("lpips") => 4,
        key if key.starts_with("ate") || key.starts_with("rpe") => 4,
        _ => 1,
    };
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::super::Better;
    use super::*;

    fn figure(key: &str, title: &str, better: Better) -> Figure {
        Figure { key: key.into(), title: title.into(), better }
    }

    fn row(scene: &str, figures: &[(&str, f64)], failed: Option<&str>) -> SceneRow {
        SceneRow {
            scene: scene.into(),
            figures: figures.iter().map(|(key, value)| (key.to_string(), *value)).collect(),
            failed: failed.map(str::to_owned),
        }
    }

    fn table(rows: Vec<SceneRow>) -> ResultTable {
        ResultTable {
            version: "1".into(),
            title: "A <set> of 100 % & more".into(),
            caption: vec!["Poses are given.".into()],
            machine: Machine::default(),
            figures: vec![
                figure("psnr", "PSNR, dB", Better::More),
                figure("lpips", "LPIPS", Better::Less),
            ],
            rows,
            published: vec![PublishedRow {
                method: "A_method".into(),
                of: "mean of 7".into(),
                figures: [("psnr".to_owned(), 24.43)].into(),
                source: "its paper, table 2".into(),
            }],
        }
    }

    #[test]
    fn a_mean_is_over_all_scenes_or_is_none() {
        let whole = table(vec![
            row("a", &[("psnr", 20.0), ("lpips", 0.5)], None),
            row("b", &[("psnr", 30.0)], None),
        ]);
        assert_eq!(whole.mean(&whole.figures[0]), Some(25.0));
        assert_eq!(whole.mean(&whole.figures[1]), None, "b has none");
        let failed = table(vec![row("a", &[("psnr", 20.0)], None), row("b", &[], Some("why"))]);
        assert_eq!((failed.mean(&failed.figures[0]), failed.failed()), (None, 1));
        let json = failed.json();
        assert_eq!((&json["failed"], &json["mean"]["psnr"]), (&json!(1), &Value::Null));
        let last = failed.cells().pop().unwrap();
        assert_eq!(last.remark, "1 of 2 scenes failed");
        assert!(table(Vec::new()).mean(&failed.figures[0]).is_none());
    }

    #[test]
    fn each_figure_is_a_line() {
        let csv = table(vec![row("a, b", &[("psnr", 20.5)], None)]).csv();
        let lines: Vec<&str> = csv.lines().map(|line| line.trim_end_matches('\r')).collect();
        assert_eq!(lines[0], "kind,name,of,figure,value,remark");
        assert_eq!(lines[1], "scene,splat4d,\"a, b\",psnr,20.5,");
        assert_eq!(lines[2], "mean,splat4d,all scenes,psnr,20.5,");
        let published = "published,A_method,mean of 7,psnr,24.43,\"its paper, table 2\"";
        assert_eq!(lines[3..], [published]);
    }

    #[test]
    fn reports_say_the_same_and_escape_what_they_must() {
        let made = table(vec![
            row("cup_1", &[("psnr", 20.125), ("lpips", 0.25)], None),
            row("b", &[], Some("it <broke>")),
        ]);
        let folder = tempfile::tempdir().unwrap();
        made.write_report(folder.path()).unwrap();
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        let [csv, latex, page] = ResultTable::REPORT_FILES.map(read);
        assert_eq!(csv, made.csv());
        for part in
            ["cup\\_1 & 20.12 & 0.2500", "A\\_method & mean of 7 & 24.43 & –", "100 \\% \\& more"]
        {
            assert!(latex.contains(part), "{part}: {latex}");
        }
        for part in
            ["<td>20.12</td>", "it &lt;broke&gt;", "A &lt;set&gt; of 100 % &amp; more", "24.43"]
        {
            assert!(page.contains(part), "{part}: {page}");
        }
        assert!(made.text().contains("cup_1"));
    }
}
