//! Association of the poses of two trajectories by time stamp.

use std::cmp::{Ordering, Reverse};
use std::collections::{BinaryHeap, VecDeque};

/// Pairs (estimate, reference) of closest time stamps, at most `max_difference` (seconds) apart, each used
/// once, in the order of the estimate.
///
/// The closest pairs are matched first, as in TUM's evaluation; of equally close pairs, the one with the
/// lower indices. Time stamps need not be sorted; non-finite ones are never matched. Takes O(n log n) time
/// and linear memory, however many time stamps are equal.
pub fn match_by_time(
    estimate: &[f64],
    reference: &[f64],
    max_difference: f64,
) -> Vec<(usize, usize)> {
    let mut pairs: Vec<(usize, usize)> = Vec::new();
    let mut line = TimeLine::new(estimate, reference, max_difference, &mut pairs);
    while let Some(Reverse(next)) = line.candidates.pop() {
        line.serve(&next, &mut pairs);
    }
    pairs.sort_unstable();
    pairs
}

/// Pairs (estimate, reference) in the order of the shorter list. Each of its time stamps is paired with the
/// nearest one of the longer list, the earlier of two equally near, if it is at most `max_difference`
/// (seconds) away after `offset` is added to the estimate's.
///
/// This is how the `evo` package pairs poses. Of lists of equal length the estimate counts as the shorter
/// one. One time stamp of the longer list may be paired with several of the shorter; [`match_by_time`] uses
/// each once. Lists of identical time stamps pair in order, however many are equal. Non-finite time stamps
/// are never matched. Takes O(n log n) time.
pub fn nearest_by_time(
    estimate: &[f64],
    reference: &[f64],
    max_difference: f64,
    offset: f64,
) -> Vec<(usize, usize)> {
    // The offset is added to the longer list in both cases, so that sums round alike.
    let swapped = estimate.len() > reference.len();
    let (short, long, offset) =
        if swapped { (reference, estimate, offset) } else { (estimate, reference, -offset) };
    let same = |(short, long): (&f64, &f64)| *short == long + offset;
    if short.len() == long.len() && max_difference >= 0.0 && short.iter().zip(long).all(same) {
        return (0..short.len()).map(|i| (i, i)).collect();
    }
    let mut sorted: Vec<(f64, usize)> = long
        .iter()
        .enumerate()
        .map(|(i, time)| (time + offset + 0.0, i))
        .filter(|(time, _)| time.is_finite())
        .collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let rises = long.windows(2).all(|pair| pair[0] + offset <= pair[1] + offset);
    let nearest = |time: f64| {
        let above = sorted.partition_point(|(other, _)| *other <= time);
        // Of equal times, the one at the nearest index; in an unsorted list, the first.
        let below = above.checked_sub(1).map(|last| match rises {
            true => last,
            false => sorted.partition_point(|(other, _)| *other < sorted[last].0),
        });
        let candidates = [below, Some(above).filter(|i| *i < sorted.len())];
        let error = |i: &usize| (sorted[*i].0 - time).abs();
        let order = |a: &usize, b: &usize| {
            error(a).total_cmp(&error(b)).then(sorted[*a].1.cmp(&sorted[*b].1))
        };
        let found = candidates.into_iter().flatten().min_by(order)?;
        (error(&found) <= max_difference).then_some(sorted[found].1)
    };
    let pairs = short.iter().enumerate().filter_map(|(i, time)| {
        let j = nearest(*time).filter(|_| time.is_finite())?;
        Some(if swapped { (j, i) } else { (i, j) })
    });
    pairs.collect()
}

/// Indices of one list that share a time stamp.
struct Moment {
    time: f64,
    of_estimate: bool,
    /// Indices not paired yet, ascending.
    left: VecDeque<usize>,
    before: Option<usize>,
    after: Option<usize>,
}

/// Two adjacent moments, one of each list, that could be paired next.
struct Candidate {
    difference: f64,
    /// First of the remaining indices.
    estimate: usize,
    reference: usize,
    /// The earlier moment and the later one.
    moments: (usize, usize),
}

impl Ord for Candidate {
    fn cmp(&self, other: &Candidate) -> Ordering {
        let indices = |c: &Candidate| (c.estimate, c.reference);
        self.difference.total_cmp(&other.difference).then(indices(self).cmp(&indices(other)))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Candidate) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Candidate) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

