/** The detector in a thread of its own, so that the page stays responsive. Answers each message with one of its id. */

import * as ort from "./ort.wasm.bundle.min.mjs";
import { Detector } from "./detector.js";
import { changeBox, changePoints, inverse, levelFrame, liftBy } from "./frames.js";
import { sensorHeight } from "./ground.js";
import { readScan } from "./readers.js";
import { LOWEST_SCORE } from "./scores.js";

// More threads need headers that a plain file server does not send, and the PFN layer's graph allows only one.
ort.env.wasm.numThreads = 1;
ort.env.wasm.wasmPaths = { wasm: new URL("ort-wasm-simd-threaded.wasm", import.meta.url).href };

let detector;

const tasks = {
  async open() {
    const manifest = await (await fetched("bundle.json")).json();
    const graphs = {};
    for (const [name, { file }] of Object.entries(manifest.graphs)) {
      graphs[name] = new Uint8Array(await (await fetched(file)).arrayBuffer());
    }
    detector = await Detector.open({ ...manifest, spec: lowered(manifest.spec) }, graphs, ort);
    return manifest;
  },

  /** Points and boxes are shown level, x ahead, about the sensor; `save` holds the boxes in the scan's frame. */
  async detect({ name, buffer, sensor: { axes, height: given, around } }, id) {
    const level = levelFrame(axes || "x-forward");
    const scan = readScan(name, buffer);
    const points = changePoints(level, scan.points);
    self.postMessage({ id, preview: points });
    const height = sensorHeight(given, points);
    const trained = detector.manifest.expected_input.ground_z_m; // of the lowest and of the highest scan
    const lift = liftBy(height === undefined || !trained ? 0 : height + (trained[0] + trained[1]) / 2);
    const { passes, timesMs, counts, ...found } = await detector.detect(changePoints(lift, points), around);
    const detections = found.detections.map((one) => ({ ...one, box: changeBox(inverse(lift), one.box) }));
    const remarks = [...scan.remarks, ...found.remarks];
    if (given === "auto") remarks.push(`The sensor is ${height.toFixed(2)} m above the ground, estimated from this scan.`);
    const boxes = detections.map((one) => written(one.class, one.score, changeBox(inverse(level), one.box)));
    const merging = passes > 1 ? { passes, iou: detector.manifest.spec.post.nms_iou } : undefined;
    const save = { scan: name, times_ms: timesMs, ...counts, passes, warnings: remarks, boxes };
    return { points, detections, merging, timesMs, remarks, save };
  },
};

/** A box as `asca detect` writes it. */
function written(name, score, [x, y, z, length, width, height, yaw]) {
  return { class: name, score, x_m: x, y_m: y, z_m: z, length_m: length, width_m: width, height_m: height, yaw_rad: yaw };
}

/** The spec with low scores, and no limit but that of the candidates: the page filters what suppression leaves. */
function lowered({ classes, post, ...spec }) {
  const score = (own) => Math.min(own, LOWEST_SCORE);
  return {
    ...spec,
    classes: classes.map((class_) => ({ ...class_, score_threshold: score(class_.score_threshold) })),
    post: { ...post, max_detections: post.candidates },
  };
}

async function fetched(file) {
  const response = await fetch(file);
  if (!response.ok) throw new Error(`${file}: ${response.status} ${response.statusText}`);
  return response;
}

self.addEventListener("message", async ({ data: { id, task, ...given } }) => {
  try {
    self.postMessage({ id, result: await tasks[task](given, id) });
  } catch (error) {
    self.postMessage({ id, error: error.message });
  }
});
