//! A headless Chromium that opens a page by itself. Its absence fails.

// Each test binary uses its own part.
#![allow(dead_code)]

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// What a browser made of a page.
pub struct Opened {
    /// The document after its scripts have run for a while.
    pub dom: String,
    /// What the page said on the console, line by line.
    pub console: Vec<String>,
}

/// Opens a file of a folder, lets virtual milliseconds pass, and gives what became of it.
#[track_caller]
pub fn open(file: &Path, milliseconds: u32, options: &[&str]) -> Opened {
    let home = tempfile::tempdir().unwrap();
    let output = Command::new("chromium")
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"])
        .args(["--no-first-run", "--enable-logging=stderr", "--dump-dom"])
        .arg(format!("--user-data-dir={}", home.path().display()))
        .arg(format!("--virtual-time-budget={milliseconds}"))
        .args(options)
        .arg(format!("file://{}", fs::canonicalize(file).unwrap().display()))
        .stdin(Stdio::null())
        .output()
        .expect("chromium is needed: apt-get install chromium");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "chromium failed: {said}");
    let console = said.lines().filter(|line| line.contains("CONSOLE")).map(str::to_owned);
    Opened { dom: String::from_utf8(output.stdout).unwrap(), console: console.collect() }
}

/// By how many pixels a page is wider than a window of some width.
#[track_caller]
pub fn overflow(file: &Path, width: u32) -> i64 {
    let folder = tempfile::tempdir().unwrap();
    let tell = "<script>addEventListener('load',()=>parent.postMessage(\
                document.documentElement.scrollWidth-document.documentElement.clientWidth,'*'))</script>";
    let page = fs::read_to_string(file).unwrap().replace("</body>", &format!("{tell}</body>"));
    fs::write(folder.path().join("page.html"), page).unwrap();
    // A window has a least width; a frame has none.
    let frame = format!(
        "<!doctype html><body><script>onmessage=e=>document.body.dataset.over=e.data</script>\
         <iframe style=\"width:{width}px;height:700px;border:0\" src=\"page.html\"></iframe></body>"
    );
    let wrapper = folder.path().join("wrapper.html");
    fs::write(&wrapper, frame).unwrap();
    let dom = open(&wrapper, 3000, &[]).dom;
    let told = dom.split("data-over=\"").nth(1).and_then(|rest| rest.split('"').next());
    told.and_then(|told| told.parse().ok()).unwrap_or_else(|| panic!("no width was told: {dom}"))
}
