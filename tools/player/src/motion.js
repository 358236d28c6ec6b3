// What moves: which control points a Gaussian follows, and by how much; the control points' motions at a
// time. As the crate's kernels `deform` and `path` define it.

const LARGEST_LOG_RADIUS = 40;
// Floats of a control point for the device: its place and fade, its shift, its rotation.
export const NODE_FLOATS = 12;

const inverseSquare = (logRadius) => Math.exp(-2 * Math.min(Math.max(logRadius, -LARGEST_LOG_RADIUS), LARGEST_LOG_RADIUS));

// The k control points nearest to a place, nearest first, equal distances by index.
function nearest(place, points, k, found, distances) {
  let held = 0;
  for (let node = 0, at = 0; at < points.length; node++, at += 3) {
    const [x, y, z] = [place[0] - points[at], place[1] - points[at + 1], place[2] - points[at + 2]];
    const distance = x * x + y * y + z * z;
    if (held === k && !(distance < distances[k - 1])) continue;
    let slot = held < k ? held++ : k - 1;
    for (; slot > 0 && distance < distances[slot - 1]; slot--) {
      distances[slot] = distances[slot - 1];
      found[slot] = found[slot - 1];
    }
    distances[slot] = distance;
    found[slot] = node;
  }
  return held;
}

// For the Gaussians of some places, k control points each and their weights, the heaviest first: groups of
// 4 indices and 4 weights. `groups` is how many of these a Gaussian has.
export function follow(positions, count, { points, logRadii, neighbours }) {
  const k = Math.min(neighbours, logRadii.length);
  const groups = Math.ceil(k / 4);
  const rows = new Float32Array(count * groups * 8);
  const found = new Int32Array(k);
  const distances = new Float64Array(k);
  for (let i = 0; i < count; i++) {
    const held = nearest(positions.subarray(3 * i, 3 * i + 3), points, k, found, distances);
    const exponents = Array.from({ length: held }, (_, s) => -0.5 * distances[s] * inverseSquare(logRadii[found[s]]));
    const largest = Math.max(...exponents);
    // Where every weight underflows, the nearest takes all.
    const weights = exponents.map((exponent, s) => (largest === -Infinity ? Number(s === 0) : Math.exp(exponent - largest)));
    const sum = weights.reduce((a, b) => a + b);
    const order = weights.map((_, s) => s).sort((a, b) => weights[b] - weights[a]);
    order.forEach((s, slot) => {
      const group = 8 * (i * groups + (slot >> 2)) + (slot & 3);
      rows[group] = found[s];
      rows[group + 4] = weights[s] / sum;
    });
  }
  return { groups, rows };
}

// Catmull and Rom's weights of the keys around a time, and the first of these.
function keysAt(time, count) {
  const place = Math.min(Math.max(time, 0), 1) * (count - 1);
  const before = Math.min(Math.max(Math.floor(place), 0), Math.max(count - 2, 0));
  const u = place - before;
  const [u2, u3] = [u * u, u * u * u];
  const weights = [-u3 + 2 * u2 - u, 3 * u3 - 5 * u2 + 2, -3 * u3 + 4 * u2 + u, u3 - u2].map((w) => 0.5 * w);
  return { first: before - 1, weights };
}

// Writes the control points' motions at a time, as the device reads them.
export function pose(time, { points, keys, paths }, out) {
  const count = points.length / 3;
  const { first, weights } = keysAt(time, keys);
  const at = weights.map((_, slot) => 8 * count * Math.min(Math.max(first + slot, 0), keys - 1));
  for (let node = 0; node < count; node++) {
    const motion = (c) => weights.reduce((sum, weight, slot) => sum + weight * paths[at[slot] + 8 * node + c], 0);
    const rotation = [1 + motion(4), motion(5), motion(6), motion(7)];
    const length = Math.hypot(...rotation);
    const unit = length > 1e-18 ? rotation.map((v) => v / length) : [1, 0, 0, 0];
    // Interpolation overshoots: nothing becomes more opaque.
    const fade = Math.min(motion(3), 0);
    const place = points.subarray(3 * node, 3 * node + 3);
    out.set([...place, fade, motion(0), motion(1), motion(2), 0, ...unit], NODE_FLOATS * node);
  }
}
