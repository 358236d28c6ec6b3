//! Depth that a network has estimated from single images.

use serde::{Deserialize, Serialize};

use super::pointmaps::quantile;
use crate::types::Image;

/// Contents of a network's depth maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EstimatedKind {
    /// Depth (z) up to a scale factor per frame; 0 or less where unknown.
    Depth,
    /// Depth (z) up to a scale factor and a shift per frame; 0 where unknown.
    ShiftedDepth,
    /// Inverse depth up to a scale factor and a shift per frame, as MiDaS and Depth Anything give it.
    ShiftedInverse,
}

/// Depth maps of a clip that a network has estimated.
#[derive(Clone, Debug, Serialize)]
pub struct EstimatedDepth {
    /// One channel for each frame, at the size of the frames; not finite where unknown.
    pub maps: Vec<Image>,
    /// What the maps hold.
    pub kind: EstimatedKind,
    /// Confidence of each pixel, one channel per frame, where the network gives it; 0 where unknown. Within
    /// a frame, relative deviations are proportional to 1 / confidence, which follows from the loss
    /// confidence × error − α ln confidence (Wang et al., "DUSt3R", CVPR 2024).
    pub confidence: Option<Vec<Image>>,
}

/// Bounds of the threshold above which a pixel is confident; the threshold is the median confidence of its
/// frame.
const CONFIDENT: (f64, f64) = (1.1, 3.0);
/// Share of the confident depths that counts as near.
const NEAR: f64 = 0.95;

impl EstimatedDepth {
    /// Whether each pixel of a frame is confident and near; `None` where the network gives no confidence.
    /// The confidence threshold is the frame's median, clamped to [1.1, 3]. The nearest 95 % of the
    /// confident pixels are near.
    pub(crate) fn sure(&self, frame: usize) -> Option<Vec<bool>> {
        let confidence = &self.confidence.as_ref()?[frame].pixels;
        let depth = |i: usize| -> Option<f64> {
            let told = f64::from(self.maps[frame].pixels[i]);
            let z = match self.kind {
                EstimatedKind::Depth | EstimatedKind::ShiftedDepth => told,
                // Inverse depth is smaller for farther points, so the order is reversed.
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
        // 100 pixels at depths of 1 to 100; every fourth has low confidence, one has unknown depth.
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
        // The smallest inverse depth is the farthest.
        told.kind = EstimatedKind::ShiftedInverse;
        let sure = told.sure(0).unwrap();
        assert!(!sure[1] && sure[99]);
        told.confidence = None;
        assert_eq!(told.sure(0), None);
    }
}
