//! Pixels and ground truth of one moment: colour, depth, flow, masks, visibility.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::scene::{Part, Scene};
use super::texture::Material;
use super::trace::{Bvh, Hit};
use crate::types::{Camera, Image};

/// Rays per pixel along each axis. Fine detail is a few pixels wide at the nominal size.
const SAMPLES: usize = 3;
/// Number of rays that measure a vertex's ambient occlusion.
const OPENNESS_RAYS: usize = 32;
/// Maximum distance of an occluder for ambient occlusion, m.
const OPENNESS_REACH: f64 = 0.9;

/// Direction to the lamp.
const LAMP: DVec3 = DVec3::new(-0.45, -0.75, -0.55);
/// The lamp's radius over its distance, which sets the softness of shadows.
const LAMP_SIZE: f64 = 0.05;
/// Exponent of the specular highlight, and its strength relative to the gloss.
const HIGHLIGHT: (i32, f32) = (40, 2.0);

/// Light at a vertex.
#[derive(Clone, Copy)]
struct Light {
    /// Light that movers do not block.
    steady: f32,
    /// Light of the lamp, which movers may block.
    lamp: f32,
}

/// The static data of a clip: the triangles of all parts, and their light.
pub(super) struct Geometry {
    parts: Vec<Part>,
    triangles: Vec<[u32; 3]>,
    /// Index of each triangle's part.
    part_of: Vec<u32>,
    texture: Vec<Vec3>,
    /// Light baked at rest. Unless the scene is dynamically lit, a surface keeps its brightness under any
    /// motion and from any direction, so that the ground-truth flow is exact in the pixels as well.
    light: Vec<Light>,
    /// Whether movers are lit at their current positions and cast shadows.
    lit: bool,
    /// Triangles of movers, with their corners anticlockwise seen from outside.
    moving: Vec<[u32; 3]>,
}

/// The geometry at one time.
pub(super) struct Moment {
    positions: Vec<DVec3>,
    bvh: Bvh,
    /// Lighting of a dynamically lit scene.
    lit: Option<Lit>,
}

/// The lighting of a moment.
struct Lit {
    normals: Vec<DVec3>,
    light: Vec<Light>,
    /// Hierarchy over the movers.
    movers: Bvh,
}

/// Ground truth at the pixels' centres of one camera.
pub(super) struct Truth {
    /// One channel: z in the camera frame.
    pub depth: Image,
    /// One channel: 1 where a mover is visible.
    pub mask: Image,
    /// Flow to each of the other requested moments.
    pub flows: Vec<Flow>,
}

/// Displacement of the surface points at one frame's pixel centres to another frame.
pub(super) struct Flow {
    /// Two channels: displacement in pixels; NaN for a point behind the other camera.
    pub flow: Image,
    /// One channel: 1 where the point is visible in the other frame.
    pub visible: Image,
}

impl Geometry {
    pub fn new(scene: Scene) -> Geometry {
        let mut geometry = Geometry {
            triangles: Vec::new(),
            part_of: Vec::new(),
            texture: Vec::new(),
            light: Vec::new(),
            lit: scene.lit,
            moving: Vec::new(),
            parts: scene.parts,
        };
        let mut still = Vec::new();
        for (index, part) in (0u32..).zip(&geometry.parts) {
            let offset = geometry.texture.len() as u32;
            let triangles = part.mesh.triangles.iter().map(|t| t.map(|v| v + offset));
            match part.motion {
                None => still.extend(triangles.clone()),
                Some(_) => {
                    let outwards = part.mesh.triangles_outwards();
                    geometry.moving.extend(outwards.map(|t| t.map(|v| v + offset)));
                }
            }
            geometry.triangles.extend(triangles);
            geometry.part_of.resize(geometry.triangles.len(), index);
            geometry.texture.extend(part.mesh.vertices.iter().map(|v| v.texture));
        }
        let vertices = || geometry.parts.iter().flat_map(|part| &part.mesh.vertices);
        let rest: Vec<DVec3> = vertices().map(|v| v.position).collect();
        let surroundings = Bvh::build(&rest, &still);
        let lit = geometry.lit;
        geometry.light = geometry
            .parts
            .par_iter()
            .flat_map(|part| {
                // Ambient occlusion is not baked into movers, because it would move along.
                let open = part.motion.is_none().then_some(&surroundings);
                part.mesh.vertices.par_iter().map(move |v| {
                    let open = open.map_or(1.0, |bvh| openness(v.position, v.normal, bvh));
                    if lit { light(v.normal, open) } else { baked(v.normal, open) }
                })
            })
            .collect();
        geometry
    }

