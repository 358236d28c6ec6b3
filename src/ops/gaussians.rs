//! The parameters of Gaussians in device buffers.

use crate::gpu::{Buffer, Device, Stream, View, ViewMut};
use crate::types::{Gaussians, sh_coefficients};
use crate::{Error, Result};
use std::ops::Range;

/// Floats per Gaussian in each band of the spherical harmonics.
pub const SH_BAND: [usize; 4] = [3, 9, 15, 21];

/// The parameters of Gaussians on the device, one buffer per parameter and per band of the spherical
/// harmonics. The gradients of Gaussians use the same container.
///
/// The buffers hold up to `capacity` Gaussians; the first `len` rows are in use.
pub struct GaussianBuffers {
    /// Number of Gaussians.
    pub len: usize,
    /// Degree of the spherical harmonics that the buffers hold.
    pub sh_degree: u32,
    /// 3 per Gaussian.
    pub positions: Buffer<f32>,
    /// 3 per Gaussian.
    pub log_scales: Buffer<f32>,
    /// w, x, y, z; need not be normalised.
    pub rotations: Buffer<[f32; 4]>,
    /// 1 per Gaussian.
    pub opacity_logits: Buffer<f32>,
    /// One buffer per band, [`SH_BAND`] floats per Gaussian; bands above the degree are empty.
    pub sh: [Buffer<f32>; 4],
    capacity: usize,
}

/// Views of Gaussians for a dispatch to read. Positions, rotations and opacities may be those at another
/// time ([`moved`](Self::moved)).
#[derive(Clone, Copy)]
pub struct GaussianViews<'a> {
    /// Number of Gaussians.
    pub len: usize,
    /// Degree of the spherical harmonics to evaluate.
    pub sh_degree: u32,
    /// 3 per Gaussian.
    pub positions: View<'a, f32>,
    /// 3 per Gaussian.
    pub log_scales: View<'a, f32>,
    /// w, x, y, z.
    pub rotations: View<'a, [f32; 4]>,
    /// 1 per Gaussian.
    pub opacity_logits: View<'a, f32>,
    /// One view per band.
    pub sh: [View<'a, f32>; 4],
    /// Whether `sh` holds 16-bit floats; see [`HalfHarmonics`](super::half::HalfHarmonics).
    pub half_sh: bool,
    /// Whether `log_scales` holds 16-bit floats; see [`HalfShapes`](super::half::HalfShapes).
    pub half_scales: bool,
    /// Whether `rotations` holds 16-bit floats.
    pub half_rotations: bool,
    /// Whether `opacity_logits` holds 16-bit floats.
    pub half_opacities: bool,
}

impl GaussianBuffers {
    /// Allocates buffers for `capacity` Gaussians; `len` is 0.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; [`Error::RangeLimit`] for 2³² or more.
    pub fn new(device: &Device, capacity: usize, sh_degree: u32) -> Result<GaussianBuffers> {
        super::countable(device, "rotations", capacity, 16)?;
        let band = |k: usize| {
            let floats = if k as u32 <= sh_degree { SH_BAND[k] } else { 0 };
            device.buffer(["sh0", "sh1", "sh2", "sh3"][k], capacity * floats)
        };
        Ok(GaussianBuffers {
            len: 0,
            sh_degree,
            positions: device.buffer("positions", 3 * capacity)?,
            log_scales: device.buffer("log scales", 3 * capacity)?,
            rotations: device.buffer("rotations", capacity)?,
            opacity_logits: device.buffer("opacity logits", capacity)?,
            sh: [band(0)?, band(1)?, band(2)?, band(3)?],
            capacity,
        })
    }

    /// Allocates buffers for a scene and uploads it.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], or a failed submission.
    pub fn from_host(stream: &mut Stream, gaussians: &Gaussians) -> Result<GaussianBuffers> {
        let device = stream.device().clone();
        let mut buffers = GaussianBuffers::new(&device, gaussians.len(), gaussians.sh_degree)?;
        buffers.upload(stream, gaussians)?;
        Ok(buffers)
    }

    /// The largest number of Gaussians that the buffers hold.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Replaces the Gaussians. Where their spherical harmonics have a lower degree than the buffers, the
    /// remaining bands are zero.
    ///
    /// # Errors
    /// [`Error::Shape`] when the Gaussians exceed the capacity or the lengths of their arrays differ.
    pub fn upload(&mut self, stream: &mut Stream, gaussians: &Gaussians) -> Result<()> {
        self.upload_at(stream, 0, gaussians)?;
        self.len = gaussians.len();
        Ok(())
    }

