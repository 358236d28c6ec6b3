//! How large a reconstruction is, by how good it is to be and what it runs on: one table.

use super::sequence::SequenceSettings;
use crate::gpu::DeviceKind;

/// How good a reconstruction is to be, for its time and memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// A first look.
    Draft,
    /// The usual one.
    #[default]
    Standard,
    /// As good as an hour allows on a software driver with two cores.
    Best,
}

/// The numbers of a quality on a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Preset {
    /// Frames are shrunk so that their longer side has at most so many pixels.
    pub longest_side: u32,
    /// Steps of the last stage of training; those before go in proportion.
    pub steps: u32,
    /// Most Gaussians, where the frames are small.
    pub gaussians: usize,
    /// Where they are large, there may be a Gaussian for so many pixels of a frame.
    pub pixels_per_gaussian: usize,
    /// Most control points.
    pub control_points: usize,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
}

impl Quality {
    /// All, from the fastest.
    pub const ALL: [Quality; 3] = [Quality::Draft, Quality::Standard, Quality::Best];

    /// What it is called.
    pub fn name(self) -> &'static str {
        match self {
            Quality::Draft => "draft",
            Quality::Standard => "standard",
            Quality::Best => "best",
        }
    }

    /// Its numbers on a kind of device. A GPU of unknown kind counts as a discrete one.
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
        // What no device class needs otherwise.
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
    /// Settings for frames of some size, and so many steps of the last stage or those of the preset.
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