/// The moments in the order of time. The closest pair of all is always in adjacent moments, because one
/// between them would be closer.
struct TimeLine {
    moments: Vec<Moment>,
    candidates: BinaryHeap<Reverse<Candidate>>,
    max_difference: f64,
}

impl TimeLine {
    /// Pairs equal times at once, because no pair is closer.
    fn new(
        estimate: &[f64],
        reference: &[f64],
        max_difference: f64,
        pairs: &mut Vec<(usize, usize)>,
    ) -> TimeLine {
        let stamps = |times: &[f64], of_estimate: bool| {
            let finite = times.iter().copied().enumerate().filter(|(_, time)| time.is_finite());
            // Normalises −0 to 0, so that both are one moment.
            finite.map(|(i, time)| (time + 0.0, of_estimate, i)).collect::<Vec<_>>()
        };
        let mut stamps = [stamps(estimate, true), stamps(reference, false)].concat();
        stamps.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
        let mut line =
            TimeLine { moments: Vec::new(), candidates: BinaryHeap::new(), max_difference };
        for same in stamps.chunk_by(|a, b| a.0 == b.0) {
            let of = |wanted: bool| {
                let stamps = same.iter().filter(move |(_, of_estimate, _)| *of_estimate == wanted);
                stamps.map(|&(_, _, i)| i).collect::<VecDeque<usize>>()
            };
            let mut left = [of(true), of(false)];
            let equal = if max_difference >= 0.0 { left[0].len().min(left[1].len()) } else { 0 };
            let [ours, theirs] = &mut left;
            pairs.extend(ours.drain(..equal).zip(theirs.drain(..equal)));
            for (left, of_estimate) in left.into_iter().zip([true, false]) {
                if !left.is_empty() {
                    let (before, after) = (line.moments.len().checked_sub(1), None);
                    line.moments.push(Moment { time: same[0].0, of_estimate, left, before, after });
                }
            }
        }
        for later in 1..line.moments.len() {
            line.moments[later - 1].after = Some(later);
            line.offer(Some(later - 1), Some(later));
        }
        line
    }

    /// Adds adjacent moments as a candidate, if they belong to different lists and are close enough.
    fn offer(&mut self, earlier: Option<usize>, later: Option<usize>) {
        let (Some(earlier), Some(later)) = (earlier, later) else { return };
        let (a, b) = (&self.moments[earlier], &self.moments[later]);
        let (ours, theirs) = match (a.of_estimate, b.of_estimate) {
            (true, false) => (a, b),
            (false, true) => (b, a),
            _ => return,
        };
        let reach = self.max_difference;
        let near = theirs.time >= ours.time - reach && theirs.time <= ours.time + reach;
        if let (true, Some(&estimate), Some(&reference)) =
            (near, ours.left.front(), theirs.left.front())
        {
            self.candidates.push(Reverse(Candidate {
                difference: (theirs.time - ours.time).abs(),
                estimate,
                reference,
                moments: (earlier, later),
            }));
        }
    }

