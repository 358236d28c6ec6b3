//! A browser viewer: a page, and the server for it.
//!
//! [`Server::start`] loads a scene on a device and serves a page that shows it. One thread owns the
//! renderer, and the clients take turns. A client requests images over a WebSocket. At most one request per
//! client waits, the newest one, and no image is rendered before the client has taken the previous one, so
//! that nothing queues however slow a reader is. [`protocol`] describes the messages.
//!
//! [`Server::live`] serves a scene that is being trained, as [`Live`] hands it over, and reports the
//! progress of the training. Rendering then takes at most half of the time, whatever clients request.
//!
//! All requests are bounded: sides and pixels of an image, length of a message, messages per second, number
//! of clients and connections. Besides the page, only the scene's description and the input images are
//! served, and these by number, so that no request names a path on this machine. A request must have this
//! server's name as its `Host`, and, if it has an `Origin`, a page of this server, so that no other page in
//! the browser can reach it, whatever its name resolves to. On an address that other machines can reach,
//! the page's URL contains a random token, without which nothing is served.

mod described;
mod guard;
mod live;
mod page;
mod painter;
mod pictures;
mod port;
pub mod protocol;
mod server;
mod socket;
mod turns;

pub use live::Live;
pub use pictures::Pictures;
pub use server::{Options, Server};

use crate::scene::Scene;
use crate::types::{Camera, Tuning};

/// Maximum number of concurrent sockets, one per open page.
pub const MOST_CLIENTS: usize = 16;
/// Maximum number of concurrent connections that request parts of the page.
pub const MOST_CONNECTIONS: usize = 32;
/// Maximum side of an image, pixels.
pub const MOST_SIDE: u32 = 4096;
/// Maximum number of pixels of an image.
pub const MOST_PIXELS: u64 = 3840 * 2160;
/// Maximum number of pixels of an image while a training is in progress, which bounds the training's delay.
pub const MOST_LIVE_PIXELS: u64 = 1280 * 720;
/// Maximum length of a client's message, bytes.
pub const MOST_MESSAGE: usize = 4096;
/// Maximum number of messages that are read per client and second; more wait in the network.
pub const MOST_MESSAGES_A_SECOND: u32 = 120;

/// A scene to show.
pub struct Show {
    /// Name on the page.
    pub name: String,
    /// The scene.
    pub scene: Scene,
    /// Settings that trade accuracy for speed.
    pub tuning: Tuning,
    /// Initial camera of the viewer.
    pub start: Camera,
    /// Distance from it to the point that it looks at, in scene units.
    pub distance: f64,
    /// Input images, shown beside the scene.
    pub pictures: Option<Pictures>,
}
