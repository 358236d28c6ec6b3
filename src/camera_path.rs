//! Camera paths around a scene: views that the input did not have.

use glam::{DVec3, Vec3};

use crate::geometry::look_at;
use crate::scene::{Scene, SceneCamera};
use crate::types::{Camera, Intrinsics, Pose};

/// Default image size for a scene without cameras.
const DEFAULT_SIZE: (u32, u32) = (960, 540);
/// Amplitudes of the orbit around an input camera, sideways and upward, in units of the distance to the
/// point that it looks at. With larger ones, the camera sees areas that the input never showed.
const SWAY: [f64; 2] = [0.1, 0.05];
/// Amplitude of a spiral's motion along the line of sight, in the same unit.
const SPIRAL_REACH: f64 = 0.1;
/// Start and end of a dolly along the line of sight, in the same unit.
const DOLLY: [f64; 2] = [-0.1, 0.3];
/// Maximum median step of an input trajectory that is followed, as a share of the distance to the point
/// that it looks at. With larger steps, the cameras are separate photographs, and one of them is used.
const FOLLOWED_STEP: f64 = 0.15;
/// Elevation of the orbit around a scene without cameras, radians.
const ELEVATION: f64 = 0.25;

/// Shape of a camera path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathShape {
    /// One turn along a small ellipse.
    Orbit,
    /// Two turns of increasing width, while the camera moves forward and back.
    Spiral,
    /// Forward along the line of sight.
    Dolly,
    /// The ellipse of an orbit at a fixed time.
    Bullet,
}

impl PathShape {
    /// The shape of a name: `orbit`, `spiral`, `dolly` or `bullet`.
    pub fn named(name: &str) -> Option<PathShape> {
        match name {
            "orbit" => Some(PathShape::Orbit),
            "spiral" => Some(PathShape::Spiral),
            "dolly" => Some(PathShape::Dolly),
            "bullet" => Some(PathShape::Bullet),
            _ => None,
        }
    }
}

/// Default time of a bullet-time path.
const BULLET_TIME: f64 = 0.5;

/// A path through novel views, with times from 0 to 1, or one fixed time for a [`PathShape::Bullet`].
///
/// If the input is a continuous shot, the camera follows it and moves around it, always looking at the
/// point that the input looks at. If it is a set of photographs, the camera moves around the one nearest to
/// their mean position. A scene without cameras is circled once; a dolly approaches it from one side.
/// Intrinsics are the input's, or 960 × 540 pixels in a scene without cameras.
///
/// ```no_run
/// # fn main() -> splat4d::Result<()> {
/// use splat4d::camera_path::{CameraPath, PathShape};
/// use splat4d::{gpu::Device, renderer::Renderer, scene::Scene};
///
/// let scene = Scene::open("scene.safetensors", false)?.scene;
/// let mut renderer = Renderer::new(&Device::open(&Default::default())?, &scene)?;
/// let path = CameraPath::new(&scene, PathShape::Orbit, 60);
/// for i in 0..path.len() {
///     let view = path.at(i);
///     let image = renderer.render(&view.camera, view.time)?.over(scene.background);
/// }
/// # Ok(())
/// # }
/// ```
pub struct CameraPath<'a> {
    shape: PathShape,
    frames: usize,
    around: Around<'a>,
}

/// Reference of a path.
enum Around<'a> {
    /// The input's camera at each time, with the distance to the point that it looks at.
    Shot(&'a Scene, f64),
    /// One camera of the input, with the same distance.
    Reference(Camera, f64),
    /// The whole extent of a scene without cameras.
    Whole(Circle),
}

