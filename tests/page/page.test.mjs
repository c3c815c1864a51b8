// The live page as a user has it: in a browser, against a daemon that is killed on the way.

import assert from "node:assert/strict";
import fs from "node:fs";
import { after, before, test } from "node:test";

import { table } from "../../server/page/colors.js";
import { Daemon, answered, launch, look, open, until } from "./harness.mjs";

let daemon;
let browser;
let watch; // the page that most tests share, as a user would
let page;

const RUN = "dam";
const state = async (id = RUN) => (await daemon.get(`/v1/runs/${id}`)).state;
const text = (selector) => page.locator(selector).textContent();
const says = async (selector, pattern) => {
  let last = "";
  await until(() => `${selector} says ${pattern}, not ${last}`, async () => pattern.test((last = await text(selector))));
};
const particles = (k = 0) => page.locator("canvas.particles").nth(k).screenshot();

// The picture, once it is another one and stays it.
const other = async (than, shot = particles) => {
  let last = null;
  return until("another picture", async () => {
    const now = await shot();
    const stays = last !== null && now.equals(last) && (than === null || !now.equals(than));
    last = now;
    return stays && now;
  });
};
const settled = (shot = particles) => other(null, shot);

before(async () => {
  daemon = await new Daemon().start();
  browser = await launch();
  watch = await open(browser, daemon.url);
  page = watch.page;
});

after(async () => {
  await browser?.close();
  await daemon?.remove();
});

// One after the other on one page: what follows a failure says nothing. Whatever a test does: nothing on
// the console, nothing asked elsewhere.
let failed = false;
function check(name, call) {
  test(name, async (t) => {
    if (failed) {
      t.skip("an earlier one failed");
      return;
    }
    failed = true;
    watch.foretold = [];
    await call();
    await answered(watch);
    assert.deepEqual(watch.wrong, []);
    failed = false;
  });
}

check("an empty page says what to do", async () => {
  await page.getByRole("heading", { name: "Nothing is selected" }).waitFor();
  assert.match(await text("#runs-empty"), /Create one/);
  await says("#connection", /^connected$/);
});

check("faults stand at their fields, in the daemon's words", async () => {
  watch.foretold = [/status of 422/, /status of 400/]; // the browser's own note of each such answer
  await page.keyboard.press("n");
  await page.getByLabel("Cell size").fill("-1");
  await page.getByLabel("Name of the run").fill("two words");
  await page.getByLabel("End, s").fill("soon");
  await page.getByRole("button", { name: "Create", exact: true }).click();
  const { errors } = await (await fetch(`${daemon.url}/v1/runs`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ scene: "dam-break", overrides: { cell: -1, time: { end: "soon" } }, id: "two words" }) })).json();
  assert.deepEqual(errors.map((e) => e.pointer).sort(), ["/id", "/scene/cell", "/scene/time/end"]);
  for (const [id, pointer] of [["create-cell", "/scene/cell"], ["create-id", "/id"], ["create-end", "/scene/time/end"]]) {
    await says(`#${id}-fault`, /./);
    assert.equal(await text(`#${id}-fault`), errors.find((e) => e.pointer === pointer).detail);
    assert.equal(await page.locator(`#${id}`).getAttribute("aria-invalid"), "true");
  }
  assert.equal(await text("#create-basis-fault"), "");
  assert.deepEqual((await daemon.get("/v1/runs")).runs, []);
});

check("a file's faults are listed with their pointers", async () => {
  watch.foretold = [/status of 422/, /status of 400/];
  const give = (name, content) => page.getByLabel("Scene file").setInputFiles({ name, mimeType: "application/json", buffer: Buffer.from(content) });
  for (const id of ["create-cell", "create-id", "create-end"]) await page.locator(`#${id}`).fill("");
  await page.getByLabel("Scene", { exact: true }).selectOption("file");
  await give("broken.json", '{"format": "fbard-scene-1", oops}');
  await says("#create .faults", /line 1|column|expected/i);
  await give("poor.json", '{"format": "fbard-scene-1", "dimension": 2, "spped": 3}');
  await says("#create .faults", /\/scene\/spped.*\/scene\/materials|\/scene\/materials.*\/scene\/spped/s);
});

