// Moving the eye: orbit around a point, or fly; with the mouse, by touch and by keys.

import { MOUSE, TOUCH, Vector3 } from "three";
import { OrbitControls } from "three/OrbitControls";

const FLYING = { KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0] };
const TURN_RAD_PER_PX = 0.004;
const KEY_TURN_RAD = 0.06;
const STEEPEST = 1.5; // rad above or below the horizon
const VIEW_RAD = [-0.6, 0.75]; // azimuth and elevation from which a map is first seen

export class Navigation {
  /** @param onMove Called when the eye has moved. */
  constructor(camera, canvas, onMove) {
    Object.assign(this, { camera, canvas, onMove, pressed: new Set(), isFlying: false, isHeld: false });
    camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(camera, canvas);
    this.orbit.enableDamping = false;
    this.orbit.zoomToCursor = true;
    this.orbit.addEventListener("change", onMove);
    if (!canvas.closest(".whole")) { // in a page that scrolls, the wheel is the page's until the map is clicked
      this.orbit.enableZoom = false;
      canvas.addEventListener("focus", () => { this.orbit.enableZoom = true; });
      canvas.addEventListener("blur", () => { this.orbit.enableZoom = false; });
    }
    canvas.addEventListener("keydown", (event) => this.#keyDown(event));
    canvas.addEventListener("keyup", (event) => this.pressed.delete(event.code));
    canvas.addEventListener("blur", () => this.pressed.clear());
    canvas.addEventListener("pointerdown", () => { this.isHeld = true; });
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, () => { this.isHeld = false; });
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
  }

  /** Look at a box, from the side or straight down. */
  lookAt(box, { fromAbove = false } = {}) {
    const centre = box.getCenter(new Vector3()), size = box.getSize(new Vector3());
    const [azimuth, elevation] = fromAbove ? [0, Math.PI / 2 - 0.001] : VIEW_RAD;
    const half = Math.tan(this.camera.fov * Math.PI / 360), { aspect } = this.camera;
    const distance = 1.05 * (fromAbove
      ? Math.max(size.y / 2, size.x / 2 / aspect) / half + size.z / 2
      : 0.5 * Math.hypot(size.x, size.y, size.z) / half * (aspect > 1 ? 0.72 : 1.1 / aspect));
    this.orbit.target.copy(centre);
    this.camera.position.set(
      centre.x + distance * Math.sin(azimuth) * Math.cos(elevation),
      centre.y - distance * Math.cos(azimuth) * Math.cos(elevation),
      centre.z + distance * Math.sin(elevation),
    );
    this.camera.near = distance / 1000;
    this.camera.far = distance * 40;
    this.camera.updateProjectionMatrix();
    this.orbit.update();
    this.onMove();
  }

  /** Look from one place at another, each as (x, y, z). */
  lookFrom(position, target) {
    this.camera.position.fromArray(position);
    this.orbit.target.fromArray(target);
    this.orbit.update();
    this.onMove();
  }

  /** Whether dragging with the left button or one finger is someone else's. */
  set isDragTaken(isTaken) {
    this.orbit.mouseButtons.LEFT = isTaken ? null : MOUSE.ROTATE;
    this.orbit.touches.ONE = isTaken ? null : TOUCH.ROTATE;
  }

  set flying(isFlying) {
    this.isFlying = isFlying;
    this.orbit.enabled = !isFlying;
    this.#aim(this.camera.getWorldDirection(new Vector3()));
  }

  /** Press or release a direction of flight, as a button on the screen does. */
  hold(code, isHeld) {
    if (isHeld) this.pressed.add(code); else this.pressed.delete(code);
    this.onMove();
  }

  /** Fly on for some seconds; return whether the eye moves. */
  advance(seconds) {
    const motion = new Vector3();
    for (const code of this.pressed) motion.add(new Vector3(...FLYING[code]));
    if (!motion.lengthSq()) return false;
    const ahead = this.camera.getWorldDirection(new Vector3());
    const right = new Vector3().crossVectors(ahead, this.camera.up).normalize();
    const speed = Math.max(0.5, 0.5 * this.camera.position.distanceTo(this.orbit.target));
    const step = new Vector3().addScaledVector(right, motion.x).addScaledVector(this.camera.up, motion.y)
      .addScaledVector(ahead, motion.z).normalize().multiplyScalar(speed * seconds);
    this.camera.position.add(step);
    this.orbit.target.add(step);
    this.orbit.update();
    this.onMove();
    return true;
  }

  #keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const turn = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.code];
    const zoom = { Equal: 0.85, NumpadAdd: 0.85, Minus: 1 / 0.85, NumpadSubtract: 1 / 0.85 }[event.code];
    if (FLYING[event.code]) this.hold(event.code, true);
    else if (turn && this.isFlying) this.#look(turn[0] * KEY_TURN_RAD, turn[1] * KEY_TURN_RAD);
    else if (turn) this.#circle(-turn[0] * KEY_TURN_RAD, -turn[1] * KEY_TURN_RAD);
    else if (zoom) this.#approach(zoom);
    else return;
    event.preventDefault();
  }

  #drag(event) {
    if (this.isFlying && event.buttons & 1) this.#look(-event.movementX * TURN_RAD_PER_PX, -event.movementY * TURN_RAD_PER_PX);
  }

  /** Turn the head. */
  #look(left, up) {
    const ahead = this.camera.getWorldDirection(new Vector3());
    const azimuth = Math.atan2(ahead.y, ahead.x) + left;
    const elevation = Math.max(-STEEPEST, Math.min(STEEPEST, Math.asin(ahead.z) + up));
    this.#aim(new Vector3(Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation)));
  }

  #aim(ahead) {
    const distance = this.camera.position.distanceTo(this.orbit.target);
    this.orbit.target.copy(this.camera.position).addScaledVector(ahead, distance);
    this.orbit.update();
    this.onMove();
  }

  /** Go around what is looked at. */
  #circle(left, down) {
    const off = this.camera.position.clone().sub(this.orbit.target), distance = off.length();
    const azimuth = Math.atan2(off.y, off.x) + left;
    const elevation = Math.max(-STEEPEST, Math.min(STEEPEST, Math.asin(off.z / distance) - down));
    off.set(Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation));
    this.camera.position.copy(this.orbit.target).addScaledVector(off, distance);
    this.orbit.update();
    this.onMove();
  }

  #approach(factor) {
    this.camera.position.sub(this.orbit.target).multiplyScalar(factor).add(this.orbit.target);
    this.orbit.update();
    this.onMove();
  }
}
