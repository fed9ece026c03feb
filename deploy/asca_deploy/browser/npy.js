/** NumPy's .npy: an array (N, 3 or more) of real numbers, as `numpy.save` writes it. */

import { AGAIN, readColumn, text } from "./records.js";

const MAGIC = [0x93, ...Array.from("NUMPY", (letter) => letter.charCodeAt(0))];
const MAX_HEADER = 10000; // characters, NumPy's own limit
const MANY_COLUMNS = 8;
const HEADER = /^\s*\{((?:\s*'[a-z_]+'\s*:\s*(?:'[^']*'|True|False|\([0-9,\s]*\))\s*,?)*)\s*\}\s*$/;
const ENTRY = /'([a-z_]+)'\s*:\s*('[^']*'|True|False|\([0-9,\s]*\))/g;
const TYPE = /^([<>=|]?)([fiu])([1248])$/;

/** Columns x, y, z and, where there is a fourth, reflectance, as `readPcd` gives them. */
export function readNpy(buffer) {
  const data = new Uint8Array(buffer);
  const version = data[6];
  const begins = MAGIC.every((byte, index) => data[index] === byte);
  if (!begins || ![1, 2, 3].includes(version) || data[7] !== 0) throw none("its beginning");
  const start = version === 1 ? 10 : 12;
  if (data.length < start) throw none("it breaks off");
  const view = new DataView(buffer);
  const length = version === 1 ? view.getUint16(8, true) : view.getUint32(8, true);
  if (length > MAX_HEADER || start + length > data.length) throw none("its header");
  const { descr, columnMajor, shape } = readHeader(text(data.subarray(start, start + length)));
  const [, order, kind, digit] = TYPE.exec(descr) ?? [];
  const [count, columns] = shape;
  if (shape.length === 2 && (count === 3 || count === 4) && columns > MANY_COLUMNS) {
    throw new Error(`of shape (${shape.join(", ")}), points lie in its columns; transpose it`);
  }
  if (kind === undefined || (kind === "f" && digit === "1") || shape.length !== 2 || columns < 3) {
    throw new Error(`holds ${descr} of shape (${shape.join(", ")}); save real numbers of shape (N, 3) or (N, 4)`);
  }
  const field = { type: kind.toUpperCase(), size: Number(digit) };
  if (data.length - start - length < count * columns * field.size) throw none("it breaks off");
  const [point, column] = columnMajor ? [1, count] : [columns, 1]; // numbers from one to the next
  const [x, y, z, reflectance] = Array.from({ length: Math.min(columns, 4) }, (_, index) => {
    const first = start + length + index * column * field.size;
    return readColumn(data, field, count, first, point * field.size, order !== ">");
  });
  const integers = kind !== "f";
  return { x, y, z, reflectance, bytes: integers && field.size === 1, integers, remarks: [] };
}

/** The three entries of the header, a Python dictionary. */
function readHeader(header) {
  const inner = HEADER.exec(header)?.[1];
  const entries = new Map([...(inner ?? "").matchAll(ENTRY)].map(([, key, value]) => [key, value]));
  const [descr, order, shape] = ["descr", "fortran_order", "shape"].map((key) => entries.get(key) ?? "");
  const numbers = /^\(\s*([0-9]+\s*,\s*)*([0-9]+\s*)?\)$/.test(shape);
  if (entries.size !== 3 || !descr.startsWith("'") || !["True", "False"].includes(order) || !numbers) {
    throw none("its header");
  }
  return { descr: descr.slice(1, -1), columnMajor: order === "True", shape: (shape.match(/[0-9]+/g) ?? []).map(Number) };
}

const none = (what) => new Error(`not an array of numbers (${what}); ${AGAIN}`);