check("a scene file is dropped on the page", async () => {
  watch.foretold = [/status of 422/, /status of 400/];
  await page.keyboard.press("Escape");
  const drop = async (name, content) => {
    const dataTransfer = await page.evaluateHandle(([n, c]) => {
      const data = new DataTransfer();
      data.items.add(new File([c], n, { type: "application/json" }));
      return data;
    }, [name, content]);
    await page.dispatchEvent("#welcome", "dragenter", { dataTransfer });
    await page.getByText("Drop a scene file (JSON)").waitFor();
    await page.dispatchEvent("#welcome", "drop", { dataTransfer });
    await page.getByText("Drop a scene file (JSON)").waitFor({ state: "hidden" });
    await page.getByRole("heading", { name: "New run" }).waitFor();
  };
  const scene = await daemon.get("/v1/scenes/dam-break");
  await drop("wrong.json", JSON.stringify({ ...scene, cell: -1, spped: 3 }));
  await says("#create-cell-fault", /must be a number > 0 in m, got -1/); // at its field, as the daemon words it
  await says("#create .faults", /\/scene\/spped/);
  await page.keyboard.press("Escape");
  await drop("mine.json", JSON.stringify({ ...scene, title: "My own", cell: 0.5 }));
  await says("#create .about", /^My own$/);
  await says("#create .estimate", /800 particles/);
  await page.getByLabel("Name of the run").fill("dropped");
  await page.getByLabel("start at once").uncheck();
  await page.getByRole("button", { name: "Create", exact: true }).click();
  await says("#run-title", /^dropped$/);
  const run = await daemon.get("/v1/runs/dropped");
  assert.deepEqual([run.scene, run.state, run.particles], ["My own", "paused", 800]);
  watch.foretold.push(/status of 404/); // what the page still asks for when somebody else deletes the run
  await daemon.ask("POST", "/v1/runs/dropped:cancel");
  await daemon.ask("DELETE", "/v1/runs/dropped");
  await page.getByRole("heading", { name: "Nothing is selected" }).waitFor();
  await page.keyboard.press("n");
});

check("a run is created from a built-in scene with overrides", async () => {
  await page.getByLabel("Scene", { exact: true }).selectOption("dam-break");
  await page.getByLabel("Name of the run").fill(RUN);
  await page.getByLabel("F̄ scheme").selectOption("zhao");
  await page.getByLabel("Cell size").fill("0.5"); // small and long: soon in motion, and not over before the test is
  await page.getByLabel("End, s").fill("20");
  await page.getByLabel("Frame interval").fill("0.01");
  await says("#create .estimate", /800 particles, .* steps/);
  await page.getByRole("button", { name: "Create", exact: true }).click();
  await says("#run-title", new RegExp(`^${RUN}$`));
  await says("#run-state", /running/);
  const run = await daemon.get(`/v1/runs/${RUN}`);
  assert.equal(run.fbar_scheme, "zhao");
  assert.equal((await daemon.get(`/v1/runs/${RUN}/scene`)).cell, 0.5);
  await says("#run-facts", /particles800/);
  await says("#run-facts", /particle-steps\/s/);
});

check("particles are drawn in the colours of the field", async () => {
  await says(".pane-title", /t = 0\.[0-9]/);
  // Water fills a fair part of the view; its pressure rises with the depth, so many colours of the map.
  let seen;
  await until(() => `water in many colours: ${JSON.stringify(seen)}`, async () => {
    seen = await look(browser, await particles());
    return seen.share > 0.12 && seen.colors > 40 && seen.darkest < 60 && seen.lightest > 200;
  });
  assert.match(await text(".legend"), /Mean stress, k?Pa/);
});

