//! The deformation network of [`NetShape`]: positional encodings, ReLU layers with one skip, a
//! linear head.
//!
//! Source: SC-GS's DeformNetwork with two heads, combined as one matrix.

use super::Real;
use crate::types::NetShape;

/// The network's input for one query `(x, y, z, t)`: position, then for every frequency the sines
/// and the cosines of its three coordinates; the time likewise.
pub fn encode<R: Real>(shape: &NetShape, query: [R; 4]) -> Vec<R> {
    let mut input = Vec::with_capacity(shape.inputs());
    let groups = [
        (&query[..3], shape.position_frequencies, shape.position_octave),
        (&query[3..], shape.time_frequencies, 0),
    ];
    for (values, frequencies, lowest) in groups {
        input.extend_from_slice(values);
        for octave in 0..frequencies {
            let frequency = R::of((f64::from(lowest) + f64::from(octave)).exp2());
            input.extend(values.iter().map(|&v| (v * frequency).sin()));
            input.extend(values.iter().map(|&v| (v * frequency).cos()));
        }
    }
    input
}

/// The intermediate values and outputs of a forward pass.
#[derive(Clone, Debug, PartialEq)]
pub struct Pass<R> {
    /// Per query, the input of every layer in the order of [`NetShape::layers`].
    inputs: Vec<Vec<Vec<R>>>,
    /// Per query, the head's values: translation (3), rotation offset (4).
    pub outputs: Vec<[R; NetShape::OUTPUTS]>,
}

/// The network at every query `(x, y, z, t)`.
pub fn forward<R: Real>(shape: &NetShape, parameters: &[R], queries: &[[R; 4]]) -> Pass<R> {
    let layers = shape.layers();
    let mut pass = Pass { inputs: Vec::new(), outputs: Vec::new() };
    for &query in queries {
        let encoding = encode(shape, query);
        let mut inputs: Vec<Vec<R>> = Vec::with_capacity(layers.len());
        let (mut values, mut start) = (encoding.clone(), 0);
        for (layer, &(width, outputs)) in layers.iter().enumerate() {
            if layer > 0 && layer as u32 == shape.skip.saturating_add(1) {
                values = [encoding.clone(), values].concat();
            }
            let (weights, biases) = parameters[start..].split_at(width * outputs);
            let next = (0..outputs)
                .map(|o| {
                    let row = &weights[o * width..(o + 1) * width];
                    let sum: R = row.iter().zip(&values).map(|(&w, &x)| w * x).sum();
                    let z = sum + biases[o];
                    if layer + 1 < layers.len() { z.max(R::zero()) } else { z }
                })
                .collect();
            inputs.push(std::mem::replace(&mut values, next));
            start += (width + 1) * outputs;
        }
        pass.inputs.push(inputs);
        pass.outputs.push(std::array::from_fn(|o| values[o]));
    }
    pass
}

/// The gradient with respect to the parameters, for a loss whose gradient with respect to the
/// outputs is given. The derivative of ReLU at 0 is zero.
pub fn backward<R: Real>(
    shape: &NetShape,
    parameters: &[R],
    pass: &Pass<R>,
    output_gradients: &[[R; NetShape::OUTPUTS]],
) -> Vec<R> {
    let layers = shape.layers();
    let mut gradients = vec![R::zero(); parameters.len()];
    for (inputs, by_output) in pass.inputs.iter().zip(output_gradients) {
        let mut by_z = by_output.to_vec();
        let mut end = parameters.len();
        for (layer, &(width, outputs)) in layers.iter().enumerate().rev() {
            let start = end - (width + 1) * outputs;
            let input = &inputs[layer];
            let mut by_input = vec![R::zero(); width];
            for o in 0..outputs {
                for i in 0..width {
                    gradients[start + o * width + i] += by_z[o] * input[i];
                    by_input[i] += by_z[o] * parameters[start + o * width + i];
                }
                gradients[start + width * outputs + o] += by_z[o];
            }
            // Inputs before the last `shape.width` ones are the encoding, a constant.
            let hidden = width.saturating_sub(shape.width as usize);
            by_z = by_input[hidden..]
                .iter()
                .zip(&input[hidden..])
                .map(|(&g, &x)| if x > R::zero() { g } else { R::zero() })
                .collect();
            end = start;
        }
    }
    gradients
}

