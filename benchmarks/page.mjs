// node benchmarks/page.mjs PAGE: CPU time of each scan by the page that `asca export --browser` wrote, its sample again and
// again, in node. The same modules and the same WebAssembly as in a browser's tab, without its drawing.
import { readFile } from "node:fs/promises";
import { join, resolve } from "node:path";
import { pathToFileURL } from "node:url";

const page = resolve(process.argv[2]);
const load = (name) => import(pathToFileURL(join(page, name)));
const bytes = async (name) => new Uint8Array(await readFile(join(page, name)));

const ort = await load("ort.wasm.bundle.min.mjs");
const { Detector } = await load("detector.js");
const { readScan } = await load("readers.js");
ort.env.wasm.numThreads = 1;
ort.env.wasm.wasmBinary = await bytes("ort-wasm-simd-threaded.wasm");

const manifest = JSON.parse(await readFile(join(page, "bundle.json")));
const graphs = {};
for (const [name, { file }] of Object.entries(manifest.graphs)) graphs[name] = await bytes(file);
const detector = await Detector.open(manifest, graphs, ort);
const { points } = readScan("sample.bin", (await bytes("sample.bin")).buffer);
const times = [];
for (let scan = 0; scan < 12; scan++) {
  const start = process.cpuUsage();
  await detector.detect(points);
  const { user, system } = process.cpuUsage(start);
  times.push((user + system) / 1000);
}
const warm = times.slice(2).sort((a, b) => a - b);
console.log(`${manifest.name}: first ${times[0].toFixed(0)} ms, then ${warm[warm.length / 2].toFixed(0)} ms of CPU time per scan, node ${process.version}`);
