// A frame's bytes as arrays, and what of it can be shown (proto/README.md has the format).

const MAGIC = "FBARFRM1";
const ARRAYS = { "<f8": Float64Array, "<f4": Float32Array, "<u4": Uint32Array };
const AXES = ["x", "y", "z"];

export function parse(buffer) {
  const bytes = new Uint8Array(buffer);
  const text = new TextDecoder();
  if (text.decode(bytes.subarray(0, 8)) !== MAGIC) throw new Error("this is no frame");
  const length = new DataView(buffer).getUint32(8, true);
  const header = JSON.parse(text.decode(bytes.subarray(64, 64 + length)));
  const fields = new Map();
  for (const field of header.fields) {
    const Type = ARRAYS[field.dtype];
    if (Type === undefined) continue;
    const width = field.shape.slice(1).reduce((a, b) => a * b, 1);
    fields.set(field.name, {
      ...field,
      width,
      values: new Type(buffer, field.offset, field.shape[0] * width),
    });
  }
  return { header, fields, count: header.count, dimension: header.dimension };
}

// Particles go to the graphics processor shuffled, so that every beginning of them is spread over all, without the
// stripes of the rows in which they were seeded, and a view in motion may draw a part. The same shuffle for one number of
// particles, kept (a frame is the like of the one before): those that are left out stay out.
const shuffles = new Map();
function shuffled(n) {
  let order = shuffles.get(n);
  if (order === undefined) {
    order = Uint32Array.from({ length: n }, (_, p) => p);
    let seed = 1;
    for (let p = n - 1; p > 0; p--) {
      seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0; // Numerical Recipes' generator: its high bits are good enough
      const q = Math.floor((seed / 4294967296) * (p + 1));
      [order[p], order[q]] = [order[q], order[p]];
    }
    if (shuffles.size > 3) shuffles.delete(shuffles.keys().next().value);
    shuffles.set(n, order);
  }
  return order;
}

// Positions as x, y, z of every particle, for the graphics processor.
export function positions(frame) {
  const from = frame.fields.get("position");
  const out = new Float32Array(3 * frame.count);
  if (from === undefined) return out;
  const d = from.width;
  const order = shuffled(frame.count);
  for (let p = 0; p < frame.count; p++)
    for (let k = 0; k < d; k++) out[3 * p + k] = from.values[d * order[p] + k];
  return out;
}

const SIGNED = new Set(["mean_stress", "mean_stress_smooth", "stress"]);
const NAMES = {
  position: "Position",
  velocity: "Velocity",
  displacement: "Displacement",
  mean_stress: "Mean stress",
  mean_stress_smooth: "Mean stress, smooth",
  stress: "Stress",
  von_mises: "Von Mises stress",
  volume_ratio: "Volume ratio J",
  volume_ratio_bar: "Volume ratio J̄",
  plastic_strain: "Plastic strain",
  density: "Density",
  body: "Body",
  id: "Particle number",
};
const VECTORS = new Set(["position", "velocity", "displacement"]);

// What can be chosen of the named fields: {key, field, part, label, signed}.
export function choices(names, dimension) {
  const list = [];
  for (const field of names) {
    const label = NAMES[field] ?? field;
    const add = (part, more, signed) =>
      list.push({ key: part === null ? field : `${field}:${part}`, field, part, label: label + more, signed });
    if (VECTORS.has(field)) {
      if (field !== "position") add("size", ", magnitude", false);
      for (let d = 0; d < dimension; d++) add(String(d), ` ${AXES[d]}`, field !== "position");
    } else if (field === "stress") {
      for (let d = 0; d < dimension; d++)
        for (let e = d; e < dimension; e++) add(String(d * dimension + e), ` ${AXES[d]}${AXES[e]}`, true);
    } else {
      add(null, "", SIGNED.has(field));
    }
  }
  return list;
}

// The values of a choice, one a particle in the order of `positions`, and their unit; null when the frame does not have the field.
export function values(frame, choice) {
  const from = frame.fields.get(choice.field);
  if (from === undefined) return null;
  const out = new Float32Array(frame.count);
  const w = from.width;
  const v = from.values;
  const order = shuffled(frame.count);
  if (choice.part === "size") {
    for (let p = 0; p < frame.count; p++) {
      let sum = 0;
      for (let d = 0; d < w; d++) sum += v[w * order[p] + d] ** 2;
      out[p] = Math.sqrt(sum);
    }
  } else {
    const offset = Number(choice.part ?? 0);
    for (let p = 0; p < frame.count; p++) out[p] = v[w * order[p] + offset];
  }
  return { values: out, unit: from.unit };
}

// Lowest and highest finite value; with `robust` the 1 % at either end are left out.
export function extent(arrays, robust) {
  let low = Infinity;
  let high = -Infinity;
  const sample = [];
  for (const array of arrays) {
    const stride = Math.max(1, Math.floor(array.length / 20000));
    for (let p = 0; p < array.length; p++) {
      const v = array[p];
      if (!Number.isFinite(v)) continue;
      if (v < low) low = v;
      if (v > high) high = v;
      if (robust && p % stride === 0) sample.push(v);
    }
  }
  if (!(low <= high)) return null;
  if (robust && sample.length > 200) {
    const sorted = Float64Array.from(sample).sort();
    low = sorted[Math.floor(0.01 * (sorted.length - 1))];
    high = sorted[Math.ceil(0.99 * (sorted.length - 1))];
  }
  return [low, high];
}
