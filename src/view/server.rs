//! The server: threads, connections, and routing of requests.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{FromRequestParts, Request, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, watch};
use tokio::time::{sleep, timeout};

use super::described::{self, Described};
use super::guard::Guard;
use super::live::Live;
use super::painter::Painter;
use super::protocol::{Refusal, Request as Asked};
use super::turns::{Answer, Turns};
use super::{
    MOST_CLIENTS, MOST_CONNECTIONS, MOST_LIVE_PIXELS, MOST_MESSAGE, Pictures, Show, page, port,
    socket,
};
use crate::gpu::Device;
use crate::{Error, Result};

/// Time limit of a connection for its request; sockets are exempt.
const MOST_ASKING: Duration = Duration::from_secs(30);
/// Time limit for a request's head.
const MOST_HEAD: Duration = Duration::from_secs(10);
/// Maximum size of a request's head, bytes.
const MOST_HEAD_BYTES: usize = 16 << 10;
/// Maximum time that a shutdown waits for pending responses.
const FAREWELL: Duration = Duration::from_millis(500);

/// Where the server listens.
#[derive(Clone, Debug)]
pub struct Options {
    /// The address to listen on; on one that is not a loopback address, the page's URL contains a token.
    pub host: IpAddr,
    /// The port, or the next free one if it is in use; 0 selects any.
    pub port: u16,
}

impl Default for Options {
    fn default() -> Options {
        Options { host: Ipv4Addr::LOCALHOST.into(), port: 8090 }
    }
}

/// A server that runs until it is dropped.
pub struct Server {
    url: String,
    port: u16,
    turns: Arc<Turns>,
    stop: watch::Sender<bool>,
    network: Option<JoinHandle<()>>,
    painting: Option<JoinHandle<Result<()>>>,
}

/// The state that requests are answered from.
struct Desk {
    guard: Guard,
    description: Described,
    turns: Arc<Turns>,
    live: Option<Live>,
    clients: Arc<Semaphore>,
    /// One input image is decoded at a time, to bound memory.
    decoding: Arc<Semaphore>,
}

impl Server {
    /// Loads the scene on the device and starts the server.
    ///
    /// # Errors
    /// [`Error::Input`] where it cannot listen; those of
    /// [`Renderer::tuned`](crate::renderer::Renderer::tuned); a thread cannot be started.
    pub fn start(device: &Device, show: Show, options: &Options) -> Result<Server> {
        let listener = port::listen(options.host, options.port)?;
        let description = described::of(&device.info().name, &show, false);
        let turns = Arc::new(Turns::default());
        let easel = Easel {
            device: device.clone(),
            painter: Some(Painter::new(device, &show)?),
            description: Described::new(&description, show.pictures.unwrap_or_default())?,
            live: None,
        };
        Server::serve(listener, easel, turns)
    }

    /// Starts a server for a scene called `name` that is being trained on the device. It serves what the
    /// [`Live`] handle receives.
    ///
    /// # Errors
    /// [`Error::Input`] where it cannot listen; a thread cannot be started.
    pub fn live(device: &Device, name: &str, options: &Options) -> Result<(Server, Live)> {
        let listener = port::listen(options.host, options.port)?;
        let turns = Arc::new(Turns::default());
        let nothing = described::nothing(&device.info().name, name);
        let description = Described::new(&nothing, Pictures::default())?;
        let live = Live::new(turns.clone(), &device.info().name, description.clone());
        let easel =
            Easel { device: device.clone(), painter: None, description, live: Some(live.clone()) };
        Ok((Server::serve(listener, easel, turns)?, live))
    }

