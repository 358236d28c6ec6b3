//! The path of an object along the line of sight, bent towards estimates of its depth.

/// An estimate, mostly of the logarithm of a quantity, and its standard deviation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Estimate {
    pub value: f64,
    pub deviation: f64,
}

impl Estimate {
    /// The mean of two independent estimates of one quantity, with inverse-variance weights.
    pub(super) fn and(self, other: Estimate) -> Estimate {
        let (a, b) = (self.deviation.powi(-2), other.deviation.powi(-2));
        Estimate {
            value: (a * self.value + b * other.value) / (a + b),
            deviation: (a + b).sqrt().recip(),
        }
    }

    /// Whether an independent estimate of the same quantity is within three standard deviations.
    pub(super) fn agrees_with(self, other: Estimate) -> bool {
        let deviation = self.deviation.hypot(other.deviation);
        (self.value - other.value).abs() <= 3.0 * deviation
    }

    /// The standard deviation relative to the value.
    pub(super) fn relative(&self) -> f64 {
        self.deviation / self.value.abs()
    }
}

/// The robust kernel of the targets of a path.
pub(super) struct Pull {
    /// Initial width of the robust kernel, in standard deviations of the target; the final width is one.
    pub first_width: f64,
    /// Exponent of the kernel's weight: 1 gives Cauchy's kernel, which still weights distant targets; 2 gives
    /// Geman and McClure's kernel, which ignores them.
    pub power: i32,
}

/// The least-squares path that keeps the steps of `path`, within each step's standard deviation, and
/// approaches the targets, iterated from `first` with robust weights.
pub(super) fn bent(
    path: &[f64],
    first: &[f64],
    targets: &[Option<Estimate>],
    Pull { first_width, power }: Pull,
    steps: &[f64],
) -> Vec<f64> {
    let n = path.len();
    let mut bent = first.to_vec();
    for round in 0..10 {
        // The kernel narrows from its initial width to one deviation.
        let width = f64::max(1.0, first_width * 0.5f64.powi(round));
        // The normal equations are tridiagonal.
        let (mut diagonal, mut right) = (vec![1e-9; n], vec![0.0; n]);
        for (k, target) in targets.iter().enumerate() {
            let Some(Estimate { value, deviation }) = target else { continue };
            let off = (value - bent[k]) / (width * deviation);
            let weight = deviation.powi(-2) / (1.0 + off * off).powi(power);
            diagonal[k] += weight;
            right[k] += weight * value;
        }
        for k in 0..n - 1 {
            let stiff = steps[k].powi(-2);
            let change = path[k + 1] - path[k];
            diagonal[k] += stiff;
            diagonal[k + 1] += stiff;
            right[k] -= stiff * change;
            right[k + 1] += stiff * change;
        }
        for k in 1..n {
            let stiff = steps[k - 1].powi(-2);
            let factor = stiff / diagonal[k - 1];
            diagonal[k] -= factor * stiff;
            right[k] += factor * right[k - 1];
        }
        bent[n - 1] = right[n - 1] / diagonal[n - 1];
        for k in (0..n - 1).rev() {
            bent[k] = (right[k] + steps[k].powi(-2) * bent[k + 1]) / diagonal[k];
        }
    }
    bent
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn estimates_are_averaged_by_their_deviations() {
        let sure = Estimate { value: 1.0, deviation: 0.1 };
        let both = sure.and(Estimate { value: 2.0, deviation: 0.2 });
        assert!((both.value - 1.2).abs() < 1e-12);
        assert!((both.deviation - 0.1 / 1.25f64.sqrt()).abs() < 1e-12);
    }
}
