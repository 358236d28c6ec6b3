//! Decides which masks of a source are accepted, and what evidence of motion they give.

use super::{ABOUT, Frame, MARGIN, probability, share};
use crate::Result;
use crate::observe::FoundMask;
use crate::types::Image;

/// Minimum intersection over union of a region and the mask of the previous frame that belongs to it.
const SAME: f64 = 0.2;
/// Share of the image that an accepted mask must stay below.
const LARGEST: f64 = 0.9;
/// Number of standard deviations of the mean by which an accepted mask must move more than the static world.
const ABOVE: f64 = 3.0;
/// Minimum fit of an accepted mask to its region.
const LEAST_FIT: f64 = 0.5;
/// Bound of the log odds of an accepted mask. With 1, masks with errors of two pixels improve the walker's
/// masks most, and masks that slip by six pixels do no harm; with 2 the latter do harm.
const BOUND: f32 = 1.0;

impl Frame<'_> {
    /// The mask of the previous frame that belongs to a region, if any.
    pub(super) fn before(&self, k: usize, handed: &[Image]) -> Option<Image> {
        let overlap = |mask: &Image| {
            let pixels = mask.pixels.iter().filter(|odds| **odds > 0.0).count();
            let both = self.regions[k].iter().filter(|i| mask.pixels[**i] > 0.0).count();
            both as f64 / (pixels + self.regions[k].len() - both) as f64
        };
        let best = handed.iter().max_by(|a, b| overlap(a).total_cmp(&overlap(b)))?;
        (overlap(best) > SAME).then(|| best.clone())
    }

    /// How well a mask fits a moving region: the expected intersection over union with what moves. `None` if
    /// the mask is rejected.
    pub(super) fn fit(&self, k: usize, mask: &Image) -> Option<f64> {
        let inside = |i: usize| mask.pixels[i] > 0.0;
        let p = |i: usize| f64::from(probability(self.odds[i]));
        let (mut area, mut moving) = (0usize, 0.0);
        for i in (0..self.odds.len()).filter(|i| inside(*i)) {
            area += 1;
            moving += p(i);
        }
        if area == 0 || area as f64 >= LARGEST * self.odds.len() as f64 {
            return None;
        }
        // Neighbouring pixels are correlated.
        let alike = (2 * share(ABOUT, self.width) + 1).pow(2) as f64;
        let (mean, deviation) = self.level;
        let doubt = deviation / (area as f64 / alike).max(1.0).sqrt();
        let outside: f64 = self.regions[k].iter().filter(|i| !inside(**i)).map(|i| p(*i)).sum();
        let fit = moving / (area as f64 + outside);
        let above = moving / area as f64 > mean + ABOVE * doubt;
        (above && fit >= LEAST_FIT).then_some(fit)
    }

    /// The log odds from accepted masks, each with its region, for the pixels in the mask, in its region and
    /// beside both.
    pub(super) fn say(&self, accepted: &[(usize, Image)]) -> Vec<f32> {
        let mut said: Vec<Option<f32>> = vec![None; self.odds.len()];
        for (k, mask) in accepted {
            let own = |i: usize| self.region[i] == k + 1;
            let mut thing = Image::new(mask.width, mask.height, 1);
            for (i, value) in thing.pixels.iter_mut().enumerate() {
                *value = f32::from(u8::from(own(i) || mask.pixels[i] > 0.0));
            }
            let near = thing.near(share(MARGIN, self.width));
            for i in 0..said.len() {
                let odds = mask.pixels[i];
                // For other regions a mask gives only positive evidence.
                if odds > 0.0 || own(i) || (near[i] && self.region[i] == 0) {
                    let odds = odds.clamp(-BOUND, BOUND);
                    said[i] = Some(said[i].map_or(odds, |other| other.max(odds)));
                }
            }
        }
        said.into_iter().map(|said| said.unwrap_or(0.0)).collect()
    }

    /// Checks that a mask has the right size and no NaN values.
    pub(super) fn check(&self, FoundMask { odds, score }: &FoundMask) -> Result<()> {
        let (width, height) = (self.picture.width, self.picture.height);
        if (odds.width, odds.height, odds.channels) != (width, height, 1) {
            return Err(self.wrong(&format!(
                "a mask is {}×{} with {} channels; one channel of {width}×{height} was expected",
                odds.width, odds.height, odds.channels
            )));
        }
        match odds.pixels.iter().chain([score]).any(|value| value.is_nan()) {
            true => Err(self.wrong("a mask or its score is not a number")),
            false => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::super::tests::{mask, square, with_square};
    use super::*;
    use crate::track::sliding::{centre, within};

    #[test]
    fn a_mask_is_believed_if_it_fits_what_moves() {
        with_square(|frame| {
            let fit = |of: &dyn Fn(DVec2) -> bool| frame.fit(0, &mask(of));
            let whole = fit(&square).unwrap();
            // The expected fit: half of the pixels have log odds of 3, half have 1.
            let expected = 0.5 * f64::from(probability(3.0) + probability(1.0));
            assert!((whole - expected).abs() < 1e-6, "{whole} {expected}");
            // Undecided pixels may belong to the mover; static pixels lower the fit.
            let wider = fit(&|p| within(p, (20.0, 10.0), (44.0, 30.0))).unwrap();
            let across = fit(&|p| within(p, (16.0, 10.0), (40.0, 30.0))).unwrap();
            assert!(whole > wider && wider > across, "{whole} {wider} {across}");
            let wrong: [&dyn Fn(DVec2) -> bool; 5] = [
                &|_| true,
                &|_| false,
                &|p| !square(p),
                &|p| within(p, (30.0, 10.0), (40.0, 30.0)),
                &|p| within(p, (0.0, 0.0), (20.0, 40.0)),
            ];
            for (k, wrong) in wrong.into_iter().enumerate() {
                assert_eq!(fit(wrong), None, "{k}");
            }
        });
    }

    #[test]
    fn what_a_mask_says_is_bounded_and_about_its_region() {
        with_square(|frame| {
            let said = frame.say(&[(0, mask(|p| within(p, (22.0, 10.0), (42.0, 30.0))))]);
            for (i, said) in said.iter().enumerate() {
                let p = centre(i);
                let expected = match p {
                    p if within(p, (22.0, 10.0), (42.0, 30.0)) => BOUND,
                    p if within(p, (18.0, 8.0), (44.0, 32.0)) => -BOUND,
                    _ => 0.0,
                };
                assert_eq!(*said, expected, "{p}");
            }
        });
    }
}
