// Read layers of a sample, which the server decodes, and paint them into canvases.
const CLASSES = [[24, 26, 32], [176, 164, 148], [240, 228, 66], [86, 200, 255]];
// viridis (van der Walt and Smith 2015) at nine places, dark to bright
const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
const WIDE = { uint8: Uint8Array, bool: Uint8Array, uint16: Uint16Array, float32: Float32Array, float64: Float64Array };
const MOST_KEPT = 24;

const kept = new Map(); // decoded layers, the latest last

// Return a layer of a sample as {data, shape}. Raises an Error with a sentence if it cannot be read.
export function read(layer, index) {
  const key = `${layer.name} ${index}`;
  let reading = kept.get(key);
  if (reading) kept.delete(key);
  else {
    reading = fetched(layer, index);
    reading.catch(() => kept.delete(key));
  }
  kept.set(key, reading);
  while (kept.size > MOST_KEPT) kept.delete(kept.keys().next().value);
  return reading;
}

async function fetched(layer, index) {
  const response = await fetch(`/api/layer/${layer.name}/${index}`);
  if (!response.ok) throw new Error(response.status === 422 ? await response.text() : `${layer.name} cannot be read`);
  const buffer = await response.arrayBuffer();
  return { data: layer.dtype === "float16" ? halves(new Uint16Array(buffer)) : new WIDE[layer.dtype](buffer), shape: layer.shape };
}

// Return numbers of 16 bits as numbers of 32 bits, for browsers without Float16Array.
function halves(words) {
  const out = new Float32Array(words.length);
  for (let k = 0; k < words.length; k++) {
    const sign = words[k] & 0x8000 ? -1 : 1, power = (words[k] >> 10) & 31, part = words[k] & 1023;
    out[k] = power === 0 ? sign * part * 2 ** -24 : power === 31 ? (part ? NaN : sign * Infinity) : sign * (1 + part / 1024) * 2 ** (power - 15);
  }
  return out;
}

function canvasOf(width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  return canvas;
}

const ROOTS = Uint8ClampedArray.from({ length: 256 }, (_, value) => Math.sqrt(255 * value));

// Return a canvas with the square root of the values of an image, black and white as they are.
export function rooted(canvas) {
  const { width, height } = canvas, out = canvasOf(width, height);
  const image = canvas.getContext("2d").getImageData(0, 0, width, height);
  for (let k = 0; k < image.data.length; k++) if (k % 4 < 3) image.data[k] = ROOTS[image.data[k]];
  out.getContext("2d").putImageData(image, 0, 0);
  return out;
}

// Return rows and columns of a layer.
export const sizeOf = (layer, shape) => (layer.dims[0] === "band" || layer.dims[0] === "fault" ? shape.slice(1, 3) : shape.slice(0, 2));

// Return the name of a value of a layer of classes, or the names of its bits.
export const nameOf = (layer, value) => (layer.bits ? layer.names.filter((_, k) => (value >> k) & 1).join(" ") || "none" : layer.names[value] ?? value);

// Return a canvas of a layer, {low, high, units} or {names} for its legend, and whether it is an image of the camera.
export function paint(layer, { data, shape }) {
  const [height, width] = sizeOf(layer, shape);
  const canvas = canvasOf(width, height);
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  const out = image.data;
  const count = width * height;
  const photograph = layer.dtype === "uint8" && shape.length === 3;
  let legend = {};
  if (photograph) {
    const channels = shape[2];
    for (let k = 0, a = 0, b = 0; k < count; k++, a += 4, b += channels) {
      out[a] = data[b]; out[a + 1] = data[b + 1]; out[a + 2] = data[b + 2]; out[a + 3] = 255;
    }
  } else if (layer.name === "normal") {
    for (let k = 0; k < count; k++) {
      const x = data[3 * k], y = data[3 * k + 1], z = data[3 * k + 2];
      const none = x === 0 && y === 0 && z === 0;
      out[4 * k] = none ? 16 : 127.5 * (x + 1);
      out[4 * k + 1] = none ? 18 : 127.5 * (1 - y);
      out[4 * k + 2] = none ? 22 : 127.5 * (1 - z);
      out[4 * k + 3] = 255;
    }
    legend = { note: "red right, green up, blue towards the camera" };
  } else if (layer.names.length) {
    // a value of several bits has the colour of the lowest one
    const names = layer.bits ? ["none", ...layer.names] : layer.names;
    const classOf = (value) => (layer.bits && value ? 32 - Math.clz32(value & -value) : value);
    const colours = names.map((_, k) => CLASSES[k % 4].map((value) => value * (k > 3 ? 0.7 : 1)));
    const used = new Set();
    for (let k = 0; k < count; k++) {
      const of = classOf(data[k]), colour = colours[of] ?? CLASSES[0];
      used.add(of);
      for (let c = 0; c < 3; c++) out[4 * k + c] = colour[c];
      out[4 * k + 3] = 255;
    }
    legend = { names: names.map((name, k) => [name, colours[k], used.has(k)]).filter((entry) => entry[2]) };
  } else if (layer.dims[0] === "band") {
    const bands = shape[0], chosen = [Math.round(0.75 * (bands - 1)), Math.round(0.5 * (bands - 1)), Math.round(0.2 * (bands - 1))];
    const { high } = range(data.subarray(chosen[1] * count, (chosen[1] + 1) * count), 1);
    for (let k = 0; k < count; k++) {
      for (let c = 0; c < 3; c++) out[4 * k + c] = 255 * Math.min(1, Math.max(0, data[chosen[c] * count + k] / high)) ** (1 / 2.2);
      out[4 * k + 3] = 255;
    }
    legend = { note: `bands ${chosen.join(", ")} as red, green, blue` };
  } else {
    const step = shape.length === 3 ? shape[2] : 1;
    const { low, high } = range(data, step);
    const grey = layer.dtype === "uint16";
    const table = ramp(grey);
    const width_ = high - low || 1;
    for (let k = 0; k < count; k++) {
      const value = data[k * step];
      const at = Number.isFinite(value) ? Math.round(255 * Math.min(1, Math.max(0, (value - low) / width_))) : -1;
      for (let c = 0; c < 3; c++) out[4 * k + c] = at < 0 ? [16, 18, 22][c] : table[3 * at + c];
      out[4 * k + 3] = 255;
    }
    legend = { low, high, units: layer.units, table, note: step > 1 ? "component x; the pointer reads all" : "" };
  }
  context.putImageData(image, 0, 0);
  return { canvas, legend, photograph };
}

