// The scene of all runs, drawn when something has changed: over each other, or side by side.

import { Box3, ColorManagement, Group, LinearSRGBColorSpace, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import { Budget } from "mapper/budget";
import { groundLines } from "mapper/ground";
import { NEVER, POINTS_LAYER, PointSet } from "mapper/points";
import { Navigation } from "mapper/navigation";
import { ratio } from "mapper/screen";
import { frameAt, loopAt, pointAt, Screen } from "mapper/picking";
import { Shading } from "mapper/shading";

const FOV_DEG = 50;
const COARSE_SHARE = 0.3; // a motion that begins with fewer points is drawn with pixels twice as large
const REST_MS = 150; // after a motion all points are drawn again
const HELD_REST_MS = 600; // the same while the pointer is held down, as the motion may go on

ColorManagement.enabled = false; // colours are drawn as the palette has them

export class MapView {
  /** Throws where the browser has no WebGL. */
  constructor(canvas, layers, ramp) {
    Object.assign(this, { canvas, layers, ramp });
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.renderer.setClearColor(getComputedStyle(canvas).backgroundColor);
    this.camera = new PerspectiveCamera(FOV_DEG, 1, 0.01, 1000);
    this.scene = new Scene();
    this.tools = new Scene(); // drawn over every run: what is measured, edits
    this.drawn = {};
    this.shading = new Shading();
    this.onRest = []; // called when all of it is drawn
    this.shown = layers.map(() => true);
    this.state = { points: "cloud", coloring: "height", isBeside: false, cut_m: Infinity, kept_m: [-Infinity, Infinity], until: NEVER, size: 1, isShaded: true, hasGrid: true, hidesMaps: false };
    this.hidden = new Set();
    this.budget = new Budget();
    for (const one of layers) this.scene.add(one.group);
    this.hasOwnWorlds = layers.some(({ run }) => run.world !== layers[0].run.world); // then each is seen as if it lay where the first lies
    this.boxes = layers.map((one) => boxOf([one]));
    this.box = this.hasOwnWorlds ? this.boxes[0] : boxOf(layers);
    this.navigation = new Navigation(this.camera, canvas, () => this.#moved());
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
    this.navigation.lookAt(this.box);
    if (this.hasOwnWorlds) this.boxes.forEach((box, run) => this.draw(`ground${run}`, groundLines(box), { isOver: false, isGround: true, run }));
    else this.draw("ground", groundLines(this.box), { isOver: false, isGround: true });
    this.update({});
    requestAnimationFrame((now) => this.#tick(now));
  }

  /** Change what is shown; names as in state. */
  update(changes) {
    Object.assign(this.state, changes);
    const { points: kind, coloring } = this.state, range = this.range();
    const isRepainted = ["points", "coloring"].some((name) => name in changes);
    this.layers.forEach((one, run) => {
      one.group.visible = this.shown[run];
      for (const [id, set] of Object.entries(one.points)) {
        set.object.visible = id === kind && !this.state.hidesMaps;
        set.hide(this.state);
        if (isRepainted && id === kind) set.paint(coloring, range, { ramp: this.ramp, runColor: one.runColor });
      }
      for (const [id, object] of Object.entries(one.objects)) object.visible = !this.hidden.has(id);
    });
    this.invalidate();
  }

  /** Layers that have a map of their own; a run of a merged map has none. */
  get mapped() {
    return this.layers.filter(({ cells }) => cells);
  }

  /** Lowest and highest value of the colouring, over all runs. */
  range() {
    const { points, coloring } = this.state;
    const key = coloring === "time" || coloring === "hits" ? coloring : "height";
    const ranges = this.layers.map((one) => one.ranges(points)[key]);
    const low = Math.min(...ranges.map(([low]) => low)), high = Math.max(...ranges.map(([, high]) => high));
    return low <= high ? [low, high] : [0, 1];
  }

  async showLayer(height_m) {
    const asked = this.askedLayers = (this.askedLayers ?? 0) + 1;
    this.canvas.setAttribute("aria-busy", "true");
    await Promise.all(this.layers.map((one) => one.showLayer(height_m)));
    this.invalidate();
    if (asked === this.askedLayers) this.canvas.setAttribute("aria-busy", "false");
  }

  /** Draw lines and marks over every run, or points and lines below, in place of those of the same name. */
  draw(name, shapes, { isOver = true, isGround = false, run = null } = {}) {
    this.drawn[name]?.group.removeFromParent();
    const group = new Group();
    for (const { object } of shapes) group.add(object);
    this.drawn[name] = { group, shapes, run, isGround };
    if (!isOver) group.renderOrder = -1;
    (isOver ? this.tools : this.scene).add(group);
    this.invalidate();
  }

  frameAt(x, y) {
    return this.#pick(x, y, (one, screen) => {
      const frame = this.hidden.has("keyframes") ? null : frameAt(one, one.frames, screen, x, y);
      return frame && { layers: one, frame };
    });
  }

  loopAt(x, y) {
    return this.#pick(x, y, (one, screen) => {
      const shown = Object.entries(one.loops).filter(([id]) => !this.hidden.has(id)).flatMap(([, loops]) => loops);
      const loop = loopAt(shown, screen, x, y);
      return loop && { layers: one, loop };
    });
  }

  /** The point at a height that is seen at a place. */
  planeAt(x, y, height_m) {
    const pane = this.#panes().findLast(({ left }) => x >= left);
    return new Screen(pane.camera, pane).onPlane(x, y, height_m);
  }

  pointAt(x, y) {
    return this.#pick(x, y, (one, screen) => pointAt(one.points[this.state.points], screen, x, y));
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    this.renderer.setSize(width, height, false);
    this.#aspect();
    this.invalidate();
  }

  /** Have it drawn anew; until that is on the screen, the canvas tells no share of the points. */
  invalidate() {
    this.isStale = true;
    this.canvas.dataset.share = "";
  }

  #moved() {
    this.camera.updateMatrixWorld(); // the points are placed by its inverse before three.js renders
    this.movedAt = performance.now();
    this.hasMoved = true;
    this.invalidate();
  }

  /** Parts of the canvas, in CSS pixels, with the runs that each shows. */
  #panes() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const runs = this.layers.map((_, run) => run).filter((run) => this.shown[run]);
    const cameraOf = (run) => this.hasOwnWorlds ? this.#cameraAt(run) : this.camera;
    if (runs.length < 2) return [{ left: 0, width, height, runs, camera: runs.length ? cameraOf(runs[0]) : this.camera }];
    if (!this.state.isBeside) return [{ left: 0, width, height, runs, camera: this.camera }];
    const each = width / runs.length;
    return runs.map((run, i) => ({ left: i * each, width: each, height, runs: [run], camera: cameraOf(run) }));
  }

  /** The camera as it sees a run of another world: at the same place relative to that run's box. */
  #cameraAt(run) {
    const camera = this.camera.clone(), [from, to] = [this.box, this.boxes[run]].map((box) => box.getCenter(new Vector3()));
    const scale = this.boxes[run].getSize(new Vector3()).length() / this.box.getSize(new Vector3()).length();
    camera.position.sub(from).multiplyScalar(scale).add(to);
    Object.assign(camera, { near: camera.near * scale, far: camera.far * scale });
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    return camera;
  }

  #pick(x, y, find) {
    for (const pane of this.#panes()) {
      if (x < pane.left || x >= pane.left + pane.width) continue;
      const screen = new Screen(pane.camera, pane);
      for (const run of pane.runs) {
        const found = find(this.layers[run], screen);
        if (found) return found;
      }
    }
    return null;
  }

  #aspect() {
    const { clientWidth: width, clientHeight: height } = this.canvas, count = this.shown.filter(Boolean).length;
    this.camera.aspect = width / (this.state.isBeside ? Math.max(count, 1) : 1) / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
  }

  #tick(now) {
    requestAnimationFrame((next) => this.#tick(next));
    this.navigation.advance(Math.min(now - (this.tickedAt ?? now), 100) / 1000);
    this.tickedAt = now;
    const rest_ms = this.navigation.isHeld ? HELD_REST_MS : REST_MS;
    const isMoving = this.hasMoved || now - (this.movedAt ?? -Infinity) < rest_ms; // a slow frame may outlast the rest
    if (this.fence && !this.#isFinished(now)) return;
    if (!isMoving) this.isCoarse = false;
    else if (!this.wasMoving) this.isCoarse = this.budget.share < COARSE_SHARE;
    this.wasMoving = isMoving;
    const share = isMoving ? this.budget.share : 1;
    if (!this.isStale && (isMoving || share === this.drawnShare)) return;
    this.hasMoved = false;
    this.#sharpen(Math.min(devicePixelRatio, 2) * (this.isCoarse ? 0.5 : 1));
    this.#draw(share, now);
  }

  /** Return whether the last frame is drawn, and learn how long that took. */
  #isFinished(now) {
    const gl = this.renderer.getContext();
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    const points = this.layers.reduce((sum, one) => sum + one.points[this.state.points].count, 0);
    if (this.hasShaders) this.budget.learn(this.drawnShare, now - this.drawnAt, points);
    this.hasShaders = true; // which the first frame has waited for
    if (this.isStale) return true;
    this.canvas.dataset.share = this.drawnShare;
    if (this.drawnShare === 1) for (const told of this.onRest) told();
    return true;
  }

  /** Return the picture of all points as a PNG. */
  picture() {
    this.#draw(1, performance.now());
    return new Promise((done) => { this.canvas.toBlob(done); });
  }

  /** Metres of a pixel at the point that is looked at. */
  get metresPerPixel() {
    const { camera, navigation } = this, distance = camera.position.distanceTo(navigation.orbit.target);
    return 2 * distance * Math.tan(camera.fov * Math.PI / 360) / this.canvas.clientHeight;
  }

  #sharpen(pixels) {
    if (this.renderer.getPixelRatio() !== pixels) this.renderer.setPixelRatio(pixels);
    ratio.value = pixels;
  }

  #draw(share, now) {
    this.isStale = false;
    this.drawnShare = share;
    this.drawnAt = now;
    this.#aspect();
    const { renderer } = this;
    const panes = this.#panes();
    renderer.setScissorTest(panes.length > 1);
    renderer.autoClear = false;
    renderer.clear();
    for (const pane of panes) {
      const { camera } = pane;
      renderer.setViewport(pane.left, 0, pane.width, pane.height);
      renderer.setScissor(pane.left, 0, pane.width, pane.height);
      const pixels = ratio.value * pane.height / (2 * Math.tan(camera.fov * Math.PI / 360));
      this.layers.forEach((one, run) => {
        one.group.visible = pane.runs.includes(run);
        for (const set of Object.values(one.points)) set.fit(camera, { pixels, scale: this.state.size, share });
        for (const segments of Object.values(one.segments)) this.#fit(segments, pane, pixels);
      });
      for (const { group, shapes, run, isGround } of Object.values(this.drawn)) {
        if (isGround) group.visible = this.state.hasGrid && (run === null || pane.runs.includes(run));
        for (const shape of shapes) {
          if (shape instanceof PointSet) shape.fit(camera, { pixels, scale: this.state.size, share: 1 });
          else if (shape.uniforms) this.#fit(shape, pane, pixels);
        }
      }
      camera.layers.set(POINTS_LAYER);
      if (this.state.isShaded && !this.isCoarse) this.shading.render(renderer, this.scene, camera, pane);
      else renderer.render(this.scene, camera);
      camera.layers.set(0);
      renderer.render(this.scene, camera);
      renderer.render(this.tools, camera);
    }
    const gl = renderer.getContext();
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  #fit({ uniforms }, { width, height }, pixels) {
    uniforms.viewport.value.set(width * ratio.value, height * ratio.value);
    uniforms.pixels.value = pixels;
  }
}

/** Around the paths and all but a few stray points of some runs. */
function boxOf(layers) {
  const box = new Box3(), at = new Vector3();
  for (const one of layers) {
    const { cloud } = one.points, axes = [0, 1, 2].map((axis) => cloud.spread((set, i) => set.low[axis] + set.step * set.places[4 * i + axis]));
    if (cloud.count) box.expandByPoint(at.fromArray(axes.map(([low]) => low))).expandByPoint(at.fromArray(axes.map(([, high]) => high)));
    const { x, y, z } = one.run.path;
    for (let i = 0; i < x.length; i++) box.expandByPoint(at.set(x[i], y[i], z[i]));
  }
  return box;
}
