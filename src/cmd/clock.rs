//! Elapsed time by stage.

use std::time::Instant;

use serde_json::{Value, json};

/// Seconds by stage, in the order of their first occurrence.
pub struct Clock {
    begun: Instant,
    stages: Vec<(String, f64)>,
}

impl Clock {
    /// Starts the clock with the first stage.
    pub fn start() -> Clock {
        Clock { begun: Instant::now(), stages: Vec::new() }
    }

    /// Ends the current stage; times of repeated stages are summed.
    pub fn lap(&mut self, stage: &str) {
        let seconds = self.begun.elapsed().as_secs_f64();
        match self.stages.iter_mut().find(|(name, _)| name == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.stages.push((stage.to_owned(), seconds)),
        }
        self.begun = Instant::now();
    }

    /// Duration of a stage in seconds; 0 for an unknown stage.
    pub fn seconds(&self, stage: &str) -> f64 {
        self.stages.iter().find(|(name, _)| name == stage).map_or(0.0, |(_, seconds)| *seconds)
    }

    /// All stages with their seconds.
    pub fn stages(&self) -> &[(String, f64)] {
        &self.stages
    }

    /// `{stage: seconds}`.
    pub fn json(&self) -> Value {
        self.stages.iter().map(|(stage, seconds)| (stage.clone(), json!(seconds))).collect()
    }

    /// All stages on one line.
    pub fn line(&self) -> String {
        let stages: Vec<String> =
            self.stages.iter().map(|(stage, seconds)| format!("{stage} {seconds:.1} s")).collect();
        stages.join(", ")
    }
}
