//! A self-contained HTML page: no fonts, images or scripts from elsewhere. It supports light and dark
//! schemes, and narrow screens.

use std::fmt::Write;

use splat4d::report::escape;
use splat4d::track::{FrameQuality, Track};

use super::charts;
use super::origins::{self, Origin};

const STYLE: &str = "\
:root{color-scheme:light dark;--paper:#fff;--ink:#1c1e21;--dim:#6b7076;--faint:#e2e4e7;--one:#0063ad;\
--two:#a85200;--bad:#c42b1c;--note:#fff6dd}\
@media(prefers-color-scheme:dark){:root{--paper:#15171a;--ink:#e6e8ea;--dim:#9aa0a6;--faint:#33373c;\
--one:#6fb7ff;--two:#ffb35c;--bad:#ff7a6e;--note:#2d2817}}\
*{box-sizing:border-box}body{font:15px/1.5 system-ui,sans-serif;background:var(--paper);color:var(--ink);\
max-width:88rem;margin:0 auto;padding:1rem;overflow-wrap:anywhere}\
h1,h2,h3{line-height:1.25;margin:1.6em 0 .5em}h1{font-size:1.5rem;margin-top:.3em}h2{font-size:1.2rem}\
h3{font-size:1rem;margin:0 0 .2em}p{max-width:60rem;margin:.5em 0}\
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(19rem,100%),1fr));gap:.1rem 2rem;margin:0}\
.facts div{display:flex;justify-content:space-between;gap:1rem;border-bottom:1px solid var(--faint);padding:.25rem 0}\
dt{color:var(--dim);overflow-wrap:break-word}dd{margin:0;text-align:right}\
.notes{background:var(--note);border-left:4px solid var(--two);padding:.5rem 1rem .5rem 2rem;margin:1rem 0}\
.grid-of{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(21rem,100%),1fr));gap:1.5rem}\
.maps{grid-template-columns:repeat(auto-fit,minmax(min(17rem,100%),1fr))}\
figure{margin:0;min-width:0}figcaption{color:var(--dim);font-size:13px}\
.pair{display:grid;grid-template-columns:1fr 1fr;gap:3px}.pair img{width:100%;height:auto;display:block}\
.scale{display:flex;flex-wrap:wrap;gap:.6rem;align-items:center;font-size:13px;margin:.5rem 0}\
.scale i{flex:1 1 6rem;max-width:16rem;height:.9rem;border:1px solid var(--dim)}\
.grey{display:inline-block;width:.9rem;height:.9rem;background:#808080;border:1px solid var(--dim);\
vertical-align:-2px;margin-right:.3rem}\
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}\
th,td{padding:.2rem .7rem;text-align:right;border-bottom:1px solid var(--faint);white-space:nowrap}\
th:nth-child(2),td:nth-child(2){text-align:left}summary{cursor:pointer;margin:1rem 0}\
.doubt{color:var(--bad);font-weight:600}";

/// A complete page; `style` is appended to the common style.
pub fn document(title: &str, style: &str, body: &str) -> String {
    let title = escape(title);
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <link rel=\"icon\" href=\"data:,\"><title>{title}</title>\
         <style>{STYLE}{}{style}</style></head><body>\n<h1>{title}</h1>\n{body}</body></html>\n",
        charts::STYLE
    )
}

/// Adds a list of names and values.
pub fn facts(body: &mut String, facts: &[(&str, String)]) {
    body.push_str("<dl class=\"facts\">");
    for (name, value) in facts {
        let _ = write!(body, "<div><dt>{}</dt><dd>{}</dd></div>", escape(name), escape(value));
    }
    body.push_str("</dl>\n");
}

/// Adds the source of each quantity.
pub fn origins(body: &mut String, origins: &[Origin]) {
    if origins.is_empty() {
        return;
    }
    body.push_str("<h2>Where it is from</h2>\n");
    facts(body, &origins::facts(origins));
}

/// Adds the notes of the run.
pub fn notes(body: &mut String, notes: &[String]) {
    if notes.is_empty() {
        return;
    }
    body.push_str("<ul class=\"notes\">");
    for note in notes {
        let _ = write!(body, "<li>{}</li>", escape(note));
    }
    body.push_str("</ul>\n");
}

/// Adds the frames with an uncertain camera, with the reasons; `shown` says where else on the page they are
/// marked.
pub fn doubtful(body: &mut String, track: &Track, names: &[String], shown: &str) {
    body.push_str("<h2>Doubtful frames</h2>\n");
    let doubtful = &track.quality.doubtful_frames;
    if doubtful.is_empty() {
        body.push_str("<p>None: enough static points agree with the camera of every frame.</p>\n");
        return;
    }
    let _ = write!(
        body,
        "<p>Too few static points agree with the cameras of these. They are {}.</p>\n<ul>",
        escape(shown)
    );
    for &frame in doubtful {
        let FrameQuality { inliers, observations, .. } = track.quality.per_frame[frame];
        let _ = write!(
            body,
            "<li>frame {frame}, <b>{}</b>: {inliers} of {observations} observations agree</li>",
            escape(&names[frame])
        );
    }
    body.push_str("</ul>\n");
}