check("another field, range and map are other colours", async () => {
  await page.getByRole("button", { name: "Pause", exact: true }).click(); // so that nothing else changes the picture
  await says("#run-state", /paused/);
  await says("#clock", new RegExp(`frame ${(await daemon.get(`/v1/runs/${RUN}/frames`)).frames.length - 1}$`));
  const stress = await settled();
  await page.getByLabel("Field").selectOption("velocity:size");
  await says(".legend", /Velocity, magnitude, m\/s/);
  const velocity = await other(stress);
  await page.getByLabel("Range").selectOption("fixed");
  await page.getByLabel("Lowest value").fill("0");
  await page.getByLabel("Highest value").fill("1000");
  await says(".legend", /1000/);
  const fixed = await other(velocity);
  await page.getByLabel("Range").selectOption("robust");
  await other(fixed);
  const saturated = async () => (await look(browser, await particles())).saturated;
  await until("colours", async () => (await saturated()) > 0.05);
  await page.getByLabel("Colours").selectOption("grey");
  await until("grey alone", async () => (await saturated()) < 0.002);
  await page.getByLabel("Colours").selectOption("auto");
  await page.getByLabel("Field").selectOption("mean_stress");
});

check("F̄ is switched in mid-run", async () => {
  await page.getByRole("button", { name: "Resume", exact: true }).click();
  await says("#run-state", /running/);
  const before = await daemon.get(`/v1/runs/${RUN}`);
  await page.locator("#fbar").getByText("off", { exact: true }).click();
  await until("F-bar is off", async () => (await daemon.get(`/v1/runs/${RUN}`)).fbar_scheme === "off");
  const { changes } = await daemon.get(`/v1/runs/${RUN}`);
  assert.deepEqual(changes.map((c) => c.patch), [{ fbar: false }]);
  assert.ok(changes[0].step >= before.step && changes[0].step > 0);
  await until("the page knows", () => page.locator('#fbar input[value="off"]').isChecked());
  await page.locator("#marks i").waitFor({ state: "attached" });
  await page.locator("#fbar").getByText("anchored", { exact: true }).click();
  await until("F-bar is anchored", async () => (await daemon.get(`/v1/runs/${RUN}`)).fbar_scheme === "anchored");
});

check("pause by key, and steps that are counted", async () => {
  await page.locator("#run-title").click();
  await page.keyboard.press("p");
  await says("#run-state", /paused/);
  assert.equal(await state(), "paused");
  const { step } = await daemon.get(`/v1/runs/${RUN}`);
  await page.getByLabel("Steps").fill("37");
  await page.getByRole("button", { name: "Step", exact: true }).click();
  await until("37 steps more", async () => {
    const run = await daemon.get(`/v1/runs/${RUN}`);
    return run.state === "paused" && run.step === step + 37;
  });
  await says("#run-facts", new RegExp(String(step + 37).replace(/\B(?=(\d{3})+$)/g, " ")));
});

check("the slider goes over the frames of the journal", async () => {
  const { frames } = await daemon.get(`/v1/runs/${RUN}/frames`);
  const slider = page.getByRole("slider", { name: "Time" });
  await until("the slider knows all frames", async () => Number(await slider.getAttribute("max")) === frames.length - 1);
  const last = await settled();
  await slider.focus();
  await page.keyboard.press("Home");
  await says("#clock", /frame 0$/);
  await page.keyboard.press("ArrowRight");
  await says("#clock", /frame 1$/);
  assert.equal(await page.locator("#live").getAttribute("aria-pressed"), "false");
  const early = await other(last);
  assert.ok((await look(browser, early)).share > 0.1);
  await page.getByRole("button", { name: "Frame after", exact: true }).click();
  await says("#clock", /frame 2$/);
  await page.locator("#live").click();
  await says("#clock", new RegExp(`frame ${frames.length - 1}$`));
});

