//! Content of a clip: a furnished room, the camera path through it, and the movers.
//!
//! The world has the axes of the camera (x right, y down, z into the room), so that the floor is at
//! positive y. Lengths are approximately metres.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3, Vec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::mesh::Mesh;
use super::street::{self, Drive};
use super::texture::{Material, Pattern};
use super::{held, movers, person, thrown};
use crate::types::Pose;

/// Height of the floor.
pub(super) const FLOOR: f64 = 1.0;
const CEILING: f64 = -1.7;
const BACK: f64 = 6.4;
const FRONT: f64 = -1.6;
/// Half the room's width.
const SIDE: f64 = 2.9;
/// Cell size of walls and furniture; light is baked at their vertices.
const CELL: f64 = 0.28;

/// Amplitude of the hand motion of a standing person, relative to a walking one.
const STANDING: f64 = 0.12;

/// Number of the first parts of the room: floor, ceiling, walls and carpet.
const FLOOR_AND_WALLS: usize = 7;
/// Texture contrast of these parts where they are plain.
const PLAIN: f32 = 0.12;

/// Maps a rest position to its position at a time in [0, 1].
pub(super) type Motion = Arc<dyn Fn(DVec3, f64) -> DVec3 + Send + Sync>;

/// A mesh of one material with a single motion.
pub(super) struct Part {
    pub mesh: Mesh,
    pub material: Material,
    /// `None` for a static part.
    pub motion: Option<Motion>,
}

/// The contents of a clip before rendering.
pub(super) struct Scene {
    pub parts: Vec<Part>,
    pub path: CameraPath,
    /// Focal length over the image's width.
    pub focal: f64,
    /// Whether movers are lit at their current positions and cast shadows; else light is baked at rest.
    pub lit: bool,
}

impl Scene {
    /// The scene of a clip; `None` for an unknown name. Each part of a scene has a separate random stream
    /// of the seed, so that one seed gives the same room in every clip.
    pub fn new(name: &str, seed: u64) -> Option<Scene> {
        let stream = |n| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(n);
            rng
        };
        let mut camera = stream(1);
        let mut movers = stream(2);
        let mut path = CameraPath::random(&mut camera);
        let focal = camera.random_range(0.84..0.92);
        let moving = match name {
            "still" => Vec::new(),
            "rigid" => movers::cart(&mut movers),
            "tripod" => {
                path.stop();
                movers::cart(&mut movers)
            }
            "bend" => movers::bending(&mut movers),
            "crowd" => movers::crowd(&mut movers),
            "throw" => thrown::ball_and_box(&mut movers),
            "hold" => held::jug(&mut movers),
            "walk" => person::walking(&mut movers),
            "pan" | "follow" => {
                let (car, drive) = street::car(&mut movers);
                path.follow(drive);
                if name == "pan" {
                    path.stop();
                }
                car
            }
            _ => return None,
        };
        let mut surroundings = stream(0);
        let mut parts = match name {
            "pan" | "follow" => street::street(&mut surroundings),
            _ => room(&mut surroundings),
        };
        if name == "throw" {
            parts.iter_mut().take(FLOOR_AND_WALLS).for_each(|part| {
                part.material = part.material.clone().of_contrast(PLAIN);
            });
        }
        parts.extend(moving);
        let lit = matches!(name, "throw" | "hold" | "walk" | "pan" | "follow");
        Some(Scene { parts, path, focal, lit })
    }
}

/// A smooth sideways arc that looks at one target, at rest or driving, with a slow dolly, rise and roll.
#[derive(Clone, Copy, Debug)]
pub(super) struct CameraPath {
    sweep: f64,
    dolly: f64,
    rise: f64,
    roll: f64,
    phase: f64,
    target: DVec3,
    /// Displacement of the target from the middle of the clip to its end.
    target_half_way: DVec3,
}

impl CameraPath {
    fn random(rng: &mut ChaCha8Rng) -> CameraPath {
        let mut side = || if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let (left_or_right, in_or_out, up_or_down) = (side(), side(), side());
        CameraPath {
            sweep: left_or_right * rng.random_range(0.55..0.7),
            dolly: in_or_out * rng.random_range(0.12..0.25),
            rise: up_or_down * rng.random_range(0.08..0.14),
            roll: rng.random_range(-0.02..0.02),
            phase: rng.random_range(0.0..TAU),
            target: DVec3::new(rng.random_range(-0.1..0.1), rng.random_range(0.15..0.25), 4.2),
            target_half_way: DVec3::ZERO,
        }
    }

