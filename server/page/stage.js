// The particles of one run, or of two side by side, at one time: panes, legend, time slider.

import { frames as stream } from "./api.js";
import { table, ticks } from "./colors.js";
import { path, thinning } from "./data.js";
import { choices, extent, positions, values } from "./frame.js";
import { byId, color, h, isDark, number, options, save, say, scaled, toast } from "./ui.js";
import { Camera, View } from "./view.js";

const PLAY_MS = 60; // between two frames that are played
const PATIENT_MS = 30; // that a frame may take the page without being noticed
const BOX = 8; // corners

const camera = new Camera();
const panes = []; // {id, data, run, view, canvas, legend, title, frame, seq, wanted, loading, seen}
let time = NaN;
let live = true;
let playing = 0;
let follower = null; // {id, abort} of the stream that the single pane follows
let onTime = () => {};

export function onTimeChange(call) {
  onTime = call;
}

const setting = {
  field: null,
  get most() {
    return Number(byId("most").value);
  },
  get range() {
    return byId("range").value;
  },
  get map() {
    return byId("map").value;
  },
  get size() {
    return Number(byId("size").value);
  },
};

// ---- Panes ------------------------------------------------------------------------------------

function makePane(id) {
  const canvas = h("canvas", { class: "particles", tabindex: "0", role: "img", "aria-label": `Particles of ${id}` });
  const title = h("figcaption", { class: "pane-title" });
  const note = h("p", { class: "pane-note" });
  const scale = h("div", { class: "scale", "aria-hidden": "true" }, h("i"), h("span"));
  const legend = h("div", { class: "legend" });
  const box = h("figure", { class: "pane" }, canvas, title, legend, scale, note);
  byId("view").append(box);
  const pane = { id, box, canvas, title, note, legend, scale, frame: null, seq: -1, wanted: -1, loading: false, seen: null, data: null, run: null };
  pane.view = new View(canvas, camera);
  pane.view.onrestored = () => upload(pane);
  pane.view.ondrawn = () => drawScale(pane);
  if (pane.view.gl === null) note.textContent = "This browser has no WebGL2, so particles cannot be drawn. Curves and everything else work.";
  canvas.addEventListener("dblclick", fit);
  return pane;
}

// Shows these runs: [{run, data}], one or two.
export function show(sets) {
  const ids = sets.map(({ run }) => run.id);
  const same = ids.length === panes.length && ids.every((id, k) => id === panes[k].id);
  if (!same) {
    stopFollowing();
    while (panes.length > 0) {
      const pane = panes.pop();
      pane.view.close();
      pane.box.remove();
    }
    camera.touched = false;
    time = NaN;
    live = true;
    stopPlaying();
    for (const id of ids) panes.push(makePane(id));
    byId("view").classList.toggle("two", ids.length > 1);
  }
  for (const [k, { run, data }] of sets.entries()) Object.assign(panes[k], { run, data });
  refresh();
}

// The runs or what is known of them have changed.
export function refresh() {
  if (panes.length === 0) return;
  offerFields();
  timeline();
  if (live) follow();
  else seek(time, false);
  say(byId("live"), panes.some((p) => isAlive(p.run)) ? "Live" : "Last");
}

const isAlive = (run) => ["queued", "running", "waiting"].includes(run?.state);

function offerFields() {
  const pane = panes[0];
  const names = pane.data.config?.output?.fields;
  if (names === undefined) return;
  const list = choices(names, pane.data.scene?.dimension ?? 2);
  if (list.length === 0) return;
  if (setting.field === null || !list.some((c) => c.key === setting.field.key))
    setting.field = list.find((c) => c.field === "mean_stress") ?? list.find((c) => c.key === "velocity:size") ?? list[0];
  options(byId("field"), list.map((c) => [c.key, c.label]), setting.field.key);
}

// ---- Time -------------------------------------------------------------------------------------

// All times at which some pane has a frame.
function times() {
  if (panes.length === 1) return panes[0].data.frames.map((f) => f.time);
  const all = new Set();
  for (const pane of panes) for (const f of pane.data.frames) all.add(Number(f.time.toPrecision(12)));
  return [...all].sort((a, b) => a - b);
}

