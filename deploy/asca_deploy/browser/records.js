/** Points with named fields and numbers of given types: what the readers of .pcd, .ply and .npy share. */

export const AGAIN = "the file is damaged or incomplete";
export const MAX_HEADER_BYTES = 65536;
const REFLECTANCE = ["intensity", "reflectance", "reflectivity", "i"];
const SPACE = "[ \\t\\n\\r\\v\\f]"; // of ASCII; \s is more, U+FEFF among it
const WORDS = new RegExp(`${SPACE}+`);

/** Bytes as characters, one each, of which browsers and node agree on those of ASCII only. */
export const text = (bytes) => new TextDecoder("latin1").decode(bytes);
export const wordsOf = (line) => line.split(WORDS).filter(Boolean);
/** The lines of an ASCII body that hold something, as words. */
export const rowsOf = (body) => text(body).split(/\r\n|\n|\r/).map(wordsOf).filter((words) => words.length);
export const wholeNumber = (word) => (/^[0-9]{1,18}$/.test(word) ? Number(word) : undefined);
/** Bytes of one point. */
export const stride = (fields) => fields.reduce((sum, field) => sum + field.size * field.count, 0);

/** What reads one number from a DataView, by type and size in bytes; little-endian unless said otherwise. */
export const READ = {
  F: {
    2: (view, at, little = true) => halfFloat(view.getUint16(at, little)),
    4: (view, at, little = true) => view.getFloat32(at, little),
    8: (view, at, little = true) => view.getFloat64(at, little),
  },
  U: {
    1: (view, at) => view.getUint8(at),
    2: (view, at, little = true) => view.getUint16(at, little),
    4: (view, at, little = true) => view.getUint32(at, little),
    8: (view, at, little = true) => Number(view.getBigUint64(at, little)),
  },
  I: {
    1: (view, at) => view.getInt8(at),
    2: (view, at, little = true) => view.getInt16(at, little),
    4: (view, at, little = true) => view.getInt32(at, little),
    8: (view, at, little = true) => Number(view.getBigInt64(at, little)),
  },
};

function halfFloat(bits) {
  const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
}

/** Indices of x, y, z and, where there is one, the reflectance, and whether that is stored in integers, in bytes. */
export function selectFields(fields) {
  const names = fields.map(({ name }) => name.toLowerCase().replace(/^scalar_/, "")); // CloudCompare's scalar_Intensity
  const wanted = ["x", "y", "z"].map((name) => names.indexOf(name));
  if (wanted.includes(-1)) throw new Error(`no field x, y or z among ${names.join(", ")}`);
  const bright = REFLECTANCE.map((name) => names.indexOf(name)).find((index) => index >= 0);
  if (bright !== undefined) wanted.push(bright);
  for (const index of wanted) {
    const { count: values } = fields[index];
    if (values !== 1) throw new Error(`${names[index]} has ${values} values per point; export one`);
    if (names.indexOf(names[index], index + 1) >= 0) throw new Error(`several fields ${names[index]}; export one`);
  }
  const integers = bright !== undefined && fields[bright].type !== "F";
  return { wanted, integers, bytes: integers && fields[bright].size === 1 };
}

/** The wanted columns of rows of words, a point each. */
export function columnsOfRows(rows, fields, wanted) {
  const starts = fields.map((_, index) => fields.slice(0, index).reduce((sum, field) => sum + field.count, 0));
  const width = fields.reduce((sum, field) => sum + field.count, 0);
  const numbers = rows.map((words, row) => {
    if (words.length !== width) throw new Error(`point ${row} has ${words.length} values, not ${width}`);
    return words.map(asNumber);
  });
  return wanted.map((index) => Float64Array.from(numbers, (point) => point[starts[index]]));
}

/** A decimal number, nan or inf, as Python reads them; `Number` alone takes 0x10 and makes NaN of any other word. */
function asNumber(word) {
  if (/^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?$/i.test(word)) return Number(word);
  if (/^[+-]?nan$/i.test(word)) return NaN;
  if (/^[+-]?inf(inity)?$/i.test(word)) return word.startsWith("-") ? -Infinity : Infinity;
  throw new Error(`'${word.slice(0, 20)}' is not a number; ${AGAIN}`);
}

/** `count` numbers of a field, `step` bytes apart. */
export function readColumn(bytes, field, count, start, step, little = true) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const read = READ[field.type][field.size];
  return Float64Array.from({ length: count }, (_, row) => read(view, start + row * step, little));
}
