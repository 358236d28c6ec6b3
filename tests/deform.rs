//! Skinning and nearest control points against their oracle.

mod common;

common::cases! { "deform", folded to 40:
    nearest, hard_motion, soft_motion, central_differences, underflow, degenerate, far, still,
    repeat,
}
