// Edits by hand: loops and regions listed, drawn and undone; then saved as a file, or solved by the server.

import { Color } from "three";
import { Segments } from "mapper/lines";
import { Markers } from "mapper/markers";
import { Aligning } from "mapper/aligning";
import { save } from "mapper/saving";

const COLORS = { accept: "#5fc75f", reject: "#ff5a4d", drop: "#ff5a4d", erase: "#ff5a4d", keep: "#5a9bff", keepout: "#e69f00" };
const NUMBERS = { erase: "X0 Y0 Z0 X1 Y1 Z1", keep: "LOW HIGH", keepout: "X,Y X,Y X,Y …" };
const CUBE = [0, 1, 3, 2].map((a, i, around) => [[a, around[(i + 1) % 4]], [a + 4, around[(i + 1) % 4] + 4], [a, a + 4]]).flat();
const round = (value) => Number(value.toFixed(3));

/** What the numbers of a region say, as the edits file has it; null if they are not such numbers. */
export function conditionOf(kind, text) {
  const all = text.trim().split(/[\s,]+/), numbers = all.map(Number);
  if (!text.trim() || !numbers.every(Number.isFinite)) return null;
  if (kind === "keepout") {
    const corners = numbers.flatMap((x, i) => i % 2 ? [] : [[x, numbers[i + 1]]]);
    return numbers.length % 2 === 0 && corners.length >= 3 ? { polygon_m: corners } : null;
  }
  const half = kind === "erase" ? 3 : 1;
  if (numbers.length !== 2 * half) return null;
  const [low, high] = [Math.min, Math.max].map((pick) => Array.from({ length: half }, (_, k) => pick(numbers[k], numbers[k + half])));
  if (!low.every((value, k) => value < high[k])) return null;
  return kind === "erase" ? { box_m: [low, high] } : { height_m: [low[0], high[0]] };
}

/** The edits as the text of an edits file. */
export function textOf(edits) {
  const dropped = edits.filter(({ kind }) => kind === "drop").map(({ values }) => values.node);
  const tables = edits.filter(({ kind }) => kind !== "drop").map(({ kind, values }) => [`[[${kind}]]`, ...Object.entries(values).map(([name, value]) => `${name} = ${JSON.stringify(value)}`), ""].join("\n"));
  return [...dropped.length ? [`drop = ${JSON.stringify(dropped)}\n`] : [], ...tables].join("\n");
}

export class Editing {
  /** @param options.run Index of the run that is edited. @param options.regions That it has. @param options.server Its event source; null without one. */
  constructor(root, view, { name, run, regions, server }) {
    Object.assign(this, { root, view, name, regions, server, layers: view.layers[run], edits: [], isDrawing: false });
    this.nodes = new Map(this.layers.frames.filter(({ node }) => node !== null).map((frame) => [frame.node, frame.pose]));
    this.find("edit").hidden = false;
    this.find("edit").open = Boolean(server);
    this.find("edit-solve").hidden = !server;
    this.#loops();
    this.#regions();
    this.#actions();
    this.#show();
  }

  find(name) {
    return this.root.querySelector(`[data-map="${name}"]`);
  }

  tell(text) {
    this.find("edit-told").textContent = text;
  }

  #loops() {
    const fields = ["edit-i", "edit-j"].map((name) => this.find(name));
    this.view.canvas.addEventListener("pick", ({ detail: { layers, frame, loop } }) => {
      if (layers !== this.layers || this.isDrawing || this.aligning.isOn || frame?.node === null) return;
      if (loop) fields.forEach((field, k) => { field.value = loop["ij"[k]]; });
      else if (!fields[0].value || fields[1].value) fields.forEach((field, k) => { field.value = k ? "" : frame.node; });
      else fields[1].value = frame.node;
      this.#tellLoop();
    });
    for (const field of fields) field.addEventListener("input", () => this.#tellLoop());
    for (const kind of ["accept", "reject"]) this.find(`edit-${kind}`).addEventListener("click", () => {
      const nodes = this.pair(), wrong = nodes === null ? "want the numbers of two keyframes" : this.#misfit(kind, nodes);
      if (wrong) this.tell(wrong);
      else this.#add(kind, { nodes, ...kind === "accept" ? this.aligning.motionOf(nodes) : {} });
      this.aligning.end();
    });
    this.find("edit-drop").addEventListener("click", () => {
      const node = Number(fields[1].value || fields[0].value || NaN);
      if (this.nodes.has(node)) this.#add("drop", { node }); else this.tell("want the number of a keyframe");
    });
    this.find("edit-align").hidden = !this.server;
    this.aligning = new Aligning(this, this.find("edit-align"), this.find("edit-moved"), () => this.pair());
  }

