/** The plane of the ground near a sensor, and the sensor's height above it (asca_pillars/scans/ground_height.py). */

const NEAR_M = [3, 20];
const BAND_M = 0.12; // half the thickness of what counts as the plane
const MIN_CELLS = 40;
const MIN_SHARE = 0.3;
const MAX_SHARE_BELOW = 0.3;
const MAX_TILT = (5 * Math.PI) / 180;
const DRAWS = 200;
const REFITS = 3;
const MIN_AREA_M2 = 10;
const MIN_SPREAD = 1e-9;
const MAX_HEIGHT_M = 10;

/**
 * The height (m) of a sensor's origin as it was given, estimated from its scan for "auto"; undefined: as in training.
 * @param {string} given as `asca detect --sensor-height` takes it, or empty
 * @param {Float32Array} points x, y, z and reflectance of each of N points, x forward, y left, z up
 */
export function sensorHeight(given, points) {
  if (given === "") return undefined;
  if (given === "auto") {
    const { height, doubt } = groundPlane(points);
    if (doubt) throw new Error(`the sensor's height cannot be estimated: ${doubt}; give metres above the ground`);
    return height;
  }
  const height = /^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)$/.test(given) ? Number(given) : NaN;
  if (!(Math.abs(height) <= MAX_HEIGHT_M)) {
    throw new Error(`sensor height ${given.slice(0, 40)}: give metres above the ground, at most ${MAX_HEIGHT_M}, or auto`);
  }
  return height;
}

/**
 * The plane through most low points near the sensor; of several points `step` apart.
 * @returns {{height: number, normal: number[], doubt: string?}} the origin's height above it, its unit normal upwards,
 *   and why it may not be the ground
 */
export function groundPlane(points, step = 1) {
  const low = lowPoints(points, step);
  const plane = low.length < MIN_CELLS ? null : commonPlane(low);
  if (plane === null) return { doubt: "too few points near the sensor, or all on one line" };
  const above = low.map((point) => point[2] - heightAt(plane, point));
  const share = above.filter((height) => Math.abs(height) < BAND_M).length / low.length;
  const below = above.filter((height) => height < -2 * BAND_M).length / low.length;
  const [a, b, c] = plane;
  const length = Math.hypot(a, b, 1);
  let doubt;
  if (share < MIN_SHARE || below > MAX_SHARE_BELOW) {
    doubt = `only ${percent(share)} of the low points lie on a plane, ${percent(below)} below it`;
  } else if (Math.atan(Math.hypot(a, b)) > MAX_TILT) doubt = "the ground is tilted";
  return { height: -c, normal: [-a / length, -b / length, 1 / length], doubt };
}

const percent = (share) => `${Math.round(100 * share)}%`;
const heightAt = ([a, b, c], [x, y]) => a * x + b * y + c;

/** One point per square metre near the sensor: the one at the tenth percentile of z. */
function lowPoints(points, step) {
  const cells = new Map();
  for (let i = 0; i < points.length; i += 4 * step) {
    const [x, y, z] = points.subarray(i, i + 3);
    const squared = x * x + y * y;
    if (!(squared > NEAR_M[0] ** 2 && squared < NEAR_M[1] ** 2)) continue;
    const cell = 1000 * Math.floor(x) + Math.floor(y);
    if (!cells.has(cell)) cells.set(cell, []);
    cells.get(cell).push([x, y, z]);
  }
  return [...cells]
    .filter(([, own]) => own.length >= 3)
    .sort(([a], [b]) => a - b)
    .map(([, own]) => own.sort((a, b) => a[2] - b[2])[Math.floor(own.length / 10)]);
}

/** The plane z = a x + b y + c that most points lie on, by RANSAC with the same draws each time, or null. */
function commonPlane(points) {
  const near = (plane) => points.filter((point) => Math.abs(point[2] - heightAt(plane, point)) < BAND_M);
  const random = generator();
  const draw = () => points[Math.floor(random() * points.length)];
  let best = null;
  let most = -1;
  for (let number = 0; number < DRAWS; number++) {
    const plane = planeThrough(draw(), draw(), draw());
    const count = plane === null ? -1 : near(plane).length;
    if (count > most) [best, most] = [plane, count];
  }
  for (let refit = 0; refit < REFITS && best !== null; refit++) best = leastSquares(near(best));
  return best;
}

/** Numbers in [0, 1), each time the same (mulberry32's mixing). */
function generator() {
  let state = 0;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 2 ** 32;
  };
}

function planeThrough(p, q, r) {
  const [u, v] = [q, r].map((end) => end.map((value, axis) => value - p[axis]));
  const twice = u[0] * v[1] - u[1] * v[0];
  if (!(Math.abs(twice) > MIN_AREA_M2)) return null;
  const a = (u[2] * v[1] - u[1] * v[2]) / twice;
  const b = (u[0] * v[2] - u[2] * v[0]) / twice;
  return [a, b, p[2] - a * p[0] - b * p[1]];
}

function leastSquares(points) {
  if (points.length < 3) return null;
  const mean = [0, 1, 2].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
  const moment = (i, j) => points.reduce((sum, point) => sum + (point[i] - mean[i]) * (point[j] - mean[j]), 0);
  const [xx, xy, yy, xz, yz] = [moment(0, 0), moment(0, 1), moment(1, 1), moment(0, 2), moment(1, 2)];
  const divisor = xx * yy - xy * xy;
  if (!(divisor > MIN_SPREAD * xx * yy)) return null;
  const [a, b] = [(xz * yy - yz * xy) / divisor, (yz * xx - xz * xy) / divisor];
  return [a, b, mean[2] - a * mean[0] - b * mean[1]];
}
