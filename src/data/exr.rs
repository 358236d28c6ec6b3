//! Float images as OpenEXR: depth (one channel) and RGBA (linear values as stored, premultiplied).

use std::io::Cursor;
use std::path::Path;

use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Layer, LayerAttributes, ReadChannels,
    ReadLayers, SmallVec, WritableImage,
};

use super::depth::clean;
use crate::error::excerpt;
use crate::io;
use crate::types::{Image, range};
use crate::{Error, Result};

/// Reads a depth map: the channel `Z`, else `depth`, `Y` or `R`, else the only one. Invalid values (NaN,
/// not above 0, nearer than [`range::DEPTH`]) are returned as 0, those farther as infinite.
pub fn read_depth(path: impl AsRef<Path>) -> Result<Image> {
    let mut depth = read_stored_depth(path.as_ref())?;
    depth.pixels.iter_mut().for_each(|z| *z = clean(*z));
    Ok(depth)
}

/// Reads the channel of [`read_depth`] with its stored values.
pub(super) fn read_stored_depth(path: &Path) -> Result<Image> {
    let mut planes = read_planes(path)?;
    let names: Vec<String> = planes.names.iter().map(|n| n.to_ascii_lowercase()).collect();
    let wanted = ["z", "depth", "depth.z", "y", "depth.v", "r"];
    let found = wanted.iter().find_map(|wanted| names.iter().position(|name| name == wanted));
    let index = match found {
        Some(index) => index,
        None if names.len() == 1 => 0,
        None => {
            let found = excerpt(&planes.names.join(", "));
            let what = format!("has no depth channel Z or Y, but {found}");
            return Err(Error::format(path, what));
        }
    };
    let pixels = planes.values.swap_remove(index);
    Ok(Image { width: planes.width, height: planes.height, channels: 1, pixels })
}

/// Reads colour: R, G, B and, if present, A; three or four channels.
pub fn read_rgba(path: impl AsRef<Path>) -> Result<Image> {
    let path = path.as_ref();
    let planes = read_planes(path)?;
    let plane = |name: &str| planes.names.iter().position(|n| n.eq_ignore_ascii_case(name));
    let (Some(r), Some(g), Some(b)) = (plane("R"), plane("G"), plane("B")) else {
        let what = format!("has no channels R, G, B, but {}", excerpt(&planes.names.join(", ")));
        return Err(Error::format(path, what));
    };
    let chosen: Vec<&Vec<f32>> =
        [r, g, b].into_iter().chain(plane("A")).map(|i| &planes.values[i]).collect();
    let count = planes.width as usize * planes.height as usize;
    let pixels = (0..count).flat_map(|i| chosen.iter().map(move |plane| plane[i])).collect();
    let channels = chosen.len() as u32;
    Ok(Image { width: planes.width, height: planes.height, channels, pixels })
}

/// Writes a depth map of one channel as `Z`, 32-bit float, by rename.
pub fn write_depth(path: impl AsRef<Path>, depth: &Image) -> Result<()> {
    write_planes(path.as_ref(), depth, &["Z"])
}

/// Writes an image of one channel as `Y`, 32-bit float, by rename.
pub fn write_grey(path: impl AsRef<Path>, image: &Image) -> Result<()> {
    write_planes(path.as_ref(), image, &["Y"])
}

/// Writes an image of three or four channels as R, G, B (and A), 32-bit float, by rename.
pub fn write_rgba(path: impl AsRef<Path>, image: &Image) -> Result<()> {
    match image.channels {
        3 => write_planes(path.as_ref(), image, &["R", "G", "B"]),
        _ => write_planes(path.as_ref(), image, &["R", "G", "B", "A"]),
    }
}

/// The channels of a file, one after another.
struct Planes {
    width: u32,
    height: u32,
    names: Vec<String>,
    values: Vec<Vec<f32>>,
}

fn read_planes(path: &Path) -> Result<Planes> {
    let bytes = io::read(path)?;
    let bad = |e: &dyn std::fmt::Display| {
        Error::format(path, format!("is not a readable EXR: {}", excerpt(&e.to_string())))
    };
    let headers = exr::meta::MetaData::read_from_buffered(Cursor::new(&bytes), false)
        .map_err(|e| bad(&e))?
        .headers;
    let announced = |header: &exr::meta::header::Header| {
        let pixels = (header.layer_size.0 as u64).saturating_mul(header.layer_size.1 as u64);
        pixels.saturating_mul(header.channels.bytes_per_pixel as u64)
    };
    let unpacked = headers.iter().map(announced).fold(0, u64::saturating_add);
    io::check_unpacked(path, unpacked, bytes.len())?;
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_buffered(Cursor::new(&bytes))
        .map_err(|e| bad(&e))?;
    let layer = image.layer_data;
    let side = |side: usize| u32::try_from(side).map_err(|e| bad(&e));
    let (width, height) = (side(layer.size.0)?, side(layer.size.1)?);
    if !(range::SIDE.contains(&width) && range::SIDE.contains(&height)) {
        return Err(Error::format(path, format!("a size of {width}×{height} makes no sense")));
    }
    let count = layer.size.0 * layer.size.1;
    let mut planes = Planes { width, height, names: Vec::new(), values: Vec::new() };
    for channel in layer.channel_data.list {
        let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
        // Subsampled chroma planes are smaller than the image and are ignored.
        if values.len() == count {
            planes.names.push(channel.name.to_string());
            planes.values.push(values);
        }
    }
    Ok(planes)
}

fn write_planes(path: &Path, image: &Image, names: &[&str]) -> Result<()> {
    if image.channels as usize != names.len() {
        return Err(Error::Shape {
            op: "exr::write",
            arg: "channels",
            expected: names.len().to_string(),
            actual: image.channels as usize,
        });
    }
    let plane = |c: usize| image.pixels.iter().skip(c).step_by(names.len()).copied().collect();
    let channels: SmallVec<[AnyChannel<FlatSamples>; 4]> = names
        .iter()
        .enumerate()
        .map(|(c, &name)| AnyChannel::new(name, FlatSamples::F32(plane(c))))
        .collect();
    let layer = Layer::new(
        (image.width as usize, image.height as usize),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(channels),
    );
    let file = exr::prelude::Image::from_layer(layer);
    io::write_atomically(path, |sink| {
        file.write().to_buffered(sink).map_err(|e| match e {
            exr::error::Error::Io(source) => source,
            other => std::io::Error::other(other),
        })
    })
}
