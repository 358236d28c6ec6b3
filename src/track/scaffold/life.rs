//! The frames in which a node is there at all.
//!
//! An object is there from the first frame that shows it to the last one; that something hides it in
//! between, or that a mask misses it, changes nothing. Before and after, it is not where it was seen last:
//! where the picture shows that place, it would show the object. Only a node whose place the picture does
//! not show can still be there, and is for some frames: a camera elsewhere sees an object leave later.
//!
//! A node that is on no known object is judged by itself: by the frames whose masks, around its place, show
//! something that moves and belongs to no object.

use std::ops::Range;

use glam::DVec2;
use rayon::prelude::*;

use super::{Node, Surfaces};

/// An object is seen in a frame that shows so many of its pixels.
const LEAST_PIXELS: usize = 12;
/// A node goes on for so many frames where the picture does not show its place.
const GOES_ON: usize = 6;

/// Says of each node in which frames it is there.
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

/// How many pixels of each object a frame shows; first those of none.
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

/// The pixel that shows a node's place, if the picture does.
fn pixel(surfaces: &Surfaces<'_>, node: &Node, frame: usize) -> Option<DVec2> {
    let view = surfaces.view_from_world[frame].apply(node.world_from_node[frame].translation);
    let pixel = surfaces.intrinsics.project(view);
    let size = DVec2::new(surfaces.flow.width as f64, surfaces.flow.height as f64);
    (view.z > 0.0 && pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all()).then_some(pixel)
}

/// Whether a frame shows something of the node's object around its place.
fn shown(surfaces: &Surfaces<'_>, node: &Node, frame: usize) -> bool {
    let Some(middle) = pixel(surfaces, node, frame) else { return false };
    let place = node.world_from_node[frame].translation;
    let half = 0.5 * node.spacing / surfaces.pixel_size(frame, place);
    let around = [DVec2::ZERO, DVec2::X, -DVec2::X, DVec2::Y, -DVec2::Y];
    around.iter().any(|off| surfaces.owner(frame, middle + half * *off) == Some(node.owner))
}

/// The frames in which a node is there that was seen in some.
fn extended(surfaces: &Surfaces<'_>, node: &Node, seen: Range<usize>) -> Range<usize> {
    let frames = surfaces.masks.len();
    let beyond = |frame: &usize| pixel(surfaces, node, *frame).is_none();
    let before = (0..seen.start).rev().take(GOES_ON).take_while(beyond).count();
    let after = (seen.end..frames).take(GOES_ON).take_while(beyond).count();
    seen.start - before..seen.end + after
}
