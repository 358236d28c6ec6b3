//! Time by stage.

use std::time::Instant;

use serde_json::{Map, Value, json};

/// Seconds by stage.
pub struct Clock {
    begun: Instant,
    laps: Map<String, Value>,
}

impl Clock {
    /// Begins the first stage.
    pub fn start() -> Clock {
        Clock { begun: Instant::now(), laps: Map::new() }
    }

    /// The stage that ends here; of one that comes several times, the sum counts.
    pub fn lap(&mut self, stage: &str) {
        let before = self.seconds(stage);
        self.laps.insert(stage.into(), json!(before + self.begun.elapsed().as_secs_f64()));
        self.begun = Instant::now();
    }

    /// How long a stage took; 0 for one that there was not.
    pub fn seconds(&self, stage: &str) -> f64 {
        self.laps.get(stage).and_then(Value::as_f64).unwrap_or(0.0)
    }

    /// `{stage: seconds}`.
    pub fn json(&self) -> Value {
        Value::Object(self.laps.clone())
    }
}

/// What [`Clock::json`] gave, as one line.
pub fn line(seconds: &Value) -> String {
    let stages: Vec<String> = seconds
        .as_object()
        .into_iter()
        .flatten()
        .map(|(stage, seconds)| format!("{stage} {:.1} s", seconds.as_f64().unwrap_or(0.0)))
        .collect();
    stages.join(", ")
}
