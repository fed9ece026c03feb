// node golden.mjs MODULES GOLDEN BUNDLE: runs the page's modules on golden vectors; prints the largest difference of each array.
import { readFile } from "node:fs/promises";
import { join, resolve } from "node:path";
import { pathToFileURL } from "node:url";

const [modules, golden, bundle] = process.argv.slice(2).map((path) => resolve(path));
const load = (name) => import(pathToFileURL(join(modules, name)));
const { makeGrid } = await load("grid.js");
const { pillarize, Canvas } = await load("pillars.js");
const { NeckRulebookBuilder } = await load("rulebooks.js");
const { decodeCandidates, suppress } = await load("boxes.js");

const TYPES = {
  "<f4": Float32Array, "<i8": BigInt64Array, "<i4": Int32Array, "|u1": Uint8Array,
};

async function npy(stage, name) {
  const bytes = await readFile(join(golden, `${stage}.${name}.npy`));
  const length = bytes.readUInt16LE(8);
  const header = bytes.subarray(10, 10 + length).toString();
  const Values = TYPES[header.match(/'descr': '([^']+)'/)[1]];
  return new Values(bytes.buffer.slice(bytes.byteOffset + 10 + length, bytes.byteOffset + bytes.length));
}

const differences = {};
async function compare(stage, name, found) {
  const expected = await npy(stage, name);
  let largest = found.length === expected.length ? 0 : Infinity;
  for (let i = 0; i < expected.length; i++) {
    const difference = Math.abs(Number(found[i]) - Number(expected[i]));
    if (!(difference <= largest)) largest = difference;
  }
  differences[`${stage}.${name}`] = String(largest);
}

const { spec, pillar } = JSON.parse(await readFile(join(bundle, "bundle.json")));
const grid = makeGrid(spec.grid);
const pillars = pillarize(await npy("input", "points"), grid, spec.limits);
await compare("pillarize", "features", pillars.features);
await compare("pillarize", "pillar_index", pillars.pillarIndex);
await compare("pillarize", "point_counts", pillars.pointCounts);
await compare("pillarize", "cells", pillars.cells);

let headCells;
if (pillar.neck === "sparse") {
  const builder = new NeckRulebookBuilder(grid.ny, grid.nx, pillar.active_cells);
  builder.build(Int32Array.from({ length: grid.ny * grid.nx }, (_, cell) => cell)); // a scan before this one
  const rulebooks = builder.build(pillars.cells);
  for (const [name, table] of Object.entries(rulebooks.inputs)) await compare("rulebooks", name, table);
  headCells = rulebooks.headCells;
  await compare("neck_head", "cells", headCells);
} else {
  const canvas = new Canvas(grid, pillar.channels, pillar.canvas);
  canvas.scatter(canvas.values.slice(0, pillar.channels).fill(1), Int32Array.of(7)); // a scan before this one
  canvas.scatter(await npy("encode", "pillar_features"), pillars.cells);
  const rows = await npy("scatter", "rows");
  const width = pillar.channels;
  await compare("scatter", "values", Array.from(rows).flatMap((row) => [...canvas.values.subarray(Number(row) * width, (Number(row) + 1) * width)]));
  const filled = new Set(Array.from(rows, Number));
  differences["scatter.elsewhere"] = String(
    canvas.values.reduce((sum, value, i) => sum + (!filled.has(Math.floor(i / width)) && value !== canvas.empty[i % width]), 0),
  );
}

const maps = {};
for (const name of ["scores", "boxes", "directions"]) maps[name] = await npy("neck_head", name);
const candidates = decodeCandidates(maps, grid, spec, pillar.layout.anchor_yaws_rad, headCells);
for (const [stage, found] of [["decode", candidates], ["suppress", suppress(candidates, spec.post)]]) {
  await compare(stage, "boxes", found.flatMap(({ box }) => [...box]));
  await compare(stage, "scores", found.map(({ score }) => score));
  await compare(stage, "labels", found.map(({ label }) => label));
}
console.log(JSON.stringify(differences));
