// What one run shows in the scene: points, voxels, a layer of cells, the path and all that belongs to it.

import {
  Color, ConeGeometry, DataTexture, DoubleSide, Group, InstancedMesh, Matrix4, Mesh, MeshBasicMaterial, NearestFilter,
  PlaneGeometry, Quaternion, Vector3,
} from "three";
import { decodedPoints, Layers } from "mapper/decoding";
import { Segments, successive } from "mapper/lines";
import { Markers } from "mapper/markers";
import { HITS_PER_OCTAVE, NEVER, PointSet } from "mapper/points";

const CELL_COLORS = [[0, 0, 0, 0], [64, 74, 92, 150], [242, 244, 248, 255]]; // unknown, free, occupied
const ARROWS = 14; // along a path

export class RunLayers {
  /** @param run Path, truth and loops. @param map Points, voxels, layers and keyframes. */
  static async decoded(run, map, colors) {
    const kind = { isObserved: map.is_observed };
    const cloud = await decodedPoints(map.cloud, { ...kind, hasColors: map.cloud.has_colors });
    const voxels = await decodedPoints(map.voxels, { ...kind, hasColors: false });
    return new RunLayers(run, map, { cloud, voxels }, colors);
  }

  constructor(run, map, decoded, colors) {
    Object.assign(this, { run, map, name: run.name, frames: map.frames });
    this.group = new Group();
    this.runColor = new Color(colors.run).toArray().map((channel) => 255 * channel);
    this.points = {
      cloud: new PointSet(decoded.cloud, { edge_m: map.cloud.edge_m, isSquare: false }),
      voxels: new PointSet(decoded.voxels, { edge_m: map.voxels.edge_m, isSquare: true }),
    };
    this.cells = map.layers && new Layers(map.layers); // a run of a merged map has no map of its own
    this.slice = this.cells && this.#slice();
    this.segments = this.#segments(colors);
    this.loops = {
      accepted: run.loops.filter((loop) => loop.ends && loop.verdict === "accepted"),
      rejected: run.loops.filter((loop) => loop.ends && loop.verdict === "rejected"),
    };
    for (const [id, loops] of Object.entries(this.loops))
      this.segments[id] = new Segments(loops.flatMap((loop) => loop.ends.flat()), { color: new Color(colors[id]), width_px: 2 });
    this.objects = this.#objects(colors);
    this.group.add(this.points.cloud.object, this.points.voxels.object, ...Object.values(this.objects));
    if (this.slice) this.group.add(this.slice);
    const order = ["band", "truth", "rejected", "accepted", "path", "doubtful", "keyframes", "ends"];
    order.forEach((id, i) => this.objects[id]?.traverse((object) => { object.renderOrder = 2 + i; }));
  }

  /** Lowest and highest value of each colouring. */
  ranges(shown) {
    const points = this.points[shown];
    return {
      height: points.spread((set, i) => set.low[2] + set.step * set.places[4 * i + 2]),
      time: [0, NEVER - 1],
      hits: [HITS_PER_OCTAVE, Math.max(points.spread((set, i) => set.tints[4 * i + 3])[1], HITS_PER_OCTAVE + 1)],
    };
  }

  get duration_s() {
    const { t } = this.run.path;
    return t.length ? t[t.length - 1] - t[0] : 0;
  }

  placeOf(frame, into) {
    const { x, y, z } = this.run.path;
    return into.set(x[frame.pose], y[frame.pose], z[frame.pose]);
  }

  /** Show the cells at a height, or none. */
  async showLayer(height_m) {
    if (!this.cells) return;
    const index = height_m === null ? -1 : this.cells.indexAt(height_m);
    if (index === this.shownLayer) return;
    this.shownLayer = index;
    const cells = await this.cells.cells(index);
    if (index !== this.shownLayer) return; // another one was asked for meanwhile
    this.slice.visible = cells !== null;
    if (cells === null) return;
    const { image } = this.slice.material.map;
    for (let i = 0; i < cells.length; i++) image.data.set(CELL_COLORS[cells[i]], 4 * i);
    this.slice.material.map.needsUpdate = true;
    this.slice.position.z = this.cells.low[2] + (index + 0.5) * this.cells.edge_m;
  }