let axis = [];

function timeline() {
  axis = times();
  const slider = byId("slider");
  const last = Math.max(0, axis.length - 1);
  if (Number(slider.max) !== last) slider.max = last;
  slider.disabled = axis.length < 2;
  drawMarks();
}

// Where F-bar was changed, on the slider.
function drawMarks() {
  const marks = byId("marks");
  const span = axis.at(-1) - axis[0];
  const list = [];
  for (const pane of panes)
    for (const change of pane.data.changes) if (change.patch.fbar !== undefined) list.push([place(change.time), JSON.stringify(change.patch.fbar)]);
  const key = JSON.stringify([list, axis.length]);
  if (marks.dataset.list === key) return;
  marks.dataset.list = key;
  marks.replaceChildren();
  if (!(span > 0)) return;
  for (const [at, what] of list) {
    const mark = h("i", { title: `F̄: ${what}` });
    mark.style.left = `${100 * at}%`;
    marks.append(mark);
  }
}

function place(t) {
  let k = axis.findIndex((a) => a >= t);
  if (k < 0) k = axis.length - 1;
  return axis.length > 1 ? k / (axis.length - 1) : 0;
}

function tell() {
  const slider = byId("slider");
  let k = 0;
  while (k + 1 < axis.length && axis[k + 1] <= time + 1e-12 + 1e-9 * Math.abs(time)) k++;
  if (Number(slider.value) !== k) slider.value = k;
  const frame = panes[0].frame?.header;
  const text = Number.isFinite(time) ? `t = ${number(time, 5)} s` : "no frame yet";
  say(byId("clock"), frame && panes.length === 1 ? `${text} · frame ${frame.seq}` : text);
  slider.setAttribute("aria-valuetext", text);
  byId("live").setAttribute("aria-pressed", String(live));
  onTime(time);
}

// Shows the frames at a time, or before it.
export function seek(t, byUser = true) {
  if (byUser) {
    live = false;
    stopFollowing();
  }
  if (!Number.isFinite(t)) t = axis.at(-1) ?? NaN;
  time = t;
  for (const pane of panes) {
    const k = Number.isFinite(t) ? Math.max(0, pane.data.indexAt(t)) : -1;
    const frame = pane.data.frames[k];
    if (frame !== undefined) want(pane, frame.seq);
  }
  tell();
}

export function goLive() {
  live = true;
  stopPlaying();
  follow();
}

// The newest frames: by the stream where one run goes on, else from the journal.
function follow() {
  const pane = panes[0];
  const streams = panes.length === 1 && isAlive(pane.run) && !document.hidden && setting.field !== null;
  if (!streams) stopFollowing();
  if (streams && follower === null) startFollowing(pane);
  if (streams && pane.frame !== null && pane.followed) {
    time = pane.frame.header.time;
    tell();
    return;
  }
  seek(axis.at(-1), false);
}

export function stopFollowing() {
  follower?.abort.abort();
  follower = null;
}

// When the browser has shown what was asked for last; in a hidden tab at once.
const drawn = () => new Promise((done) => (document.hidden ? done() : requestAnimationFrame(() => setTimeout(done))));

async function startFollowing(pane) {
  const mine = { abort: new AbortController() };
  const { most, field } = { most: setting.most, field: setting.field.field };
  follower = mine;
  try {
    for await (const buffer of stream(path(pane.id, `/stream${thinning(most, field)}`), { signal: mine.abort.signal })) {
      if (follower !== mine || !panes.includes(pane)) return;
      const frame = pane.data.keep(buffer, most, field);
      pane.followed = true;
      const began = performance.now();
      accept(pane, frame);
      time = frame.header.time;
      tell();
      await drawn();
      // Frames may take the page half of its time; what is not read the daemon leaves out.
      const took = performance.now() - began;
      if (took > PATIENT_MS) await new Promise((done) => setTimeout(done, Math.min(took, 1000)));
    }
  } catch {
    // gone: the next event of the run, or the return of the daemon, brings it back
  } finally {
    pane.followed = false;
    if (follower === mine) follower = null;
  }
}

