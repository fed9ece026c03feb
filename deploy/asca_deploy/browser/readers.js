/** Scan files -> points: KITTI's .bin and the Point Cloud Library's .pcd (docs/SCANS.md). */

const REFLECTANCE = ["intensity", "reflectance", "reflectivity", "i"];
const AGAIN = "the file is damaged or incomplete";

/**
 * Finite points of a file, and what was done to get them.
 * @param {string} name with its suffix
 * @param {ArrayBuffer} buffer the file's content
 * @returns {{points: Float32Array, remarks: string[]}} x, y, z in metres and reflectance 0..1 of each of N points
 */
export function readScan(name, buffer) {
  const suffix = name.toLowerCase().split(".").pop();
  const readers = { bin: readBin, pcd: readPcd };
  if (!Object.hasOwn(readers, suffix)) throw new Error(`${name}: scans are .bin and .pcd files`);
  if (buffer.byteLength === 0) throw new Error(`${name}: the file is empty`);
  try {
    return usable(readers[suffix](buffer));
  } catch (error) {
    throw new Error(`${name}: ${error.message}`);
  }
}

/** Little-endian float32 without a header: x, y, z, reflectance, and of some exporters the ring. */
function readBin(buffer) {
  if (buffer.byteLength % 4) throw new Error(`${buffer.byteLength} bytes are no whole number of float32; ${AGAIN}`);
  const values = new Float32Array(buffer);
  const columns = binColumns(values);
  if (values.length % columns) throw new Error(`${values.length} values are no whole number of points; ${AGAIN}`);
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
  return fitting >= (0.99 * values.length) / columns;
}

/** PCD 0.7: ascii, binary and binary_compressed. */
function readPcd(buffer) {
  const { header, body } = splitHeader(new Uint8Array(buffer));
  const count = pointCount(header);
  const fields = pcdFields(header);
  const encoding = (header.DATA ?? "").trim().toLowerCase();
  const read = { ascii: asciiColumns, binary: binaryColumns, binary_compressed: compressedColumns }[encoding];
  if (!read) throw new Error(`DATA is '${encoding}'; PCD knows ascii, binary and binary_compressed`);
  const names = fields.map(({ name }) => name.toLowerCase().replace(/^scalar_/, "")); // CloudCompare's scalar_Intensity
  const wanted = ["x", "y", "z"].map((name) => names.indexOf(name));
  if (wanted.includes(-1)) throw new Error(`no field x, y or z among ${names.join(", ")}`);
  const bright = REFLECTANCE.map((name) => names.indexOf(name)).find((index) => index >= 0);
  for (const index of [...wanted, ...(bright === undefined ? [] : [bright])]) {
    if (names.indexOf(names[index], index + 1) >= 0) throw new Error(`several fields ${names[index]}; export one`);
  }
  const [x, y, z, reflectance] = read(body, fields, count, [...wanted, ...(bright === undefined ? [] : [bright])]);
  const bytes = bright !== undefined && fields[bright].type !== "F" && fields[bright].size === 1;
  const integers = bright !== undefined && fields[bright].type !== "F";
  return { x, y, z, reflectance, bytes, integers, remarks: [] };
}

function splitHeader(bytes) {
  const header = {};
  let position = 0;
  while (!("DATA" in header)) {
    const end = bytes.indexOf(10, position);
    if (end < 0 || end > 65536) throw new Error(`no DATA line in the header; ${AGAIN}`);
    const line = new TextDecoder().decode(bytes.subarray(position, end)).trim();
    const [key, ...words] = line.split(/\s+/);
    if (key && !key.startsWith("#")) header[key] = words.join(" ");
    position = end + 1;
  }
  return { header, body: bytes.slice(position) };
}

