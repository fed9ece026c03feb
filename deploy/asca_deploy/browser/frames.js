/** From one coordinate frame to another: p -> axes p + shift, metres (asca_pillars/geometry/frame_change.py, scans/mounting.py). */

const NAMED_AXES = { "x-forward": "x,y,z", "y-forward": "y,-x,z" };
const EXAMPLES = "x-forward, y-forward or three signed axes, such as -y,x,z: where forward, left and up are found in the scan";

/** The turn counter-clockwise about z by an angle; quarter turns are exact. */
export function turnBy(angle) {
  const quarters = Math.round(angle / (Math.PI / 2));
  const exact = [[1, 0], [0, 1], [-1, 0], [0, -1]][((quarters % 4) + 4) % 4];
  const isExact = Math.abs(angle - (quarters * Math.PI) / 2) < 1e-12;
  const [cos, sin] = isExact ? exact : [Math.cos(angle), Math.sin(angle)];
  return { axes: [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], shift: [0, 0, 0] };
}

/** The change to x forward, y left, z up, from axes as `asca detect --axes` takes them. */
export function levelFrame(text) {
  const words = (Object.hasOwn(NAMED_AXES, text) ? NAMED_AXES[text] : text).split(",");
  const found = words.map((word) => /^\+*(-?)([xyz])$/.exec(word.trim()));
  const names = found.map((match) => match?.[2] ?? "").sort().join("");
  if (names !== "xyz") throw new Error(`axes ${text.slice(0, 40)}: give ${EXAMPLES}`);
  const axes = found.map(([, sign, name]) => [..."xyz"].map((axis) => (axis === name ? Number(`${sign}1`) : 0)));
  if (axes[2][2] === 0) throw new Error(`axes ${text}: boxes turn about the scan's z axis, which must point up or down`);
  return { axes, shift: [0, 0, 0] };
}

/** The shift along z by so many metres. */
export function liftBy(height) {
  return { ...turnBy(0), shift: [0, 0, height] };
}

/** The way back. */
export function inverse({ axes, shift }) {
  const back = transposed(axes);
  return { axes: back, shift: back.map((row) => -dot(row, shift)) };
}

export function isIdentity({ axes, shift }) {
  return axes.every((row, i) => row.every((value, j) => value === Number(i === j))) && shift.every((value) => value === 0);
}

/** Points (x, y, z, reflectance of each) in the new frame, in float32 as NumPy computes them; the same array if nothing changes. */
export function changePoints(change, points) {
  if (isIdentity(change)) return points;
  const { fround } = Math;
  const rows = change.axes.map((row) => row.map(fround));
  const shift = change.shift.map(fround);
  const changed = points.slice();
  for (let i = 0; i < points.length; i += 4) {
    for (let axis = 0; axis < 3; axis++) {
      const [a, b, c] = rows[axis];
      const sum = fround(fround(a * points[i]) + fround(b * points[i + 1]));
      changed[i + axis] = fround(sum + fround(c * points[i + 2])) + shift[axis];
    }
  }
  return changed;
}

/** A box in the new frame: its center moves with the points, its heading turns as seen from above. */
export function changeBox(change, box) {
  if (isIdentity(change)) return box;
  const { axes, shift } = change;
  const [x, y, z, length, width, height, yaw] = box;
  const center = axes.map((row, axis) => dot(row, [x, y, z]) + shift[axis]);
  const [forward, left] = axes.slice(0, 2).map((row) => dot(row, [Math.cos(yaw), Math.sin(yaw), 0]));
  return Float32Array.of(...center, length, width, height, Math.atan2(left, forward));
}

function dot(a, b) {
  return a.reduce((sum, value, i) => sum + value * b[i], 0);
}

export function transposed(matrix) {
  return matrix[0].map((_, column) => matrix.map((row) => row[column]));
}

export function product(a, b) {
  return a.map((row) => transposed(b).map((column) => dot(row, column)));
}
