//! Linear blend skinning on the device: dynamic Gaussians follow their nearest control points.
//!
//! `oracle::deform` has the formulae. Gaussians that are not listed as dynamic are only copied.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::deform as kernels;
use crate::ops::neighbours::Neighbours;

/// The largest number of control points that a Gaussian follows.
pub const MOST_FOLLOWED: usize = 8;

/// Soft motion: the motion of every listed Gaussian is weighted by the sigmoid of its motion logit.
#[derive(Clone, Copy)]
pub struct SoftMotion<'a> {
    /// Motion logits of all Gaussians.
    pub logits: View<'a, f32>,
    /// The evidence of motion of all Gaussians from the motion masks, in [0, 1]. It weights the rigidity
    /// term and gets no gradient.
    pub evidence: View<'a, f32>,
}

/// The inputs of skinning.
#[derive(Clone, Copy)]
pub struct SkinArgs<'a> {
    /// Indices of the dynamic Gaussians, as many as [`Skin::refresh`] was given.
    pub gaussian_from_dynamic: View<'a, u32>,
    /// Canonical centres of all Gaussians, three values each, world frame.
    pub positions: View<'a, f32>,
    /// Canonical quaternions (w, x, y, z) of all Gaussians, any norm.
    pub rotations: View<'a, [f32; 4]>,
    /// Canonical logits of the opacities of all Gaussians.
    pub opacity_logits: View<'a, f32>,
    /// Canonical positions of the control points, three values each.
    pub nodes: View<'a, f32>,
    /// Natural logarithms of their radii.
    pub log_radii: View<'a, f32>,
    /// Their motions, for one time after the other, two vectors each. The first holds the translation
    /// and a value that is added to the opacity logit: 0, or less where the control point is absent. The
    /// second holds a rotation quaternion of any norm. [`path::evaluate`](crate::ops::path::evaluate)
    /// and [`Network::forward`](crate::ops::mlp::Network::forward) write this layout.
    pub transforms: View<'a, [f32; 4]>,
    /// Index of the time in `transforms`.
    pub time: usize,
    /// `None`: every listed Gaussian moves fully.
    pub soft: Option<SoftMotion<'a>>,
}

/// The outputs of skinning, for all Gaussians.
pub struct Skinned<'a> {
    /// Centres at the time; static Gaussians keep the same bits.
    pub positions: ViewMut<'a, f32>,
    /// Quaternions at the time, with the norms of the canonical ones.
    pub rotations: ViewMut<'a, [f32; 4]>,
    /// Logits of the opacities at the time; static Gaussians keep the same bits. The derivative with
    /// respect to the canonical logits is 1.
    pub opacity_logits: ViewMut<'a, f32>,
    /// The rigidity term `(1 − m̂) ‖Δ‖²` of each listed Gaussian; zero unless soft.
    pub rigidity: ViewMut<'a, f32>,
}

/// The gradients that the backward pass reads and writes.
pub struct SkinGradients<'a> {
    /// In: with respect to the centres at the time. Out: with respect to the canonical centres.
    pub positions: ViewMut<'a, f32>,
    /// In: with respect to the quaternions at the time. Out: with respect to the canonical quaternions.
    pub rotations: ViewMut<'a, [f32; 4]>,
    /// With respect to the motion logits: accumulated with soft motion, else untouched.
    pub motion_logits: ViewMut<'a, f32>,
    /// With respect to the motions, in their layout; only the rows of the time change.
    pub transforms: ViewMut<'a, [f32; 4]>,
    /// With respect to the logarithms of the radii.
    pub log_radii: ViewMut<'a, f32>,
    /// Whether the gradients are added to `transforms` and `log_radii` instead of overwriting them.
    pub accumulate: bool,
    /// Weight of the summed rigidity terms in the loss.
    pub rigid_scale: f32,
}