  #slice() {
    const { low, edge_m, shape: [width, height] } = this.cells;
    const texture = new DataTexture(new Uint8Array(4 * width * height), width, height);
    texture.minFilter = texture.magFilter = NearestFilter;
    const material = new MeshBasicMaterial({ map: texture, transparent: true, side: DoubleSide, depthWrite: false });
    const plane = new Mesh(new PlaneGeometry(width * edge_m, height * edge_m), material);
    plane.position.set(low[0] + 0.5 * width * edge_m, low[1] + 0.5 * height * edge_m, 0);
    plane.renderOrder = 1;
    plane.visible = false;
    return plane;
  }

  #segments(colors) {
    const { path, truth } = this.run, band = path.band_m;
    const made = { path: new Segments(successive(path), { color: new Color(colors.run), width_px: 3 }) };
    if (truth) made.truth = new Segments(successive(truth), { color: new Color(colors.truth), width_px: 2 });
    if (path.doubtful.includes(true))
      made.doubtful = new Segments(
        successive(path, (i) => path.doubtful[i] || path.doubtful[i + 1]), { color: new Color(colors.doubtful), width_px: 5 },
      );
    if (band) {
      const isKnown = (i) => band[i] !== null && band[i + 1] !== null, halfWidths = [];
      for (let i = 0; i + 1 < band.length; i++) if (isKnown(i)) halfWidths.push(band[i], band[i + 1]);
      made.band = new Segments(successive(path, isKnown), { color: new Color(colors.run), width_px: 0, halfWidths, opacity: 0.3 });
    }
    return made;
  }

  #objects(colors) {
    const { path } = this.run, last = path.x.length - 1;
    const placesOf = (frames) => frames.flatMap(({ pose }) => [path.x[pose], path.y[pose], path.z[pose]]);
    const objects = Object.fromEntries(Object.entries(this.segments).map(([id, { object }]) => [id, object]));
    const keyframes = this.frames.filter((frame) => frame.node !== null);
    if (keyframes.length) objects.keyframes = new Markers(placesOf(keyframes), { color: new Color(colors.run), size_px: 7 }).object;
    const doubtful = this.frames.filter((frame) => path.doubtful[frame.pose]);
    if (doubtful.length) {
      const marks = new Markers(placesOf(doubtful), { color: new Color(colors.doubtful), size_px: 11 }).object;
      objects.doubtful = objects.doubtful ? new Group().add(objects.doubtful, marks) : marks;
    }
    if (last < 0) return objects; // the voxels of a merged map have no path of their own
    objects.ends = new Group().add(
      new Markers([path.x[last], path.y[last], path.z[last]], { color: new Color(colors.end), size_px: 16, isSquare: true }).object,
      new Markers([path.x[0], path.y[0], path.z[0]], { color: new Color(colors.start), size_px: 16 }).object,
      this.#arrows(colors),
    );
    return objects;
  }

  /** Diagonal of the box around the path, metres. */
  #reach() {
    const { x, y, z } = this.run.path;
    return Math.hypot(...[x, y, z].map((axis) => axis.reduce((a, b) => Math.max(a, b)) - axis.reduce((a, b) => Math.min(a, b))));
  }

  /** Cones that tell which way the path goes. */
  #arrows(colors) {
    const { x, y, z } = this.run.path, lengths = [0];
    for (let i = 1; i < x.length; i++) lengths.push(lengths[i - 1] + Math.hypot(x[i] - x[i - 1], y[i] - y[i - 1], z[i] - z[i - 1]));
    const total = lengths[lengths.length - 1], size = Math.min(total / 60, this.#reach() / 40);
    const cones = new InstancedMesh(new ConeGeometry(0.35, 1, 10), new MeshBasicMaterial({ color: colors.run, transparent: true, depthTest: false }), ARROWS);
    const up = new Vector3(0, 1, 0), turn = new Quaternion(), at = new Vector3(), ahead = new Vector3();
    let next = 1;
    for (let arrow = 0; arrow < ARROWS; arrow++) {
      const reach = (arrow + 0.5) * total / ARROWS;
      while (next < x.length - 1 && lengths[next] < reach) next++;
      const before = Math.max(next - 1, 0);
      ahead.set(x[next] - x[before], y[next] - y[before], z[next] - z[before]).normalize();
      turn.setFromUnitVectors(up, ahead);
      cones.setMatrixAt(arrow, new Matrix4().compose(at.set(x[next], y[next], z[next]), turn, new Vector3(size, size, size)));
    }
    cones.frustumCulled = false;
    cones.visible = total > 0;
    return cones;
  }
}
