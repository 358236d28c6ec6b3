//! Export of a scene as one self-contained HTML page that plays it, in any browser with WebGL 2.
//! The page also works from a local file and loads nothing from elsewhere.
//!
//! The page holds the scene in its [`compact`] form, and a player, which `tools/player` builds:
//! Spark on three.js, which sort and draw the splats, and the skinning of dynamic Gaussians. The
//! player supports control points with paths only; a deformation network must be replaced by paths
//! first.

use std::io::Write;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

use super::{Scene, compact};
use crate::types::Camera;
use crate::{Error, Result, io};

const PAGE: &str = include_str!("page.html");
/// The style sheet; the part shared with the viewer's page comes first.
const STYLE: &str = concat!(include_str!("../../view/page/base.css"), include_str!("style.css"));
const UNPACK: &str = include_str!("unpack.js");
/// The licences of third-party code in the player.
const LICENCES: &str = include_str!("licences.txt");
/// The player's script, gzip-compressed.
const PLAYER: &[u8] = include_bytes!("player.js.gz");
/// Spark's sorting module, gzip-compressed.
const SORTER: &[u8] = include_bytes!("sorter.wasm.gz");
/// Maximum number of Gaussians of a page; such a page has about 100 MB.
pub const MOST_GAUSSIANS: usize = 1 << 22;

/// The initial state of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct Opening {
    /// The page's title.
    pub title: String,
    /// The initial camera of the viewer.
    pub start: Camera,
    /// Distance from the camera to the orbit centre, scene units.
    pub distance: f64,
    /// The time, in [0, 1].
    pub time: f64,
}

/// Writes a page, atomically by rename. The output is deterministic.
///
/// # Errors
/// [`Error::Input`] for a scene that a network moves, and for more than [`MOST_GAUSSIANS`]; else as for
/// [`compact::write`].
pub fn write(path: impl AsRef<Path>, scene: &Scene, opening: &Opening) -> Result<()> {
    if scene.moves() && scene.network.is_some() {
        let what =
            "a page plays control points with paths; bake the network's motion into paths first";
        return Err(Error::Input(what.into()));
    }
    let count = scene.gaussians.len();
    if count > MOST_GAUSSIANS {
        let what =
            format!("{count} Gaussians are more than the {MOST_GAUSSIANS} that a page plays");
        return Err(Error::Input(what));
    }
    let page = page(scene, opening)?;
    io::write_atomically(path, |sink| sink.write_all(page.as_bytes()))
}

fn page(scene: &Scene, opening: &Opening) -> Result<String> {
    // The report is left out: the player does not use it, and it may describe the machine that made
    // the scene.
    let scene = Scene { report: Value::Null, ..scene.clone() };
    let about = json!({
        "start": camera(&opening.start),
        "distance": opening.distance,
        "time": opening.time,
    });
    let parts = [
        ("licences", LICENCES.to_owned()),
        ("generator", concat!("splat4d ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("title", escaped(&opening.title)),
        ("style", STYLE.to_owned()),
        ("about", about.to_string()),
        ("scene", STANDARD.encode(compact::encoded(&scene)?)),
        ("sorter", STANDARD.encode(SORTER)),
        ("player", STANDARD.encode(PLAYER)),
        ("unpack", UNPACK.to_owned()),
    ];
    Ok(filled(PAGE, &parts))
}

/// Fills the placeholders of the template; placeholders inside inserted parts are not replaced.
fn filled(template: &str, parts: &[(&str, String)]) -> String {
    let mut out = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        let (name, after) = after.split_once("}}").expect("the template closes its braces");
        let (_, part) = parts.iter().find(|(known, _)| *known == name).expect("a part is missing");
        out.push_str(before);
        out.push_str(part);
        rest = after;
    }
    out + rest
}

/// A camera as JSON for the player and the viewer.
fn camera(camera: &Camera) -> Value {
    let (k, pose) = (&camera.intrinsics, &camera.view_from_world);
    let (q, t) = (pose.rotation, pose.translation);
    json!({
        "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": k.width, "height": k.height,
        "view_from_world": [q.w, q.x, q.y, q.z, t.x, t.y, t.z],
    })
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_part_holds_is_not_a_part_itself() {
        let parts = [("a", "{{b}} <".to_owned()), ("b", String::new())];
        assert_eq!(filled("x{{a}}y{{b}}z", &parts), "x{{b}} <yz");
    }

    #[test]
    fn a_page_holds_its_parts_and_no_name_breaks_it() {
        let opening = Opening {
            title: "</title><script>{{scene}} & more".into(),
            start: Camera {
                intrinsics: crate::types::Intrinsics::centred(90.0, 100, 80),
                view_from_world: crate::types::Pose::IDENTITY,
            },
            distance: 2.5,
            time: 0.25,
        };
        let page = page(&Scene::default(), &opening).unwrap();
        assert!(page.contains("<title>&lt;/title&gt;&lt;script&gt;{{scene}} &amp; more</title>"));
        assert!(page.contains(&STANDARD.encode(PLAYER)) && page.contains(&STANDARD.encode(SORTER)));
        assert_eq!(page, super::page(&Scene::default(), &opening).unwrap(), "the same bytes");
        // The licences are inside a comment, scripts and style inside elements, so they must not
        // contain the closing tags.
        assert!(!LICENCES.contains("-->") && !UNPACK.contains("</") && !STYLE.contains("</"));
        for name in ["three 0", "@sparkjsdev/spark", "fflate", "fzstd"] {
            assert!(LICENCES.contains(name) && page.contains(name), "{name}");
        }
    }
}
