//! Skinning on the device: dynamic Gaussians follow their nearest control points.
//!
//! `oracle::deform` has the formulae. Only the Gaussians that are listed as dynamic cost anything
//! beyond a copy.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::deform as kernels;
use crate::ops::neighbours::Neighbours;

/// The largest number of control points that a Gaussian follows.
pub const MOST_FOLLOWED: usize = 8;

/// Soft motion: every listed Gaussian moves by the sigmoid of its motion logit.
#[derive(Clone, Copy)]
pub struct SoftMotion<'a> {
    /// Motion logits of all Gaussians.
    pub logits: View<'a, f32>,
    /// The image's evidence of motion of all Gaussians, in [0, 1]; weighs the rigidity term and
    /// gets no gradient.
    pub evidence: View<'a, f32>,
}

/// What skinning reads.
#[derive(Clone, Copy)]
pub struct SkinArgs<'a> {
    /// The Gaussians that move, as many as [`Skin::refresh`] was given.
    pub dynamic_ids: View<'a, u32>,
    /// Canonical centres of all Gaussians, three values each.
    pub positions: View<'a, f32>,
    /// Canonical quaternions (w, x, y, z) of all Gaussians, any norm.
    pub rotations: View<'a, [f32; 4]>,
    /// Canonical logits of the opacities of all Gaussians.
    pub opacity_logits: View<'a, f32>,
    /// Canonical positions of the control points, three values each.
    pub nodes: View<'a, f32>,
    /// Natural logarithms of their radii.
    pub log_radii: View<'a, f32>,
    /// Their motions, time after time, two vectors each: translation, and what is added to the logit of
    /// the opacity (0, or less where the control point is not there); rotation of any norm. What
    /// [`path::evaluate`](crate::ops::path::evaluate) and
    /// [`Network::forward`](crate::ops::mlp::Network::forward) write.
    pub transforms: View<'a, [f32; 4]>,
    /// Which of the times.
    pub time: usize,
    /// `None`: every listed Gaussian moves fully.
    pub soft: Option<SoftMotion<'a>>,
}

/// What skinning writes, for all Gaussians.
pub struct Skinned<'a> {
    /// Centres at the time; of static Gaussians the same bits.
    pub positions: ViewMut<'a, f32>,
    /// Quaternions at the time, as long as the canonical ones.
    pub rotations: ViewMut<'a, [f32; 4]>,
    /// Logits of the opacities at the time; of static Gaussians the same bits. The derivative by the
    /// canonical ones is 1.
    pub opacity_logits: ViewMut<'a, f32>,
    /// The rigidity term `(1 − m̂) ‖Δ‖²` of each listed Gaussian; zero unless soft.
    pub rigidity: ViewMut<'a, f32>,
}

/// The gradients that the derivative takes and gives.
pub struct SkinGradients<'a> {
    /// In: by the centres at the time. Out: by the canonical ones.
    pub positions: ViewMut<'a, f32>,
    /// In: by the quaternions at the time. Out: by the canonical ones.
    pub rotations: ViewMut<'a, [f32; 4]>,
    /// By the motion logits: added to where soft, else untouched.
    pub motion_logits: ViewMut<'a, f32>,
    /// By the motions, laid out as these; only the rows of the time change.
    pub transforms: ViewMut<'a, [f32; 4]>,
    /// By the logarithms of the radii.
    pub log_radii: ViewMut<'a, f32>,
    /// Whether `transforms` and `log_radii` are added to rather than written.
    pub accumulate: bool,
    /// Weight of the summed rigidity terms in the loss.
    pub rigid_scale: f32,
}

/// Skinning of up to a number of dynamic Gaussians.
///
/// ```no_run
/// use splat4d::gpu::{Buffer, Device, Recorder};
/// use splat4d::ops::deform::{Skin, SkinArgs, Skinned};
/// # fn skin(
/// #     device: &Device, recorder: &mut Recorder, dynamic_ids: &Buffer<u32>, positions: &Buffer<f32>,
/// #     rotations: &Buffer<[f32; 4]>, opacity_logits: &Buffer<f32>, nodes: &Buffer<f32>,
/// #     log_radii: &Buffer<f32>, transforms: &Buffer<[f32; 4]>,
/// # ) -> splat4d::Result<()> {
/// // Each dynamic Gaussian follows the 4 control points next to it.
/// let mut skin = Skin::new(device, 4, dynamic_ids.len(), log_radii.len())?;
/// skin.refresh(recorder, dynamic_ids.view(), positions.view(), nodes.view())?;
///
/// let mut moved = device.buffer("moved positions", positions.len())?;
/// let mut turned = device.buffer("moved rotations", rotations.len())?;
/// let mut faded = device.buffer("faded opacities", opacity_logits.len())?;
/// let mut rigidity = device.buffer("rigidity", dynamic_ids.len())?;
/// let args = SkinArgs {
///     dynamic_ids: dynamic_ids.view(),
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
    /// Room for `capacity` dynamic Gaussians that follow `k` control points each, of at most
    /// `node_capacity`.
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

    /// Records the search for the control points that each dynamic Gaussian follows; needed when the
    /// list, the control points or the Gaussians have changed enough to matter.
    ///
    /// # Errors
    /// [`Error::Shape`] for more Gaussians or control points than there is room for.
    pub fn refresh(
        &mut self,
        recorder: &mut Recorder,
        dynamic_ids: View<'_, u32>,
        positions: View<'_, f32>,
        nodes: View<'_, f32>,
    ) -> Result<()> {
        self.neighbours.refresh(recorder, Some(dynamic_ids), positions, nodes)
    }

    /// What each dynamic Gaussian follows, to be put back.
    pub(crate) fn neighbours_mut(&mut self) -> &mut Neighbours {
        &mut self.neighbours
    }

    /// What each dynamic Gaussian follows.
    pub fn neighbours(&self) -> &Neighbours {
        &self.neighbours
    }

    fn check(&self, args: &SkinArgs<'_>) -> Result<()> {
        let (nodes, count) = (self.neighbours.node_count(), args.rotations.len());
        equal("dynamic_ids", self.neighbours.rows(), args.dynamic_ids.len())?;
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
        equal("rigidity", args.dynamic_ids.len(), out.rigidity.len())?;
        recorder.copy(args.positions, out.positions.reborrow());
        recorder.copy(args.rotations, out.rotations.reborrow());
        recorder.copy(args.opacity_logits, out.opacity_logits.reborrow());
        let rows = self.neighbours.rows();
        // Bound, not read, where motion is not soft.
        let unused = args.log_radii;
        recorder.dispatch_specialised::<kernels::Skin>(
            &[self.neighbours.k() as u32],
            Groups::linear(rows, 64, recorder.device().limits())?,
            kernels::SkinParams {
                rows: rows as u32,
                transforms_at: (args.time * self.neighbours.node_count()) as u32,
                soft: u32::from(args.soft.is_some()),
            },
            kernels::SkinArgs {
                dynamic_ids: args.dynamic_ids,
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

    /// Records the derivative: `deform/skin_backward`, `deform/gather`. Static Gaussians' gradients stay as they are: their centre at the
    /// time is the canonical one.
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
            &[self.neighbours.k() as u32],
            Groups::linear(rows, 64, &limits)?,
            kernels::SkinBackwardParams {
                rows: rows as u32,
                transforms_at,
                soft: u32::from(args.soft.is_some()),
                rigid_scale: gradients.rigid_scale,
            },
            kernels::SkinBackwardArgs {
                dynamic_ids: args.dynamic_ids,
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
                places: self.neighbours.places(),
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
