// Probes as curves over time, with the references that the scene cites.

import { byId, color, h, number, say } from "./ui.js";

const { Chart } = window;
const DECIMATE = 800; // points of a curve that are drawn at most

// A line at the time that the view shows.
const cursor = {
  id: "cursor",
  afterDatasetsDraw(chart) {
    const t = chart.options.cursorTime;
    if (!Number.isFinite(t)) return;
    const x = chart.scales.x.getPixelForValue(t);
    const { top, bottom, left, right } = chart.chartArea;
    if (x < left - 1 || x > right + 1) return;
    const ctx = chart.ctx;
    ctx.save();
    ctx.strokeStyle = color("muted");
    ctx.setLineDash([3, 3]);
    ctx.beginPath();
    ctx.moveTo(x, top);
    ctx.lineTo(x, bottom);
    ctx.stroke();
    ctx.restore();
  },
};
// The tolerance of each reference, as a bar through its point.
const bars = {
  id: "bars",
  beforeDatasetsDraw(chart) {
    const { y } = chart.scales;
    const ctx = chart.ctx;
    const { left, top, width, height } = chart.chartArea;
    for (const [k, set] of chart.data.datasets.entries()) {
      if (!set.isReference) continue;
      const points = chart.getDatasetMeta(k).data;
      ctx.save();
      ctx.beginPath();
      ctx.rect(left - 6, top, width + 12, height);
      ctx.clip();
      ctx.strokeStyle = set.borderColor;
      ctx.lineWidth = 1.5;
      for (const [p, point] of points.entries()) {
        const { y: value, bar } = set.data[p];
        const [a, b] = [y.getPixelForValue(value - bar), y.getPixelForValue(value + bar)];
        ctx.beginPath();
        ctx.moveTo(point.x, a);
        ctx.lineTo(point.x, b);
        for (const end of [a, b]) {
          ctx.moveTo(point.x - 4, end);
          ctx.lineTo(point.x + 4, end);
        }
        ctx.stroke();
      }
      ctx.restore();
    }
  },
};

const DASHES = [[], [6, 3], [2, 2], [8, 3, 2, 3], [1, 3]];

// As many as it takes to tell the marks of an axis from each other.
function digits(marks) {
  const size = Math.max(...marks.map((m) => Math.abs(m.value)));
  const step = Math.abs(marks[1]?.value - marks[0]?.value);
  return step > 0 && size > 0 ? Math.min(8, Math.max(2, Math.ceil(Math.log10(size / step)) + 1)) : 3;
}

function points(samples, values) {
  const out = [];
  for (let k = 0; k < samples.time.length; k++)
    if (values[k] !== null && values[k] !== undefined) out.push({ x: samples.time[k], y: values[k] });
  return out;
}

export class Curves {
  constructor(place, onTime) {
    this.place = place;
    this.onTime = onTime;
    this.charts = new Map(); // by probe
    this.time = NaN;
  }

  clear() {
    for (const { chart, box } of this.charts.values()) {
      chart.destroy();
      box.remove();
    }
    this.charts.clear();
  }

  create(name) {
    const canvas = h("canvas", { role: "img" });
    const value = h("span", { class: "value" });
    const log = h("button", { class: "log", "aria-pressed": "false", "aria-label": `${name}: logarithmic scale`, title: "Logarithmic scale (of what is above 0)" }, "log");
    log.addEventListener("click", () => {
      const on = log.getAttribute("aria-pressed") === "false";
      log.setAttribute("aria-pressed", String(on));
      chart.options.scales.y.type = on ? "logarithmic" : "linear";
      chart.update("none");
    });
    const box = h("figure", { class: "curve" }, h("figcaption", {}, h("span", { class: "name" }, name), value, log), h("div", { class: "plot" }, canvas));
    this.place.append(box);
    const chart = new Chart(canvas, {
      type: "line",
      data: { datasets: [] },
      plugins: [cursor, bars],
      options: {
        animation: false,
        responsive: true,
        maintainAspectRatio: false,
        parsing: false,
        normalized: true,
        interaction: { mode: "nearest", axis: "x", intersect: false },
        onClick: (event) => {
          const t = chart.scales.x.getValueForPixel(event.x);
          if (Number.isFinite(t)) this.onTime(t);
        },
        elements: { point: { radius: 0, hitRadius: 6 }, line: { borderWidth: 1.6 } },
        layout: { padding: { right: 6, top: 4 } },
        plugins: {
          legend: { display: false, align: "start", labels: { boxWidth: 20, boxHeight: 0, padding: 6, font: { size: 10 }, filter: (item, { datasets }) => datasets[item.datasetIndex].part !== undefined } },
          decimation: { enabled: true, algorithm: "lttb", samples: DECIMATE },
          tooltip: { callbacks: { title: (items) => `t = ${number(items[0]?.parsed.x)} s`, label: (item) => `${item.dataset.label}: ${number(item.parsed.y, 5)}` } },
        },
        scales: {
          x: { type: "linear", ticks: { maxTicksLimit: 6, maxRotation: 0, font: { size: 10 } } },
          y: { ticks: { maxTicksLimit: 4, font: { size: 10 }, callback: (v, k, all) => number(v, digits(all)) }, afterFit: (axis) => { axis.width = 52; } },
        },
      },
    });
    const entry = { chart, box, canvas, value };
    this.charts.set(name, entry);
    return entry;
  }

