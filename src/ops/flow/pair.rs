//! The flow of one pair, coarse to fine.

use super::{Flow, FlowFrame, TILE};
use crate::Result;
use crate::gpu::{Buffer, Device, Groups, Recorder, View, ViewMut};
use crate::kernels::flow::{
    Cheapest, CheapestArgs, CheapestParams, Confidence, ConfidenceArgs, ConfidenceParams, Densify,
    DensifyArgs, DensifyParams, Linearise, LineariseArgs, LineariseParams, Median, MedianArgs,
    MedianParams, Path, PathArgs, PathParams, Propagate, PropagateArgs, PropagateParams, Relax,
    RelaxArgs, RelaxParams, Search, SearchArgs, SearchParams, Slant, SlantArgs, SlantParams,
    Slopes, SlopesArgs, SlopesParams, Trust, TrustArgs, TrustParams, Upsample, UpsampleArgs,
    UpsampleParams,
};
use crate::types::FlowSettings;

/// Distance between neighbouring patches, as in `glsl/flow/patch.glsl`.
const STRIDE: u32 = 4;
/// The workgroup of kernels with an invocation per patch.
const PATCH_TILE: [u32; 2] = [8, 4];

/// Intermediate buffers of a pair; they can be reused for further pairs.
pub struct FlowScratch {
    /// The forward and the backward direction.
    directions: [Direction; 2],
}

struct Direction {
    volume: Buffer<u32>,
    /// The current flow; `other` holds the previous level's flow or the unfiltered flow.
    flow: Buffer<[f32; 2]>,
    other: Buffer<[f32; 2]>,
    patches: Buffer<[f32; 4]>,
    spread: Buffer<[f32; 4]>,
    trust: Buffer<f32>,
    slopes: Buffer<[f32; 4]>,
    matrices: Buffer<[f32; 4]>,
    sides: Buffer<[f32; 2]>,
}

