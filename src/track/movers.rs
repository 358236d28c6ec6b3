//! Depth of movers: each object's shape and path up to one scale, then the scale.
//!
//! [`super::shape`] gives the shape and path, [`super::distance`] the scale.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::ballistic;
use super::cameras::Cameras;
use super::contour::Region;
use super::depth::Layer;
use super::distance::{Behind, Distance, Observed};
use super::masks::regions;
use super::objects::{self, Object};
use super::outline::Outlines;
use super::relief::relief;
use super::shape::{Frame, OFF_CENTRE, Shape, UPRIGHT_DRIFT, shape};
use super::{Mover, estimated, quantile, unfollowed};
use crate::geometry::sim3::Sim3;
use crate::observe::NeighbourFlow;
use crate::types::{Image, Intrinsics, Pose};

/// Confidence of a mover's depth: `KNOWN` if the scale is known, `BOUND` if only a bound on it is.
pub(super) const KNOWN: f32 = 0.4;
pub(super) const BOUND: f32 = 0.2;
/// Inverse depth of an object relative to what it hides, used if nothing else is known about its depth.
pub(super) const NEARER: f64 = 1.25;

/// Minimum number of points or pixels with supplied depth that determine an object's depth in a frame.
const LEAST_SUPPLIED: usize = 5;

/// Two objects count as connected if they are in one mask region in this share of the frames in which both
/// are seen.
const TOGETHER: f64 = 0.75;

/// Mask regions are merged if the gap between them is less than 2 / `BESIDE` of the image width.
const BESIDE: usize = 64;

/// The movers of a clip in three dimensions.
pub(super) struct Lifted {
    /// Inverse depth and confidence of the movers' pixels, frame by frame; `None` at pixels without an
    /// object.
    pub pixels: Vec<Vec<Option<(f32, f32)>>>,
    /// As [`super::Track`] has them.
    pub movers: Vec<Mover>,
    /// As [`super::Track`] has them.
    pub owners: Vec<Image>,
}

impl Lifted {
    /// A result without objects, for clips whose moving pixels are not assigned to any object.
    pub fn nothing(masks: &[Image]) -> Lifted {
        Lifted {
            pixels: masks.iter().map(|mask| vec![None; mask.pixels.len()]).collect(),
            movers: Vec::new(),
            owners: masks.iter().map(|mask| Image::new(mask.width, mask.height, 1)).collect(),
        }
    }
}

