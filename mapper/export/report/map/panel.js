// The controls beside the map, and what is told about a frame, a loop or a distance.

import { Color, Vector3 } from "three";
import { roundLength } from "mapper/ground";
import { Segments } from "mapper/lines";
import { Markers } from "mapper/markers";
import { HITS_PER_OCTAVE, NEVER } from "mapper/points";
import { plyOf, save } from "mapper/saving";

const SCALE_PX = 120;
const UNITS = { height: "m", time: "s", hits: "scans" };

export const short = (value) => value === null || value === undefined ? "–" : String(Number(value.toPrecision(3)));

export class Panel {
  constructor(root, view, { ramp, images }) {
    Object.assign(this, { root, view, images, measured: [], isMeasuring: false });
    this.ramp = ramp;
    this.#runs();
    this.#points();
    this.#cut();
    this.#time();
    this.#layers();
    this.#tools();
    this.#pointer();
    this.#legend();
    this.#saving();
    view.onRest.push(() => this.#orient());
  }

  find(name) {
    return this.root.querySelector(`[data-map="${name}"]`);
  }

  #runs() {
    const { view } = this, { layers } = view;
    this.find("runs").hidden = layers.length < 2;
    this.find("beside").hidden = view.mapped.length < 2;
    for (const box of this.root.querySelectorAll("[data-map-run]"))
      box.addEventListener("change", () => {
        view.shown[Number(box.dataset.mapRun)] = box.checked;
        view.update({});
      });
    const choose = (isBeside) => view.update({ isBeside });
    this.find("beside").addEventListener("change", ({ target }) => choose(target.value === "beside"));
    if (!view.hasOwnWorlds) return;
    this.find("beside").querySelector("[value=beside]").checked = true; // over each other they would say nothing
    choose(true);
    view.resize();
    view.navigation.lookAt(view.box);
  }

