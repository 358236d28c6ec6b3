//! Fair scheduling of the clients' requests to the renderer.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::mpsc::{Receiver, Sender, channel};

use super::protocol::{Refusal, Request};

/// An answer to a client.
pub enum Answer {
    /// The binary message with an image.
    Picture(Vec<u8>),
    /// The reason for a rejection.
    Refused(Refusal),
}

/// Waiting requests, at most one per client, and the channels of their answers.
#[derive(Default)]
pub struct Turns {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    seats: BTreeMap<u64, Seat>,
    /// Number of client identifiers assigned so far.
    numbers: u64,
    /// The client that was served last.
    last: u64,
    closed: bool,
}

struct Seat {
    /// The newest request; it replaces an older one.
    waiting: Option<Request>,
    /// Channel with a capacity of one answer.
    answers: Sender<Answer>,
}

impl Turns {
    /// Adds a client: its identifier and its answers. `None` after [`close`](Self::close).
    pub fn join(&self) -> Option<(u64, Receiver<Answer>)> {
        let mut state = self.lock();
        if state.closed {
            return None;
        }
        let (answers, receiver) = channel(1);
        state.numbers += 1;
        let number = state.numbers;
        state.seats.insert(number, Seat { waiting: None, answers });
        Some((number, receiver))
    }

    /// Removes a client and its waiting request.
    pub fn leave(&self, client: u64) {
        self.lock().seats.remove(&client);
    }

    /// Queues a client's request; it replaces one that has not been answered yet.
    pub fn ask(&self, client: u64, request: Request) {
        if let Some(seat) = self.lock().seats.get_mut(&client) {
            seat.waiting = Some(request);
        }
        self.changed.notify_one();
    }

    /// Notes that a client has taken an answer and can receive the next.
    pub fn taken(&self) {
        self.changed.notify_one();
    }

    /// Waits for a request whose client can receive an answer, in round-robin order. `None` once the turns
    /// are closed.
    pub fn next(&self) -> Option<(u64, Request)> {
        let mut state = self.lock();
        loop {
            if state.closed {
                return None;
            }
            if let Some(client) = state.following() {
                state.last = client;
                let seat = state.seats.get_mut(&client).expect("just found");
                return seat.waiting.take().map(|request| (client, request));
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Waits for a duration, or until the turns are closed.
    pub fn rest(&self, long: Duration) {
        let state = self.lock();
        let open = |state: &mut State| !state.closed;
        drop(self.changed.wait_timeout_while(state, long, open));
    }

    /// Sends an answer to a client, if it is still connected.
    pub fn answer(&self, client: u64, answer: Answer) {
        if let Some(seat) = self.lock().seats.get(&client) {
            // The channel had capacity when its turn came, and only this thread sends.
            let _ = seat.answers.try_send(answer);
        }
    }

    /// Closes the turns; the clients' answer channels end.
    pub fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        state.seats.clear();
        self.changed.notify_all();
    }

    /// Number of clients.
    pub fn clients(&self) -> usize {
        self.lock().seats.len()
    }

    /// The state is consistent at any time, so a poisoned lock can be used.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// The next client in round-robin order whose request can be served.
    fn following(&self) -> Option<u64> {
        let ready =
            |(_, seat): &(&u64, &Seat)| seat.waiting.is_some() && seat.answers.capacity() > 0;
        let after = self.seats.range(self.last + 1..).find(ready);
        after.or_else(|| self.seats.range(..=self.last).find(ready)).map(|(client, _)| *client)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Camera, Intrinsics, Pose};
    use crate::view::protocol::{Format, Layer};

    fn request(id: u64) -> Request {
        let camera =
            Camera { intrinsics: Intrinsics::centred(8.0, 8, 8), view_from_world: Pose::IDENTITY };
        Request {
            id,
            time: 0.0,
            layer: Layer::Colour,
            format: Format::Jpeg,
            quality: 90,
            points: false,
            camera: camera.into(),
        }
    }

    #[test]
    fn the_newest_wins_and_clients_take_turns() {
        let turns = Turns::default();
        let (a, _of_a) = turns.join().unwrap();
        let (b, _of_b) = turns.join().unwrap();
        (1..=9).for_each(|id| turns.ask(a, request(id)));
        turns.ask(b, request(20));
        let mut served = Vec::new();
        for _ in 0..2 {
            let (client, request) = turns.next().unwrap();
            served.push((client, request.id));
            turns.ask(a, super::tests::request(30));
        }
        assert_eq!(served, [(a, 9), (b, 20)]);
        assert_eq!(turns.next().unwrap().1.id, 30);
        turns.close();
        assert!(turns.next().is_none() && turns.join().is_none());
    }

    #[test]
    fn who_has_not_taken_an_answer_waits() {
        let turns = Turns::default();
        let (slow, mut of_slow) = turns.join().unwrap();
        let (quick, _of_quick) = turns.join().unwrap();
        turns.ask(slow, request(1));
        assert_eq!(turns.next().unwrap().1.id, 1);
        turns.answer(slow, Answer::Picture(vec![1]));
        turns.ask(slow, request(2));
        turns.ask(quick, request(3));
        assert_eq!(turns.next().unwrap(), (quick, request(3)));
        assert!(matches!(of_slow.try_recv(), Ok(Answer::Picture(bytes)) if bytes == [1]));
        assert_eq!(turns.next().unwrap(), (slow, request(2)));
        turns.leave(slow);
        turns.answer(slow, Answer::Picture(vec![2]));
        assert_eq!(turns.clients(), 1);
    }
}
