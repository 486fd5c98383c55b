// The floor's grid, with its axes at the origin, and round lengths.

import { Color } from "three";
import { Segments } from "mapper/lines";

const CELLS = 12; // across the map, about
const AXES = ["#ff5a4d", "#5fc75f", "#5a9bff"]; // x, y, z

/** The largest of 1, 2, 5, 10 … that is no more than a length. */
export function roundLength(length) {
  const decade = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].find((step) => step * decade <= length * 1.0001) * decade;
}

/** Lines of the floor below a box, z = 0, and the axes. */
export function groundLines({ min, max }) {
  const reach = Math.max(max.x - min.x, max.y - min.y, 1e-3), step = roundLength(2 * reach / CELLS), ends = [];
  const [left, right, low, high] = [Math.floor(min.x / step), Math.ceil(max.x / step), Math.floor(min.y / step), Math.ceil(max.y / step)];
  for (let i = left; i <= right; i++) ends.push(i * step, low * step, 0, i * step, high * step, 0);
  for (let i = low; i <= high; i++) ends.push(left * step, i * step, 0, right * step, i * step, 0);
  const axis = (color, i) => new Segments([0, 0, 0, ...[0, 1, 2].map((k) => k === i ? step : 0)], { color: new Color(color), width_px: 3 });
  return [new Segments(ends, { color: new Color("#2c313b"), width_px: 1, isHidden: true }), ...AXES.map(axis)];
}
