// The page: which runs there are, which one is looked at, and what the user does with it.

import { Problem, ask, listen, onToken } from "./api.js";
import { onMade, openCreate, readFile } from "./create.js";
import { Curves } from "./curves.js";
import { RunData, path } from "./data.js";
import * as stage from "./stage.js";
import { byId, bytes, count, dialog, duration, h, number, options, rate, save, say, toast } from "./ui.js";

const SILENCE_MS = 25000; // the daemon sends something every 10 s
const RETRY_MS = [250, 500, 1000, 2000, 3000];

const runs = new Map(); // by id, oldest first
const datas = new Map();
let selected = null;
let other = null; // that is compared with
let connected = false;
let line = null; // the stream of events that is open
let tries = 0;
let heardAt = null;

const FINAL = new Set(["completed", "failed", "cancelled"]);
const MOVING = new Set(["queued", "running", "waiting"]);

const curves = new Curves(byId("curves"), (t) => stage.seek(t));

// ---- The daemon -------------------------------------------------------------------------------

function connection(state, text) {
  const place = byId("connection");
  place.dataset.state = state;
  say(place, text);
}

function away() {
  connected = false;
  const banner = byId("banner");
  document.body.classList.add("away");
  connection("away", "not connected");
  banner.hidden = false;
  say(banner, `fbard does not answer${heardAt ? `; last heard at ${heardAt.toLocaleTimeString()}` : ""}. What you see is from then. Trying again by itself.`);
  drawHead(); // nothing can be asked for now
}

function back() {
  connected = true;
  tries = 0;
  document.body.classList.remove("away");
  byId("banner").hidden = true;
  connection("live", "connected");
  service();
}

let serviceKnown = false;
async function service() {
  if (serviceKnown) return;
  serviceKnown = true;
  try {
    const s = await (await ask("GET", "/v1")).json();
    say(byId("service"), `${s.version} · ${s.threads} ${s.threads === 1 ? "thread" : "threads"} · ${s.instruction_set} · ${s.slots} ${s.slots === 1 ? "slot" : "slots"}`);
  } catch {
    serviceKnown = false;
  }
}

// One stream tells of all runs. While the page is hidden there is none.
async function connect() {
  if (line !== null || document.hidden) return;
  const abort = new AbortController();
  const mine = { abort };
  line = mine;
  let silence = 0;
  const beat = () => {
    clearTimeout(silence);
    heardAt = new Date();
    silence = setTimeout(() => abort.abort(), SILENCE_MS);
  };
  const there = new Set();
  let ready = false;
  try {
    beat();
    await listen("/v1/events", {
      signal: abort.signal,
      beat,
      opened: () => {
        for (const data of datas.values()) data.forget();
        serviceKnown = false;
      },
      tell: (kind, data) => {
        if (kind === "run") {
          if (!ready) there.add(data.id);
          heard(data);
        } else if (kind === "gone") {
          gone(data.id);
        } else if (kind === "ready") {
          ready = true;
          back();
          for (const id of [...runs.keys()]) if (!there.has(id)) gone(id);
          if (selected === null) choose();
          draw();
        }
      },
    });
  } catch {
    // nobody there, or cut off
  } finally {
    clearTimeout(silence);
  }
  if (line !== mine) return;
  line = null;
  if (document.hidden) return;
  stage.stopFollowing();
  away();
  setTimeout(connect, RETRY_MS[Math.min(tries++, RETRY_MS.length - 1)]);
}

function disconnect() {
  line?.abort.abort();
  line = null;
  stage.stopFollowing();
}

document.addEventListener("visibilitychange", () => {
  if (document.hidden) {
    disconnect();
  } else {
    connect();
    if (selected !== null) stage.refresh();
  }
});

onToken(async (refused) => {
  const answer = await dialog(byId("ask"), [
    h("h2", { id: "ask-title" }, "Token"),
    h("p", {}, refused ? "That token was not accepted. " : "", "This fbard asks for a token: the text of the file that it was given as --token-file. It is kept until this tab is closed."),
    h("label", { class: "field" }, "Token", h("input", { name: "token", type: "password", autocomplete: "off", required: true })),
    h("div", { class: "actions" }, h("button", { class: "primary", value: "yes" }, "Go on")),
  ]);
  return answer?.get("token").trim() ?? "";
});

// ---- Runs -------------------------------------------------------------------------------------

