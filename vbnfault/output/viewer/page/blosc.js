// Decode chunks of Blosc 1 whose blocks are compressed with Zstandard, as the stores of vbnfault have them.
//
// A chunk is a header of 16 bytes, the place of each block, and the blocks. A block is one stream, or one for each byte of
// a word; it holds words whose bytes (shuffle) or bits (bitshuffle) were sorted by weight. See the file
// README_CHUNK_FORMAT.rst of c-blosc 1.21 and shuffle.c beside it.
import { decompress } from "/zarrita.js";

const SHUFFLED = 1, STORED = 2, BITS_SHUFFLED = 4, NOT_SPLIT = 16, ZSTD = 4;

export class Blosc {
  kind = "bytes_to_bytes";
  static fromConfig() { return new Blosc(); }
  encode() { throw new Error("the viewer does not encode"); }
  decode(chunk) { return decoded(chunk); }
}

export function decoded(chunk) {
  const view = new DataView(chunk.buffer, chunk.byteOffset, chunk.byteLength);
  const flags = chunk[2], word = chunk[3];
  const size = view.getUint32(4, true), blockSize = view.getUint32(8, true);
  if (flags & STORED) return chunk.slice(16, 16 + size);
  if (flags >> 5 !== ZSTD) throw new Error(`blocks of Blosc are compressed with codec ${flags >> 5}, not Zstandard`);
  const out = new Uint8Array(size);
  for (let start = 0, block = 0; start < size; start += blockSize, block++) {
    const length = Math.min(blockSize, size - start);
    const streams = !(flags & NOT_SPLIT) && length === blockSize ? word : 1;
    const each = length / streams;
    const bytes = new Uint8Array(length);
    for (let stream = 0, at = view.getInt32(16 + 4 * block, true); stream < streams; stream++) {
      const packed = view.getInt32(at, true), data = chunk.subarray(at + 4, at + 4 + packed);
      if (packed === each) bytes.set(data, stream * each); // it could not be compressed
      else decompress(data, bytes.subarray(stream * each, (stream + 1) * each));
      at += 4 + packed;
    }
    const part = out.subarray(start, start + length);
    if (flags & SHUFFLED && word > 1) joinBytes(bytes, part, word);
    else if (flags & BITS_SHUFFLED && Math.floor(length / word) % 8 === 0) joinBits(bytes, part, word);
    else part.set(bytes);
  }
  return out;
}

function joinBytes(from, to, word) {
  const words = Math.floor(from.length / word);
  for (let b = 0; b < word; b++)
    for (let k = 0, source = b * words, target = b; k < words; k++, source++, target += word) to[target] = from[source];
  to.set(from.subarray(words * word), words * word);
}

// Row 8 b + k of `from` holds bit k of byte b of every word, eight words in a byte.
function joinBits(from, to, word) {
  const words = Math.floor(from.length / word), row = words / 8;
  for (let b = 0; b < word; b++)
    for (let k = 0, at = 8 * b * row; k < row; k++, at++) {
      // a matrix of 8 × 8 bits in two numbers, transposed in three steps (Warren, Hacker's Delight, 7-3)
      let low = from[at] | (from[at + row] << 8) | (from[at + 2 * row] << 16) | (from[at + 3 * row] << 24);
      let high = from[at + 4 * row] | (from[at + 5 * row] << 8) | (from[at + 6 * row] << 16) | (from[at + 7 * row] << 24);
      let swap = (low ^ (low >>> 7)) & 0x00aa00aa;
      low ^= swap ^ (swap << 7);
      swap = (high ^ (high >>> 7)) & 0x00aa00aa;
      high ^= swap ^ (swap << 7);
      swap = (low ^ (low >>> 14)) & 0x0000cccc;
      low ^= swap ^ (swap << 14);
      swap = (high ^ (high >>> 14)) & 0x0000cccc;
      high ^= swap ^ (swap << 14);
      swap = (low & 0xf0f0f0f0) >>> 4;
      low = (low & 0x0f0f0f0f) | ((high & 0x0f0f0f0f) << 4);
      high = (high & 0xf0f0f0f0) | swap;
      let target = 8 * k * word + b;
      for (let shift = 0; shift < 32; shift += 8, target += word) to[target] = low >>> shift;
      for (let shift = 0; shift < 32; shift += 8, target += word) to[target] = high >>> shift;
    }
  to.set(from.subarray(words * word), words * word);
}
