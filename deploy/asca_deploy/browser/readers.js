/** Scan files -> points: KITTI's .bin, the Point Cloud Library's .pcd, .ply and NumPy's .npy (docs/SCANS.md). */

import { readNpy } from "./npy.js";
import { readPly } from "./ply.js";
import {
  AGAIN, MAX_HEADER_BYTES, READ, columnsOfRows, readColumn, rowsOf, selectFields, stride, text, wholeNumber, wordsOf,
} from "./records.js";

const LFS_POINTER = /^version https:\/\/git-lfs/;

/**
 * Finite points of a file, and what was done to get them.
 * @param {string} name with its suffix
 * @param {ArrayBuffer} buffer the file's content
 * @returns {{points: Float32Array, remarks: string[]}} x, y, z in metres and reflectance 0..1 of each of N points
 */
export function readScan(name, buffer) {
  const suffix = name.toLowerCase().split(".").pop();
  const readers = { bin: readBin, npy: readNpy, pcd: readPcd, ply: readPly };
  if (!Object.hasOwn(readers, suffix)) throw new Error(`${name}: scans are .bin, .npy, .pcd and .ply files`);
  if (buffer.byteLength === 0) throw new Error(`${name}: the file is empty`);
  if (buffer.byteLength <= 1024 && LFS_POINTER.test(text(new Uint8Array(buffer)))) {
    throw new Error(`${name}: is a Git LFS pointer whose content was not fetched; run git lfs pull`);
  }
  try {
    return usable(readers[suffix](buffer));
  } catch (error) {
    throw new Error(`${name}: ${error.message}`);
  }
}

/** Little-endian float32 without a header: x, y, z, reflectance, and of some exporters the ring. */
function readBin(buffer) {
  if (buffer.byteLength % 4) throw new Error(`${buffer.byteLength} bytes are not a multiple of 4; ${AGAIN}`);
  const values = new Float32Array(buffer);
  const columns = binColumns(values);
  if (values.length % columns) throw new Error(`${values.length} values are not a multiple of ${columns}; ${AGAIN}`);
  const count = values.length / columns;
  const column = (index) => Float64Array.from({ length: count }, (_, row) => values[row * columns + index]);
  const remarks = columns === 5 ? ["read as 5 columns: x, y, z, reflectance, ring"] : [];
  return { x: column(0), y: column(1), z: column(2), reflectance: column(3), bytes: false, remarks };
}

/** Four columns, unless five fit better: then the fifth counts rings. */
function binColumns(values) {
  if (values.length % 5 || !plausible(values, 5)) return 4;
  const rings = values.filter((_, index) => index % 5 === 4);
  if (!rings.every((ring) => ring >= 0 && ring < 512 && Number.isInteger(ring))) return 4;
  const varied = rings.some((ring) => ring !== rings[0]);
  if (!varied && rings.length < 100) return 4;
  if (values.length % 4 === 0 && plausible(values, 4)) {
    if (!varied) return 4;
    throw new Error("may have four columns or five; convert it to .pcd, which says");
  }
  return 5;
}

/** Whether columns can be x, y, z and a reflectance: hardly any far away, hardly any negative reflectance. */
function plausible(values, columns) {
  let fitting = 0;
  for (let start = 0; start < values.length; start += columns) {
    const [x, y, z, reflectance] = values.subarray(start, start + 4);
    const near = Math.max(Math.abs(x), Math.abs(y), Math.abs(z)) <= 1000;
    fitting += near && reflectance >= 0 && reflectance <= 65535;
  }
  return fitting / (values.length / columns) >= 0.99;
}

/** PCD 0.7: ascii, binary and binary_compressed; keywords and types of either case. */
function readPcd(buffer) {
  const { header, body, start } = splitHeader(new Uint8Array(buffer));
  const fields = pcdFields(header);
  const count = pointCount(header);
  const encoding = header.DATA.join(" ").toLowerCase();
  const readers = { ascii: asciiColumns, binary: binaryColumns, binary_compressed: compressedColumns };
  if (!Object.hasOwn(readers, encoding)) {
    throw new Error(`DATA is '${encoding}'; PCD knows ascii, binary and binary_compressed`);
  }
  const { wanted, integers, bytes } = selectFields(fields);
  const { columns, surplus } = readers[encoding](body, fields, count, wanted, start);
  const [x, y, z, reflectance] = columns;
  const remarks = surplus >= stride(fields) ? [`${surplus} bytes after the points were left out`] : [];
  return { x, y, z, reflectance, bytes, integers, remarks };
}

