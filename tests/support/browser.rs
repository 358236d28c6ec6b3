//! Headless Chromium, controlled over its DevTools protocol. A missing Chromium fails.

// Each test binary uses its own part.
#![allow(dead_code)]

use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use tempfile::TempDir;
use tungstenite::{Message, WebSocket};

/// A large scene on SwiftShader takes minutes for its first image where other programs use the processors.
const PATIENCE: Duration = Duration::from_secs(300);

/// A page in a separate browser process.
pub struct Browser {
    child: Child,
    socket: WebSocket<TcpStream>,
    session: Option<String>,
    calls: u64,
    /// The page's console output and errors.
    pub said: Vec<String>,
    _profile: TempDir,
}

impl Browser {
    /// Opens a page in a window of `width` × `height`, with one device pixel per CSS pixel.
    pub fn open(url: &str, width: u32, height: u32) -> Browser {
        Browser::launch(url, width, height, &["--disable-gpu"])
    }

    /// Opens a file that draws with WebGL, on Chromium's bundled SwiftShader.
    pub fn open_drawing(file: &Path, width: u32, height: u32) -> Browser {
        let flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
        Browser::launch(&address(file), width, height, &flags)
    }

    fn launch(url: &str, width: u32, height: u32, flags: &[&str]) -> Browser {
        let profile = tempfile::tempdir().unwrap();
        let program = std::env::var("SPLAT4D_CHROMIUM").unwrap_or("chromium".into());
        let child = Command::new(&program)
            .args(["--headless=new", "--no-sandbox", "--disable-dev-shm-usage"])
            .args(flags)
            // The Vulkan driver selected for the tests is not meant for the browser, which has its own.
            .env_remove("VK_DRIVER_FILES")
            .args([
                "--no-first-run",
                "--disable-background-networking",
                "--remote-debugging-port=0",
            ])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|e| panic!("tests of pages need {program} (Debian: chromium): {e}"));
        let told = profile.path().join("DevToolsActivePort");
        let address = until("Chromium's port", || {
            let text = std::fs::read_to_string(&told).ok()?;
            let (port, path) = text.split_once('\n')?;
            (!path.is_empty()).then(|| (port.to_owned(), path.trim().to_owned()))
        });
        let stream = TcpStream::connect(format!("127.0.0.1:{}", address.0)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let url_of_tools = format!("ws://127.0.0.1:{}{}", address.0, address.1);
        let (socket, _) = tungstenite::client(url_of_tools, stream).unwrap();
        let said = Vec::new();
        let mut browser =
            Browser { child, socket, session: None, calls: 0, said, _profile: profile };
        let target = browser.call("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let attached = browser.call("Target.attachToTarget", attach);
        browser.session = Some(attached["sessionId"].as_str().unwrap().to_owned());
        for domain in ["Page", "Runtime", "Log", "Network"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser.resize(width, height);
        browser.call("Page.navigate", json!({ "url": url }));
        browser.wait_for("location.href !== 'about:blank' && document.readyState === 'complete'");
        browser
    }

    /// Opens a file in a window of `width` × `height`.
    pub fn open_file(file: &Path, width: u32, height: u32) -> Browser {
        Browser::open(&address(file), width, height)
    }

    /// The number of pixels by which the page is wider than a window of `width`.
    #[track_caller]
    pub fn overflow(&mut self, width: u32) -> i64 {
        self.resize(width, 700);
        let root = "document.documentElement";
        self.evaluate(&format!("{root}.scrollWidth - {root}.clientWidth")).as_i64().unwrap()
    }

    pub fn resize(&mut self, width: u32, height: u32) {
        let metrics = json!({
            "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600,
        });
        self.call("Emulation.setDeviceMetricsOverride", metrics);
    }

    /// Calls a method of the protocol.
    #[track_caller]
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.calls += 1;
        let mut message = json!({ "id": self.calls, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.socket.send(Message::text(message.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let mut answer: Value = serde_json::from_str(&text).unwrap();
            if answer["id"] == json!(self.calls) {
                assert!(answer.get("error").is_none(), "{method}: {}", answer["error"]);
                return answer["result"].take();
            }
            self.listen(&answer);
        }
    }

    fn listen(&mut self, event: &Value) {
        let loud = ["Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"];
        if event["method"].as_str().is_some_and(|method| loud.contains(&method)) {
            self.said.push(event["params"].to_string());
        }
        // The page must not request anything from another host.
        let url = event["params"]["request"]["url"].as_str().unwrap_or_default();
        if event["method"] == "Network.requestWillBeSent"
            && !["http://127.0.0.1:", "file:", "data:", "blob:", "about:"]
                .iter()
                .any(|own| url.starts_with(own))
        {
            self.said.push(format!("asks for {url}"));
        }
    }

    /// The value of an expression, which may be a promise.
    #[track_caller]
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let call = json!({
            "expression": expression, "awaitPromise": true, "returnByValue": true,
        });
        let mut answer = self.call("Runtime.evaluate", call);
        assert!(answer.get("exceptionDetails").is_none(), "{expression}: {answer}");
        answer["result"]["value"].take()
    }

    /// Waits until an expression is true.
    #[track_caller]
    pub fn wait_for(&mut self, expression: &str) {
        let begun = Instant::now();
        while self.evaluate(&format!("Boolean({expression})")) != json!(true) {
            assert!(
                begun.elapsed() < PATIENCE,
                "{expression} does not become true: {:?}",
                self.said
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Sends a mouse event; `button` is `left` or `right`.
    pub fn mouse(&mut self, kind: &str, x: f64, y: f64, button: &str) {
        // The page gets no `pointerdown` if the held buttons include another one than `button`.
        let held = if button == "right" { 2 } else { 1 };
        let buttons = if kind == "mouseReleased" { 0 } else { held };
        let event = json!({
            "type": kind, "x": x, "y": y, "button": button, "buttons": buttons, "clickCount": 1,
        });
        self.call("Input.dispatchMouseEvent", event);
    }

    /// Drags with the left button, in steps.
    pub fn drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        self.mouse("mousePressed", from[0], from[1], "left");
        for step in 1..=4 {
            let share = f64::from(step) / 4.0;
            let at = [0, 1].map(|k| from[k] + (to[k] - from[k]) * share);
            self.mouse("mouseMoved", at[0], at[1], "left");
        }
        self.mouse("mouseReleased", to[0], to[1], "left");
    }

    /// Presses a key and releases it after `milliseconds`; `text` is the text that the key types.
    pub fn key(&mut self, key: &str, code: u32, text: &str, milliseconds: u64) {
        let event = |kind: &str| json!({ "type": kind, "key": key, "windowsVirtualKeyCode": code, "text": text });
        self.call(
            "Input.dispatchKeyEvent",
            event(if text.is_empty() { "rawKeyDown" } else { "keyDown" }),
        );
        std::thread::sleep(Duration::from_millis(milliseconds));
        self.call("Input.dispatchKeyEvent", event("keyUp"));
    }

    /// A screenshot of the page, as PNG.
    pub fn screenshot(&mut self) -> Vec<u8> {
        let shot = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        STANDARD.decode(shot["data"].as_str().unwrap()).unwrap()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Closed over the protocol, the browser also ends its child processes.
        let close = json!({ "id": 0, "method": "Browser.close" }).to_string();
        let _ = self.socket.send(Message::text(close));
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(5) && matches!(self.child.try_wait(), Ok(None))
        {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The `file://` URL of a file.
fn address(file: &Path) -> String {
    format!("file://{}", file.canonicalize().unwrap().display())
}

fn until<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(begun.elapsed() < PATIENCE, "{what} does not come");
        std::thread::sleep(Duration::from_millis(20));
    }
}
