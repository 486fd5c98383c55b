// Two keyframes' scans aligned by hand: the second one is dragged over the first, and turned.

import { Matrix4, Quaternion, Vector3 } from "three";
import { decodedPoints } from "mapper/decoding";
import { PointSet } from "mapper/points";

const COLORS = [[242, 244, 248], [230, 159, 0]]; // of the one that stays, and of the one that is moved
const TURN_DEG_PER_PX = 0.2;

export class Aligning {
  /** @param button Begins and ends it. @param field Has the motion: x, y, z in metres, and degrees about the vertical. */
  constructor(editing, button, field, pairOf) {
    Object.assign(this, { editing, view: editing.view, button, field, pairOf, isOn: false, byEye: editing.find("edit-by-eye") });
    button.addEventListener("click", () => { if (this.isOn) this.end(); else this.#begin(); });
    field.addEventListener("input", () => this.#place());
    this.#dragging();
  }

  /** The motion as the edits file has it: the pose of the second keyframe in the first; nothing unless they are aligned. */
  motionOf(nodes) {
    if (!this.isOn || nodes.join() !== this.nodes.join() || !this.moved) return {};
    const T_i_j = this.poses[0].clone().invert().multiply(this.#pose()), at = new Vector3(), turn = new Quaternion();
    T_i_j.decompose(at, turn, new Vector3());
    const [translation_m, rotation_xyzw] = [at, turn].map((one) => one.toArray().map((value) => Number(value.toFixed(5))));
    return { translation_m, rotation_xyzw, ...this.byEye.checked ? { by_eye: true } : {} };
  }

  end() {
    this.#show(false);
    this.view.draw("aligned", [], { isOver: false });
  }

  async #begin() {
    const nodes = this.pairOf();
    if (!nodes) { this.editing.tell("want the numbers of two keyframes"); return; }
    this.editing.tell("reading both …");
    const answer = await fetch(`scans/${nodes.join("/")}`), text = await answer.text();
    if (!answer.ok) { this.editing.tell(text); return; }
    const scans = JSON.parse(text);
    this.nodes = nodes;
    this.poses = scans.map(({ T_world_body }) => new Matrix4().set(...T_world_body.flat()));
    const decoded = await Promise.all(scans.map(({ points }) => decodedPoints(points, { isObserved: false, hasColors: false })));
    const { edge_m } = this.editing.layers.map.cloud;
    this.sets = decoded.map((points, k) => {
      const set = new PointSet(points, { edge_m, isSquare: false });
      for (let i = 0; i < set.count; i++) set.shades.set(COLORS[k], 4 * i);
      return Object.assign(set, { toBody: set.toWorld });
    });
    this.field.value = "0 0 0 0";
    this.view.draw("aligned", this.sets, { isOver: false });
    this.#show(true);
    this.#place();
    this.editing.tell("drag the yellow one over the white one, with Shift to turn it; then Accept");
  }

  #show(isOn) {
    this.isOn = isOn;
    this.button.setAttribute("aria-pressed", String(isOn));
    this.field.hidden = this.byEye.closest("label").hidden = !isOn;
    this.view.navigation.isDragTaken = isOn;
    this.view.update({ hidesMaps: isOn });
  }

  /** Pose of the second keyframe in the world, moved and turned about where it is. */
  #pose() {
    const [x, y, z, turn_deg] = this.moved, at = new Vector3().setFromMatrixPosition(this.poses[1]);
    return new Matrix4().makeTranslation(at.x + x, at.y + y, at.z + z)
      .multiply(new Matrix4().makeRotationZ(turn_deg * Math.PI / 180))
      .multiply(new Matrix4().makeTranslation(-at.x, -at.y, -at.z)).multiply(this.poses[1]);
  }

  #place() {
    const numbers = this.field.value.trim().split(/[\s,]+/).map(Number);
    this.moved = numbers.length === 4 && numbers.every(Number.isFinite) ? numbers : null;
    if (!this.moved) return;
    [this.poses[0], this.#pose()].forEach((pose, k) => { this.sets[k].toWorld = pose.clone().multiply(this.sets[k].toBody); });
    this.view.invalidate();
  }

  #dragging() {
    const { canvas } = this.view;
    let last = null;
    const at = (event) => {
      const box = canvas.getBoundingClientRect(), height = new Vector3().setFromMatrixPosition(this.poses[1]).z;
      return this.view.planeAt(event.clientX - box.left, event.clientY - box.top, height);
    };
    canvas.addEventListener("pointerdown", (event) => { last = this.isOn && this.moved && !event.button ? at(event) : null; });
    canvas.addEventListener("pointerup", () => { last = null; });
    canvas.addEventListener("pointermove", (event) => {
      const now = last && event.buttons & 1 ? at(event) : null;
      if (!now) return;
      const [x, y, z, turn] = this.moved;
      const moved = event.shiftKey ? [x, y, z, turn - TURN_DEG_PER_PX * event.movementX] : [x + now.x - last.x, y + now.y - last.y, z, turn];
      this.field.value = moved.map((value) => Number(value.toFixed(3))).join(" ");
      last = now;
      this.#place();
    });
  }
}
