//! Time by stage.

use std::time::Instant;

use serde_json::{Value, json};

/// Seconds by stage, in the order in which the stages began.
pub struct Clock {
    begun: Instant,
    stages: Vec<(String, f64)>,
}

impl Clock {
    /// Begins the first stage.
    pub fn start() -> Clock {
        Clock { begun: Instant::now(), stages: Vec::new() }
    }

    /// The stage that ends here; of one that comes several times, the sum counts.
    pub fn lap(&mut self, stage: &str) {
        let seconds = self.begun.elapsed().as_secs_f64();
        match self.stages.iter_mut().find(|(name, _)| name == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.stages.push((stage.to_owned(), seconds)),
        }
        self.begun = Instant::now();
    }

    /// How long a stage took; 0 for one that there was not.
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