    /// Writes Gaussians from row `first` on; `len` does not change.
    ///
    /// # Errors
    /// As for [`upload`](Self::upload).
    pub fn upload_at(
        &mut self,
        stream: &mut Stream,
        first: usize,
        gaussians: &Gaussians,
    ) -> Result<()> {
        let (len, coefficients) = (gaussians.len(), sh_coefficients(gaussians.sh_degree));
        let shapes = [
            ("log_scales", gaussians.log_scales.len(), len),
            ("rotations", gaussians.rotations.len(), len),
            ("opacity_logits", gaussians.opacity_logits.len(), len),
            ("sh", gaussians.sh.len(), len * coefficients),
        ];
        for (arg, actual, expected) in shapes {
            if actual != expected {
                let expected = expected.to_string();
                return Err(Error::Shape { op: "upload", arg, expected, actual });
            }
        }
        if gaussians.sh_degree > self.sh_degree {
            let expected = format!("degree {} at most", self.sh_degree);
            let actual = gaussians.sh_degree as usize;
            return Err(Error::Shape { op: "upload", arg: "sh_degree", expected, actual });
        }
        let rows = first..first + len;
        if rows.end > self.capacity {
            let expected =
                format!("at most {} from {first} on", self.capacity.saturating_sub(first));
            return Err(Error::Shape { op: "upload", arg: "gaussians", expected, actual: len });
        }
        let threes = 3 * rows.start..3 * rows.end;
        let to = self.positions.range_mut(threes.clone());
        stream.upload_to(to, gaussians.positions.as_flattened())?;
        stream.upload_to(self.log_scales.range_mut(threes), gaussians.log_scales.as_flattened())?;
        stream.upload_to(self.rotations.range_mut(rows.clone()), &gaussians.rotations)?;
        stream.upload_to(self.opacity_logits.range_mut(rows.clone()), &gaussians.opacity_logits)?;
        let mut coefficient = 0;
        for band in 0..=self.sh_degree as usize {
            let (floats, triples) = (SH_BAND[band], SH_BAND[band] / 3);
            let mut values = vec![0.0f32; len * floats];
            if band as u32 <= gaussians.sh_degree {
                for (i, row) in values.chunks_exact_mut(floats).enumerate() {
                    let from = i * coefficients + coefficient;
                    row.copy_from_slice(gaussians.sh[from..from + triples].as_flattened());
                }
            }
            let to = self.sh[band].range_mut(floats * rows.start..floats * rows.end);
            stream.upload_to(to, &values)?;
            coefficient += triples;
        }
        Ok(())
    }

    /// Grows the capacity to at least `capacity` Gaussians and keeps the present ones.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`], or a failed submission.
    pub fn reserve(&mut self, stream: &mut Stream, capacity: usize) -> Result<()> {
        if capacity <= self.capacity {
            return Ok(());
        }
        let none = self.len..self.len;
        self.remake(stream, capacity, none)
    }

    /// Removes a range of Gaussians; the rows after it move up.
    ///
    /// # Errors
    /// [`Error::Shape`] for a range that is out of bounds; [`Error::OutOfMemory`], since the rows move
    /// into new buffers; or a failed submission.
    pub fn remove(&mut self, stream: &mut Stream, range: Range<usize>) -> Result<()> {
        if range.start > range.end || range.end > self.len {
            let (expected, actual) = (format!("a range within {}", self.len), range.end);
            return Err(Error::Shape { op: "remove", arg: "range", expected, actual });
        }
        self.remake(stream, self.capacity, range)
    }

    /// Copies all rows except `out` into new buffers, and waits.
    fn remake(&mut self, stream: &mut Stream, capacity: usize, out: Range<usize>) -> Result<()> {
        let device = stream.device().clone();
        let mut fresh = GaussianBuffers::new(&device, capacity, self.sh_degree)?;
        fresh.len = self.len - out.len();
        let mut recorder = stream.record()?;
        let mut moved = |per: usize, from: View<'_, f32>, mut to: ViewMut<'_, f32>| {
            let (before, behind) = (0..per * out.start, per * out.end..per * self.len);
            let freed = before.end..before.end + behind.len();
            recorder.copy(from.range(before.clone()), to.reborrow().range(before));
            recorder.copy(from.range(behind), to.range(freed));
        };
        moved(3, self.positions.view(), fresh.positions.view_mut());
        moved(3, self.log_scales.view(), fresh.log_scales.view_mut());
        moved(4, self.rotations.view().floats(), fresh.rotations.view_mut().floats());
        moved(1, self.opacity_logits.view(), fresh.opacity_logits.view_mut());
        for band in 0..=self.sh_degree as usize {
            moved(SH_BAND[band], self.sh[band].view(), fresh.sh[band].view_mut());
        }
        let ticket = stream.submit(recorder)?;
        stream.wait(ticket)?;
        *self = fresh;
        Ok(())
    }

    /// Reads the Gaussians back. `motion_logits` is empty, since these buffers do not hold them.
    ///
    /// # Errors
    /// A failed submission.
    pub fn download(&self, stream: &mut Stream) -> Result<Gaussians> {
        self.download_first(stream, self.len)
    }

