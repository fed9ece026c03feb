/** The detector in a thread of its own, so that the page stays responsive. Answers each message with one of its id. */

import * as ort from "./ort.wasm.bundle.min.mjs";
import { Detector } from "./detector.js";
import { readScan } from "./readers.js";
import { LOWEST_SCORE } from "./scores.js";

// More threads need headers that a plain file server does not send, and the encoder's graph allows only one.
ort.env.wasm.numThreads = 1;
ort.env.wasm.wasmPaths = { wasm: new URL("ort-wasm-simd-threaded.wasm", import.meta.url).href };

let detector;

const tasks = {
  async open() {
    const manifest = await (await fetched("bundle.json")).json();
    const bytes = async (graph) => new Uint8Array(await (await fetched(manifest.graphs[graph].file)).arrayBuffer());
    const graphs = { encoder: await bytes("encoder"), backbone: await bytes("backbone") };
    detector = await Detector.open({ ...manifest, spec: lowered(manifest.spec) }, graphs, ort);
    return manifest;
  },

  async detect({ name, buffer }, id) {
    const { points, remarks } = readScan(name, buffer);
    self.postMessage({ id, preview: points });
    const found = await detector.detect(points);
    return { ...found, points, remarks: [...remarks, ...found.remarks] };
  },
};

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
