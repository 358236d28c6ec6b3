//! The queue, which one thread at a time may use: the engine's own, or one shared with a host.

use super::requirements::unsupported;
use crate::error::Result;
use ash::vk;
use std::sync::Mutex;

/// A function that calls its argument exactly once, while no other code uses the queue.
pub type QueueLock = dyn Fn(&mut dyn FnMut()) + Send + Sync;

pub(super) struct Queue {
    raw: Mutex<vk::Queue>,
    /// The lock of a host that uses the queue too.
    lock: Option<Box<QueueLock>>,
}

impl Queue {
    pub(super) fn new(raw: vk::Queue, lock: Option<Box<QueueLock>>) -> Queue {
        Queue { raw: Mutex::new(raw), lock }
    }

    /// Runs `work` with exclusive use of the queue.
    pub(super) fn with<R>(&self, work: impl FnOnce(vk::Queue) -> Result<R>) -> Result<R> {
        let (mut work, mut result) = (Some(work), None);
        let mut run = || {
            if let Some(work) = work.take() {
                // A poisoned lock is safe to use: a panic elsewhere cannot change the handle.
                let queue = self.raw.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                result = Some(work(*queue));
            }
        };
        match &self.lock {
            Some(lock) => lock(&mut run),
            None => run(),
        }
        result.unwrap_or_else(|| {
            Err(unsupported("the host's queue lock did not run what it was given".into()))
        })
    }
}