// Loads a frame; while one is on its way only the newest wish counts.
async function want(pane, seq) {
  pane.wanted = seq;
  if (pane.loading || setting.field === null) return;
  if (pane.seq === seq && pane.frame !== null && pane.frame.asked === asked()) return;
  pane.loading = true;
  try {
    while (panes.includes(pane)) {
      const now = pane.wanted;
      const key = asked();
      const frame = await pane.data.frame(now, setting.most, setting.field.field);
      if (panes.includes(pane)) accept(pane, frame, key);
      if (now === pane.wanted && key === asked()) break;
    }
  } catch (error) {
    if (error.name !== "AbortError") pane.note.textContent = error.status === 404 ? "this frame is gone" : "";
  } finally {
    pane.loading = false;
  }
}

const asked = () => `${setting.most} ${setting.field.field}`;

function accept(pane, frame, key = asked()) {
  frame.asked = key;
  pane.frame = frame;
  pane.seq = frame.header.seq;
  pane.note.textContent = "";
  upload(pane);
  paint();
  tell();
}

// ---- Drawing ----------------------------------------------------------------------------------

// Distance of particles, m: the cell by the particles in it, wider where some are left out.
function spacing(pane) {
  const scene = pane.data.scene;
  const d = pane.frame.dimension;
  let n = 1;
  for (const body of Object.values(scene?.bodies ?? {})) n = Math.max(n, body.particles_per_cell ?? 1);
  const thinned = Math.max(1, (pane.run?.particles ?? pane.frame.count) / Math.max(1, pane.frame.count));
  if (scene?.cell) return (scene.cell * thinned ** (1 / d)) / n ** (1 / d);
  return pane.seen ? Math.max(...pane.seen[1].map((v, k) => v - pane.seen[0][k])) / pane.frame.count ** (1 / d) : 1;
}

function upload(pane) {
  const { frame, view } = pane;
  if (frame === null) return;
  frame.positions ??= positions(frame);
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  const p = frame.positions;
  for (let k = 0; k < p.length; k++) {
    const d = k % 3;
    if (p[k] < low[d]) low[d] = p[k];
    if (p[k] > high[d]) high[d] = p[k];
  }
  const first = pane.seen === null;
  if (p.length > 0)
    pane.seen = first ? [low, high] : [low.map((v, d) => Math.min(v, pane.seen[0][d])), high.map((v, d) => Math.max(v, pane.seen[1][d]))];
  const now = removed(pane.data.scene, frame.header.time).join(" ");
  if (first || now !== pane.removed) {
    pane.removed = now;
    pane.view.strokesOf(walls(pane));
  }
  // The diagonal: discs leave no gaps; and some more where a part of the particles is there, which are no lattice.
  const part = frame.count < (pane.run?.particles ?? 0);
  const size = (part ? 1.5 : 1) * Math.SQRT2 * setting.size * spacing(pane);
  view.particles(p, frame.dimension, size);
  if (first || !camera.touched) fitIfOutside(first);
}

// Names of the walls that the stages up to a time have removed. The last stage begins at 0.
function removed(scene, time) {
  const stages = scene?.stages ?? [];
  const out = [];
  let begin = 0;
  for (let k = stages.length - 1; k >= 0; k--) {
    if (k < stages.length - 1) begin -= stages[k].duration ?? stages[k].until?.duration ?? 0;
    if (begin < time || (k === 0 && time <= begin)) out.push(...(stages[k].remove?.walls ?? []));
  }
  return out;
}

