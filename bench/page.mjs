// How the live page holds up with a million particles: how soon they are there, how many pictures a second while the
// view is turned, how long the page does not answer, what a viewer costs the daemon. `make bench-page`.
//
// Chromium draws by its software renderer here, on the cores that the daemon computes on: with a graphics processor the
// pictures cost the cores nothing. PICTURES=folder keeps a picture of each scene.

import fs from "node:fs";
import path from "node:path";

import { Daemon, launch, open, until } from "../tests/page/harness.mjs";

const SECONDS = Number(process.env.SECONDS ?? 4);
const STILL_S = 10;
const pictures = process.env.PICTURES;

// Over a million particles each; two fields a frame, as the page asks for.
const output = { fields: ["position", "mean_stress"], journal_bytes: 2e9 };
const SCENES = [
  { id: "flat", scene: "dam-break", overrides: { cell: 0.015625, bodies: { reservoir: { particles_per_cell: 36 } }, time: { dt: null, cfl: 0.3 }, references: [], output: { ...output, interval: 2e-6 } } },
  { id: "solid", scene: "landslide", overrides: { cell: 0.125, time: { dt: null, cfl: 0.3 }, references: [], output: { ...output, interval: 3e-5 } } },
];

// In the page: when particles were drawn, and when the page did not answer.
const watchful = () => {
  window.drawn = [];
  window.blocked = [];
  const { drawArrays } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) {
    drawArrays.call(this, mode, first, count);
    if (mode === this.POINTS) window.drawn.push({ at: performance.now(), count });
  };
  new PerformanceObserver((list) => window.blocked.push(...list.getEntries().map((e) => ({ at: e.startTime, ms: e.duration })))).observe({ entryTypes: ["longtask"] });
};

// Milliseconds that the daemon's threads have run, by the scheduler's account (finer than the kernel's ticks).
const threads = ({ process: { pid } }) =>
  fs.readdirSync(`/proc/${pid}/task`).reduce((sum, id) => sum + Number(fs.readFileSync(`/proc/${pid}/task/${id}/schedstat`, "utf8").split(" ")[0]) / 1e6, 0);

const median = (list) => [...list].sort((a, b) => a - b)[list.length >> 1];
const round = (x, digits = 2) => Number(x.toPrecision(digits));

// Drags the mouse over the view for SECONDS: {pictures a second; the longest time between two, and the longest task, ms;
// the least and the median number of particles drawn}.
async function turn(page) {
  const box = await page.locator("canvas.particles").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  await page.mouse.move(x, y);
  await page.mouse.down();
  const since = await page.evaluate(() => performance.now());
  const end = Date.now() + 1000 * SECONDS;
  for (let k = 0; Date.now() < end; k++) await page.mouse.move(x + 120 * Math.sin(k / 20), y + 40 * Math.cos(k / 20));
  await page.mouse.up();
  return page.evaluate((from) => {
    const drawn = window.drawn.filter((d) => d.at >= from);
    const gaps = drawn.slice(1).map((d, k) => d.at - drawn[k].at);
    return {
      fps: (1000 * gaps.length) / (drawn.at(-1).at - drawn[0].at),
      gap: Math.max(...gaps),
      task: Math.max(0, ...window.blocked.filter((b) => b.at >= from).map((b) => b.ms)),
      least: Math.min(...drawn.map((d) => d.count)),
      count: drawn.map((d) => d.count).sort((a, b) => a - b)[drawn.length >> 1],
    };
  }, since);
}

async function drawnOf(page, count, since) {
  return until(`${count} particles drawn`, () => page.evaluate(([n, t]) => window.drawn.find((d) => d.at > t && d.count === n)?.at, [count, since]));
}