/// Lifts all movers, which are in front of the static world `behind`. `layers` hold supplied depth.
pub(super) fn lift(
    frames: &[Image],
    cameras: &Cameras,
    flow: &NeighbourFlow,
    masks: &[Image],
    layers: &[Layer],
    behind: &[Behind<'_>],
) -> Lifted {
    let mut objects = objects::find(frames, flow, masks);
    let mut owners: Vec<Vec<Option<u16>>> =
        (0..masks.len()).into_par_iter().map(|f| owners(&objects, &masks[f], f)).collect();
    let shaped = |(i, object): (usize, &Object)| {
        let range = object.first..object.end;
        let (owners, behind) = (&owners[range.clone()], &behind[range.clone()]);
        let outlines = Outlines::new(i as u16, owners, behind, &cameras.intrinsics);
        shape(object, &frames[range], cameras, &outlines)
    };
    let mut shapes: Vec<Shape> = objects.iter().enumerate().map(shaped).collect();
    let points: Vec<Vec<DVec2>> =
        (0..masks.len()).map(|f| followed(&objects, &shapes, f)).collect();
    let spacing = objects::spacing(masks) as f64;
    let parts = unfollowed::find(frames, masks, &points, spacing);
    if let Some(parts) = &parts {
        let own = Some(objects.len() as u16);
        for (owners, part) in owners.iter_mut().zip(parts) {
            owners.iter_mut().zip(part).filter(|(_, part)| **part).for_each(|(o, _)| *o = own);
        }
    }
    let observed: Vec<Observed> = objects
        .par_iter()
        .zip(&shapes)
        .enumerate()
        .map(|(i, (object, shape))| {
            Observed::new(i, object, shape, &cameras.intrinsics, &owners, behind)
        })
        .collect();
    let paths: Vec<ballistic::Path> = observed.iter().map(Observed::path).collect();
    let flights = ballistic::flights(&paths, cameras);
    let mut known: Vec<Distance> = (0..objects.len())
        .into_par_iter()
        .map(|i| {
            let (object, shape) = (&objects[i], &shapes[i]);
            let supplied = supplied(i as u16, object, shape, &owners, layers, flow.width);
            Distance::supplied(shape, &supplied)
                .unwrap_or_else(|| observed[i].distance(cameras, flights[i].as_ref()))
        })
        .collect();
    join_connected(&objects, masks, &owners, &mut known);
    let mut scaled: Vec<(Vec<f64>, f32)> = known.iter().map(Distance::depths).collect();
    let reliefs: Vec<Vec<f64>> = (0..masks.len())
        .into_par_iter()
        .map(|f| reliefs(f, &objects, &shapes, &owners[f], behind[f].inverse, &cameras.intrinsics))
        .collect();
    let painted = |objects: &[Object], scaled: &[(Vec<f64>, f32)]| {
        let paint = |f: usize| paint(f, objects, scaled, &owners[f], &reliefs[f]);
        (0..masks.len()).into_par_iter().map(paint).collect::<Vec<_>>()
    };
    let mut pixels = painted(&objects, &scaled);
    if let Some(parts) = &parts {
        let (shape, depths) = before(parts, &pixels, behind, flow.width);
        objects.push(Object { tracks: Vec::new(), first: 0, end: masks.len() });
        shapes.push(shape);
        scaled.push((depths, BOUND));
        pixels = painted(&objects, &scaled);
    }
    // A rigid object keeps the shape that was estimated together with its motion.
    let open: Vec<bool> = shapes.iter().map(|shape| !shape.rigid).collect();
    estimated::shape(&mut pixels, &owners, &open, layers, flow);
    let movers = objects
        .iter()
        .zip(&shapes)
        .zip(&scaled)
        .map(|((object, shape), (depths, _))| Mover {
            first: object.first,
            world_from_object: motion(object, shape, depths, cameras),
        })
        .collect();
    let numbered = |owner: &Option<u16>| owner.map_or(0.0, |i| f32::from(i) + 1.0);
    let owners = owners
        .iter()
        .zip(masks)
        .map(|(own, mask)| Image { pixels: own.iter().map(numbered).collect(), ..*mask })
        .collect();
    Lifted { pixels, movers, owners }
}

/// The logarithm of the depth of an object's middle from supplied depth, frame by frame. It is measured at
/// the object's tracked points, or at all its pixels if too few points have supplied depth. `None` in frames
/// in which the object has too little supplied depth.
fn supplied(
    index: u16,
    object: &Object,
    shape: &Shape,
    owners: &[Vec<Option<u16>>],
    layers: &[Layer],
    width: usize,
) -> Vec<Option<f64>> {
    let in_frame = |(k, frame): (usize, &Frame)| {
        let f = object.first + k;
        let (layer, owners) = (&layers[f], &owners[f]);
        let depth = |i: usize| {
            let told = layer.told(i).filter(|_| owners[i] == Some(index));
            told.map(|inverse| -inverse.ln())
        };
        let relative = object.tracks.iter().zip(&frame.relative);
        let mut told: Vec<f64> = relative
            .filter_map(|(track, relative)| {
                Some(depth(nearest_pixel(track.at(f)?, width, owners.len()))? - (*relative)?.ln())
            })
            .collect();
        if told.len() < LEAST_SUPPLIED {
            told = (0..owners.len()).filter_map(depth).collect();
        }
        (told.len() >= LEAST_SUPPLIED).then(|| quantile(told, 0.5))
    };
    shape.frames.iter().enumerate().map(in_frame).collect()
}

/// Shares distances between connected objects. Objects that are connected in the masks in most frames are
/// parts of one object, or one holds the other. An object whose own path does not determine its distance
/// takes the distance of a connected object whose path does. If neither path does, the smaller object takes
/// the distance of the larger one.
fn join_connected(
    objects: &[Object],
    masks: &[Image],
    owners: &[Vec<Option<u16>>],
    known: &mut [Distance],
) {
    let n = objects.len();
    let mut pixels = vec![0usize; n];
    // The number of frames in which two objects have most of their pixels in the same region.
    let mut together = vec![vec![0usize; n]; n];
    for (mask, owners) in masks.iter().zip(owners) {
        let mut home: Vec<(usize, usize)> = vec![(0, 0); n];
        let width = mask.width as usize;
        let near =
            mask.near((width / BESIDE).max(1)).into_iter().map(|near| f32::from(u8::from(near)));
        let near: Vec<f32> = near.collect();
        for (r, (region, _)) in regions(&near, width, true).iter().enumerate() {
            let mut counts = vec![0usize; n];
            for owner in region.iter().filter_map(|i| owners[*i]).map(usize::from) {
                if owner < n {
                    counts[owner] += 1;
                    pixels[owner] += 1;
                }
            }
            for (home, count) in home.iter_mut().zip(counts) {
                if count > home.0 {
                    *home = (count, r);
                }
            }
        }
        for a in 0..n {
            for b in 0..n {
                let both = home[a].0 > 0 && home[b].0 > 0;
                together[a][b] += usize::from(both && home[a].1 == home[b].1);
            }
        }
    }
    // Objects with a known distance come first, then larger ones before smaller ones.
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by_key(|i| (!known[*i].is_known(), std::cmp::Reverse(pixels[*i])));
    for (place, own) in order.iter().copied().enumerate() {
        if known[own].is_known() {
            continue;
        }
        let frames = objects[own].first..objects[own].end;
        let shared = |other: &usize| {
            let end = frames.end.min(objects[*other].end);
            end.saturating_sub(frames.start.max(objects[*other].first))
        };
        let held = |other: &&usize| {
            let least = TOGETHER * (frames.len().min(shared(other).max(1)) as f64);
            2 * shared(other) >= frames.len() && together[own][**other] as f64 >= least
        };
        if let Some(other) = order[..place].iter().find(held).copied() {
            let first = objects[other].first;
            let [own, other] = known.get_disjoint_mut([own, other]).expect("an order has no twins");
            own.depend_on(frames.start, (other, first));
        }
    }
}

/// The transform of an object, frame by frame, from its structure from motion. In other frames it keeps the
/// orientation in the world of the nearest frame with structure, and its middle follows `depths`.
fn motion(object: &Object, shape: &Shape, depths: &[f64], cameras: &Cameras) -> Vec<Sim3> {
    let known: Vec<Option<Sim3>> = shape
        .frames
        .iter()
        .zip(depths)
        .enumerate()
        .map(|(k, (frame, depth))| {
            let view_from_object = frame.view_from_object?;
            let scale = depth / frame.depth;
            let world_from_view = cameras.poses[object.first + k].inverse();
            let world_from_object = world_from_view
                * Pose::new(view_from_object.rotation, scale * view_from_object.translation);
            let Pose { rotation, translation } = world_from_object;
            Some(Sim3 { scale, rotation, translation })
        })
        .collect();
    let run: Vec<usize> = (0..known.len()).filter(|k| known[*k].is_some()).collect();
    shape
        .frames
        .iter()
        .zip(depths)
        .enumerate()
        .map(|(k, (frame, depth))| {
            if let Some(known) = known[k] {
                return known;
            }
            let nearest = run.iter().min_by_key(|r| r.abs_diff(k)).and_then(|r| known[*r]);
            let nearest = nearest.unwrap_or(Sim3::IDENTITY);
            let ray = cameras.intrinsics.ray(frame.middle);
            let middle = cameras.poses[object.first + k].inverse().apply(ray * *depth);
            let translation = middle - nearest.scale * (nearest.rotation * shape.middle);
            Sim3 { translation, ..nearest }
        })
        .collect()
}

/// For each pixel of a mover, the object that has the nearest tracked point within the same mask region.
fn owners(objects: &[Object], mask: &Image, frame: usize) -> Vec<Option<u16>> {
    let w = mask.width as usize;
    let mut points: Vec<(u16, DVec2)> = Vec::new();
    for (i, object) in objects.iter().enumerate() {
        points.extend(object.tracks.iter().filter_map(|t| Some((i as u16, t.at(frame)?))));
    }
    let mut out = vec![None; mask.pixels.len()];
    for (region, _) in regions(&mask.pixels, w, true) {
        let own: Vec<&(u16, DVec2)> = {
            let inside: std::collections::HashSet<usize> = region.iter().copied().collect();
            let pixel = |p: DVec2| nearest_pixel(p, w, out.len());
            points.iter().filter(|(_, p)| inside.contains(&pixel(*p))).collect()
        };
        for i in region {
            let p = DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            let distance = |q: &&&(u16, DVec2)| q.1.distance_squared(p);
            out[i] = own.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).map(|q| q.0);
        }
    }
    out
}

