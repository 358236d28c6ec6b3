//! The as-rigid-as-possible energy of control points between two times, on the device.
//!
//! `oracle::arap` has the formula. For each control point, the energy is the weighted mean over its
//! edges of the squared residual after the best-fitting rotation; the result is the mean over the
//! control points.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::arap as kernels;
use crate::ops::neighbours::Neighbours;

/// Selection of the edges, and the weight of the energy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArapSettings {
    /// Number of nearest neighbours that count at any distance.
    pub always: u32,
    /// Further neighbours count only when they are nearer than this in the canonical frame, world units.
    pub reach: f32,
    /// The energy's weight in the loss.
    pub weight: f32,
}

impl Default for ArapSettings {
    /// The edges of SC-GS, for a scene of unit extent.
    fn default() -> Self {
        ArapSettings { always: 3, reach: 0.1, weight: 1e-2 }
    }
}

/// Inputs and outputs of the energy.
pub struct ArapArgs<'a> {
    /// Canonical positions of the control points of the last refresh, three values each.
    pub nodes: View<'a, f32>,
    /// Natural logarithms of their radii.
    pub log_radii: View<'a, f32>,
    /// Their motions, for one time after the other, two vectors each.
    pub transforms: View<'a, [f32; 4]>,
    /// Indices of the two times in `transforms`; they must differ.
    pub times: [usize; 2],
    /// Receives each control point's share of the weighted energy; the loss is their sum.
    pub energies: ViewMut<'a, f32>,
    /// The gradient with respect to the translations at both times is added to this.
    pub transform_gradients: ViewMut<'a, [f32; 4]>,
}

/// The energy of control points, up to a fixed capacity.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Device, Recorder};
/// use splat4d::ops::arap::{Arap, ArapArgs, ArapSettings};
/// # fn rigid(
/// #     device: &Device, recorder: &mut Recorder, nodes: &Buffer<f32>, log_radii: &Buffer<f32>,
/// #     transforms: &Buffer<[f32; 4]>, by_transforms: &mut Buffer<[f32; 4]>,
/// # ) -> splat4d::Result<()> {
/// let mut arap = Arap::new(device, 10, log_radii.len())?;
/// arap.refresh(recorder, nodes.view())?;
/// let mut energies = device.buffer("energies", log_radii.len())?;
/// let args = ArapArgs {
///     nodes: nodes.view(),
///     log_radii: log_radii.view(),
///     transforms: transforms.view(),
///     times: [0, 1],
///     energies: energies.view_mut(),
///     transform_gradients: by_transforms.view_mut(),
/// };
/// arap.record(recorder, &ArapSettings::default(), args)?;
/// # Ok(())
/// # }
/// ```
pub struct Arap {
    neighbours: Neighbours,
    edge_gradients: Buffer<[f32; 4]>,
}

impl Arap {
    /// Allocates for `node_capacity` control points with `k` edges each (SC-GS: 10).
    ///
    /// # Errors
    /// [`Error::Input`] for `k` of 0 or beyond 15; [`Error::OutOfMemory`].
    pub fn new(device: &Device, k: usize, node_capacity: usize) -> Result<Arap> {
        // Each control point is its own nearest neighbour.
        let places = k + 1;
        if k == 0 {
            return Err(Error::Input("arap: each control point needs an edge".into()));
        }
        Ok(Arap {
            neighbours: Neighbours::new(device, places, node_capacity, node_capacity)?,
            edge_gradients: device.buffer("arap edges", 2 * places * node_capacity)?,
        })
    }

    /// Records the search for each control point's edges. Repeat it when control points are added,
    /// removed or moved in the canonical frame.
    ///
    /// # Errors
    /// [`Error::Shape`] where the control points exceed the capacity.
    pub fn refresh(&mut self, recorder: &mut Recorder, nodes: View<'_, f32>) -> Result<()> {
        self.neighbours.refresh(recorder, None, nodes, nodes)
    }

    /// Records the energy and its gradient: `arap/fit`, `arap/gather`.
    ///
    /// # Errors
    /// [`Error::Shape`] where lengths disagree with each other or the last refresh; [`Error::Input`]
    /// when both times are the same.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        settings: &ArapSettings,
        args: ArapArgs<'_>,
    ) -> Result<()> {
        let count = self.neighbours.node_count();
        let [first, second] = args.times;
        let rows = 2 * count * (first.max(second) + 1);
        let shape = |arg, good: bool, expected: String, actual: usize| match good {
            true => Ok(()),
            false => Err(Error::Shape { op: "arap", arg, expected, actual }),
        };
        for (arg, expected, actual) in [
            ("nodes", 3 * count, args.nodes.len()),
            ("log_radii", count, args.log_radii.len()),
            ("energies", count, args.energies.len()),
            ("transform_gradients", args.transforms.len(), args.transform_gradients.len()),
        ] {
            shape(arg, expected == actual, expected.to_string(), actual)?;
        }
        let actual = args.transforms.len();
        shape("transforms", actual >= rows, format!("at least {rows}"), actual)?;
        if first == second {
            return Err(Error::Input("arap: the two times must differ".into()));
        }
        let limits = *recorder.device().limits();
        let k = self.neighbours.k() as u32;
        let (first_at, second_at) = ((first * count) as u32, (second * count) as u32);
        recorder.dispatch::<kernels::Fit>(
            Groups::linear(count, 64, &limits)?,
            kernels::FitParams {
                node_count: count as u32,
                k,
                first_at,
                second_at,
                always: settings.always,
                reach: settings.reach,
                scale: settings.weight / count.max(1) as f32,
            },
            kernels::FitArgs {
                nodes: args.nodes,
                log_radii: args.log_radii,
                neighbours: self.neighbours.neighbours(),
                transforms: args.transforms,
                energies: args.energies,
                edge_gradients: self.edge_gradients.view_mut(),
            },
        )?;
        recorder.dispatch::<kernels::Gather>(
            Groups::linear(count, 64, &limits)?,
            kernels::GatherParams { node_count: count as u32, k, first_at, second_at },
            kernels::GatherArgs {
                starts: self.neighbours.starts(),
                place_from_sorted: self.neighbours.place_from_sorted(),
                edge_gradients: self.edge_gradients.view(),
                transform_gradients: args.transform_gradients,
            },
        )
    }
}
