//! Scenes found by fuzzing, as written by `splat4d validate --fuzz`; the faults are fixed.

/// Name and JSON text of each scene.
pub const ALL: &[(&str, &str)] = &[
    ("ordinary", include_str!("cases/ordinary.json")),
    // Spherical harmonics of 1e38: the colour was finite, its gradient was not.
    ("huge coefficient", include_str!("cases/huge_coefficient.json")),
    ("huge coefficient far away", include_str!("cases/huge_coefficient_far_away.json")),
    // The contribution behind a splat of alpha 0.999 is a difference of sums a thousand times as
    // large.
    ("behind a capped splat", include_str!("cases/behind_a_capped_splat.json")),
    // Rounding made the power of pixels on a needle of 1e7 units negative, and they were skipped.
    ("needle without pixels", include_str!("cases/needle_without_pixels.json")),
    ("needle across a corner", include_str!("cases/needle_across_a_corner.json")),
    // The gradient with respect to a needle's length was lost to cancellation.
    ("needle by its length", include_str!("cases/needle_by_its_length.json")),
    ("needle far away", include_str!("cases/needle_far_away.json")),
    // A colour of 4e-8: rounding decides whether it is clamped and its gradient is 0.
    ("colour at the clamp", include_str!("cases/colour_at_the_clamp.json")),
    // An opacity six ulp above the cut: rounding decides the splat's extent, and with it whether a
    // tile lists the splat.
    ("opacity at the cut", include_str!("cases/opacity_at_the_cut.json")),
    // A quaternion of 1e38: one over it is subnormal, a GPU flushed it to zero, and nothing was drawn.
    ("huge quaternion", include_str!("cases/huge_quaternion.json")),
];