check("curves are the probes, with the references of the scene", async () => {
  const probes = await daemon.get(`/v1/runs/${RUN}/probes`);
  const { accuracy } = await daemon.get(`/v1/runs/${RUN}`);
  const names = Object.keys(probes.probes);
  assert.ok(names.length > 3 && accuracy.length > 0);
  await until("as many curves as probes", async () => (await page.locator("figure.curve").count()) === names.length);
  const drawn = () =>
    page.evaluate(() =>
      [...document.querySelectorAll("figure.curve")].map((figure) => ({
        name: figure.querySelector(".name").textContent,
        sets: window.Chart.getChart(figure.querySelector("canvas")).data.datasets.map((d) => ({ reference: d.isReference === true, raw: d._data ?? d.data })),
      })),
    );
  await until("all samples", async () => (await drawn())[0].sets[0].raw.length === probes.time.length);
  const front = (await drawn()).find((c) => c.name === "front");
  assert.deepEqual(front.sets[0].raw, probes.time.map((x, k) => ({ x, y: probes.probes.front[k] })));
  const cited = accuracy.filter((r) => r.probe === "front");
  assert.deepEqual(front.sets.find((s) => s.reference).raw.map(({ x, y }) => [x, y]), cited.map((r) => [r.at, r.reference]));
  const energy = (await drawn()).find((c) => c.name === "energy");
  assert.equal(energy.sets.length, Object.keys(probes.probes.energy).length);
  await until("a curve", async () => (await look(browser, await page.locator("figure.curve canvas").first().screenshot())).share > 0.005);
});

check("picture and CSV are downloaded", async () => {
  const fetched = async (press) => {
    const waiting = page.waitForEvent("download");
    await press();
    const download = await waiting;
    return { name: download.suggestedFilename(), bytes: fs.readFileSync(await download.path()) };
  };
  const picture = await fetched(() => page.getByRole("button", { name: "Picture", exact: true }).click());
  assert.match(picture.name, /^dam-mean_stress-t.*\.png$/);
  const seen = await look(browser, picture.bytes);
  assert.ok(seen.share > 0.15 && seen.colors > 40, JSON.stringify(seen));
  const csv = await fetched(() => page.getByRole("button", { name: "CSV", exact: true }).click());
  assert.equal(csv.name, "dam-probes.csv");
  assert.equal(csv.bytes.toString(), await (await daemon.ask("GET", `/v1/runs/${RUN}/probes`, undefined, { Accept: "text/csv" })).text());
});

check("the view is turned by hand and keys, and fits again", async () => {
  const before = await settled();
  const box = await page.locator("canvas.particles").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await page.mouse.wheel(0, -400);
  const near = await other(before);
  await page.mouse.down();
  await page.mouse.move(box.x + box.width / 2 + 150, box.y + box.height / 2 + 40);
  await page.mouse.up();
  const moved = await other(near);
  await page.locator("canvas.particles").focus();
  await page.keyboard.press("ArrowLeft");
  await page.keyboard.press("-");
  await page.keyboard.press("0");
  await other(moved);
  const { share } = await look(browser, before);
  await until("as at first", async () => Math.abs((await look(browser, await particles())).share - share) < 0.05);
});

check("two runs stand side by side on one time axis", async () => {
  await page.getByRole("button", { name: /Run twin/ }).click();
  const twin = await until("the twin is there", async () => (await daemon.get("/v1/runs")).runs.find((r) => r.id !== RUN));
  assert.equal(twin.fbar, !(await daemon.get(`/v1/runs/${RUN}`)).fbar);
  await until("both panes show particles", async () => (await page.locator(".pane-title b").allTextContents()).join() === `${RUN},${twin.id}`);
  await until("some frames of the twin", async () => (await daemon.get(`/v1/runs/${twin.id}/frames`)).frames.length > 3);
  await daemon.ask("POST", `/v1/runs/${twin.id}:pause`);
  await says("#runs", /paused.*paused/s);
  const slider = page.getByRole("slider", { name: "Time" });
  await slider.focus();
  await page.keyboard.press("Home");
  await page.keyboard.press("ArrowRight");
  await page.keyboard.press("ArrowRight");
  const times = await until("both at one time", async () => {
    const found = (await page.locator(".pane-title").allTextContents()).map((t) => /t = (\S+) s/.exec(t)?.[1]);
    return found[0] === found[1] && found[0] !== undefined ? found : null;
  });
  assert.equal(times.length, 2);
  for (const k of [0, 1]) await until(`particles in pane ${k}`, async () => (await look(browser, await particles(k))).share > 0.08);
  await until("one range for both", async () => {
    const legends = await page.locator(".legend").allTextContents();
    return legends.length === 2 && legends[0] === legends[1];
  });
  await until("curves of both", () => page.evaluate(() => window.Chart.getChart(document.querySelector("figure.curve canvas")).data.datasets.filter((d) => !d.isReference).length === 2));
  await page.getByLabel("Compare with").selectOption("");
  await until("one pane again", async () => (await page.locator(".pane").count()) === 1);
});

