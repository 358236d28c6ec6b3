//! Check cases of the loss of rendered motion against motion masks.

use super::scene::{random, skew_camera};
use super::{Bound, Case, Harness};
use crate::error::Result;
use crate::ops::gaussians::GaussianBuffers;
use crate::ops::mask::{VoteArgs, compare, paint, vote};
use crate::ops::render::{Frame, Render};
use crate::oracle::mask;
use crate::types::RenderSettings;
use rand::RngExt;

/// The family's cases.
pub const CASES: &[Case] = &[
    Case { id: "mask/paint", run: painting },
    Case { id: "mask/compare", run: comparing },
    Case { id: "mask/vote", run: voting },
    Case { id: "mask/blend", run: blending },
];

const SMALL: Bound = Bound { absolute: 1e-6, relative: 1e-6 };

fn values(h: &mut Harness, count: usize, low: f32, high: f32) -> Vec<f32> {
    (0..count).map(|_| h.rng.random_range(low..high)).collect()
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

fn painting(h: &mut Harness) -> Result<()> {
    for count in [0, 1, 64, 1000] {
        let mut logits = values(h, count, -9.0, 9.0);
        if count > 9 {
            logits[..4].copy_from_slice(&[40.0, -40.0, f32::INFINITY, f32::NEG_INFINITY]);
        }
        let buffer = h.device.upload("motion logits", &logits)?;
        let mut colours = h.output::<[f32; 4]>("colours", count)?;
        let mut recorder = h.stream.record()?;
        paint(&mut recorder, buffer.view(), colours.view_mut())?;
        h.stream.submit(recorder)?;
        let flat = |rgb: &[f64; 3]| [rgb[0], rgb[1], rgb[2], 0.0];
        let truth: Vec<f64> = mask::paint(&wide(&logits)).iter().flat_map(flat).collect();
        let device = h.read(&colours)?;
        h.close("colours", device.as_flattened(), &truth, None, SMALL);
    }
    Ok(())
}

fn comparing(h: &mut Harness) -> Result<()> {
    for (width, height) in [(1, 1), (17, 3), (80, 41)] {
        let device = h.device.clone();
        let pixels = (width * height) as usize;
        let render = Render::plan(&device, 1, 1, width, height, RenderSettings::default())?;
        let (mut rendered, mut gradients) =
            (render.pixels(&device)?, render.pixel_gradients(&device)?);
        let red = values(h, pixels, 0.0, 1.0);
        let mut truth: Vec<f32> = red.iter().map(|r| f32::from(*r > 0.4)).collect();
        // Where both values are equal the slope is zero.
        truth[0] = red[0];
        let rgba: Vec<[f32; 4]> = red.iter().map(|&r| [r, 7.0, -7.0, 0.5]).collect();
        h.stream.upload(&mut rendered.rgba, &rgba)?;
        let buffer = device.upload("mask", &truth)?;
        let mut out = h.output::<[f32; 4]>("gradient", pixels)?;
        let mut recorder = h.stream.record()?;
        compare(&mut recorder, &rendered, buffer.view(), 0.5, &mut gradients)?;
        recorder.copy(gradients.rgba.view(), out.view_mut());
        h.stream.submit(recorder)?;
        let expected = mask::compare(&wide(&red), &wide(&truth), 0.5 / pixels as f64);
        let expected: Vec<f64> = expected.iter().flat_map(|g| [g[0], g[1], g[2], 0.0]).collect();
        let got = h.read(&out)?;
        h.close("gradient", got.as_flattened(), &expected, None, SMALL);
    }
    Ok(())
}

fn voting(h: &mut Harness) -> Result<()> {
    let count = 700;
    let mut by_colour: Vec<[f32; 4]> = (0..count)
        .map(|_| {
            let all = h.rng.random_range(0.0..3.0);
            let share: f32 = h.rng.random_range(0.0..1.0);
            [h.rng.random_range(-1.0..1.0), all * share, all, 9.0]
        })
        .collect();
    by_colour[3][0] = f32::NAN;
    by_colour[4][2] = f32::INFINITY;
    by_colour[6] = [0.0; 4];
    let visible: Vec<u32> = (0..count as u32).map(|i| i % 3).collect();
    let mut logits = values(h, count, -5.0, 5.0);
    (logits[1], logits[2]) = (40.0, -40.0);
    let mut start =
        [values(h, count, -1.0, 1.0), values(h, 2 * count, 0.0, 1.0), values(h, count, 0.0, 1.0)];
    // The votes for motion are a part of all votes.
    start[1].chunks_exact_mut(2).for_each(|v| v[1] += v[0]);
    (start[1][12], start[1][13]) = (0.0, 0.0);
    let device = h.device.clone();
    let gradient_buffer = device.upload("colour gradients", &by_colour)?;
    let visible_buffer = device.upload("visible", &visible)?;
    let logit_buffer = device.upload("motion logits", &logits)?;
    for (fitted, word) in [(true, 1u32), (false, 0)] {
        let fits = device.upload("fits", &[word])?;
        let mut outputs = [
            h.output::<f32>("gradients", count)?,
            h.output::<f32>("votes", 2 * count)?,
            h.output::<f32>("evidence", count)?,
        ];
        let sources = [
            device.upload("start", &start[0])?,
            device.upload("start", &start[1])?,
            device.upload("start", &start[2])?,
        ];
        let mut recorder = h.stream.record()?;
        for (from, to) in sources.iter().zip(&mut outputs) {
            recorder.copy(from.view(), to.view_mut());
        }
        let [gradients, votes, evidence] = &mut outputs;
        vote(
            &mut recorder,
            VoteArgs {
                colour_gradients: gradient_buffer.view(),
                visible: visible_buffer.view(),
                fits: fits.view(),
                motion_logits: logit_buffer.view(),
                motion_gradients: gradients.view_mut(),
                votes: votes.view_mut(),
                evidence: evidence.view_mut(),
            },
        )?;
        h.stream.submit(recorder)?;
        let rows = |flat: &[f32]| flat.chunks(2).map(|v| [v[0].into(), v[1].into()]).collect();
        let mut truth = mask::Votes {
            gradients: wide(&start[0]),
            votes: rows(&start[1]),
            evidence: wide(&start[2]),
        };
        if fitted {
            let by_colour: Vec<[f64; 3]> =
                by_colour.iter().map(|g| [g[0].into(), g[1].into(), g[2].into()]).collect();
            mask::vote(&by_colour, &visible, &wide(&logits), &mut truth);
        }
        let [gradients, votes, evidence] =
            [h.read(&outputs[0])?, h.read(&outputs[1])?, h.read(&outputs[2])?];
        h.close("gradients", &gradients, &truth.gradients, None, SMALL);
        h.close("votes", &votes, truth.votes.as_flattened(), None, SMALL);
        h.close("evidence", &evidence, &truth.evidence, None, SMALL);
    }
    Ok(())
}

/// Blending of other colours over the same geometry: the image equals that of a scene with these
/// colours, alpha and depth are equal bit for bit, and the votes sum each Gaussian's weights in the
/// image.
fn blending(h: &mut Harness) -> Result<()> {
    let camera = skew_camera(83, 59);
    let scene = random(&mut h.rng, 600, 0, &camera);
    let count = scene.positions.len();
    let device = h.device.clone();
    let gaussians = GaussianBuffers::from_host(&mut h.stream, &scene)?;
    let k = camera.intrinsics;
    let render =
        Render::plan(&device, count, 1 << 14, k.width, k.height, RenderSettings::default())?;
    let (mut frame, mut own) = (render.differentiable(&device)?, render.pixels(&device)?);
    let logits = device.upload("motion logits", &vec![f32::INFINITY; count])?;
    let mut colours = device.buffer::<[f32; 4]>("colours", count)?;
    let mask = device.upload("mask", &vec![1.0f32; (k.width * k.height) as usize])?;
    let mut by_colour = h.output::<[f32; 4]>("by colour", count)?;
    let mut recorder = h.stream.record()?;
    frame.forward(&mut recorder, &camera, gaussians.views(), own.views_mut())?;
    paint(&mut recorder, logits.view(), colours.view_mut())?;
    frame.blend(&mut recorder, Some(colours.view()), Default::default())?;
    let Frame { pixels: painted, gradients, .. } = &mut frame;
    compare(&mut recorder, painted, mask.view(), 1.0, &mut gradients.pixels)?;
    frame.blend_backward(&mut recorder, Some(colours.view()), count, Default::default())?;
    recorder.copy(frame.gradients.colours(count), by_colour.view_mut());
    h.stream.submit(recorder)?;
    let own_rgba = h.stream.download(&own.rgba)?;
    let rgba = h.stream.download(&frame.pixels.rgba)?;
    let same = own_rgba.iter().zip(&rgba).all(|(a, b)| a[3].to_bits() == b[3].to_bits());
    h.holds("alpha stays", same);
    let (own_depth, depth) =
        (h.stream.download(&own.depth)?, h.stream.download(&frame.pixels.depth)?);
    h.holds("depth stays", own_depth == depth);
    // If all Gaussians move, the blended probability equals alpha: the same sum in two orders.
    let red: Vec<f32> = rgba.iter().map(|p| p[0]).collect();
    let alpha: Vec<f64> = rgba.iter().map(|p| f64::from(p[3])).collect();
    h.close("red", &red, &alpha, None, Bound { absolute: 5e-6, relative: 0.0 });
    let shown = h.stream.download(&frame.scratch.visible)?;
    let votes = h.read(&by_colour)?;
    let total = |of: fn(&[f32; 4]) -> f32| -> f32 {
        let seen = votes.iter().zip(&shown).filter(|(_, v)| **v != 0);
        seen.map(|(g, _)| of(g)).sum()
    };
    let all: f64 = alpha.iter().sum();
    let bound = Bound { absolute: 0.0, relative: 1e-4 };
    h.close("votes", &[total(|g| g[1]), total(|g| g[2])], &[all, all], None, bound);
    Ok(())
}
