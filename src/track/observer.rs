//! The observer of tracking: it receives progress reports and saves finished parts of the work.
//!
//! Tracking is a fixed sequence of parts. Each part depends only on the frames, the options, the flow and the
//! earlier parts. If an earlier run has saved a part, it is loaded instead of computed, so that an
//! interrupted run continues with the same bits. Parts can be nested: for example, the masks of single frames
//! lie within a round of masks. When the outer part is done, the inner parts are no longer needed.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::Stage;
use crate::{Error, Result};

/// An observer of tracking.
pub trait Observer {
    /// Receives the stage and the completed share of that stage. An error ends the work.
    fn progress(&mut self, stage: Stage, share: f64) -> Result<()>;

    /// Whether finished parts are to be saved; if so, each is encoded and passed to [`keep`](Self::keep).
    fn keeps(&self) -> bool {
        false
    }

    /// Saves a finished part: everything that the rest of the work needs from it. It replaces an earlier
    /// value of that name, and every part whose name begins with this one and a `/`. An error ends the work.
    fn keep(&mut self, _part: &str, _value: Vec<u8>) -> Result<()> {
        Ok(())
    }

    /// Returns what an earlier run on the same frames, options and flow has saved under a name. An error ends
    /// the work.
    fn kept(&mut self, _part: &str) -> Result<Option<Vec<u8>>> {
        Ok(None)
    }
}

/// An observer that passes progress to a closure and saves nothing.
pub(super) struct Progress<'a>(pub &'a mut dyn FnMut(Stage, f64) -> Result<()>);

impl Observer for Progress<'_> {
    fn progress(&mut self, stage: Stage, share: f64) -> Result<()> {
        (self.0)(stage, share)
    }
}

/// The work in progress: the interface of the parts to the observer.
pub(super) struct Work<'a> {
    observer: &'a mut dyn Observer,
    /// Whether the observer has ended the work.
    pub ended: bool,
}

impl<'a> Work<'a> {
    pub fn new(observer: &'a mut dyn Observer) -> Work<'a> {
        Work { observer, ended: false }
    }

    fn ends<T>(&mut self, result: Result<T>) -> Result<T> {
        self.ended |= result.is_err();
        result
    }

    pub fn progress(&mut self, stage: Stage, share: f64) -> Result<()> {
        let result = self.observer.progress(stage, share);
        self.ends(result)
    }

    /// Returns a part that an earlier run has saved, or computes and saves it.
    pub fn part<T: Serialize + DeserializeOwned>(
        &mut self,
        name: &str,
        make: impl FnOnce(&mut Work) -> Result<T>,
    ) -> Result<T> {
        if let Some(kept) = self.kept(name)? {
            return Ok(kept);
        }
        let made = make(self)?;
        self.keep(name, &made)?;
        Ok(made)
    }

    /// Returns one part per frame, computed a few frames at a time: `make` gives the parts of a range of
    /// frames. Progress is reported within `shares` of the stage.
    pub fn frames<T: Serialize + DeserializeOwned>(
        &mut self,
        name: &str,
        frames: usize,
        make: impl Fn(std::ops::Range<usize>) -> Vec<T>,
        stage: Stage,
        shares: std::ops::Range<f64>,
    ) -> Result<Vec<T>> {
        let at_a_time = rayon::current_num_threads();
        let mut out: Vec<T> = Vec::with_capacity(frames);
        while out.len() < frames {
            let frame = out.len();
            match self.kept(&numbered(name, frame))? {
                Some(kept) => out.push(kept),
                None => {
                    for (i, made) in (frame..).zip(make(frame..(frame + at_a_time).min(frames))) {
                        self.keep(&numbered(name, i), &made)?;
                        out.push(made);
                    }
                }
            }
            let share = out.len() as f64 / frames as f64;
            self.progress(stage, shares.start + (shares.end - shares.start) * share)?;
        }
        Ok(out)
    }

    pub fn kept<T: DeserializeOwned>(&mut self, name: &str) -> Result<Option<T>> {
        let found = self.observer.kept(name);
        let Some(bytes) = self.ends(found)? else { return Ok(None) };
        let decoded = postcard::from_bytes(&bytes).map(Some).map_err(|error| {
            Error::Input(format!(
                "what an earlier run has kept of the tracking ({name}) cannot be decoded: {error}; \
                 begin anew"
            ))
        });
        self.ends(decoded)
    }

    pub fn keep<T: Serialize>(&mut self, name: &str, value: &T) -> Result<()> {
        if !self.observer.keeps() {
            return Ok(());
        }
        let bytes = postcard::to_stdvec(value)
            .map_err(|error| Error::Failed(format!("{name} cannot be encoded: {error}")));
        let bytes = self.ends(bytes)?;
        let result = self.observer.keep(name, bytes);
        self.ends(result)
    }
}

/// The name of a part that exists once per frame or pair of frames.
pub(super) fn numbered(name: &str, number: usize) -> String {
    format!("{name}/{number:05}")
}
