// Eye-dome lighting (Boucheny 2009): what lies behind its neighbours on the screen is darkened, so that edges show.

import { DepthTexture, GLSL3, Mesh, PlaneGeometry, RawShaderMaterial, Scene, UnsignedIntType, WebGLRenderTarget } from "three";
import { POINTS_LAYER } from "mapper/points";

const STRENGTH = 12;

const VERTEX = `
in vec3 position;
void main() { gl_Position = vec4(position.xy * 2.0, 0.0, 1.0); }`;

const FRAGMENT = `
precision highp float;
uniform sampler2D colors;
uniform highp sampler2D depths;
uniform float near, far, strength;
uniform int reach;
out vec4 painted;

float depthAt(ivec2 at) { return texelFetch(depths, clamp(at, ivec2(0), textureSize(depths, 0) - 1), 0).r; }
float octaves(float depth) { return log2(near * far / (far - depth * (far - near))); }

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float depth = depthAt(at);
  if (depth == 1.0) discard;
  float own = octaves(depth), behind = 0.0;
  for (int i = 0; i < 4; i++) {
    ivec2 off = reach * ivec2(i < 2 ? 2 * i - 1 : 0, i < 2 ? 0 : 2 * i - 5);
    behind += max(0.0, own - octaves(depthAt(at + off)));
  }
  painted = vec4(texelFetch(colors, at, 0).rgb * max(0.25, exp(-strength * behind / 4.0)), 1.0);
  gl_FragDepth = depth;
}`;

export class Shading {
  constructor() {
    this.target = new WebGLRenderTarget(1, 1, { depthTexture: new DepthTexture(1, 1, UnsignedIntType) });
    this.uniforms = {
      colors: { value: this.target.texture }, depths: { value: this.target.depthTexture },
      near: { value: 1 }, far: { value: 1 }, strength: { value: STRENGTH }, reach: { value: 1 },
    };
    const quad = new Mesh(new PlaneGeometry(1, 1), new RawShaderMaterial({
      glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms,
    }));
    quad.frustumCulled = false;
    quad.layers.set(POINTS_LAYER);
    this.scene = new Scene().add(quad);
  }

  /** Render the points of a scene into a part of the screen, in CSS pixels. */
  render(renderer, scene, camera, { left, width, height }) {
    const { target, uniforms } = this, { width: across, height: down } = renderer.domElement, ratio = renderer.getPixelRatio();
    target.setSize(across, down);
    target.viewport.set(left * ratio, 0, width * ratio, height * ratio);
    target.scissor.copy(target.viewport);
    target.scissorTest = true;
    Object.assign(uniforms.near, { value: camera.near });
    Object.assign(uniforms.far, { value: camera.far });
    uniforms.reach.value = Math.max(1, Math.round(ratio));
    renderer.setRenderTarget(target);
    renderer.clear();
    renderer.render(scene, camera);
    renderer.setRenderTarget(null);
    renderer.render(this.scene, camera);
  }
}