// Return the 1st and the 99th percentile of the finite values, from some of them.
function range(data, step) {
  const every = Math.max(1, Math.floor(data.length / step / 20000)) * step;
  const some = [];
  for (let k = 0; k < data.length; k += every) if (Number.isFinite(data[k])) some.push(data[k]);
  some.sort((a, b) => a - b);
  return some.length ? { low: some[Math.floor(0.01 * (some.length - 1))], high: some[Math.ceil(0.99 * (some.length - 1))] } : { low: 0, high: 1 };
}

export function ramp(grey) {
  const table = new Uint8ClampedArray(768);
  for (let k = 0; k < 256; k++) {
    const at = (k / 255) * (VIRIDIS.length - 1), j = Math.min(VIRIDIS.length - 2, Math.floor(at));
    for (let c = 0; c < 3; c++) table[3 * k + c] = grey ? k : VIRIDIS[j][c] + (at - j) * (VIRIDIS[j + 1][c] - VIRIDIS[j][c]);
  }
  return table;
}

// Return a canvas of the difference of two images, eight times, on grey.
export function difference(image, clean, shape) {
  const [height, width, channels] = shape;
  const canvas = canvasOf(width, height);
  const context = canvas.getContext("2d");
  const out = context.createImageData(width, height);
  for (let k = 0; k < width * height; k++) {
    for (let c = 0; c < 3; c++) out.data[4 * k + c] = 127 + 8 * (image.data[channels * k + c] - clean.data[channels * k + c]);
    out.data[4 * k + 3] = 255;
  }
  context.putImageData(out, 0, 0);
  return { canvas, legend: { note: "image − clean twin, 8 ×; grey: equal" } };
}

// Return for each fault a canvas of its mask, tinted inside with an outline, or null; and its area.
export function paintMasks({ data, shape }, faults, scale) {
  const [count, height, width] = shape;
  const line = Math.max(1, Math.round(scale));
  const painted = [];
  for (let f = 0; f < count; f++) {
    const mask = data.subarray(f * width * height, (f + 1) * width * height);
    let area = 0;
    for (let k = 0; k < mask.length; k++) area += mask[k];
    if (!area) { painted.push(null); continue; }
    const whole = area > 0.98 * mask.length;
    const canvas = canvasOf(width, height);
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const words = new Uint32Array(image.data.buffer);
    const [r, g, b] = faults[f].colour;
    const rgb = r | (g << 8) | (b << 16);
    const inside = (rgb | ((whole || !faults[f].localised ? 32 : 77) << 24)) >>> 0, edge = (rgb | (235 << 24)) >>> 0;
    for (let y = 0, k = 0; y < height; y++)
      for (let x = 0; x < width; x++, k++)
        if (mask[k])
          words[k] = x < line || y < line || x >= width - line || y >= height - line
            || !mask[k - line] || !mask[k + line] || !mask[k - line * width] || !mask[k + line * width] ? edge : inside;
    context.putImageData(image, 0, 0);
    painted.push({ canvas, area: area / mask.length });
  }
  return painted;
}