  /** The two nodes in the fields; null if they are not two keyframes. */
  pair() {
    const [i, j] = ["edit-i", "edit-j"].map((name) => this.find(name).value).map((text) => text ? Number(text) : null);
    return i !== j && this.nodes.has(i) && this.nodes.has(j) ? [i, j] : null;
  }

  #loopOf([a, b]) {
    const all = this.layers.run.loops.filter(({ i, j }) => (i === a && j === b) || (i === b && j === a));
    return all.find(({ verdict }) => verdict === "accepted") ?? all.at(-1);
  }

  #misfit(kind, nodes) {
    const isHeld = this.#loopOf(nodes)?.verdict === "accepted";
    if (this.edits.some(({ values }) => values.nodes?.every((node) => nodes.includes(node)))) return "this loop is in the list already";
    if (kind === "accept" && isHeld) return "this loop holds already";
    return kind === "reject" && !isHeld ? "no loop holds between these" : "";
  }

  #tellLoop() {
    const nodes = this.pair(), loop = nodes && this.#loopOf(nodes);
    this.tell(!nodes ? "" : !loop ? "no candidate: accepting adds it" : loop.verdict === "accepted" ? "this loop holds" : `refused: ${loop.reason}`);
  }

  #regions() {
    const { view } = this, kind = this.find("edit-kind"), field = this.find("edit-region"), draw = this.find("edit-draw");
    const press = (isOn) => {
      this.isDrawing = isOn;
      view.navigation.isDragTaken = isOn;
      draw.setAttribute("aria-pressed", String(isOn));
      if (isOn) this.tell(kind.value === "erase" ? "drag over the floor" : "click on the corners");
    };
    const change = () => {
      press(false);
      field.placeholder = NUMBERS[kind.value];
      draw.disabled = kind.value === "keep";
      field.value = kind.value === "keep" ? `${round(Number(this.find("cut").min))} ${round(Number(this.find("cut").value))}` : "";
      this.#preview();
    };
    kind.addEventListener("input", change);
    field.addEventListener("input", () => this.#preview());
    field.addEventListener("keydown", ({ code }) => { if (code === "Enter") this.find("edit-add").click(); });
    draw.addEventListener("click", () => { field.value = this.isDrawing ? field.value : ""; press(!this.isDrawing); });
    this.find("edit-add").addEventListener("click", () => {
      const values = conditionOf(kind.value, field.value);
      if (!values) { this.tell(`want ${NUMBERS[kind.value]}, metres`); return; }
      field.value = "";
      press(false);
      this.#add(kind.value, values);
    });
    this.#drawing(kind, field);
    change();
  }

  /** Boxes are dragged, polygons clicked, on the floor. */
  #drawing(kind, field) {
    const { view } = this, { canvas } = view;
    let began = null;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return view.planeAt(event.clientX - box.left, event.clientY - box.top, 0);
    };
    const span = [round(2 * this.layers.map.cloud.edge_m), round(this.layers.map.headroom_m)]; // the floor itself stays
    const write = (text) => { field.value = text; this.#preview(); };
    canvas.addEventListener("pointerdown", (event) => { began = this.isDrawing && !event.button ? at(event) : null; });
    canvas.addEventListener("pointermove", (event) => {
      const now = began && kind.value === "erase" && event.buttons & 1 ? at(event) : null;
      if (now) write([began.x, began.y, span[0], now.x, now.y, span[1]].map(round).join(" "));
    });
    canvas.addEventListener("pointerup", () => {
      if (began && kind.value === "keepout") write(`${field.value} ${round(began.x)},${round(began.y)}`.trim());
      began = null;
    });
  }

  #actions() {
    const { view } = this, undo = this.find("edit-undo");
    undo.addEventListener("click", () => {
      if (this.edits.length) { this.edits.pop(); this.#show(); } else this.#ask("undo", "");
    });
    document.addEventListener("keydown", (event) => {
      if (event.code !== "KeyZ" || !(event.ctrlKey || event.metaKey) || event.target.matches("input")) return;
      event.preventDefault();
      undo.click();
    });
    this.find("edit-save").addEventListener("click", () => save(`${this.name}.edits.toml`, textOf(this.edits)));
    this.find("edit-solve").addEventListener("click", () => this.#ask("solve", textOf(this.edits)));
    if (!this.server) return;
    this.server.onmessage = ({ data }) => { if (data && this.isAsking) this.tell(data); };
    this.server.onerror = () => {
      this.server.close();
      this.server = null;
      this.#show();
      this.tell("mapper edit has ended; edits can still be saved as a file");
    };
  }

  /** Have the server solve or undo, then show the run as it is now. */
  async #ask(what, body) {
    this.isAsking = true;
    this.#show();
    this.tell("…");
    const answer = await fetch(what, { method: "POST", body, headers: { "Content-Type": "application/toml" } }).catch(() => null);
    const line = answer && (await answer.text().catch(() => "")).trim();
    this.isAsking = false;
    if (line === "done") location.reload();
    else { this.#show(); this.tell(line || "mapper edit does not answer"); }
  }

  #add(kind, values) {
    this.edits.push({ kind, values });
    this.#show();
    this.tell("");
  }

  /** The list of edits, what can be done with it, and where they are. */
  #show() {
    const { edits, server, isAsking } = this, count = edits.length;
    this.find("edits").replaceChildren(...edits.map(({ kind, values }) => {
      const item = document.createElement("li");
      const { node, nodes, translation_m, by_eye, ...region } = values;
      item.textContent = `${kind} ${node ?? nodes?.join(" – ") ?? JSON.stringify(Object.values(region)[0])}${by_eye ? ", by eye" : translation_m ? ", aligned" : ""}`;
      return item;
    }));
    this.find("edit-undo").disabled = isAsking || (!count && !server);
    this.find("edit-save").disabled = !count;
    this.find("edit-solve").disabled = isAsking || !count || !server;
    this.#preview();
  }

  /** Draw the edits, and the region whose numbers are in the field. */
  #preview() {
    const kind = this.find("edit-kind").value, values = conditionOf(kind, this.find("edit-region").value), { view } = this;
    const bands = [...this.edits, { values }].map((edit) => edit.values?.height_m).filter(Boolean);
    view.update({ kept_m: bands.length ? [Math.min(...bands.map(([low]) => low)), Math.max(...bands.map(([, high]) => high))] : [-Infinity, Infinity] });
    const corners = this.find("edit-region").value.trim().split(/[\s,]+/).map(Number);
    const shapes = [...this.regions, ...this.edits, ...values ? [{ kind, values }] : []].flatMap((edit) => this.#shapesOf(edit));
    if (this.isDrawing && kind === "keepout" && corners.length > 1)
      shapes.push(new Markers(corners.flatMap((v, i) => i % 2 ? [v, 0] : [v]), { color: new Color(COLORS.keepout), size_px: 9 }));
    view.draw("edits", shapes);
  }

  #shapesOf({ kind, values: { node, nodes, box_m, polygon_m } }) {
    const { x, y, z } = this.layers.run.path;
    let ends = [];
    if (node !== undefined) return [new Markers([x, y, z].map((axis) => axis[this.nodes.get(node)]), { color: new Color(COLORS.drop), size_px: 14, isSquare: true })];
    if (nodes) ends = nodes.map((node) => this.nodes.get(node)).flatMap((pose) => [x[pose], y[pose], z[pose]]);
    if (box_m) ends = CUBE.flat().flatMap((corner) => [0, 1, 2].map((axis) => box_m[corner >> axis & 1][axis]));
    if (polygon_m) ends = polygon_m.flatMap((corner, i) => [...corner, 0, ...polygon_m[(i + 1) % polygon_m.length], 0]);
    return ends.length ? [new Segments(ends, { color: new Color(COLORS[kind]), width_px: nodes ? 4 : 2 })] : [];
  }
}
