//! Ray–triangle intersection with a bounding-volume hierarchy in f64, which the ground truth needs.

use glam::DVec3;

/// Maximum number of triangles in a leaf.
const LEAF: usize = 4;
/// Number of candidate cuts along each axis, plus one.
const BINS: usize = 12;
/// Depth from which nodes are halved, which bounds the depth: fewer than 2³² triangles are at most
/// 32 halvings from a leaf.
const DEEP: usize = 32;
/// Tolerance (in barycentric units) by which triangles are extended, so that no ray passes through the seam
/// between two.
const SEAM: f64 = 1e-9;

/// Intersection of a ray with a triangle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// Ray parameter in lengths of the ray's direction; with a direction of unit z in the camera frame, the
    /// depth.
    pub t: f64,
    /// Index of the triangle.
    pub triangle: u32,
    /// Weights of the triangle's second and third corner.
    pub weights: [f64; 2],
}

/// One triangle, precomputed for the intersection.
#[derive(Clone, Copy, Debug)]
struct Facet {
    corner: DVec3,
    edges: [DVec3; 2],
    triangle: u32,
}

impl Facet {
    /// Intersection of the ray with the triangle's plane: t and weights, whether or not inside.
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

/// A node of the hierarchy. A leaf has `count` facets from index `first`; an inner node has `count` = 0,
/// and its children are at its own index + 1 and at `first`.
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
    /// Index of each triangle's facet.
    facet_of: Vec<u32>,
}

impl Bvh {
    /// Builds the hierarchy over all triangles.
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

    /// The nearest hit along a ray. `guess`, a triangle that is likely to be hit, only saves time.
    pub fn nearest(&self, origin: DVec3, direction: DVec3, guess: Option<u32>) -> Option<Hit> {
        let facet = |triangle: u32| &self.facets[self.facet_of[triangle as usize] as usize];
        let guessed = guess.and_then(|g| facet(g).hit(origin, direction, f64::INFINITY));
        self.search::<false>(origin, direction, f64::INFINITY, guessed)
    }

    /// Whether a ray hits anything nearer than `reach`.
    pub fn blocked(&self, origin: DVec3, direction: DVec3, reach: f64) -> bool {
        self.search::<true>(origin, direction, reach, None).is_some()
    }

    /// The nearest hit below `reach`, or with `ANY` the first one found.
    fn search<const ANY: bool>(
        &self,
        origin: DVec3,
        direction: DVec3,
        reach: f64,
        mut best: Option<Hit>,
    ) -> Option<Hit> {
        // A zero component would give 0 · ∞ for a box face through the origin.
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
                // The child whose box is nearer is popped first.
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

    /// Intersection of a ray with the plane of a triangle, inside it or not.
    pub fn on_plane(&self, triangle: u32, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let facet = &self.facets[self.facet_of[triangle as usize] as usize];
        let (t, b, c) = facet.plane(origin, direction)?;
        Some(Hit { t, triangle, weights: [b, c] })
    }
}

/// A growing bounding box.
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

    /// Half the surface area, proportional to the probability that a ray hits the box.
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

/// Appends the node over `facets[start..end]` and its subtree.
fn split(nodes: &mut Vec<Node>, facets: &mut [Facet], start: usize, end: usize, depth: usize) {
    let bounds = facets[start..end].iter().fold(Bounds::EMPTY, |b, f| b.union(f.bounds()));
    // Margin for rounding: walls are flat boxes, which rays hit exactly on the face.
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

/// Partitions facets between two children; returns the index of the second child's first facet. The cut is
/// the cheapest of a few by the surface area heuristic (Wald 2007); where none separates the facets, or the
/// tree is deep, the median of the longest axis.
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
        // A stable sort keeps the order deterministic, and with it every tie between triangles.
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
