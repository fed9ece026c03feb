/** Head maps -> boxes: threshold, decode, rotated non-maximum suppression, votes (asca_pillars/detection/decode.py). */

const DIRECTION_OFFSET = Math.PI / 4; // where bundle.json does not say
const MAX_LOG_RATIO = Math.log(100);
const VOTE_SCORE = 0.1; // from which on a box votes, reported or not

/**
 * Boxes that enter suppression, class by class, the best first: those above their class's threshold, and where boxes
 * vote those above VOTE_SCORE, which are not `reported`.
 * @param {{scores: Float32Array, boxes: Float32Array, directions: Float32Array}} maps of the head, channels last
 * @param {object} grid of `makeGrid`
 * @param {object} spec of bundle.json
 * @param {number[]} yaws `pillar.layout.anchor_yaws_rad`
 * @param {Int32Array} [cells] of the head's map whose rows the maps hold, ascending; all of them if left out
 * @returns {{box: Float32Array, score: number, label: number, reported: boolean}[]} box: x, y, z, length, width,
 *   height, yaw
 */
export function decodeCandidates(maps, grid, spec, yaws, cells) {
  const anchors = spec.classes.length * yaws.length;
  const logitOf = (score) => Math.log(score / (1 - score));
  const thresholds = spec.classes.map(({ score_threshold: score }) => logitOf(score));
  const floors = thresholds.map((least) => (spec.post.vote_iou == null ? least : Math.min(least, logitOf(VOTE_SCORE))));
  const offset = spec.direction_offset_rad ?? DIRECTION_OFFSET;
  const best = spec.classes.map(() => []);
  maps.scores.forEach((logit, index) => {
    const anchor = index % anchors;
    const label = Math.floor(anchor / yaws.length);
    if (logit >= floors[label]) best[label].push({ logit, anchor, row: (index - anchor) / anchors, label });
  });
  const chosen = best.flatMap((own) =>
    own
      .sort((a, b) => b.logit - a.logit || a.anchor - b.anchor || a.row - b.row)
      .slice(0, spec.post.candidates),
  );
  return chosen
    .map(({ logit, anchor, row, label }) => {
      const own = anchorBox(grid, spec.classes[label], cells ? cells[row] : row, yaws[anchor % yaws.length]);
      const [box, score] = [decodeBox(maps, row * anchors + anchor, own, offset), 1 / (1 + Math.exp(-logit))];
      return { box, score, label, reported: logit >= thresholds[label] };
    })
    .filter(({ box, score }) => box.every(Number.isFinite) && Number.isFinite(score));
}

/** Center, size and yaw of a class's anchor in a cell of the head's map. */
function anchorBox(grid, class_, cell, yaw) {
  const columns = grid.headColumnCenters.length;
  const x = grid.headColumnCenters[cell % columns];
  const y = grid.headRowCenters[Math.floor(cell / columns)];
  return [x, y, class_.z_m, class_.length_m, class_.width_m, class_.height_m, yaw].map(Math.fround);
}

function decodeBox(maps, place, [x, y, z, length, width, height, yaw], offset) {
  const residual = maps.boxes.subarray(7 * place, 7 * place + 7);
  const bin = maps.directions[2 * place + 1] > maps.directions[2 * place] ? 1 : 0;
  const diagonal = Math.hypot(length, width);
  const grow = (ratio) => Math.exp(Math.min(Math.max(ratio, -MAX_LOG_RATIO), MAX_LOG_RATIO));
  const heading = offset + Math.PI * bin + modulo(residual[6] + yaw - offset, Math.PI);
  return Float32Array.of(
    x + residual[0] * diagonal,
    y + residual[1] * diagonal,
    z + residual[2] * height,
    length * grow(residual[3]),
    width * grow(residual[4]),
    height * grow(residual[5]),
    modulo(heading + Math.PI, 2 * Math.PI) - Math.PI,
  );
}

/**
 * Rotated non-maximum suppression within each class, seen from above; then the best of all classes, best first.
 * @param {{box: Float32Array, score: number, label: number, reported: ?boolean}[]} candidates of `decodeCandidates`, or
 *   others, of which all are reported
 * @param {{nms_iou: number, max_detections: number, vote_iou: ?number}} post `spec.post` of bundle.json
 */
export function suppress(candidates, post) {
  const kept = [];
  for (const candidate of candidates) {
    if (candidate.reported === false) continue;
    const own = kept.filter((other) => other.label === candidate.label);
    if (own.length < post.max_detections && own.every((other) => bevIou(other.box, candidate.box) <= post.nms_iou)) {
      kept.push(candidate);
    }
  }
  const best = kept.sort((a, b) => b.score - a.score).slice(0, post.max_detections);
  return post.vote_iou == null ? best : best.map((own) => ({ ...own, box: votedBox(own, candidates, post.vote_iou) }));
}

/** The mean of the boxes of its class that overlap a kept one, weighted with score squared and overlap: `vote_boxes`. */
function votedBox(own, candidates, iouThreshold) {
  const sums = new Float64Array(7);
  let total = 0;
  for (const other of candidates) {
    if (other.label !== own.label) continue;
    const iou = bevIou(own.box, other.box);
    if (iou < iouThreshold) continue;
    const weight = other.score ** 2 * iou;
    total += weight;
    other.box.forEach((value, axis) => {
      const difference = value - own.box[axis];
      // Half a turn does not change a footprint: the kept box alone says which end is the front.
      const step = axis < 6 ? difference : difference - Math.PI * Math.floor(difference / Math.PI + 0.5);
      sums[axis] += weight * step;
    });
  }
  const box = own.box.map((value, axis) => value + (total > 0 ? sums[axis] / total : 0));
  box[6] = modulo(box[6] + Math.PI, 2 * Math.PI) - Math.PI;
  return box;
}

/** Intersection over union of the footprints of two boxes. */
export function bevIou(a, b) {
  const reach = (Math.hypot(a[3], a[4]) + Math.hypot(b[3], b[4])) / 2;
  if (Math.hypot(a[0] - b[0], a[1] - b[1]) >= reach) return 0;
  const shared = area(clip(corners(a), corners(b)));
  const union = a[3] * a[4] + b[3] * b[4] - shared;
  return union > 0 ? shared / union : 0;
}

/** The four corners of a box's footprint, counter-clockwise, metres. */
export function corners([x, y, , length, width, , yaw]) {
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([along, across]) => {
    const [forward, left] = [(along * length) / 2, (across * width) / 2];
    return [x + cos * forward - sin * left, y + sin * forward + cos * left];
  });
}

/** The part of a convex polygon within another one (Sutherland and Hodgman); both counter-clockwise. */
function clip(polygon, window) {
  window.forEach(([x0, y0], index) => {
    const [x1, y1] = window[(index + 1) % window.length];
    const side = ([x, y]) => (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0); // positive inside
    polygon = polygon.flatMap((end, place) => {
      const start = polygon[(place + polygon.length - 1) % polygon.length];
      const [before, after] = [side(start), side(end)];
      const share = before / (before - after);
      const border = [start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])];
      if (after >= 0) return before >= 0 ? [end] : [border, end];
      return before >= 0 ? [border] : [];
    });
  });
  return polygon;
}

function area(polygon) {
  const twice = polygon.reduce((sum, [x, y], index) => {
    const [nextX, nextY] = polygon[(index + 1) % polygon.length];
    return sum + x * nextY - nextX * y;
  }, 0);
  return Math.max(twice / 2, 0);
}

/** The remainder in [0, divisor), as NumPy's mod gives it. */
function modulo(value, divisor) {
  return value - divisor * Math.floor(value / divisor);
}
