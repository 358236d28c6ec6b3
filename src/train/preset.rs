//! The size of a reconstruction by quality and kind of device, in one table.

use super::sequence::SequenceSettings;
use crate::gpu::DeviceKind;

/// Quality of a reconstruction; higher quality takes more time and memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// A fast preview.
    Draft,
    /// The default.
    #[default]
    Standard,
    /// The best quality that takes about an hour on a software driver with two cores.
    Best,
}

/// The sizes and limits of a quality on a kind of device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Preset {
    /// Largest length of a frame's longer side, pixels; larger frames are scaled down.
    pub longest_side: u32,
    /// Steps of the last stage of training; the steps of the stages before it are proportional.
    pub steps: u32,
    /// Largest number of Gaussians for small frames.
    pub gaussians: usize,
    /// For large frames, the number of pixels of a frame per Gaussian; the larger of both limits
    /// applies.
    pub pixels_per_gaussian: usize,
    /// Largest number of control points.
    pub control_points: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
}

impl Quality {
    /// All qualities, the fastest first.
    pub const ALL: [Quality; 3] = [Quality::Draft, Quality::Standard, Quality::Best];

    /// The name of the quality.
    pub fn name(self) -> &'static str {
        match self {
            Quality::Draft => "draft",
            Quality::Standard => "standard",
            Quality::Best => "best",
        }
    }

    /// The preset for a kind of device. A GPU of unknown kind counts as a discrete one.
    pub fn preset(self, kind: DeviceKind) -> Preset {
        let class = match kind {
            DeviceKind::Software => 0,
            DeviceKind::Integrated => 1,
            DeviceKind::Discrete | DeviceKind::Virtual | DeviceKind::Other => 2,
        };
        // Software, integrated, discrete.
        let (longest_side, steps, gaussians) = match self {
            Quality::Draft => ([240, 480, 480], [550, 1100, 1100], [20_000, 20_000, 20_000]),
            Quality::Standard => ([320, 640, 640], [2200, 2200, 2200], [40_000, 40_000, 40_000]),
            Quality::Best => ([480, 960, 1280], [6000, 12_000, 30_000], [60_000, 200_000, 400_000]),
        };
        // These are the same for all kinds of devices.
        let (pixels_per_gaussian, control_points, sh_degree) = match self {
            Quality::Draft => (6, 128, 0),
            Quality::Standard => (3, 256, 1),
            Quality::Best => (2, 512, 1),
        };
        Preset {
            longest_side: longest_side[class],
            steps: steps[class],
            gaussians: gaussians[class],
            pixels_per_gaussian,
            control_points,
            sh_degree,
        }
    }
}

impl Preset {
    /// Settings for frames of a size in pixels, with `steps` steps of the last stage, or the preset's
    /// number.
    pub fn settings(&self, (width, height): (u32, u32), steps: Option<u32>) -> SequenceSettings {
        let pixels = width as usize * height as usize;
        let usual = SequenceSettings::default();
        SequenceSettings {
            max_gaussians: self.gaussians.max(pixels / self.pixels_per_gaussian),
            control_points: self.control_points,
            sh_degree: self.sh_degree,
            ..usual.of_steps(steps.unwrap_or(self.steps))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn standard_is_the_default_everywhere() {
        let usual = SequenceSettings::default();
        for kind in [DeviceKind::Software, DeviceKind::Integrated, DeviceKind::Discrete] {
            let standard = Quality::default().preset(kind).settings((320, 180), None);
            assert_eq!(format!("{standard:?}"), format!("{usual:?}"), "{kind:?}");
        }
        let large = Quality::Standard.preset(DeviceKind::Discrete).settings((640, 360), None);
        assert_eq!(large.max_gaussians, 76_800, "a Gaussian for every three pixels");
    }

    #[test]
    fn a_better_quality_is_larger_in_all() {
        for kind in [DeviceKind::Software, DeviceKind::Integrated, DeviceKind::Discrete] {
            for pair in Quality::ALL.windows(2) {
                let [a, b] = [pair[0].preset(kind), pair[1].preset(kind)];
                assert!(a.longest_side < b.longest_side && a.steps < b.steps, "{kind:?} {pair:?}");
                assert!(a.gaussians < b.gaussians && a.control_points < b.control_points);
                assert!(a.pixels_per_gaussian > b.pixels_per_gaussian);
                assert!(a.sh_degree <= b.sh_degree);
            }
        }
    }

    #[test]
    fn the_first_stage_goes_in_proportion() {
        let preset = Quality::Draft.preset(DeviceKind::Software);
        let settings = preset.settings((64, 36), Some(1100));
        assert_eq!((settings.static_steps, settings.steps), (250, 1100));
    }
}
