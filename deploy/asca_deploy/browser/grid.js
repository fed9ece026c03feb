/** The pillar grid that bundle.json describes (asca_pillars/ops/pillar/grid.py): cells of points, and where cells stand. */

const HEAD_STRIDE = 2;

/**
 * Tables of the grid. Borders are float32, as points are; columns run along x and rows along y.
 * @param {object} grid `spec.grid` of bundle.json
 */
export function makeGrid(grid) {
  if (grid.map === "pooled" && grid.zones > 1) {
    throw new Error("this page runs bundles with a warped map; `spec.grid.map` is pooled");
  }
  const [xLow, xHigh] = grid.x_range_m;
  const [yLow, yHigh] = grid.y_range_m;
  const firstColumns = Math.round((xHigh - xLow) / (grid.zones * grid.v_max_m));
  const ny = Math.round((yHigh - yLow) / grid.v_y_m);
  // The x range in slices of the finest depth: every column's border is one of a slice.
  const slices = grid.zones * firstColumns * 2 ** (grid.zones - 1);
  const sliceEdges = linspace(xLow, xHigh, slices);
  const columnOfSlice = new Int32Array(slices);
  const xEdges = [];
  let slice = 0;
  for (let zone = 0; zone < grid.zones; zone++) {
    for (let column = 0; column < firstColumns * 2 ** zone; column++) {
      const depth = 2 ** (grid.zones - 1 - zone);
      columnOfSlice.fill(xEdges.length, slice, slice + depth);
      xEdges.push(sliceEdges[slice]);
      slice += depth;
    }
  }
  xEdges.push(sliceEdges[slices]);
  const yEdges = linspace(yLow, yHigh, ny);
  return {
    nx: xEdges.length - 1,
    ny,
    ranges: [grid.x_range_m, grid.y_range_m, grid.z_range_m].map((range) => Float32Array.from(range)),
    sliceEdges: Float32Array.from(sliceEdges),
    columnOfSlice,
    rowEdges: Float32Array.from(yEdges),
    columnCenters: Float32Array.from(centers(xEdges, 1)),
    rowCenters: Float32Array.from(centers(yEdges, 1)),
    headColumnCenters: Float32Array.from(centers(xEdges, HEAD_STRIDE)),
    headRowCenters: Float32Array.from(centers(yEdges, HEAD_STRIDE)),
  };
}

/** Flat cell index row * nx + column of a point in metres, or -1 outside the ranges; borders belong to the cell above. */
export function cellOf(grid, x, y, z) {
  const [xs, ys, zs] = grid.ranges;
  if (!(x >= xs[0] && x < xs[1] && y >= ys[0] && y < ys[1] && z >= zs[0] && z < zs[1])) return -1;
  return interval(y, grid.rowEdges) * grid.nx + grid.columnOfSlice[interval(x, grid.sliceEdges)];
}

// As in asca_pillars/scans/input_check.py.
const BEHIND_SHARE = 0.2;
const BODY_M = 3;

/**
 * Per cent of the points behind the sensor, where the model does not look; 0 below BEHIND_SHARE.
 * @param {object} grid of `makeGrid`
 * @param {Float32Array} points x, y, z in metres and reflectance of each of N points
 * @returns {number}
 */
export function percentBehind(grid, points) {
  const [[xLow, xHigh], [yLow, yHigh]] = grid.ranges;
  const reach = Math.min(xHigh, -yLow, yHigh);
  let away = 0;
  let behind = 0;
  for (let i = 0; i < points.length; i += 4) {
    const [x, y] = [points[i], points[i + 1]];
    if (Math.max(Math.abs(x), Math.abs(y)) <= BODY_M) continue;
    away += 1;
    if (reach > 0 && x * reach < Math.min(xLow, 0) * Math.hypot(x, y)) behind += 1;
  }
  return away === 0 || behind / away < BEHIND_SHARE ? 0 : Math.round((100 * behind) / away);
}

/** Index of the interval [edges[i], edges[i + 1]) around a value, for evenly spaced edges. */
function interval(value, edges) {
  const last = edges.length - 1;
  const guess = Math.min(Math.floor(((value - edges[0]) * last) / (edges[last] - edges[0])), last - 1);
  // The product rounds; the borders decide.
  if (value < edges[guess]) return guess - 1;
  return value >= edges[guess + 1] ? guess + 1 : guess;
}

/** `count` + 1 evenly spaced numbers from low to high, rounded as numpy.linspace rounds them. */
function linspace(low, high, count) {
  const step = (high - low) / count;
  return Array.from({ length: count + 1 }, (_, index) => (index === count ? high : index * step + low));
}

/** Middles of every `stride` intervals between ascending edges. */
function centers(edges, stride) {
  const count = (edges.length - 1) / stride;
  return Array.from({ length: count }, (_, index) => (edges[index * stride] + edges[(index + 1) * stride]) / 2);
}
