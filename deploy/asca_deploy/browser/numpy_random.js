/**
 * NumPy's default_rng(seed).permutation(n), bit by bit: SeedSequence, PCG64 (XSL-RR 128/64), masked rejection.
 *
 * A pillar that holds more points than the limit keeps a random subset. The same scan must keep the same one here and
 * in Python, or the boxes differ.
 */

const MASK_64 = (1n << 64n) - 1n;
const MASK_128 = (1n << 128n) - 1n;
const MULTIPLIER = 0x2360ed051fc65da44385df649fccf645n;

export class Generator {
  /** @param {number} seed 0..2^32 - 1 */
  constructor(seed) {
    const words = seedWords(seed, 8);
    const wide = (index) => BigInt(words[index]) | (BigInt(words[index + 1]) << 32n);
    this.increment = ((((wide(4) << 64n) | wide(6)) << 1n) | 1n) & MASK_128;
    this.state = (this.increment + ((wide(0) << 64n) | wide(2))) & MASK_128;
    this.step();
    this.spare = null;
  }

  /** 0..n-1 in random order, Int32Array. */
  permutation(n) {
    const order = Int32Array.from({ length: n }, (_, index) => index);
    for (let index = n - 1; index > 0; index--) {
      const other = this.upTo(index);
      [order[index], order[other]] = [order[other], order[index]];
    }
    return order;
  }

  /** An integer 0..highest: bits as many as it needs, drawn again while they are too large. */
  upTo(highest) {
    const mask = 0xffffffff >>> Math.clz32(highest);
    let value;
    do value = (this.uint32() & mask) >>> 0;
    while (value > highest);
    return value;
  }

  uint32() {
    if (this.spare !== null) {
      const value = this.spare;
      this.spare = null;
      return value;
    }
    this.step();
    const high = this.state >> 64n;
    const mixed = high ^ (this.state & MASK_64);
    const turn = high >> 58n;
    const value = ((mixed >> turn) | (mixed << (64n - turn))) & MASK_64;
    this.spare = Number(value >> 32n);
    return Number(value & 0xffffffffn);
  }

  step() {
    this.state = (this.state * MULTIPLIER + this.increment) & MASK_128;
  }
}

/** CRC-32 of bytes, as zlib's. */
export function crc32(bytes) {
  const table = crcTable();
  let crc = 0xffffffff;
  for (let index = 0; index < bytes.length; index++) crc = table[(crc ^ bytes[index]) & 255] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}

function crcTable() {
  return Uint32Array.from({ length: 256 }, (_, byte) => {
    let value = byte;
    for (let bit = 0; bit < 8; bit++) value = value & 1 ? 0xedb88320 ^ (value >>> 1) : value >>> 1;
    return value;
  });
}

/** `count` words of numpy.random.SeedSequence(seed), pool of four, for a seed of one word. */
function seedWords(seed, count) {
  let constant = 0x43b0d7e5;
  const hash = (value) => {
    value ^= constant;
    constant = Math.imul(constant, 0x931e8875);
    value = Math.imul(value, constant);
    return value ^ (value >>> 16);
  };
  const mix = (a, b) => {
    const value = (Math.imul(0xca01f9dd, a) - Math.imul(0x4973f715, b)) | 0;
    return value ^ (value >>> 16);
  };
  const pool = [hash(seed), hash(0), hash(0), hash(0)];
  for (let from = 0; from < 4; from++) {
    for (let to = 0; to < 4; to++) if (from !== to) pool[to] = mix(pool[to], hash(pool[from]));
  }
  constant = 0x8b51f9dd;
  return Array.from({ length: count }, (_, index) => {
    let value = pool[index % 4] ^ constant;
    constant = Math.imul(constant, 0x58f38ded);
    value = Math.imul(value, constant);
    return (value ^ (value >>> 16)) >>> 0;
  });
}
