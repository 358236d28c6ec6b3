//! A scene as one page that plays it, written only: in any browser with WebGL 2, from a file as well, and
//! nothing is loaded from elsewhere.
//!
//! The page holds the scene in its [`compact`] form, and a player, which `tools/player` builds: Spark on
//! three.js, which sort and draw, and the skinning of what moves. The player moves control points by their
//! paths; where a network moves them, paths are to take its place first.

use std::io::Write;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

use super::{Scene, compact};
use crate::types::Camera;
use crate::{Error, Result, io};

const PAGE: &str = include_str!("page.html");
/// What it shares with the viewer's page first.
const STYLE: &str = concat!(include_str!("../../view/page/base.css"), include_str!("style.css"));
const UNPACK: &str = include_str!("unpack.js");
/// What the player is made of, by others.
const LICENCES: &str = include_str!("licences.txt");
/// The player's script, through gzip.
const PLAYER: &[u8] = include_bytes!("player.js.gz");
/// Spark's module that sorts, through gzip.
const SORTER: &[u8] = include_bytes!("sorter.wasm.gz");
/// Most Gaussians of a page, which then has some 100 MB.
pub const MOST_GAUSSIANS: usize = 1 << 22;

/// How a page begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Opening {
    /// The page's title.
    pub title: String,
    /// Where the viewer stands, and its lens.
    pub start: Camera,
    /// From there to what it looks at, in the scene's units.
    pub distance: f64,
    /// The time, in [0, 1].
    pub time: f64,
}

/// Writes a page by rename. The same scene and opening give the same bytes.
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
    // The player has no use for it, and it may tell of the machine that the scene was made on.
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

/// The template with its parts; what a part holds is not looked at again.
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

/// As the player and the viewer know a camera.
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
        // The licences stand in a comment, scripts and style in elements.
        assert!(!LICENCES.contains("-->") && !UNPACK.contains("</") && !STYLE.contains("</"));
        for name in ["three 0", "@sparkjsdev/spark", "fflate", "fzstd"] {
            assert!(LICENCES.contains(name) && page.contains(name), "{name}");
        }
    }
}
