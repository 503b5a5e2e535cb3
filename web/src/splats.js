// Layers as src/spackle/formats/html.py writes them, as Spark's Gaussians.
import { ExtSplats } from "@sparkjsdev/spark";

const BYTES = 20;
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
  let last = count - 1;
  for (const layer of layers) {
    if (layer.bytes.length !== BYTES * layer.count) {
      throw new Error(`${layer.file}: ${layer.bytes.length} bytes, not ${BYTES} for each of ${layer.count} Gaussians`);
    }
    decodeLayer(splats, last, layer);
    last -= layer.count;
  }
  return new ExtSplats({ extArrays: splats.extArrays, numSplats: count }); // only so do they become textures
}

function decodeLayer(splats, last, { bytes, count, scaleLow, scaleStep }) {
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
    splats.setSplat(last - i, center, scales, quaternion, planes[19][i] / 255, color);
  }
}