function heard(run) {
  const before = runs.get(run.id);
  runs.set(run.id, run);
  let data = datas.get(run.id);
  if (data !== undefined && data.created !== run.created) {
    datas.delete(run.id);
    data = undefined;
  }
  drawItem(run, before);
  if (before === undefined) drawList();
  if (run.id === selected || run.id === other) bring(run);
}

function gone(id) {
  runs.delete(id);
  datas.delete(id);
  byId(`run-${id}`)?.remove();
  if (other === id) select(selected, null);
  if (selected === id) {
    selected = null;
    choose();
  }
  drawList();
  drawHead();
}

// Fetches what is new of a run that is shown, then shows it.
async function bring(run) {
  if (run.id === selected) drawHead();
  let data = datas.get(run.id);
  if (data === undefined) {
    data = new RunData(run, draw);
    datas.set(run.id, data);
  }
  try {
    await data.sync(run);
  } catch {
    // the daemon is away: its return brings all again
  }
}

const shown = () =>
  [selected, other]
    .filter((id) => id !== null && runs.has(id) && datas.get(id)?.config)
    .map((id) => ({ run: runs.get(id), data: datas.get(id), label: id }));

function draw() {
  drawHead();
  const sets = shown();
  if (sets.length === 0 || sets[0].run.id !== selected) return;
  stage.show(sets);
  curves.update(sets);
  drawAccuracy(sets);
  drawDetails(sets[0].run);
}

function select(id, along = null) {
  const changed = id !== selected;
  selected = id;
  other = along !== id ? along : null;
  const parts = [];
  if (selected !== null) parts.push(`run=${encodeURIComponent(selected)}`);
  if (other !== null) parts.push(`with=${encodeURIComponent(other)}`);
  history.replaceState(null, "", parts.length > 0 ? `#${parts.join("&")}` : location.pathname);
  if (changed) curves.clear();
  for (const item of byId("runs").children) item.firstChild.setAttribute("aria-current", String(item.dataset.id === selected));
  for (const key of [selected, other]) if (key !== null && runs.has(key)) bring(runs.get(key));
  draw();
}

// What to look at when nothing is chosen: what the address names, or the newest run.
function choose() {
  const wished = new URLSearchParams(location.hash.slice(1));
  const id = wished.get("run");
  if (id !== null && runs.has(id)) {
    select(id, runs.has(wished.get("with")) ? wished.get("with") : null);
    return;
  }
  const newest = [...runs.values()].at(-1);
  select(newest?.id ?? null);
}

// ---- The list ---------------------------------------------------------------------------------

function drawList() {
  const empty = runs.size === 0;
  byId("runs-empty").hidden = !empty;
  say(byId("runs-count"), empty ? "" : String(runs.size));
  byId("welcome").hidden = selected !== null && !empty;
  byId("main").hidden = selected === null || empty;
}

const STATE_WORDS = { queued: "queued", running: "running", waiting: "waiting", paused: "paused", completed: "completed", failed: "failed", cancelled: "cancelled" };

function drawItem(run) {
  let item = byId(`run-${run.id}`);
  if (item === null) {
    const button = h("button", { class: "run", onclick: () => select(run.id) },
      h("span", { class: "run-name" }), h("span", { class: "state" }), h("span", { class: "run-more" }), h("span", { class: "run-more" }), h("span", { class: "progress" }, h("i")));
    item = h("li", { id: `run-${run.id}`, "data-id": run.id }, button);
    byId("runs").prepend(item);
  }
  const button = item.firstChild;
  const [name, state, more, speed, bar] = button.children;
  button.setAttribute("aria-current", String(run.id === selected));
  say(name, run.id);
  name.title = run.id;
  say(state, STATE_WORDS[run.state]);
  state.dataset.state = run.state;
  const parts = [`F̄ ${run.fbar_scheme}`];
  if (run.state === "running") {
    parts.push(`${Math.floor(100 * run.progress)} %`);
    if (run.eta_s !== null) parts.push(`${duration(run.eta_s)} left`);
  } else if (!FINAL.has(run.state)) {
    parts.push(`${Math.floor(100 * run.progress)} %`);
  }
  say(speed, run.performance.particle_steps_per_s > 0 ? `${rate(run.performance.particle_steps_per_s)} particle-steps/s` : "no steps yet");
  say(more, parts.join(" · "));
  bar.firstChild.style.width = `${100 * run.progress}%`;
  bar.dataset.state = run.state;
}

// ---- The selected run -------------------------------------------------------------------------

