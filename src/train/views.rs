//! The training views, and the size of the scene that they show.

#[cfg(feature = "files")]
use crate::data::View;
use crate::types::range::{self, Check};
use crate::types::{Camera, Gaussians, Image};
#[cfg(feature = "files")]
use serde::Serialize;

/// A training view: a posed image, and what else is known of its pixels.
#[derive(Clone, Debug)]
#[cfg_attr(feature = "files", derive(Serialize))]
pub struct TrainingView {
    /// Its camera, with the image's size.
    pub camera: Camera,
    /// Time of the image, in [0, 1] over the clip.
    pub time: f64,
    /// RGB in [0, 1].
    pub image: Image,
    /// Weight per pixel in [0, 1]; `None` for 1.
    pub weights: Option<Image>,
    /// Disparity (inverse depth) and its weight per pixel, two channels; `None` where unknown.
    pub disparity: Option<Image>,
    /// Motion mask, one channel: 1 where something moves, else 0; `None` where unknown.
    pub mask: Option<Image>,
    /// The view takes part in one of this many rounds through the views; 1 for every round.
    pub every: u32,
}

impl TrainingView {
    /// Checks that its camera, its time, disparity and mask are in their ranges; the image itself is
    /// clamped to [0, 1].
    pub(super) fn check(&self) -> Check {
        self.camera.check()?;
        range::moment(self.time)?;
        range::wanted(self.every > 0, || "a view is shown in one of 0 rounds".into())?;
        for (what, image) in [("disparity", &self.disparity), ("mask", &self.mask)] {
            let pixels = image.iter().flat_map(|image| &image.pixels);
            let mut wrong = pixels.filter(|v| !(0.0..=1e15).contains(*v));
            let wrong = wrong.next();
            range::wanted(wrong.is_none(), || {
                format!("{what} {:?} is no {what}", wrong.unwrap_or(&0.0))
            })?;
        }
        Ok(())
    }
}

/// Converts a dataset's view to a training view; pixels that undistortion left empty have no weight.
#[cfg(feature = "files")]
impl From<View> for TrainingView {
    fn from(view: View) -> TrainingView {
        let View { camera, time, image, valid, .. } = view;
        TrainingView { camera, time, image, weights: valid, disparity: None, mask: None, every: 1 }
    }
}

/// The views of a round, where view i takes part in one of `every[i]` rounds; all views where that would
/// give none. `turn` is the round's random number, drawn uniformly: adjacent views take turns.
pub(super) fn due(every: &[u32], turn: u32) -> Vec<usize> {
    let is_due = |i: &usize| (*i as u64 + u64::from(turn)).is_multiple_of(u64::from(every[*i]));
    let due: Vec<usize> = (0..every.len()).filter(is_due).collect();
    if due.is_empty() { (0..every.len()).collect() } else { due }
}

/// The scene radius: the larger of the extent of the cameras and the median distance of the Gaussians
/// from the cameras' mean centre.
pub(super) fn scene_radius(views: &[TrainingView], gaussians: &Gaussians) -> f64 {
    let cameras = views.iter().map(|view| &view.camera);
    let sum: glam::DVec3 = cameras.clone().map(Camera::centre).sum();
    let middle = sum / views.len().max(1) as f64;
    let from = |p: &[f32; 3]| glam::Vec3::from(*p).as_dvec3().distance(middle);
    let mut all: Vec<f64> = gaussians.positions.iter().map(from).collect();
    all.sort_by(f64::total_cmp);
    extent(cameras).max(all.get(all.len() / 2).copied().unwrap_or(0.0))
}

/// The extent of the cameras: 1.1 times the largest distance of a camera from their mean, the unit of
/// the positions' learning rate. 1 where all cameras are in one place.
pub(super) fn extent<'a>(cameras: impl Iterator<Item = &'a Camera> + Clone) -> f64 {
    let centres: Vec<_> = cameras.map(Camera::centre).collect();
    let mean = centres.iter().copied().sum::<glam::DVec3>() / centres.len().max(1) as f64;
    let largest = centres.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
    if largest > 1e-6 { 1.1 * largest } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::due;

    #[test]
    fn views_take_turns() {
        let every = [1, 1, 1, 4, 4, 4, 4, 4];
        let mut shown = [0; 8];
        for turn in 0..4 {
            let round = due(&every, turn);
            assert!((4..=5).contains(&round.len()), "{round:?}");
            round.into_iter().for_each(|view| shown[view] += 1);
        }
        assert_eq!(shown, [4, 4, 4, 1, 1, 1, 1, 1]);
        // No round is empty.
        assert_eq!(due(&[1 << 31, u32::MAX], 7), [0, 1]);
        assert_eq!(due(&[2], 1), [0]);
    }
}
