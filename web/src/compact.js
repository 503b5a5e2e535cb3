// Layers as src/spackle/formats/compact_layer.py writes them, back in the planes that splats.js reads.
const STEPS_PER_LONG_SIDE = 8 * 1536;
const DEPTH_STEPS_PER_E = 12288;
const SCALE_SHIFT = 2;
const QUATERNION_SHIFT = 4;
const COLOR_SHIFT = 2;

/** The 20 planes of `count` Gaussians; `camera` is the description's. */
export function expand(bytes, count, { K, width, height }) {
  const planes = bytes.slice();
  const plane = (k) => planes.subarray(k * count, (k + 1) * count);
  const pixel = Math.max(width, height) / STEPS_PER_LONG_SIDE;
  const right = running(plane(0), plane(1), plane(2));
  const down = running(plane(3), plane(4), plane(5));
  const into = running(plane(6), plane(7), plane(8));
  const float = new Float32Array(1);
  const word = new Uint32Array(float.buffer);
  const put = (axis, i, value) => {
    float[0] = value;
    const rounded = word[0] + 0x80;
    for (let k = 0; k < 3; k++) planes[(3 * axis + k) * count + i] = rounded >>> (8 * (k + 1));
  };
  for (let i = 0; i < count; i++) {
    const z = Math.exp(into[i] / DEPTH_STEPS_PER_E);
    put(0, i, (right[i] * pixel * z) / K[0][0]);
    put(1, i, (down[i] * pixel * z) / K[1][1]);
    put(2, i, z);
  }
  // What a byte has lost lies half a step above what is left.
  const whole = (values, shift) => {
    const half = (1 << shift) >> 1;
    for (let i = 0; i < count; i++) values[i] = Math.min(255, (values[i] << shift) + half);
  };
  for (const k of [9, 10, 11]) whole(plane(k), SCALE_SHIFT);
  for (const k of [13, 14, 15]) whole(plane(k), QUATERNION_SHIFT);
  colors(plane(16), plane(17), plane(18), count);
  return planes;
}

/** Whole numbers of which three planes hold the differences. */
function running(low, middle, high) {
  const values = new Int32Array(low.length);
  let sum = 0;
  for (let i = 0; i < values.length; i++) {
    const unsigned = low[i] | (middle[i] << 8) | (high[i] << 16);
    sum += unsigned & 1 ? -(unsigned + 1) / 2 : unsigned / 2;
    values[i] = sum;
  }
  return values;
}

/** Differences of green, red minus green and blue minus green become red, green and blue. */
function colors(first, second, third, count) {
  const sums = [0, 0, 0];
  const signed = (value) => (value << 24) >> 24;
  const byte = (value) => Math.round((value * 255) / (255 >> COLOR_SHIFT));
  for (let i = 0; i < count; i++) {
    [first[i], second[i], third[i]].forEach((value, k) => (sums[k] = (sums[k] + value) & 255));
    const green = sums[0];
    [first[i], second[i], third[i]] = [green + signed(sums[1]), green, green + signed(sums[2])].map(byte);
  }
}
