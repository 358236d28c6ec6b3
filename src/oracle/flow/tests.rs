//! Tests of the oracle on known flows.

use super::*;

const WIDTH: usize = 64;
const HEIGHT: usize = 48;

fn texture(x: f64, y: f64) -> f64 {
    0.5 + 0.17 * (0.61 * x + 0.23 * y).sin()
        + 0.14 * (0.53 * y - 0.31 * x).sin()
        + 0.12 * (0.19 * x + 0.11 * y).sin()
        + 0.07 * (1.3 * x).sin() * (1.1 * y).cos()
}

fn pyramid(from: impl Fn(f64, f64) -> f64) -> Pyramid<f64> {
    let pixels: Vec<f64> =
        (0..WIDTH * HEIGHT).map(|p| from((p % WIDTH) as f64, (p / WIDTH) as f64)).collect();
    Pyramid::new(&pixels, WIDTH, HEIGHT, 1, FlowSettings::default().coarsest_side)
}

#[test]
fn a_shift_is_found_in_both_directions() {
    let (first, second) = (pyramid(texture), pyramid(|x, y| texture(x - 3.4, y + 1.2)));
    let pair = flow(&first, &second, None, &FlowSettings::default());
    let error = |flow: &[[f64; 2]], u: f64, v: f64| {
        let inner = (0..flow.len()).filter(|p| {
            (8..WIDTH - 8).contains(&(p % WIDTH)) && (8..HEIGHT - 8).contains(&(p / WIDTH))
        });
        inner.map(|p| (flow[p][0] - u).hypot(flow[p][1] - v)).fold(0.0, f64::max)
    };
    let errors = (error(&pair.forward, 3.4, -1.2), error(&pair.backward, -3.4, 1.2));
    // The worst pixel, measured 0.19, lies where the outer frame's missing matches reach in.
    assert!(errors.0 < 0.3 && errors.1 < 0.3, "{errors:?}");
    // Pixels that leave the image on the right have confidence 0.
    assert_eq!(pair.forward_confidence[10 * WIDTH + WIDTH - 1], 0.0);
    assert!(pair.forward_confidence[20 * WIDTH + 30] > 0.9);
}

#[test]
fn relaxation_solves_the_equations() {
    let (first, second) = (pyramid(texture), pyramid(|x, y| texture(x - 0.7, y + 0.4)));
    let (a, b) = (&first.levels[0], &second.levels[0]);
    let settings = FlowSettings::default();
    let mut flow = vec![[0.0; 2]; WIDTH * HEIGHT];
    let slopes = vec![[0.01, -0.02, 0.03, 0.01]; WIDTH * HEIGHT];
    let trust = vec![1.0; WIDTH * HEIGHT];
    let mut equations = linearise(a, b, &flow, &trust, &slopes, settings.smoothness, &settings);
    let plain = equations.clone();
    slant(&mut equations, &slopes, WIDTH, HEIGHT);
    for half_sweep in 0..600 {
        relax(&mut flow, &equations, WIDTH, HEIGHT, half_sweep % 2, &settings);
    }
    // The residual of each pixel's own equation and its neighbours' pull.
    for y in 1..HEIGHT - 1 {
        for x in 1..WIDTH - 1 {
            let p = y * WIDTH + x;
            let e = plain[p];
            let [u, v] = flow[p];
            let mut residual = [e.a * u + e.b * v - e.r, e.b * u + e.c * v - e.s];
            for (dx, dy) in [(-1, 0), (1, 0), (0, -1), (0, 1)] {
                let q = p.wrapping_add_signed(dy * WIDTH as isize + dx);
                let pull = 0.5 * (e.pull + plain[q].pull);
                let [ux, uy, vx, vy] = slopes[p];
                let predicted = |sx: f64, sy: f64| sx * dx as f64 + sy * dy as f64;
                residual[0] += pull * (u - flow[q][0] + predicted(ux, uy));
                residual[1] += pull * (v - flow[q][1] + predicted(vx, vy));
            }
            assert!(residual[0].hypot(residual[1]) < 1e-6, "{x}, {y}: {residual:?}");
        }
    }
}

#[test]
fn slopes_are_those_of_the_surface() {
    // Two affine flows that meet at x = 30.
    let at = |p: usize| {
        let (x, y) = ((p % WIDTH) as f64, (p / WIDTH) as f64);
        if x < 30.0 {
            [0.01 * x + 0.002 * y, -0.004 * x + 0.006 * y]
        } else {
            [9.0 - 0.008 * x, 3.0 + 0.01 * y]
        }
    };
    let flow: Vec<[f64; 2]> = (0..WIDTH * HEIGHT).map(at).collect();
    let found = slopes(&flow, &vec![1.0; flow.len()], WIDTH, HEIGHT);
    for (p, truth) in [
        (20 * WIDTH + 12, [0.01, 0.002, -0.004, 0.006]),
        (20 * WIDTH + 27, [0.01, 0.002, -0.004, 0.006]),
        (30 * WIDTH + 50, [-0.008, 0.0, 0.0, 0.01]),
    ] {
        // The ridge shrinks slopes, the more the fewer pixels are alike.
        let off = (0..4).map(|k| (found[p][k] - truth[k]).abs()).fold(0.0, f64::max);
        assert!(off < 0.15 * 0.01, "{:?} is not {truth:?}", found[p]);
    }
    // No surroundings, no slopes.
    assert_eq!(slopes(&[[1.0, 2.0]], &[1.0], 1, 1), vec![[0.0; 4]]);
}

#[test]
fn derivatives_are_those_of_a_parabola() {
    let luma: Vec<f64> = (0..81)
        .map(|p| {
            let (x, y) = (f64::from(p % 9), f64::from(p / 9));
            0.1 + 0.02 * x - 0.03 * y + 0.004 * x * x + 0.002 * x * y - 0.001 * y * y
        })
        .collect();
    let truth = [0.02 + 0.032 + 0.008, -0.03 + 0.008 - 0.008, 0.008, 0.002, -0.002];
    let d = derivatives(&luma, 9, 9)[4 * 9 + 4];
    assert!((0..5).all(|k| (d[k] - truth[k]).abs() < 1e-12), "{d:?}");
}

#[test]
fn halving_and_upsampling_keep_places() {
    // A ramp stays a ramp of the same slope per unit of the full image.
    let ramp: Vec<f64> = (0..16 * 12).map(|p| 0.01 * (f64::from(p % 16) + 0.5)).collect();
    let half = halve(&ramp, 16, 12);
    for x in 1..7 {
        assert!((half[3 * 8 + x] - 0.02 * (x as f64 + 0.5)).abs() < 1e-12);
    }
    let flow: Vec<[f64; 2]> = half.iter().map(|v| [*v, 0.0]).collect();
    let fine = upsample(&flow, 8, 6, 16, 12);
    for x in 3..13 {
        assert!((fine[5 * 16 + x][0] - 2.0 * ramp[5 * 16 + x]).abs() < 1e-12);
    }
}

#[test]
fn a_median_drops_an_outlier() {
    let mut flow = vec![[1.0, 2.0]; 25];
    flow[12] = [90.0, -90.0];
    assert_eq!(median(&flow, 5, 5), vec![[1.0, 2.0]; 25]);
}

#[test]
fn matching_prefers_no_motion_among_equals() {
    let grey = vec![0.5f64; 30];
    assert_eq!(coarse(&grey, &grey, 6, 5, &FlowSettings::default()), vec![[0.0; 2]; 30]);
}