    /// Reads the first `len` rows back, whatever `self.len` is: buffers of gradients need not set it.
    ///
    /// # Errors
    /// A failed submission.
    pub fn download_first(&self, stream: &mut Stream, len: usize) -> Result<Gaussians> {
        let rows3 = |flat: Vec<f32>| -> Vec<[f32; 3]> { bytemuck::cast_slice(&flat).to_vec() };
        Ok(Gaussians {
            positions: rows3(stream.download_from(self.positions.range(0..3 * len))?),
            log_scales: rows3(stream.download_from(self.log_scales.range(0..3 * len))?),
            rotations: stream.download_from(self.rotations.range(0..len))?,
            opacity_logits: stream.download_from(self.opacity_logits.range(0..len))?,
            sh_degree: self.sh_degree,
            sh: self.download_sh(stream, len)?,
            motion_logits: Vec::new(),
        })
    }

    /// Reads back the spherical harmonics of the first `len` rows, in the order of [`Gaussians::sh`].
    ///
    /// # Errors
    /// A failed submission.
    pub fn download_sh(&self, stream: &mut Stream, len: usize) -> Result<Vec<[f32; 3]>> {
        let coefficients = sh_coefficients(self.sh_degree);
        let mut sh = vec![[0.0f32; 3]; len * coefficients];
        let mut first = 0;
        for band in 0..=self.sh_degree as usize {
            let rows = SH_BAND[band] / 3;
            let values = stream.download_from(self.sh[band].range(0..len * SH_BAND[band]))?;
            for (i, row) in values.chunks_exact(SH_BAND[band]).enumerate() {
                let to = i * coefficients + first;
                sh[to..to + rows].copy_from_slice(bytemuck::cast_slice(row));
            }
            first += rows;
        }
        Ok(sh)
    }

    /// Views of the first `len` Gaussians, for a dispatch to read.
    pub fn views(&self) -> GaussianViews<'_> {
        let n = self.len;
        let band = |k: usize| {
            let floats = if k as u32 <= self.sh_degree { SH_BAND[k] } else { 0 };
            self.sh[k].range(0..n * floats)
        };
        GaussianViews {
            len: n,
            sh_degree: self.sh_degree,
            positions: self.positions.range(0..3 * n),
            log_scales: self.log_scales.range(0..3 * n),
            rotations: self.rotations.range(0..n),
            opacity_logits: self.opacity_logits.range(0..n),
            sh: [band(0), band(1), band(2), band(3)],
            half_sh: false,
            half_scales: false,
            half_rotations: false,
            half_opacities: false,
        }
    }
}

impl<'a> GaussianViews<'a> {
    /// The same Gaussians with their positions, rotations and opacities at another time.
    pub fn moved(
        self,
        positions: View<'a, f32>,
        rotations: View<'a, [f32; 4]>,
        opacity_logits: View<'a, f32>,
    ) -> Self {
        let (half_rotations, half_opacities) = (false, false);
        GaussianViews {
            positions,
            rotations,
            opacity_logits,
            half_rotations,
            half_opacities,
            ..self
        }
    }

    /// Whether any parameter is stored as 16-bit floats.
    pub(super) fn is_half(&self) -> bool {
        self.half_sh || self.half_scales || self.half_rotations || self.half_opacities
    }

    /// The same Gaussians with spherical harmonics of at most this degree.
    pub fn at_degree(self, sh_degree: u32) -> Self {
        GaussianViews { sh_degree: sh_degree.min(self.sh_degree), ..self }
    }

    /// Whether bands 1, 2 and 3 of the spherical harmonics are evaluated.
    pub(super) fn bands(&self) -> [bool; 3] {
        [1, 2, 3].map(|band| band <= self.sh_degree)
    }

    pub(super) fn check(&self, op: &'static str) -> Result<()> {
        let n = self.len;
        let words = |half: bool, values: usize| if half { values.div_ceil(2) } else { values };
        let band = |k: usize| match k as u32 <= self.sh_degree {
            true => words(self.half_sh, n * SH_BAND[k]),
            false => 0,
        };
        super::at_least(
            op,
            &[
                ("positions", 3 * n, self.positions.len()),
                ("log_scales", words(self.half_scales, 3 * n), self.log_scales.len()),
                ("rotations", words(self.half_rotations, n), self.rotations.len()),
                ("opacity_logits", words(self.half_opacities, n), self.opacity_logits.len()),
                ("sh0", band(0), self.sh[0].len()),
                ("sh1", band(1), self.sh[1].len()),
                ("sh2", band(2), self.sh[2].len()),
                ("sh3", band(3), self.sh[3].len()),
            ],
        )?;
        match self.sh_degree {
            0..=3 => Ok(()),
            degree => {
                Err(Error::Input(format!("spherical harmonics of degree {degree}: 3 at most")))
            }
        }
    }
}