    /// Fixes the camera in the middle of its path.
    fn stop(&mut self) {
        (self.sweep, self.dolly, self.rise, self.roll) = (0.0, 0.0, 0.0, 0.0);
    }

    /// Aims the camera at a passing car, hand-held by a standing person.
    fn follow(&mut self, drive: Drive) {
        (self.target, self.target_half_way) = (drive.middle, drive.half_way);
        self.sweep *= STANDING;
        self.dolly *= STANDING;
        self.rise *= STANDING;
    }

    /// The camera at a time in [0, 1], displaced by `offset` metres; it still looks at the target.
    pub fn view_from_world(&self, time: f64, offset: DVec3) -> Pose {
        // Hand-held motion is never quite even and never at rest; a hundredth of the speed gives no parallax.
        let along = time - 0.5 + 0.04 * (TAU * time + self.phase).sin();
        let centre = offset
            + DVec3::new(
                self.sweep * along,
                -0.1 + self.rise * (PI * time + self.phase).sin(),
                self.dolly * along - 0.15 * (2.0 * along).powi(2) * self.sweep.abs(),
            );
        // A panning person runs ahead of the target and falls behind it.
        let lead = 0.05 * (TAU * 0.8 * time + self.phase).sin();
        let target = self.target + self.target_half_way * (2.0 * time - 1.0 + lead);
        let forward = (target - centre).normalize();
        let right = DVec3::Y.cross(forward).normalize();
        let upright = DMat3::from_cols(right, forward.cross(right), forward);
        let roll = DQuat::from_rotation_z(self.roll * (TAU * 0.7 * time + self.phase).sin());
        let world_from_view = Pose::new(DQuat::from_mat3(&upright) * roll, centre);
        world_from_view.inverse()
    }
}

/// Assembles parts that share a frame.
pub(super) struct Assembly<'a> {
    pub rng: &'a mut ChaCha8Rng,
    pub world_from_shape: Pose,
    pub motion: Option<Motion>,
    pub parts: Vec<Part>,
}