function facts(list, place) {
  if (place.children.length !== list.length) place.replaceChildren(...list.map(() => h("div", {}, h("dt"), h("dd"))));
  for (const [k, [key, value]] of list.entries()) {
    say(place.children[k].firstChild, key);
    say(place.children[k].lastChild, value);
  }
}

function drawHead() {
  drawList();
  const run = runs.get(selected);
  if (run === undefined) return;
  document.title = `${run.id} · ${run.state} · fbard`;
  say(byId("run-title"), run.id);
  say(byId("run-scene"), run.scene);
  const state = byId("run-state");
  say(state, STATE_WORDS[run.state]);
  state.dataset.state = run.state;
  const bar = byId("run-progress");
  bar.firstChild.style.width = `${100 * run.progress}%`;
  bar.dataset.state = run.state;
  bar.setAttribute("aria-valuenow", String(Math.round(100 * run.progress)));
  facts(
    [
      ["step", count(run.step)],
      ["time", `${number(run.time, 5)} of ${number(run.end_time, 4)} s`],
      ["Δt", `${number(run.dt, 3)} s`],
      ["done", `${(100 * run.progress).toFixed(1)} %`],
      ["left", run.state === "running" ? duration(run.eta_s) : "–"],
      ["speed", run.performance.particle_steps_per_s > 0 ? `${rate(run.performance.particle_steps_per_s)} particle-steps/s` : "–"],
      ["particles", count(run.particles)],
    ],
    byId("run-facts"),
  );
  const over = FINAL.has(run.state);
  const go = byId("go");
  say(go, MOVING.has(run.state) ? "Pause" : run.step === 0 && run.state === "paused" ? "Start" : "Resume");
  go.disabled = over || !connected;
  go.classList.toggle("primary", run.state === "paused");
  for (const id of ["step", "steps"]) byId(id).disabled = run.state !== "paused" || !connected;
  byId("cancel").disabled = over || !connected;
  byId("delete").disabled = !over || !connected;
  byId("twin").disabled = !connected;
  const fbar = byId("fbar");
  fbar.disabled = over || !connected;
  for (const radio of fbar.querySelectorAll("input")) radio.checked = radio.value === run.fbar_scheme;
  const error = byId("run-error");
  error.hidden = run.error === null;
  if (run.error !== null)
    say(error, `Failed at step ${count(run.error.step)}, t = ${number(run.error.time)} s: ${run.error.detail || run.error.kind}${run.error.particle >= 0 ? ` (particle ${run.error.particle}, ${run.error.quantity} = ${number(run.error.value)})` : ""}. ${run.error.advice ? `Advice: ${run.error.advice}` : ""}`);
  const warnings = byId("run-warnings");
  const text = run.warnings.join("\n");
  if (warnings.dataset.text !== text) {
    warnings.dataset.text = text;
    warnings.replaceChildren(...run.warnings.map((w) => h("li", {}, w)));
  }
  options(byId("compare"), [["", "nothing"], ...[...runs.keys()].filter((id) => id !== selected).reverse().map((id) => [id, id])], other ?? "");
  say(byId("twin"), run.fbar ? "Run twin without F̄" : "Run twin with F̄");
}

function drawAccuracy(sets) {
  const place = byId("accuracy");
  const lists = sets.map(({ run }) => run.accuracy ?? []);
  const key = JSON.stringify(lists.map((l) => l.map((r) => [r.value, r.reference])));
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  if (lists[0].length === 0) {
    place.replaceChildren();
    return;
  }
  const cell = (r) => (r === undefined || r.value === null ? "–" : `${(100 * r.relative_error).toFixed(2)} %`);
  const mark = (r) => (r === undefined || r.value === null ? "" : r.relative_error <= r.tolerance ? "good" : "off");
  place.replaceChildren(
    h("h3", {}, "Against references"),
    h("div", { class: "scroll" },
      h("table", {},
        h("thead", {}, h("tr", {}, ["probe", "at", "reference", ...sets.map(({ label }) => (sets.length > 1 ? `error, ${label}` : "error")), "within"].map((t) => h("th", { scope: "col" }, t)))),
        h("tbody", {}, lists[0].map((r, k) =>
          h("tr", { title: r.source },
            h("th", { scope: "row" }, r.component ? `${r.probe}.${r.component}` : r.probe),
            h("td", {}, r.at === "end" ? "end" : `${number(r.at, 3)} s`),
            h("td", {}, number(r.reference, 4)),
            ...lists.map((list) => h("td", { class: mark(list[k]) }, cell(list[k]))),
            h("td", {}, `${number(100 * r.tolerance, 2)} %`)))))),
  );
}