    /// The geometry at a time in [0, 1].
    pub fn at(&self, time: f64) -> Moment {
        let place = |part: &Part, rest| part.motion.as_ref().map_or(rest, |m| m(rest, time));
        let positions: Vec<DVec3> = self
            .parts
            .iter()
            .flat_map(|part| part.mesh.vertices.iter().map(move |v| place(part, v.position)))
            .collect();
        let bvh = Bvh::build(&positions, &self.triangles);
        let lit = self.lit.then(|| self.lit_at(&positions));
        Moment { positions, bvh, lit }
    }

    /// Normals and light at a moment whose vertices are at `positions`.
    fn lit_at(&self, positions: &[DVec3]) -> Lit {
        let mut normals = vec![DVec3::ZERO; positions.len()];
        for triangle in &self.moving {
            let [a, b, c] = triangle.map(|v| positions[v as usize]);
            // Proportional to the triangle's area, so that larger triangles weigh more.
            let normal = (b - a).cross(c - a);
            triangle.iter().for_each(|v| normals[*v as usize] += normal);
        }
        let mut light = self.light.clone();
        let parts = self.parts.iter().flat_map(|part| {
            part.mesh.vertices.iter().map(move |v| (v.normal, part.motion.is_some()))
        });
        for ((place, now), (normal, moves)) in normals.iter_mut().zip(&mut light).zip(parts) {
            *place = match place.try_normalize().filter(|_| moves) {
                Some(found) => found,
                None => normal,
            };
            if moves {
                *now = self::light(*place, 1.0);
            }
        }
        Lit { normals, light, movers: Bvh::build(positions, &self.moving) }
    }

    fn material(&self, hit: &Hit) -> &Material {
        &self.parts[self.part_of[hit.triangle as usize] as usize].material
    }

    /// Interpolates a vertex attribute at a hit.
    fn at_hit<T: std::ops::Mul<f32, Output = T> + std::iter::Sum>(
        &self,
        hit: &Hit,
        of: impl Fn(usize) -> T,
    ) -> T {
        let corners = self.triangles[hit.triangle as usize].map(|v| v as usize);
        let [b, c] = hit.weights.map(|w| w as f32);
        corners.into_iter().zip([1.0 - b - c, b, c]).map(|(v, weight)| of(v) * weight).sum()
    }

    /// The colour along a ray; `sample` selects the point on the lamp.
    fn colour(&self, moment: &Moment, ray: (DVec3, DVec3), hit: &Hit, sample: usize) -> Vec3 {
        let Some(lit) = &moment.lit else {
            let unlit = self.material(hit).colour(self.at_hit(hit, |v| self.texture[v]));
            return (unlit * self.at_hit(hit, |v| self.light[v].steady))
                .clamp(Vec3::ZERO, Vec3::ONE);
        };
        let (colour, open) = self.lit_colour(lit, ray, hit, sample);
        let gloss = self.material(hit).gloss;
        if gloss == 0.0 {
            return colour.clamp(Vec3::ZERO, Vec3::ONE);
        }
        let normal = self.facing(lit, hit, ray.1);
        let back = ray.1 - 2.0 * ray.1.dot(normal) * normal;
        let onward = (off_surface(ray, hit, normal), back);
        // Surfaces seen in a reflection do not reflect in turn.
        let seen = moment.bvh.nearest(onward.0, onward.1, None);
        let mirrored =
            seen.map_or(Vec3::ZERO, |seen| self.lit_colour(lit, onward, &seen, sample).0);
        let (sharpness, strength) = HIGHLIGHT;
        let aligned = back.normalize().dot(LAMP.normalize()).max(0.0) as f32;
        let highlight = strength * open * aligned.powi(sharpness);
        (colour * (1.0 - gloss) + (mirrored + Vec3::splat(highlight)) * gloss)
            .clamp(Vec3::ZERO, Vec3::ONE)
    }

