//! Point-track metrics as in TAP-Vid (Doersch et al. 2022).

use glam::DVec2;

use crate::types::Tracks;
use crate::{Error, Result};

/// Distance thresholds, in pixels of frames scaled to [`SIDE`] × [`SIDE`].
pub const WITHIN: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];
/// Side length that frames are scaled to for the thresholds, along both axes.
pub const SIDE: f64 = 256.0;

/// Point-track scores; all are shares, and 1 is the best. The query frame of a point is excluded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackScores {
    /// Average Jaccard: true positives over true positives, false positives and false negatives, averaged
    /// over the thresholds. Both position and visibility have to be right.
    pub average_jaccard: f64,
    /// Share of the visible points that are found within each threshold.
    pub within: [f64; WITHIN.len()],
    /// Share of all points whose visibility is predicted correctly.
    pub occlusion_accuracy: f64,
    /// Number of points.
    pub points: usize,
}

impl TrackScores {
    /// Mean of `within`.
    pub fn position_accuracy(&self) -> f64 {
        self.within.iter().sum::<f64>() / WITHIN.len() as f64
    }
}

/// Scores tracks of the same points against the ground truth, for the points whose index passes `counts`.
/// `None` where none are left.
///
/// # Errors
/// [`Error::Input`] where points or frames differ in number, or the ground truth lacks the size of its
/// frames.
pub fn score_tracks(
    found: &Tracks,
    truth: &Tracks,
    counts: impl Fn(usize) -> bool,
) -> Result<Option<TrackScores>> {
    let of = |tracks: &Tracks| (tracks.points.len(), tracks.frames());
    if of(found) != of(truth) {
        let ((points, frames), (true_points, true_frames)) = (of(found), of(truth));
        return Err(Error::Input(format!(
            "{points} points in {frames} frames cannot be held against {true_points} points in \
             {true_frames} frames: both must be of the same queries"
        )));
    }
    let Some((width, height)) = truth.size else {
        return Err(Error::Input("the true tracks do not say how large their frames are".into()));
    };
    let scale = SIDE / DVec2::new(f64::from(width), f64::from(height));
    let (mut told, mut seen, mut right, mut points) = (0usize, 0usize, 0usize, 0);
    let (mut within, mut hits) = ([0usize; WITHIN.len()], [0usize; WITHIN.len()]);
    let mut claimed = 0usize;
    for (_, (found, truth)) in
        found.points.iter().zip(&truth.points).enumerate().filter(|(i, _)| counts(*i))
    {
        points += 1;
        for frame in (0..truth.pixels.len()).filter(|frame| *frame != truth.query.0) {
            told += 1;
            right += usize::from(found.seen[frame] == truth.seen[frame]);
            claimed += usize::from(found.seen[frame]);
            if !truth.seen[frame] {
                continue;
            }
            seen += 1;
            let off = ((found.pixels[frame] - truth.pixels[frame]) * scale).length();
            for k in 0..WITHIN.len() {
                let near = off < WITHIN[k];
                within[k] += usize::from(near);
                hits[k] += usize::from(near && found.seen[frame]);
            }
        }
    }
    if seen == 0 {
        return Ok(None);
    }
    // Every claim that is not a hit is a false positive; every visible point counts once below.
    let jaccard = hits.map(|hits| hits as f64 / (seen + claimed - hits) as f64);
    Ok(Some(TrackScores {
        average_jaccard: jaccard.iter().sum::<f64>() / WITHIN.len() as f64,
        within: within.map(|within| within as f64 / seen as f64),
        occlusion_accuracy: right as f64 / told as f64,
        points,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::PointPath;

    /// Two points in four frames of 512×256; the second is occluded in the last.
    fn truth() -> Tracks {
        let point = |i: usize| PointPath {
            query: (0, DVec2::new(10.0, 10.0)),
            pixels: (0..4).map(|t| DVec2::new(10.0 + 8.0 * t as f64, 10.0 + i as f64)).collect(),
            seen: (0..4).map(|t| i == 0 || t < 3).collect(),
        };
        Tracks { size: Some((512, 256)), points: vec![point(0), point(1)] }
    }

    #[test]
    fn what_is_right_scores_one() {
        let scores = score_tracks(&truth(), &truth(), |_| true).unwrap().unwrap();
        assert_eq!(
            (scores.average_jaccard, scores.occlusion_accuracy, scores.points),
            (1.0, 1.0, 2)
        );
        assert_eq!(scores.position_accuracy(), 1.0);
    }

    #[test]
    fn errors_count_as_tap_vid_counts_them() {
        let mut found = truth();
        // Six pixels of 512 along x are three of 256: not within 1 or 2.
        found.points[0].pixels[1].x += 6.0;
        // A visible point predicted as occluded, and the reverse.
        found.points[0].seen[2] = false;
        found.points[1].seen[3] = true;
        // The query frame does not count.
        found.points[1].pixels[0].x += 100.0;
        let scores = score_tracks(&found, &truth(), |_| true).unwrap().unwrap();
        // Five are visible, five are claimed.
        assert_eq!(scores.within, [0.8, 0.8, 1.0, 1.0, 1.0]);
        assert_eq!(scores.occlusion_accuracy, 4.0 / 6.0);
        // Three hits of five and five; four within 4 and more.
        let expected = (2.0 * 3.0 / 7.0 + 3.0 * 4.0 / 6.0) / 5.0;
        assert!((scores.average_jaccard - expected).abs() < 1e-12, "{scores:?}");
        let second = score_tracks(&found, &truth(), |i| i == 1).unwrap().unwrap();
        assert_eq!((second.points, second.within), (1, [1.0; 5]));
    }

    #[test]
    fn what_cannot_be_compared_is_told() {
        let (mut short, mut unsized_) = (truth(), truth());
        short.points.pop();
        unsized_.size = None;
        assert!(score_tracks(&short, &truth(), |_| true).is_err());
        assert!(score_tracks(&truth(), &unsized_, |_| true).is_err());
        assert_eq!(score_tracks(&truth(), &truth(), |_| false).unwrap(), None);
        // An unknown position is not found.
        let mut lost = truth();
        lost.points[0].pixels[1] = DVec2::NAN;
        let scores = score_tracks(&lost, &truth(), |_| true).unwrap().unwrap();
        assert_eq!(scores.within, [0.8; 5]);
    }
}
