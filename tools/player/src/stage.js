// The scene on a canvas, as a camera sees it at a time.

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Color, PerspectiveCamera, SRGBColorSpace, Scene, WebGLRenderer } from "three";
import { placed } from "../../../src/view/page/camera.js";
import { Skinned } from "./skinned.js";

// Spark's limits that ours do not have: half sides in pixels, and how far outside of the picture a centre
// may lie.
const ANY_SIZE = 16384;
const ANYWHERE = 1e6;
// A cut of 0 would make splats endless.
const LEAST_CUT = 1e-4;

export class Stage {
  // onDirty: something is to be drawn, since splats are in another order now.
  constructor(canvas, scene, onDirty) {
    this.canvas = canvas;
    this.source = new Skinned(scene);
    this.near = scene.settings.near;
    this.renderer = new WebGLRenderer({ canvas, antialias: false, depth: false, alpha: false });
    this.renderer.setClearColor(new Color().setRGB(...scene.background, SRGBColorSpace));
    const { dilation } = scene.settings;
    const alphaCut = Math.max(scene.settings.alpha_cut, LEAST_CUT);
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty,
      accumExtSplats: true,
      enableLod: false,
      sortRadial: false,
      preBlurAmount: dilation,
      blurAmount: 0,
      minAlpha: alphaCut,
      maxStdDev: Math.sqrt(2 * Math.log(1 / alphaCut)),
      maxPixelRadius: ANY_SIZE,
      clipXY: ANYWHERE,
    });
    // Spark draws every splat as wide as an opaque one; what lies outside of the cut it throws away.
    const wide = "adjustedStdDev = maxStdDev;";
    if (!this.spark.material.vertexShader.includes(wide)) throw new Error("this is not the Spark that the player is made for");
    this.spark.material.vertexShader = this.spark.material.vertexShader.replace(
      wide,
      "adjustedStdDev = min(maxStdDev, sqrt(2.0 * log(max(rgba.a / minAlpha, 1.0))));",
    );
    this.mesh = new SplatMesh({ splats: this.source, editable: false, raycastable: false });
    this.world = new Scene();
    this.world.add(this.spark, this.mesh);
    this.camera = new PerspectiveCamera();
    this.time = 0;
  }

  // Pixels of the picture.
  resize(width, height) {
    if (this.canvas.width !== width || this.canvas.height !== height) this.renderer.setSize(width, height, false);
  }

  setTime(time) {
    if (time === this.time) return;
    this.time = time;
    this.source.setTime(time);
    if (this.source.movers > 0) this.mesh.updateVersion();
  }

  // A camera's axes are OpenCV's, those of three.js are turned about x by half a turn.
  look(camera) {
    const seen = JSON.stringify(camera);
    // Left to itself, Spark sorts anew only after a step of a thousandth of a unit, whatever the scene's size.
    if (seen !== this.seen) this.mesh.updateVersion();
    this.seen = seen;
    const { rotation: [w, x, y, z], centre } = placed(camera);
    this.camera.position.set(...centre);
    this.camera.quaternion.set(w, z, -y, -x);
    this.camera.updateMatrixWorld();
    const { fx, fy, cx, cy, width, height } = camera;
    const n = this.near;
    // Without a far plane.
    this.camera.projectionMatrix.set(
      (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
      0, (2 * fy) / height, (2 * cy) / height - 1, 0,
      0, 0, -1, -2 * n,
      0, 0, -1, 0,
    );
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
  }

  draw() {
    this.renderer.render(this.world, this.camera);
  }

  // Draws when the splats of this camera and time are in order.
  async drawSorted() {
    const { spark } = this;
    spark.autoUpdate = false;
    await this.idle();
    await spark.update({ scene: this.world, camera: this.camera });
    await this.idle();
    this.draw();
    spark.autoUpdate = true;
  }

  async idle() {
    const { spark } = this;
    while (spark.sorting || spark.sortDirty) await new Promise((resolve) => setTimeout(resolve, 1));
  }

  // The pixels drawn last, rows from the top.
  read() {
    const gl = this.renderer.getContext();
    const { width, height } = this.canvas;
    const bytes = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    const image = new ImageData(width, height);
    for (let row = 0; row < height; row++) {
      image.data.set(bytes.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    }
    return image;
  }
}
