//! Which cases hold the numerics contract, and which make the quick set.

/// The contract's hard cases, in its own words, with the cases that show each: a finite answer close
/// to the oracle, or the documented error.
pub const HARD: &[(&str, &[&str])] = &[
    (
        "splats at the near plane, behind the camera and at its centre",
        &["render/near_behind_and_at_the_camera"],
    ),
    ("needles of 1e6:1", &["render/needles"]),
    ("splats that cover every tile and sub-pixel ones", &["render/covering_and_sub_pixel"]),
    ("scales from 1e-20 to 1e20", &["render/scales", "arap/scales"]),
    ("opacity logits of ±40", &["render/opacities", "density/regularise", "density/shrink"]),
    (
        "zero, NaN, infinite and unnormalised quaternions",
        &["render/quaternions", "deform/degenerate", "density/jitter"],
    ),
    (
        "NaN or infinite anything",
        &["render/non_finite", "adam/hard", "deform/nearest", "density/adapt", "flow/pyramid"],
    ),
    ("thousands of layers on a pixel", &["render/layers_of_equal_depth", "raster/layers"]),
    ("equal depths", &["render/layers_of_equal_depth", "bin/equal_depths"]),
    ("extreme fields of view", &["render/fields_of_view"]),
    ("off-centre principal points", &["render/fields_of_view"]),
    ("scenes 1e6 from the origin", &["render/far_from_the_origin", "deform/far"]),
    ("images of 1×1, 17×3 and 4097 wide", &["raster/image_sizes", "bin/image_sizes"]),
    ("no splats at all", &["render/no_splats"]),
    ("intersection overflow", &["raster/overflow", "bin/overflow"]),
    ("sort of 0, 1, 255, 256, 257 and 2^k±1 keys", &["sort/sizes"]),
    ("sort of keys all equal, sorted, reversed", &["sort/orders"]),
    ("all skinning weights underflowing", &["deform/underflow"]),
    ("coincident control points", &["deform/degenerate"]),
    ("antipodal quaternions", &["deform/degenerate"]),
    ("collinear and coplanar ARAP neighbourhoods", &["arap/degenerate"]),
];

/// The quick set: every kernel, in under a minute on a software driver.
pub const QUICK: &[&str] = &["scan/sizes"];
