//! Images in texture formats.

mod common;

common::cases! { "texel", folded to 4: unorm8, half }