const KEYS = ["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"];
const PAGE_BYTES = [4096, 8192, 16384, 32768, 65536]; // of memory
const OLD_KEYS = { COLUMNS: "FIELDS" }; // as PCD's first version has it

/** Words of each header line by its keyword, and the bytes after them, which begin at `start`. */
function splitHeader(bytes) {
  const header = {};
  let position = bytes[0] === 0xef && bytes[1] === 0xbb && bytes[2] === 0xbf ? 3 : 0; // a byte-order mark
  while (!("DATA" in header)) {
    const end = bytes.indexOf(10, position);
    if (end < 0 || end >= MAX_HEADER_BYTES) throw new Error(`no DATA line within ${MAX_HEADER_BYTES} bytes; ${AGAIN}`);
    const [word, ...words] = wordsOf(text(bytes.subarray(position, end)));
    position = end + 1;
    if (word === undefined || word.startsWith("#")) continue;
    const key = Object.hasOwn(OLD_KEYS, word.toUpperCase()) ? OLD_KEYS[word.toUpperCase()] : word.toUpperCase();
    if (!KEYS.includes(key)) throw new Error(`'${word.slice(0, 20)}' is not a line of a PCD header; ${AGAIN}`);
    if (key in header) throw new Error(`two ${key} lines; correct the header`);
    header[key] = words;
  }
  return { header, body: bytes.slice(position), start: position };
}

/** POINTS, which has to be WIDTH times HEIGHT where those are there too. */
function pointCount(header) {
  const numbers = {};
  for (const key of ["POINTS", "WIDTH", "HEIGHT"]) {
    if (!(key in header)) continue;
    numbers[key] = header[key].length === 1 ? wholeNumber(header[key][0]) : undefined;
    if (numbers[key] === undefined) throw new Error(`${key} is not one whole number; correct the header`);
  }
  const { POINTS, WIDTH, HEIGHT = 1 } = numbers;
  if (POINTS === undefined && WIDTH === undefined) throw new Error("neither POINTS nor WIDTH in the header");
  const area = WIDTH === undefined ? POINTS : WIDTH * HEIGHT;
  if (POINTS !== undefined && POINTS !== area) {
    throw new Error(`POINTS is ${POINTS} and WIDTH times HEIGHT is ${area}; correct the header`);
  }
  return area;
}

function pcdFields(header) {
  const names = header.FIELDS ?? [];
  const columns = { SIZE: header.SIZE ?? [], TYPE: header.TYPE ?? [], COUNT: header.COUNT ?? names.map(() => "1") };
  for (const [key, column] of Object.entries(columns)) {
    if (column.length === names.length) continue;
    throw new Error(`${key} has ${column.length} values for ${names.length} FIELDS; correct the header`);
  }
  let start = 0;
  return names.map((name, index) => {
    const [size, type] = [columns.SIZE[index], columns.TYPE[index].toUpperCase()];
    const count = wholeNumber(columns.COUNT[index]);
    const known = Object.hasOwn(READ, type) && Object.hasOwn(READ[type], size);
    if (!known || count === undefined) throw new Error(`field ${name} is not described; correct the header`);
    const field = { name, size: Number(size), type, count, start };
    start += field.size * field.count;
    return field;
  });
}

function asciiColumns(body, fields, count, wanted) {
  const rows = rowsOf(body);
  if (rows.length !== count) throw new Error(`${rows.length} lines where the header states ${count} points`);
  return { columns: columnsOfRows(rows, fields, wanted), surplus: 0 };
}

