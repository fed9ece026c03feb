/** Cells of pillars -> the rulebooks that a sparse neck reads (asca_pillars/ops/pillar/neck_rulebooks.py, docs/BUNDLE.md). */

const LEVELS = 3;

/** Which cells of a map seen from above are active; its memory is kept from scan to scan. */
class CellMap {
  constructor(ny, nx) {
    this.ny = ny;
    this.nx = nx;
    this.width = nx + 2;
    this.cells = new Int32Array(0); // y * nx + x, ascending
    this.rows = new Int32Array((ny + 2) * this.width).fill(-1); // of the active cells, with a border around the map
  }

  /** Index into `rows` of a cell of -1..ny and -1..nx. */
  place(y, x) {
    return (y + 1) * this.width + x + 1;
  }

  /** Call `at(i, y, x)` for each active cell, in ascending order. */
  visit(at) {
    for (let i = 0, y = 0; i < this.cells.length; i++) {
      while (this.cells[i] >= (y + 1) * this.nx) y++;
      at(i, y, this.cells[i] - y * this.nx);
    }
  }

  clear() {
    this.visit((i, y, x) => { this.rows[this.place(y, x)] = -1; });
    this.cells = new Int32Array(0);
  }

  /** Make these cells active, ascending. */
  enter(cells) {
    this.clear();
    this.cells = Int32Array.from(cells);
    this.visit((i, y, x) => { this.rows[this.place(y, x)] = i; });
  }

  /** Mark the cells of these rows and columns, both ends included, of -1..ny and -1..nx. */
  mark(top, bottom, left, right) {
    for (let y = top; y <= bottom; y++) for (let x = left; x <= right; x++) this.rows[this.place(y, x)] = 0;
  }

  /** Make active what was marked since `clear`; marks on the border around the map do not count. */
  number() {
    const cells = new Int32Array(this.ny * this.nx);
    let count = 0;
    for (let place = 0, y = -1; y <= this.ny; y++) {
      for (let x = -1; x <= this.nx; x++, place++) {
        if (this.rows[place] < 0) continue;
        const inside = y >= 0 && y < this.ny && x >= 0 && x < this.nx;
        this.rows[place] = inside ? count : -1;
        if (inside) cells[count++] = y * this.nx + x;
      }
    }
    this.cells = cells.slice(0, count);
  }

  /** Row of a cell of -1..ny and -1..nx among the active ones, their number where it is none of them. */
  row(y, x) {
    const row = this.rows[this.place(y, x)];
    return row < 0 ? this.cells.length : row;
  }
}

export class NeckRulebookBuilder {
  /**
   * @param {number} ny rows of the map, a multiple of 8
   * @param {number} nx columns, likewise
   * @param {"sub"|"fine"} rule `pillar.active_cells` of bundle.json; with `fine` the finest level grows
   */
  constructor(ny, nx, rule) {
    const level = (number) => new CellMap(ny >> number, nx >> number);
    this.pillars = level(0);
    this.strided = Array.from({ length: LEVELS }, (_, number) => level(number + 1));
    this.outputs = [...this.strided];
    if (rule === "fine") this.outputs[0] = level(1);
    this.head = level(1);
  }

  /**
   * Tables of a scan by the names of the graph's inputs, Int32Array each.
   * @param {Int32Array} cells of its pillars, row * nx + column, ascending
   * @returns {{inputs: Object<string, Int32Array>, headCells: Int32Array}} with the active cells of the head's map
   */
  build(cells) {
    this.activate(cells);
    const inputs = {};
    this.outputs.forEach((output, number) => {
      const strided = this.strided[number];
      inputs[`strided_${number}`] = gather(strided, number ? this.outputs[number - 1] : this.pillars, 2);
      if (strided !== output) inputs[`first_${number}`] = gather(output, strided, 1);
      inputs[`same_${number}`] = gather(output, output, 1);
      inputs[`places_${number}`] = places(this.head, output, number);
    });
    return { inputs, headCells: this.head.cells };
  }

  activate(cells) {
    this.pillars.enter(cells);
    let before = this.pillars;
    for (const level of this.strided) { // the coarser levels do not see the growth
      level.clear();
      // A kernel of 3 with stride 2 and padding 1 has one output over an even place, two over an odd one.
      before.visit((i, y, x) => level.mark(y >> 1, (y + 1) >> 1, x >> 1, (x + 1) >> 1));
      level.number();
      before = level;
    }
    const [grown, strided] = [this.outputs[0], this.strided[0]];
    if (grown !== strided) {
      grown.clear();
      strided.visit((i, y, x) => grown.mark(y - 1, y + 1, x - 1, x + 1));
      grown.number();
    }
    this.head.clear();
    this.outputs.forEach((output, number) => {
      const end = (value) => ((value + 1) << number) - 1;
      output.visit((i, y, x) => this.head.mark(y << number, end(y), x << number, end(x)));
    });
    this.head.number();
  }
}

/** The rows of `source` that a kernel of 3 with padding 1 reads for each of the outputs: N x 9. */
function gather(outputs, source, stride) {
  const rulebook = new Int32Array(9 * outputs.cells.length);
  outputs.visit((i, y, x) => {
    let entry = 9 * i;
    for (let row = stride * y - 1; row <= stride * y + 1; row++) {
      for (let column = stride * x - 1; column <= stride * x + 1; column++) rulebook[entry++] = source.row(row, column);
    }
  });
  return rulebook;
}

/** Row of each head cell among the outputs of an upsampling, 4^halvings for each of the level's cells. */
function places(head, level, halvings) {
  const found = new Int32Array(head.cells.length);
  const within = (1 << halvings) - 1;
  head.visit((i, y, x) => {
    const parent = level.row(y >> halvings, x >> halvings);
    const child = ((y & within) << halvings) + (x & within);
    found[i] = (parent << (2 * halvings)) + (parent < level.cells.length ? child : 0);
  });
  return found;
}