/** POINTS, which has to be WIDTH times HEIGHT where those are there too. */
function pointCount(header) {
  const numbers = {};
  for (const key of ["POINTS", "WIDTH", "HEIGHT"]) {
    if (!(key in header)) continue;
    if (!/^[0-9]{1,18}$/.test(header[key])) throw new Error(`${key} is no whole number; correct the header`);
    numbers[key] = Number(header[key]);
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
  const words = (key) => (header[key] ?? "").split(/\s+/).filter(Boolean);
  const counts = "COUNT" in header ? words("COUNT").map(Number) : words("FIELDS").map(() => 1);
  const sizes = words("SIZE").map(Number);
  const types = words("TYPE");
  let start = 0;
  return words("FIELDS").map((name, index) => {
    const field = { name, size: sizes[index], type: types[index], count: counts[index], start };
    if (!READ[field.type]?.[field.size] || !(field.count >= 0)) throw new Error(`field ${name} is not described`);
    start += field.size * field.count;
    return field;
  });
}

const READ = {
  F: { 4: (view, at) => view.getFloat32(at, true), 8: (view, at) => view.getFloat64(at, true) },
  U: {
    1: (view, at) => view.getUint8(at),
    2: (view, at) => view.getUint16(at, true),
    4: (view, at) => view.getUint32(at, true),
    8: (view, at) => Number(view.getBigUint64(at, true)),
  },
  I: {
    1: (view, at) => view.getInt8(at),
    2: (view, at) => view.getInt16(at, true),
    4: (view, at) => view.getInt32(at, true),
    8: (view, at) => Number(view.getBigInt64(at, true)),
  },
};

function asciiColumns(body, fields, count, wanted) {
  const lines = new TextDecoder().decode(body).split("\n").filter((line) => line.trim());
  if (lines.length !== count) throw new Error(`${lines.length} lines where the header states ${count} points`);
  const starts = fields.map((_, index) => fields.slice(0, index).reduce((sum, field) => sum + field.count, 0));
  const width = fields.reduce((sum, field) => sum + field.count, 0);
  const rows = lines.map((line, row) => {
    const numbers = line.trim().split(/\s+/).map(asNumber);
    if (numbers.length !== width) throw new Error(`point ${row} has ${numbers.length} values, not ${width}`);
    return numbers;
  });
  return wanted.map((index) => Float64Array.from(rows, (numbers) => numbers[starts[index]]));
}

/** A decimal number, nan or inf, as Python reads them; `Number` alone takes 0x10 and makes NaN of any other word. */
function asNumber(word) {
  if (/^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?$/i.test(word)) return Number(word);
  if (/^[+-]?nan$/i.test(word)) return NaN;
  if (/^[+-]?inf(inity)?$/i.test(word)) return word.startsWith("-") ? -Infinity : Infinity;
  throw new Error(`'${word.slice(0, 20)}' is no number; ${AGAIN}`);
}

function binaryColumns(body, fields, count, wanted) {
  const last = fields[fields.length - 1];
  const stride = last.start + last.size * last.count;
  if (body.length < count * stride) throw new Error(`${body.length} bytes where ${count} points need ${count * stride}`);
  return wanted.map((index) => readColumn(body, fields[index], count, fields[index].start, stride));
}

/** Field after field, as one LZF stream behind its two sizes. */
function compressedColumns(body, fields, count, wanted) {
  const sizes = new DataView(body.buffer, body.byteOffset);
  if (body.length < 8) throw new Error(`the compressed body is missing; ${AGAIN}`);
  const last = fields[fields.length - 1];
  const needed = count * (last.start + last.size * last.count);
  if (sizes.getUint32(4, true) !== needed) throw new Error(`the header's points need ${needed} unpacked bytes; ${AGAIN}`);
  const unpacked = lzfDecompress(body.subarray(8, 8 + sizes.getUint32(0, true)), needed);
  return wanted.map((index) => {
    const field = fields[index];
    return readColumn(unpacked, field, count, field.start * count, field.size * field.count);
  });
}

function readColumn(bytes, field, count, start, stride) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const read = READ[field.type][field.size];
  return Float64Array.from({ length: count }, (_, row) => read(view, start + row * stride));
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
