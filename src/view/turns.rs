//! The clients' turns at the renderer.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::mpsc::{Receiver, Sender, channel};

use super::protocol::{Refusal, Request};

/// What a client is to get.
pub enum Answer {
    /// A picture.
    Picture(Vec<u8>),
    /// Why there is none.
    Refused(Refusal),
}

/// Requests that wait, at most one of each client, and where the answers go.
#[derive(Default)]
pub struct Turns {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    seats: BTreeMap<u64, Seat>,
    /// Numbers given out.
    numbers: u64,
    /// Whose turn it was last.
    last: u64,
    closed: bool,
}

struct Seat {
    /// The newest request; an older one is forgotten.
    waiting: Option<Request>,
    /// Room for one answer.
    answers: Sender<Answer>,
}

impl Turns {
    /// A new client: its number, and its answers. None once it is [closed](Self::close).
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

    /// A client goes, and what it waited for with it.
    pub fn leave(&self, client: u64) {
        self.lock().seats.remove(&client);
    }

    /// A client asks; what it asked before and has not got yet is forgotten.
    pub fn ask(&self, client: u64, request: Request) {
        if let Some(seat) = self.lock().seats.get_mut(&client) {
            seat.waiting = Some(request);
        }
        self.changed.notify_one();
    }

    /// A client has taken an answer, and may have the next.
    pub fn taken(&self) {
        self.changed.notify_one();
    }

    /// Waits for a request whose client has room for an answer; the clients take turns. `None` once it is
    /// closed.
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

    /// Waits for so long, or until it is closed.
    pub fn rest(&self, long: Duration) {
        let state = self.lock();
        let open = |state: &mut State| !state.closed;
        drop(self.changed.wait_timeout_while(state, long, open));
    }

    /// Answers a client, where it is still there.
    pub fn answer(&self, client: u64, answer: Answer) {
        if let Some(seat) = self.lock().seats.get(&client) {
            // There was room when its turn came, and nobody else answers.
            let _ = seat.answers.try_send(answer);
        }
    }

    /// Ends it: clients are told by the end of their answers.
    pub fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        state.seats.clear();
        self.changed.notify_all();
    }

    /// How many clients there are.
    pub fn clients(&self) -> usize {
        self.lock().seats.len()
    }

    /// A thread that has panicked leaves the state as whole as it was.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// The client after the last one whose request can be served.
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