    /// Colour of a lit surface, and 1 where the lamp is visible from it, else 0.
    fn lit_colour(&self, lit: &Lit, ray: (DVec3, DVec3), hit: &Hit, sample: usize) -> (Vec3, f32) {
        let unlit = self.material(hit).colour(self.at_hit(hit, |v| self.texture[v]));
        let normal = self.facing(lit, hit, ray.1);
        let angle = sample as f64 * TAU * 0.618_033_988_749_895;
        let radius = LAMP_SIZE * ((sample as f64 + 0.5) / (SAMPLES * SAMPLES) as f64).sqrt();
        let lamp = LAMP.normalize();
        let (across, up) = lamp.any_orthonormal_pair();
        let lamp = lamp + (across * angle.cos() + up * angle.sin()) * radius;
        let hidden = lit.movers.blocked(off_surface(ray, hit, normal), lamp, f64::INFINITY);
        let open = if hidden { 0.0 } else { 1.0 };
        let steady: f32 = self.at_hit(hit, |v| lit.light[v].steady);
        let of_lamp: f32 = self.at_hit(hit, |v| lit.light[v].lamp);
        (unlit * (steady + of_lamp * open), open)
    }

    /// The unit normal on the side that the ray hits.
    fn facing(&self, lit: &Lit, hit: &Hit, direction: DVec3) -> DVec3 {
        let corners = self.triangles[hit.triangle as usize].map(|v| lit.normals[v as usize]);
        let [b, c] = hit.weights;
        let normal = corners[0] * (1.0 - b - c) + corners[1] * b + corners[2] * c;
        let normal = normal.try_normalize().unwrap_or(corners[0]);
        if normal.dot(direction) > 0.0 { -normal } else { normal }
    }

    /// Renders an image: three channels, each pixel averaged over its area.
    pub fn picture(&self, moment: &Moment, camera: &Camera) -> Image {
        let view = View::new(camera);
        let (width, height) = (view.width, view.height);
        let rows: Vec<Vec<f32>> = (0..height)
            .into_par_iter()
            .map(|y| {
                let mut guess = None;
                let pixel = |x| self.pixel(moment, &view, x, y, &mut guess).to_array();
                (0..width).flat_map(pixel).collect()
            })
            .collect();
        Image { width, height, channels: 3, pixels: rows.concat() }
    }

    /// The mean colour of a pixel. Where the four outermost rays hit one triangle, those between them do as
    /// well (except for objects thinner than a pixel) and need no search.
    fn pixel(&self, moment: &Moment, view: &View, x: u32, y: u32, guess: &mut Option<u32>) -> Vec3 {
        let place = |i: usize| (i as f64 + 0.5) / SAMPLES as f64;
        let ray = |i, j| view.ray(DVec2::new(x as f64 + place(i), y as f64 + place(j)));
        let last = SAMPLES - 1;
        let corners = [(0, 0), (last, 0), (0, last), (last, last)].map(|(i, j)| {
            let hit = moment.bvh.nearest(view.centre, ray(i, j), *guess);
            *guess = hit.map(|h| h.triangle);
            *guess
        });
        let whole = corners[0].filter(|_| corners.iter().all(|c| *c == corners[0]));
        let mut sum = Vec3::ZERO;
        for j in 0..SAMPLES {
            for i in 0..SAMPLES {
                let hit = match whole {
                    Some(triangle) => moment.bvh.on_plane(triangle, view.centre, ray(i, j)),
                    None => moment.bvh.nearest(view.centre, ray(i, j), *guess),
                };
                let along = (view.centre, ray(i, j));
                let colour = |h| self.colour(moment, along, &h, j * SAMPLES + i);
                sum += hit.map_or(Vec3::ZERO, colour);
            }
        }
        sum / (SAMPLES * SAMPLES) as f32
    }

