"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const MARGIN = { left: 52, right: 18, top: 8, bottom: 22 };
  const CURVE_HEIGHT = 150;
  const ARROW_EVERY_PX = 70; // along a path
  const runs = JSON.parse(document.getElementById("data").textContent);
  const shown = runs.map(() => true);
  const redraws = [];
  const followers = []; // told which second of which run the pointer is at

  const colorOf = (run) => `var(--run${run % 6})`;
  const redraw = () => redraws.forEach((draw) => draw());
  const follow = (seconds) => followers.forEach((place) => place(seconds));

  function element(parent, name, attributes = {}, text = null) {
    const made = parent instanceof SVGElement || name === "svg"
      ? document.createElementNS(SVG, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== null) made.textContent = text;
    parent.appendChild(made);
    return made;
  }

  const short = (value) => value === null || value === undefined ? "–" : String(Number(value.toPrecision(3)));

  /** Round numbers between two values, about as many as asked for. */
  function ticks(low, high, count) {
    const rough = (high - low) / count || 1;
    const decade = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((s) => s * decade).find((s) => s >= rough);
    const found = [];
    for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
    return found;
  }

  /** Index of the entry of a sorted list that is nearest to a value. */
  function nearest(sorted, value) {
    let low = 0, high = sorted.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (sorted[middle] < value) low = middle + 1; else high = middle;
    }
    return low > 0 && value - sorted[low - 1] < sorted[low] - value ? low - 1 : low;
  }

  function pathOf(xs, ys, toX, toY) {
    let d = "", pen = "M";
    for (let i = 0; i < xs.length; i++) {
      if (ys[i] === null) { pen = "M"; continue; }
      d += `${pen}${toX(xs[i]).toFixed(1)} ${toY(ys[i]).toFixed(1)}`;
      pen = "L";
    }
    return d;
  }

  /** Buttons that show and hide what they name. */
  function legend(figure, entries, onChange) {
    const bar = element(figure, "div", { class: "legend" });
    for (const entry of entries) {
      const button = element(bar, "button", { type: "button", "aria-pressed": String(entry.on), style: `--of: ${entry.color}` }, entry.label);
      button.addEventListener("click", () => {
        entry.on = !entry.on;
        button.setAttribute("aria-pressed", String(entry.on));
        onChange();
      });
      entry.button = button;
    }
  }

  /** A line below a legend that tells what a colour is, and has nothing to click. */
  function keyOf(figure, color, text) {
    element(figure.querySelector(".legend"), "span", { class: "key", style: `--of: ${color}` }, text);
  }

  /** Call back with the corners, in pixels, of a box that is dragged over a figure. */
  function onDrag(svg, zoom) {
    let began = null, box = null;
    const at = (event) => {
      const frame = svg.getBoundingClientRect();
      return [event.clientX - frame.left, event.clientY - frame.top];
    };
    svg.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      began = at(event);
      box = element(svg, "rect", { class: "zoom" });
    });
    svg.addEventListener("pointermove", (event) => {
      if (!box) return;
      at(event).forEach((now, axis) => {
        box.setAttribute("xy"[axis], Math.min(began[axis], now));
        box.setAttribute(["width", "height"][axis], Math.abs(now - began[axis]));
      });
    });
    addEventListener("pointerup", (event) => {
      if (!box) return;
      const ended = at(event);
      box.remove();
      box = null;
      if (Math.abs(ended[0] - began[0]) > 5) zoom(began.map((a, i) => Math.min(a, ended[i])), began.map((a, i) => Math.max(a, ended[i])));
    });
  }

  // Curves over time: one line per run -----------------------------------------------------------------

  function seriesOf(run, key, unit) {
    const frames = runs[run].frames;
    if (key === "residual" && runs[run].residual_unit !== unit) return null;
    if (key === "error") {
      const error = runs[run].error;
      const { t, band_3d_m: band } = runs[run].path;
      return error && { xs: error.t, ys: error.m, band: band && { xs: t, ys: band } };
    }
    const isKnown = { ms: () => true, features: () => true }[key]
      ?? ((i) => ["tracked", "doubtful"].includes(frames.outcome[i]) && frames.matches[i] > 0); // the first has nothing to be matched with
    const placed = frames[key].map((value, i) => isKnown(i) ? value : null);
    return placed.some((value) => value !== null) ? { xs: frames.t, ys: placed } : null;
  }

  /** Times [from, to] between which the path is doubtful, from the pose before to the pose after. */
  function doubtfulTimes({ t, doubtful }) {
    const found = [];
    doubtful.forEach((is, i) => {
      if (!is) return;
      if (i && doubtful[i - 1]) found[found.length - 1][1] = t[Math.min(i + 1, t.length - 1)];
      else found.push([t[Math.max(i - 1, 0)], t[Math.min(i + 1, t.length - 1)]]);
    });
    return found;
  }

  /** Outline of what lies between zero and the band's height; a gap where that is not known. */
  function areaOf({ xs, ys }, toX, toY) {
    let d = "", begin = null;
    for (let i = 0; i <= xs.length; i++) {
      const known = i < xs.length && ys[i] !== null;
      if (known) d += `${begin === null ? `M${toX(xs[i]).toFixed(1)} ${toY(0).toFixed(1)}` : ""}L${toX(xs[i]).toFixed(1)} ${toY(ys[i]).toFixed(1)}`;
      else if (begin !== null) d += `L${toX(xs[i - 1]).toFixed(1)} ${toY(0).toFixed(1)}Z`;
      begin = known ? xs[i] : null;
    }
    return d;
  }

  let zoomed = null; // [from, to] in seconds, shared by all curves

  function curve(figure) {
    const { curve: key, unit } = figure.dataset;
    const series = runs.map((_, run) => ({ run, ...seriesOf(run, key, unit) })).filter((one) => one.xs);
    if (!series.length) { figure.hidden = true; return; }
    if (unit) figure.querySelector("figcaption").textContent += `, ${unit}`;
    const entries = series.map((one) => ({ ...one, on: true, color: colorOf(one.run), label: runs[one.run].name }));
    legend(figure, entries, () => draw());
    if (series.some((one) => one.band)) keyOf(figure, "var(--faint)", "shaded: 2 σ of the position, the first pose being right");
    if (series.some((one) => runs[one.run].path.doubtful.includes(true))) keyOf(figure, "var(--doubtful)", "doubtful frames");
    const svg = element(figure, "svg", { role: "img", "aria-label": figure.querySelector("figcaption").textContent });
    const readOut = element(figure, "div", { class: "read-out" });
    let toX, fromX, line;

    function draw() {
      const width = Math.max(figure.clientWidth, 200), height = CURVE_HEIGHT;
      svg.replaceChildren();
      svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      svg.setAttribute("height", height);
      for (const entry of entries) entry.button.hidden = !shown[entry.run];
      const visible = entries.filter((entry) => entry.on && shown[entry.run]);
      const all = visible.length ? visible : entries;
      const times = (shown.includes(true) ? runs.filter((_, run) => shown[run]) : runs).map((run) => run.frames.t);
      const [from, to] = zoomed || [Math.min(...times.map((t) => t[0])), Math.max(...times.map((t) => t[t.length - 1]))];
      let top = 0;
      for (const one of all) one.ys.forEach((y, i) => { if (y !== null && one.xs[i] >= from && one.xs[i] <= to && y > top) top = y; });
      const highest = 3 * top; // a band that is far wider must not flatten the curve
      for (const one of all) if (one.band) one.band.ys.forEach((y, i) => { if (y !== null && one.band.xs[i] >= from && one.band.xs[i] <= to && y > top) top = Math.min(y, highest); });
      top = top || 1;
      const right = width - MARGIN.right, bottom = height - MARGIN.bottom;
      toX = (t) => MARGIN.left + (t - from) / (to - from || 1) * (right - MARGIN.left);
      fromX = (x) => from + (x - MARGIN.left) / (right - MARGIN.left) * (to - from);
      const toY = (y) => bottom - y / top * (bottom - MARGIN.top);
      for (const y of ticks(0, top, 4)) {
        element(svg, "line", { class: "grid", x1: MARGIN.left, x2: right, y1: toY(y), y2: toY(y) });
        element(svg, "text", { x: MARGIN.left - 6, y: toY(y) + 4, "text-anchor": "end" }, short(y));
      }
      for (const t of ticks(from, to, Math.max(2, width / 110)))
        element(svg, "text", { x: toX(t), y: height - 6, "text-anchor": "middle" }, `${short(t)} s`);
      const clip = `clip-${key}-${unit}`;
      element(element(svg, "clipPath", { id: clip }), "rect",
        { x: MARGIN.left, y: 0, width: right - MARGIN.left, height: bottom + 1 });
      for (const one of visible) {
        for (const [begin, end] of doubtfulTimes(runs[one.run].path))
          element(svg, "rect", { class: "doubtful", "clip-path": `url(#${clip})`, x: toX(begin), width: Math.max(toX(end) - toX(begin), 2), y: MARGIN.top, height: bottom - MARGIN.top });
        if (one.band)
          element(svg, "path", { class: "band", "clip-path": `url(#${clip})`, style: `fill: ${one.color}`, d: areaOf(one.band, toX, toY) });
      }
      for (const one of visible)
        element(svg, "path", { class: "line", "clip-path": `url(#${clip})`, style: `stroke: ${one.color}`, d: pathOf(one.xs, one.ys, toX, toY) });
      line = element(svg, "line", { class: "cursor", y1: MARGIN.top, y2: bottom, visibility: "hidden" });
    }

    function point(seconds) {
      line.setAttribute("visibility", seconds === null ? "hidden" : "visible");
      if (seconds === null) { readOut.textContent = ""; return; }
      line.setAttribute("x1", toX(seconds));
      line.setAttribute("x2", toX(seconds));
      readOut.textContent = entries.filter((entry) => entry.on && shown[entry.run]).map((one) => {
        const i = nearest(one.xs, seconds);
        return `${one.label} at ${one.xs[i]} s: ${short(one.ys[i])}${unit ? ` ${unit}` : ""}`;
      }).join("   ");
    }

    const xOf = (event) => event.clientX - svg.getBoundingClientRect().left;
    svg.addEventListener("pointermove", (event) => follow(fromX(xOf(event))));
    svg.addEventListener("pointerleave", () => follow(null));
    onDrag(svg, (low, high) => {
      zoomed = [fromX(low[0]), fromX(high[0])];
      redraw();
    });
    svg.addEventListener("dblclick", () => { zoomed = null; redraw(); });
    redraws.push(draw);
    followers.push(point);
  }

  // Plans: the slice from above, with the path over it ----------------------------------------------------

  function plan(figure) {
    const index = Number(figure.dataset.of), run = runs[index], { slice } = run;
    const held = run.loops.filter((loop) => loop.ends && loop.verdict === "accepted");
    const refused = run.loops.filter((loop) => loop.ends && loop.verdict === "rejected");
    const { doubtful, band_m: band } = run.path, doubted = doubtful.filter(Boolean).length;
    const widest = band ? Math.max(0, ...band.filter((width) => width !== null)) : 0;
    const layers = [
      { id: "band", label: `2 σ from above, at most ${short(widest)} m`, color: colorOf(index), on: true, there: widest > 0 },
      { id: "truth", label: "truth", color: "var(--truth)", on: true, there: Boolean(run.truth) },
      { id: "estimate", label: "estimate", color: colorOf(index), on: true, there: true },
      { id: "doubtful", label: `${doubted} doubtful frames`, color: "var(--doubtful)", on: true, there: doubted > 0 },
      { id: "accepted", label: `${held.length} loops that hold`, color: "var(--accepted)", on: true, there: held.length > 0 },
      { id: "rejected", label: `${refused.length} refused`, color: "var(--rejected)", on: false, there: refused.length > 0 },
    ].filter((layer) => layer.there);
    legend(figure, layers, () => draw());
    keyOf(figure, "var(--start)", "start");
    keyOf(figure, "var(--end)", "end");
    const svg = element(figure, "svg", { role: "img", "aria-label": `${run.name} from above` });
    const readOut = element(figure, "div", { class: "read-out" });
    const margin = 0.3;
    const xs = [slice.x, slice.x + slice.width_m], ys = [slice.y, slice.y + slice.height_m];
    for (const path of [run.path, run.truth]) if (path) { for (const x of path.x) xs.push(x); for (const y of path.y) ys.push(y); }
    const least = (values) => values.reduce((a, b) => Math.min(a, b)), most = (values) => values.reduce((a, b) => Math.max(a, b));
    const everything = [least(xs) - margin, most(xs) + margin, least(ys) - margin, most(ys) + margin];
    let [x0, x1, y0, y1] = everything;
    let scale, dot;
    let left; // of what is drawn, where the height limits its width
    const toX = (x) => left + (x - x0) * scale, toY = (y) => (y1 - y) * scale;

    function draw() {
      const width = Math.max(figure.clientWidth, 200);
      scale = Math.min(width / (x1 - x0), 620 / (y1 - y0));
      left = (width - (x1 - x0) * scale) / 2;
      const height = (y1 - y0) * scale;
      svg.replaceChildren();
      svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      svg.setAttribute("height", height);
      element(svg, "image", { href: slice.uri, x: toX(slice.x), y: toY(slice.y + slice.height_m), width: slice.width_m * scale, height: slice.height_m * scale, preserveAspectRatio: "none" });
      for (const layer of layers.filter((one) => one.on)) {
        const group = element(svg, "g", { class: `layer-${layer.id}`, style: `stroke: ${layer.color}` });
        const path = { truth: run.truth, estimate: run.path }[layer.id];
        if (layer.id === "band" || layer.id === "doubtful")
          drawStretches(group, layer.id === "band" ? band : doubtful.map((is, i) => is || doubtful[i + 1] ? 0 : null));
        else if (path)
          element(group, "path", { class: "line", "stroke-dasharray": layer.id === "truth" ? "5 3" : "none", d: pathOf(path.x, path.y, toX, toY) });
        else
          for (const loop of layer.id === "accepted" ? held : refused) {
            const [a, b] = loop.ends;
            element(group, "line", { x1: toX(a[0]), y1: toY(a[1]), x2: toX(b[0]), y2: toY(b[1]) });
            element(group, "circle", { cx: toX(a[0]), cy: toY(a[1]), r: 1.5 });
          }
      }
      drawDirection();
      const bar = [1000, 500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02].find((length) => length <= 0.25 * (x1 - x0)) || 0.01;
      element(svg, "line", { x1: left + 8, x2: left + 8 + bar * scale, y1: height - 8, y2: height - 8, style: "stroke: var(--ink)", "stroke-width": 3 });
      element(svg, "text", { x: left + 8, y: height - 14 }, `${bar} m`);
      dot = element(svg, "circle", { class: "here", r: 5, visibility: "hidden", style: `fill: ${colorOf(index)}; stroke: white; stroke-width: 2` });
    }

    /** Where the path starts and ends, and arrows along it. */
    function drawDirection() {
      const { x, y } = run.path, last = x.length - 1, group = element(svg, "g", { class: "direction" });
      let since = ARROW_EVERY_PX / 2;
      for (let i = 1; i <= last; i++) {
        const [dx, dy] = [toX(x[i]) - toX(x[i - 1]), toY(y[i]) - toY(y[i - 1])];
        since += Math.hypot(dx, dy);
        if (since < ARROW_EVERY_PX) continue;
        since = 0;
        const turn = Math.atan2(dy, dx) * 180 / Math.PI;
        element(group, "path", { d: "M5 0L-4 4L-4 -4Z", style: `fill: ${colorOf(index)}`, transform: `translate(${toX(x[i]).toFixed(1)} ${toY(y[i]).toFixed(1)}) rotate(${turn.toFixed(0)})` });
      }
      element(group, "rect", { x: toX(x[last]) - 6, y: toY(y[last]) - 6, width: 12, height: 12, style: "fill: var(--end)" });
      element(group, "circle", { cx: toX(x[0]), cy: toY(y[0]), r: 6, style: "fill: var(--start)" });
    }

    /** Lines between poses, as wide as told in metres where that is above zero; none where it is null. */
    function drawStretches(group, halfWidths) {
      const { x, y } = run.path, stride = halfWidths === band ? Math.ceil(x.length / 3000) : 1;
      for (let i = 0; i + stride < x.length; i += stride) {
        if (halfWidths[i] === null) continue;
        const width = halfWidths[i] ? { "stroke-width": Math.max(2 * halfWidths[i] * scale, 1).toFixed(1) } : {};
        element(group, "line", { x1: toX(x[i]).toFixed(1), y1: toY(y[i]).toFixed(1), x2: toX(x[i + stride]).toFixed(1), y2: toY(y[i + stride]).toFixed(1), ...width });
      }
    }

    function place(seconds) {
      dot.setAttribute("visibility", seconds === null ? "hidden" : "visible");
      if (seconds === null) { readOut.textContent = ""; return; }
      const i = nearest(run.path.t, seconds);
      dot.setAttribute("cx", toX(run.path.x[i]));
      dot.setAttribute("cy", toY(run.path.y[i]));
      const error = run.error ? `, ${short(run.error.m[nearest(run.error.t, run.path.t[i])])} m from the truth` : "";
      readOut.textContent = `${run.path.t[i]} s: x ${run.path.x[i]}, y ${run.path.y[i]}, z ${run.path.z[i]} m${error}`;
    }

    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect();
      const x = event.clientX - box.left, y = event.clientY - box.top;
      let best = 0, least = Infinity;
      run.path.x.forEach((_, i) => {
        const miss = (toX(run.path.x[i]) - x) ** 2 + (toY(run.path.y[i]) - y) ** 2;
        if (miss < least) { least = miss; best = i; }
      });
      follow(run.path.t[best]);
    });
    svg.addEventListener("pointerleave", () => follow(null));
    onDrag(svg, (low, high) => {
      const flat = high[1] - low[1] < 5 ? 5 : 0;
      [x0, x1, y0, y1] = [x0 + (low[0] - left) / scale, x0 + (high[0] - left) / scale, y1 - (high[1] + flat) / scale, y1 - low[1] / scale];
      draw();
    });
    svg.addEventListener("dblclick", () => { [x0, x1, y0, y1] = everything; draw(); });
    redraws.push(draw);
    followers.push(place);
  }

  // Loops: a table that sorts and filters ------------------------------------------------------------------

  const COLUMNS = [
    ["i", (loop) => loop.i], ["j", (loop) => loop.j], ["from, s", (loop) => loop.t[0]], ["to, s", (loop) => loop.t[1]],
    ["proposed by", (loop) => loop.by], ["matches", (loop) => loop.matches], ["inliers", (loop) => loop.inliers],
    ["RMSE, m", (loop) => loop.rmse_m], ["before, m", (loop) => loop.before_m], ["after, m", (loop) => loop.after_m],
    ["weight", (loop) => loop.weight], ["verdict", (loop) => loop.verdict], ["reason", (loop) => loop.reason],
  ];
  const ON_PHONES = ["i", "j", "inliers", "verdict", "reason"];
  const widthOf = (title) => ON_PHONES.includes(title) ? "" : "for-width";

  function loopsTable(box) {
    const loops = [...runs[Number(box.dataset.of)].loops];
    if (!loops.length) return;
    const controls = element(box, "div", { class: "controls" });
    const select = element(controls, "select", { "aria-label": "verdict" });
    for (const choice of ["all", "accepted", "rejected"]) element(select, "option", { value: choice }, choice);
    const table = element(element(box, "div", { class: "scroll", tabindex: 0 }), "table", { class: "sortable" });
    const head = element(element(table, "thead"), "tr"), body = element(table, "tbody");
    let sorted = null, rising = true;
    COLUMNS.forEach(([title, valueOf], column) => {
      element(head, "th", { class: widthOf(title) }, title).addEventListener("click", () => {
        rising = sorted === column ? !rising : true;
        sorted = column;
        loops.sort((a, b) => {
          const [p, q] = [valueOf(a), valueOf(b)];
          if (p === null || q === null) return (p === null) - (q === null); // unknown last, either way
          return (p < q ? -1 : p > q ? 1 : 0) * (rising ? 1 : -1);
        });
        fill();
      });
    });

    function fill() {
      body.replaceChildren();
      for (const loop of loops.filter((one) => select.value === "all" || one.verdict === select.value)) {
        const row = element(body, "tr", { class: loop.verdict });
        for (const [title, valueOf] of COLUMNS) {
          const value = valueOf(loop), isNumber = typeof value !== "string";
          element(row, "td", { class: `${isNumber ? "number " : ""}${widthOf(title)}` }, isNumber ? short(value) : value);
        }
      }
    }
    select.addEventListener("change", fill);
    fill();
  }

  // Which runs are shown, and which settings ---------------------------------------------------------------

  for (const input of document.querySelectorAll("input[data-run]"))
    input.addEventListener("change", () => {
      shown[Number(input.dataset.run)] = input.checked;
      for (const part of document.querySelectorAll(`[data-of="${input.dataset.run}"]`)) part.hidden = !input.checked;
      redraw();
    });

  const search = document.getElementById("setting"), differing = document.getElementById("differing");
  const sift = () => {
    for (const row of document.querySelectorAll("table.settings tbody tr"))
      row.hidden = !row.firstElementChild.textContent.includes(search.value.trim())
        || (differing.checked && !row.classList.contains("differs"));
  };
  search.addEventListener("input", sift);
  differing.addEventListener("change", sift);

  document.querySelectorAll("figure.plan").forEach(plan);
  document.querySelectorAll("figure.curve").forEach(curve);
  document.querySelectorAll("div.loops").forEach(loopsTable);
  sift();
  redraw();
  addEventListener("resize", redraw);
})();