    fn serve(listener: std::net::TcpListener, easel: Easel, turns: Arc<Turns>) -> Result<Server> {
        let address = listener.local_addr().map_err(Error::io("the socket"))?;
        let guard = Guard::new(address)?;
        let url = guard.url();
        let desk = Arc::new(Desk {
            guard,
            description: easel.description.clone(),
            turns: turns.clone(),
            live: easel.live.clone(),
            clients: Arc::new(Semaphore::new(MOST_CLIENTS)),
            decoding: Arc::new(Semaphore::new(1)),
        });
        let network = || -> std::io::Result<_> {
            listener.set_nonblocking(true)?;
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .max_blocking_threads(1)
                .build()?;
            let listener = {
                let _inside = runtime.enter();
                TcpListener::from_std(listener)?
            };
            Ok((runtime, listener))
        };
        let (runtime, listener) = network().map_err(Error::io("the network"))?;
        let (stop, stopped) = watch::channel(false);
        let thread = |name: &str| std::thread::Builder::new().name(name.into());
        let painting = {
            let turns = turns.clone();
            thread("view: images").spawn(move || easel.paint(&turns))
        };
        let mut server =
            Server { url, port: address.port(), turns, stop, network: None, painting: None };
        // Dropping it ends the thread that has been started.
        server.painting = Some(painting.map_err(Error::io("a thread"))?);
        let network = thread("view: network").spawn(move || {
            runtime.block_on(accept(listener, desk, stopped));
            runtime.shutdown_timeout(FAREWELL);
        });
        server.network = Some(network.map_err(Error::io("a thread"))?);
        Ok(server)
    }

    /// URL of the page, with its token where it has one.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// The port that the server listens on.
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Number of open pages.
    pub fn clients(&self) -> usize {
        self.turns.clients()
    }