    /// Depth and mask of a frame, and its flow to others.
    pub fn truth(&self, here: (&Moment, &Camera), others: &[(&Moment, &Camera)]) -> Truth {
        let (moment, camera) = here;
        let view = View::new(camera);
        let (width, height) = (view.width, view.height);
        let image = |channels| Image::new(width, height, channels);
        let mut truth = Truth {
            depth: image(1),
            mask: image(1),
            flows: others.iter().map(|_| Flow { flow: image(2), visible: image(1) }).collect(),
        };
        let hits: Vec<Option<Hit>> = (0..height)
            .into_par_iter()
            .flat_map_iter(|y| {
                let mut guess = None;
                (0..width)
                    .map(move |x| (x, y))
                    .map(|(x, y)| {
                        let ray = view.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
                        let hit = moment.bvh.nearest(view.centre, ray, guess);
                        guess = hit.map(|h| h.triangle);
                        hit
                    })
                    .collect::<Vec<_>>()
            })
            .collect();
        for (pixel, hit) in hits.iter().enumerate() {
            if let Some(hit) = hit {
                let part = self.part_of[hit.triangle as usize] as usize;
                truth.depth.pixels[pixel] = hit.t as f32;
                truth.mask.pixels[pixel] = f32::from(self.parts[part].motion.is_some());
            }
        }
        for ((moment, camera), flow) in others.iter().zip(&mut truth.flows) {
            let there = View::new(camera);
            flow.flow
                .pixels
                .par_chunks_exact_mut(2)
                .zip(&mut flow.visible.pixels)
                .zip(&hits)
                .enumerate()
                .for_each(|(pixel, ((flow, visible), hit))| {
                    let (x, y) = (pixel % width as usize, pixel / width as usize);
                    let from = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    let to = hit.and_then(|hit| self.seen_in(&hit, moment, camera, &there));
                    let (to, seen) = to.unwrap_or((DVec2::NAN, false));
                    flow.copy_from_slice(&(to - from).as_vec2().to_array());
                    *visible = f32::from(seen);
                });
        }
        truth
    }

    /// The hits of a camera's rays at some pixels.
    pub fn hits(&self, (moment, camera): (&Moment, &Camera), pixels: &[DVec2]) -> Vec<Option<Hit>> {
        let view = View::new(camera);
        let hit = |pixel: &DVec2| moment.bvh.nearest(view.centre, view.ray(*pixel), None);
        pixels.par_iter().map(hit).collect()
    }