impl CameraPath<'_> {
    /// A path of the given shape with a number of views.
    pub fn new(scene: &Scene, shape: PathShape, frames: usize) -> CameraPath<'_> {
        let around = match middle_camera(scene) {
            None => Around::Whole(Circle::around(scene)),
            Some(middle) => {
                let distance = typical_depth(scene, &middle);
                match is_shot(scene, distance) {
                    true => Around::Shot(scene, distance),
                    false => Around::Reference(middle, distance),
                }
            }
        };
        CameraPath { shape, frames, around }
    }

    /// Number of views.
    pub fn len(&self) -> usize {
        self.frames
    }

    /// Whether there are no views.
    pub fn is_empty(&self) -> bool {
        self.frames == 0
    }

    /// Whether time is fixed while the camera moves.
    pub fn has_fixed_time(&self) -> bool {
        self.shape == PathShape::Bullet
    }

    /// The view at `index`, below [`len`](Self::len), at its own time.
    pub fn at(&self, index: usize) -> SceneCamera {
        let way = index as f64 / self.frames.max(2).saturating_sub(1) as f64;
        self.at_time(index, if self.has_fixed_time() { BULLET_TIME } else { way })
    }

    /// The view at `index` relative to the input's camera at a given time in [0, 1].
    pub fn at_time(&self, index: usize, time: f64) -> SceneCamera {
        let way = index as f64 / self.frames.max(2).saturating_sub(1) as f64;
        let (base, distance) = match &self.around {
            Around::Shot(scene, distance) => (between(scene, time), distance),
            Around::Reference(camera, distance) => (*camera, distance),
            Around::Whole(circle) => {
                // A full circle ends one step before its beginning.
                let turn = index as f64 / self.frames.max(1) as f64 * std::f64::consts::TAU;
                let camera = match self.shape {
                    PathShape::Orbit | PathShape::Bullet => circle.at(turn, 1.0),
                    PathShape::Spiral => circle.at(2.0 * turn, 1.0 - 0.3 * way),
                    PathShape::Dolly => circle.at(0.0, 1.0 - 0.5 * way),
                };
                return SceneCamera { time, camera };
            }
        };
        let turn = way * std::f64::consts::TAU;
        let aside = match self.shape {
            PathShape::Orbit | PathShape::Bullet => {
                DVec3::new(SWAY[0] * turn.cos(), SWAY[1] * turn.sin(), 0.0)
            }
            PathShape::Spiral => {
                let (sin, cos) = (2.0 * turn).sin_cos();
                DVec3::new(SWAY[0] * way * cos, SWAY[1] * way * sin, SPIRAL_REACH * turn.sin())
            }
            PathShape::Dolly => DVec3::Z * (DOLLY[0] + way * (DOLLY[1] - DOLLY[0])),
        };
        let world_from_view = base.view_from_world.inverse();
        let target = world_from_view.apply(DVec3::Z * *distance);
        let up = world_from_view.rotation * DVec3::NEG_Y;
        let centre = world_from_view.apply(aside * *distance);
        SceneCamera {
            time,
            camera: Camera { view_from_world: look_at(centre, target, up), ..base },
        }
    }
}

/// Initial camera of a viewer, and its distance to the point that it looks at, world units: the input's first
/// camera, or one that sees the whole of a scene without cameras.
pub fn initial_view(scene: &Scene) -> (Camera, f64) {
    match scene.cameras.first() {
        Some(first) => (first.camera, typical_depth(scene, &first.camera)),
        None => {
            let circle = Circle::around(scene);
            (circle.at(0.0, 1.0), circle.distance)
        }
    }
}

/// The input camera nearest to the mean of their centres.
fn middle_camera(scene: &Scene) -> Option<Camera> {
    let centres = scene.cameras.iter().map(|c| c.camera.centre());
    let mean = centres.sum::<DVec3>() / scene.cameras.len() as f64;
    let distance = |camera: &Camera| camera.centre().distance_squared(mean);
    let cameras = scene.cameras.iter().map(|c| c.camera);
    cameras.min_by(|a, b| distance(a).total_cmp(&distance(b)))
}

