//! Density control against its oracle.

mod common;

common::cases! { "density", folded to 40:
    relocate, grow, shrink, jitter, adapt, regularise, central_differences, statistics,
}