/// Skinning of dynamic Gaussians, up to a fixed capacity.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Device, Recorder};
/// use splat4d::ops::deform::{Skin, SkinArgs, Skinned};
/// # fn skin(
/// #     device: &Device, recorder: &mut Recorder, gaussian_from_dynamic: &Buffer<u32>,
/// #     positions: &Buffer<f32>, rotations: &Buffer<[f32; 4]>, opacity_logits: &Buffer<f32>,
/// #     nodes: &Buffer<f32>, log_radii: &Buffer<f32>, transforms: &Buffer<[f32; 4]>,
/// # ) -> splat4d::Result<()> {
/// // Each dynamic Gaussian follows the 4 control points nearest to it.
/// let mut skin = Skin::new(device, 4, gaussian_from_dynamic.len(), log_radii.len())?;
/// skin.refresh(recorder, gaussian_from_dynamic.view(), positions.view(), nodes.view())?;
///
/// let mut moved = device.buffer("moved positions", positions.len())?;
/// let mut turned = device.buffer("moved rotations", rotations.len())?;
/// let mut faded = device.buffer("faded opacities", opacity_logits.len())?;
/// let mut rigidity = device.buffer("rigidity", gaussian_from_dynamic.len())?;
/// let args = SkinArgs {
///     gaussian_from_dynamic: gaussian_from_dynamic.view(),
///     positions: positions.view(),
///     rotations: rotations.view(),
///     opacity_logits: opacity_logits.view(),
///     nodes: nodes.view(),
///     log_radii: log_radii.view(),
///     transforms: transforms.view(),
///     time: 0,
///     soft: None,
/// };
/// let out = Skinned {
///     positions: moved.view_mut(),
///     rotations: turned.view_mut(),
///     opacity_logits: faded.view_mut(),
///     rigidity: rigidity.view_mut(),
/// };
/// skin.forward(recorder, args, out)?;
/// # Ok(())
/// # }
/// ```
pub struct Skin {
    neighbours: Neighbours,
    contributions: Buffer<[f32; 4]>,
}

impl Skin {
    /// Allocates for `capacity` dynamic Gaussians that follow `k` control points each, and for up to
    /// `node_capacity` control points.
    ///
    /// # Errors
    /// [`Error::Input`] for `k` of 0 or beyond [`MOST_FOLLOWED`]; [`Error::OutOfMemory`].
    pub fn new(device: &Device, k: usize, capacity: usize, node_capacity: usize) -> Result<Skin> {
        if k > MOST_FOLLOWED {
            return Err(Error::Input(format!(
                "{k} control points for each Gaussian: it must be 1 to {MOST_FOLLOWED}"
            )));
        }
        Ok(Skin {
            neighbours: Neighbours::new(device, k, capacity, node_capacity)?,
            contributions: device.buffer("skin contributions", 2 * k * capacity)?,
        })
    }

    /// Records the search for the control points that each dynamic Gaussian follows. Repeat it when the
    /// list of dynamic Gaussians changes, and when control points or Gaussians have moved far in the
    /// canonical frame.
    ///
    /// # Errors
    /// [`Error::Shape`] where Gaussians or control points exceed the capacity.
    pub fn refresh(
        &mut self,
        recorder: &mut Recorder,
        gaussian_from_dynamic: View<'_, u32>,
        positions: View<'_, f32>,
        nodes: View<'_, f32>,
    ) -> Result<()> {
        self.neighbours.refresh(recorder, Some(gaussian_from_dynamic), positions, nodes)
    }

    /// The neighbour lists of the dynamic Gaussians, for restoring a saved state.
    pub(crate) fn neighbours_mut(&mut self) -> &mut Neighbours {
        &mut self.neighbours
    }

    /// The control points that each dynamic Gaussian follows.
    pub fn neighbours(&self) -> &Neighbours {
        &self.neighbours
    }

    fn check(&self, args: &SkinArgs<'_>) -> Result<()> {
        let (nodes, count) = (self.neighbours.node_count(), args.rotations.len());
        equal("gaussian_from_dynamic", self.neighbours.rows(), args.gaussian_from_dynamic.len())?;
        equal("positions", 3 * count, args.positions.len())?;
        equal("opacity_logits", count, args.opacity_logits.len())?;
        equal("nodes", 3 * nodes, args.nodes.len())?;
        equal("log_radii", nodes, args.log_radii.len())?;
        if args.transforms.len() < 2 * nodes * (args.time + 1) {
            let expected = format!("at least {}", 2 * nodes * (args.time + 1));
            let actual = args.transforms.len();
            return Err(Error::Shape { op: "skin", arg: "transforms", expected, actual });
        }
        if let Some(soft) = args.soft {
            equal("motion logits", count, soft.logits.len())?;
            equal("evidence", count, soft.evidence.len())?;
        }
        Ok(())
    }