    /// Whether the server still renders images; if not, [`stop`](Self::stop) returns the reason.
    pub fn is_serving(&self) -> bool {
        self.painting.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Stops the server.
    ///
    /// # Errors
    /// The reason if it ended earlier: the device was lost.
    pub fn stop(mut self) -> Result<()> {
        self.end()
    }

    fn end(&mut self) -> Result<()> {
        self.turns.close();
        let _ = self.stop.send(true);
        if let Some(network) = self.network.take() {
            let _ = network.join();
        }
        match self.painting.take().map(JoinHandle::join) {
            Some(Ok(done)) => done,
            Some(Err(_)) => Err(Error::Failed("the thread that makes images panicked".into())),
            None => Ok(()),
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

/// The state of the rendering thread.
struct Easel {
    device: Device,
    /// `None` before there is a scene.
    painter: Option<Painter>,
    description: Described,
    live: Option<Live>,
}

impl Easel {
    /// Renders images until the turns are closed. An error of one request is reported to its client; an
    /// error that affects all ends the loop. While a training is in progress, each rendering is followed by
    /// a pause of the same length, so that clients use at most half of the device's time.
    fn paint(mut self, turns: &Turns) -> Result<()> {
        while let Some((client, request)) = turns.next() {
            let begun = Instant::now();
            let answer = match self.picture(&request) {
                Ok(picture) => Answer::Picture(picture),
                Err(error @ (Error::Vulkan { .. } | Error::DeviceLost { .. })) => {
                    turns.close();
                    return Err(error);
                }
                Err(error) => {
                    Answer::Refused(Refusal { id: Some(request.id), error: error.to_string() })
                }
            };
            turns.answer(client, answer);
            if let Some(live) = &self.live {
                live.set_shown();
                if live.is_under_way() {
                    turns.rest(begun.elapsed());
                }
            }
        }
        Ok(())
    }

    /// The answer to a request, from the newest scene.
    fn picture(&mut self, request: &Asked) -> Result<Vec<u8>> {
        if let Some(live) = &self.live {
            let pixels = u64::from(request.camera.width) * u64::from(request.camera.height);
            if pixels > MOST_LIVE_PIXELS {
                return Err(Error::Input(format!(
                    "an image of {}×{} was asked for; at most {MOST_LIVE_PIXELS} pixels are made \
                     while a scene is trained",
                    request.camera.width, request.camera.height
                )));
            }
            if let Some(show) = live.take() {
                // The old scene is dropped first, so that the device need not hold both.
                self.painter = None;
                self.painter = Some(Painter::new(&self.device, &show)?);
            }
        }
        let painter = self.painter.as_mut();
        painter.ok_or_else(|| Error::Input("there is no scene yet".into()))?.paint(request)
    }
}

/// Accepts connections until shutdown. Each connection carries one request, so that closed or idle sockets
/// do not hold a slot.
async fn accept(listener: TcpListener, desk: Arc<Desk>, mut stopped: watch::Receiver<bool>) {
    let places = Arc::new(Semaphore::new(MOST_CONNECTIONS));
    let router = Router::new().fallback(answer).with_state(desk);
    loop {
        let place = places.clone().acquire_owned().await.expect("never closed");
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = stopped.changed() => break,
        };
        let Ok((stream, _)) = accepted else {
            // Out of file descriptors, or the client has disconnected.
            sleep(Duration::from_millis(50)).await;
            continue;
        };
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(router.clone());
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(MOST_HEAD)
            .max_buf_size(MOST_HEAD_BYTES)
            .serve_connection(TokioIo::new(stream), service)
            .with_upgrades();
        tokio::spawn(async move {
            // Errors of a client's connection are ignored.
            let _ = timeout(MOST_ASKING, connection).await;
            drop(place);
        });
    }
    // Leaves time for the sockets' closing messages.
    sleep(FAREWELL / 5).await;
}

/// Answers one request.
async fn answer(State(desk): State<Arc<Desk>>, request: Request) -> Response {
    page::guarded(desk.answer(request).await)
}

impl Desk {
    async fn answer(&self, request: Request) -> Response {
        let (mut parts, _) = request.into_parts();
        let path = parts.uri.path().to_owned();
        let path = match self.guard.admit(&path, &parts.headers) {
            Ok(path) => path,
            Err(refused) => return refused.into_response(),
        };
        if parts.method != Method::GET {
            return StatusCode::METHOD_NOT_ALLOWED.into_response();
        }
        if let Some(file) = page::file(path) {
            return file;
        }
        if path == "scene.json" {
            let kind = [(CONTENT_TYPE, "application/json")];
            return (kind, self.description.text().to_string()).into_response();
        }
        if path == "socket" {
            return match WebSocketUpgrade::from_request_parts(&mut parts, &()).await {
                Ok(upgrade) => self.open(upgrade),
                Err(rejected) => rejected.into_response(),
            };
        }
        let number = path.strip_prefix("pictures/").and_then(|number| number.parse().ok());
        match number {
            Some(number) => self.picture(number).await,
            None => StatusCode::NOT_FOUND.into_response(),
        }
    }

    /// Opens a socket, if a slot is free.
    fn open(&self, upgrade: WebSocketUpgrade) -> Response {
        let upgrade = upgrade.max_message_size(MOST_MESSAGE).max_frame_size(MOST_MESSAGE);
        let turns = self.turns.clone();
        let told = self.live.as_ref().map(Live::listen);
        match self.clients.clone().try_acquire_owned() {
            Ok(place) => upgrade.on_upgrade(|socket| async move {
                socket::serve(socket, turns, told).await;
                drop(place);
            }),
            Err(_) => upgrade.on_upgrade(socket::turn_away),
        }
    }

    async fn picture(&self, number: usize) -> Response {
        let turn = self.decoding.clone().acquire_owned().await.expect("never closed");
        let pictures = self.description.pictures();
        // The client may disconnect meanwhile; the permit is held until decoding ends.
        let decode = move || {
            let decoded = pictures.jpeg(number);
            drop(turn);
            decoded
        };
        match tokio::task::spawn_blocking(decode).await {
            Ok(Ok(Some(bytes))) => ([(CONTENT_TYPE, "image/jpeg")], bytes).into_response(),
            Ok(Ok(None)) => StatusCode::NOT_FOUND.into_response(),
            // Error messages contain the file's path, which must not leave this machine.
            Ok(Err(_)) | Err(_) => {
                (StatusCode::INTERNAL_SERVER_ERROR, "the image cannot be read").into_response()
            }
        }
    }
}
