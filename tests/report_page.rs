//! The HTML reports of `--report`, in a browser.

#![cfg(feature = "cli")]

#[path = "support/browser.rs"]
mod browser;
#[path = "support/program.rs"]
mod program;
mod support;

use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use browser::Browser;
use serde_json::{Value, json};
use support::says;

/// The values of all attributes of a name, in order.
fn attributes<'a>(page: &'a str, name: &str) -> Vec<&'a str> {
    let begin = format!("{name}=\"");
    page.split(begin.as_str()).skip(1).filter_map(|rest| rest.split('"').next()).collect()
}

#[test]
fn a_reconstruction_is_told_on_a_page() {
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), "synth rigid -o clip --frames 8 --size 96x54 --seed 3");
    let arguments = "reconstruct clip/frames -o scene.safetensors --steps 90 --max-gaussians 900 \
                     --control-points 12 --report report";
    let report = program::json(folder.path(), arguments);
    let file = folder.path().join("report/report.html");
    let page = fs::read_to_string(&file).unwrap();

    // The page loads nothing from elsewhere, and shows no NaN.
    for address in attributes(&page, " src").into_iter().chain(attributes(&page, " href")) {
        assert!(address.starts_with("data:"), "{}", &address[..address.len().min(80)]);
    }
    assert!(!page.contains("@import") && !page.contains("url("));
    // Encoded images are removed first: they may contain any letters.
    let words: String = page
        .split("src=\"")
        .map(|part| part.split_once('"').map_or(part, |(_, text)| text))
        .collect();
    assert!(words.len() < page.len() / 2 && words.contains("dB"));
    assert!(!words.contains("NaN") && !words.contains(">inf"), "something is no number");
    assert!(page.len() < 4 << 20, "{} bytes", page.len());

    // The page shows all results.
    let psnr = format!("{:.2} dB", report["psnr_input"].as_f64().unwrap());
    says(&page, &["8 frames of 96×54", &psnr, "Input", "Render", "Error", "What moves", "Depth"]);
    says(&page, &["From aside", "From above, with static points", "Doubtful frames"]);
    says(&page, &["What was modelled, and what was left out", "Time and memory", "The command"]);
    says(&page, &["splat4d reconstruct clip/frames -o scene.safetensors --steps 90"]);
    for choice in report["model"].as_array().unwrap() {
        let text = choice["because"].as_str().unwrap().replace('\'', "&#39;");
        says(&page, &[choice["what"].as_str().unwrap(), &text]);
    }
    for stage in report["seconds"].as_object().unwrap().keys() {
        says(&page, &[&format!("<th>{stage}</th>")]);
    }
    // Five lanes of eight frames, and an orbit.
    assert_eq!(page.matches("<img ").count(), 5 * 8 + 24);
    // Loss, PSNR and number of Gaussians are plotted, and stored as numbers.
    assert_eq!(page.matches("<svg width").count(), 3);
    let written: Value =
        serde_json::from_slice(&fs::read(folder.path().join("report/report.json")).unwrap())
            .unwrap();
    let training = written["training"].as_array().unwrap();
    assert!(training.len() >= 60 && report.get("training").is_none(), "{}", training.len());
    let (first, last) = (&training[0], &training[training.len() - 1]);
    let number = |of: &Value, key: &str| of[key].as_f64().unwrap();
    assert!(number(last, "psnr") > number(first, "psnr") + 1.0, "{first} {last}");
    assert!(number(last, "l1") < number(first, "l1"), "{first} {last}");
    assert_eq!((last["phase"].as_str(), &last["gaussians"]), (Some("joint"), &report["gaussians"]));
    assert!((number(last, "psnr") - report["psnr_input"].as_f64().unwrap()).abs() < 6.0, "{last}");

    // A browser opens the page without errors and plays it.
    let mut opened = Browser::open_file(&file, 1280, 900);
    let players = "[...document.querySelectorAll('[data-at]')].map(player => +player.dataset.at)";
    assert_eq!(opened.evaluate(players).as_array().unwrap().len(), 2);
    for player in 0..2 {
        // The player may have wrapped around to its first image.
        opened.wait_for(&format!("{players}[{player}] > 0"));
    }
    let seen = "[...document.images].filter(picture => picture.offsetParent).length";
    assert_eq!(opened.evaluate(seen), json!(5 + 1), "one image of each lane is seen");
    let broken = "[...document.querySelectorAll('dt')].filter(name => { const text = document.createRange(); \
        text.selectNodeContents(name); \
        return !name.textContent.includes(' ') && text.getClientRects().length > 1; \
        }).map(name => name.textContent)";
    for width in [320, 360, 768, 1280] {
        assert_eq!(opened.overflow(width), 0, "at {width} pixels");
        assert_eq!(opened.evaluate(broken), json!([]), "words on two lines at {width} pixels");
    }
    let less = json!({ "features": [{ "name": "prefers-reduced-motion", "value": "reduce" }] });
    opened.call("Emulation.setEmulatedMedia", less);
    opened.call("Page.reload", json!({}));
    std::thread::sleep(std::time::Duration::from_secs(3));
    assert_eq!(opened.evaluate(players), json!([0, 0]), "who wants less motion gets it");
    assert!(opened.said.is_empty(), "{:?}", opened.said);
}