/** Point after point. What follows them may be padding: zeros, or as many bytes as PCL up to 1.8 appends (pcd.py). */
function binaryColumns(body, fields, count, wanted, start) {
  const size = stride(fields);
  const used = count * size;
  if (body.length < used) throw new Error(`${body.length} bytes where ${count} points need ${used}; ${AGAIN}`);
  const surplus = body.length - used;
  const padded = PAGE_BYTES.includes(start + surplus) || body.subarray(used).every((byte) => byte === 0);
  if (surplus >= size && !padded) {
    throw new Error(`${body.length} bytes where the header states ${count} points of ${size}; correct the header`);
  }
  const columns = wanted.map((index) => readColumn(body, fields[index], count, fields[index].start, size));
  return { columns, surplus };
}

/** Field after field, as one LZF stream behind its two sizes. */
function compressedColumns(body, fields, count, wanted) {
  let [unpacked, used] = [new Uint8Array(), 0];
  if (count) {
    if (body.length < 8) throw new Error(`the compressed body is missing; ${AGAIN}`);
    const sizes = new DataView(body.buffer, body.byteOffset);
    const needed = count * stride(fields);
    const size = sizes.getUint32(4, true);
    if (size !== needed) throw new Error(`${size} unpacked bytes where the points need ${needed}; ${AGAIN}`);
    used = 8 + sizes.getUint32(0, true);
    if (body.length < used) throw new Error(`${body.length} of ${used} compressed bytes are there; ${AGAIN}`);
    unpacked = lzfDecompress(body.subarray(8, used), needed);
  }
  const columns = wanted.map((index) => {
    const field = fields[index];
    return readColumn(unpacked, field, count, field.start * count, field.size);
  });
  return { columns, surplus: body.length - used };
}

/** An LZF stream of `size` bytes: literals, and references of length and distance, which may overlap their output. */
export function lzfDecompress(data, size) {
  const out = new Uint8Array(size);
  let written = 0;
  let at = 0;
  while (at < data.length) {
    const control = data[at++];
    if (control < 32) {
      if (at + control + 1 > data.length || written + control + 1 > size) throw new Error(AGAIN);
      for (let end = at + control + 1; at < end; ) out[written++] = data[at++];
      continue;
    }
    const length = (control >> 5 === 7 ? 7 + data[at++] : control >> 5) + 2;
    const from = written - ((control & 31) << 8) - data[at++] - 1;
    if (!(from >= 0) || written + length > size) throw new Error(AGAIN);
    for (let step = 0; step < length; step++) out[written++] = out[from + step];
  }
  if (written !== size) throw new Error(AGAIN);
  return out;
}

/** Finite points with the reflectance brought to 0..1, as `read_scan` and the detector do it. */
function usable({ x, y, z, reflectance, bytes, integers, remarks }) {
  const scale = reflectance ? reflectanceScale(reflectance, bytes, integers) : 1;
  const points = new Float32Array(4 * x.length);
  let count = 0;
  for (let row = 0; row < x.length; row++) {
    const bright = reflectance ? Math.fround(Math.fround(reflectance[row]) / scale) : 0;
    const point = [x[row], y[row], z[row], Math.min(Math.max(bright, 0), 1)];
    if (point.every((value) => Number.isFinite(Math.fround(value))) && Number.isFinite(bright)) {
      points.set(point, 4 * count++);
    }
  }
  if (scale !== 1) remarks.push(`reflectances were taken as 0..${scale}`);
  if (count < x.length) remarks.push(`${x.length - count} points are not finite and were dropped`);
  return { points: points.slice(0, 4 * count), remarks };
}

/** 1, 255 or 65535: the smallest scale that no more than one value in a thousand exceeds; of integers at least 255. */
function reflectanceScale(values, bytes, integers) {
  const manyAbove = (limit) => {
    const above = values.reduce((sum, value) => sum + (value > limit && Number.isFinite(value)), 0);
    return above > Math.max(Math.min(1, values.length - 1), 0.001 * values.length);
  };
  if (bytes) return 255;
  if (manyAbove(255)) return 65535;
  return integers || manyAbove(2) ? 255 : 1;
}