check("a daemon that is killed is said to be away, and comes back by itself", async () => {
  watch.foretold = [/net::ERR_(CONNECTION_REFUSED|INCOMPLETE_CHUNKED_ENCODING|CONNECTION_RESET|EMPTY_RESPONSE|CONNECTION_CLOSED)/];
  await page.getByRole("button", { name: /^(Resume|Start)$/ }).click();
  await says("#run-state", /running/);
  await daemon.end("SIGKILL");
  await page.locator("#banner").waitFor();
  assert.match(await text("#banner"), /does not answer/);
  await until("nothing can be pressed", () => page.locator("#go").isDisabled());
  await daemon.start();
  await page.locator("#banner").waitFor({ state: "hidden" });
  await says("#run-state", /running/); // it goes on from its checkpoint
  const { frames } = await daemon.get(`/v1/runs/${RUN}/frames`);
  await until("new frames are shown", async () => Number(/frame (\d+)/.exec(await text("#clock"))?.[1]) >= frames.length);
  await page.getByRole("button", { name: "Pause", exact: true }).click();
  await says("#run-state", /paused/);
});

check("a page that stands still asks nothing and costs next to nothing", async () => {
  await says("#runs", /paused.*paused/s);
  const streams = async () => Number(/^fbard_streams (\d+)/m.exec(await (await daemon.ask("GET", "/metrics")).text())[1]);
  await until("the events of all runs, and nothing else", async () => (await streams()) === 1);
  await until("what followed the pause is over", async () => {
    const before = [watch.requests.length, daemon.cpu()];
    await page.waitForTimeout(500);
    return watch.requests.length === before[0] && daemon.cpu() - before[1] <= 0.01;
  });
  const asked = watch.requests.length;
  const cpu = daemon.cpu();
  await page.waitForTimeout(3000);
  assert.equal(watch.requests.length, asked);
  // 10 ms are one tick of the kernel's account; an idle daemon with an open page uses well under 1 %.
  assert.ok(daemon.cpu() - cpu <= 0.06, `${daemon.cpu() - cpu} s of 3 s`);
  // A hidden tab lets go of the rest; shown again it is there at once.
  const hide = (hidden) =>
    page.evaluate((h) => {
      Object.defineProperty(document, "hidden", { value: h, configurable: true });
      document.dispatchEvent(new Event("visibilitychange"));
    }, hidden);
  await hide(true);
  await until("no stream is open", async () => (await streams()) === 0);
  await hide(false);
  await until("it listens again", async () => (await streams()) === 1);
  await says("#connection", /^connected$/);
});

check("dark and light, wide and narrow", async () => {
  const background = async () => (await look(browser, await particles())).background;
  assert.ok((await background()) > 200);
  await page.emulateMedia({ colorScheme: "dark" });
  await until("dark", async () => (await background()) < 60);
  await page.getByRole("button", { name: /^Theme/ }).click(); // light, whatever the system has
  await until("light", async () => (await background()) > 200);
  await page.setViewportSize({ width: 390, height: 844 });
  assert.ok((await page.evaluate(() => document.scrollingElement.scrollWidth)) <= 390, "nothing sticks out");
  const seen = await until("it is drawn anew", async () => {
    const narrow = await look(browser, await particles());
    return narrow.share > 0.1 && narrow;
  });
  assert.ok(seen.width <= 390, JSON.stringify(seen));
  await page.setViewportSize({ width: 1280, height: 800 });
});