    /// Positions of surface points in a camera, and whether they are visible there; NaN behind the camera.
    pub fn places<'a>(
        &self,
        hits: impl Iterator<Item = &'a Hit>,
        (moment, camera): (&Moment, &Camera),
    ) -> Vec<(DVec2, bool)> {
        let view = View::new(camera);
        let place = |hit| self.seen_in(hit, moment, camera, &view);
        hits.map(|hit| place(hit).unwrap_or((DVec2::NAN, false))).collect()
    }

    /// The median depth of a camera's view.
    pub fn median_depth(&self, moment: &Moment, camera: &Camera) -> f64 {
        let mut depth = self.truth((moment, camera), &[]).depth.pixels;
        depth.retain(|z| *z > 0.0);
        let middle = depth.len() / 2;
        if depth.is_empty() {
            return 0.0;
        }
        f64::from(*depth.select_nth_unstable_by(middle, f32::total_cmp).1)
    }

    /// Position of a surface point in another camera, and whether it is visible there.
    fn seen_in(
        &self,
        hit: &Hit,
        moment: &Moment,
        camera: &Camera,
        view: &View,
    ) -> Option<(DVec2, bool)> {
        let [a, b, c] = self.triangles[hit.triangle as usize].map(|v| moment.positions[v as usize]);
        let [weight_b, weight_c] = hit.weights;
        let point = a + (b - a) * weight_b + (c - a) * weight_c;
        let local = camera.view_from_world.apply(point);
        if local.z <= 0.0 {
            return None;
        }
        let to = camera.intrinsics.project(local);
        let inside = to.x >= 0.0
            && to.y >= 0.0
            && to.x < f64::from(view.width)
            && to.y < f64::from(view.height);
        let seen = inside
            && moment
                .bvh
                .nearest(view.centre, view.ray(to), Some(hit.triangle))
                .is_some_and(|first| first.t > local.z * (1.0 - 1e-4));
        Some((to, seen))
    }
}

/// The hit point, offset from the surface so that a ray from there does not hit it again.
fn off_surface((origin, direction): (DVec3, DVec3), hit: &Hit, normal: DVec3) -> DVec3 {
    origin + direction * hit.t + normal * 4e-3
}

/// A camera, precomputed for ray generation.
struct View {
    camera: Camera,
    world_from_view: glam::DMat3,
    centre: DVec3,
    width: u32,
    height: u32,
}

impl View {
    fn new(camera: &Camera) -> View {
        View {
            camera: *camera,
            world_from_view: camera.view_from_world.rotation_matrix().transpose(),
            centre: camera.centre(),
            width: camera.intrinsics.width,
            height: camera.intrinsics.height,
        }
    }

    /// A ray direction whose z in the camera frame is 1, so that distances along it are depths.
    fn ray(&self, pixel: DVec2) -> DVec3 {
        self.world_from_view * self.camera.intrinsics.ray(pixel)
    }
}

/// Diffuse light at a vertex without movers' shadows: a lamp and the ambient light from above, scaled by
/// the ambient occlusion `open`.
fn baked(normal: DVec3, open: f64) -> Light {
    let direct = normal.dot(LAMP.normalize()).max(0.0);
    let ambient = 0.5 - 0.5 * normal.y;
    let all = (0.5 + 0.42 * direct + 0.3 * ambient) * (0.4 + 0.6 * open);
    Light { steady: all as f32, lamp: 0.0 }
}

/// The same light with a stronger lamp, which movers may block.
fn light(normal: DVec3, open: f64) -> Light {
    let direct = normal.dot(LAMP.normalize()).max(0.0);
    let ambient = 0.5 - 0.5 * normal.y;
    let open = 0.4 + 0.6 * open;
    Light { steady: ((0.34 + 0.25 * ambient) * open) as f32, lamp: (0.68 * direct * open) as f32 }
}

/// Cosine-weighted share of the hemisphere that is unoccluded within `OPENNESS_REACH`.
fn openness(position: DVec3, normal: DVec3, bvh: &Bvh) -> f64 {
    let (a, b) = normal.any_orthonormal_pair();
    let origin = position + normal * 1e-3;
    let clear = (0..OPENNESS_RAYS).filter(|&i| {
        // A golden-angle spiral over the disc, projected to the hemisphere.
        let radius = ((i as f64 + 0.5) / OPENNESS_RAYS as f64).sqrt();
        let angle = i as f64 * TAU * 0.618_033_988_749_895;
        let (sin, cos) = angle.sin_cos();
        let up = normal * (1.0 - radius * radius).sqrt();
        let direction = (a * cos + b * sin) * radius + up;
        !bvh.blocked(origin, direction, OPENNESS_REACH)
    });
    clear.count() as f64 / OPENNESS_RAYS as f64
}
