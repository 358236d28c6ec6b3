// A camera path: keyframes, what lies between them, and the file that `splat4d render --path` takes.

import { add, placed, resized, rotated, scaled, slerp } from "./camera.js";

export class Keyframes {
  constructor() {
    this.keys = [];
  }

  // A camera at a time.
  add(camera, time) {
    const { fx, fy, cx, cy, width, height } = camera;
    this.keys.push({ time, lens: { fx, fy, cx, cy, width, height }, ...placed(camera) });
  }

  remove(index) {
    this.keys.splice(index, 1);
  }

  // The key at a share of the way: centres by Catmull and Rom's cubic, rotations by slerp, times and
  // lenses evenly.
  at(share) {
    const { keys } = this;
    const along = Math.min(Math.max(share, 0), 1) * (keys.length - 1);
    const first = Math.min(Math.floor(along), Math.max(keys.length - 2, 0));
    const s = along - first;
    const key = (i) => keys[Math.min(Math.max(i, 0), keys.length - 1)];
    const [p, a, b, n] = [first - 1, first, first + 1, first + 2].map(key);
    const weights = [
      ((2 - s) * s - 1) * s * 0.5,
      ((3 * s - 5) * s * s + 2) * 0.5,
      ((4 - 3 * s) * s + 1) * s * 0.5,
      (s - 1) * s * s * 0.5,
    ];
    const centre = [p, a, b, n]
      .map((k, i) => scaled(k.centre, weights[i]))
      .reduce((sum, v) => add(sum, v));
    const mixed = (x, y) => x + (y - x) * s;
    const { width, height } = keys[0].lens;
    const [from, to] = [a, b].map((k) => resized(k.lens, width, height));
    const lens = Object.fromEntries(Object.keys(from).map((k) => [k, mixed(from[k], to[k])]));
    return { time: mixed(a.time, b.time), lens, centre, rotation: slerp(a.rotation, b.rotation, s) };
  }

  // nerfstudio's transforms.json of so many cameras, all of the first key's size: world_from_view with
  // OpenGL's axes (y up, z backward).
  transforms(count) {
    const { width: w, height: h } = this.keys[0].lens;
    const frames = Array.from({ length: count }, (_, i) => {
      const { time, lens, centre, rotation } = this.at(count > 1 ? i / (count - 1) : 0);
      const x = rotated(rotation, [1, 0, 0]);
      const y = rotated(rotation, [0, -1, 0]);
      const z = rotated(rotation, [0, 0, -1]);
      const row = (r) => [x[r], y[r], z[r], centre[r]];
      return {
        file_path: `${String(i).padStart(4, "0")}.png`,
        time: Math.min(Math.max(time, 0), 1),
        transform_matrix: [row(0), row(1), row(2), [0, 0, 0, 1]],
        fl_x: lens.fx, fl_y: lens.fy, cx: lens.cx, cy: lens.cy, w, h,
      };
    });
    const { fl_x, fl_y, cx, cy } = frames[0];
    return { camera_model: "PINHOLE", fl_x, fl_y, cx, cy, w, h, frames };
  }
}
