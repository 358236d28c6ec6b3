//! A result table for a paper: a `tabular` that needs no packages.

use std::fmt::Write;

use super::{Better, ResultTable};

/// The table in a `table` environment.
pub(super) fn latex(table: &ResultTable) -> String {
    let columns = "r".repeat(table.figures.len());
    let caption: Vec<String> =
        [&table.title].into_iter().chain(&table.caption).map(|line| escape(line)).collect();
    let mut text = format!(
        "% splat4d {}\n\\begin{{table}}\n\\centering\n\\caption{{{}}}\n\\begin{{tabular}}{{ll{columns}}}\n\
         \\hline\nMethod & of",
        table.version,
        caption.join(" ")
    );
    for figure in &table.figures {
        let arrow = if figure.better == Better::More { "\\uparrow" } else { "\\downarrow" };
        let _ = write!(text, " & {}$\\,{arrow}$", escape(&figure.title));
    }
    text.push_str(" \\\\\n\\hline\n");
    for (i, row) in table.cells().iter().enumerate() {
        if i > 0 && i == table.published.len() {
            text.push_str("\\hline\n");
        }
        let _ = write!(text, "{} & {}", escape(&row.name), escape(&row.of));
        for cell in &row.cells {
            let _ = write!(text, " & {cell}");
        }
        if row.failed {
            let _ = write!(text, " % {}", row.remark.replace('\n', " "));
            // A comment hides the rest of its line.
            text.push('\n');
        }
        text.push_str(" \\\\\n");
    }
    text.push_str("\\hline\n\\end{tabular}\n\\end{table}\n");
    text
}

/// Escapes LaTeX's special characters.
fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\\' => out.push_str("\\textbackslash{}"),
            '~' => out.push_str("\\textasciitilde{}"),
            '^' => out.push_str("\\textasciicircum{}"),
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => {
                out.push('\\');
                out.push(c);
            }
            c => out.push(c),
        }
    }
    out
}
