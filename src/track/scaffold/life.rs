//! The range of frames in which a control point exists.
//!
//! An object exists from the first frame that shows it to the last one, even if something hides it in between
//! or a mask misses it. Before and after, it is not where it was seen last: if that position is inside the
//! image, the image would show the object. Only a control point whose position is outside the image can still
//! exist, and it is kept for some frames, because an offset camera sees the object leave later.
//!
//! A control point that is on no known object is judged individually: by the frames whose masks show, around
//! its position, something that moves and belongs to no object.

use std::ops::Range;

use glam::DVec2;
use rayon::prelude::*;

use super::{Node, Surfaces};

/// Minimum number of its pixels in a frame for an object to count as seen.
const LEAST_PIXELS: usize = 12;
/// Maximum number of frames that a control point is kept while its position is outside the image.
const GOES_ON: usize = 6;

/// Sets the range of frames in which each control point exists.
pub(super) fn find(surfaces: &Surfaces<'_>, nodes: &mut [Node]) {
    let frames = surfaces.masks.len();
    let counts: Vec<Vec<usize>> =
        (0..frames).into_par_iter().map(|f| pixels(surfaces, f)).collect();
    let objects: Vec<Option<Range<usize>>> = (0..=surfaces.movers.len())
        .map(|owner| range((0..frames).filter(|f| counts[*f][owner] >= LEAST_PIXELS)))
        .collect();
    nodes.par_iter_mut().for_each(|node| {
        let seen = match node.owner {
            0 => range((0..frames).filter(|f| shown(surfaces, node, *f))),
            owner => objects[owner].clone(),
        };
        node.alive = seen.map_or(0..frames, |seen| extended(surfaces, node, seen));
    });
}

/// The number of pixels of each object in a frame; index 0 counts moving pixels without an object.
fn pixels(surfaces: &Surfaces<'_>, frame: usize) -> Vec<usize> {
    let mut counts = vec![0; surfaces.movers.len() + 1];
    let (mask, owners) = (&surfaces.masks[frame], &surfaces.owners[frame]);
    for (mask, owner) in mask.pixels.iter().zip(&owners.pixels) {
        if *mask > 0.5 {
            counts[*owner as usize] += 1;
        }
    }
    counts
}

fn range(mut frames: impl Iterator<Item = usize>) -> Option<Range<usize>> {
    let first = frames.next()?;
    Some(first..frames.last().unwrap_or(first) + 1)
}

/// The pixel at which a control point projects, if it is inside the image.
fn pixel(surfaces: &Surfaces<'_>, node: &Node, frame: usize) -> Option<DVec2> {
    let view = surfaces.view_from_world[frame].apply(node.world_from_node[frame].translation);
    let pixel = surfaces.intrinsics.project(view);
    let size = DVec2::new(surfaces.flow.width as f64, surfaces.flow.height as f64);
    (view.z > 0.0 && pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all()).then_some(pixel)
}

/// Whether a frame shows the control point's object near the control point's position.
fn shown(surfaces: &Surfaces<'_>, node: &Node, frame: usize) -> bool {
    let Some(middle) = pixel(surfaces, node, frame) else { return false };
    let place = node.world_from_node[frame].translation;
    let half = 0.5 * node.spacing / surfaces.pixel_size(frame, place);
    let around = [DVec2::ZERO, DVec2::X, -DVec2::X, DVec2::Y, -DVec2::Y];
    around.iter().any(|off| surfaces.owner(frame, middle + half * *off) == Some(node.owner))
}

/// Extends the range of frames in which a control point was seen.
fn extended(surfaces: &Surfaces<'_>, node: &Node, seen: Range<usize>) -> Range<usize> {
    let frames = surfaces.masks.len();
    let beyond = |frame: &usize| pixel(surfaces, node, *frame).is_none();
    let before = (0..seen.start).rev().take(GOES_ON).take_while(beyond).count();
    let after = (seen.end..frames).take(GOES_ON).take_while(beyond).count();
    seen.start - before..seen.end + after
}
