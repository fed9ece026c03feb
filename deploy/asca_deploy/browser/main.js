/** The page: a detector, in a worker or behind `asca view`, the scene, and the panel beside it. */

import { Scene, cssColor } from "./scene.js";
import { LOWEST_SCORE, ScoreSliders } from "./scores.js";
import { ServedDetector, WorkerDetector, fetched } from "./sources.js";

const SAMPLE = "sample.bin";

const element = (id) => document.getElementById(id);
let scene;
let detector;
let sliders;
let colors = {}; // of the classes, red, green, blue 0..255: those of the pictures of `asca detect`
let last; // the file that was asked for
let found; // in the one that is shown
let files = []; // those that were opened together
let position = 0;
let busy = false;

async function start() {
  const page = await (await fetched("page.json")).json();
  scene = new Scene(element("scene"), element("labels"), page.heights);
  colors = page.colors;
  if (page.scans) {
    document.body.classList.add("served");
    detector = new ServedDetector();
    element("model").textContent = `${page.bundle}, ${page.runs_on}`;
    sliders = new ScoreSliders(element("scores"), page.classes, page.limit, show);
    files = page.scans.map((name, number) => ({ name, number }));
    await step(0);
    return;
  }
  detector = new WorkerDetector();
  const manifest = await detector.open();
  element("model").textContent = `${manifest.name}, ${manifest.precision}, in this browser`;
  const classes = manifest.spec.classes.map(({ name, score_threshold: score }) => ({
    name,
    score,
    lowest: Math.min(score, LOWEST_SCORE),
  }));
  sliders = new ScoreSliders(element("scores"), classes, manifest.spec.post.max_detections, show);
  await detect({ name: SAMPLE, buffer: await (await fetched(SAMPLE)).arrayBuffer() });
}

/** Run one file; `document.body.dataset.state` says when it is done. */
async function detect(file) {
  if (busy) return;
  busy = true;
  last = file;
  element("again").disabled = element("sensor").disabled = true;
  document.body.dataset.state = "busy";
  say(`${file.name}: detecting`);
  const [axes, height] = ["axes", "height"].map((id) => element(id).value.trim());
  const sensor = { axes, height, around: { around: true, ahead: false }[element("around").value] };
  try {
    found = { name: file.name, ...(await detector.detect(file, sensor, (points) => scene.show(points, []))) };
    show();
    document.body.dataset.state = "done";
  } catch (error) {
    fail(error.message);
  } finally {
    busy = false;
    element("again").disabled = element("sensor").disabled = false;
  }
}

/** Draw and list what was found, from the sliders' scores on. */
function show() {
  if (found === undefined) return;
  const { name: file, points, merging, remarks, timesMs, save: content } = found;
  const chosen = sliders.chosen(found.detections, merging);
  const detections = chosen.map((place) => found.detections[place]);
  const colored = detections.map((one) => ({ ...one, color: colors[one.class].map((value) => value / 255) }));
  scene.show(points, colored);
  const total = Object.values(timesMs).reduce((sum, time) => sum + time, 0);
  const seen = (content.points - content.points_outside).toLocaleString("en"); // by every pass, one after the other
  const where = content.passes === 1 ? `${seen} within the model's ranges` : `in ${content.passes} passes`;
  say([
    `${file}: ${detections.length} objects in ${total.toFixed(0)} ms.`,
    `${(points.length / 4).toLocaleString("en")} points, ${where}.`,
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
  save({ ...content, boxes: chosen.map((place) => content.boxes[place]) });
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
  if (chosen.length === 0 || busy || detector instanceof ServedDetector) return;
  files = [...chosen].sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
  position = 0;
  await step(0);
}

async function step(by) {
  if (busy || files[position + by] === undefined) return;
  position += by;
  const file = files[position];
  await detect(file instanceof File ? { name: file.name, buffer: await file.arrayBuffer() } : file);
  if (files.length > 1) element("place").textContent = `${position + 1} of ${files.length}, arrow keys for the others`;
  else element("place").textContent = "";
}

element("file").addEventListener("change", (event) => open(event.target.files));
document.addEventListener("keydown", (event) => {
  if (["range", "text"].includes(event.target.type)) return; // in which they move
  if (event.key === "ArrowRight") step(1);
  if (event.key === "ArrowLeft") step(-1);
});
element("again").addEventListener("click", () => detect(last));
element("sensor").addEventListener("change", () => detect(last));
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", kind === "dragover");
    if (kind === "drop") open(event.dataTransfer.files);
  });
}

start().catch((error) => fail(error.message));
