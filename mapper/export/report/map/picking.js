// What lies below the pointer: all is compared on the screen.

import { Matrix4, Vector3 } from "three";

const REACH_PX = 12;
const POINT_REACH_PX = 8;

/** Projection of a camera onto a part of the screen, both in CSS pixels. */
export class Screen {
  constructor(camera, { left, width, height }) {
    this.matrix = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    Object.assign(this, { left, width, height, place: new Vector3() });
  }

  /** The point of the plane at a height that is seen at a place, as a Vector3; null above the horizon. */
  onPlane(x, y, height_m) {
    const inverse = this.matrix.clone().invert();
    const [from, to] = [-1, 1].map((z) => new Vector3(2 * (x - this.left) / this.width - 1, 1 - 2 * y / this.height, z).applyMatrix4(inverse));
    const share = (height_m - from.z) / (to.z - from.z);
    return share > 0 && share < 1 ? from.lerp(to, share) : null;
  }

  /** Pixels and depth of a point in the world; null behind the eye. */
  of(place) {
    const { elements: m } = this.matrix, { x, y, z } = place;
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (w <= 0) return null;
    return [
      this.left + (0.5 + 0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12]) / w) * this.width,
      (0.5 - 0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * this.height,
      w,
    ];
  }
}

/** The frame whose mark is nearest to the pointer; null if none is near. */
export function frameAt(layers, frames, screen, x, y) {
  let best = null, least = REACH_PX;
  for (const frame of frames) {
    const place = screen.of(layers.placeOf(frame, screen.place));
    const miss = place ? Math.hypot(place[0] - x, place[1] - y) : Infinity;
    if (miss < least) { least = miss; best = frame; }
  }
  return best;
}

/** The loop whose line is nearest to the pointer; null if none is near. */
export function loopAt(loops, screen, x, y) {
  let best = null, least = REACH_PX / 2;
  for (const loop of loops) {
    const [a, b] = loop.ends.map((end) => screen.of({ x: end[0], y: end[1], z: end[2] }));
    if (!a || !b) continue;
    const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
    const share = Math.max(0, Math.min(1, ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy || 1)));
    const miss = Math.hypot(a[0] + share * dx - x, a[1] + share * dy - y);
    if (miss < least) { least = miss; best = loop; }
  }
  return best;
}

/** The point of a cloud that is seen below the pointer, as a Vector3; null if there is none. */
export function pointAt(points, screen, x, y) {
  const at = new Vector3();
  let best = -1, least = Infinity;
  for (let i = 0; i < points.count; i++) {
    const place = screen.of(points.at(i, screen.place));
    if (!place) continue;
    const miss = Math.hypot(place[0] - x, place[1] - y);
    if (miss > POINT_REACH_PX || !points.isShown(i)) continue;
    const rank = place[2] * (1 + 0.02 * miss); // the nearest surface wins; of that the nearest point
    if (rank < least) { least = rank; best = i; }
  }
  return best < 0 ? null : points.at(best, at);
}
