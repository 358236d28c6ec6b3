// The scene as a source of splats for Spark. Spark keeps, colours, sorts and draws them; between reading
// and colouring, those that move are put to where they are at the time, on the device.

import { ExtSplats, dyno, utils } from "@sparkjsdev/spark";
import { DataTexture, FloatType, RGBAFormat } from "three";
import { NODE_FLOATS, follow, pose } from "./motion.js";

const SH_C0 = 0.28209479177387814;
// Texels of a row: the most that every device with WebGL 2 has in practice.
const WIDTH = 4096;

// A texture of floats, four a texel, read by the texel's number.
function texture(floats) {
  const rows = Math.max(1, Math.ceil(floats.length / 4 / WIDTH));
  const padded = new Float32Array(4 * WIDTH * rows);
  padded.set(floats);
  const made = new DataTexture(padded, WIDTH, rows, RGBAFormat, FloatType);
  made.internalFormat = "RGBA32F";
  made.needsUpdate = true;
  return made;
}

// Quaternions are (x, y, z, w) here, as in the rest of Spark's shaders; those of the nodes (w, x, y, z).
const SKIN = `
vec4 splat4dTexel(sampler2D texels, int at) {
  return texelFetch(texels, ivec2(at % ${WIDTH}, at / ${WIDTH}), 0);
}

void splat4dSkin(sampler2D followed, sampler2D nodes, int groups, int index,
                 inout vec3 center, inout vec4 quaternion, inout float opacity) {
  vec3 delta = vec3(0.0);
  vec4 sum = vec4(0.0);
  vec4 pole = vec4(0.0);
  float fade = 0.0;
  for (int group = 0; group < groups; group++) {
    vec4 ids = splat4dTexel(followed, 2 * (index * groups + group));
    vec4 weights = splat4dTexel(followed, 2 * (index * groups + group) + 1);
    for (int slot = 0; slot < 4; slot++) {
      int at = 3 * int(ids[slot]);
      vec4 place = splat4dTexel(nodes, at);
      vec3 shift = splat4dTexel(nodes, at + 1).xyz;
      vec4 turn = splat4dTexel(nodes, at + 2).yzwx;
      if (group == 0 && slot == 0) {
        pole = turn;
        fade = place.w;
      }
      vec3 offset = center - place.xyz;
      vec3 t = 2.0 * cross(turn.xyz, offset);
      delta += weights[slot] * (turn.w * t + cross(turn.xyz, t) + shift);
      sum += weights[slot] * (dot(turn, pole) < 0.0 ? -turn : turn);
    }
  }
  center += delta;
  if (dot(sum, sum) > 0.0) {
    quaternion = normalize(quatQuat(normalize(sum), quaternion));
  }
  float kept = exp(fade);
  opacity = opacity * kept / (1.0 - opacity + opacity * kept);
}`;

export class Skinned {
  constructor(scene) {
    const isMover = (i) => scene.keys > 0 && scene.motionLogits?.[i] > 0;
    // Movers first: a Gaussian's index tells whether it moves.
    const all = Array.from({ length: scene.count }, (_, i) => i);
    const order = [...all.filter(isMover), ...all.filter((i) => !isMover(i))];
    this.movers = all.filter(isMover).length;
    this.scene = scene;
    this.splats = packed(scene, order);
    if (this.movers === 0) return;
    const places = new Float32Array(3 * this.movers);
    for (let i = 0; i < this.movers; i++) places.set(scene.positions.subarray(3 * order[i], 3 * order[i] + 3), 3 * i);
    const { groups, rows } = follow(places, this.movers, scene);
    this.groups = groups;
    this.followed = new dyno.DynoSampler2D({ key: "followed", value: texture(rows) });
    this.nodes = new dyno.DynoSampler2D({
      key: "nodes",
      value: texture(new Float32Array((NODE_FLOATS * scene.points.length) / 3)),
    });
    this.setTime(0);
  }

  setTime(time) {
    if (this.movers === 0) return;
    const texels = this.nodes.value;
    pose(time, this.scene, texels.image.data);
    texels.needsUpdate = true;
  }

  // What Spark asks of a source of splats.

  prepareFetchSplat() {}

  dispose() {
    this.splats.dispose();
  }

  getNumSplats() {
    return this.splats.getNumSplats();
  }

  hasRgbDir() {
    return this.splats.hasRgbDir();
  }

  getNumSh() {
    return this.splats.getNumSh();
  }

