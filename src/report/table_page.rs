//! A result table as one self-contained HTML page.

use std::fmt::Write;

use super::html::{STYLE, escape};
use super::{Better, ResultTable};

/// The HTML page.
pub(super) fn page(table: &ResultTable) -> String {
    let title = escape(&table.title);
    let mut body = format!("<h1>{title}</h1>\n<p>");
    for line in &table.caption {
        let _ = write!(body, "{} ", escape(line));
    }
    let machine = &table.machine;
    let _ = writeln!(
        body,
        "</p>\n<p>On {} ({}), splat4d {}.</p>",
        escape(&machine.device),
        escape(&machine.driver),
        escape(&table.version)
    );
    if machine.software {
        body.push_str("<p>Times of a software driver say nothing of a GPU.</p>\n");
    }
    body.push_str("<div class=\"wide\"><table><thead><tr><th>method</th><th>of</th>");
    for figure in &table.figures {
        let arrow = if figure.better == Better::More { "↑" } else { "↓" };
        let _ = write!(body, "<th>{} {arrow}</th>", escape(&figure.title));
    }
    body.push_str("<th></th></tr></thead><tbody>");
    for row in table.cells() {
        let class = if row.failed { " class=\"missed\"" } else { "" };
        let _ =
            write!(body, "<tr{class}><td>{}</td><td>{}</td>", escape(&row.name), escape(&row.of));
        for cell in &row.cells {
            let _ = write!(body, "<td>{cell}</td>");
        }
        // Sources are sentences, which may wrap.
        let remark = escape(&row.remark);
        let _ = write!(body, "<td style=\"text-align:left;white-space:normal\">{remark}</td></tr>");
    }
    body.push_str("</tbody></table></div>\n");
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <link rel=\"icon\" href=\"data:,\">\
         <title>splat4d table: {title}</title><style>{STYLE}</style></head><body>\n{body}</body></html>\n"
    )
}