// The walls of a scene as lines, cut to what is near the particles.
function walls(pane) {
  const scene = pane.data.scene;
  const lines = [];
  if (!scene || !pane.seen) return lines;
  const d = scene.dimension;
  const domain = scene.domain ?? { min: pane.seen[0], max: pane.seen[1] };
  const size = Math.max(...pane.seen[1].map((v, k) => v - pane.seen[0][k]));
  const margin = (d === 2 ? 2 : 0.1) * size; // in 3D lines from afar would cross the view
  const low = [0, 1, 2].map((k) => (k < d ? Math.max(domain.min[k], pane.seen[0][k] - margin) : 0));
  const high = [0, 1, 2].map((k) => (k < d ? Math.min(domain.max[k], pane.seen[1][k] + margin) : 0));
  const gone = removed(scene, pane.frame.header.time);
  for (const [name, wall] of Object.entries(scene.walls ?? {})) {
    if (gone.includes(name)) continue;
    const at = "xyz".indexOf(wall.axis);
    if (at < 0) continue;
    const others = [0, 1, 2].filter((k) => k !== at && k < d);
    const point = (...along) => {
      const out = [0, 0, 0];
      out[at] = wall.at;
      others.forEach((k, j) => {
        out[k] = along[j];
      });
      return out;
    };
    if (d === 2) {
      lines.push(...point(low[others[0]]), ...point(high[others[0]]));
    } else {
      const [a, b] = others;
      const corners = [point(low[a], low[b]), point(high[a], low[b]), point(high[a], high[b]), point(low[a], high[b])];
      for (let k = 0; k < 4; k++) lines.push(...corners[k], ...corners[(k + 1) % 4]);
    }
  }
  return lines;
}

function bounds() {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const { seen } of panes)
    if (seen !== null)
      for (let d = 0; d < 3; d++) {
        low[d] = Math.min(low[d], seen[0][d]);
        high[d] = Math.max(high[d], seen[1][d]);
      }
  return low[0] <= high[0] ? [low, high] : null;
}

export function fit() {
  const box = bounds();
  const shown = panes.find((p) => p.frame !== null);
  if (box === null || shown === undefined) return;
  camera.fit(...box, shown.frame.dimension, shown.view.aspect);
  camera.touched = false;
}

// Until the user takes the view in hand, all that has been seen stays in it.
function fitIfOutside(first) {
  const box = bounds();
  if (box === null) return;
  const shown = panes.find((p) => p.frame !== null);
  const matrix = camera.matrix(shown.view.aspect);
  let outside = first || camera.dimension !== shown.frame.dimension;
  for (let k = 0; k < BOX && !outside; k++) {
    const corner = [0, 1, 2].map((d) => box[(k >> d) & 1][d]);
    const [x, y, , w] = [0, 1, 2, 3].map((r) => matrix[r] * corner[0] + matrix[4 + r] * corner[1] + matrix[8 + r] * corner[2] + matrix[12 + r]);
    outside = Math.abs(x) > 1.05 * w || Math.abs(y) > 1.05 * w;
  }
  if (outside) fit();
}

function rangeOf(arrays) {
  if (setting.range === "fixed") {
    const low = Number(byId("low").value.replace("−", "-"));
    const high = Number(byId("high").value.replace("−", "-"));
    const bad = !Number.isFinite(low) || !Number.isFinite(high) || !(low < high);
    for (const id of ["low", "high"]) byId(id).toggleAttribute("aria-invalid", bad);
    if (!bad) return [low, high];
  }
  let range = extent(arrays, setting.range === "robust");
  if (range === null) return [0, 1];
  if (setting.field.signed && mapName(range) === "diverging") {
    const most = Math.max(Math.abs(range[0]), Math.abs(range[1]));
    range = [-most, most];
  }
  if (range[0] === range[1]) {
    const more = range[0] !== 0 ? 1e-3 * Math.abs(range[0]) : 1;
    range = [range[0] - more, range[1] + more];
  }
  return range;
}

// Diverging where values of either sign matter, else sequential.
function mapName(range) {
  if (setting.map !== "auto") return setting.map;
  const [a, b] = range;
  return setting.field.signed && a < 0 && b > 0 && Math.min(-a, b) > 0.05 * Math.max(-a, b) ? "diverging" : "sequential";
}

let shownRange = [0, 1];

