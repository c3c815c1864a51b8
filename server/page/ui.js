// Elements, words and numbers.

export const byId = (id) => document.getElementById(id);

// An element: properties are attributes, but for on... (listeners); children are text or elements.
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (value === false || value === null || value === undefined) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat().filter((c) => c !== null && c !== undefined));
  return element;
}

// Changes the text only where it is another one, so that nothing is laid out for nothing.
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function options(select, list, chosen) {
  const key = JSON.stringify(list);
  if (select.dataset.list !== key) {
    select.dataset.list = key;
    select.replaceChildren(...list.map(([value, text]) => h("option", { value }, text)));
  }
  if (chosen !== undefined && select.value !== chosen) select.value = chosen;
}

// What came in a colour of the page's style, as rgb(...), for canvases.
const sampler = h("span", { hidden: true });
export function color(name) {
  if (!sampler.isConnected) document.body.append(sampler);
  sampler.style.color = `var(--${name})`;
  return getComputedStyle(sampler).color;
}

export const isDark = () => {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
};

const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"]]; // prettier-ignore
const PREFIXED = new Set(["Pa", "N", "J", "N/m", "Pa s"]);

// {factor, unit} so that `size` reads as a number between 1 and 1000.
export function scaled(size, unit) {
  if (!PREFIXED.has(unit) || !(size > 0)) return { factor: 1, unit: unit === "1" ? "" : unit.replace("^3", "³") };
  const [factor, prefix] = PREFIXES.find(([f]) => size >= f) ?? PREFIXES.at(-1);
  return { factor, unit: prefix + unit };
}

export function number(x, digits = 4) {
  if (x === null || x === undefined || !Number.isFinite(x)) return "–";
  if (x === 0) return "0";
  const size = Math.abs(x);
  if (size >= 1e5 || size < 1e-3) {
    const [m, e] = x.toExponential(Math.max(0, digits - 2)).split("e");
    return `${Number(m)}e${Number(e)}`.replace("-", "−").replace("e-", "e−");
  }
  return String(Number(x.toPrecision(digits))).replace("-", "−");
}

export function count(x) {
  if (x === null || x === undefined || !Number.isFinite(x)) return "–";
  return Math.round(x).toString().replace(/\B(?=(\d{3})+$)/g, " ");
}

export function rate(x) {
  if (!(x > 0)) return "–";
  const [factor, prefix] = PREFIXES.find(([f]) => x >= f) ?? [1, ""];
  return `${Number((x / factor).toPrecision(3))} ${prefix}`.trim();
}

export function bytes(x) {
  const [factor, prefix] = PREFIXES.find(([f]) => x >= f) ?? [1, ""];
  return `${Number((x / factor).toPrecision(3))} ${prefix}B`;
}

export function duration(s) {
  if (s === null || s === undefined || !Number.isFinite(s)) return "–";
  if (s < 10) return `${Math.max(0, s).toFixed(1)} s`;
  if (s < 100) return `${Math.round(s)} s`;
  if (s < 6000) return `${Math.floor(s / 60)} min ${Math.round(s % 60)} s`;
  return `${Math.floor(s / 3600)} h ${Math.round((s % 3600) / 60)} min`;
}

export function toast(text, bad = false) {
  const item = h("p", { class: bad ? "bad" : "" }, text);
  byId("toasts").append(item);
  setTimeout(() => item.remove(), bad ? 9000 : 4000);
}

export function save(blob, name) {
  const url = URL.createObjectURL(blob);
  const link = h("a", { href: url, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

// Asks in a dialog; resolves to the form's data, or null when it was closed.
export function dialog(element, content) {
  return new Promise((resolve) => {
    const form = h("form", { method: "dialog" }, content);
    let answer = null;
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      if (event.submitter?.value !== "no") answer = new FormData(form);
      element.close();
    });
    element.replaceChildren(form);
    element.addEventListener("close", () => resolve(answer), { once: true });
    if (!element.open) element.showModal();
  });
}
