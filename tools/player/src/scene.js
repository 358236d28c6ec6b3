// Reads a scene's own file in its compact form: safetensors whose tensors are packed, as the module
// `scene::compact` of the crate describes them.

import { decompress } from "fzstd";

// An opacity of 8 bits is taken a quarter of a step inside of [0, 1], so that its logit is finite.
const INSIDE = 0.25 / 255;

export function parse(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const length = Number(view.getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + length)));
  const metadata = header.__metadata__;
  const packed = JSON.parse(metadata.packed);
  const tensor = (name) => {
    const entry = header[name];
    if (!entry) return null;
    const [begin, end] = entry.data_offsets;
    const data = bytes.subarray(8 + length + begin, 8 + length + end);
    if (packed[name]) return unpacked(packed[name], data);
    const kind = { F32: Float32Array, F64: Float64Array }[entry.dtype];
    return { shape: entry.shape, values: new kind(data.slice().buffer) };
  };
  const values = (name) => tensor(name)?.values;
  const sh = tensor("gaussians.sh");
  const path = tensor("control_points.path");
  const lenses = values("cameras.intrinsics");
  const poses = values("cameras.view_from_world");
  return {
    count: sh.shape[0],
    positions: values("gaussians.position"),
    logScales: values("gaussians.log_scale"),
    rotations: values("gaussians.rotation"),
    opacities: values("gaussians.opacity").map((v) => Math.min(Math.max(v, INSIDE), 1 - INSIDE)),
    coefficients: sh.shape[1],
    sh: sh.values,
    motionLogits: values("gaussians.motion_logit"),
    points: values("control_points.position"),
    logRadii: values("control_points.log_radius"),
    keys: path?.shape[0] ?? 0,
    paths: path?.values,
    neighbours: Number(metadata.neighbours),
    settings: JSON.parse(metadata.settings),
    background: JSON.parse(metadata.background),
    up: JSON.parse(metadata.up),
    cameras: Array.from(values("cameras.time") ?? [], (time, i) => {
      const [fx, fy, cx, cy, width, height] = lenses.subarray(6 * i);
      return { time, camera: { fx, fy, cx, cy, width, height, view_from_world: [...poses.subarray(7 * i, 7 * i + 7)] } };
    }),
  };
}

function unpacked({ shape, bytes, offset, step }, data) {
  const count = shape.reduce((product, side) => product * side, 1);
  const rows = shape[0];
  const columns = rows ? count / rows : 1;
  const stored = decompress(data, new Uint8Array(count * bytes));
  const values = new Float32Array(count);
  for (let c = 0; c < columns; c++) {
    for (let row = 0; row < rows; row++) {
      const place = c * rows + row;
      let number = 0;
      for (let byte = bytes - 1; byte >= 0; byte--) number = 256 * number + stored[byte * count + place];
      values[row * columns + c] = step ? offset[c] + step[c] * number : half(number);
    }
  }
  return { shape, values };
}

function half(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}
