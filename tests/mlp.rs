//! The deformation network against its oracle.

mod common;

common::cases! { "mlp", folded to 40:
    narrow, paper, central_differences, shapes, accumulate, encoding,
}