impl<'a> Assembly<'a> {
    pub fn new(rng: &'a mut ChaCha8Rng) -> Assembly<'a> {
        Assembly { rng, world_from_shape: Pose::IDENTITY, motion: None, parts: Vec::new() }
    }

    /// Adds a shape, given in the assembly's frame.
    pub fn add(&mut self, mesh: Mesh, material: Material) {
        let mesh = mesh.placed(self.world_from_shape);
        self.parts.push(Part { mesh, material, motion: self.motion.clone() });
    }

    /// Shapes that are added after this call move with `world_from_shape`.
    pub fn carry(&mut self, world_from_shape: impl Fn(f64) -> Pose + Send + Sync + 'static) {
        self.world_from_shape = world_from_shape(0.5);
        self.motion = Some(movers::rigid(self.world_from_shape, world_from_shape));
    }

    /// Adds a box of a random material between two heights, with `top` the smaller one.
    fn crate_box(
        &mut self,
        centre: [f64; 2],
        half: [f64; 2],
        heights: [f64; 2],
        material: Material,
    ) {
        let [top, bottom] = heights;
        let half = DVec3::new(half[0], 0.5 * (bottom - top), half[1]);
        let centre = DVec3::new(centre[0], 0.5 * (top + bottom), centre[1]);
        self.add(Mesh::cuboid(half, CELL).at(centre), material);
    }

    /// Places the frame on the floor, rotated about the vertical axis; its y is the world's.
    fn stand(&mut self, x: f64, z: f64, turn: f64) {
        let jitter = |rng: &mut ChaCha8Rng| rng.random_range(-0.08..0.08);
        let place = DVec3::new(x + jitter(self.rng), 0.0, z + jitter(self.rng));
        let turn = turn + self.rng.random_range(-0.2..0.2);
        self.world_from_shape = Pose::new(DQuat::from_rotation_y(turn), place);
    }
}

fn room(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let mut a = Assembly::new(rng);
    walls(&mut a);
    shelf(&mut a);
    bench(&mut a);
    table(&mut a);
    crates(&mut a);
    a.parts
}

fn walls(a: &mut Assembly) {
    let cells = |length: f64| (length / (1.6 * CELL)).ceil() as usize;
    let (wide, high, deep) = (2.0 * SIDE, FLOOR - CEILING, BACK - FRONT);
    let wall = |origin: [f64; 3], across: [f64; 3], along: [f64; 3]| {
        let (across, along) = (DVec3::from(across), DVec3::from(along));
        let counts = [cells(across.length()), cells(along.length())];
        Mesh::patch(DVec3::from(origin), across, along, counts)
    };
    let wood = Material::tinted(a.rng, [0.62, 0.45, 0.30], Pattern::Planks(0.37), 0.055);
    a.add(wall([-SIDE, FLOOR, FRONT], [0.0, 0.0, deep], [wide, 0.0, 0.0]).flipped(), wood);
    let plaster = Material::tinted(a.rng, [0.78, 0.76, 0.72], Pattern::Plain, 0.06);
    a.add(wall([-SIDE, CEILING, FRONT], [0.0, 0.0, deep], [wide, 0.0, 0.0]), plaster);
    let paper = Material::tinted(a.rng, [0.66, 0.68, 0.58], Pattern::Blobs(0.34), 0.065);
    a.add(wall([-SIDE, CEILING, BACK], [0.0, high, 0.0], [wide, 0.0, 0.0]), paper);
    let brick = Material::tinted(a.rng, [0.66, 0.48, 0.42], Pattern::Blobs(0.5), 0.06);
    a.add(wall([-SIDE, CEILING, FRONT], [0.0, high, 0.0], [0.0, 0.0, deep]), brick.clone());
    a.add(
        wall([SIDE, CEILING, FRONT], [0.0, high, 0.0], [0.0, 0.0, deep]).flipped(),
        brick.clone(),
    );
    a.add(wall([-SIDE, CEILING, FRONT], [0.0, high, 0.0], [wide, 0.0, 0.0]).flipped(), brick);
    let carpet = Material::random(a.rng, Pattern::Stripes(Vec3::new(1.6, 0.0, 1.1)), 0.05);
    a.stand(0.1, 4.0, 0.0);
    a.crate_box([0.0, 0.0], [1.15, 0.85], [FLOOR - 0.02, FLOOR], carpet);
    a.world_from_shape = Pose::IDENTITY;
    for x in [0.0, 1.35] {
        let picture = Material::random(a.rng, Pattern::Blobs(0.3), 0.05);
        let (x, y) = (x + a.rng.random_range(-0.15..0.15), a.rng.random_range(-0.75..-0.55));
        let half = DVec3::new(a.rng.random_range(0.3..0.5), a.rng.random_range(0.25..0.35), 0.03);
        a.add(Mesh::cuboid(half, CELL).at(DVec3::new(x, y, BACK - 0.03)), picture);
    }
}

/// A bookshelf at the back on the left.
fn shelf(a: &mut Assembly) {
    a.stand(-1.85, BACK - 0.4, 0.0);
    let board = Material::tinted(a.rng, [0.55, 0.36, 0.22], Pattern::Plain, 0.045);
    let (half_wide, half_deep, top) = (0.75, 0.2, -0.95);
    for side in [-1.0, 1.0] {
        a.crate_box([side * half_wide, 0.0], [0.03, half_deep], [top, FLOOR], board.clone());
    }
    a.crate_box([0.0, half_deep], [half_wide, 0.02], [top, FLOOR], board.clone());
    let rows = 4;
    let spacing = (FLOOR - top) / rows as f64;
    for row in 0..=rows {
        let y = top + row as f64 * spacing;
        a.crate_box([0.0, 0.0], [half_wide, half_deep], [y - 0.025, y + 0.025], board.clone());
    }
    for row in 1..=rows {
        let bottom = top + row as f64 * spacing - 0.025;
        let mut left = -half_wide + 0.04;
        loop {
            let width = a.rng.random_range(0.07..0.19);
            if left + width > half_wide - 0.04 {
                break;
            }
            let height = a.rng.random_range(0.24..0.4);
            let back = a.rng.random_range(0.0..0.06);
            let cover = Material::random(a.rng, Pattern::Plain, 0.05);
            a.crate_box(
                [left + width / 2.0, back],
                [width / 2.0, 0.13],
                [bottom - height, bottom],
                cover,
            );
            left += width + if a.rng.random_bool(0.2) { 0.1 } else { 0.005 };
        }
    }
}

/// A bench with a back and cushions against the back wall.
fn bench(a: &mut Assembly) {
    a.stand(0.75, 5.55, 0.0);
    let cloth = Material::random(a.rng, Pattern::Stripes(Vec3::new(2.4, 0.0, 0.0)), 0.05);
    a.crate_box([0.0, 0.0], [0.95, 0.32], [0.55, FLOOR], cloth.clone());
    a.crate_box([0.0, 0.3], [0.95, 0.1], [0.05, FLOOR], cloth.clone());
    for side in [-1.0, 1.0] {
        a.crate_box([side * 0.9, 0.0], [0.1, 0.34], [0.32, FLOOR], cloth.clone());
    }
    for x in [-0.5, 0.35] {
        let cushion = Material::random(a.rng, Pattern::Blobs(0.2), 0.045);
        let tilt =
            DQuat::from_rotation_x(-0.3) * DQuat::from_rotation_z(a.rng.random_range(-0.3..0.3));
        let place = Pose::new(tilt, DVec3::new(x, 0.33, 0.08));
        a.add(Mesh::ellipsoid(DVec3::new(0.25, 0.24, 0.09), 24).placed(place), cushion);
    }
}

/// A table on the right with objects on it.
fn table(a: &mut Assembly) {
    a.stand(1.75, 4.05, 0.3);
    let wood = Material::tinted(a.rng, [0.70, 0.52, 0.34], Pattern::Plain, 0.04);
    a.crate_box([0.0, 0.0], [0.6, 0.4], [0.26, 0.32], wood.clone());
    for (x, z) in [(-0.54, -0.34), (0.54, -0.34), (-0.54, 0.34), (0.54, 0.34)] {
        a.crate_box([x, z], [0.045, 0.045], [0.32, FLOOR], wood.clone());
    }
    let ball = Material::random(a.rng, Pattern::Stripes(Vec3::new(0.8, 3.2, 0.0)), 0.035);
    let radius = a.rng.random_range(0.16..0.2);
    a.add(Mesh::ellipsoid(DVec3::splat(radius), 32).at(DVec3::new(-0.3, 0.26 - radius, 0.0)), ball);
    let parcel = Material::random(a.rng, Pattern::Blobs(0.16), 0.035);
    let height = a.rng.random_range(0.25..0.4);
    a.crate_box([0.15, 0.1], [0.14, 0.12], [0.26 - height, 0.26], parcel);
    let vase = Material::random(a.rng, Pattern::Plain, 0.035);
    a.add(Mesh::cylinder(0.08, 0.16, 24, 3).at(DVec3::new(0.42, 0.1, -0.15)), vase);
}

/// Crates on the left and a post on the right, in the foreground.
fn crates(a: &mut Assembly) {
    a.stand(-1.5, 3.35, 0.5);
    let large = Material::random(a.rng, Pattern::Blobs(0.24), 0.035);
    a.crate_box([0.0, 0.0], [0.34, 0.34], [0.36, FLOOR], large);
    let small = Material::random(a.rng, Pattern::Stripes(Vec3::new(1.5, 2.5, 0.0)), 0.035);
    a.crate_box([0.05, 0.03], [0.2, 0.17], [0.02, 0.36], small);
    a.stand(-1.0, 4.55, 1.0);
    let middle = Material::random(a.rng, Pattern::Blobs(0.3), 0.04);
    a.crate_box([0.0, 0.0], [0.26, 0.26], [0.45, FLOOR], middle);
    a.stand(1.3, 2.75, 0.0);
    let post = Material::random(a.rng, Pattern::Blobs(0.17), 0.03);
    let half = 0.5 * (FLOOR - CEILING);
    a.add(Mesh::cylinder(0.1, half, 24, 12).at(DVec3::Y * (FLOOR - half)), post);
}