// Colours of all panes by one range, so that equal colours are equal values.
export function paint() {
  const ready = panes.filter((p) => p.frame !== null && setting.field !== null);
  const fields = ready.map((p) => values(p.frame, setting.field));
  if (fields.every((f) => f === null)) {
    for (const pane of ready) pane.note.textContent = "";
  }
  const range = rangeOf(fields.filter((f) => f !== null).map((f) => f.values));
  const name = mapName(range);
  const dark = isDark();
  const colors = table(name, dark);
  shownRange = range;
  for (const [k, pane] of ready.entries()) {
    const { view } = pane;
    view.theme(color("view"), color("wall"));
    view.colors(colors);
    view.range = range;
    view.values(fields[k]?.values ?? new Float32Array(pane.frame.count).fill(NaN));
    if (fields[k] === null) pane.note.textContent = `no ${setting.field.label.toLowerCase()} in this frame`;
    const header = pane.frame.header;
    const part = pane.frame.count < (pane.run?.particles ?? 0) ? `${pane.frame.count} of ${pane.run.particles} particles` : `${pane.frame.count} particles`;
    pane.title.replaceChildren(h("b", {}, pane.id), ` F̄ ${header.fbar ? "on" : "off"} · t = ${number(header.time, 4)} s · ${part}`);
    pane.canvas.setAttribute("aria-label", `Particles of ${pane.id} at ${number(header.time, 4)} s, coloured by ${setting.field.label}`);
    drawLegend(pane.legend, colors, range, fields[k]?.unit ?? "", setting.field.label);
    view.request();
  }
}

function drawLegend(box, colors, range, unit, label) {
  const size = Math.max(Math.abs(range[0]), Math.abs(range[1]));
  const { factor, unit: shown } = scaled(size, unit);
  const key = JSON.stringify([range, unit, label, colors[0], colors[512]]);
  if (box.dataset.key === key) return;
  box.dataset.key = key;
  const bar = h("canvas", { width: 256, height: 1 });
  bar.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(colors), 256, 1), 0, 0);
  const marks = ticks(range[0] / factor, range[1] / factor, 4).map((t) => {
    const mark = h("span", {}, number(t, 4));
    mark.style.left = `${(100 * (t - range[0] / factor)) / ((range[1] - range[0]) / factor)}%`;
    return mark;
  });
  box.replaceChildren(h("p", {}, shown ? `${label}, ${shown}` : label), bar, h("div", { class: "ticks" }, marks));
}

function drawScale(pane) {
  const pixels = pane.canvas.clientHeight / (2 * camera.half); // a metre
  if (!(pixels > 0) || !Number.isFinite(pixels)) return;
  const raw = 110 / pixels;
  const power = 10 ** Math.floor(Math.log10(raw));
  const length = [5, 2, 1].map((f) => f * power).find((l) => l <= raw) ?? power;
  pane.scale.firstChild.style.width = `${length * pixels}px`;
  say(pane.scale.lastChild, length < 0.01 ? `${number(1000 * length)} mm` : `${number(length)} m`);
}

// ---- Picture ----------------------------------------------------------------------------------

