//! Who looks on while a clip is tracked: progress, and finished parts of the work, put away.
//!
//! Tracking is a fixed sequence of parts, each of which depends on frames, options, flow and the
//! parts before it, and on nothing else. A part that an earlier run has put away is taken as it is,
//! so that a run that was interrupted goes on with the same bits. Parts lie within others: the masks
//! of single frames in a round of masks, say. When the outer part is done, those within are no longer
//! needed.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::Stage;
use crate::{Error, Result};

/// Looks on while a clip is tracked.
pub trait Observer {
    /// Told the stage and the share of it that is done. An error ends the work.
    fn progress(&mut self, stage: Stage, share: f64) -> Result<()>;

    /// Whether finished parts are wanted at all: each is encoded for [`keep`](Self::keep).
    fn keeps(&self) -> bool {
        false
    }

    /// A part is done: all that the rest of the work needs of it. It takes the place of an earlier
    /// value of that name, and of every part whose name begins with this one and a `/`. An error
    /// ends the work.
    fn keep(&mut self, _part: &str, _value: Vec<u8>) -> Result<()> {
        Ok(())
    }

    /// What was kept under a name by an earlier run on the same frames, options and flow. An error
    /// ends the work.
    fn kept(&mut self, _part: &str) -> Result<Option<Vec<u8>>> {
        Ok(None)
    }
}

/// A closure's view of the work.
pub(super) struct Progress<'a>(pub &'a mut dyn FnMut(Stage, f64) -> Result<()>);

impl Observer for Progress<'_> {
    fn progress(&mut self, stage: Stage, share: f64) -> Result<()> {
        (self.0)(stage, share)
    }
}

/// The work under way, as its parts see it.
pub(super) struct Work<'a> {
    observer: &'a mut dyn Observer,
    /// The observer has ended it.
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

    /// A part as an earlier run has kept it, else as it is made now.
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

    /// A part for each of so many frames, made a few frames at a time: `make` gives those of a range.
    /// `done` is told the share that is done.
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

/// The name of a part that there is for every frame, or pair of frames.
pub(super) fn numbered(name: &str, number: usize) -> String {
    format!("{name}/{number:05}")
}