/// A control point's motion from the head's values, as skinning reads it: translation, padding,
/// rotation `[1, 0, 0, 0] + δ`, not normalised.
pub fn transform<R: Real>(output: [R; NetShape::OUTPUTS]) -> [R; 8] {
    let [x, y, z, w, i, j, k] = output;
    [x, y, z, R::zero(), R::one() + w, i, j, k]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::DeformNet;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Anything but regular.
    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
    }

    fn shapes() -> Vec<NetShape> {
        let base = NetShape {
            depth: 4,
            width: 16,
            skip: 1,
            position_frequencies: 2,
            time_frequencies: 3,
            ..NetShape::PAPER
        };
        vec![
            base,
            NetShape { skip: 0, ..base },
            // The skip enters the head itself.
            NetShape { skip: 3, ..base },
            NetShape { skip: 9, position_frequencies: 0, time_frequencies: 0, ..base },
            NetShape { depth: 1, skip: u32::MAX, ..base },
        ]
    }

    fn problem(shape: &NetShape) -> (Vec<f64>, Vec<[f64; 4]>, Vec<[f64; 7]>) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        // A head of ordinary size and biases that are not zero, so that every path shows.
        let parameters = DeformNet::random(*shape, 1)
            .parameters
            .iter()
            .map(|&p| f64::from(p) + 0.05 * normal(&mut rng))
            .collect();
        let queries = (0..3).map(|_| std::array::from_fn(|_| normal(&mut rng))).collect();
        let gradients = (0..3).map(|_| std::array::from_fn(|_| normal(&mut rng))).collect();
        (parameters, queries, gradients)
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        for shape in shapes() {
            let (mut parameters, queries, gradients) = problem(&shape);
            let loss = |parameters: &[f64]| -> f64 {
                let pass = forward(&shape, parameters, &queries);
                pass.outputs
                    .iter()
                    .flatten()
                    .zip(gradients.iter().flatten())
                    .map(|(a, b)| a * b)
                    .sum()
            };
            let pass = forward(&shape, &parameters, &queries);
            let analytic = backward(&shape, &parameters, &pass, &gradients);
            assert_eq!(analytic.len(), shape.parameters());
            for p in 0..parameters.len() {
                let (start, h) = (parameters[p], 1e-6);
                parameters[p] = start + h;
                let up = loss(&parameters);
                parameters[p] = start - h;
                let down = loss(&parameters);
                parameters[p] = start;
                let numeric = (up - down) / (2.0 * h);
                let bound = 1e-6 * (1.0 + analytic[p].abs());
                assert!((numeric - analytic[p]).abs() < bound, "{shape:?} {p}: {numeric}");
            }
        }
    }

    #[test]
    fn a_network_of_ones_counts_its_inputs() {
        // All weights 1, no frequencies: layer 0 sums four inputs in each unit, and so on.
        let shape = NetShape {
            depth: 2,
            width: 16,
            skip: 0,
            position_frequencies: 0,
            time_frequencies: 0,
            ..NetShape::PAPER
        };
        let mut parameters = vec![1.0; shape.parameters()];
        let mut start = 0;
        for (inputs, outputs) in shape.layers() {
            parameters[start + inputs * outputs..start + (inputs + 1) * outputs].fill(0.0);
            start += (inputs + 1) * outputs;
        }
        let pass = forward(&shape, &parameters, &[[1.0, 2.0, 3.0, 4.0]]);
        // 10 per unit; 16 · 10 and the encoding's 10 again; 16 of those.
        assert_eq!(pass.outputs[0], [16.0 * 170.0; 7]);
        assert_eq!(transform(pass.outputs[0])[3], 0.0);
    }

    #[test]
    fn encodings_have_no_factor_pi_and_alternate() {
        let shape = NetShape {
            depth: 1,
            width: 16,
            skip: 9,
            position_frequencies: 2,
            time_frequencies: 1,
            ..NetShape::PAPER
        };
        let e = encode(&shape, [0.1f64, 0.2, 0.3, 0.7]);
        assert_eq!(e.len(), shape.inputs());
        assert_eq!(e[3], 0.1f64.sin());
        assert_eq!(e[7], 0.2f64.cos());
        assert_eq!(e[11], 0.6f64.sin());
        assert_eq!(e[15], 0.7);
        assert_eq!(e[17], 0.7f64.cos());
    }

    #[test]
    fn a_new_network_moves_nothing_to_speak_of() {
        let shape = NetShape::PAPER;
        let parameters: Vec<f64> =
            DeformNet::random(shape, 5).parameters.iter().map(|&p| f64::from(p)).collect();
        assert_eq!(parameters.len(), shape.parameters());
        let pass = forward(&shape, &parameters, &[[0.3, -0.5, 0.2, 0.4]]);
        let size = pass.outputs[0].iter().fold(0.0f64, |m, v| m.max(v.abs()));
        assert!(size > 0.0 && size < 1e-2, "{size}");
        assert_eq!(DeformNet::random(shape, 5), DeformNet::random(shape, 5));
        assert_ne!(DeformNet::random(shape, 5), DeformNet::random(shape, 6));
    }
}
