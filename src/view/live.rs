//! A training in progress, as its server reports and shows it.
//!
//! The training holds a [`Live`], reports its progress, and asks after each step whether the scene is
//! wanted. It is wanted only while a page is open, and at a limited rate, so that the scene is copied for
//! nobody else. No call here waits for the network or for a rendered image.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::Show;
use super::described::{self, Described};
use super::protocol::{Progressed, Status};
use super::turns::Turns;
use crate::Result;

/// Minimum time between two handovers of the scene.
const LEAST_BETWEEN: Duration = Duration::from_secs(1);
/// Minimum time between two handovers, as a multiple of the duration of a handover.
const SHARE: u32 = 30;
/// Maximum number of points of the curves; longer curves are thinned by half.
const MOST_POINTS: usize = 400;

/// Handle with which a training reports its progress and hands over scenes; clones share one state.
#[derive(Clone)]
pub struct Live(Arc<Shared>);

struct Shared {
    status: watch::Sender<Status>,
    scene: Mutex<Handover>,
    turns: Arc<Turns>,
    device: String,
    description: Described,
}

/// The handover of a scene to the painter.
struct Handover {
    waiting: Option<Show>,
    /// Whether an image of the last scene was rendered and sent.
    shown: bool,
    /// Time at which the scene that is being copied was requested.
    asked: Option<Instant>,
    /// Earliest time of the next request.
    due: Instant,
}

impl Live {
    /// A handle for a device; `description` is what the page receives about the scene.
    pub(super) fn new(turns: Arc<Turns>, device: &str, description: Described) -> Live {
        let scene = Handover { waiting: None, shown: false, asked: None, due: Instant::now() };
        let (scene, device) = (Mutex::new(scene), device.to_owned());
        let status = watch::Sender::new(Status::default());
        Live(Arc::new(Shared { status, scene, turns, device, description }))
    }

    /// Reports the progress of a stage: `done` of `of` units.
    pub fn progress(&self, stage: &str, done: u64, of: u64, unit: &str) {
        self.0.status.send_modify(|status| {
            if status.stage != stage || status.unit != unit {
                (status.stage, status.unit) = (stage.to_owned(), unit.to_owned());
            }
            (status.done, status.of) = (done, of);
        });
    }

    /// Reports a point of the curves.
    pub fn measured(&self, point: Progressed) {
        self.0.status.send_modify(|status| {
            status.gaussians = Some(point.gaussians);
            status.curves.push(point);
            if status.curves.len() > MOST_POINTS {
                let mut number = 0;
                status.curves.retain(|_| {
                    number += 1;
                    number % 2 == 1
                });
            }
        });
    }

    /// Whether a page is open.
    pub fn has_clients(&self) -> bool {
        self.0.turns.clients() > 0
    }

    /// Whether the scene is to be handed over now.
    pub fn wants_scene(&self) -> bool {
        if self.0.turns.clients() == 0 {
            return false;
        }
        let mut scene = self.lock();
        let now = Instant::now();
        let wanted = scene.waiting.is_none() && now >= scene.due;
        if wanted {
            scene.asked = Some(now);
        }
        wanted
    }

    /// Hands over the scene; replaces one that has not been shown yet.
    ///
    /// # Errors
    /// [`Error::Failed`](crate::Error::Failed): a camera holds a number that is not representable in JSON.
    pub fn hand_over(&self, show: Show) -> Result<()> {
        let gaussians = show.scene.gaussians.len();
        let pictures = show.pictures.clone().unwrap_or_default();
        self.0.description.set(&described::of(&self.0.device, &show, true), pictures)?;
        {
            let mut scene = self.lock();
            let now = Instant::now();
            let took = scene.asked.take().map_or(Duration::ZERO, |asked| now - asked);
            scene.due = now + LEAST_BETWEEN.max(took * SHARE);
            (scene.waiting, scene.shown) = (Some(show), false);
        }
        self.0.status.send_modify(|status| {
            status.gaussians = Some(gaussians);
            status.scenes += 1;
        });
        Ok(())
    }

    /// Reports the end of the training; `how` describes it.
    pub fn end(&self, how: &str) {
        self.0.status.send_modify(|status| status.end = Some(how.to_owned()));
    }

    /// Whether a page is open that has not received an image of the last scene.
    pub fn is_awaited(&self) -> bool {
        let scene = self.lock();
        self.0.turns.clients() > 0 && self.0.status.borrow().scenes > 0 && !scene.shown
    }

    /// Whether the training is in progress.
    pub(super) fn is_under_way(&self) -> bool {
        self.0.status.borrow().end.is_none()
    }

    /// Takes the scene that was handed over last, if it has not been taken yet.
    pub(super) fn take(&self) -> Option<Show> {
        self.lock().waiting.take()
    }

    /// Records that an image of the scene taken last was sent.
    pub(super) fn set_shown(&self) {
        let mut scene = self.lock();
        scene.shown |= scene.waiting.is_none();
    }

    /// Subscribes to the status.
    pub(super) fn listen(&self) -> watch::Receiver<Status> {
        let mut told = self.0.status.subscribe();
        told.mark_changed();
        told
    }

    /// The state is consistent at any time, so a poisoned lock can be used.
    fn lock(&self) -> MutexGuard<'_, Handover> {
        self.0.scene.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;
    use crate::types::{Camera, Gaussians, Intrinsics, Pose, Tuning};
    use crate::view::Pictures;

    fn show() -> Show {
        let intrinsics = Intrinsics::centred(8.0, 8, 8);
        Show {
            name: "a scene".into(),
            scene: Scene::of(Gaussians::default()),
            tuning: Tuning::default(),
            start: Camera { intrinsics, view_from_world: Pose::IDENTITY },
            distance: 1.0,
            pictures: None,
        }
    }

    fn live(turns: &Arc<Turns>) -> Live {
        let nothing = described::nothing("d", "n");
        let description = Described::new(&nothing, Pictures::default()).unwrap();
        Live::new(turns.clone(), "d", description)
    }

    #[test]
    fn a_scene_is_wanted_while_somebody_looks_and_not_too_often() {
        let turns = Arc::new(Turns::default());
        let live = live(&turns);
        assert!(!live.wants_scene(), "nobody looks");
        let (client, _answers) = turns.join().unwrap();
        assert!(live.wants_scene());
        live.hand_over(show()).unwrap();
        assert!(!live.wants_scene() && live.is_awaited(), "the last one waits");
        assert!(live.take().is_some() && live.take().is_none());
        live.set_shown();
        assert!(!live.wants_scene() && !live.is_awaited(), "it is too early");
        live.lock().due = Instant::now();
        assert!(live.wants_scene());
        turns.leave(client);
        assert!(!live.wants_scene(), "nobody looks any more");
    }

    #[test]
    fn curves_are_bounded_and_keep_their_first_point() {
        let live = live(&Arc::default());
        for step in 0..5000 {
            live.measured(Progressed { step, gaussians: 7, l1: 0.1, ssim: 0.9, psnr: None });
        }
        let told = live.listen();
        let status = told.borrow();
        let curves = &status.curves;
        assert!((MOST_POINTS / 2..=MOST_POINTS).contains(&curves.len()), "{}", curves.len());
        assert_eq!((curves[0].step, curves[curves.len() - 1].step), (0, 4999));
        assert!(curves.is_sorted_by_key(|point| point.step));
    }
}
