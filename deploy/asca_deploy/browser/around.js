/** Every direction: wider ranges where the graphs allow them, else turned passes (asca_deploy/around.py). */

import { suppress } from "./boxes.js";
import { isIdentity, product, transposed, turnBy } from "./frames.js";
import { groundPlane } from "./ground.js";

const CAMERA_FIELD = Math.PI / 4; // to each side of a camera's view
const SEAM_MARGIN = (10 * Math.PI) / 180;
const STEP = Math.PI / 180;
const GROUND_POINTS = 10_000;
const NECK_STRIDE = 8;

/**
 * `spec` of a bundle with ranges that reach in every direction as far as its own do in one; its own spec where the
 * graphs do not allow it, as those of a dense neck and those that were trained on a camera's view.
 */
export function widenRanges({ spec, pillar, expected_input: expected }) {
  const { grid, limits } = spec;
  if (pillar.neck !== "sparse" || expected.camera_view || grid.zones > 1) return spec;
  const reach = Math.max(...[...grid.x_range_m, ...grid.y_range_m].map(Math.abs));
  const end = (pillarM) => {
    const step = NECK_STRIDE * pillarM;
    return Math.round(Math.ceil(reach / step - 1e-6) * step * 1e6) / 1e6;
  };
  const [x, y] = [end(grid.v_max_m), end(grid.v_y_m)];
  const square = { ...grid, x_range_m: [-x, x], y_range_m: [-y, y] };
  const cells = ({ x_range_m: [left, right], y_range_m: [bottom, top] }) =>
    Math.round((right - left) / grid.v_max_m) * Math.round((top - bottom) / grid.v_y_m);
  const pillars = Math.ceil(limits.max_pillars * (cells(square) / cells(grid)));
  return { ...spec, grid: square, limits: { ...limits, max_pillars: pillars } };
}

/**
 * What each pass turns the scan by; the first one by nothing. One pass where the model looks all around.
 * @param {object} grid `spec.grid` of bundle.json
 * @param {boolean} cameraView `expected_input.camera_view`
 */
export function turnsAround({ x_range_m: [xLow, xHigh], y_range_m: [yLow, yHigh] }, cameraView) {
  const enough = Math.min(xHigh, -yLow, yHigh);
  if (enough <= 0) throw new Error("the model does not see ahead and to both sides, so that it cannot look all around");
  const sees = (halfSector) => {
    const end = Math.min(halfSector + SEAM_MARGIN, Math.PI);
    for (let step = 0; step * STEP < end; step++) {
      const [x, y] = [enough * Math.cos(step * STEP), enough * Math.sin(step * STEP)];
      if (!(x >= Math.min(xLow, 0) && x <= xHigh && y <= yHigh && -y >= yLow)) return false;
    }
    return true;
  };
  const field = cameraView ? CAMERA_FIELD : Math.PI;
  let passes = 1;
  while (Math.PI / passes > field + 1e-9 || !sees(Math.PI / passes)) passes++;
  return Array.from({ length: passes }, (_, number) => turnBy((-2 * Math.PI * number) / passes));
}

/** The turns about the normal of a scan's ground, in which the ground lies as before them; about z where none is sure. */
export function aboutGround(turns, points) {
  const { normal: up, doubt } = groundPlane(points, Math.max(1, Math.floor(points.length / 4 / GROUND_POINTS)));
  if (doubt) return turns;
  const ahead = [1, 0, 0].map((value, axis) => value - up[0] * up[axis]);
  const forward = ahead.map((value) => value / Math.hypot(...ahead));
  const left = [[1, 2], [2, 0], [0, 1]].map(([a, b]) => up[a] * forward[b] - up[b] * forward[a]);
  const level = [forward, left, up];
  return turns.map((turn) =>
    isIdentity(turn) ? turn : { ...turn, axes: product(transposed(level), product(turn.axes, level)) },
  );
}

/**
 * The boxes that the sensor is not in; one that it is in, seen from above, is the vehicle that carries it.
 * @param {{box: number[]|Float32Array}[]} found in the model's frame
 */
export function withoutOwnVehicle(found) {
  return found.filter(({ box: [x, y, , length, width, , yaw] }) => {
    const along = x * Math.cos(yaw) + y * Math.sin(yaw);
    const across = y * Math.cos(yaw) - x * Math.sin(yaw);
    return Math.abs(along) > length / 2 || Math.abs(across) > width / 2;
  });
}

/**
 * The boxes of all passes, each object once, best first: of those of a class that overlap, the one stays that its pass
 * sees nearest to straight ahead.
 * @param {{box: Float32Array, score: number, label: any, offAhead: number}[]} found in one frame; `offAhead`: the angle
 *   from straight ahead at which its pass sees it
 * @param {{passes: number, iou: number}} merging how many, and `spec.post.nms_iou` of bundle.json
 */
export function merge(found, { passes, iou }) {
  const own = found.filter(({ offAhead }) => offAhead <= Math.PI / passes + SEAM_MARGIN);
  return suppress(own.sort((a, b) => a.offAhead - b.offAhead), { nms_iou: iou, max_detections: Infinity });
}