    /// Records skinning: copies centres, quaternions and opacities, then moves the dynamic Gaussians
    /// (`deform/skin`).
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree with each other or with the last
    /// [`refresh`](Self::refresh).
    pub fn forward(
        &self,
        recorder: &mut Recorder,
        args: SkinArgs<'_>,
        mut out: Skinned<'_>,
    ) -> Result<()> {
        self.check(&args)?;
        equal("moved positions", args.positions.len(), out.positions.len())?;
        equal("moved rotations", args.rotations.len(), out.rotations.len())?;
        equal("moved opacities", args.opacity_logits.len(), out.opacity_logits.len())?;
        equal("rigidity", args.gaussian_from_dynamic.len(), out.rigidity.len())?;
        recorder.copy(args.positions, out.positions.reborrow());
        recorder.copy(args.rotations, out.rotations.reborrow());
        recorder.copy(args.opacity_logits, out.opacity_logits.reborrow());
        let rows = self.neighbours.rows();
        // A placeholder that is bound but not read without soft motion.
        let unused = args.log_radii;
        recorder.dispatch_specialised::<kernels::Skin>(
            kernels::SkinConstants { k: self.neighbours.k() as u32 },
            Groups::linear(rows, 64, recorder.device().limits())?,
            kernels::SkinParams {
                rows: rows as u32,
                transforms_at: (args.time * self.neighbours.node_count()) as u32,
                soft: u32::from(args.soft.is_some()),
            },
            kernels::SkinArgs {
                gaussian_from_dynamic: args.gaussian_from_dynamic,
                neighbours: self.neighbours.neighbours(),
                positions: args.positions,
                rotations: args.rotations,
                motion_logits: args.soft.map_or(unused, |soft| soft.logits),
                evidence: args.soft.map_or(unused, |soft| soft.evidence),
                nodes: args.nodes,
                log_radii: args.log_radii,
                transforms: args.transforms,
                opacity_logits: args.opacity_logits,
                moved_positions: out.positions,
                moved_rotations: out.rotations,
                moved_opacity_logits: out.opacity_logits,
                rigidity: out.rigidity,
            },
        )
    }

    /// Records the backward pass: `deform/skin_backward`, `deform/gather`. The gradients of static
    /// Gaussians do not change, since their moved centre is the canonical one.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree with each other or with the last
    /// [`refresh`](Self::refresh).
    pub fn backward(
        &mut self,
        recorder: &mut Recorder,
        args: SkinArgs<'_>,
        mut gradients: SkinGradients<'_>,
    ) -> Result<()> {
        self.check(&args)?;
        equal("position gradients", args.positions.len(), gradients.positions.len())?;
        equal("rotation gradients", args.rotations.len(), gradients.rotations.len())?;
        equal("transform gradients", args.transforms.len(), gradients.transforms.len())?;
        equal("radius gradients", args.log_radii.len(), gradients.log_radii.len())?;
        if args.soft.is_some() {
            equal("motion gradients", args.rotations.len(), gradients.motion_logits.len())?;
        }
        let limits = *recorder.device().limits();
        let (rows, nodes) = (self.neighbours.rows(), self.neighbours.node_count());
        let transforms_at = (args.time * nodes) as u32;
        let unused = args.log_radii;
        recorder.dispatch_specialised::<kernels::SkinBackward>(
            kernels::SkinConstants { k: self.neighbours.k() as u32 },
            Groups::linear(rows, 64, &limits)?,
            kernels::SkinBackwardParams {
                rows: rows as u32,
                transforms_at,
                soft: u32::from(args.soft.is_some()),
                rigid_scale: gradients.rigid_scale,
            },
            kernels::SkinBackwardArgs {
                gaussian_from_dynamic: args.gaussian_from_dynamic,
                neighbours: self.neighbours.neighbours(),
                positions: args.positions,
                rotations: args.rotations,
                motion_logits: args.soft.map_or(unused, |soft| soft.logits),
                evidence: args.soft.map_or(unused, |soft| soft.evidence),
                nodes: args.nodes,
                log_radii: args.log_radii,
                transforms: args.transforms,
                position_gradients: gradients.positions.reborrow(),
                rotation_gradients: gradients.rotations.reborrow(),
                motion_gradients: gradients.motion_logits.reborrow(),
                contributions: self.contributions.view_mut(),
            },
        )?;
        recorder.dispatch::<kernels::Gather>(
            Groups::linear(nodes, 1, &limits)?,
            kernels::GatherParams {
                node_count: nodes as u32,
                transforms_at,
                accumulate: u32::from(gradients.accumulate),
            },
            kernels::GatherArgs {
                starts: self.neighbours.starts(),
                place_from_sorted: self.neighbours.place_from_sorted(),
                contributions: self.contributions.view(),
                transforms: args.transforms,
                transform_gradients: gradients.transforms.reborrow(),
                radius_gradients: gradients.log_radii.reborrow(),
            },
        )
    }
}

fn equal(arg: &'static str, expected: usize, actual: usize) -> Result<()> {
    if actual == expected {
        return Ok(());
    }
    Err(Error::Shape { op: "skin", arg, expected: expected.to_string(), actual })
}
