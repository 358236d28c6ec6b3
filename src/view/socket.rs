//! The WebSocket of a client.

use std::future::pending;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::ws::{CloseFrame, Message, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde::Serialize;
use tokio::sync::mpsc::{self, Receiver, Sender};
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout};

use super::MOST_MESSAGES_A_SECOND;
use super::protocol::{Refusal, Request, Status, Told};
use super::turns::{Answer, Turns};

/// Maximum time for sending one answer; slower clients are disconnected.
const MOST_SENDING: Duration = Duration::from_secs(20);
/// Interval of pings; browsers answer them automatically.
const PING: Duration = Duration::from_secs(15);
/// Maximum silence of a client before it is disconnected.
const MOST_SILENCE: Duration = Duration::from_secs(60);
/// Minimum time between two status messages.
const NEWS: Duration = Duration::from_millis(250);
/// Number of consecutive invalid messages after which a client is disconnected.
const MOST_RUBBISH: u32 = 20;
/// Close codes of RFC 6455.
const GOING_AWAY: u16 = 1001;
const POLICY: u16 = 1008;

/// Serves a client until it disconnects, misbehaves, or the server stops; `told` is the status of a training.
pub async fn serve(socket: WebSocket, turns: Arc<Turns>, told: Option<watch::Receiver<Status>>) {
    let Some((client, answers)) = turns.join() else { return };
    let (sink, stream) = socket.split();
    let (refusals, refused) = mpsc::channel(1);
    tokio::select! {
        () = write(sink, answers, refused, told, &turns) => {}
        () = read(stream, client, &turns, refusals) => {}
    }
    turns.leave(client);
}

/// Reads requests at the permitted rate.
async fn read(
    mut stream: SplitStream<WebSocket>,
    client: u64,
    turns: &Turns,
    refusals: Sender<Refusal>,
) {
    let each = Duration::from_secs(1) / MOST_MESSAGES_A_SECOND;
    let burst = Duration::from_secs(1);
    // Time at which everything read so far would have been due.
    let mut due = Instant::now();
    let mut rubbish = 0;
    while let Ok(Some(Ok(message))) = timeout(MOST_SILENCE, stream.next()).await {
        due = due.max(Instant::now() - burst) + each;
        sleep_until(due).await;
        let text = match message {
            Message::Text(text) => Ok(text),
            Message::Binary(_) => Err("a text message was expected".to_owned()),
            Message::Ping(_) | Message::Pong(_) => continue,
            Message::Close(_) => return,
        };
        let parsed = text.and_then(|text| {
            serde_json::from_str::<Request>(&text).map_err(|e| format!("is no request: {e}"))
        });
        match parsed {
            Ok(request) => match request.checked() {
                Ok(_) => {
                    rubbish = 0;
                    turns.ask(client, request);
                }
                Err(error) => refuse(&refusals, Some(request.id), error),
            },
            Err(error) => {
                rubbish += 1;
                refuse(&refusals, None, error);
                if rubbish == MOST_RUBBISH {
                    return;
                }
            }
        }
    }
}

/// Queues a refusal; dropped while the last one has not been sent yet.
fn refuse(refusals: &Sender<Refusal>, id: Option<u64>, error: String) {
    let _ = refusals.try_send(Refusal { id, error });
}

/// Sends answers in order.
async fn write(
    mut sink: SplitSink<WebSocket, Message>,
    mut answers: Receiver<Answer>,
    mut refused: Receiver<Refusal>,
    mut told: Option<watch::Receiver<Status>>,
    turns: &Turns,
) {
    let mut due = Instant::now();
    let mut pings = interval(PING);
    pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let message = tokio::select! {
            answer = answers.recv() => match answer {
                Some(Answer::Picture(bytes)) => Message::Binary(bytes.into()),
                Some(Answer::Refused(refusal)) => text(&refusal),
                None => break,
            },
            Some(refusal) = refused.recv() => text(&refusal),
            status = news(&mut told, due) => {
                due = Instant::now() + NEWS;
                text(&Told { status })
            }
            _ = pings.tick() => Message::Ping(Default::default()),
        };
        let sent = timeout(MOST_SENDING, sink.send(message)).await;
        turns.taken();
        if !matches!(sent, Ok(Ok(()))) {
            return;
        }
    }
    if let Some(told) = told {
        let status = told.borrow().clone();
        let _ = timeout(PING / 10, sink.send(text(&Told { status }))).await;
    }
    let farewell = CloseFrame { code: GOING_AWAY, reason: "the server ends".into() };
    let _ = timeout(PING / 10, sink.send(Message::Close(Some(farewell)))).await;
}

/// Waits for a changed status that is due; waits for ever where there is no training.
async fn news(told: &mut Option<watch::Receiver<Status>>, due: Instant) -> Status {
    let Some(told) = told else { return pending().await };
    sleep_until(due).await;
    match told.changed().await {
        Ok(()) => told.borrow_and_update().clone(),
        Err(_) => pending().await,
    }
}

fn text(message: &impl Serialize) -> Message {
    Message::Text(serde_json::to_string(message).expect("plain data").into())
}

/// Rejects a client.
pub async fn turn_away(mut socket: WebSocket) {
    let reason = "too many pages show this scene; close one";
    let farewell = CloseFrame { code: POLICY, reason: reason.into() };
    let _ = timeout(PING / 10, socket.send(Message::Close(Some(farewell)))).await;
}
