//! A symmetric matrix in envelope (skyline) storage: each row from its first non-zero entry to the diagonal.
//!
//! Points are seen by nearby frames, so a camera is coupled with nearby cameras. The Cholesky factor of
//! such a matrix has no entries before the matrix's first one in the same row (George and Liu, *Computer
//! Solution of Large Sparse Positive Definite Systems*, 1981, chapter 4), so that it fits into the same
//! storage. Where each camera is coupled with a bounded number of others, memory and time grow linearly
//! with the number of cameras. Unknowns that are coupled with all others belong in the last rows.

use nalgebra::{DMatrix, DVector};

/// The lower triangle of a symmetric matrix.
#[derive(Clone, Debug)]
pub(crate) struct Envelope {
    /// First column of each row.
    first: Vec<usize>,
    /// Offset of each row in `values`, and the end offset.
    start: Vec<usize>,
    values: Vec<f64>,
}

impl Envelope {
    /// A zero matrix; row r has columns `first[r]..=r`.
    pub(crate) fn zeros(first: Vec<usize>) -> Envelope {
        let mut start = Vec::with_capacity(first.len() + 1);
        start.push(0);
        for (row, first) in first.iter().enumerate() {
            start.push(start[row] + row + 1 - first);
        }
        let values = vec![0.0; start[first.len()]];
        Envelope { first, start, values }
    }

    /// Number of rows.
    pub(crate) fn size(&self) -> usize {
        self.first.len()
    }

    /// The entries of a row from column `from` (at or after its first one) to the diagonal.
    pub(crate) fn row_mut(&mut self, row: usize, from: usize) -> &mut [f64] {
        let skipped = from - self.first[row];
        &mut self.values[self.start[row] + skipped..self.start[row + 1]]
    }

    fn row(&self, row: usize, from: usize) -> &[f64] {
        &self.values[self.start[row] + from - self.first[row]..self.start[row + 1]]
    }

    /// A diagonal entry.
    pub(crate) fn diagonal(&self, row: usize) -> f64 {
        self.values[self.start[row + 1] - 1]
    }

    pub(crate) fn diagonal_mut(&mut self, row: usize) -> &mut f64 {
        &mut self.values[self.start[row + 1] - 1]
    }

    /// The largest diagonal entry; 0 for an empty matrix.
    pub(crate) fn largest_diagonal(&self) -> f64 {
        (0..self.size()).map(|row| self.diagonal(row)).fold(0.0, f64::max)
    }

    /// Adds `factor` times a matrix with the same envelope.
    pub(crate) fn add(&mut self, factor: f64, other: &Envelope) {
        debug_assert_eq!(self.first, other.first);
        self.values.iter_mut().zip(&other.values).for_each(|(a, b)| *a += factor * b);
    }

    /// The dense matrix, with both triangles.
    pub(crate) fn to_dense(&self) -> DMatrix<f64> {
        let mut dense = DMatrix::zeros(self.size(), self.size());
        for row in 0..self.size() {
            for (column, value) in (self.first[row]..).zip(self.row(row, self.first[row])) {
                (dense[(row, column)], dense[(column, row)]) = (*value, *value);
            }
        }
        dense
    }

    /// The Cholesky factor, with the same envelope; `None` unless the matrix is positive definite.
    pub(crate) fn cholesky(mut self) -> Option<Factor> {
        for row in 0..self.size() {
            let first = self.first[row];
            let (above, own) = self.values.split_at_mut(self.start[row]);
            for column in first..row {
                let from = first.max(self.first[column]);
                let end = self.start[column + 1] - 1;
                let other = &above[end - (column - from)..end];
                let (solved, rest) = own.split_at_mut(column - first);
                rest[0] = (rest[0] - dot(&solved[from - first..], other)) / above[end];
            }
            let (solved, rest) = own.split_at_mut(row - first);
            let pivot = rest[0] - dot(solved, solved);
            if !(pivot > 0.0 && pivot.is_finite()) {
                return None;
            }
            rest[0] = pivot.sqrt();
        }
        Some(Factor(self))
    }
}

/// The factor L of L Lᵀ.
pub(crate) struct Factor(Envelope);

impl Factor {
    /// Solves L Lᵀ x = `right`.
    pub(crate) fn solve(&self, right: &DVector<f64>) -> DVector<f64> {
        let lower = &self.0;
        let mut x = right.clone();
        let values = x.as_mut_slice();
        for row in 0..lower.size() {
            let first = lower.first[row];
            let (diagonal, own) = lower.row(row, first).split_last().expect("rows have diagonals");
            values[row] = (values[row] - dot(own, &values[first..row])) / diagonal;
        }
        for row in (0..lower.size()).rev() {
            let first = lower.first[row];
            let (diagonal, own) = lower.row(row, first).split_last().expect("rows have diagonals");
            values[row] /= diagonal;
            let solved = values[row];
            values[first..row].iter_mut().zip(own).for_each(|(v, l)| *v -= l * solved);
        }
        x
    }
}

/// Dot product in eight partial sums, which vectorises; a single sum would fix the order.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    const LANES: usize = 8;
    let (a, a_tail) = a.as_chunks::<LANES>();
    let (b, b_tail) = b.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let tail: f64 = a_tail.iter().zip(b_tail).map(|(a, b)| a * b).sum();
    let [a, b, c, d, e, f, g, h] = sums;
    ((a + b) + (c + d)) + ((e + f) + (g + h)) + tail
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A band matrix with ragged rows, one row coupled with all, and a dominant diagonal.
    fn ragged() -> Envelope {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let first = (0..60).map(|row: usize| match row {
            59 => 0,
            _ => row - random.random_range(0..=row.min(19)),
        });
        let mut matrix = Envelope::zeros(first.collect());
        for row in 0..60 {
            let from = matrix.first[row];
            for value in matrix.row_mut(row, from) {
                *value = random.random_range(-1.0..1.0);
            }
            *matrix.diagonal_mut(row) = 30.0;
        }
        matrix
    }

    #[test]
    fn a_system_is_solved_as_the_dense_one() {
        let matrix = ragged();
        let right = DVector::from_fn(60, |row, _| (row as f64).sin());
        let expected = matrix.to_dense().cholesky().unwrap().solve(&right);
        let found = matrix.clone().cholesky().unwrap().solve(&right);
        assert!((found - &expected).amax() < 1e-14 * expected.amax());
        assert_eq!(matrix.largest_diagonal(), 30.0);
    }

    #[test]
    fn what_is_not_positive_definite_has_no_factor() {
        let mut matrix = ragged();
        *matrix.diagonal_mut(40) = -1.0;
        assert!(matrix.clone().cholesky().is_none());
        *matrix.diagonal_mut(40) = f64::NAN;
        assert!(matrix.cholesky().is_none());
        let nothing = Envelope::zeros(Vec::new()).cholesky().unwrap();
        assert_eq!(nothing.solve(&DVector::zeros(0)).len(), 0);
    }
}