async function measure(browser, daemon, { id, scene, overrides }) {
  await daemon.ask("POST", "/v1/runs", { scene, id, overrides, start: false });
  await daemon.ask("POST", `/v1/runs/${id}:step`, { steps: 3 });
  await until("a few frames", async () => (await daemon.get(`/v1/runs/${id}`)).state === "paused");
  const { particles } = await daemon.get(`/v1/runs/${id}`);
  const { frames } = await daemon.get(`/v1/runs/${id}/frames`);
  console.log(`\n${scene}, ${particles.toLocaleString("en")} particles, ${round(frames[0].bytes / 1e6)} MB a frame`);

  // What a frame costs the daemon, cut to size and whole.
  for (const most of [200000, 1000000, particles]) {
    const times = [];
    const cpu = daemon.cpu();
    let size = 0;
    for (let k = 0; k < 5; k++) {
      const began = performance.now();
      const answer = await daemon.ask("GET", `/v1/runs/${id}/frames/latest?fields=position,mean_stress&max_particles=${most}`);
      size = (await answer.arrayBuffer()).byteLength;
      times.push(performance.now() - began);
    }
    console.log(`  a frame cut to ${most.toLocaleString("en").padStart(9)}: ${round(size / 1e6)} MB in ${round(median(times))} ms, ${round(1000 * (daemon.cpu() - cpu) / 5)} ms of the daemon's processor time`);
  }

  const watch = await open(browser, `${daemon.url}/#run=${id}`, {}, watchful);
  const { page } = watch;
  const first = Math.ceil(particles / Math.ceil(particles / 200000));
  console.log(`  opened: particles there after ${round((await drawnOf(page, first, 0)) / 1000)} s`);
  const show = async (what, of) => {
    const { fps, gap, task, count, least } = await turn(page);
    console.log(`  ${what} ${round(fps)} pictures/s of ${count.toLocaleString("en")} particles (at least ${least.toLocaleString("en")}) of ${of.toLocaleString("en")}; longest pause ${round(gap)} ms, longest task ${round(task)} ms`);
  };
  await page.waitForTimeout(3000);
  const [rest, stood] = [threads(daemon), performance.now()];
  await page.waitForTimeout(1000 * STILL_S);
  console.log(`  standing still: ${round(threads(daemon) - rest)} ms of the daemon's processor time in ${round((performance.now() - stood) / 1000)} s`);
  await show("turned:              ", first);
  const still = await page.evaluate(() => performance.now());
  console.log(`  let go: all are drawn after ${round((await drawnOf(page, first, still)) - still)} ms`);

  const since = await page.evaluate(() => performance.now());
  await page.locator("#most").selectOption("1000000");
  const many = Math.ceil(particles / Math.ceil(particles / 1000000));
  const there = await drawnOf(page, many, since);
  console.log(`  1 million chosen: there after ${round(there - since)} ms`);
  await show("turned:              ", many);
  await page.locator("#most").selectOption("200000");
  await drawnOf(page, first, there);

  const before = await page.evaluate(() => performance.now());
  await page.getByRole("slider", { name: "Time" }).focus();
  await page.keyboard.press("Home");
  console.log(`  slider to the first frame: there after ${round((await drawnOf(page, first, before)) - before)} ms`);
  await page.locator("#live").click();
  if (pictures) await page.screenshot({ path: path.join(pictures, `million-${id}.png`) });

  // While it runs: frames come as fast as the daemon makes them.
  const seen = (await daemon.get(`/v1/runs/${id}/frames`)).frames.length;
  await page.getByRole("button", { name: /^(Resume|Start)$/ }).click();
  await until("it runs", async () => (await daemon.get(`/v1/runs/${id}/frames`)).frames.length > seen + 1);
  await show("turned while it runs:", first);
  const clicked = performance.now();
  await page.getByRole("button", { name: "Pause", exact: true }).click();
  await page.locator("#run-state", { hasText: "paused" }).waitFor();
  const run = await daemon.get(`/v1/runs/${id}`);
  console.log(`  Pause pressed: paused on the page after ${round(performance.now() - clicked)} ms; a step takes ${round((1000 * run.performance.wall_s) / run.step)} ms`);
  for (const word of watch.wrong) console.log(`  ON THE CONSOLE: ${word}`);
  await watch.context.close();
  await daemon.ask("POST", `/v1/runs/${id}:cancel`);
  await daemon.ask("DELETE", `/v1/runs/${id}`);
}

if (pictures) fs.mkdirSync(pictures, { recursive: true });
const daemon = await new Daemon().start();
const browser = await launch();
try {
  for (const scene of SCENES) await measure(browser, daemon, scene);
} finally {
  await browser.close();
  await daemon.remove();
}