check("everything is reached by the keyboard, and shows it", async () => {
  const wanted = new Set(["new", "go", "compare", "twin", "field", "range", "map", "most", "size", "fit", "picture", "slider", "play", "live", "csv", "theme", "help"]);
  await page.locator("#run-title").click();
  for (let k = 0; k < 60 && wanted.size > 0; k++) {
    await page.keyboard.press("Tab");
    const { id, outline, name } = await page.evaluate(() => {
      const e = document.activeElement;
      const label = e.getAttribute("aria-label") ?? e.labels?.[0]?.textContent ?? e.textContent;
      return { id: e.id, outline: getComputedStyle(e).outlineStyle, name: label?.trim() };
    });
    if (id === "") continue;
    assert.notEqual(outline, "none", id);
    assert.ok(name, `${id} has a name`);
    wanted.delete(id);
  }
  assert.deepEqual([...wanted], []);
  await page.keyboard.press("?");
  await page.getByRole("heading", { name: "Keys" }).waitFor();
  await page.keyboard.press("Escape");
});

check("a run is cancelled and deleted", async () => {
  await page.getByRole("button", { name: "Cancel", exact: true }).click();
  await says("#run-state", /cancelled/);
  await page.getByRole("button", { name: "Delete", exact: true }).click();
  await page.locator("#ask").getByRole("button", { name: "Delete", exact: true }).click();
  await until("it is gone", async () => !(await daemon.get("/v1/runs")).runs.some((r) => r.id === RUN));
  await until("from the list as well", async () => !(await page.locator(".run-name").allTextContents()).includes(RUN));
});

test("colour maps are even steps of lightness, without edges", () => {
  // Lightness of OKLab (B. Ottosson, 2020) of sRGB bytes.
  const linear = (v) => (v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4);
  const lightness = ([r, g, b]) =>
    0.2104542553 * Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b) +
    0.793617785 * Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b) -
    0.0040720468 * Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  for (const [name, dark] of [["sequential", false], ["grey", false], ["diverging", false], ["diverging", true]]) {
    const bytes = table(name, dark);
    const L = Array.from({ length: 256 }, (_, k) => lightness([0, 1, 2].map((c) => linear(bytes[4 * k + c]))));
    const [from, to] = name === "diverging" ? [[0, 127], [128, 255]] : [[0, 255], [0, 255]];
    for (const [a, b] of [from, to])
      for (let k = a; k <= b; k++) {
        const even = L[a] + ((L[b] - L[a]) * (k - a)) / (b - a);
        // Bytes are within half a step of 1/255; at these colours that is 0.004 of lightness.
        assert.ok(Math.abs(L[k] - even) < 0.006, `${name} ${dark} at ${k}: ${L[k]}, not ${even}`);
      }
  }
});

test("three dimensions are orbited", async () => {
  await daemon.ask("POST", "/v1/runs", { scene: "landslide", id: "solid", start: false, overrides: { cell: 1, time: { dt: 1e-4 } } });
  const own = await open(browser, `${daemon.url}/#run=solid`);
  const canvas = own.page.locator("canvas.particles");
  await own.page.locator(".pane-title b").waitFor();
  const shot = () => canvas.screenshot();
  await until("particles", async () => (await look(browser, await shot())).share > 0.05);
  const before = await settled(shot);
  const box = await canvas.boundingBox();
  await own.page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await own.page.mouse.down();
  await own.page.mouse.move(box.x + box.width / 2 + 120, box.y + box.height / 2 + 30);
  await own.page.mouse.up();
  const turned = await other(before, shot);
  assert.ok((await look(browser, turned)).share > 0.05);
  assert.deepEqual(own.wrong, []);
  await own.context.close();
});