  // `sets`: [{data: RunData, run, label}], the first of which gives the references.
  update(sets) {
    const names = [];
    for (const { data } of sets) for (const name of data.samples.columns.keys()) if (!names.includes(name)) names.push(name);
    for (const [name, { chart, box }] of this.charts)
      if (!names.includes(name)) {
        chart.destroy();
        box.remove();
        this.charts.delete(name);
      }
    const inks = [color("curve-a"), color("curve-b")];
    const [grid, text] = [color("line"), color("muted")];
    let end = -Infinity;
    for (const { run } of sets) if (Number.isFinite(run.end_time)) end = Math.max(end, run.end_time);
    const key = byId("curve-key");
    key.hidden = sets.length < 2 && (sets[0].run.accuracy ?? []).length === 0;
    key.replaceChildren(
      ...(sets.length > 1 ? sets.map(({ label }, k) => h("li", { class: k === 0 ? "a" : "b" }, label)) : []),
      (sets[0].run.accuracy ?? []).length > 0 ? h("li", { class: "reference" }, "reference and its tolerance") : "",
    );
    for (const name of names) {
      const entry = this.charts.get(name) ?? this.create(name);
      const { chart } = entry;
      const datasets = [];
      const latest = [];
      for (const [k, { data, label }] of sets.entries()) {
        let part = 0;
        for (const [component, values] of data.samples.columns.get(name) ?? []) {
          const line = points(data.samples, values);
          // The legend names the parts once; which colour is which run stands above all curves.
          const title = component || (sets.length > 1 ? label : name);
          datasets.push({ label: title, part: component && k === 0 ? part : undefined, data: line, borderColor: inks[k], backgroundColor: inks[k], borderDash: DASHES[part % DASHES.length] });
          if (line.length > 0) latest.push(`${component ? `${component} ` : ""}${number(line.at(-1).y)}`);
          part++;
        }
      }
      const references = (sets[0].run.accuracy ?? []).filter((r) => r.probe === name);
      if (references.length > 0)
        datasets.push({
          label: "reference",
          isReference: true,
          type: "line",
          showLine: false,
          data: references
            .map((r) => ({ x: r.at === "end" ? sets[0].run.end_time : r.at, y: r.reference, bar: r.tolerance * (r.reference !== 0 ? Math.abs(r.reference) : 1) }))
            .sort((a, b) => a.x - b.x),
          borderColor: color("reference"),
          backgroundColor: color("reference"),
          pointStyle: "rectRot",
          pointRadius: 4,
        });
      chart.data.datasets = datasets;
      const { x, y } = chart.options.scales;
      for (const axis of [x, y]) {
        axis.grid = { color: grid, drawTicks: false };
        axis.ticks.color = text;
      }
      const first = Math.min(...sets.map(({ data }) => data.samples.time[0] ?? 0));
      x.min = Number.isFinite(first) ? first : undefined;
      x.max = Number.isFinite(end) ? end : undefined;
      chart.options.plugins.legend.display = datasets.some((d) => d.part !== undefined);
      chart.options.plugins.legend.labels.color = text;
      chart.options.cursorTime = this.time;
      chart.update("none");
      say(entry.value, latest.slice(0, 3).join("  "));
      entry.canvas.setAttribute("aria-label", `${name} over time; latest ${latest.join(", ") || "none"}${references.length > 0 ? `; ${references.length} references` : ""}`);
    }
  }

  at(time) {
    if (time === this.time) return;
    this.time = time;
    for (const { chart } of this.charts.values()) {
      chart.options.cursorTime = time;
      chart.draw();
    }
  }
}