export function picture() {
  const shown = panes.filter((p) => p.frame !== null);
  if (shown.length === 0) {
    toast("there is no frame to draw yet", true);
    return;
  }
  const foot = 92;
  const head = 36;
  for (const pane of shown) pane.view.draw(); // the browser drops what was drawn before
  const width = shown.reduce((s, p) => s + p.canvas.width, 0) + 12 * (shown.length - 1);
  const height = Math.max(...shown.map((p) => p.canvas.height));
  const out = h("canvas", { width, height: height + head + foot });
  const ctx = out.getContext("2d");
  ctx.fillStyle = color("view");
  ctx.fillRect(0, 0, out.width, out.height);
  let x = 0;
  for (const pane of shown) {
    pane.view.draw();
    ctx.drawImage(pane.canvas, x, head);
    ctx.fillStyle = color("text");
    ctx.font = "16px system-ui, sans-serif";
    ctx.fillText(pane.title.textContent, x + 10, 24, pane.canvas.width - 20);
    x += pane.canvas.width + 12;
  }
  const colors = table(mapName(shownRange), isDark());
  const unit = shown[0].frame.fields.get(setting.field.field)?.unit ?? "";
  const { factor, unit: prefixed } = scaled(Math.max(...shownRange.map(Math.abs)), unit);
  const bar = h("canvas", { width: 256, height: 1 });
  bar.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(colors), 256, 1), 0, 0);
  const wide = Math.min(420, out.width - 60);
  const top = height + head + 34;
  ctx.fillStyle = color("text");
  ctx.fillText(prefixed ? `${setting.field.label}, ${prefixed}` : setting.field.label, 24, top - 10);
  ctx.drawImage(bar, 24, top, wide, 16);
  ctx.font = "13px system-ui, sans-serif";
  ctx.textAlign = "center";
  const [low, high] = shownRange.map((v) => v / factor);
  for (const t of ticks(low, high, 5)) ctx.fillText(number(t, 4), 24 + (wide * (t - low)) / (high - low), top + 34);
  out.toBlob((blob) => save(blob, `${shown.map((p) => p.id).join("-and-")}-${setting.field.key.replace(":", "-")}-t${shown[0].frame.header.time.toPrecision(4)}.png`), "image/png");
}

// ---- Hands ------------------------------------------------------------------------------------

export function move(by) {
  const k = Number(byId("slider").value) + by;
  if (axis.length > 0) seek(axis[Math.min(axis.length - 1, Math.max(0, k))]);
}

function stopPlaying() {
  clearTimeout(playing);
  playing = 0;
  byId("play").textContent = "▶";
  byId("play").setAttribute("aria-label", "Play");
}

export function play() {
  if (playing !== 0) {
    stopPlaying();
    return;
  }
  if (axis.length < 2) return;
  if (Number(byId("slider").value) >= axis.length - 1) seek(axis[0]);
  byId("play").textContent = "⏸";
  byId("play").setAttribute("aria-label", "Stop playing");
  const next = () => {
    if (panes.every((p) => !p.loading)) {
      const k = Number(byId("slider").value) + 1;
      if (k >= axis.length) {
        stopPlaying();
        return;
      }
      seek(axis[k]);
    }
    playing = setTimeout(next, PLAY_MS);
  };
  playing = setTimeout(next, PLAY_MS);
}

// What was asked of frames has changed: other fields, other particles.
function again() {
  stopFollowing();
  if (live) follow();
  else seek(time, false);
}

export function repaint() {
  for (const pane of panes) {
    if (pane.frame !== null) upload(pane);
    pane.view.theme(color("view"), color("wall"));
    pane.view.request();
  }
  if (panes.some((p) => p.frame !== null)) paint();
}

export function setUp() {
  byId("field").addEventListener("change", () => {
    const list = choices(panes[0].data.config.output.fields, panes[0].data.scene.dimension);
    const before = setting.field.field;
    setting.field = list.find((c) => c.key === byId("field").value);
    if (before === setting.field.field) paint();
    else again();
  });
  byId("range").addEventListener("change", () => {
    const fixed = setting.range === "fixed";
    byId("limits").hidden = !fixed;
    if (fixed) {
      byId("low").value = Number(shownRange[0].toPrecision(3));
      byId("high").value = Number(shownRange[1].toPrecision(3));
    }
    paint();
  });
  for (const id of ["low", "high"]) byId(id).addEventListener("input", paint);
  byId("map").addEventListener("change", paint);
  byId("most").addEventListener("change", again);
  byId("size").addEventListener("input", repaint);
  byId("fit").addEventListener("click", fit);
  byId("picture").addEventListener("click", picture);
  byId("slider").addEventListener("input", () => seek(axis[Number(byId("slider").value)]));
  byId("play").addEventListener("click", play);
  byId("before").addEventListener("click", () => move(-1));
  byId("after").addEventListener("click", () => move(1));
  byId("live").addEventListener("click", goLive);
}
