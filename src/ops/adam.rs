//! The Adam optimiser on the device.

use crate::error::{Error, Result};
use crate::gpu::{Buffer, Device, Groups, Recorder, Stream, View, ViewMut};
use crate::kernels::adam::{Gate, GateArgs, GateParams, Step, StepArgs, StepConstants, StepParams};
use crate::types::AdamSettings;

/// Row lengths with a specialised pipeline: those of a Gaussian's parameters. Every other length is a
/// run-time parameter; otherwise each would compile and keep a pipeline.
const ROWS: [usize; 6] = [1, 3, 4, 9, 15, 21];

/// The specialisation constants for rows of `row` values.
fn constants(row: usize, rows: Option<usize>) -> StepConstants {
    let masked = StepConstants { masked: true, ..Default::default() };
    match rows {
        None => StepConstants::default(),
        // With rows this long every value lies in the first row, and the kernel needs no division.
        Some(1) => StepConstants { row: u32::MAX, short_rows: false, ..masked },
        Some(_) if ROWS.contains(&row) => {
            StepConstants { row: row as u32, short_rows: row < 3, ..masked }
        }
        Some(_) => StepConstants { short_rows: row < 3, any_row: true, ..masked },
    }
}

/// One group of parameters with its moments; all arrays have the same length.
pub struct AdamArgs<'a> {
    /// Gradients. A value that is not finite leaves its parameter and moments unchanged; magnitudes are
    /// clamped to 1e18.
    pub gradients: View<'a, f32>,
    /// Parameters; updated in place.
    pub parameters: ViewMut<'a, f32>,
    /// First moments; zero before the first step.
    pub first: ViewMut<'a, f32>,
    /// Second moments; zero before the first step.
    pub second: ViewMut<'a, f32>,
    /// Number of values in a row, and one word for each row: a row whose word is 0 does not change.
    pub visible: Option<(usize, View<'a, u32>)>,
}

/// The optimiser (Kingma and Ba 2015, with bias correction).
///
/// ```
/// use splat4d::gpu::{Device, Request};
/// use splat4d::ops::adam::{Adam, AdamArgs};
/// use splat4d::types::AdamSettings;
/// # fn main() -> splat4d::Result<()> {
/// let device = Device::open(&Request::software())?;
/// let mut stream = device.stream()?;
/// let gradients = device.upload("gradients", &[1.0f32, -2.0])?;
/// let mut parameters = device.upload("parameters", &[0.5f32, 0.5])?;
/// let mut first = device.upload("first moments", &[0.0f32; 2])?;
/// let mut second = device.upload("second moments", &[0.0f32; 2])?;
///
/// let mut adam = Adam::new(&device)?;
/// let mut recorder = stream.record()?;
/// let args = AdamArgs {
///     gradients: gradients.view(),
///     parameters: parameters.view_mut(),
///     first: first.view_mut(),
///     second: second.view_mut(),
///     visible: None,
/// };
/// let settings = AdamSettings { rate: 0.1, step: 1, ..Default::default() };
/// adam.record(&mut recorder, &settings, args)?;
/// stream.submit(recorder)?;
/// let stepped = stream.download(&parameters)?;
/// assert!((stepped[0] - 0.4).abs() < 1e-6 && (stepped[1] - 0.6).abs() < 1e-6);
/// assert_eq!(adam.broken(&mut stream)?, 0);
/// # Ok(())
/// # }
/// ```
pub struct Adam {
    /// A placeholder that is bound where no visibility is given.
    nothing: Buffer<u32>,
    /// Counts of non-finite gradients, one every [`STRIDE`] words.
    broken: Buffer<u32>,
    /// The count that the next step adds to.
    next: usize,
}

/// Number of steps that may run concurrently, each with its own count.
const COUNTS: usize = 16;
/// Words from one count to the next: 256 bytes, the largest alignment of storage offsets on any device.
const STRIDE: usize = 64;

impl Adam {
    /// Allocates the optimiser's buffers on a device.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn new(device: &Device) -> Result<Adam> {
        Ok(Adam {
            nothing: device.buffer("no visibility", 1)?,
            broken: device.upload("broken gradients", &[0; COUNTS * STRIDE])?,
            next: 0,
        })
    }

    /// Records one step: `adam/step`.
    ///
    /// # Errors
    /// [`Error::Shape`] where the lengths disagree; [`Error::Input`] for step 0.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        settings: &AdamSettings,
        args: AdamArgs<'_>,
    ) -> Result<()> {
        let count = args.gradients.len();
        let shape = |arg, expected: usize, actual: usize| match expected == actual {
            true => Ok(()),
            false => Err(Error::Shape { op: "adam", arg, expected: expected.to_string(), actual }),
        };
        shape("parameters", count, args.parameters.len())?;
        shape("first", count, args.first.len())?;
        shape("second", count, args.second.len())?;
        if settings.step == 0 {
            return Err(Error::Input("adam: steps count from 1".into()));
        }
        let (row, visible) = match args.visible {
            Some((row, visible)) => {
                shape("visible", count, row * visible.len())?;
                (row.max(1), visible)
            }
            None => (1, self.nothing.view()),
        };
        let rows = args.visible.map(|(_, visible)| visible.len());
        let unbias = |beta: f64| (1.0 / (1.0 - beta.powf(f64::from(settings.step)))) as f32;
        let at = self.next * STRIDE;
        self.next = (self.next + 1) % COUNTS;
        recorder.dispatch_specialised::<Step>(
            constants(row, rows),
            Groups::linear(count / 4 + count % 4, 64, recorder.device().limits())?,
            StepParams {
                count: count as u32,
                rate: settings.rate as f32,
                beta1: settings.beta1 as f32,
                beta2: settings.beta2 as f32,
                rest1: (1.0 - settings.beta1) as f32,
                rest2: (1.0 - settings.beta2) as f32,
                unbias1: unbias(settings.beta1),
                unbias2: unbias(settings.beta2),
                epsilon: settings.epsilon as f32,
                row: row as u32,
            },
            StepArgs {
                visible,
                gradients: args.gradients,
                parameters: args.parameters,
                first: args.first,
                second: args.second,
                broken: self.broken.range_mut(at..at + 1),
            },
        )
    }

    /// Waits, and counts the non-finite gradients so far, in rows that steps changed.
    ///
    /// # Errors
    /// As for [`Stream::download`].
    pub fn broken(&self, stream: &mut Stream) -> Result<u64> {
        let words = stream.download(&self.broken)?;
        Ok(words.iter().map(|&count| u64::from(count)).sum())
    }
}

/// Records which rows a step may change: the trainable ones, or none where `fits` holds 0.
///
/// # Errors
/// [`Error::Shape`] where the lengths disagree.
pub fn gate(
    recorder: &mut Recorder,
    fits: View<'_, u32>,
    trainable: View<'_, u32>,
    gate: ViewMut<'_, u32>,
) -> Result<()> {
    let count = trainable.len();
    if gate.len() != count {
        let (expected, actual) = (count.to_string(), gate.len());
        return Err(Error::Shape { op: "adam", arg: "gate", expected, actual });
    }
    recorder.dispatch::<Gate>(
        Groups::linear(count, 64, recorder.device().limits())?,
        GateParams { count: count as u32 },
        GateArgs { fits, trainable, gate },
    )
}
