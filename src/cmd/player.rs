//! Image sequences that play on a page: one lane or several synchronised lanes side by side.

use std::fmt::Write;

use splat4d::report::escape;

/// Duration of an image, milliseconds.
const EACH: u32 = 140;

/// CSS rules that a page with players needs.
pub const STYLE: &str = "\
.lanes{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(9.5rem,100%),1fr));gap:.5rem}\
.lanes.one{max-width:40rem;grid-template-columns:1fr}\
.lanes figcaption{padding:.1rem 0 .3rem}.lanes img{width:100%;height:auto;display:block}\
.lanes img[hidden]{display:none}\
.controls{display:flex;gap:.7rem;align-items:center;flex-wrap:wrap;margin:.5rem 0}\
.controls input{flex:1 1 9rem;min-width:0;max-width:40rem;accent-color:var(--one)}\
.controls button{font:inherit;min-width:4.5rem;padding:.25rem .6rem;color:inherit;background:var(--faint);\
border:1px solid var(--dim);border-radius:4px;cursor:pointer}\
.controls output{color:var(--dim);font-size:13px;font-variant-numeric:tabular-nums}";

/// Script that plays them, to be placed after them. Without it, the first images are shown. If the system
/// requests reduced motion, they start paused.
pub fn script() -> String {
    format!("<script>{}</script>\n", SCRIPT.replace("EACH", &EACH.to_string()))
}

const SCRIPT: &str = "\
for(const player of document.querySelectorAll('.player')){\
const lanes=[...player.querySelectorAll('figure')].map(f=>[...f.querySelectorAll('img')]),\
slider=player.querySelector('input'),button=player.querySelector('button'),told=player.querySelector('output');\
let timer=0;\
const show=at=>{for(const lane of lanes)lane.forEach((image,i)=>image.hidden=i!==at);\
slider.value=at;told.value=lanes[0][at].dataset.name;player.dataset.at=at},\
play=on=>{clearInterval(timer);timer=on?setInterval(()=>show((+slider.value+1)%lanes[0].length),EACH):0;\
button.textContent=on?'Pause':'Play'};\
button.onclick=()=>play(!timer);slider.oninput=()=>{play(false);show(+slider.value)};\
player.querySelector('.controls').hidden=false;show(0);\
play(!matchMedia('(prefers-reduced-motion: reduce)').matches)}";

/// Images of one kind, as URLs.
pub struct Lane {
    pub title: String,
    pub pictures: Vec<String>,
}

/// Adds lanes; each has as many images as there are names.
pub fn draw(body: &mut String, what: &str, lanes: &[Lane], names: &[String]) {
    let Some(last) = names.len().checked_sub(1) else { return };
    let one = if lanes.len() == 1 { " one" } else { "" };
    let _ = write!(body, "<div class=\"player\"><div class=\"lanes{one}\">");
    for Lane { title, pictures } in lanes {
        body.push_str("<figure>");
        for (i, (picture, name)) in pictures.iter().zip(names).enumerate() {
            let (hidden, name) = (if i > 0 { " hidden" } else { "" }, escape(name));
            let title = escape(title);
            let _ = write!(
                body,
                "<img src=\"{picture}\" alt=\"{title}, {name}\" data-name=\"{name}\"{hidden}>"
            );
        }
        let _ = write!(body, "<figcaption>{}</figcaption></figure>", escape(title));
    }
    let what = escape(what);
    let _ = writeln!(
        body,
        "</div><div class=\"controls\" hidden><button type=\"button\">Play</button>\
         <input type=\"range\" min=\"0\" max=\"{last}\" value=\"0\" aria-label=\"{what}\">\
         <output></output></div></div>"
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_picture_of_each_lane_is_seen_without_a_script() {
        let lane = |title: &str| Lane { title: title.into(), pictures: vec!["data:,".into(); 3] };
        let names = ["a<b", "b", "c"].map(String::from);
        let mut body = String::new();
        draw(&mut body, "frames", &[lane("input"), lane("render")], &names);
        assert_eq!((body.matches("<img").count(), body.matches("hidden>").count()), (6, 5));
        assert!(body.contains("a&lt;b") && body.contains("max=\"2\""), "{body}");
        let mut none = String::new();
        draw(&mut none, "frames", &[lane("input")], &[]);
        assert!(none.is_empty());
    }
}
