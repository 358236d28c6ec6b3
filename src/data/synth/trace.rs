//! Rays against triangles: a bounding-volume hierarchy in f64, since the truth is read from it.

use glam::DVec3;

/// At most this many triangles in a leaf.
const LEAF: usize = 4;
/// Cuts that are weighed along each axis, plus one.
const BINS: usize = 12;
/// From this depth on nodes are halved, which bounds the depth: fewer than 2³² triangles are at most
/// 32 halvings from a leaf.
const DEEP: usize = 32;
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
    /// Builds over all triangles.
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
        split(&mut nodes, &mut facets, 0, count, 0);
        let mut facet_of = vec![0; count];
        for (place, facet) in facets.iter().enumerate() {
            facet_of[facet.triangle as usize] = place as u32;
        }
        Bvh { nodes, facets, facet_of }
    }

    /// The nearest triangle along a ray. `guess`, a triangle likely to be met, only saves time.
    pub fn nearest(&self, origin: DVec3, direction: DVec3, guess: Option<u32>) -> Option<Hit> {
        let facet = |triangle: u32| &self.facets[self.facet_of[triangle as usize] as usize];
        let guessed = guess.and_then(|g| facet(g).hit(origin, direction, f64::INFINITY));
        self.search::<false>(origin, direction, f64::INFINITY, guessed)
    }

    /// Whether a ray meets anything nearer than `reach`.
    pub fn blocked(&self, origin: DVec3, direction: DVec3, reach: f64) -> bool {
        self.search::<true>(origin, direction, reach, None).is_some()
    }

    /// The nearest hit below `reach`, or with `ANY` the first that is found.
    fn search<const ANY: bool>(
        &self,
        origin: DVec3,
        direction: DVec3,
        reach: f64,
        mut best: Option<Hit>,
    ) -> Option<Hit> {
        // A zero would make 0 · ∞ of a box face through the origin.
        let inverse =
            DVec3::from_array(direction.to_array().map(|d| if d == 0.0 { 1e300 } else { 1.0 / d }));
        let mut stack = [0u32; DEEP + 34];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let index = stack[depth];
            let node = &self.nodes[index as usize];
            let limit = best.map_or(reach, |hit| hit.t);
            let (a, b) = ((node.lower - origin) * inverse, (node.upper - origin) * inverse);
            let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
            if enter > leave * (1.0 + 1e-12) || leave < 0.0 || enter > limit {
                continue;
            }
            if node.count > 0 {
                let range = node.first as usize..(node.first + node.count) as usize;
                for facet in &self.facets[range] {
                    let limit = best.map_or(reach, |hit| hit.t);
                    best = facet.hit(origin, direction, limit).or(best);
                }
                if ANY && best.is_some() {
                    return best;
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

/// A box that grows.
#[derive(Clone, Copy)]
struct Bounds {
    lower: DVec3,
    upper: DVec3,
}

impl Bounds {
    const EMPTY: Bounds = Bounds { lower: DVec3::INFINITY, upper: DVec3::NEG_INFINITY };

    fn including(self, lower: DVec3, upper: DVec3) -> Bounds {
        Bounds { lower: self.lower.min(lower), upper: self.upper.max(upper) }
    }

    fn union(self, other: Bounds) -> Bounds {
        self.including(other.lower, other.upper)
    }

    /// Half the surface: in proportion to how many rays meet the box.
    fn area(self) -> f64 {
        let size = (self.upper - self.lower).max(DVec3::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }
}

impl Facet {
    fn bounds(&self) -> Bounds {
        let corners = [DVec3::ZERO, self.edges[0], self.edges[1]].map(|edge| self.corner + edge);
        corners.into_iter().fold(Bounds::EMPTY, |bounds, c| bounds.including(c, c))
    }

    fn middle(&self) -> DVec3 {
        self.corner + (self.edges[0] + self.edges[1]) / 3.0
    }
}

/// Adds the node over `facets[start..end]` and all below it.
fn split(nodes: &mut Vec<Node>, facets: &mut [Facet], start: usize, end: usize, depth: usize) {
    let bounds = facets[start..end].iter().fold(Bounds::EMPTY, |b, f| b.union(f.bounds()));
    // Room for rounding: walls are flat boxes, and a ray meets them on the very face.
    let margin = DVec3::splat(1e-9);
    let node = nodes.len();
    let count = end - start;
    nodes.push(Node {
        lower: bounds.lower - margin,
        upper: bounds.upper + margin,
        first: start as u32,
        count: if count <= LEAF { count as u32 } else { 0 },
    });
    if count <= LEAF {
        return;
    }
    let half = start + divide(&mut facets[start..end], depth);
    split(nodes, facets, start, half, depth + 1);
    nodes[node].first = nodes.len() as u32;
    split(nodes, facets, half, end, depth + 1);
}

/// Orders facets so that those of one child come before those of the other; gives the first of the
/// other. The cut is the cheapest of a few by the surface area heuristic (Wald 2007); where none
/// parts them, or the tree grows deep, the median of the longest axis.
fn divide(facets: &mut [Facet], depth: usize) -> usize {
    let middles =
        facets.iter().fold(Bounds::EMPTY, |bounds, f| bounds.including(f.middle(), f.middle()));
    let size = middles.upper - middles.lower;
    let bin_of = |f: &Facet, axis: usize| {
        let along = (f.middle()[axis] - middles.lower[axis]) / size[axis];
        ((along * BINS as f64) as usize).min(BINS - 1)
    };
    let mut best: Option<(f64, usize, usize)> = None;
    for axis in (0..3).filter(|&axis| size[axis] > 0.0 && depth < DEEP) {
        let mut bins = [(0usize, Bounds::EMPTY); BINS];
        for facet in facets.iter() {
            let bin = &mut bins[bin_of(facet, axis)];
            *bin = (bin.0 + 1, bin.1.union(facet.bounds()));
        }
        let cost = |bins: &[(usize, Bounds)]| {
            let whole = bins.iter().fold((0, Bounds::EMPTY), |a, b| (a.0 + b.0, a.1.union(b.1)));
            (whole.0, whole.0 as f64 * whole.1.area())
        };
        for cut in 1..BINS {
            let (left, right) = (cost(&bins[..cut]), cost(&bins[cut..]));
            let cheaper = best.is_none_or(|(least, ..)| left.1 + right.1 < least);
            if left.0 > 0 && right.0 > 0 && cheaper {
                best = Some((left.1 + right.1, axis, cut));
            }
        }
    }
    if let Some((_, axis, cut)) = best {
        // Stable, so that the order, and with it every tie between triangles, is the same always.
        facets.sort_by_key(|f| bin_of(f, axis) >= cut);
        return facets.partition_point(|f| bin_of(f, axis) < cut);
    }
    let axis = size.max_position();
    let half = facets.len() / 2;
    facets.select_nth_unstable_by(half, |a, b| {
        a.middle()[axis].total_cmp(&b.middle()[axis]).then(a.triangle.cmp(&b.triangle))
    });
    half
}
