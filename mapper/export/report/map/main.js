// Start of the map: decode what the page holds, then draw it; pictures take its place where that fails.

import { Editing } from "mapper/editing";
import { MapView } from "mapper/map_view";
import { Panel } from "mapper/panel";
import { RunLayers } from "mapper/run_layers";

const root = document.querySelector(".map");
const parsed = (id) => JSON.parse(document.getElementById(id)?.textContent ?? "null");
const edited = parsed("edited"), server = edited?.isServed ? new EventSource("open") : null; // at once: it counts the tab

function hasWebGl() {
  return Boolean(document.createElement("canvas").getContext("webgl2"));
}

async function start() {
  const stage = root.querySelector(".map-stage"), style = getComputedStyle(stage);
  const colorOf = (name) => style.getPropertyValue(`--${name}`).trim();
  const runs = parsed("data"), { ramp, maps } = parsed("maps");
  const layers = [];
  for (const [index, map] of maps.entries()) {
    const colors = Object.fromEntries(["truth", "accepted", "rejected", "doubtful", "start", "end"].map((name) => [name, colorOf(name)]));
    layers.push(await RunLayers.decoded(runs[index], map, { ...colors, run: colorOf(`run${index % 6}`) }));
  }
  const view = new MapView(root.querySelector("canvas"), layers, ramp);
  new Panel(root, view, { ramp, images: maps.map(({ images }) => images) });
  if (edited) new Editing(root, view, { ...edited, server });
  const [, seen] = /^#view=([-.\d,]+)$/.exec(location.hash) ?? [], numbers = (seen ?? "").split(",").map(Number);
  if (numbers.length === 6 && numbers.every(Number.isFinite)) view.navigation.lookFrom(numbers.slice(0, 3), numbers.slice(3));
  root.dataset.state = "ready";
}

if (hasWebGl()) start().catch((error) => { root.dataset.state = "pictures"; throw error; });
else root.dataset.state = "pictures";
