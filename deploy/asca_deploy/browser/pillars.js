/** Points -> pillars -> pseudo-image (asca_pillars/ops/pillar/prepare.py, docs/BUNDLE.md). */

import { cellOf } from "./grid.js";

const FEATURES = 9;

/**
 * Sort a scan's points into pillars and compute their nine features.
 * @param {Float32Array} points x, y, z in metres (LiDAR frame), reflectance 0..1 of each of N points
 * @param {object} grid of `makeGrid`
 * @param {{max_pillars: number, max_points: number}} limits `spec.limits` of bundle.json
 * @returns features (M x 9), pillarIndex (M), pointCounts (P), cells (P) ascending, and how many points lay outside
 */
export function pillarize(points, grid, limits) {
  const { order, cells, counts } = sortByCell(points, grid);
  const { kept, stays } = chosen(counts, limits);
  const rows = stays.reduce((sum, stay) => sum + stay, 0);
  const pillars = kept.reduce((sum, keep) => sum + keep, 0);
  const found = {
    features: new Float32Array(rows * FEATURES),
    pillarIndex: new BigInt64Array(rows),
    pointCounts: new BigInt64Array(pillars),
    cells: new Int32Array(pillars),
    outside: points.length / 4 - order.length,
  };
  let end = 0;
  let row = 0;
  let pillar = 0;
  for (let index = 0; index < cells.length; index++) {
    const start = end;
    end += counts[index];
    if (!kept[index]) continue;
    const members = [];
    for (let place = start; place < end; place++) if (stays[place]) members.push(order[place]);
    writePillar(found.features, row, points, members, grid, cells[index]);
    found.pillarIndex.fill(BigInt(pillar), row, row + members.length);
    found.pointCounts[pillar] = BigInt(members.length);
    found.cells[pillar] = cells[index];
    row += members.length;
    pillar += 1;
  }
  return found;
}

/** The nine features of one pillar's points, into the rows from `row` on. Sums are double, everything else float32. */
function writePillar(features, row, points, members, grid, cell) {
  const sums = [0, 0, 0];
  for (const point of members) for (let axis = 0; axis < 3; axis++) sums[axis] += points[4 * point + axis];
  const means = sums.map((sum) => Math.fround(sum / members.length));
  const center = [grid.columnCenters[cell % grid.nx], grid.rowCenters[Math.floor(cell / grid.nx)]];
  members.forEach((point, index) => {
    const out = (row + index) * FEATURES;
    for (let channel = 0; channel < 4; channel++) features[out + channel] = points[4 * point + channel];
    for (let axis = 0; axis < 3; axis++) features[out + 4 + axis] = points[4 * point + axis] - means[axis];
    for (let axis = 0; axis < 2; axis++) features[out + 7 + axis] = points[4 * point + axis] - center[axis];
  });
}

/** Points inside in the order of their cells, and the occupied cells, ascending, with how many points each holds. */
function sortByCell(points, grid) {
  const tally = new Int32Array(grid.nx * grid.ny);
  const cellOfPoint = new Int32Array(points.length / 4);
  let inside = 0;
  for (let point = 0; point < cellOfPoint.length; point++) {
    const cell = cellOf(grid, points[4 * point], points[4 * point + 1], points[4 * point + 2]);
    cellOfPoint[point] = cell;
    if (cell >= 0) {
      tally[cell] += 1;
      inside += 1;
    }
  }
  const cells = [];
  const counts = [];
  let position = 0;
  tally.forEach((count, cell) => {
    if (count === 0) return;
    cells.push(cell);
    counts.push(count);
    tally[cell] = position; // from here on: where the cell's next point goes
    position += count;
  });
  const order = new Int32Array(inside);
  cellOfPoint.forEach((cell, point) => {
    if (cell >= 0) order[tally[cell]++] = point;
  });
  return { order, cells, counts };
}

/** Whether each of `count` things in a row stays, if `most` may: at even steps. */
function evenly(count, most) {
  const share = Math.min(most, count);
  return Uint8Array.from({ length: count }, (_, k) =>
    Math.floor(((k + 1) * share) / count) > Math.floor((k * share) / count) ? 1 : 0,
  );
}

/** Which pillars stay, and which of the sorted points. */
function chosen(counts, limits) {
  const total = counts.reduce((sum, count) => sum + count, 0);
  const kept = evenly(counts.length, limits.max_pillars);
  const stays = new Uint8Array(total);
  let start = 0;
  counts.forEach((count, pillar) => {
    if (kept[pillar]) stays.set(evenly(count, limits.max_points), start);
    start += count;
  });
  return { kept, stays };
}

/** The pseudo-image (ny + 1, nx + 1, C), channels last; kept from scan to scan, and cleared where the last one stood. */
export class Canvas {
  /**
   * @param {object} grid of `makeGrid`
   * @param {number} channels C
   * @param {{type: string, empty: number[]}} format `pillar.canvas` of bundle.json
   */
  constructor(grid, channels, format) {
    const Values = format.type === "uint8" ? Uint8Array : Float32Array;
    this.grid = grid;
    this.channels = channels;
    this.shape = [1, grid.ny + 1, grid.nx + 1, channels];
    this.empty = Values.from(format.empty.length ? format.empty : new Array(channels).fill(0));
    this.values = new Values((grid.ny + 1) * (grid.nx + 1) * channels);
    for (let start = 0; start < this.values.length; start += channels) this.values.set(this.empty, start);
    this.rows = new Int32Array(0);
  }

  /** Write the features (P x C) of the pillars in `cells` (P). Row 0 and column 0 are the first convolution's padding. */
  scatter(features, cells) {
    for (const row of this.rows) this.values.set(this.empty, row * this.channels);
    this.rows = cells.map(
      (cell) => (Math.floor(cell / this.grid.nx) + 1) * (this.grid.nx + 1) + (cell % this.grid.nx) + 1,
    );
    this.rows.forEach((row, pillar) => {
      this.values.set(
        features.subarray(pillar * this.channels, (pillar + 1) * this.channels),
        row * this.channels,
      );
    });
  }
}
