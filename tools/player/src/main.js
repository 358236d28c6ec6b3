// The page: what its elements do. `stage.js` draws; camera, pointer, keys and time line are those of
// the viewer (`splat4d view`).
//
// The page's own script sets `globalThis.splat4d` before this one runs:
//   { sorter, scene }   Spark's WebAssembly module and the scene's file, as bytes
// and this one adds what programs may use, once `splat4d.ready` is fulfilled:
//   shot(camera, time, width, height)   gives ImageData of the scene as a camera sees it at a time in
//     [0, 1], no matter what the page shows. The camera is { fx, fy, cx, cy, width, height,
//     view_from_world: [qw, qx, qy, qz, tx, ty, tz] } with OpenCV's axes, of which all is seen where the
//     picture has other sides; null stands for the page's own.
//   frames                              how many pictures the page has drawn

import { Viewer, resized } from "../../../src/view/page/camera.js";
import { listenToKeys } from "../../../src/view/page/keys.js";
import { apply, listen } from "../../../src/view/page/pointer.js";
import { TimeLine } from "../../../src/view/page/timeline.js";
import { parse } from "./scene.js";
import { Stage } from "./stage.js";

const INPUT_RATE = 24;
const SECONDS_WITHOUT_INPUT = 4;
// Pixels of a CSS pixel's side, and of the picture: more are seen by few and take long.
const MOST_RATIO = 2;
const MOST_PIXELS = 1920 * 1080;

const element = (id) => document.getElementById(id);
const say = (text) => {
  element("message").textContent = text;
};

globalThis.splat4d.ready = start();
globalThis.splat4d.ready.catch((error) => say(`The scene cannot be shown: ${error.message}`));

async function start() {
  const page = globalThis.splat4d;
  const about = JSON.parse(element("about").textContent);
  const scene = parse(page.scene);
  delete page.scene;
  const picture = element("picture");
  const stage = new Stage(picture, scene, () => want());
  const viewer = new Viewer(about.start, about.distance, scene.up);
  const moves = stage.source.movers > 0;
  let wanted = false;
  let shots = Promise.resolve();
  let isShooting = false;

  page.frames = 0;
  // Pictures are drawn one after the other, and none of the page's own meanwhile.
  page.shot = (camera, time, width, height) => {
    const shot = shots.then(() => shoot(camera, time, width, height));
    shots = shot.catch(() => {});
    return shot;
  };

  const timeLine = new TimeLine(
    { slider: element("time"), text: element("time-text"), button: element("play"), loop: element("loop"), speed: element("speed") },
    scene.cameras.length > 1 ? scene.cameras.length / INPUT_RATE : SECONDS_WITHOUT_INPUT,
    { time: changed },
  );

  async function shoot(camera, time, width, height) {
    isShooting = true;
    try {
      stage.resize(width, height);
      stage.look(camera ? { ...camera, ...resized(camera, width, height) } : viewer.camera(width, height));
      stage.setTime(time);
      await stage.drawSorted();
      return stage.read();
    } finally {
      isShooting = false;
      want();
    }
  }

  function want() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => {
      wanted = false;
      if (!isShooting) frame();
    });
  }

  function frame() {
    const sides = [picture.clientWidth, picture.clientHeight];
    const most = Math.sqrt(MOST_PIXELS / Math.max(sides[0] * sides[1], 1));
    const ratio = Math.min(devicePixelRatio, MOST_RATIO, most);
    const [width, height] = sides.map((side) => Math.max(1, Math.round(side * ratio)));
    stage.resize(width, height);
    stage.look(viewer.camera(width, height));
    stage.setTime(timeLine.time);
    stage.draw();
    page.frames++;
  }

  function changed() {
    picture.setAttribute("data-time", timeLine.time);
    want();
  }

  const size = () => ({ width: picture.clientWidth, height: picture.clientHeight });
  const act = (change) => {
    change();
    changed();
  };
  listen(picture, () => "orbit", {
    move: (kind, right, down) => act(() => apply(viewer, kind, right, down, size())),
    dolly: (factor) => act(() => viewer.dolly(factor)),
    click() {},
  });
  listenToKeys(picture, {
    turn: (kind, right, down) => act(() => apply(viewer, kind, right, down, size())),
    dolly: (factor) => act(() => viewer.dolly(factor)),
    fly: (steps) => act(() => viewer.fly(...steps.map((step) => step * viewer.distance))),
    strokes: {
      home: reset,
      "?": help,
      ...(moves && { " ": () => timeLine.toggle(), ",": () => timeLine.step(-0.01), ".": () => timeLine.step(0.01) }),
    },
  });

  function reset() {
    act(() => viewer.reset());
  }

  function help() {
    element("keys-help").showModal();
  }

  element("reset").addEventListener("click", reset);
  element("help").addEventListener("click", help);
  new ResizeObserver(changed).observe(picture);
  picture.addEventListener("webglcontextlost", () => say("The graphics device was lost; reload the page."));
  // What the scene does not have is not offered.
  for (const part of document.querySelectorAll(".moving")) part.hidden = !moves;
  element("count").textContent = `${scene.count.toLocaleString("en")} Gaussians`;
  timeLine.set(about.time);
  stage.look(viewer.camera(1, 1));
  await stage.drawSorted();
  changed();
  say("");
  if (moves && !matchMedia("(prefers-reduced-motion: reduce)").matches) timeLine.play();
}
