//! The report's folder: `report.json`, and a sheet with input, render, motion mask and depth side by side.

use std::path::Path;

use serde_json::Value;
use splat4d::data::{View, write_png};
use splat4d::gpu::Device;
use splat4d::renderer::Renderer;
use splat4d::scene::Scene;
use splat4d::types::Image;
use splat4d::{Result, io};

use super::pictures::{DepthScale, shrunk};
use super::quality::motion_only;

/// The files that [`write`] writes to the folder.
pub const FILES: [&str; 2] = ["report.json", "sheet.png"];

/// Number of rows of the sheet.
const ROWS: usize = 5;
/// Maximum width of an image on the sheet, pixels.
const WIDEST: u32 = 320;
/// Gap between images, pixels.
const GAP: u32 = 4;

/// An evenly spread selection of the views.
pub fn spread(views: &[View]) -> Vec<&View> {
    let count = views.len().min(ROWS);
    (0..count).map(|i| &views[i * (views.len() - 1) / (count - 1).max(1)]).collect()
}

/// Renders the views and writes both files.
pub fn write(
    folder: &Path,
    device: &Device,
    scene: &Scene,
    views: &[&View],
    report: &Value,
) -> Result<()> {
    let mut colours = Renderer::new(device, scene)?;
    let mut motion = Renderer::new(device, &motion_only(scene))?;
    let mut rows = Vec::new();
    for view in views {
        let rendered = colours.render(&view.camera, view.time)?;
        let moving = motion.render(&view.camera, view.time)?.over([0.0; 3]);
        let depth = rendered.mean_depth();
        let black = || Image::new(depth.width, depth.height, 3);
        let shaded = DepthScale::of([&depth]).map_or_else(black, |scale| scale.shade(&depth));
        let row = [view.image.clone(), rendered.over(scene.background), moving, shaded];
        rows.push(row.map(|image| shrunk(&image, WIDEST)));
    }
    write_png(folder.join("sheet.png"), &tile(&rows))?;
    io::write_json(folder.join("report.json"), report)
}

/// Rows of RGB images on white, stacked vertically.
fn tile(rows: &[[Image; 4]]) -> Image {
    let row_width = |row: &[Image; 4]| row.iter().map(|i| i.width + GAP).sum::<u32>() - GAP;
    let width = rows.iter().map(row_width).max().unwrap_or(1);
    let height = rows.iter().map(|row| row[0].height + GAP).sum::<u32>().max(GAP + 1) - GAP;
    let mut sheet = Image::new(width, height, 3);
    sheet.pixels.fill(1.0);
    let mut top = 0;
    for row in rows {
        let mut left = 0;
        for image in row {
            for y in 0..image.height {
                for x in 0..image.width {
                    sheet.at_mut(left + x, top + y).copy_from_slice(image.at(x, y));
                }
            }
            left += image.width + GAP;
        }
        top += row[0].height + GAP;
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_side_by_side() {
        let grey = |v: f32| Image { width: 3, height: 2, channels: 3, pixels: vec![v; 18] };
        let row = [grey(0.1), grey(0.2), grey(0.3), grey(0.4)];
        let sheet = tile(&[row.clone(), row]);
        assert_eq!((sheet.width, sheet.height), (4 * 3 + 3 * GAP, 2 * 2 + GAP));
        assert_eq!(sheet.at(3 + GAP, 2 + GAP), [0.2; 3]);
        assert_eq!(sheet.at(3, 0), [1.0; 3], "between images it is white");
    }
}
