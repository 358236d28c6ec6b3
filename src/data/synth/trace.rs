//! Rays against triangles: a bounding-volume hierarchy in f64, since the truth is read from it.

use glam::DVec3;

/// At most this many triangles in a leaf.
const LEAF: usize = 4;
/// Edges reach this far (in barycentric units) past their triangle, so that no ray slips through
/// the seam between two.
const SEAM: f64 = 1e-9;

/// Where a ray meets a triangle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// In lengths of the ray's direction; with a direction of unit z in the camera, the depth.
    pub t: f64,
    /// Index of the triangle.
    pub triangle: u32,
    /// Weights of the triangle's second and third corner.
    pub weights: [f64; 2],
}

/// One triangle, as the intersection wants it.
#[derive(Clone, Copy, Debug)]
struct Facet {
    corner: DVec3,
    edges: [DVec3; 2],
    triangle: u32,
}

impl Facet {
    /// The ray's meeting with the triangle's plane: t and weights, whether or not inside.
    fn plane(&self, origin: DVec3, direction: DVec3) -> Option<(f64, f64, f64)> {
        // Möller and Trumbore 1997.
        let p = direction.cross(self.edges[1]);
        let determinant = self.edges[0].dot(p);
        if determinant == 0.0 {
            return None;
        }
        let from_corner = origin - self.corner;
        let q = from_corner.cross(self.edges[0]);
        let inverse = 1.0 / determinant;
        let b = from_corner.dot(p) * inverse;
        let c = direction.dot(q) * inverse;
        Some((self.edges[1].dot(q) * inverse, b, c))
    }

    fn hit(&self, origin: DVec3, direction: DVec3, nearer_than: f64) -> Option<Hit> {
        let (t, b, c) = self.plane(origin, direction)?;
        let inside = b >= -SEAM && c >= -SEAM && b + c <= 1.0 + SEAM;
        (inside && t > 1e-9 && t < nearer_than).then_some(Hit {
            t,
            triangle: self.triangle,
            weights: [b, c],
        })
    }
}

/// A box of the hierarchy. A leaf has `count` facets from `first`; an inner node has `count` = 0,
/// its children at its own index + 1 and at `first`.
#[derive(Clone, Copy, Debug)]
struct Node {
    lower: DVec3,
    upper: DVec3,
    first: u32,
    count: u32,
}

/// The hierarchy over the triangles of one moment.
#[derive(Debug)]
pub(super) struct Bvh {
    nodes: Vec<Node>,
    facets: Vec<Facet>,
    /// Where each triangle's facet lies.
    facet_of: Vec<u32>,
}

impl Bvh {
    /// Builds over all triangles; splits at the median of the longest axis.
    pub fn build(positions: &[DVec3], triangles: &[[u32; 3]]) -> Bvh {
        let mut facets: Vec<Facet> = (0u32..)
            .zip(triangles)
            .map(|(triangle, corners)| {
                let [a, b, c] = corners.map(|v| positions[v as usize]);
                Facet { corner: a, edges: [b - a, c - a], triangle }
            })
            .collect();
        let mut nodes = Vec::new();
        let count = facets.len();
        split(&mut nodes, &mut facets, 0, count);
        let mut facet_of = vec![0; count];
        for (place, facet) in facets.iter().enumerate() {
            facet_of[facet.triangle as usize] = place as u32;
        }
        Bvh { nodes, facets, facet_of }
    }

    /// The nearest triangle along a ray. `guess`, a triangle likely to be met, only saves time.
    pub fn nearest(&self, origin: DVec3, direction: DVec3, guess: Option<u32>) -> Option<Hit> {
        let facet = |triangle: u32| &self.facets[self.facet_of[triangle as usize] as usize];
        let mut best = guess.and_then(|g| facet(g).hit(origin, direction, f64::INFINITY));
        // A zero would make 0 · ∞ of a box face through the origin.
        let inverse =
            DVec3::from_array(direction.to_array().map(|d| if d == 0.0 { 1e300 } else { 1.0 / d }));
        let mut stack = [0u32; 64];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let index = stack[depth];
            let node = &self.nodes[index as usize];
            let limit = best.map_or(f64::INFINITY, |hit| hit.t);
            let (a, b) = ((node.lower - origin) * inverse, (node.upper - origin) * inverse);
            let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
            if enter > leave * (1.0 + 1e-12) || leave < 0.0 || enter > limit {
                continue;
            }
            if node.count > 0 {
                let range = node.first as usize..(node.first + node.count) as usize;
                for facet in &self.facets[range] {
                    let limit = best.map_or(f64::INFINITY, |hit| hit.t);
                    best = facet.hit(origin, direction, limit).or(best);
                }
            } else {
                // The child whose box begins nearer comes off the stack first.
                let children = [index + 1, node.first];
                let middle = children.map(|child| {
                    let node = &self.nodes[child as usize];
                    (node.lower + node.upper).dot(direction)
                });
                let near = usize::from(middle[1] < middle[0]);
                stack[depth] = children[1 - near];
                stack[depth + 1] = children[near];
                depth += 2;
            }
        }
        best
    }

    /// Where a ray meets the plane of a triangle, inside it or not.
    pub fn on_plane(&self, triangle: u32, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let facet = &self.facets[self.facet_of[triangle as usize] as usize];
        let (t, b, c) = facet.plane(origin, direction)?;
        Some(Hit { t, triangle, weights: [b, c] })
    }
}

/// Adds the node over `facets[start..end]` and all below it; halving bounds the depth by log2.
fn split(nodes: &mut Vec<Node>, facets: &mut [Facet], start: usize, end: usize) {
    let middle_of = |f: &Facet| f.corner + (f.edges[0] + f.edges[1]) / 3.0;
    let (mut lower, mut upper) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for facet in &facets[start..end] {
        for corner in [facet.corner, facet.corner + facet.edges[0], facet.corner + facet.edges[1]] {
            lower = lower.min(corner);
            upper = upper.max(corner);
        }
        low = low.min(middle_of(facet));
        high = high.max(middle_of(facet));
    }
    // Room for rounding: walls are flat boxes, and a ray meets them on the very face.
    let margin = DVec3::splat(1e-9);
    let node = nodes.len();
    let count = end - start;
    nodes.push(Node {
        lower: lower - margin,
        upper: upper + margin,
        first: start as u32,
        count: if count <= LEAF { count as u32 } else { 0 },
    });
    if count <= LEAF {
        return;
    }
    let axis = (high - low).max_position();
    let half = start + count / 2;
    facets[start..end].select_nth_unstable_by(count / 2, |a, b| {
        middle_of(a)[axis].total_cmp(&middle_of(b)[axis]).then(a.triangle.cmp(&b.triangle))
    });
    split(nodes, facets, start, half);
    nodes[node].first = nodes.len() as u32;
    split(nodes, facets, half, end);
}