#[test]
fn a_training_is_told_on_a_page_from_its_first_step_though_it_was_resumed() {
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), "synth rigid -o clip --frames 8 --size 96x54 --seed 3");
    let arguments = "train clip/truth -o scene.safetensors --steps 300 --random-points 400 \
                     --control-points 12 --eval-every 4 --report report";
    // Ctrl-C as soon as a checkpoint of the second stage exists.
    let kept = folder.path().join("scene.safetensors.checkpoint/training");
    let mut child = program::program()
        .current_dir(folder.path())
        .args(arguments.split_whitespace())
        .args(["--checkpoint-every", "1e-9", "--device", "software"])
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    while !kept.exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended without a checkpoint");
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(1500));
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    lines.by_ref().for_each(drop);
    assert_eq!(child.wait().unwrap().code(), Some(130));

    let report = program::json(folder.path(), &format!("{arguments} --resume"));
    let file = folder.path().join("report/report.html");
    let page = fs::read_to_string(&file).unwrap();
    let psnr = format!("{:.2} dB", report["psnr_test"].as_f64().unwrap());
    says(&page, &["splat4d train: truth", &psnr, "2 that were held out", "400 Gaussians"]);
    says(&page, &["Images that were held out", "From aside", "Where the cameras are"]);
    says(&page, &["What was modelled, and what was left out", "Time and memory", "--resume"]);
    assert!(!page.contains("what lay before it is not shown"), "the whole curve is there");
    let words: String = page
        .split("src=\"")
        .map(|part| part.split_once('"').map_or(part, |(_, text)| text))
        .collect();
    assert!(!words.contains("NaN") && !words.contains(">inf"), "something is no number");
    assert_eq!(page.matches("<svg width").count(), 3, "loss, PSNR, Gaussians");
    let written: Value =
        serde_json::from_slice(&fs::read(folder.path().join("report/report.json")).unwrap())
            .unwrap();
    let training = written["training"].as_array().unwrap();
    // In the first tenth of the steps the scene is static.
    let steps: Vec<(&str, u64)> = training
        .iter()
        .map(|m| (m["phase"].as_str().unwrap(), m["step"].as_u64().unwrap()))
        .collect();
    let expected: Vec<(&str, u64)> = (1..=30)
        .map(|step| ("static", step))
        .chain((1..=67).map(|i| ("joint", 4 * i)))
        .chain([("joint", 270)])
        .collect();
    assert_eq!(steps, expected);

    let mut opened = Browser::open_file(&file, 1280, 900);
    for width in [320, 360, 768, 1280] {
        assert_eq!(opened.overflow(width), 0, "at {width} pixels");
    }
    let seen = "[...document.images].filter(picture => picture.offsetParent).length";
    assert_eq!(opened.evaluate(seen), json!(5 + 1), "one image of each lane is seen");
    assert!(opened.said.is_empty(), "{:?}", opened.said);
}

#[test]
fn a_console_message_would_be_seen() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bad.html");
    let page = "<meta name=\"viewport\" content=\"width=device-width\">\
                <body><div style=\"width:900px\">x</div><script>nothing()</script></body>";
    fs::write(&file, page).unwrap();
    let mut opened = Browser::open_file(&file, 360, 700);
    assert!(opened.overflow(360) > 500);
    assert!(opened.said.len() == 1 && opened.said[0].contains("nothing"), "{:?}", opened.said);
}

#[test]
fn the_tracks_page_has_nothing_to_say_either() {
    let folder = tempfile::tempdir().unwrap();
    program::json(folder.path(), "synth rigid -o clip --frames 6 --size 96x54 --seed 4");
    program::json(folder.path(), "track clip/frames -o tracked");
    let file = folder.path().join("tracked/report.html");
    let mut opened = Browser::open_file(&file, 1280, 900);
    for width in [360, 1280] {
        assert_eq!(opened.overflow(width), 0, "at {width} pixels");
        let lines = opened.evaluate("document.querySelector('.scale').offsetHeight");
        assert!(lines.as_f64() < Some(80.0), "a legend {lines} pixels high at {width} pixels");
    }
    assert!(opened.said.is_empty(), "{:?}", opened.said);
}
