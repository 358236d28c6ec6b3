//! Known driver faults. Validation passes on a driver whose fault is listed, and fails again when
//! the listed fault no longer occurs.

use super::Outcome;

/// A case that a driver is known to fail.
#[derive(Clone, Copy, Debug)]
pub struct Expect {
    /// Part of the driver's name and version, as `splat4d devices` prints them.
    pub driver: &'static str,
    /// The case.
    pub case: &'static str,
    /// The driver's fault, and where it is documented.
    pub reason: &'static str,
}

/// The faults known so far: none.
pub const EXPECTED: &[Expect] = &[];

/// The verdict on a case's outcome.
#[derive(Clone, Copy, Debug)]
pub enum Verdict<'a> {
    /// The case passed as expected.
    Passed,
    /// The case failed and no fault is listed.
    Failed,
    /// The case failed with a listed fault.
    KnownFault(&'a Expect),
    /// The case passed although a fault is listed: the entry is out of date.
    FaultGone(&'a Expect),
}

impl Verdict<'_> {
    /// Whether validation may pass with this verdict.
    pub fn is_fine(&self) -> bool {
        matches!(self, Verdict::Passed | Verdict::KnownFault(_))
    }
}

/// Judges an outcome on a driver (name and version) against the listed faults. `clean` states that
/// the validation layer reported nothing.
pub fn verdict<'a>(
    outcome: &Outcome,
    clean: bool,
    driver: &str,
    expected: &'a [Expect],
) -> Verdict<'a> {
    let known = expected.iter().find(|e| e.case == outcome.id && driver.contains(e.driver));
    match (known, outcome.passed() && clean) {
        (None, true) => Verdict::Passed,
        (None, false) => Verdict::Failed,
        (Some(fault), false) => Verdict::KnownFault(fault),
        (Some(fault), true) => Verdict::FaultGone(fault),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::finding;
    use std::collections::BTreeSet;

    #[test]
    fn a_fault_is_expected_of_its_driver_only_and_must_show() {
        let outcome = |truth: u32| Outcome {
            id: "sort/sizes",
            seed: 0,
            findings: vec![finding::exact("keys", &[1], &[truth])],
            dispatched: BTreeSet::new(),
            error: None,
        };
        let expected =
            [Expect { driver: "llvmpipe", case: "sort/sizes", reason: "loses the last key" }];
        let judge = |truth, clean, driver| verdict(&outcome(truth), clean, driver, &expected);
        let (here, elsewhere) = ("llvmpipe Mesa 22.3.6", "SwiftShader driver 5.0.0");
        assert!(matches!(judge(1, true, elsewhere), Verdict::Passed));
        assert!(matches!(judge(2, true, elsewhere), Verdict::Failed));
        assert!(matches!(judge(1, false, elsewhere), Verdict::Failed), "the layer complained");
        assert!(matches!(judge(2, true, here), Verdict::KnownFault(_)));
        assert!(matches!(judge(1, true, here), Verdict::FaultGone(_)));
        assert!(!judge(1, true, here).is_fine() && judge(2, true, here).is_fine());
        let nothing = Outcome { findings: Vec::new(), ..outcome(1) };
        assert!(matches!(verdict(&nothing, true, elsewhere, &expected), Verdict::Failed));
    }
}
