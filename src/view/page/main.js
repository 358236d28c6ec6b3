// The page: what its elements do. The picture comes from the server; see `link.js`.

import { Viewer } from "./camera.js";
import { Keyframes } from "./keyframes.js";
import { listenToKeys } from "./keys.js";
import { Link } from "./link.js";
import { Overlay, nearestIn } from "./overlay.js";
import { apply, listen } from "./pointer.js";
import { TimeLine } from "./timeline.js";
import { Training } from "./training.js";

const STILL_AFTER = 160;
const STILL_QUALITY = 92;
const MOVING_QUALITY = 75;
// While it moves a picture should take no longer than this, in milliseconds.
const SLOW = 70;
const FAST = 25;
const LEAST_SCALE = 0.25;
const MOST_PIXELS_SHOWN = 1920 * 1080;
const PATH_RATE = 24;
const INPUT_RATE = 24;
const SECONDS_WITHOUT_INPUT = 4;

const element = (id) => document.getElementById(id);
const picture = element("picture");
const layers = ["colour", "depth", "alpha", "motion", "flow", "normal"];

const answer = await fetch("scene.json");
if (!answer.ok) element("message").textContent = "The scene cannot be loaded; is the server running?";
let scene = await answer.json();
let viewer = new Viewer(scene.start, scene.distance, scene.up);
let overlay;
// Of a training the scene comes later, and again and again.
let isThere = !scene.live;
let scenes = 0;
let loads = false;
const keyframes = new Keyframes();
let scale = 1;
let stillTimer;
let wantsScreenshot = false;
let pathPlays = false;
// The request for the picture that stays.
let whole = null;
let shownPoints = new Float32Array();

const curve = (name) => ({ svg: element(`${name}-curve`), text: element(`${name}-text`) });
const training = new Training(element("work"), element("work-stage"), element("work-bar"), {
  loss: curve("loss"),
  psnr: curve("psnr"),
  count: curve("count"),
});
const link = new Link({ picture: show, refusal: say, state: say, status: told });
const timeLine = new TimeLine(
  { slider: element("time"), text: element("time-text"), button: element("play"), loop: element("loop"), speed: element("speed") },
  SECONDS_WITHOUT_INPUT,
  { time: timeChanged },
);

function say(text) {
  element("message").textContent = text;
}

// The picture's size where it is still: the stage's pixels, within what the server makes.
function fullSize() {
  const ratio = Math.min(devicePixelRatio, 2);
  const [w, h] = [picture.clientWidth * ratio, picture.clientHeight * ratio];
  const most = Math.min(scene.most_pixels, MOST_PIXELS_SHOWN);
  const shrink = Math.min(1, scene.most_side / Math.max(w, h, 1), Math.sqrt(most / Math.max(w * h, 1)));
  return [w, h].map((side) => Math.max(16, Math.floor(side * shrink)));
}

function request(still) {
  const share = still ? 1 : scale;
  const [width, height] = fullSize().map((side) => Math.max(16, Math.round(side * share)));
  return {
    time: timeLine.time,
    layer: element("layer").value,
    format: still && wantsScreenshot ? "png" : "jpeg",
    quality: still ? STILL_QUALITY : MOVING_QUALITY,
    points: element("show-points").checked,
    camera: viewer.camera(width, height),
  };
}

// Something has changed: a quick picture now, a whole one when it is still.
function changed() {
  if (!isThere) return;
  picture.setAttribute("aria-busy", "true");
  whole = null;
  link.ask(request(false));
  clearTimeout(stillTimer);
  stillTimer = setTimeout(settle, STILL_AFTER);
}

function settle() {
  if (!isThere) return;
  whole = request(true);
  link.ask(whole);
}

let newestDecoded = 0;
async function show(header, points, blob, asked) {
  const bitmap = await createImageBitmap(blob);
  // Decoding may overtake; an older picture is not shown after a newer one.
  if (header.id < newestDecoded) return;
  newestDecoded = header.id;
  picture.width = header.width;
  picture.height = header.height;
  picture.getContext("2d").drawImage(bitmap, 0, 0);
  bitmap.close();
  picture.shown = { header, asked };
  if (asked === whole) picture.setAttribute("aria-busy", "false");
  shownPoints = points;
  drawOverlay();
  element("milliseconds").textContent = `${header.milliseconds.toFixed(1)} ms`;
  element("gaussians").textContent = `${header.gaussians.toLocaleString("en")} Gaussians`;
  element("size").textContent = `${header.width}×${header.height}`;
  const range = element("range");
  range.hidden = header.range === null;
  if (header.range) range.textContent = legend(header);
  if (asked?.quality === MOVING_QUALITY) {
    if (header.milliseconds > SLOW) scale = Math.max(LEAST_SCALE, scale / Math.SQRT2);
    else if (header.milliseconds < FAST) scale = Math.min(1, scale * Math.SQRT2);
  } else if (header.milliseconds > SLOW) {
    scale = Math.max(LEAST_SCALE, Math.min(scale, Math.sqrt(SLOW / header.milliseconds)));
  }
  if (header.format === "png" && wantsScreenshot) {
    wantsScreenshot = false;
    save(blob, "splat4d.png");
  }
}

