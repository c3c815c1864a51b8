// What the page knows of a run: its scene and configuration, the index of its frames, its probes.
// Asked for once, then only what is new.

import { Problem, ask, get } from "./api.js";
import { parse } from "./frame.js";

const CACHE_BYTES = 300e6;
const cache = new Map(); // of frames, oldest use first
let cached = 0;

function keep(key, frame, size) {
  cache.set(key, { frame, size });
  cached += size;
  for (const [old, { size: n }] of cache) {
    if (cached <= CACHE_BYTES || old === key) break;
    cache.delete(old);
    cached -= n;
  }
}

export const path = (id, rest = "") => `/v1/runs/${encodeURIComponent(id)}${rest}`;

export function thinning(most, field) {
  const fields = [...new Set(["position", field])].join(",");
  return `?fields=${fields}${most > 0 ? `&max_particles=${most}` : ""}`;
}

export class RunData {
  // `updated` is called whenever something new is there.
  constructor(run, updated) {
    this.updated = updated;
    this.id = run.id;
    this.created = run.created;
    this.frames = [];
    this.samples = { step: [], time: [], columns: new Map() };
    this.scene = null;
    this.config = null;
    this.revision = -1;
    this.changes = []; // of the configuration, all
    this.busy = null;
    this.next = null;
    this.stale = false;
  }

  // After the daemon was away: what it knew may be another.
  forget() {
    this.frames = [];
    this.samples = { step: [], time: [], columns: new Map() };
    this.revision = -1;
    this.changes = []; // of the configuration, all
    this.stale = true;
  }

  // Brings it up to `run`; calls that come meanwhile are one more round.
  sync(run) {
    this.next = run;
    this.busy ??= this.rounds().finally(() => {
      this.busy = null;
    });
    return this.busy;
  }

  async rounds() {
    while (this.next !== null) {
      const run = this.next;
      this.next = null;
      this.stale = false;
      try {
        await Promise.all([this.syncScene(run), this.syncFrames(run), this.syncSamples(run)]);
      } catch (error) {
        if (error instanceof Problem && error.status === 404) return; // deleted meanwhile
        throw error;
      }
      if (this.stale) this.next ??= run;
      this.updated(); // each round: where news come faster than answers there is no last one
    }
  }

  async syncScene(run) {
    if (run.revision === this.revision) return;
    const list = this.changes;
    const [scene, config, { changes }] = await Promise.all([
      get(path(this.id, "/scene")),
      get(path(this.id, "/config")),
      get(path(this.id, `/changes?since_revision=${list.at(-1)?.revision ?? 0}`)),
    ]);
    if (list !== this.changes) return;
    this.scene = scene;
    this.config = config;
    this.changes = [...list, ...changes];
    this.revision = run.revision;
  }

  async syncFrames(run) {
    const have = this.frames.at(-1)?.seq ?? -1;
    if (run.journal === null || run.journal.frames <= have + 1) return;
    const list = this.frames;
    const { first, frames } = await get(path(this.id, `/frames${have >= 0 ? `?since_seq=${have}` : ""}`));
    if (list !== this.frames) return;
    this.frames = [...list.filter((f) => f.seq >= first), ...frames];
  }

  async syncSamples(run) {
    const samples = this.samples;
    const last = samples.step.at(-1);
    if (last !== undefined && last >= run.step) return;
    const fresh = await get(path(this.id, `/probes${last === undefined ? "" : `?since_step=${last}`}`));
    if (samples !== this.samples) return;
    const n = samples.step.length;
    samples.step.push(...fresh.step);
    samples.time.push(...fresh.time);
    for (const [name, column] of Object.entries(fresh.probes)) {
      const parts = Array.isArray(column) ? [["", column]] : Object.entries(column);
      if (!samples.columns.has(name)) samples.columns.set(name, new Map());
      const probe = samples.columns.get(name);
      for (const [part, values] of parts) {
        if (!probe.has(part)) probe.set(part, new Array(n).fill(null));
        probe.get(part).push(...values);
      }
    }
  }

  // The index of the last frame at or before a time; -1 when there is none.
  indexAt(time) {
    let [low, high] = [0, this.frames.length];
    const slack = 1e-9 * Math.abs(time) + 1e-12;
    while (low < high) {
      const mid = (low + high) >> 1;
      if (this.frames[mid].time <= time + slack) low = mid + 1;
      else high = mid;
    }
    return low - 1;
  }

  key(seq, most, field) {
    return `${this.id} ${this.created} ${seq} ${most} ${field}`;
  }

  keep(buffer, most, field) {
    const frame = parse(buffer);
    keep(this.key(frame.header.seq, most, field), frame, buffer.byteLength);
    return frame;
  }

  async frame(seq, most, field, signal) {
    const key = this.key(seq, most, field);
    const hit = cache.get(key);
    if (hit !== undefined) {
      cache.delete(key); // to the end: used last
      cache.set(key, hit);
      return hit.frame;
    }
    const response = await ask("GET", path(this.id, `/frames/${seq}${thinning(most, field)}`), { signal });
    return this.keep(await response.arrayBuffer(), most, field);
  }
}
