//! The static files of the page.

use axum::http::header::{
    CACHE_CONTROL, CONNECTION, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, REFERRER_POLICY,
    X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// The page's files: path, media type, content.
const FILES: [(&str, &str, &str); 12] = [
    ("", HTML, include_str!("page/index.html")),
    ("base.css", CSS, include_str!("page/base.css")),
    ("style.css", CSS, include_str!("page/style.css")),
    ("main.js", SCRIPT, include_str!("page/main.js")),
    ("camera.js", SCRIPT, include_str!("page/camera.js")),
    ("keyframes.js", SCRIPT, include_str!("page/keyframes.js")),
    ("keys.js", SCRIPT, include_str!("page/keys.js")),
    ("link.js", SCRIPT, include_str!("page/link.js")),
    ("overlay.js", SCRIPT, include_str!("page/overlay.js")),
    ("pointer.js", SCRIPT, include_str!("page/pointer.js")),
    ("training.js", SCRIPT, include_str!("page/training.js")),
    ("timeline.js", SCRIPT, include_str!("page/timeline.js")),
];

/// Headers of every response: nothing is loaded from elsewhere, no page may frame the viewer or read its
/// parts, its URL is not sent as a referrer, and nothing is cached.
const HEADERS: [(HeaderName, &str); 7] = [
    (
        CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; \
         connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
    (REFERRER_POLICY, "no-referrer"),
    (CACHE_CONTROL, "no-store"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
];

/// A file of the page.
pub fn file(path: &str) -> Option<Response> {
    let (_, kind, content) = FILES.iter().find(|(name, ..)| *name == path)?;
    Some(([(CONTENT_TYPE, *kind)], *content).into_response())
}

/// Adds the common headers to a response. Except for a socket's, a response closes its connection.
pub fn guarded(mut response: Response) -> Response {
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    if response.status() != StatusCode::SWITCHING_PROTOCOLS {
        response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    }
    response
}
