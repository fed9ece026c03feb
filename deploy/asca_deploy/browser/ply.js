/** PLY (Stanford polygon) files, ascii and binary of either byte order: their vertices are the points. */

import {
  AGAIN, MAX_HEADER_BYTES, READ, columnsOfRows, readColumn, rowsOf, selectFields, stride, text, wholeNumber,
} from "./records.js";

const MAX_LISTS = 1_000_000; // of the elements before the vertices: each has to be walked over
const LINES = /\r\n|[\n\r\v\f\x1c-\x1e]/; // as Python splits text, here and below
const SPACES = /[ \t\n\r\v\f\x1c-\x1f]+/;
const ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"];
const TYPES = {
  char: ["I", 1], uchar: ["U", 1], short: ["I", 2], ushort: ["U", 2], int: ["I", 4], uint: ["U", 4],
  int8: ["I", 1], uint8: ["U", 1], int16: ["I", 2], uint16: ["U", 2], int32: ["I", 4], uint32: ["U", 4],
  float: ["F", 4], double: ["F", 8], float32: ["F", 4], float64: ["F", 8],
};

/** Columns of the vertices, as `readPcd` gives those of its points. */
export function readPly(buffer) {
  const { encoding, elements, body } = splitHeader(new Uint8Array(buffer));
  const places = elements.flatMap(({ name }, index) => (name === "vertex" ? [index] : []));
  if (places.length !== 1) throw new Error(`${places.length || "no"} elements vertex; export one point cloud`);
  const [place] = places;
  const { count, properties: fields } = elements[place];
  if (fields.some(({ length }) => length)) throw new Error("the vertices have a list property; export plain x, y, z");
  const last = place === elements.length - 1;
  const { wanted, integers, bytes } = selectFields(fields);
  let columns;
  if (encoding === "ascii") {
    const before = elements.slice(0, place).reduce((sum, element) => sum + element.count, 0);
    const rows = rowsOf(body).slice(before);
    if (rows.length < count || (last && rows.length > count)) {
      throw new Error(`${rows.length} lines where the header states ${count} points; ${AGAIN}`);
    }
    columns = columnsOfRows(rows.slice(0, count), fields, wanted);
  } else {
    const little = encoding === "binary_little_endian";
    const start = skipped(body, elements.slice(0, place), little);
    const size = stride(fields);
    const there = body.length - start;
    if (there < count * size || (last && there >= (count + 1) * size)) {
      throw new Error(`${there} bytes where the header states ${count} points of ${size}; ${AGAIN}`);
    }
    const startOf = (index) => start + stride(fields.slice(0, index));
    columns = wanted.map((index) => readColumn(body, fields[index], count, startOf(index), size, little));
  }
  const [x, y, z, reflectance] = columns;
  return { x, y, z, reflectance, bytes, integers, remarks: [] };
}

/** The number of bytes that elements take at the start of a binary body. */
function skipped(body, elements, little) {
  const view = new DataView(body.buffer, body.byteOffset, body.byteLength);
  let position = 0;
  for (const { count, properties } of elements) {
    if (!properties.some(({ length }) => length)) {
      position += count * stride(properties);
      continue;
    }
    if (count > MAX_LISTS) throw new Error(`${count} lists before the vertices; export the vertices first`);
    for (let row = 0; row < count; row++) {
      for (const { size, length } of properties) {
        if (!length) {
          position += size;
          continue;
        }
        const [type, bytes] = length;
        if (position + bytes > body.length) throw new Error(`a list before the vertices breaks off; ${AGAIN}`);
        position += bytes + Math.max(READ[type][bytes](view, position, little), 0) * size;
      }
    }
  }
  return position;
}

/** The encoding, the elements with their properties (of a list with its `length`'s type), and the bytes after them. */
function splitHeader(data) {
  const bytes = data[0] === 0xef && data[1] === 0xbb && data[2] === 0xbf ? data.slice(3) : data;
  const head = text(bytes.subarray(0, MAX_HEADER_BYTES));
  const end = head.indexOf("\nend_header");
  const start = end < 0 ? 0 : bytes.indexOf(10, end + 1) + 1;
  if (!head.startsWith("ply") || start === 0) {
    throw new Error(`no PLY header from 'ply' to 'end_header' within ${MAX_HEADER_BYTES} bytes; ${AGAIN}`);
  }
  const lines = head.slice(0, end).split(LINES).slice(1).map((line) => line.split(SPACES).filter(Boolean));
  const encoding = lines.find((words) => words.length === 3 && words[0] === "format")?.[1];
  if (!ENCODINGS.includes(encoding)) throw new Error(`the PLY format is ${encoding}; known are ${ENCODINGS.join(", ")}`);
  const elements = [];
  for (const words of lines) readLine(words, elements);
  return { encoding, elements, body: bytes.slice(start) };
}

function readLine(words, elements) {
  const [key, ...rest] = words;
  const count = key === "element" && rest.length === 2 ? wholeNumber(rest[1]) : undefined;
  const [kind, name] = rest.slice(-2);
  const known = key === "property" && elements.length && Object.hasOwn(TYPES, kind ?? "");
  if (count !== undefined) {
    elements.push({ name: rest[0], count, properties: [] });
  } else if (known && rest.length === 2) {
    const [type, size] = TYPES[kind];
    elements.at(-1).properties.push({ name, type, size, count: 1 });
  } else if (known && rest.length === 4 && rest[0] === "list" && "IU".includes(TYPES[rest[1]]?.[0] ?? "-")) {
    const [type, size] = TYPES[kind];
    elements.at(-1).properties.push({ name, type, size, count: 1, length: TYPES[rest[1]] });
  } else if (!["format", "comment", "obj_info", undefined].includes(key)) {
    throw new Error(`'${words.join(" ").slice(0, 60)}' is not a line of a PLY header; ${AGAIN}`);
  }
}
