// Decoding of the page's compressed points and layers; packing.py writes them.

const KEEPS = 4; // cells in a byte of a layer

export async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/**
 * Points as two interleaved arrays that the graphics card reads as they are.
 *
 * They are in bit-reversed order, so that the first n of them are spread evenly over all: drawing only those
 * is a coarser map.
 *
 * @returns places has
 *   x, y, z in steps and the time of the first hit of each point, tints its red, green, blue and hits; sparsity
 *   tells how much larger points have to be drawn because others were left out.
 */
export async function decodedPoints(packed, { isObserved, hasColors }) {
  const { count, of, low, step } = packed;
  const reader = new PlaneReader(await inflated(bytesOf(packed.data)), count);
  const [x, y, z] = [reader.words(), reader.words(), reader.words()];
  const seen = isObserved ? reader.words() : new Uint16Array(count);
  const hits = isObserved ? reader.bytes() : new Uint8Array(count);
  const [r, g, b] = hasColors ? [reader.bytes(), reader.bytes(), reader.bytes()] : [hits, hits, hits];
  const places = new Uint16Array(4 * count), tints = new Uint8Array(4 * count);
  let to = 0;
  for (const from of bitReversed(count)) {
    places[to] = x[from];
    places[to + 1] = y[from];
    places[to + 2] = z[from];
    places[to + 3] = seen[from];
    tints[to] = r[from];
    tints[to + 1] = g[from];
    tints[to + 2] = b[from];
    tints[to + 3] = hits[from];
    to += 4;
  }
  return { count, low, step, places, tints, sparsity: Math.sqrt(of / Math.max(count, 1)) };
}

/** Planes of one value per point, each stored as its difference from the point before. */
class PlaneReader {
  constructor(data, count) {
    this.data = data;
    this.count = count;
    this.at = 0;
  }

  bytes() {
    const values = new Uint8Array(this.count);
    let value = 0;
    for (let i = 0; i < this.count; i++) values[i] = value += this.data[this.at + i];
    this.at += this.count;
    return values;
  }

  words() {
    const { data, count, at } = this, values = new Uint16Array(count);
    let value = 0;
    for (let i = 0; i < count; i++) {
      const zigzag = data[at + i] | (data[at + count + i] << 8);
      values[i] = value += (zigzag >>> 1) ^ -(zigzag & 1);
    }
    this.at += 2 * count;
    return values;
  }
}

function* bitReversed(count) {
  const bits = Math.max(1, Math.ceil(Math.log2(Math.max(count, 2))));
  for (let i = 0; i < 1 << bits; i++) {
    let reversed = 0;
    for (let bit = 0; bit < bits; bit++) reversed |= ((i >> bit) & 1) << (bits - 1 - bit);
    if (reversed < count) yield reversed;
  }
}

/** Layers of cells, decoded when they are asked for. */
export class Layers {
  constructor({ low, edge_m, shape, ends, data }) {
    Object.assign(this, { low, edge_m, shape, ends });
    this.data = bytesOf(data);
  }

  /** Number of the layer at a height in metres; it may be beyond the lowest or the highest. */
  indexAt(height_m) {
    return Math.floor((height_m - this.low[2]) / this.edge_m);
  }

  /** Cells of a layer, row 0 with the lowest y: 0 unknown, 1 free, 2 occupied. Null where there is none. */
  async cells(index) {
    if (index < 0 || index >= this.shape[2]) return null;
    const begin = index ? this.ends[index - 1] : 0;
    const packed = await inflated(this.data.subarray(begin, this.ends[index]));
    const cells = new Uint8Array(this.shape[0] * this.shape[1]);
    for (let i = 0; i < cells.length; i++) cells[i] = (packed[(i / KEEPS) | 0] >> (2 * (i % KEEPS))) & 3;
    return cells;
  }
}