test("fingers on a phone: one orbits, two pan, a pinch zooms", async () => {
  const own = await open(browser, `${daemon.url}/#run=solid`, { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true });
  const canvas = own.page.locator("canvas.particles");
  await own.page.locator(".pane-title b").waitFor();
  await canvas.scrollIntoViewIfNeeded();
  const box = await canvas.boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  const cdp = await own.context.newCDPSession(own.page);
  const touch = (type, ...points) => cdp.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([px, py], id) => ({ x: px, y: py, id })) });
  const slide = async (from, to) => {
    await touch("touchStart", ...from);
    for (let k = 1; k <= 4; k++) await touch("touchMove", ...from.map((p, f) => p.map((v, d) => v + (k / 4) * (to[f][d] - v))));
    await touch("touchEnd");
  };
  // What the view shows: {perMetre: px by its scale; place: of the particles, px}.
  let shot = null;
  const view = async () => {
    shot = await canvas.screenshot();
    const [width, label] = [(await own.page.locator(".scale i").boundingBox()).width, await own.page.locator(".scale span").textContent()];
    return { perMetre: width / Number(label.replace(" m", "")), place: (await look(browser, shot)).place };
  };
  // The view, once it stands still, is nearer by `zoom`, and the particles have moved by `by` px (12 for what perspective makes of it).
  const becomes = (what, from, zoom, by) => {
    let now = null;
    return until(() => `${what}: ${JSON.stringify([from, now])}`, async () => {
      now = await view();
      if (!shot.equals(await canvas.screenshot())) return false;
      return Math.abs(now.perMetre / from.perMetre / zoom - 1) < 0.02 && by.every((v, d) => v === null || Math.abs(now.place[d] - from.place[d] - v) < 12) && now;
    });
  };
  const scrolled = () => own.page.evaluate(() => document.scrollingElement.scrollTop);
  const top = await scrolled();
  await own.page.locator("#field").selectOption("position:0"); // in all colours
  await own.page.locator(".legend").evaluate((legend) => (legend.style.visibility = "hidden")); // whose colours stay where they are
  await until("particles", async () => (await view()).place.every((v) => v > 0) && shot.equals(await canvas.screenshot()));
  const start = await view();
  const before = shot;
  await slide([[x, y]], [[x + 90, y + 20]]);
  await until("another side", async () => !(await view(), shot.equals(before)));
  const orbited = await becomes("turned about its middle", start, 1, [0, null]);
  await slide([[x - 40, y], [x + 40, y]], [[x + 10, y - 30], [x + 90, y - 30]]);
  const panned = await becomes("moved with the fingers", orbited, 1, [50, -30]);
  await slide([[x - 40, y], [x + 40, y]], [[x - 80, y], [x + 80, y]]);
  await becomes("twice as near", panned, 2, [null, null]);
  assert.equal(await scrolled(), top, "the page stays where it is");
  assert.deepEqual(own.wrong, []);
  await own.context.close();
});

test("with a token the page asks for it, and says when it is wrong", async () => {
  const file = `${daemon.folder}/token`;
  fs.writeFileSync(file, "open-sesame\n", { mode: 0o600 });
  const locked = await new Daemon("--token-file", file).start();
  try {
    const own = await open(browser, locked.url);
    own.foretold = [/status of 401/];
    await own.page.getByRole("textbox", { name: "Token" }).fill("wrong");
    await own.page.getByRole("button", { name: "Go on" }).click();
    await own.page.getByText("was not accepted").waitFor();
    await own.page.getByRole("textbox", { name: "Token" }).fill("open-sesame");
    await own.page.getByRole("button", { name: "Go on" }).click();
    await own.page.getByText("connected", { exact: true }).waitFor();
    await own.page.reload(); // the tab keeps it
    await own.page.getByText("connected", { exact: true }).waitFor();
    assert.deepEqual(own.wrong, []);
    assert.ok(own.requests.every((url) => !url.includes("sesame")), "in headers only");
    await own.context.close();
  } finally {
    await locked.remove();
  }
});
