// Lines of any width: WebGL's own are one pixel wide.

import { BufferAttribute, DoubleSide, GLSL3, InstancedBufferAttribute, InstancedBufferGeometry, Mesh, RawShaderMaterial, Vector2 } from "three";
import { ratio } from "mapper/screen";

const VERTEX = `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform vec2 viewport;
uniform float pixels, width, ratio;
in vec3 position, begin, end;
in vec2 halfWidths;
out float along;

void main() {
  vec4 a = modelViewMatrix * vec4(begin, 1.0), b = modelViewMatrix * vec4(end, 1.0);
  const float near = -0.02; // a segment that passes the eye is cut in front of it
  if (a.z > near && b.z < near) a = mix(a, b, (near - a.z) / (b.z - a.z));
  if (b.z > near && a.z < near) b = mix(b, a, (near - b.z) / (a.z - b.z));
  vec4 from = projectionMatrix * a, to = projectionMatrix * b;
  vec2 direction = (to.xy / to.w - from.xy / from.w) * viewport;
  direction = length(direction) > 1e-6 ? normalize(direction) : vec2(1.0, 0.0);
  vec4 place = position.x < 0.5 ? from : to;
  float metres = position.x < 0.5 ? halfWidths.x : halfWidths.y;
  float reach = max(metres * pixels / place.w, width * ratio);
  vec2 side = vec2(-direction.y, direction.x) * position.y + direction * (position.x * 2.0 - 1.0) * 0.5;
  place.xy += side * reach * 2.0 / viewport * place.w;
  gl_Position = a.z > near && b.z > near ? vec4(2.0, 2.0, 2.0, 1.0) : place;
  along = position.x;
}`;

const FRAGMENT = `
precision mediump float;
uniform vec3 color;
uniform float opacity;
out vec4 painted;
void main() { painted = vec4(color, opacity); }`;

export class Segments {
  /**
   * @param ends Six numbers of each segment: where it begins and where it ends, metres.
   * @param options.isHidden By what lies before them.
   * @param options.halfWidths Two numbers of each segment, metres; none: as many pixels as width_px tells.
   */
  constructor(ends, { color, width_px, halfWidths = null, opacity = 1, isHidden = false }) {
    this.ends = Float32Array.from(ends);
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array([0, -1, 0, 1, -1, 0, 0, 1, 0, 1, 1, 0]), 3));
    geometry.setIndex([0, 1, 2, 2, 1, 3]);
    geometry.setAttribute("begin", attribute(this.ends, 0));
    geometry.setAttribute("end", attribute(this.ends, 3));
    geometry.setAttribute("halfWidths", new InstancedBufferAttribute(Float32Array.from(halfWidths ?? new Float32Array(this.count * 2)), 2));
    geometry.instanceCount = this.count;
    this.uniforms = {
      color: { value: color }, opacity: { value: opacity }, width: { value: width_px / 2 },
      viewport: { value: new Vector2(1, 1) }, pixels: { value: 1 }, ratio,
    };
    this.object = new Mesh(geometry, new RawShaderMaterial({
      glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms,
      transparent: true, depthTest: isHidden, depthWrite: false, side: DoubleSide,
    }));
    this.object.frustumCulled = false;
  }

  get count() {
    return this.ends.length / 6;
  }
}

function attribute(ends, offset) {
  const values = new Float32Array(ends.length / 2);
  for (let i = 0; i < values.length; i++) values[i] = ends[6 * Math.floor(i / 3) + offset + (i % 3)];
  return new InstancedBufferAttribute(values, 3);
}

/** Segments between the successive points of a path; where keep(i) is false, the one from i on is left out. */
export function successive({ x, y, z }, keep = () => true) {
  const ends = [];
  for (let i = 0; i + 1 < x.length; i++)
    if (keep(i)) ends.push(x[i], y[i], z[i], x[i + 1], y[i + 1], z[i + 1]);
  return ends;
}