function drawDetails(run) {
  if (!byId("more").open) return;
  const p = run.performance;
  facts(
    [
      ["created", new Date(run.created).toLocaleString()],
      ["wall time", duration(p.wall_s)],
      ["nodes", count(run.nodes)],
      ["Δt limit", `${number(run.dt_limit, 3)} s`],
      ["frames", run.journal ? `${count(run.journal.frames)}, ${bytes(run.journal.bytes)}` : "–"],
      ["kinetic energy", `${number(run.balance.kinetic_energy)} J`],
      ["strain energy", `${number(run.balance.strain_energy)} J`],
      ["mass", `${number(run.balance.mass)} kg`],
      ...Object.entries(p.phases).filter(([, s]) => s > 0).map(([name, s]) => [`in ${name}`, `${(100 * s / Math.max(p.wall_s, 1e-9)).toFixed(1)} %`]),
    ],
    byId("details"),
  );
}

// ---- What the user does -----------------------------------------------------------------------

async function attempt(what, call) {
  try {
    return await call();
  } catch (error) {
    toast(`${what}: ${error instanceof Problem ? error.message : "fbard does not answer"}`, true);
    return null;
  }
}

// What came of it the events tell: an answer may be overtaken by them, and would then be out of date.
function act(verb, body) {
  return attempt(verb, () => ask("POST", path(selected, `:${verb}`), { body }));
}

function created(run) {
  if (!runs.has(run.id)) heard(run);
}

byId("go").addEventListener("click", () => act(MOVING.has(runs.get(selected)?.state) ? "pause" : "resume"));
byId("step").addEventListener("click", () => {
  const steps = Number(byId("steps").value);
  act("step", { steps: Number.isFinite(steps) ? steps : byId("steps").value });
});
byId("steps").addEventListener("keydown", (event) => {
  if (event.key === "Enter") byId("step").click();
});
byId("cancel").addEventListener("click", () => act("cancel"));
byId("delete").addEventListener("click", async () => {
  const id = selected;
  const answer = await dialog(byId("ask"), [
    h("h2", { id: "ask-title" }, "Delete this run?"),
    h("p", {}, h("b", {}, id), " and its frames, probes and checkpoints are removed from the disk for good."),
    h("div", { class: "actions" }, h("button", { value: "no" }, "Keep"), h("button", { class: "danger", value: "yes" }, "Delete")),
  ]);
  if (answer === null) return;
  const done = await attempt("delete", () => ask("DELETE", path(id)));
  if (done !== null) gone(id);
});
byId("fbar").addEventListener("change", async (event) => {
  const id = selected;
  const scheme = event.target.value;
  const fbar = { off: false, zhao: true, anchored: { scheme: "anchored" } }[scheme];
  const config = await attempt("F̄", async () => (await ask("PATCH", path(id, "/config"), { body: { fbar } })).json());
  if (config !== null) toast(`F̄ is ${scheme} from step ${count(config.effective_step)} on`);
  drawHead();
});
byId("compare").addEventListener("change", () => select(selected, byId("compare").value || null));
byId("twin").addEventListener("click", async () => {
  const run = runs.get(selected);
  const twin = await attempt("twin", async () => {
    const scene = await (await ask("GET", path(run.id, "/scene"))).json();
    const stem = run.id.slice(0, 48);
    const id = `${stem}-${run.fbar ? "no-fbar" : "fbar"}`;
    const body = { scene, overrides: { fbar: !run.fbar } };
    if (!runs.has(id)) body.id = id;
    return (await ask("POST", "/v1/runs", { body })).json();
  });
  if (twin === null) return;
  created(twin);
  select(run.id, twin.id);
});
byId("csv").addEventListener("click", async () => {
  for (const { run } of shown()) {
    const text = await attempt("CSV", async () => (await ask("GET", path(run.id, "/probes"), { headers: { Accept: "text/csv" } })).text());
    if (text !== null) save(new Blob([text], { type: "text/csv" }), `${run.id}-probes.csv`);
  }
});
byId("more").addEventListener("toggle", () => runs.has(selected) && drawDetails(runs.get(selected)));

