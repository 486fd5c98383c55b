// Marks of a fixed size on the screen: keyframes, doubtful frames, start, end, measured points.

import { BufferAttribute, BufferGeometry, GLSL3, Points, RawShaderMaterial } from "three";
import { ratio } from "mapper/screen";

const VERTEX = `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform float size, ratio;
in vec3 position;
void main() {
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = size * ratio;
}`;

const FRAGMENT = `
precision mediump float;
uniform vec3 color;
uniform bool isSquare;
uniform float rim;
out vec4 painted;
void main() {
  vec2 off = abs(gl_PointCoord - 0.5);
  float reach = isSquare ? max(off.x, off.y) : length(off);
  if (reach > 0.5) discard;
  painted = vec4(reach > rim ? vec3(1.0) : color, 1.0);
}`;

export class Markers {
  /** @param places Three numbers of each mark, metres. */
  constructor(places, { color, size_px, isSquare = false }) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(places), 3));
    this.object = new Points(geometry, new RawShaderMaterial({
      glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthTest: false, depthWrite: false,
      uniforms: { color: { value: color }, size: { value: size_px }, ratio, isSquare: { value: isSquare }, rim: { value: 0.5 - 1.3 / size_px } },
    }));
    this.object.frustumCulled = false;
  }
}