  setMaxSh(degree) {
    this.splats.setMaxSh(degree);
  }

  forEachSplat(callback) {
    this.splats.forEachSplat(callback);
  }

  fetchSplat({ index, viewOrigin }) {
    if (this.movers === 0) return this.splats.fetchSplat({ index, viewOrigin });
    const { center, quaternion, opacity } = dyno.splitGsplat(this.splats.fetchSplat({ index })).outputs;
    const moved = new dyno.Dyno({
      inTypes: { index: "int", followed: "sampler2D", nodes: "sampler2D", center: "vec3", quaternion: "vec4", opacity: "float" },
      outTypes: { center: "vec3", quaternion: "vec4", opacity: "float" },
      inputs: { index, followed: this.followed, nodes: this.nodes, center, quaternion, opacity },
      globals: () => [SKIN],
      statements: ({ inputs, outputs }) => [
        `${outputs.center} = ${inputs.center};`,
        `${outputs.quaternion} = ${inputs.quaternion};`,
        `${outputs.opacity} = ${inputs.opacity};`,
        `if (${inputs.index} < ${this.movers}) {`,
        `  splat4dSkin(${inputs.followed}, ${inputs.nodes}, ${this.groups}, ${inputs.index},`,
        `    ${outputs.center}, ${outputs.quaternion}, ${outputs.opacity});`,
        "}",
      ],
    }).outputs;
    // Spark colours by the direction to where a splat is stored; its colour is that of where it is now.
    const origin = viewOrigin && dyno.sub(viewOrigin, dyno.sub(moved.center, center));
    return dyno.combineGsplat({ gsplat: this.splats.fetchSplat({ index, viewOrigin: origin }), ...moved });
  }
}

// A harmonic's three colours in 32 bits, as Spark's shaders read them: 8 bits each under one power of two that
// is no less than any of them, and the signs.
function harmonic([r, g, b]) {
  const largest = Math.max(Math.abs(r), Math.abs(g), Math.abs(b));
  const power = Math.min(Math.max(Math.ceil(Math.log2(largest)) + 15, 0), 31);
  const step = 2 ** (power - 15) / 255;
  const [x, y, z] = [r, g, b].map((v) => Math.min(Math.round(Math.abs(v) / step), 255));
  const signs = (r < 0 ? 1 : 0) | (g < 0 ? 2 : 0) | (b < 0 ? 4 : 0);
  return x | (y << 8) | (z << 16) | (((power << 3) | signs) << 24);
}

// Of each Gaussian's coefficients above the constant one, those from `first` on, four a texel. (Spark 2.2.0
// has functions for this, which cut off what is larger than a power of two, and read band 2 from the wrong
// places.)
function texels({ sh, coefficients }, order, first, size) {
  const words = new Uint32Array(size);
  const count = Math.min(coefficients - first, 4);
  order.forEach((i, at) => {
    for (let k = 0; k < count; k++) {
      const from = 3 * (coefficients * i + first + k);
      words[4 * at + k] = harmonic(sh.subarray(from, from + 3));
    }
  });
  return words;
}

// The Gaussians as they stand, in Spark's 32 bytes each and 4 a harmonic.
function packed(scene, order) {
  const size = 4 * utils.getTextureSize(scene.count).maxSplats;
  const extArrays = [new Uint32Array(size), new Uint32Array(size)];
  const { positions, logScales, rotations, opacities, sh, coefficients } = scene;
  order.forEach((i, at) => {
    const [w, x, y, z] = rotations.subarray(4 * i, 4 * i + 4);
    const length = Math.hypot(w, x, y, z);
    const constant = 3 * coefficients * i;
    utils.encodeExtSplat(
      extArrays,
      at,
      ...positions.subarray(3 * i, 3 * i + 3),
      ...logScales.subarray(3 * i, 3 * i + 3).map(Math.exp),
      ...(length > 1e-10 ? [x, y, z, w].map((v) => v / length) : [0, 0, 0, 1]),
      opacities[i],
      ...sh.subarray(constant, constant + 3).map((v) => 0.5 + SH_C0 * v),
    );
  });
  const extra = {};
  ["sh1", "sh2", "sh3a", "sh3b"].forEach((name, k) => {
    if (coefficients > 4 * k + 3) extra[name] = texels(scene, order, 4 * k + 1, size);
  });
  return new ExtSplats({ extArrays, numSplats: scene.count, extra });
}
