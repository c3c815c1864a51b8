// The dialog that creates a run: a built-in scene or a file, a few overrides; faults stand at the field
// that they are about, as the daemon words them.

import { Problem, ask, get } from "./api.js";
import { byId, bytes, count, h, number, options, toast } from "./ui.js";

const VALIDATE_AFTER_MS = 250;
const BASES = ["linear", "gimp", "bspline2", "bspline3"];
const FBAR = { off: false, zhao: true, anchored: { scheme: "anchored" } };

let scenes = null;
let file = null; // {name, text} that was dropped or chosen

// What a field is called and which pointer of the request is its.
const FIELDS = [
  { key: "basis", label: "Basis", pointer: "/scene/basis", choices: ["", ...BASES] },
  { key: "fbar", label: "F̄ scheme", pointer: "/scene/fbar", choices: ["", ...Object.keys(FBAR)] },
  { key: "cell", label: "Cell size, m", pointer: "/scene/cell", hint: "the resolution" },
  { key: "end", label: "End, s", pointer: "/scene/time/end" },
  { key: "dt", label: "Time increment, s", pointer: "/scene/time", hint: "or “cfl” for automatic increments" },
  { key: "interval", label: "Frame interval, s", pointer: "/scene/output/interval" },
  { key: "id", label: "Name of the run", pointer: "/id", hint: "made up when empty" },
];

function typed(text) {
  const value = Number(text);
  return text.trim() !== "" && Number.isFinite(value) ? value : text;
}

function overrides(form) {
  const out = {};
  const of = (key) => form.elements[key].value.trim();
  if (of("basis")) out.basis = of("basis");
  if (of("fbar")) out.fbar = FBAR[of("fbar")];
  if (of("cell")) out.cell = typed(of("cell"));
  const time = {};
  if (of("end")) time.end = typed(of("end"));
  if (of("dt") === "cfl") Object.assign(time, { dt: null, cfl: 0.3 });
  else if (of("dt")) Object.assign(time, { dt: typed(of("dt")), cfl: null });
  if (Object.keys(time).length > 0) out.time = time;
  if (of("interval")) out.output = { interval: typed(of("interval")) };
  return out;
}

// The request as text. A file goes in as it is, so that the daemon sees what is wrong with it.
function request(form, creates) {
  const rest = {};
  const patch = overrides(form);
  if (Object.keys(patch).length > 0) rest.overrides = patch;
  if (creates) {
    const id = form.elements.id.value.trim();
    if (id) rest.id = id;
    if (!form.elements.start.checked) rest.start = false;
  }
  const scene = form.elements.scene.value;
  const more = JSON.stringify(rest).slice(1, -1);
  return `{"scene":${scene === "file" ? (file?.text.trim() || "null") : JSON.stringify(scene)}${more ? `,${more}` : ""}}`;
}

function showFaults(form, errors, detail) {
  const places = [...form.querySelectorAll("[data-pointer]")].sort((a, b) => b.dataset.pointer.length - a.dataset.pointer.length);
  const list = form.querySelector(".faults");
  for (const place of places) {
    place.querySelector(".fault").replaceChildren();
    place.querySelector("input, select").removeAttribute("aria-invalid");
  }
  list.replaceChildren();
  for (const error of errors) {
    const place = places.find((p) => error.pointer === p.dataset.pointer || error.pointer.startsWith(`${p.dataset.pointer}/`));
    if (place !== undefined) {
      place.querySelector(".fault").append(h("span", {}, error.detail));
      place.querySelector("input, select").setAttribute("aria-invalid", "true");
    } else {
      list.append(h("li", {}, h("code", {}, error.pointer || "/"), " ", error.detail));
    }
  }
  if (errors.length === 0 && detail) list.append(h("li", {}, detail));
  list.hidden = list.children.length === 0;
}

export async function readFile(chosen) {
  file = { name: chosen.name, text: await chosen.text() };
  return openCreate({ scene: "file" });
}

// `made(run)` is called when a run was created.
let made = () => {};
export function onMade(call) {
  made = call;
}

