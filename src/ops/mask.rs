//! The mask loss on the device: rendered probabilities of motion are compared with motion masks.
//!
//! `oracle::mask` has the formulae. [`paint`] turns the Gaussians' probabilities of motion into colours,
//! [`Frame::blend`] blends these, [`compare`] compares the result with the mask, and [`vote`]
//! distributes what [`Frame::blend_backward`] gathers over the Gaussians. This costs one more blending
//! pass forward and one backward, without projection and sorting.
//!
//! [`Frame::blend`]: super::render::Frame::blend
//! [`Frame::blend_backward`]: super::render::Frame::blend_backward

use super::at_least;
use super::render::{PixelBuffers, PixelGradients};
use crate::Result;
use crate::gpu::{Groups, Recorder, View, ViewMut};
use crate::kernels::mask as kernels;

const WORKGROUP: u32 = 64;

/// Records `mask/paint`: the probability of motion of each logit becomes the red channel of a colour.
///
/// # Errors
/// [`Error::Shape`](crate::Error::Shape) for fewer colours than logits.
pub fn paint(
    recorder: &mut Recorder,
    motion_logits: View<'_, f32>,
    colours: ViewMut<'_, [f32; 4]>,
) -> Result<()> {
    let count = motion_logits.len();
    at_least("mask", &[("colours", count, colours.len())])?;
    recorder.dispatch::<kernels::Paint>(
        Groups::linear(count, WORKGROUP, recorder.device().limits())?,
        kernels::PaintParams { count: count as u32 },
        kernels::PaintArgs { motion_logits, colours },
    )
}

/// Records `mask/compare`: the mean absolute difference between a rendered image's red channel and a
/// mask (1 where something moves), with a weight in the loss. It writes the gradient with respect to the
/// image's colours; the gradient with respect to depth is not written, since colours do not depend on
/// it.
///
/// # Errors
/// [`Error::Shape`](crate::Error::Shape) where the sizes differ.
pub fn compare(
    recorder: &mut Recorder,
    rendered: &PixelBuffers,
    mask: View<'_, f32>,
    weight: f64,
    gradients: &mut PixelGradients,
) -> Result<()> {
    let pixels = rendered.width as usize * rendered.height as usize;
    at_least("mask", &[("mask", pixels, mask.len()), ("gradient", pixels, gradients.rgba.len())])?;
    recorder.dispatch::<kernels::Compare>(
        Groups::linear(pixels, WORKGROUP, recorder.device().limits())?,
        kernels::CompareParams {
            pixels: pixels as u32,
            factor: (weight / pixels.max(1) as f64) as f32,
        },
        kernels::CompareArgs {
            rgba: rendered.rgba.view(),
            mask,
            rgba_gradient: gradients.rgba.view_mut(),
        },
    )
}

/// Inputs and outputs of a vote, for as many Gaussians as there are logits; the other arrays may be
/// longer.
pub struct VoteArgs<'a> {
    /// The gradients with respect to the Gaussians' colours.
    pub colour_gradients: View<'a, [f32; 4]>,
    /// One word for each Gaussian, not 0 where it is visible in the image.
    pub visible: View<'a, u32>,
    /// Where this holds 0, the vote changes nothing.
    pub fits: View<'a, u32>,
    /// Motion logits.
    pub motion_logits: View<'a, f32>,
    /// The gradient with respect to the motion logits; accumulated.
    pub motion_gradients: ViewMut<'a, f32>,
    /// Two values for each Gaussian, votes for motion and all votes; accumulated.
    pub votes: ViewMut<'a, f32>,
    /// Votes for motion divided by all votes, in [0, 1]; unchanged where there is no vote.
    pub evidence: ViewMut<'a, f32>,
}

/// Records `mask/vote`.
///
/// # Errors
/// [`Error::Shape`](crate::Error::Shape) where an array is too short.
pub fn vote(recorder: &mut Recorder, args: VoteArgs<'_>) -> Result<()> {
    let count = args.motion_logits.len();
    at_least(
        "mask",
        &[
            ("colour gradients", count, args.colour_gradients.len()),
            ("visible", count, args.visible.len()),
            ("fits", 1, args.fits.len()),
            ("motion gradients", count, args.motion_gradients.len()),
            ("votes", 2 * count, args.votes.len()),
            ("evidence", count, args.evidence.len()),
        ],
    )?;
    recorder.dispatch::<kernels::Vote>(
        Groups::linear(count, WORKGROUP, recorder.device().limits())?,
        kernels::VoteParams { count: count as u32 },
        kernels::VoteArgs {
            colour_gradients: args.colour_gradients,
            visible: args.visible,
            fits: args.fits,
            motion_logits: args.motion_logits,
            motion_gradients: args.motion_gradients,
            votes: args.votes,
            evidence: args.evidence,
        },
    )
}
