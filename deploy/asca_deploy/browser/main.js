/** The page: the worker's detector, the scene, and the panel beside it. */

import { Scene, cssColor } from "./scene.js";

const SAMPLE = "sample.bin";

const element = (id) => document.getElementById(id);
const worker = new Worker("worker.js", { type: "module" });
const waiting = new Map();
let scene;
let colors = {}; // of the classes, red, green, blue 0..255: those of the pictures of `asca detect`
let last; // the file that is shown
let files = []; // those that were opened together
let position = 0;
let busy = false;
let asked = 0;

/** Let the worker do one of its tasks. */
function ask(task, given = {}) {
  const id = asked++;
  worker.postMessage({ id, task, ...given });
  return new Promise((resolve, reject) => waiting.set(id, { resolve, reject }));
}

worker.addEventListener("message", ({ data: { id, result, error, preview } }) => {
  if (preview !== undefined) { // the points of a scan, before its boxes are there
    scene.show(preview, []);
    return;
  }
  const { resolve, reject } = waiting.get(id);
  waiting.delete(id);
  if (error === undefined) resolve(result);
  else reject(new Error(error));
});
worker.addEventListener("error", (event) => fail(event.message || "worker.js cannot be loaded"));

async function start() {
  scene = new Scene(element("scene"), element("labels"));
  const manifest = await ask("open");
  colors = (await (await fetched("page.json")).json()).colors;
  element("model").textContent = `${manifest.name}, ${manifest.precision}, in this browser`;
  await detect({ name: SAMPLE, buffer: await (await fetched(SAMPLE)).arrayBuffer() });
}

async function fetched(file) {
  const response = await fetch(file);
  if (!response.ok) throw new Error(`${file}: ${response.status} ${response.statusText}`);
  return response;
}

/** Run one file; `document.body.dataset.state` says when it is done. */
async function detect(file) {
  if (busy) return;
  busy = true;
  document.body.dataset.state = "busy";
  say(`${file.name}: detecting`);
  try {
    const found = await ask("detect", file);
    last = file;
    show(file, found);
    document.body.dataset.state = "done";
  } catch (error) {
    fail(error.message);
  } finally {
    busy = false;
    element("again").disabled = last === undefined;
  }
}

function show(file, { points, remarks, detections, timesMs, counts }) {
  const colored = detections.map((found) => ({ ...found, color: colors[found.class].map((value) => value / 255) }));
  scene.show(points, colored);
  const total = Object.values(timesMs).reduce((sum, time) => sum + time, 0);
  const seen = counts.points - counts.points_outside;
  say([
    `${file.name}: ${detections.length} objects in ${total.toFixed(0)} ms.`,
    `${counts.points.toLocaleString("en")} points, ${seen.toLocaleString("en")} within the model's ranges.`,
    ...remarks,
  ].join(" "));
  const times = [...Object.entries(timesMs), ["total", total]];
  fill("times", times.map(([stage, time]) => row([stage, `${time.toFixed(1)} ms`], stage)));
  fill("boxes", colored.map(({ class: name, score, box: [x, y], color, box }) => {
    const line = row([name, score.toFixed(2), `${x.toFixed(1)} m`, `${y.toFixed(1)} m`, `${Math.hypot(x, y).toFixed(1)} m`]);
    line.firstChild.style.color = cssColor(color);
    line.addEventListener("click", () => scene.lookAt(box));
    return line;
  }));
  save({ scan: file.name, times_ms: timesMs, ...counts, warnings: remarks, boxes: detections.map(plain) });
}

/** A box as `asca detect` writes it. */
function plain({ class: name, score, box: [x, y, z, length, width, height, yaw] }) {
  return { class: name, score, x_m: x, y_m: y, z_m: z, length_m: length, width_m: width, height_m: height, yaw_rad: yaw };
}

function save(content) {
  const link = element("save");
  URL.revokeObjectURL(link.href);
  link.href = URL.createObjectURL(new Blob([JSON.stringify(content, null, 1)], { type: "application/json" }));
  link.hidden = false;
}

function row(cells, name) {
  const line = document.createElement("tr");
  line.className = name === "total" ? "total" : "";
  line.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
  return line;
}

function fill(table, rows) {
  element(table).tBodies[0].replaceChildren(...rows);
}

function say(text) {
  element("status").className = "";
  element("status").textContent = text;
}

function fail(message) {
  element("status").className = "failed";
  element("status").textContent = message;
  document.body.dataset.state = "failed";
}

/** Open the first of some files; the arrow keys go to the others. */
async function open(chosen) {
  if (chosen.length === 0 || busy) return;
  files = [...chosen].sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
  position = 0;
  await step(0);
}

async function step(by) {
  if (busy || files[position + by] === undefined) return;
  position += by;
  const file = files[position];
  await detect({ name: file.name, buffer: await file.arrayBuffer() });
  if (files.length > 1) element("place").textContent = `${position + 1} of ${files.length}, arrow keys for the others`;
  else element("place").textContent = "";
}

element("file").addEventListener("change", (event) => open(event.target.files));
document.addEventListener("keydown", (event) => {
  if (event.key === "ArrowRight") step(1);
  if (event.key === "ArrowLeft") step(-1);
});
element("again").addEventListener("click", () => detect(last));
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", kind === "dragover");
    if (kind === "drop") open(event.dataTransfer.files);
  });
}

start().catch((error) => fail(error.message));
