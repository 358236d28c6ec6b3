//! Triangle meshes at rest, from which scenes are assembled.

use glam::{DVec3, Vec3};

use crate::types::Pose;

/// A corner of a mesh at rest.
#[derive(Clone, Copy, Debug)]
pub(super) struct Vertex {
    /// Rest position; a motion maps it to its position at a time.
    pub position: DVec3,
    /// Outward unit normal at rest, used for the baked light.
    pub normal: DVec3,
    /// Position in the solid texture: the position in the shape's own frame, so that neither placing nor
    /// moving a shape shifts its texture.
    pub texture: Vec3,
}

/// Triangles over shared vertices.
#[derive(Clone, Debug, Default)]
pub(super) struct Mesh {
    pub vertices: Vec<Vertex>,
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// The parallelogram `origin + a·side_a + b·side_b`, cut into `cells` × `cells` quads; its
    /// normal is `side_a × side_b`.
    pub fn patch(origin: DVec3, side_a: DVec3, side_b: DVec3, cells: [usize; 2]) -> Mesh {
        let normal = side_a.cross(side_b).normalize();
        Mesh::grid(cells, |a, b| {
            let position = origin + side_a * a + side_b * b;
            Vertex { position, normal, texture: position.as_vec3() }
        })
    }

    /// A box centred at the origin with its faces cut into cells of at most `cell`.
    pub fn cuboid(half: DVec3, cell: f64) -> Mesh {
        let mut mesh = Mesh::default();
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let mut across = DVec3::ZERO;
                across[axis] = sign;
                let mut side_a = DVec3::ZERO;
                side_a[(axis + 1) % 3] = 2.0 * half[(axis + 1) % 3] * sign;
                let mut side_b = DVec3::ZERO;
                side_b[(axis + 2) % 3] = 2.0 * half[(axis + 2) % 3];
                let cells = [side_a, side_b].map(|side| (side.length() / cell).ceil() as usize);
                let origin = across * half - (side_a + side_b) * 0.5;
                mesh.append(Mesh::patch(origin, side_a, side_b, cells));
            }
        }
        mesh
    }

    /// An ellipsoid centred at the origin.
    pub fn ellipsoid(radii: DVec3, segments: usize) -> Mesh {
        Mesh::grid([segments, segments / 2], |a, b| {
            let (longitude, colatitude) = (a * std::f64::consts::TAU, b * std::f64::consts::PI);
            let unit = DVec3::new(
                colatitude.sin() * longitude.cos(),
                -colatitude.cos(),
                colatitude.sin() * longitude.sin(),
            );
            let position = unit * radii;
            Vertex { position, normal: (unit / radii).normalize(), texture: position.as_vec3() }
        })
    }

    /// A closed cylinder centred at the origin with its axis along y.
    pub fn cylinder(radius: f64, half_height: f64, segments: usize, rings: usize) -> Mesh {
        let rim = |a: f64| {
            let angle = a * std::f64::consts::TAU;
            DVec3::new(angle.cos(), 0.0, angle.sin())
        };
        let mut mesh = Mesh::grid([segments, rings], |a, b| {
            let position = rim(a) * radius + DVec3::Y * half_height * (2.0 * b - 1.0);
            Vertex { position, normal: rim(a), texture: position.as_vec3() }
        });
        for sign in [-1.0, 1.0] {
            mesh.append(Mesh::grid([segments, 1], |a, b| {
                let position = rim(a) * radius * b + DVec3::Y * half_height * sign;
                Vertex { position, normal: DVec3::Y * sign, texture: position.as_vec3() }
            }));
        }
        mesh
    }

    /// A grid of quads over [0, 1]², each cut into two triangles.
    fn grid(cells: [usize; 2], vertex: impl Fn(f64, f64) -> Vertex) -> Mesh {
        let [columns, rows] = cells.map(|n| n.max(1));
        let mut mesh = Mesh::default();
        for row in 0..=rows {
            for column in 0..=columns {
                let (a, b) = (column as f64 / columns as f64, row as f64 / rows as f64);
                mesh.vertices.push(vertex(a, b));
            }
        }
        for row in 0..rows {
            for column in 0..columns {
                let corner = (row * (columns + 1) + column) as u32;
                let below = corner + columns as u32 + 1;
                mesh.triangles.push([corner, corner + 1, below]);
                mesh.triangles.push([corner + 1, below + 1, below]);
            }
        }
        mesh
    }

    /// The triangles, with their corners anticlockwise seen from outside.
    pub fn triangles_outwards(&self) -> impl Iterator<Item = [u32; 3]> + Clone + '_ {
        self.triangles.iter().map(|&[a, b, c]| {
            let [at_a, at_b, at_c] = [a, b, c].map(|v| self.vertices[v as usize].position);
            let outward: DVec3 = [a, b, c].iter().map(|v| self.vertices[*v as usize].normal).sum();
            let out = (at_b - at_a).cross(at_c - at_a).dot(outward) >= 0.0;
            if out { [a, b, c] } else { [a, c, b] }
        })
    }

    /// The mesh with its orientation reversed.
    pub fn flipped(mut self) -> Mesh {
        for vertex in &mut self.vertices {
            vertex.normal = -vertex.normal;
        }
        self
    }

    /// Adds another mesh's triangles to this one's.
    pub fn append(&mut self, other: Mesh) {
        let offset = self.vertices.len() as u32;
        self.vertices.extend(other.vertices);
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + offset)));
    }

    /// The mesh transformed into another frame, with its texture unchanged.
    pub fn placed(mut self, to: Pose) -> Mesh {
        for vertex in &mut self.vertices {
            vertex.position = to.apply(vertex.position);
            vertex.normal = to.rotation * vertex.normal;
        }
        self
    }

    /// The mesh translated, with its texture unchanged.
    pub fn at(self, position: DVec3) -> Mesh {
        self.placed(Pose::new(glam::DQuat::IDENTITY, position))
    }
}