/// The index of the pixel that contains a point, or of the nearest pixel if the point is outside the image.
pub(super) fn nearest_pixel(point: DVec2, width: usize, pixels: usize) -> usize {
    let x = (point.x.max(0.0) as usize).min(width - 1);
    (point.y.max(0.0) as usize).min(pixels / width - 1) * width + x
}

/// The tracked points of a frame that move with their object.
fn followed(objects: &[Object], shapes: &[Shape], frame: usize) -> Vec<DVec2> {
    let of = |(object, shape): (&Object, &Shape)| {
        let k = frame.checked_sub(object.first).filter(|k| *k < shape.frames.len());
        let relative = k.map_or(&[][..], |k| &shape.frames[k].relative);
        let goes = object.tracks.iter().zip(relative).filter(|(_, relative)| relative.is_some());
        goes.filter_map(|(track, _)| track.at(frame)).collect::<Vec<_>>()
    };
    objects.iter().zip(shapes).flat_map(of).collect()
}

/// The shape and the depth of the untracked parts of movers. Each part is flat, and nearer than what it
/// hides: tracked movers (`pixels`: their inverse depth) and the static world.
fn before(
    parts: &[Vec<bool>],
    pixels: &[Vec<Option<(f32, f32)>>],
    behind: &[Behind<'_>],
    width: usize,
) -> (Shape, Vec<f64>) {
    let known: Vec<Option<(DVec2, f64)>> = (0..parts.len())
        .map(|f| {
            let own: Vec<usize> = (0..parts[f].len()).filter(|i| parts[f][*i]).collect();
            let middle = |k: usize| {
                let place = |i: &usize| [i % width, i / width][k] as f64 + 0.5;
                quantile(own.iter().map(place).collect(), 0.5)
            };
            let movers = pixels[f].iter().flatten().map(|(inverse, _)| f64::from(*inverse));
            let still = own.iter().map(|i| f64::from(behind[f].inverse[*i]));
            let hidden = [movers.collect::<Vec<_>>(), still.collect()]
                .into_iter()
                .filter(|hidden| !hidden.is_empty())
                .map(|hidden| quantile(hidden, 0.5))
                .fold(0.0, f64::max);
            (hidden > 0.0 && !own.is_empty())
                .then(|| (DVec2::new(middle(0), middle(1)), 1.0 / (NEARER * hidden)))
        })
        .collect();
    // In frames where the parts are not seen, the values of the nearest frame with them are used.
    let seen: Vec<usize> = (0..known.len()).filter(|f| known[*f].is_some()).collect();
    let (middles, depths): (Vec<DVec2>, Vec<f64>) = (0..known.len())
        .map(|f| {
            let nearest = seen.iter().min_by_key(|s| s.abs_diff(f));
            nearest.and_then(|s| known[*s]).unwrap_or((DVec2::ZERO, 1.0))
        })
        .unzip();
    let frame = |(middle, depth): (&DVec2, &f64)| Frame {
        depth: *depth,
        middle: *middle,
        relative: Vec::new(),
        view_from_object: None,
    };
    let frames = middles.iter().zip(&depths).map(frame).collect();
    let drift = vec![UPRIGHT_DRIFT; depths.len().saturating_sub(1)];
    (Shape { frames, drift, middle: DVec3::ZERO, rigid: false, off_centre: OFF_CENTRE.0 }, depths)
}

/// The relief of all movers in a frame: the logarithm of each pixel's depth relative to the depth of its
/// mover.
fn reliefs(
    frame: usize,
    objects: &[Object],
    shapes: &[Shape],
    owners: &[Option<u16>],
    behind: &[f32],
    intrinsics: &Intrinsics,
) -> Vec<f64> {
    let mut out = vec![0.0; owners.len()];
    for (index, (object, shape)) in objects.iter().zip(shapes).enumerate() {
        let Some(k) = frame.checked_sub(object.first).filter(|k| *k < shape.frames.len()) else {
            continue;
        };
        let region = Region::new(index as u16, owners, behind, intrinsics.width as usize);
        // Without structure from motion only the image positions of the points are known.
        let structured = shape.frames[k].view_from_object.is_some();
        let relative = object.tracks.iter().zip(&shape.frames[k].relative);
        let points: Vec<(DVec2, Option<f64>)> = relative
            .filter_map(|(track, relative)| Some((track.at(frame)?, (*relative)?.ln())))
            .map(|(pixel, depth)| (pixel, structured.then_some(depth)))
            .collect();
        let relief = relief(&region, &points, intrinsics);
        region.pixels.iter().zip(relief).for_each(|(pixel, relief)| out[*pixel] = relief);
    }
    out
}

/// Inverse depth and confidence of a frame's movers.
fn paint(
    frame: usize,
    objects: &[Object],
    scaled: &[(Vec<f64>, f32)],
    owners: &[Option<u16>],
    relief: &[f64],
) -> Vec<Option<(f32, f32)>> {
    let pixel = |(owner, relief): (&Option<u16>, &f64)| {
        let owner = usize::from((*owner)?);
        let k = frame.checked_sub(objects.get(owner)?.first)?;
        let (depths, confidence) = &scaled[owner];
        Some(((1.0 / (depths.get(k)? * relief.exp())) as f32, *confidence))
    };
    owners.iter().zip(relief).map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::super::sliding::{self, FRAMES, HEIGHT, STEP, WALL, WIDTH, map, within};
    use super::*;

    #[test]
    fn what_is_not_followed_lies_before_what_is() {
        // The left half of the mover moves down uniformly. On its right half the flow differs at every pixel,
        // and the backward flow never leads back.
        let left = |frame: usize, p: DVec2| {
            within(p, (8.0, 3.0 + frame as f64), (32.0, 33.0 + frame as f64))
        };
        let right = |frame: usize, p: DVec2| {
            within(p, (32.0, 3.0 + frame as f64), (56.0, 33.0 + frame as f64))
        };
        let flow = sliding::flow(|frame, p| {
            if left(frame, p) {
                DVec2::new(0.0, 1.0)
            } else if right(frame, p) {
                DVec2::new(3.0 + 2.0 * p.x.sin(), 3.0 * (5.0 * p.y).cos())
            } else {
                sliding::wall()
            }
        });
        let frame = |f: usize| {
            let mut image = Image::new(WIDTH, HEIGHT, 3);
            for (i, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
                pixel.fill(if right(f, sliding::centre(i)) { 0.8 } else { 0.3 });
            }
            image
        };
        let frames: Vec<Image> = (0..FRAMES).map(frame).collect();
        let mask = |f: usize| map(move |p| f32::from(u8::from(left(f, p) || right(f, p))));
        let masks: Vec<Image> = (0..FRAMES).map(mask).collect();
        let (inverse, confidence) =
            (map(|_| (1.0 / WALL) as f32).pixels, vec![1.0; masks[0].pixels.len()]);
        let behind =
            vec![Behind { inverse: &inverse, confidence: &confidence, ground: None }; FRAMES];
        let layers = layers(&inverse, |_, _| None);
        let lifted = lift(&frames, &sliding::cameras(STEP), &flow, &masks, &layers, &behind);
        assert_eq!(lifted.movers.len(), 2);
        for f in 0..FRAMES {
            let depth = |half: &dyn Fn(usize, DVec2) -> bool, owner: f32| {
                let own = (0..masks[f].pixels.len()).filter(|i| half(f, sliding::centre(*i)));
                let own: Vec<usize> =
                    own.filter(|i| lifted.owners[f].pixels[*i] == owner).collect();
                assert!(own.len() > 24 * 30 * 9 / 10, "frame {f}, owner {owner}: {}", own.len());
                let inverse = own.iter().map(|i| f64::from(lifted.pixels[f][*i].unwrap().0));
                quantile(inverse.collect(), 0.5)
            };
            let ratio = depth(&right, 2.0) / depth(&left, 1.0);
            assert!((ratio / NEARER - 1.0).abs() < 0.02, "frame {f}: {ratio}");
        }
    }

    #[test]
    fn the_smaller_of_two_that_touch_is_about_as_far_as_the_larger() {
        // One object moves down and a smaller one beside it moves up, in front of walls at different depths.
        let large = |frame: usize, p: DVec2| {
            let y = 6.0 + 2.0 * frame as f64;
            within(p, (10.0, y), (32.0, y + 20.0))
        };
        let small = |frame: usize, p: DVec2| {
            let y = 18.0 - 2.0 * frame as f64;
            within(p, (32.0, y), (44.0, y + 14.0))
        };
        let flow = sliding::flow(|frame, p| match (large(frame, p), small(frame, p)) {
            (true, _) => DVec2::new(0.0, 2.0),
            (_, true) => DVec2::new(0.0, -2.0),
            _ => sliding::wall(),
        });
        let mask = |f: usize| map(move |p| f32::from(u8::from(large(f, p) || small(f, p))));
        let masks: Vec<Image> = (0..FRAMES).map(mask).collect();
        let inverse = map(|p| if p.x < 32.0 { 0.25 } else { 0.1 }).pixels;
        let confidence = vec![1.0; inverse.len()];
        let behind =
            vec![Behind { inverse: &inverse, confidence: &confidence, ground: None }; FRAMES];
        let (cameras, layers) = (sliding::cameras(STEP), layers(&inverse, |_, _| None));
        let lifted = lift(&sliding::frames(), &cameras, &flow, &masks, &layers, &behind);
        assert_eq!(lifted.movers.len(), 2);
        let depth = |owner: f32| {
            let pixels = lifted.pixels[2].iter().zip(&lifted.owners[2].pixels);
            let own = pixels.filter(|(_, o)| **o == owner).map(|(p, _)| f64::from(p.unwrap().0));
            quantile(own.collect(), 0.5).recip()
        };
        let ratio = depth(2.0) / depth(1.0);
        assert!((ratio.ln() + 0.05).abs() < 0.03, "{ratio}");
    }

    /// The static world, and the supplied depth of a frame's pixels.
    fn layers(inverse: &[f32], supplied: impl Fn(usize, DVec2) -> Option<f64>) -> Vec<Layer> {
        let layer = |f: usize| {
            let told = (0..inverse.len()).map(|i| supplied(f, sliding::centre(i)));
            let told: Vec<Option<f64>> = told.collect();
            let depth =
                |(known, own): (&Option<f64>, &f32)| known.map_or(*own, |z| (1.0 / z) as f32);
            Layer {
                estimated: Vec::new(),
                inverse: told.iter().zip(inverse).map(depth).collect(),
                confidence: vec![1.0; inverse.len()],
                supplied: told.iter().map(Option::is_some).collect(),
            }
        };
        (0..FRAMES).map(layer).collect()
    }

    #[test]
    fn supplied_depth_tells_how_far_an_object_is() {
        // Only the upper half has supplied depth, with an error of 4 % whose sign alternates.
        let inside = |frame: usize, p: DVec2| {
            let y = 4.0 + 2.0 * frame as f64;
            within(p, (14.0, y), (44.0, y + 24.0))
        };
        let flow = sliding::flow(|frame, p| match inside(frame, p) {
            true => DVec2::new(0.0, 2.0),
            false => sliding::wall(),
        });
        let mask = |f: usize| map(move |p| f32::from(u8::from(inside(f, p))));
        let masks: Vec<Image> = (0..FRAMES).map(mask).collect();
        let (inverse, confidence) =
            (map(|_| (1.0 / WALL) as f32).pixels, vec![1.0; masks[0].pixels.len()]);
        let behind =
            vec![Behind { inverse: &inverse, confidence: &confidence, ground: None }; FRAMES];
        let depth = 0.37 * WALL;
        let off = |f: usize| 1.0 + 0.04 * [1.0, -1.0][f % 2];
        let lifted = |supplied: &dyn Fn(usize, DVec2) -> Option<f64>| {
            let (cameras, layers) = (sliding::cameras(STEP), layers(&inverse, supplied));
            lift(&sliding::frames(), &cameras, &flow, &masks, &layers, &behind)
        };
        let upper = |f: usize, p: DVec2| inside(f, p) && p.y < 14.0 + 2.0 * f as f64;
        let found = lifted(&|f, p| upper(f, p).then(|| depth * off(f)));
        assert_eq!(found.movers.len(), 1);
        let last = found.movers[0].world_from_object.len() - 1;
        for f in 0..=last {
            let own = found.pixels[f].iter().flatten().map(|(inverse, _)| f64::from(*inverse));
            let far = quantile(own.collect(), 0.5).recip() / depth;
            assert!((far - 1.0).abs() < 0.03, "frame {f}: {far}");
            assert!(found.pixels[f].iter().flatten().all(|(_, confidence)| *confidence == KNOWN));
        }
        // Supplied depth in one frame is too little.
        let one = lifted(&|f, p| (f == 0 && upper(f, p)).then_some(depth));
        let none = lifted(&|_, _| None);
        assert_eq!(one.pixels, none.pixels);
    }
}