function legend({ layer, range: [first, last] }) {
  if (layer === "flow") return `white ${first} px, full colour ${last} px until the next input frame`;
  return `white ${first.toPrecision(3)}, dark ${last.toPrecision(3)}`;
}

function drawOverlay() {
  const asked = picture.shown?.asked;
  if (!asked) return;
  overlay.draw(asked.camera, asked.time, shownPoints, {
    cameras: element("show-cameras").checked,
    points: element("show-points").checked,
  });
}

function save(blob, name) {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(blob);
  anchor.download = name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 10_000);
  say(`${name} is saved`);
}

// The input.

function timeChanged() {
  const followed = element("follow").checked ? nearestIn(scene.cameras, timeLine.time) : undefined;
  if (followed && !pathPlays) viewer.jump(followed.camera);
  changed();
  showInput();
}

function jump(index) {
  const known = scene.cameras[index];
  if (!known) return;
  element("cameras").value = String(index);
  viewer.jump(known.camera);
  timeLine.set(known.time);
  say(`Input camera ${index + 1} of ${scene.cameras.length}`);
}

function step(by) {
  const { length } = scene.cameras;
  if (length) jump((Number(element("cameras").value) + by + length) % length);
}

let inputWanted = null;
let inputShown = null;
let inputLoads = false;
async function showInput() {
  if (element("beside").hidden) return;
  const { cameras, pictures } = scene;
  const nearest = nearestIn(cameras, timeLine.time);
  inputWanted = cameras.length === pictures ? cameras.indexOf(nearest) : Math.round(timeLine.time * (pictures - 1));
  if (inputLoads) return;
  inputLoads = true;
  while (inputWanted !== inputShown) {
    const number = inputWanted;
    const loaded = await fetch(`pictures/${number}`).catch(() => null);
    inputShown = number;
    if (!loaded?.ok) {
      say(`The input's image ${number + 1} cannot be loaded`);
      continue;
    }
    const bitmap = await createImageBitmap(await loaded.blob());
    const canvas = element("input");
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    element("input-name").textContent = `Input ${number + 1} of ${pictures}`;
  }
  inputLoads = false;
}

// The path.

function addKey() {
  const [width, height] = fullSize();
  keyframes.add(viewer.camera(width, height), timeLine.time);
  listKeys(keyframes.keys.length - 1);
  say(`Keyframe ${keyframes.keys.length} added at time ${timeLine.time.toFixed(3)}`);
}

function listKeys(chosen) {
  const list = element("keys");
  const { keys } = keyframes;
  const options = keys.map((key, i) => new Option(`${i + 1}: time ${key.time.toFixed(3)}`, String(i)));
  list.replaceChildren(...(options.length ? options : [new Option("no keyframes", "")]));
  if (keys.length) list.value = String(Math.min(Math.max(chosen, 0), keys.length - 1));
  for (const id of ["remove-key", "save-path"]) element(id).disabled = keys.length === 0;
  element("play-path").disabled = keys.length < 2;
}

function goTo(key) {
  viewer.rotation = key.rotation;
  viewer.centre = key.centre;
  viewer.lens = key.lens;
  timeLine.set(key.time);
}

function pathLength() {
  const box = element("path-length");
  const length = Math.round(Number(box.value));
  return Math.min(Math.max(Number.isFinite(length) ? length : 1, Number(box.min)), Number(box.max));
}

