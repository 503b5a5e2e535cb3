// Layers as src/spackle/formats/html.py writes them, as Spark's Gaussians.
import { ExtSplats } from "@sparkjsdev/spark";

const BYTES = 20;
const STEPS = 127; // of a harmonic's byte to either side of 0
const PARTS = ["w", "x", "y", "z"]; // the file's order
const REST = PARTS.map((part) => PARTS.filter((other) => other !== part));

/**
 * All layers in one set, backwards: of Gaussians at the same depth Spark draws the last one in front, and our renderer
 * the first one. `layers` are the description's, with their `bytes`.
 */
export function decode(layers) {
  const count = layers.reduce((sum, layer) => sum + layer.count, 0);
  const splats = new ExtSplats();
  splats.ensureSplats(Math.max(1, count));
  const extra = harmonicArrays(layers, splats.maxSplats);
  let last = count - 1;
  for (const layer of layers) {
    if (layer.bytes.length !== BYTES * layer.count) {
      throw new Error(`${layer.file}: ${layer.bytes.length} bytes, not ${BYTES} for each of ${layer.count} Gaussians`);
    }
    decodeLayer(splats, last, layer, decodeHarmonics(extra, last, layer));
    last -= layer.count;
  }
  return new ExtSplats({ extArrays: splats.extArrays, numSplats: count, extra }); // only so do they become textures
}

/** Spark's arrays for harmonics of the layers' highest degree, all 0; none where no colour changes with the view. */
function harmonicArrays(layers, size) {
  const most = Math.max(...layers.map(({ harmonics }) => harmonics?.count ?? 0));
  const names = { 0: [], 3: ["sh1"], 8: ["sh1", "sh2"], 15: ["sh1", "sh2", "sh3a", "sh3b"] }[most];
  return Object.fromEntries(names.map((name) => [name, new Uint32Array(4 * size)]));
}

/** Put a layer's coefficients into Spark's arrays; the planes of what its colours exceed 0..1 by, if there are any. */
function decodeHarmonics(extra, last, { harmonics, count }) {
  if (!harmonics) return null;
  const { bytes, limit, file } = harmonics;
  const vectors = 1 + harmonics.count;
  if (bytes.length !== 3 * vectors * count) {
    throw new Error(`${file}: ${bytes.length} bytes, not ${3 * vectors} for each of ${count} Gaussians`);
  }
  const values = Float64Array.from({ length: 256 }, (_, byte) => Math.sign(byte - 128) * ((byte - 128) / STEPS) ** 2 * limit);
  const arrays = [extra.sh1, extra.sh2, extra.sh3a, extra.sh3b];
  for (let k = 1; k < vectors; k++) {
    const [red, green, blue] = [0, 1, 2].map((color) => bytes.subarray((3 * k + color) * count));
    // Four to an array; the last of degree 2 ends the second one.
    const array = arrays[(k - 1) >> 2];
    const place = (k - 1) & 3;
    for (let i = 0; i < count; i++) {
      array[4 * (last - i) + place] = sharedExponent(values[red[i]], values[green[i]], values[blue[i]]);
    }
  }
  return [0, 1, 2].map((color) => ({ at: (i) => values[bytes[color * count + i]] }));
}

/** Three numbers as Spark reads them: 8 bits each, their signs, and one exponent. Its own function cuts off large ones. */
function sharedExponent(r, g, b) {
  const largest = Math.max(Math.abs(r), Math.abs(g), Math.abs(b));
  if (largest === 0) return 0;
  const exponent = Math.min(Math.max(Math.ceil(Math.log2(largest)), -15), 16);
  const step = 2 ** exponent / 255;
  const eight = (value) => Math.min(255, Math.round(Math.abs(value) / step));
  const signs = (r < 0 ? 1 : 0) | (g < 0 ? 2 : 0) | (b < 0 ? 4 : 0);
  return (eight(r) | (eight(g) << 8) | (eight(b) << 16) | (signs << 24) | ((exponent + 15) << 27)) >>> 0;
}

function decodeLayer(splats, last, { bytes, count, scaleLow, scaleStep }, excess) {
  const plane = (k) => bytes.subarray(k * count, (k + 1) * count);
  const planes = Array.from({ length: BYTES }, (_, k) => plane(k));
  const bits = new Uint32Array(1);
  const float = new Float32Array(bits.buffer);
  const centre = (axis, i) => {
    const k = 3 * axis;
    bits[0] = (planes[k][i] << 8) | (planes[k + 1][i] << 16) | (planes[k + 2][i] << 24);
    return float[0];
  };
  const sizes = Float64Array.from({ length: 256 }, (_, step) => Math.exp(scaleLow + step * scaleStep));
  const center = {};
  const scales = {};
  const quaternion = {};
  const color = {};
  for (let i = 0; i < count; i++) {
    [center.x, center.y, center.z] = [centre(0, i), centre(1, i), centre(2, i)];
    [scales.x, scales.y, scales.z] = [sizes[planes[9][i]], sizes[planes[10][i]], sizes[planes[11][i]]];
    const largest = planes[12][i];
    let left = 1;
    for (let k = 0; k < 3; k++) {
      const value = (planes[13 + k][i] - 128) / (127 * Math.SQRT2);
      quaternion[REST[largest][k]] = value;
      left -= value * value;
    }
    quaternion[PARTS[largest]] = Math.sqrt(Math.max(0, left));
    [color.r, color.g, color.b] = [planes[16][i] / 255, planes[17][i] / 255, planes[18][i] / 255];
    if (excess) {
      color.r += excess[0].at(i);
      color.g += excess[1].at(i);
      color.b += excess[2].at(i);
    }
    splats.setSplat(last - i, center, scales, quaternion, planes[19][i] / 255, color);
  }
}
