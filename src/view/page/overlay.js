// What is drawn over the picture: input cameras and control points.

import { add, placed, project, rotated, scaled } from "./camera.js";

const MOST_CAMERAS = 200;
const NEAR_CLICK = 16;

export class Overlay {
  constructor(canvas, cameras, size) {
    this.canvas = canvas;
    this.size = size;
    const step = Math.ceil(cameras.length / MOST_CAMERAS);
    this.frusta = cameras
      .map((known, index) => ({ index, known }))
      .filter(({ index }) => index % Math.max(step, 1) === 0)
      .map(({ index, known }) => ({ index, time: known.time, lines: this.lines(known.camera) }));
  }

  // The centre and the four corners of a camera's picture at some depth.
  lines(camera) {
    const { rotation, centre } = placed(camera);
    const corner = ([x, y]) => {
      const ray = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1];
      return add(centre, rotated(rotation, scaled(ray, this.size)));
    };
    const { width, height } = camera;
    return [centre, ...[[0, 0], [width, 0], [width, height], [0, height]].map(corner)];
  }

  // Over a picture of a camera at a time; `shows` tells what.
  draw(camera, time, points, shows) {
    const ratio = Math.min(devicePixelRatio, 2);
    const width = Math.round(this.canvas.clientWidth * ratio);
    const height = Math.round(this.canvas.clientHeight * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    const across = width / camera.width;
    const down = height / camera.height;
    this.places = [];
    const at = (point) => {
      const [x, y, depth] = project(camera, point);
      return depth > 1e-3 * this.size ? [x * across, y * down] : null;
    };
    if (shows.cameras) this.drawCameras(context, at, time, ratio);
    if (shows.points) drawPoints(context, at, points, ratio);
  }

  drawCameras(context, at, time, ratio) {
    const nearest = nearestIn(this.frusta, time);
    for (const frustum of this.frusta) {
      const [centre, ...corners] = frustum.lines.map(at);
      if (!centre || corners.includes(null)) continue;
      this.places.push({ index: frustum.index, x: centre[0] / ratio, y: centre[1] / ratio });
      const path = new Path2D();
      corners.forEach((corner, i) => {
        path.moveTo(...centre);
        path.lineTo(...corner);
        path.lineTo(...corners[(i + 1) % 4]);
      });
      stroke(context, path, frustum === nearest ? "#ffb000" : "#4cc9ff", ratio);
    }
  }

  // The input camera at a place of the canvas, in CSS pixels.
  hit(x, y) {
    const distance = (place) => Math.hypot(place.x - x, place.y - y);
    const [best] = (this.places ?? []).sort((a, b) => distance(a) - distance(b));
    return best && distance(best) < NEAR_CLICK ? best.index : null;
  }
}

export function nearestIn(cameras, time) {
  const away = (camera) => Math.abs(camera.time - time);
  return cameras.reduce((best, c) => (best && away(best) <= away(c) ? best : c), undefined);
}

// Light on dark, to be seen on any picture.
function stroke(context, path, colour, ratio) {
  context.strokeStyle = "rgb(0 0 0 / 0.6)";
  context.lineWidth = 3 * ratio;
  context.stroke(path);
  context.strokeStyle = colour;
  context.lineWidth = 1.25 * ratio;
  context.stroke(path);
}

function drawPoints(context, at, points, ratio) {
  context.fillStyle = "#ffe14d";
  context.strokeStyle = "#000";
  context.lineWidth = ratio;
  for (let i = 0; i < points.length; i += 4) {
    if (points[i + 3] === 0) continue;
    const place = at(points.subarray(i, i + 3));
    if (!place) continue;
    context.beginPath();
    context.arc(...place, 3 * ratio, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
  }
}