function playPath() {
  pathPlays = !pathPlays;
  element("play-path").setAttribute("aria-pressed", String(pathPlays));
  if (!pathPlays) return;
  timeLine.pause();
  const begun = performance.now();
  const seconds = pathLength() / PATH_RATE;
  const tick = (now) => {
    if (!pathPlays) return;
    const share = (now - begun) / 1000 / seconds;
    goTo(keyframes.at(share));
    if (share >= 1) playPath();
    else requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

function savePath() {
  const text = JSON.stringify(keyframes.transforms(pathLength()), null, 1);
  save(new Blob([text], { type: "application/json" }), "transforms.json");
}

function screenshot() {
  wantsScreenshot = true;
  picture.setAttribute("aria-busy", "true");
  settle();
}

// Keys on the picture.

listenToKeys(picture, {
  turn: (kind, right, down) => {
    apply(viewer, kind, right, down, stageSize());
    changed();
  },
  dolly: (factor) => {
    viewer.dolly(factor);
    changed();
  },
  fly: (steps) => {
    viewer.fly(...steps.map((step) => step * viewer.distance));
    changed();
  },
  strokes: {
    " ": () => timeLine.toggle(),
    ",": () => timeLine.step(-0.01),
    ".": () => timeLine.step(0.01),
    "[": () => step(-1),
    "]": () => step(1),
    "?": () => element("keys-help").showModal(),
    home: reset,
    k: addKey,
    p: screenshot,
    ...Object.fromEntries(layers.map((layer, i) => [i + 1, () => setLayer(layer)])),
  },
});

function reset() {
  viewer.reset();
  changed();
}

function setLayer(layer) {
  if (element("layer").querySelector(`[value=${layer}]`).disabled) return;
  element("layer").value = layer;
  changed();
}

function stageSize() {
  return { width: picture.clientWidth, height: picture.clientHeight };
}

listen(picture, () => element("drag").value, {
  move(kind, right, down) {
    apply(viewer, kind, right, down, stageSize());
    changed();
  },
  dolly(factor) {
    viewer.dolly(factor);
    changed();
  },
  click(x, y) {
    const index = element("show-cameras").checked ? overlay.hit(x, y) : null;
    if (index !== null) jump(index);
  },
});

const on = (id, kind, act) => element(id).addEventListener(kind, act);
on("layer", "change", changed);
on("show-points", "change", changed);
on("show-cameras", "change", drawOverlay);
on("show-input", "change", () => {
  element("beside").hidden = !element("show-input").checked;
  showInput();
});
on("follow", "change", timeChanged);
on("reset", "click", reset);
on("previous", "click", () => step(-1));
on("next", "click", () => step(1));
on("cameras", "change", () => jump(Number(element("cameras").value)));
on("add-key", "click", addKey);
on("keys", "change", () => goTo(keyframes.keys[Number(element("keys").value)]));
on("remove-key", "click", () => {
  const index = Number(element("keys").value);
  keyframes.remove(index);
  listKeys(index);
});
on("play-path", "click", playPath);
on("save-path", "click", savePath);
on("screenshot", "click", screenshot);
on("help", "click", () => element("keys-help").showModal());
new ResizeObserver(changed).observe(picture);

// What the scene does not have is not offered.
function adopt(described) {
  scene = described;
  overlay = new Overlay(element("overlay"), scene.cameras, 0.05 * scene.distance);
  timeLine.seconds = scene.cameras.length > 1 ? scene.cameras.length / INPUT_RATE : SECONDS_WITHOUT_INPUT;
  document.title = `${scene.name} – splat4d`;
  element("name").textContent = scene.name;
  element("name").title = scene.device;
  const list = element("cameras");
  if (list.dataset.count !== String(scene.cameras.length)) listCameras(list);
  for (const id of ["show-cameras", "cameras", "previous", "next", "follow"]) element(id).disabled = scene.cameras.length === 0;
  element("show-points").disabled = scene.control_points === 0;
  for (const layer of ["motion", "flow"]) element("layer").querySelector(`[value=${layer}]`).disabled = !scene.moves;
  const side = element("show-input");
  side.disabled = scene.pictures === 0;
  side.closest("label").title = side.disabled
    ? "Start splat4d view with --frames to see the input beside the scene"
    : "The input beside the scene";
}

function listCameras(list) {
  const options = scene.cameras.map((c, i) => new Option(`${i + 1}: time ${c.time.toFixed(3)}`, String(i)));
  list.replaceChildren(...(options.length ? options : [new Option("no input cameras", "")]));
  list.dataset.count = String(scene.cameras.length);
}

// A training tells how far it is; a new scene is fetched and shown from where the viewer is.
async function told(status) {
  training.show(status);
  if (!isThere && status.scenes === 0) say("There is no scene yet: it comes with the first step of training");
  if (loads || status.scenes === scenes) return;
  loads = true;
  const loaded = await fetch("scene.json").catch(() => null);
  loads = false;
  if (!loaded?.ok) return;
  scenes = status.scenes;
  adopt(await loaded.json());
  if (isThere) {
    picture.setAttribute("aria-busy", "true");
    settle();
    return;
  }
  isThere = true;
  say("");
  viewer = new Viewer(scene.start, scene.distance, scene.up);
  timeLine.set(scene.cameras[0]?.time ?? 0);
}

adopt(scene);
timeLine.set(scene.cameras[0]?.time ?? 0);