/// Median depth of the opaque static Gaussians that a camera sees; 1 where it sees none. The canonical
/// positions of dynamic ones are arbitrary.
fn typical_depth(scene: &Scene, camera: &Camera) -> f64 {
    let k = &camera.intrinsics;
    let g = &scene.gaussians;
    let near = f64::from(scene.settings.near);
    let mut depths: Vec<f64> = (0..g.len())
        .filter(|&i| g.opacity_logits[i] > 0.0 && !g.moves(i))
        .map(|i| camera.view_from_world.apply(Vec3::from_array(g.positions[i]).as_dvec3()))
        .filter(|p| {
            let pixel = k.project(*p);
            let inside = |v: f64, side: u32| (0.0..f64::from(side)).contains(&v);
            p.z > near && inside(pixel.x, k.width) && inside(pixel.y, k.height)
        })
        .map(|p| p.z)
        .collect();
    median(&mut depths).unwrap_or(1.0)
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Whether the cameras, in the order of their times, form one continuous motion.
fn is_shot(scene: &Scene, distance: f64) -> bool {
    let centres = scene.cameras.iter().map(|c| c.camera.centre()).collect::<Vec<_>>();
    let mut steps: Vec<f64> = centres.windows(2).map(|c| c[0].distance(c[1])).collect();
    median(&mut steps).is_none_or(|step| step < FOLLOWED_STEP * distance)
}

/// The input's camera at a time, interpolated between its frames.
fn between(scene: &Scene, time: f64) -> Camera {
    let cameras = &scene.cameras;
    let after = cameras.partition_point(|c| c.time < time).clamp(1, cameras.len().max(2) - 1);
    let first = &cameras[after - 1];
    let second = cameras.get(after).unwrap_or(first);
    let span = second.time - first.time;
    let share = if span > 0.0 { ((time - first.time) / span).clamp(0.0, 1.0) } else { 0.0 };
    let [a, b] = [first, second].map(|c| c.camera.view_from_world.inverse());
    let world_from_view =
        Pose::new(a.rotation.slerp(b.rotation, share), a.translation.lerp(b.translation, share));
    Camera { view_from_world: world_from_view.inverse(), ..first.camera }
}

/// A circle around a scene without cameras.
struct Circle {
    target: DVec3,
    /// Distance of the cameras from the target.
    distance: f64,
    /// Focal length of the cameras, pixels.
    focal: f64,
    up: DVec3,
}

impl Circle {
    fn around(scene: &Scene) -> Circle {
        let g = &scene.gaussians;
        let solid = |i: &usize| g.opacity_logits[*i] > 0.0 && !g.moves(*i);
        let mut chosen: Vec<usize> = (0..g.len()).filter(solid).collect();
        if chosen.is_empty() {
            chosen = (0..g.len()).collect();
        }
        // Without the outermost twentieth on every side, because floaters would push the camera away.
        let (mut low, mut high) = (DVec3::ZERO, DVec3::ZERO);
        for axis in 0..3 {
            let mut values: Vec<f64> =
                chosen.iter().map(|&i| f64::from(g.positions[i][axis])).collect();
            values.sort_by(f64::total_cmp);
            if let Some(last) = values.len().checked_sub(1) {
                (low[axis], high[axis]) = (values[last / 20], values[last - last / 20]);
            }
        }
        let target = 0.5 * (low + high);
        let near = f64::from(scene.settings.near);
        // If the centres have no extent, as for a single Gaussian, its own size is used.
        let mut sizes: Vec<f64> = chosen.iter().map(|&i| deviation(g.log_scales[i])).collect();
        let spread = 0.5 * (high - low).length();
        let radius = spread.max(3.0 * median(&mut sizes).unwrap_or(0.0)).max(1e-6);
        let (width, height) = DEFAULT_SIZE;
        let mut half_view = (f64::from(height) / 2.0 / (f64::from(width) * 0.8)).atan();
        let mut distance = radius / half_view.sin();
        // Content nearer than `near` is not drawn, so a tiny scene is viewed from farther away with a
        // longer focal length.
        if distance - radius < 2.0 * near {
            distance = radius + 2.0 * near;
            half_view = (radius / distance).asin();
        }
        let focal = f64::from(height) / 2.0 / half_view.tan();
        let up = Vec3::from_array(scene.up).as_dvec3().try_normalize().unwrap_or(DVec3::NEG_Y);
        Circle { target, distance, focal, up }
    }

    /// The camera at an angle, at a share of the distance from which all is visible.
    fn at(&self, angle: f64, share: f64) -> Camera {
        let Circle { target, distance, focal, up } = *self;
        let (width, height) = DEFAULT_SIZE;
        let side = up.any_orthonormal_vector();
        let (sin, cos) = angle.sin_cos();
        let outward = (side * cos + up.cross(side) * sin) * ELEVATION.cos() + up * ELEVATION.sin();
        let centre = target + outward * distance * share;
        Camera {
            intrinsics: Intrinsics::centred(focal, width, height),
            view_from_world: look_at(centre, target, up),
        }
    }
}

/// The largest standard deviation of a Gaussian.
fn deviation(log_scales: [f32; 3]) -> f64 {
    f64::from(log_scales.into_iter().fold(f32::NEG_INFINITY, f32::max)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Gaussians;

    fn wall(depth: f32) -> Scene {
        let positions: Vec<[f32; 3]> = (0..121)
            .map(|i| [(i % 11) as f32 * 0.2 - 1.0, (i / 11) as f32 * 0.2 - 1.0, depth])
            .collect();
        let n = positions.len();
        Scene::of(Gaussians {
            positions,
            log_scales: vec![[-3.0; 3]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![2.0; n],
            sh_degree: 0,
            sh: vec![[0.0; 3]; n],
            motion_logits: Vec::new(),
        })
    }

    fn with_cameras(mut scene: Scene, centres: &[DVec3]) -> Scene {
        let last = (centres.len() - 1).max(1) as f64;
        scene.cameras = centres
            .iter()
            .enumerate()
            .map(|(i, centre)| SceneCamera {
                time: i as f64 / last,
                camera: Camera {
                    intrinsics: Intrinsics::centred(80.0, 100, 60),
                    view_from_world: Pose::new(glam::DQuat::IDENTITY, -*centre),
                },
            })
            .collect();
        scene
    }

    fn orbit(scene: &Scene, frames: usize) -> Vec<SceneCamera> {
        let orbit = CameraPath::new(scene, PathShape::Orbit, frames);
        (0..orbit.len()).map(|i| orbit.at(i)).collect()
    }

    #[test]
    fn an_orbit_follows_a_shot_and_looks_at_the_wall() {
        let centres: Vec<DVec3> = (0..9).map(|i| DVec3::X * (0.1 * f64::from(i) - 0.4)).collect();
        let path = orbit(&with_cameras(wall(4.0), &centres), 17);
        assert_eq!(path.len(), 17);
        assert_eq!((path[0].time, path[16].time), (0.0, 1.0));
        for (i, shot) in path.iter().enumerate() {
            let base = DVec3::X * (0.05 * i as f64 - 0.4);
            let away = shot.camera.centre().distance(base);
            assert!((0.19..0.41).contains(&away), "{i}: {away}");
            let target = shot.camera.view_from_world.apply(base + DVec3::Z * 4.0);
            assert!(target.truncate().length() < 1e-9, "{i}: {target}");
        }
    }

    #[test]
    fn shapes_differ_in_where_they_lead() {
        let centres: Vec<DVec3> = (0..9).map(|i| DVec3::X * (0.1 * f64::from(i) - 0.4)).collect();
        let scene = with_cameras(wall(4.0), &centres);
        let base = |time: f64| DVec3::X * (0.8 * time - 0.4);
        let way = |shape| {
            let orbit = CameraPath::new(&scene, shape, 9);
            let shots: Vec<SceneCamera> = (0..orbit.len()).map(|i| orbit.at(i)).collect();
            for shot in &shots {
                let target = shot.camera.view_from_world.apply(base(shot.time) + DVec3::Z * 4.0);
                assert!(target.truncate().length() < 1e-9, "{shape:?}: {target}");
            }
            let aside = |shot: &SceneCamera| shot.camera.centre() - base(shot.time);
            (shots.iter().map(aside).collect::<Vec<_>>(), shots)
        };
        let (dolly, _) = way(PathShape::Dolly);
        assert!(dolly.windows(2).all(|w| w[1].z > w[0].z && w[1].truncate().length() < 1e-9));
        assert!((dolly[0].z + 0.4).abs() < 1e-9 && (dolly[8].z - 1.2).abs() < 1e-9, "{dolly:?}");
        let (spiral, _) = way(PathShape::Spiral);
        assert!(spiral[0].length() < 1e-9 && (spiral[8].x - 0.4).abs() < 1e-9, "{spiral:?}");
        assert!(spiral[2].z > 0.3 && spiral[6].z < -0.3, "it nears and draws back: {spiral:?}");
        let (_, bullet) = way(PathShape::Bullet);
        assert!(bullet.iter().all(|shot| shot.time == 0.5));
        assert!(bullet[0].camera.centre().distance(bullet[4].camera.centre()) > 0.7);
        let early = CameraPath::new(&scene, PathShape::Bullet, 9).at_time(4, 0.0);
        assert!(early.time == 0.0 && early.camera.centre().x < -0.7, "{:?}", early.camera);
        // Also for a scene without cameras.
        for shape in [PathShape::Spiral, PathShape::Dolly, PathShape::Bullet] {
            let whole = wall(4.0);
            let orbit = CameraPath::new(&whole, shape, 5);
            let away = |i: usize| orbit.at(i).camera.centre().distance(DVec3::Z * 4.0);
            let nearer = shape != PathShape::Bullet;
            assert_eq!(away(4) < 0.9 * away(0), nearer, "{shape:?}");
            assert_eq!(orbit.has_fixed_time(), orbit.at(0).time == orbit.at(4).time);
        }
    }

    #[test]
    fn photographs_from_all_around_are_not_followed() {
        let centres = [4.0, -4.0, 0.1, 5.0, -5.0].map(|x| DVec3::X * x);
        let path = orbit(&with_cameras(wall(4.0), &centres), 8);
        assert!(path.iter().all(|shot| shot.camera.centre().distance(centres[2]) < 0.5));
    }

    #[test]
    fn a_scene_without_cameras_is_circled_and_seen_whole() {
        for scene in [wall(4.0), wall(-3.0)] {
            for shot in orbit(&scene, 12) {
                let k = shot.camera.intrinsics;
                for p in &scene.gaussians.positions {
                    let seen = shot.camera.view_from_world.apply(Vec3::from_array(*p).as_dvec3());
                    let pixel = k.project(seen);
                    assert!(seen.z > 0.0 && pixel.x > 0.0 && pixel.x < f64::from(k.width));
                    assert!(pixel.y > 0.0 && pixel.y < f64::from(k.height));
                }
            }
        }
        // One Gaussian of any size, and scenes nearer than the renderer's near plane.
        for (log_scale, depth) in [(-3.0, 4.0), (-12.0, 0.0), (5.0, 1e6), (-40.0, 1.0)] {
            let mut scene = wall(depth);
            let g = &mut scene.gaussians;
            g.positions.fill([0.5, 0.5, depth]);
            g.log_scales.fill([log_scale; 3]);
            for shot in orbit(&scene, 5) {
                shot.camera.check().unwrap();
                let centre = glam::DVec3::new(0.5, 0.5, f64::from(depth));
                let seen = shot.camera.view_from_world.apply(centre);
                let k = shot.camera.intrinsics;
                let sigma = k.fy * f64::from(log_scale).exp() / seen.z;
                assert!(seen.z > 0.01 && (k.project(seen).x - k.cx).abs() < 1.0, "{seen}");
                assert!(log_scale < -13.0 || (20.0..200.0).contains(&sigma), "{sigma}");
            }
        }
        let (first, distance) = initial_view(&wall(4.0));
        assert_eq!(first, orbit(&wall(4.0), 12)[0].camera);
        assert!((first.centre().distance(DVec3::Z * 4.0) - distance).abs() < 1e-9);
        let empty = orbit(&Scene::of(Gaussians::default()), 3);
        assert!(empty.iter().all(|shot| shot.camera.centre().is_finite()));
    }

    #[test]
    fn one_camera_is_enough() {
        let path = orbit(&with_cameras(wall(2.0), &[DVec3::ZERO]), 5);
        assert!(path.iter().all(|shot| shot.camera.centre().length() < 0.3));
        assert_eq!(orbit(&wall(2.0), 1).len(), 1);
        let known = with_cameras(wall(2.0), &[DVec3::ZERO]);
        assert_eq!(initial_view(&known), (known.cameras[0].camera, 2.0));
    }
}
