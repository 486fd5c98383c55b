// Clouds and voxels: many points, coloured and cut in the shader.

import { BufferAttribute, BufferGeometry, GLSL3, Matrix4, Points, RawShaderMaterial } from "three";
import { ratio } from "mapper/screen";

export const NEVER = 1023; // the time of the first hit of a point that no voxel's hit explains
export const HITS_PER_OCTAVE = 16;
export const POINTS_LAYER = 1; // of the camera: points are rendered before everything else
const UNSEEN = [115, 115, 115];
const SMALLEST_PX = 1.5, LARGEST_PX = 40;

// Little is worked out per point: where a processor draws in place of a graphics card, that is most of the time.
const VERTEX = `
precision highp float;
uniform mat4 toClip;
uniform float cut, floor, until, size, least, most, ratio;
in vec4 position;
in vec3 shade;
flat out vec3 color;

void main() {
  gl_Position = toClip * vec4(position.xyz, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, least * ratio, most * ratio);
  if (position.z > cut || position.z < floor || position.w > until) gl_Position.w = -1.0;
  color = shade;
}`;

const FRAGMENT = `
precision mediump float;
flat in vec3 color;
out vec4 painted;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  painted = vec4(color, 1.0);
}`;

const SQUARE = `
precision mediump float;
flat in vec3 color;
out vec4 painted;
void main() {
  vec2 off = abs(gl_PointCoord - 0.5);
  painted = vec4(max(off.x, off.y) > 0.42 ? 0.84 * color : color, 1.0);
}`;

export class PointSet {
  /**
   * @param decoded Of decodedPoints.
   * @param options.edge_m Edge of the voxel that a point stands for.
   * @param options.isSquare Draw the rims of what is large enough.
   */
  constructor(decoded, { edge_m, isSquare }) {
    Object.assign(this, decoded);
    this.edge_m = edge_m;
    this.shades = new Uint8Array(4 * this.count);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(this.places, 4));
    geometry.setAttribute("shade", new BufferAttribute(this.shades, 4, true));
    this.uniforms = {
      toClip: { value: new Matrix4() }, cut: { value: Infinity }, floor: { value: -Infinity }, until: { value: NEVER }, size: { value: 1 },
      least: { value: SMALLEST_PX }, most: { value: LARGEST_PX }, ratio,
    };
    this.object = new Points(geometry, new RawShaderMaterial({
      glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: isSquare ? SQUARE : FRAGMENT, uniforms: this.uniforms,
    }));
    this.object.frustumCulled = false;
    this.object.layers.set(POINTS_LAYER);
    this.toWorld = new Matrix4().makeScale(this.step, this.step, this.step).setPosition(...this.low);
  }

  /** Colour all points: by "height", "color", "time", "hits", or by the colour of the "run". */
  paint(coloring, [low, high], { ramp, runColor }) {
    const { places, tints, shades, count } = this, last = ramp.length - 1;
    for (let i = 0; i < 4 * count; i += 4) {
      let rgb = UNSEEN;
      const height = this.low[2] + this.step * places[i + 2];
      const value = coloring === "time" ? places[i + 3] : coloring === "hits" ? tints[i + 3] : height;
      const share = Math.max(0, Math.min(1, (value - low) / (high - low || 1)));
      if (coloring === "color") {
        shades[i] = tints[i]; shades[i + 1] = tints[i + 1]; shades[i + 2] = tints[i + 2];
        continue;
      }
      if (coloring === "run") rgb = runColor.map((channel) => channel * (0.45 + 0.55 * share));
      else if (!(coloring === "time" && value === NEVER) && !(coloring === "hits" && value === 0)) rgb = ramp[Math.round(share * last)];
      shades[i] = rgb[0]; shades[i + 1] = rgb[1]; shades[i + 2] = rgb[2];
    }
    this.object.geometry.attributes.shade.needsUpdate = true;
  }

  /** Hide what is higher than cut_m, outside of the heights kept_m, or was first seen later than at a step of the time. */
  hide({ cut_m, kept_m: [low_m, high_m], until }) {
    Object.assign(this, { low_m, high_m: Math.min(cut_m, high_m), until });
    this.uniforms.cut.value = (this.high_m - this.low[2]) / this.step;
    this.uniforms.floor.value = (low_m - this.low[2]) / this.step;
    this.uniforms.until.value = until >= NEVER - 1 ? NEVER : until;
  }

  /** Fit to a camera. @param pixels Pixels per metre at a distance of one metre. @param share Of the points, evenly spread. */
  fit(camera, { pixels, scale, share }) {
    this.uniforms.toClip.value.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).multiply(this.toWorld);
    this.uniforms.size.value = this.edge_m * this.sparsity * scale * pixels / Math.sqrt(share);
    this.object.geometry.setDrawRange(0, Math.ceil(share * this.count));
  }

  /** Lowest and highest value, all but a few stray ones; of no points the lowest is the higher. */
  spread(read) {
    const values = [], stride = Math.max(1, Math.floor(this.count / 20000));
    for (let i = 0; i < this.count; i += stride) values.push(read(this, i));
    values.sort((a, b) => a - b);
    if (!values.length) return [Infinity, -Infinity];
    return [values[Math.floor(0.02 * (values.length - 1))], values[Math.ceil(0.98 * (values.length - 1))]];
  }

  at(index, into) {
    const { places, low, step } = this;
    return into.set(low[0] + step * places[4 * index], low[1] + step * places[4 * index + 1], low[2] + step * places[4 * index + 2]);
  }

  isShown(index) {
    const { places, low, step } = this, height = low[2] + step * places[4 * index + 2];
    return height <= this.high_m && height >= this.low_m && places[4 * index + 3] <= this.uniforms.until.value;
  }
}
