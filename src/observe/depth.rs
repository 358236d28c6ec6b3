//! Depth that a network has estimated from single frames.

use serde::{Deserialize, Serialize};

use super::pointmaps::quantile;
use crate::types::Image;

/// What a network's depth maps hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EstimatedKind {
    /// Depth (z) up to a factor of each frame; not above 0 where unknown.
    Depth,
    /// Depth (z) up to a factor and a shift of each frame; 0 where unknown.
    ShiftedDepth,
    /// Inverse depth up to a factor and a shift of each frame, as MiDaS and Depth Anything give it.
    ShiftedInverse,
}

/// A network's depth of a clip.
#[derive(Clone, Debug, Serialize)]
pub struct EstimatedDepth {
    /// One channel for each frame, at the size of the frames; not finite where unknown.
    pub maps: Vec<Image>,
    /// What they hold.
    pub kind: EstimatedKind,
    /// One channel for each frame: how far each pixel is to be believed, where the network tells; 0 where unknown.
    /// Relative deviations within a frame go with 1 / confidence, as a loss of confidence × error − α ln confidence
    /// makes them (Wang et al., "DUSt3R", CVPR 2024).
    pub confidence: Option<Vec<Image>>,
}

/// Pixels are confident from the median of their frame on, within these bounds.
const CONFIDENT: (f64, f64) = (1.1, 3.0);
/// The share of the confident depths that is near.
const NEAR: f64 = 0.95;

impl EstimatedDepth {
    /// Whether each pixel of a frame is confident and near, where the network tells confidence. Confidence that half
    /// of the pixels reach is enough, 1.1 is needed and 3 suffices; near are the nearest 95 % of the confident ones.
    pub(crate) fn sure(&self, frame: usize) -> Option<Vec<bool>> {
        let confidence = &self.confidence.as_ref()?[frame].pixels;
        let depth = |i: usize| -> Option<f64> {
            let told = f64::from(self.maps[frame].pixels[i]);
            let z = match self.kind {
                EstimatedKind::Depth | EstimatedKind::ShiftedDepth => told,
                // What is far is small, and sorted the other way.
                EstimatedKind::ShiftedInverse => -told,
            };
            z.is_finite().then_some(z)
        };
        let told = (0..confidence.len()).filter(|i| confidence[*i] > 0.0);
        let middle = quantile(told.map(|i| f64::from(confidence[i])).collect(), 0.5);
        let least = middle.clamp(CONFIDENT.0, CONFIDENT.1);
        let confident = |i: usize| depth(i).filter(|_| f64::from(confidence[i]) >= least);
        let far = quantile((0..confidence.len()).filter_map(confident).collect(), NEAR);
        Some((0..confidence.len()).map(|i| confident(i).is_some_and(|z| z <= far)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_confident_and_near_is_sure() {
        // 100 pixels at depths of 1 to 100; every fourth hardly believed, one unknown.
        let row = |of: &dyn Fn(usize) -> f32| Image {
            width: 100,
            height: 1,
            channels: 1,
            pixels: (0..100).map(of).collect(),
        };
        let depth = row(&|i| if i == 7 { f32::NAN } else { 1.0 + i as f32 });
        let confidence = row(&|i| if i % 4 == 0 { 1.05 } else { 2.0 });
        let mut told = EstimatedDepth {
            maps: vec![depth.clone()],
            kind: EstimatedKind::Depth,
            confidence: Some(vec![confidence]),
        };
        let sure = told.sure(0).unwrap();
        assert!(!sure[8] && !sure[7] && sure[9] && !sure[99] && sure[90], "{sure:?}");
        assert_eq!(sure.iter().filter(|sure| **sure).count(), 70, "95 % of 74");
        // Of inverse depth the smallest is the farthest.
        told.kind = EstimatedKind::ShiftedInverse;
        let sure = told.sure(0).unwrap();
        assert!(!sure[1] && sure[99]);
        told.confidence = None;
        assert_eq!(told.sure(0), None);
    }
}
