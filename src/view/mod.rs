//! A scene in the browser: a page, and what serves it.
//!
//! [`Server::start`] puts a scene on a device and serves a page that shows it. One thread owns the
//! renderer, and the clients take turns at it. A client asks for pictures over a WebSocket; of each client
//! at most one request waits, the newest, and no picture is made while the one before has not been taken:
//! nothing queues, however slow a reader is. [`protocol`] describes the messages.
//!
//! [`Server::live`] serves a scene that is being trained, as [`Live`] hands it over, and tells how far the
//! training is. Making pictures takes at most half of the time then, whatever clients ask for.
//!
//! What may be asked is bounded: sides and pixels of a picture, the length of a message, messages a
//! second, clients and connections at a time. Beside the page, the scene's description and the input's
//! pictures, nothing is served, and these by number: no request names a path of the machine. A request must
//! name this server as its `Host`, and a page of this server as its `Origin` where it has one, so that no
//! other page in the browser can reach it, whatever its name resolves to. On an address that others
//! reach, the page's address holds a random token, without which nothing is served.

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

/// Most sockets at a time: pages that show the scene.
pub const MOST_CLIENTS: usize = 16;
/// Most connections at a time that ask for a part of the page.
pub const MOST_CONNECTIONS: usize = 32;
/// Most pixels along a side of a picture.
pub const MOST_SIDE: u32 = 4096;
/// Most pixels of a picture.
pub const MOST_PIXELS: u64 = 3840 * 2160;
/// Most pixels of a picture of a training under way, which is not to wait for it long.
pub const MOST_LIVE_PIXELS: u64 = 1280 * 720;
/// Bytes of the longest message that a client may send.
pub const MOST_MESSAGE: usize = 4096;
/// Messages of a client that are read in a second; more wait in the network.
pub const MOST_MESSAGES_A_SECOND: u32 = 120;

/// What is shown.
pub struct Show {
    /// What the page calls it.
    pub name: String,
    /// The scene.
    pub scene: Scene,
    /// Accuracy given up for speed.
    pub tuning: Tuning,
    /// Where the viewer begins.
    pub start: Camera,
    /// From there to what it looks at, in the scene's units.
    pub distance: f64,
    /// The input's pictures, to be shown beside the scene.
    pub pictures: Option<Pictures>,
}