/// The buffers of one pair. Each output has an element per pixel.
pub struct FlowArgs<'a> {
    /// The pyramid of the first image.
    pub first: &'a FlowFrame,
    /// The pyramid of the second image.
    pub second: &'a FlowFrame,
    /// Displacements to try, forward and backward, per pixel; not finite where there is no guess.
    pub guess: Option<[View<'a, [f32; 2]>; 2]>,
    /// Receive the flow: first to second, second to first, pixels.
    pub flow: [ViewMut<'a, [f32; 2]>; 2],
    /// Receive the confidence of the flow, in [0, 1].
    pub confidence: [ViewMut<'a, f32>; 2],
}

impl Flow {
    /// Allocates the intermediate buffers of [`record`](Self::record).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`](crate::Error::OutOfMemory).
    pub fn scratch(&self, device: &Device) -> Result<FlowScratch> {
        let n = self.pixels(0);
        let [nx, ny] = self.patch_grid(0);
        let patches = 2 * nx as usize * ny as usize;
        let labels = (2 * self.settings.start_radius as usize + 1).pow(2);
        let volume = self.pixels(self.levels.len() - 1) * labels;
        let direction = || {
            Ok(Direction {
                volume: device.buffer("flow volume", volume)?,
                flow: device.buffer("flow", n)?,
                other: device.buffer("flow, other", n)?,
                patches: device.buffer("flow patches", patches)?,
                spread: device.buffer("flow patches, spread", patches)?,
                trust: device.buffer("flow trust", n)?,
                slopes: device.buffer("flow slopes", n)?,
                matrices: device.buffer("flow matrices", n)?,
                sides: device.buffer("flow sides", n)?,
            })
        };
        Ok(FlowScratch { directions: [direction()?, direction()?] })
    }

    /// Records the flow of a pair. Both frames must have been recorded before.
    ///
    /// Each stage is recorded for both directions before the next stage, so that both share its barrier.
    /// At the coarsest level: four times `flow/path`, then `flow/cheapest`. At each level, the coarsest
    /// first: `flow/upsample` (not at the coarsest), `flow/search`, `flow/propagate` once per
    /// propagation of the settings, `flow/densify`, `flow/trust`, `flow/median`, and for each warp
    /// `flow/linearise`, with affine smoothness at the finest level `flow/slopes` before and `flow/slant` after it,
    /// `flow/relax` twice per sweep, `flow/median`. Finally `flow/confidence`.
    ///
    /// # Errors
    /// [`Error::Shape`](crate::Error::Shape) for a buffer that is too short; else as for
    /// [`Recorder::dispatch`].
    pub fn record(
        &self,
        recorder: &mut Recorder,
        mut args: FlowArgs<'_>,
        scratch: &mut FlowScratch,
    ) -> Result<()> {
        let n = self.pixels(0);
        for d in 0..2 {
            let guess = args.guess.map_or(n, |guess| guess[d].len());
            super::super::at_least(
                "flow",
                &[
                    ("guess", n, guess),
                    ("flow", n, args.flow[d].len()),
                    ("confidence", n, args.confidence[d].len()),
                ],
            )?;
        }
        self.record_start(recorder, &args, scratch)?;
        for l in (0..self.levels.len()).rev() {
            self.record_search(recorder, l, &args, scratch)?;
            self.record_refine(recorder, l, &args, scratch)?;
        }
        let [width, height] = self.levels[0].map(|n| n as i32);
        for d in 0..2 {
            let (a, b) = args.frames(d);
            recorder.dispatch::<Confidence>(
                self.pixel_groups(0),
                ConfidenceParams { width, height },
                ConfidenceArgs {
                    luma_a: a.levels[0].luma.view(),
                    luma_b: b.levels[0].luma.view(),
                    forward: scratch.directions[d].flow.view(),
                    backward: scratch.directions[1 - d].flow.view(),
                    confidence: args.confidence[d].reborrow(),
                },
            )?;
        }
        for d in 0..2 {
            recorder
                .copy(scratch.directions[d].flow.range(0..n), args.flow[d].reborrow().range(0..n));
        }
        Ok(())
    }

    /// Records semi-global matching at the coarsest level, into `flow`.
    fn record_start(
        &self,
        recorder: &mut Recorder,
        args: &FlowArgs<'_>,
        scratch: &mut FlowScratch,
    ) -> Result<()> {
        let l = self.levels.len() - 1;
        let [width, height] = self.levels[l].map(|n| n as i32);
        let limits = *recorder.device().limits();
        let radius = self.settings.start_radius as i32;
        for path in 0..4 {
            let lines = if path < 2 { height } else { width };
            for (d, direction) in scratch.directions.iter_mut().enumerate() {
                let (a, b) = args.frames(d);
                recorder.dispatch::<Path>(
                    Groups::linear(lines as usize, 1, &limits)?,
                    PathParams {
                        width,
                        height,
                        radius,
                        path,
                        small_step: self.settings.start_small_step,
                        large_step: self.settings.start_large_step,
                    },
                    PathArgs {
                        census_a: a.census.view(),
                        census_b: b.census.view(),
                        volume: direction.volume.view_mut(),
                    },
                )?;
            }
        }
        let count = self.pixels(l) as u32;
        for direction in &mut scratch.directions {
            recorder.dispatch::<Cheapest>(
                Groups::linear(count as usize, 64, &limits)?,
                CheapestParams { count, radius },
                CheapestArgs { volume: direction.volume.view(), flow: direction.flow.view_mut() },
            )?;
        }
        Ok(())
    }

    /// Records the upsampling of the coarser level's flow, within `flow`; nothing at the coarsest level.
    fn record_upsample(
        &self,
        recorder: &mut Recorder,
        l: usize,
        scratch: &mut FlowScratch,
    ) -> Result<()> {
        let Some(coarse) = self.levels.get(l + 1) else { return Ok(()) };
        let [coarse_width, coarse_height] = coarse.map(|n| n as i32);
        let [width, height] = self.levels[l].map(|n| n as i32);
        for direction in &mut scratch.directions {
            recorder.dispatch::<Upsample>(
                self.pixel_groups(l),
                UpsampleParams { coarse_width, coarse_height, width, height },
                UpsampleArgs { coarse: direction.flow.view(), flow: direction.other.view_mut() },
            )?;
            std::mem::swap(&mut direction.flow, &mut direction.other);
        }
        Ok(())
    }

    /// Records the search of one level. It reads the coarser level's flow (at the coarsest level, the
    /// start) from `flow` and writes this level's dense, unrefined flow to `other`.
    fn record_search(
        &self,
        recorder: &mut Recorder,
        l: usize,
        args: &FlowArgs<'_>,
        scratch: &mut FlowScratch,
    ) -> Result<()> {
        self.record_upsample(recorder, l, scratch)?;
        let [width, height] = self.levels[l].map(|n| n as i32);
        let patches = Groups::grid(self.patch_grid(l)[0], self.patch_grid(l)[1], PATCH_TILE);
        let FlowSettings { search_steps, noise, .. } = self.settings;
        let guess_size = if args.guess.is_some() { self.levels[0] } else { [0, 0] };
        for (d, direction) in scratch.directions.iter_mut().enumerate() {
            let (a, b) = args.frames(d);
            recorder.dispatch::<Search>(
                patches,
                SearchParams {
                    width,
                    height,
                    search_steps,
                    noise,
                    guess_width: guess_size[0] as i32,
                    guess_height: guess_size[1] as i32,
                    guess_scale: (1u32 << l) as f32,
                },
                SearchArgs {
                    luma_a: a.levels[l].luma.view(),
                    luma_b: b.levels[l].luma.view(),
                    derivatives_a: a.levels[l].derivatives.view(),
                    start: direction.flow.view(),
                    guess: args.guess.map_or(direction.flow.view(), |guess| guess[d]),
                    patches: direction.patches.view_mut(),
                },
            )?;
        }
        for pass in 0..self.settings.propagations {
            for (d, direction) in scratch.directions.iter_mut().enumerate() {
                let (a, b) = args.frames(d);
                // Passes alternate between the adjacent patches and those at distance two.
                let reach = 1 + (pass % 2) as i32;
                recorder.dispatch::<Propagate>(
                    patches,
                    PropagateParams { width, height, search_steps, noise, reach },
                    PropagateArgs {
                        luma_a: a.levels[l].luma.view(),
                        luma_b: b.levels[l].luma.view(),
                        derivatives_a: a.levels[l].derivatives.view(),
                        patches: direction.patches.view(),
                        spread: direction.spread.view_mut(),
                    },
                )?;
                std::mem::swap(&mut direction.patches, &mut direction.spread);
            }
        }
        for (d, direction) in scratch.directions.iter_mut().enumerate() {
            let (a, b) = args.frames(d);
            recorder.dispatch::<Densify>(
                self.pixel_groups(l),
                DensifyParams { width, height },
                DensifyArgs {
                    luma_a: a.levels[l].luma.view(),
                    luma_b: b.levels[l].luma.view(),
                    patches: direction.patches.view(),
                    flow: direction.other.view_mut(),
                },
            )?;
        }
        Ok(())
    }

    /// Records the variational refinement of one level, from the dense flow in `other` to the refined
    /// one in `flow`.
    fn record_refine(
        &self,
        recorder: &mut Recorder,
        l: usize,
        args: &FlowArgs<'_>,
        scratch: &mut FlowScratch,
    ) -> Result<()> {
        let [width, height] = self.levels[l].map(|n| n as i32);
        let (pixels, s) = (self.pixel_groups(l), &self.settings);
        for d in 0..2 {
            let [forward, backward] = &mut scratch.directions;
            let (one, two) = if d == 0 { (forward, backward) } else { (backward, forward) };
            recorder.dispatch::<Trust>(
                pixels,
                TrustParams { width, height },
                TrustArgs {
                    forward: one.other.view(),
                    backward: two.other.view(),
                    trust: one.trust.view_mut(),
                },
            )?;
        }
        self.record_median(recorder, l, scratch)?;
        let affine = s.is_affine(l);
        for direction in scratch.directions.iter_mut().filter(|_| !affine) {
            recorder.fill(direction.slopes.view_mut(), 0);
        }
        for _ in 0..s.warps {
            for direction in scratch.directions.iter_mut().filter(|_| affine) {
                recorder.dispatch::<Slopes>(
                    pixels,
                    SlopesParams { width, height },
                    SlopesArgs {
                        flow: direction.flow.view(),
                        trust: direction.trust.view(),
                        slopes: direction.slopes.view_mut(),
                    },
                )?;
            }
            for (d, direction) in scratch.directions.iter_mut().enumerate() {
                let (a, b) = args.frames(d);
                recorder.dispatch::<Linearise>(
                    pixels,
                    LineariseParams {
                        width,
                        height,
                        brightness: s.brightness,
                        gradient: s.gradient,
                        smoothness: s.smoothness_at(l),
                        edge: s.edge,
                        noise: s.noise,
                        kink: s.kink,
                    },
                    LineariseArgs {
                        luma_a: a.levels[l].luma.view(),
                        luma_b: b.levels[l].luma.view(),
                        derivatives_a: a.levels[l].derivatives.view(),
                        derivatives_b: b.levels[l].derivatives.view(),
                        flow: direction.flow.view(),
                        trust: direction.trust.view(),
                        slopes: direction.slopes.view(),
                        matrices: direction.matrices.view_mut(),
                        sides: direction.sides.view_mut(),
                    },
                )?;
            }
            for direction in scratch.directions.iter_mut().filter(|_| affine) {
                recorder.dispatch::<Slant>(
                    pixels,
                    SlantParams { width, height },
                    SlantArgs {
                        matrices: direction.matrices.view(),
                        slopes: direction.slopes.view(),
                        sides: direction.sides.view_mut(),
                    },
                )?;
            }
            // Half of the pixels of a row belong to one colour of the red–black sweep.
            let half = Groups::grid(self.levels[l][0].div_ceil(2), self.levels[l][1], TILE);
            for half_sweep in 0..2 * s.sweeps {
                for direction in &mut scratch.directions {
                    recorder.dispatch::<Relax>(
                        half,
                        RelaxParams {
                            width,
                            height,
                            colour: half_sweep % 2,
                            relaxation: s.relaxation,
                        },
                        RelaxArgs {
                            matrices: direction.matrices.view(),
                            sides: direction.sides.view(),
                            flow: direction.flow.view_mut(),
                        },
                    )?;
                }
            }
            for direction in &mut scratch.directions {
                std::mem::swap(&mut direction.flow, &mut direction.other);
            }
            self.record_median(recorder, l, scratch)?;
        }
        Ok(())
    }

    /// Records the median filter, from `other` to `flow`.
    fn record_median(
        &self,
        recorder: &mut Recorder,
        l: usize,
        scratch: &mut FlowScratch,
    ) -> Result<()> {
        let [width, height] = self.levels[l].map(|n| n as i32);
        for direction in &mut scratch.directions {
            recorder.dispatch::<Median>(
                self.pixel_groups(l),
                MedianParams { width, height },
                MedianArgs { flow: direction.other.view(), filtered: direction.flow.view_mut() },
            )?;
        }
        Ok(())
    }

    fn patch_grid(&self, level: usize) -> [u32; 2] {
        self.levels[level].map(|n| n.div_ceil(STRIDE))
    }
}

impl<'a> FlowArgs<'a> {
    /// The image that direction `d` starts from, and the one it leads to.
    fn frames(&self, d: usize) -> (&'a FlowFrame, &'a FlowFrame) {
        if d == 0 { (self.first, self.second) } else { (self.second, self.first) }
    }
}