  #points() {
    const { view } = this, coloring = this.find("coloring");
    const has = {
      color: view.layers.some(({ map }) => map.cloud.has_colors),
      time: view.layers.every(({ map }) => map.is_observed),
      hits: view.layers.every(({ map }) => map.is_observed),
      run: view.mapped.length > 1,
    };
    for (const option of [...coloring.options]) if (has[option.value] === false) option.remove();
    coloring.value = has.run ? "run" : has.color ? "color" : "height";
    const change = () => {
      const points = this.find("points").value, color = coloring.querySelector("[value=color]");
      if (color) color.disabled = points === "voxels";
      if (points === "voxels" && coloring.value === "color") coloring.value = "height";
      view.update({ points, coloring: coloring.value, size: Number(this.find("size").value) });
      this.#legend();
    };
    for (const name of ["points", "coloring", "size"]) this.find(name).addEventListener("input", change);
    change();
  }

  #cut() {
    const { view } = this, slider = this.find("cut"), box = this.find("slice"), told = this.find("cut-value");
    const cut = view.mapped.map(({ cells }) => cells);
    const lows = cut.map(({ low }) => low[2]);
    const highs = cut.map(({ low, shape, edge_m }) => low[2] + shape[2] * edge_m);
    const edge_m = Math.min(...cut.map((cells) => cells.edge_m));
    slider.min = Math.min(...lows);
    slider.max = Math.max(...highs);
    slider.step = edge_m;
    const headroom_m = Math.max(...view.mapped.map(({ map }) => map.headroom_m));
    slider.value = Math.min(headroom_m, Number(slider.max));
    const change = () => {
      const isWhole = Number(slider.value) >= Number(slider.max) - edge_m / 2, height_m = Number(slider.value);
      told.textContent = isWhole ? "nothing is cut" : `${height_m.toFixed(2)} m`;
      slider.setAttribute("aria-valuetext", told.textContent);
      view.update({ cut_m: isWhole ? Infinity : height_m });
      return view.showLayer(box.checked && !isWhole ? height_m - edge_m / 2 : null);
    };
    slider.addEventListener("input", () => {
      if (!this.wasCut) box.checked = true; // who cuts for the first time wants to see the slice
      this.wasCut = true;
      change();
    });
    box.addEventListener("change", change);
    change();
  }

  #time() {
    const { view } = this, slider = this.find("until"), told = this.find("until-value");
    const longest_s = Math.max(...view.layers.map((one) => one.duration_s));
    this.find("time").hidden = !view.layers.every(({ map }) => map.is_observed);
    const change = () => {
      const until = Number(slider.value);
      told.textContent = until >= NEVER - 1 ? "the end" : `${short(until / (NEVER - 1) * longest_s)} s`;
      slider.setAttribute("aria-valuetext", told.textContent);
      view.update({ until: until >= NEVER - 1 ? NEVER : until });
    };
    slider.addEventListener("input", change);
    change();
  }

  #layers() {
    const { view } = this;
    for (const box of this.root.querySelectorAll("[data-map-layer]")) {
      const id = box.dataset.mapLayer;
      const counts = { accepted: (one) => one.loops.accepted.length, rejected: (one) => one.loops.rejected.length };
      const isThere = view.layers.some((one) => one.objects[id] && (!counts[id] || counts[id](one)));
      box.closest("label").hidden = !isThere;
      if (counts[id]) box.closest("label").querySelector("b").textContent = view.layers.reduce((sum, one) => sum + counts[id](one), 0);
      const change = () => {
        if (box.checked) view.hidden.delete(id); else view.hidden.add(id);
        view.update({});
      };
      box.addEventListener("change", change);
      change();
    }
  }

  #tools() {
    const { view } = this, { navigation } = view, measure = this.find("measure"), fly = this.find("fly");
    this.find("home").addEventListener("click", () => navigation.lookAt(view.box));
    for (const [name, change] of [["shading", (isOn) => view.update({ isShaded: isOn })], ["grid", (isOn) => view.update({ hasGrid: isOn })]])
      this.find(name).addEventListener("change", ({ target }) => change(target.checked));
    this.find("above").addEventListener("click", () => navigation.lookAt(view.box, { fromAbove: true }));
    const press = (button, isOn) => button.setAttribute("aria-pressed", String(isOn));
    fly.addEventListener("click", () => {
      navigation.flying = !navigation.isFlying;
      press(fly, navigation.isFlying);
      this.find("flight").hidden = !navigation.isFlying;
      view.canvas.focus();
    });
    for (const button of this.root.querySelectorAll("[data-map-fly]"))
      for (const [type, isHeld] of [["pointerdown", true], ["pointerup", false], ["pointerleave", false], ["pointercancel", false]])
        button.addEventListener(type, () => navigation.hold(button.dataset.mapFly, isHeld));
    measure.addEventListener("click", () => {
      this.isMeasuring = !this.isMeasuring;
      press(measure, this.isMeasuring);
      this.#measure([]);
    });
    view.canvas.addEventListener("keydown", (event) => {
      if (event.code === "KeyM") measure.click();
      else if (event.code === "KeyF") fly.click();
      else if (event.code === "KeyT") this.find("above").click();
      else if (event.code === "KeyR") this.find("home").click();
      else if (event.code === "Escape") { this.#measure([]); this.#tellFrame(null); }
    });
    this.find("frame-close").addEventListener("click", () => this.#tellFrame(null));
  }

  #saving() {
    const { view } = this, name = view.layers[0].name;
    this.find("save-picture").addEventListener("click", async () => save(`${name}.png`, await view.picture()));
    this.find("save-points").addEventListener("click", () => {
      for (const [run, one] of view.layers.entries()) if (view.shown[run] && one.cells) save(`${one.name}.ply`, ...plyOf(one.points[view.state.points]));
    });
  }

  /** Scale, north, and the address of the view. */
  #orient() {
    const { view } = this, { camera, navigation: { orbit } } = view;
    this.find("scale").parentElement.hidden = view.hasOwnWorlds && view.shown.filter(Boolean).length > 1; // each has its own
    const length = roundLength(SCALE_PX * view.metresPerPixel);
    this.find("scale").style.width = `${length / view.metresPerPixel}px`;
    this.find("scale-text").textContent = length < 1 ? `${Math.round(100 * length)} cm` : length < 1000 ? `${length} m` : `${length / 1000} km`;
    const north = this.find("north");
    north.hidden = !view.mapped.every(({ map }) => map.has_north);
    const up = new Vector3(0, 1, 0).transformDirection(camera.matrixWorld);
    north.style.transform = `rotate(${-Math.atan2(up.x, up.y)}rad)`;
    if (this.root.matches(".whole")) history.replaceState(null, "", `#view=${[camera.position, orbit.target].flatMap((place) => place.toArray().map((v) => Number(v.toFixed(3))))}`);
  }

  #pointer() {
    const { canvas } = this.view;
    let pressed = null;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => { pressed = at(event); });
    canvas.addEventListener("pointermove", (event) => { if (!event.buttons) this.#hover(...at(event)); });
    canvas.addEventListener("pointerleave", () => { this.find("hint").hidden = true; });
    canvas.addEventListener("pointerup", (event) => {
      const [x, y] = at(event);
      if (!pressed || event.button || Math.hypot(x - pressed[0], y - pressed[1]) > 5) return;
      this.#click(x, y);
      if (event.pointerType === "touch") this.#hover(x, y); // a finger does not hover
    });
  }

  #click(x, y) {
    const { view } = this;
    if (this.isMeasuring) {
      const place = view.pointAt(x, y);
      if (place) this.#measure(this.measured.length === 2 ? [place] : [...this.measured, place]);
      else this.find("distance").textContent = "no point there; click on one";
      return;
    }
    const found = view.frameAt(x, y), held = view.loopAt(x, y);
    if (found) this.#tellFrame(found);
    if (found || held) view.canvas.dispatchEvent(new CustomEvent("pick", { detail: found ?? held }));
  }

  #measure(places) {
    const { view } = this, told = this.find("distance"), coordinates = (p) => p.toArray().map((v) => v.toFixed(2)).join(", ");
    const [a, b] = places;
    this.measured = places;
    const flat = places.flatMap((place) => place.toArray());
    view.draw("measured", [
      ...places.length === 2 ? [new Segments(flat, { color: new Color("#ffffff"), width_px: 2 })] : [],
      ...places.length ? [new Markers(flat, { color: new Color("#e69f00"), size_px: 12 })] : [],
    ]);
    told.hidden = !this.isMeasuring;
    told.textContent = b ? `${a.distanceTo(b).toFixed(3)} m; level ${Math.hypot(b.x - a.x, b.y - a.y).toFixed(3)} m, up ${(b.z - a.z).toFixed(3)} m`
      : a ? `from ${coordinates(a)} m; click on the second point` : "click on two points of the map";
  }

  #hover(x, y) {
    const hint = this.find("hint"), found = this.view.frameAt(x, y), held = this.view.loopAt(x, y);
    hint.hidden = !found && !held;
    this.view.canvas.style.cursor = this.isMeasuring ? "crosshair" : found ? "pointer" : "";
    if (hint.hidden) return;
    hint.textContent = [found && this.#titleOf(found), held && loopText(held.loop)].filter(Boolean).join("\n");
    const { clientWidth } = this.view.canvas;
    hint.style.left = `${Math.min(x + 14, Math.max(clientWidth - hint.offsetWidth - 4, 0))}px`;
    hint.style.top = `${y + 14}px`;
  }

  #titleOf({ layers, frame }) {
    const { path } = layers.run, what = frame.node === null ? "doubtful frame" : `keyframe ${frame.node}`;
    return `${this.view.layers.length > 1 ? `${layers.name}: ` : ""}${what} at ${short(path.t[frame.pose])} s${frame.doubts.length ? `: ${frame.doubts.join("; ")}` : ""}`;
  }

  #tellFrame(found) {
    const box = this.find("frame");
    box.hidden = !found;
    if (!found) return;
    const { layers, frame } = found, { path, error } = layers.run, { pose } = frame;
    this.find("frame-title").textContent = this.#titleOf(found);
    const image = this.find("frame-image"), uri = frame.image === null ? null : this.images[this.view.layers.indexOf(layers)][frame.image];
    image.hidden = !uri;
    if (uri) image.src = uri;
    const loops = layers.run.loops.filter((loop) => loop.i === frame.node || loop.j === frame.node);
    const held = loops.filter((loop) => loop.verdict === "accepted").length;
    const sigma = path.band_3d_m && path.band_3d_m[pose];
    const rows = [
      ["position", `${[path.x, path.y, path.z].map((axis) => axis[pose].toFixed(2)).join(", ")} m`],
      ["uncertainty, 2 σ", sigma === null || sigma === undefined ? null : `${short(sigma)} m`],
      ["from the truth", error ? missAt(error, path.t[pose]) : null],
      ["tracked by", frame.method || null],
      ["features", frame.features || null],
      ["matches", frame.matches || null],
      ["inliers", frame.inliers || null],
      ["residual", frame.inliers && frame.residual !== null ? `${short(frame.residual)} ${frame.residual_unit}` : null],
      ["time to track", frame.ms === null ? null : `${short(frame.ms)} ms`],
      ["loops", loops.length ? `${held} hold, ${loops.length - held} refused` : null],
    ];
    const table = this.find("frame-numbers");
    table.replaceChildren(...rows.filter(([, value]) => value !== null).map(([name, value]) => {
      const row = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
      head.scope = "row";
      head.textContent = name;
      cell.textContent = value;
      row.append(head, cell);
      return row;
    }));
  }

  #legend() {
    const { coloring } = this.view.state, bar = this.find("legend");
    bar.hidden = !UNITS[coloring];
    if (bar.hidden) return;
    let [low, high] = this.view.range();
    if (coloring === "time") [low, high] = [0, Math.max(...this.view.layers.map((one) => one.duration_s))];
    if (coloring === "hits") [low, high] = [low, high].map((v) => Math.round(2 ** (v / HITS_PER_OCTAVE) - 1));
    this.find("legend-low").textContent = `${short(low)} ${UNITS[coloring]}`;
    this.find("legend-high").textContent = `${short(high)} ${UNITS[coloring]}`;
    const stops = this.ramp.filter((_, i) => i % 15 === 0).map((rgb) => `rgb(${rgb})`);
    this.find("legend-ramp").style.background = `linear-gradient(to right, ${stops})`;
  }
}

function missAt(error, t) {
  const i = error.t.findIndex((other) => Math.abs(other - t) < 5e-4);
  return i < 0 ? null : `${short(error.m[i])} m`;
}

function loopText(loop) {
  const head = `loop ${loop.i} – ${loop.j}, by ${loop.by}`;
  if (loop.verdict === "rejected") return `${head}: refused: ${loop.reason}`;
  return `${head}: holds, ${loop.inliers} inliers, ${short(loop.rmse_m)} m RMSE, ${short(loop.after_m)} m off after the solve`;
}