onMade((run) => {
  created(run);
  select(run.id);
});
byId("new").addEventListener("click", () => openCreate());
document.addEventListener("click", (event) => {
  const wish = event.target.dataset?.act;
  if (wish === "new") openCreate();
  if (wish === "example")
    attempt("dam break", async () => {
      const run = await (await ask("POST", "/v1/runs", { body: { scene: "dam-break" } })).json();
      created(run);
      select(run.id);
    });
});

// A file may be dropped anywhere.
let over = 0;
addEventListener("dragenter", (event) => {
  if (!event.dataTransfer?.types.includes("Files")) return;
  over++;
  byId("drop").hidden = false;
});
addEventListener("dragleave", () => {
  over = Math.max(0, over - 1);
  if (over === 0) byId("drop").hidden = true;
});
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  over = 0;
  byId("drop").hidden = true;
  const file = event.dataTransfer?.files[0];
  if (file !== undefined) readFile(file);
});

// ---- Keys and theme ---------------------------------------------------------------------------

const KEYS = [
  ["n", "new run"],
  ["p", "pause, or go on"],
  ["f", "F̄ off, or on again"],
  ["space", "play the frames"],
  [", .", "frame before, frame after"],
  ["l", "follow the newest frame"],
  ["0", "fit the view"],
  ["j k", "next run, run before"],
  ["arrows, + −", "in the view: pan (2D) or orbit (3D; with shift pan), zoom"],
  ["?", "this list"],
];

function showKeys() {
  const box = byId("keys");
  box.replaceChildren(
    h("form", { method: "dialog" }, h("h2", { id: "keys-title" }, "Keys"),
      h("dl", { class: "keys" }, KEYS.flatMap(([key, what]) => [h("dt", {}, h("kbd", {}, key)), h("dd", {}, what)])),
      h("p", { class: "muted" }, "Mouse: drag to pan (2D) or orbit (3D), with the right button or shift to pan, wheel to zoom, double click to fit. Touch: one finger, two fingers, pinch."),
      h("div", { class: "actions" }, h("button", { value: "no" }, "Close"))),
  );
  box.showModal();
}
byId("help").addEventListener("click", showKeys);

function neighbour(by) {
  const ids = [...byId("runs").children].map((item) => item.dataset.id);
  const next = ids[ids.indexOf(selected) + by];
  if (next !== undefined) select(next);
}

addEventListener("keydown", (event) => {
  const tag = event.target.tagName;
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]") !== null) return;
  if (["INPUT", "SELECT", "TEXTAREA"].includes(tag) && !(tag === "INPUT" && event.target.type === "range" && event.key === " ")) return;
  if (event.key === " " && ["BUTTON", "SUMMARY"].includes(tag)) return;
  const press = (id) => () => byId(id).disabled || byId(id).click();
  const keys = {
    n: () => openCreate(),
    p: press("go"),
    f: () => {
      const run = runs.get(selected);
      if (run !== undefined && !byId("fbar").disabled) byId("fbar").querySelector(`input[value="${run.fbar ? "off" : "zhao"}"]`).click();
    },
    " ": stage.play,
    ",": () => stage.move(-1),
    ".": () => stage.move(1),
    l: stage.goLive,
    0: stage.fit,
    j: () => neighbour(1),
    k: () => neighbour(-1),
    "?": showKeys,
  };
  if (keys[event.key] === undefined) return;
  if (selected === null && event.key !== "n" && event.key !== "?") return;
  event.preventDefault();
  keys[event.key]();
});

const THEMES = ["", "light", "dark"];
function applyTheme(theme) {
  if (theme) document.documentElement.dataset.theme = theme;
  else delete document.documentElement.dataset.theme;
  byId("theme").textContent = { "": "◐", light: "☀", dark: "☾" }[theme];
  byId("theme").setAttribute("aria-label", `Theme: ${theme || "as the system"}`);
  recolour();
}
function recolour() {
  stage.repaint();
  const sets = shown();
  if (sets.length > 0) curves.update(sets);
}
byId("theme").addEventListener("click", () => {
  const now = localStorage.getItem("fbard-theme") ?? "";
  const next = THEMES[(THEMES.indexOf(now) + 1) % THEMES.length];
  localStorage.setItem("fbard-theme", next);
  applyTheme(next);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => applyTheme(localStorage.getItem("fbard-theme") ?? ""));

stage.onTimeChange((t) => curves.at(t));
stage.setUp();
applyTheme(localStorage.getItem("fbard-theme") ?? "");
connect();