    /// Pairs a candidate, unless one of its members was paired before.
    fn serve(&mut self, next: &Candidate, pairs: &mut Vec<(usize, usize)>) {
        let (earlier, later) = next.moments;
        let (ours, theirs) = match self.moments[earlier].of_estimate {
            true => (earlier, later),
            false => (later, earlier),
        };
        let first = |moment: usize| self.moments[moment].left.front().copied();
        if (first(ours), first(theirs)) != (Some(next.estimate), Some(next.reference)) {
            return;
        }
        pairs.push((next.estimate, next.reference));
        for moment in [earlier, later] {
            self.moments[moment].left.pop_front();
            if self.moments[moment].left.is_empty() {
                let Moment { before, after, .. } = self.moments[moment];
                if let Some(before) = before {
                    self.moments[before].after = after;
                }
                if let Some(after) = after {
                    self.moments[after].before = before;
                }
            }
        }
        // Updates the candidates at these positions.
        let is_left = |moment: usize| !self.moments[moment].left.is_empty();
        match (is_left(earlier), is_left(later)) {
            (true, true) => {
                self.offer(self.moments[earlier].before, Some(earlier));
                self.offer(Some(earlier), Some(later));
                self.offer(Some(later), self.moments[later].after);
            }
            (true, false) => {
                self.offer(self.moments[earlier].before, Some(earlier));
                self.offer(Some(earlier), self.moments[earlier].after);
            }
            (false, true) => {
                self.offer(self.moments[later].before, Some(later));
                self.offer(Some(later), self.moments[later].after);
            }
            (false, false) => self.offer(self.moments[earlier].before, self.moments[later].after),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_stamps_pair_with_the_nearest_once() {
        let pairs = match_by_time(&[0.0, 1.0, 1.02, 2.0, f64::NAN], &[2.01, 1.015, 0.2, 9.0], 0.05);
        assert_eq!(pairs, vec![(2, 1), (3, 0)]);
        assert!(match_by_time(&[], &[1.0], 1.0).is_empty());
    }

    /// The definition: all pairs that are near enough, closest first. Takes quadratic memory.
    fn match_by_definition(ours: &[f64], theirs: &[f64], reach: f64) -> Vec<(usize, usize)> {
        let near = |a: f64, b: f64| b >= a - reach && b <= a + reach;
        let mut all = Vec::new();
        for (i, &a) in ours.iter().enumerate() {
            let close = theirs.iter().enumerate().filter(|&(_, &b)| near(a, b));
            all.extend(close.map(|(j, &b)| ((b - a).abs(), i, j)));
        }
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let (mut taken, mut pairs) = ((Vec::new(), Vec::new()), Vec::new());
        for (_, i, j) in all {
            if !taken.0.contains(&i) && !taken.1.contains(&j) {
                taken.0.push(i);
                taken.1.push(j);
                pairs.push((i, j));
            }
        }
        pairs.sort_unstable();
        pairs
    }

    #[test]
    fn time_stamps_pair_as_the_definition_says() {
        use rand::{RngExt, SeedableRng};
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        for round in 0..3000 {
            // Multiples of a quarter give equal times and equal differences, both exact. Other values give
            // hardly any.
            let coarse = round % 2 == 0;
            let mut list = || -> Vec<f64> {
                let len = random.random_range(0..24);
                let mut time = || match random.random_range(0.0..6.0) {
                    time if coarse => f64::floor(4.0 * time) / 4.0,
                    time => time,
                };
                (0..len).map(|_| time()).collect()
            };
            let (ours, theirs) = (list(), list());
            for reach in [-1.0, 0.0, 0.25, 0.6, f64::INFINITY, f64::NAN] {
                let found = match_by_time(&ours, &theirs, reach);
                let wanted = match_by_definition(&ours, &theirs, reach);
                assert_eq!(found, wanted, "{ours:?}, {theirs:?}, {reach}");
            }
        }
        assert_eq!(match_by_time(&[0.0, -0.0], &[-0.0, 0.0], 0.0), [(0, 0), (1, 1)]);
    }

    #[test]
    fn many_equal_time_stamps_take_linear_memory() {
        let count = 300_000;
        let whole: Vec<(usize, usize)> = (0..count).map(|i| (i, i)).collect();
        assert_eq!(match_by_time(&vec![7.0; count], &vec![7.0; count], 0.02), whole);
        assert_eq!(match_by_time(&vec![7.0; count], &vec![7.01; count], 0.02), whole);
    }

    #[test]
    fn the_shorter_list_takes_the_nearest_of_the_longer() {
        let near = |a: &[f64], b: &[f64], offset| nearest_by_time(a, b, 0.25, offset);
        // One is too far; two share one; ties take the earlier.
        assert_eq!(near(&[0.0, 1.0, 2.0], &[0.25, 0.75, 1.25, 3.0], 0.0), [(0, 0), (1, 1)]);
        assert_eq!(near(&[0.0, 0.125, 9.0, 9.5, 9.75], &[0.0, 9.25], 0.0), [(0, 0), (2, 1)]);
        assert_eq!(near(&[0.0, 0.125], &[0.0, 9.25], 0.0), [(0, 0), (1, 0)]);
        // The offset is the estimate's, whichever list is longer.
        assert_eq!(near(&[5.0, 6.0], &[0.0, 1.0, 2.0], -5.0), [(0, 0), (1, 1)]);
        assert_eq!(near(&[5.0, 6.0, 7.0], &[0.0, 1.0], -5.0), [(0, 0), (1, 1)]);
        assert_eq!(near(&[5.0, 5.0, 6.0], &[5.0, 5.0, 6.0], 0.0), [(0, 0), (1, 1), (2, 2)]);
        // Unsorted and non-finite time stamps.
        assert_eq!(near(&[1.0, f64::NAN], &[3.0, 1.25, f64::NAN, 0.75], 0.0), [(0, 1)]);
        assert!(near(&[], &[1.0], 0.0).is_empty() && near(&[1.0], &[], 0.0).is_empty());
    }
}