export async function openCreate({ scene = null } = {}) {
  const box = byId("create");
  if (scenes === null) {
    try {
      scenes = (await get("/v1/scenes")).scenes;
    } catch (error) {
      toast(error instanceof Problem ? error.message : "fbard does not answer: no run can be created now", true);
      return;
    }
  }
  if (box.open) box.close();
  const estimate = h("p", { class: "estimate", role: "status" });
  const chooser = h("input", { type: "file", accept: ".json,application/json", "aria-label": "Scene file" });
  const create = h("button", { class: "primary", value: "yes" }, "Create");
  const rows = FIELDS.map(({ key, label, pointer, choices, hint }) => {
    const id = `create-${key}`;
    const input = choices
      ? h("select", { id, name: key, "aria-describedby": `${id}-fault` }, choices.map((c) => h("option", { value: c }, c || "as in the scene")))
      : h("input", { id, name: key, autocomplete: "off", spellcheck: "false", "aria-describedby": `${id}-fault` });
    return h("div", { class: "field", "data-pointer": pointer }, h("label", { for: id }, label, hint ? h("small", {}, hint) : null), input, h("p", { class: "fault", id: `${id}-fault` }));
  });
  const form = h(
    "form",
    { novalidate: true },
    h("h2", { id: "create-title" }, "New run"),
    h(
      "div",
      { class: "field wide", "data-pointer": "/scene-name" },
      h("label", { for: "create-scene" }, "Scene"),
      h("select", { id: "create-scene", name: "scene" }),
      h("p", { class: "fault" }),
    ),
    h("p", { class: "about muted" }),
    h("div", { class: "file" }, chooser, h("span", { class: "file-name muted" })),
    h("ul", { class: "faults", role: "alert", hidden: true }),
    h("div", { class: "fields" }, rows),
    h("label", { class: "check" }, h("input", { type: "checkbox", name: "start", checked: true }), " start at once"),
    estimate,
    h("div", { class: "actions" }, h("button", { type: "button", class: "close" }, "Close"), create),
  );
  box.replaceChildren(form);
  options(form.elements.scene, [...scenes.map((s) => [s.name, `${s.name}${s.dimension ? ` · ${s.dimension}D` : ""}`]), ["file", file ? `file: ${file.name}` : "a file …"]], scene ?? scenes.find((s) => s.name === "dam-break")?.name ?? scenes[0]?.name);
  form.querySelector(".close").addEventListener("click", () => box.close());

  let round = 0;
  let timer = 0;
  const validate = async () => {
    const mine = ++round;
    try {
      const answer = await (await ask("POST", "/v1/scenes:validate", { text: request(form, false) })).json();
      if (mine !== round) return;
      const e = answer.estimate;
      showFaults(form, [], "");
      estimate.replaceChildren(
        `${count(e.particles)} particles, ${count(e.steps)} steps of ${number(e.dt, 3)} s, ${bytes(e.bytes)}`,
        ...answer.warnings.map((w) => h("span", { class: "warning" }, w)),
      );
    } catch (error) {
      if (mine !== round) return;
      estimate.replaceChildren();
      if (error instanceof Problem) showFaults(form, error.errors, error.message);
      else showFaults(form, [], "fbard does not answer");
    }
  };
  const later = () => {
    clearTimeout(timer);
    timer = setTimeout(validate, VALIDATE_AFTER_MS);
  };
  const choose = async () => {
    const name = form.elements.scene.value;
    const isFile = name === "file";
    form.querySelector(".file").hidden = !isFile;
    form.querySelector(".file-name").textContent = file ? file.name : "choose it, or drop it on the page";
    let json = null;
    try {
      json = isFile ? (file ? JSON.parse(file.text) : null) : await get(`/v1/scenes/${name}`);
    } catch {
      json = null; // the daemon says what is wrong with it
    }
    if (form.elements.scene.value !== name) return;
    form.querySelector(".about").textContent = json?.title ?? "";
    const shown = { cell: json?.cell, end: json?.time?.end, dt: json?.time?.dt ?? `cfl ${json?.time?.cfl ?? 0.3}`, interval: json?.output?.interval };
    for (const [key, value] of Object.entries(shown)) form.elements[key].placeholder = json && value !== undefined ? String(value) : "";
    const scheme = json?.fbar === true ? "zhao" : (json?.fbar?.scheme ?? "off");
    form.elements.basis.options[0].textContent = json ? `as in the scene: ${json.basis ?? "gimp"}` : "as in the scene";
    form.elements.fbar.options[0].textContent = json ? `as in the scene: ${scheme}` : "as in the scene";
    if (!isFile || file) later();
  };
  chooser.addEventListener("change", async () => {
    if (chooser.files.length === 0) return;
    file = { name: chooser.files[0].name, text: await chooser.files[0].text() };
    choose();
  });
  form.elements.scene.addEventListener("change", choose);
  form.addEventListener("input", (event) => {
    if (event.target !== form.elements.scene && event.target !== chooser && event.target.name !== "id") later();
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    clearTimeout(timer);
    round++;
    create.disabled = true;
    try {
      const run = await (await ask("POST", "/v1/runs", { text: request(form, true) })).json();
      box.close();
      made(run);
    } catch (error) {
      if (error instanceof Problem) showFaults(form, error.errors, error.message);
      else showFaults(form, [], "fbard does not answer");
      form.querySelector("[aria-invalid]")?.focus();
    } finally {
      create.disabled = false;
    }
  });
  await choose();
  box.showModal();
  form.elements.scene.focus();
}

