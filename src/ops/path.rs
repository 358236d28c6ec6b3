//! Paths of control points on the device: evaluation of their motions, and the gradient.

use crate::error::{Error, Result};
use crate::gpu::{Groups, Recorder, View, ViewMut};
use crate::kernels::path::{
    Evaluate, EvaluateArgs, EvaluateParams, Gather, GatherArgs, GatherParams,
};

const WORKGROUP: u32 = 64;
/// Number of values of a control point at a key time.
pub const VALUES: usize = 8;

/// Records `path/evaluate`: the motions of `nodes` control points at some times in [0, 1], two vectors
/// each, for one time after the other. `paths` holds [`VALUES`] values for each control point, key after
/// key, as [`ControlPoints::paths`](crate::types::ControlPoints::paths). Never allocates.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Recorder};
/// use splat4d::ops::path;
/// # fn motions(
/// #     recorder: &mut Recorder, paths: &Buffer<f32>, times: &Buffer<f32>,
/// #     transforms: &mut Buffer<[f32; 4]>,
/// # ) -> splat4d::Result<()> {
/// path::evaluate(recorder, 256, paths.view(), times.view(), transforms.view_mut())
/// # }
/// ```
///
/// # Errors
/// [`Error::Shape`] where the lengths disagree.
pub fn evaluate(
    recorder: &mut Recorder,
    nodes: usize,
    paths: View<'_, f32>,
    times: View<'_, f32>,
    transforms: ViewMut<'_, [f32; 4]>,
) -> Result<()> {
    let rows = nodes * times.len();
    let keys = keys("paths", paths.len(), nodes)?;
    check("transforms", transforms.len(), 2 * rows)?;
    let limits = *recorder.device().limits();
    recorder.dispatch::<Evaluate>(
        Groups::linear(2 * rows, WORKGROUP, &limits)?,
        EvaluateParams { node_count: nodes as u32, key_count: keys as u32, rows: rows as u32 },
        EvaluateArgs { paths, times, transforms },
    )
}

/// Records `path/gather`: the gradient with respect to the paths, from the gradient with respect to the
/// motions. Both are laid out as in [`evaluate`].
///
/// # Errors
/// [`Error::Shape`] where the lengths disagree.
pub fn gather(
    recorder: &mut Recorder,
    nodes: usize,
    times: View<'_, f32>,
    transform_gradients: View<'_, [f32; 4]>,
    gradients: ViewMut<'_, f32>,
) -> Result<()> {
    let keys = keys("gradients", gradients.len(), nodes)?;
    check("transform gradients", transform_gradients.len(), 2 * nodes * times.len())?;
    let limits = *recorder.device().limits();
    recorder.dispatch::<Gather>(
        Groups::linear(2 * keys * nodes, WORKGROUP, &limits)?,
        GatherParams {
            node_count: nodes as u32,
            key_count: keys as u32,
            time_count: times.len() as u32,
        },
        GatherArgs { times, transform_gradients, gradients },
    )
}

/// The number of keys that `values` values make.
fn keys(arg: &'static str, values: usize, nodes: usize) -> Result<usize> {
    let row = VALUES * nodes;
    if values > 0 && values.is_multiple_of(row.max(1)) {
        return Ok(values / row.max(1));
    }
    let expected = format!("a multiple of {row}");
    Err(Error::Shape { op: "control point paths", arg, expected, actual: values })
}

fn check(arg: &'static str, actual: usize, expected: usize) -> Result<()> {
    if actual == expected {
        return Ok(());
    }
    Err(Error::Shape { op: "control point paths", arg, expected: expected.to_string(), actual })
}
