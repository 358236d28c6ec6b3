// The viewer's camera. Axes are OpenCV's: x right, y down, z forward. Quaternions are [w, x, y, z].

export const add = (a, b) => a.map((v, i) => v + b[i]);
export const scaled = (a, s) => a.map((v) => v * s);
export const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);

export function product([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}

export const conjugate = ([w, x, y, z]) => [w, -x, -y, -z];
export const normalised = (q) => scaled(q, 1 / Math.hypot(...q));

export function rotated(q, [x, y, z]) {
  const [, a, b, c] = product(product(q, [0, x, y, z]), conjugate(q));
  return [a, b, c];
}

export function turn(axis, angle) {
  const s = Math.sin(angle / 2);
  return [Math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s];
}

export function slerp(a, b, share) {
  let cosine = dot(a, b);
  if (cosine < 0) {
    b = scaled(b, -1);
    cosine = -cosine;
  }
  if (cosine > 0.9995) return normalised(add(scaled(a, 1 - share), scaled(b, share)));
  const angle = Math.acos(cosine);
  const parts = [Math.sin((1 - share) * angle), Math.sin(share * angle)];
  return normalised(add(scaled(a, parts[0]), scaled(b, parts[1])));
}

// The camera's picture at another size: all that it showed stays in the picture.
export function resized(k, width, height) {
  const scale = Math.min(width / k.width, height / k.height);
  return {
    fx: k.fx * scale,
    fy: k.fy * scale,
    cx: width / 2 + (k.cx - k.width / 2) * scale,
    cy: height / 2 + (k.cy - k.height / 2) * scale,
    width,
    height,
  };
}

// The pixel of a point in the world, and its depth.
export function project(camera, point) {
  const [w, x, y, z, tx, ty, tz] = camera.view_from_world;
  const [px, py, depth] = add(rotated([w, x, y, z], point), [tx, ty, tz]);
  return [(camera.fx * px) / depth + camera.cx, (camera.fy * py) / depth + camera.cy, depth];
}

// Where a camera stands, and its rotation world_from_view.
export function placed(camera) {
  const [w, x, y, z, tx, ty, tz] = camera.view_from_world;
  const rotation = conjugate(normalised([w, x, y, z]));
  return { rotation, centre: scaled(rotated(rotation, [tx, ty, tz]), -1) };
}

// How near to the poles an orbit may come: the sine of the elevation.
const STEEPEST = 0.998;

export class Viewer {
  constructor(start, distance, up) {
    this.first = { start, distance };
    this.up = normalised([0, ...up]).slice(1);
    this.reset();
  }

  reset() {
    this.jump(this.first.start);
    this.distance = this.first.distance;
  }

  // Goes to where a camera is; what it looks at is taken to be as far away as before.
  jump(camera) {
    const { rotation, centre } = placed(camera);
    this.rotation = rotation;
    this.centre = centre;
    const { fx, fy, cx, cy, width, height } = camera;
    this.lens = { fx, fy, cx, cy, width, height };
  }

  get forward() {
    return rotated(this.rotation, [0, 0, 1]);
  }

  get pivot() {
    return add(this.centre, scaled(this.forward, this.distance));
  }

  // Turns by angles: to the right and down where they are above 0, on the picture.
  turned(right, down) {
    const across = product(turn(this.up, -right), this.rotation);
    const whole = normalised(product(across, turn([1, 0, 0], -down)));
    const steep = Math.abs(dot(rotated(whole, [0, 0, 1]), this.up));
    const now = Math.abs(dot(this.forward, this.up));
    return steep > STEEPEST && steep > now ? normalised(across) : whole;
  }

  orbit(right, down) {
    const pivot = this.pivot;
    this.rotation = this.turned(right, down);
    this.centre = add(pivot, scaled(this.forward, -this.distance));
  }

  look(right, down) {
    this.rotation = this.turned(right, down);
  }

  // By shares of the picture's width: what is at the pivot's distance follows the pointer.
  pan(right, down, size) {
    const k = resized(this.lens, size.width, size.height);
    const x = (-right * size.width * this.distance) / k.fx;
    const y = (-down * size.width * this.distance) / k.fy;
    this.centre = add(this.centre, rotated(this.rotation, [x, y, 0]));
  }

  dolly(factor) {
    const pivot = this.pivot;
    const bounds = [1e-4 * this.first.distance, 1e4 * this.first.distance];
    this.distance = Math.min(Math.max(this.distance * factor, bounds[0]), bounds[1]);
    this.centre = add(pivot, scaled(this.forward, -this.distance));
  }

  fly(right, down, forward) {
    this.centre = add(this.centre, rotated(this.rotation, [right, down, forward]));
  }

  camera(width, height) {
    const inverse = conjugate(this.rotation);
    const translation = scaled(rotated(inverse, this.centre), -1);
    return { ...resized(this.lens, width, height), view_from_world: [...inverse, ...translation] };
  }
}
