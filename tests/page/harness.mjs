// A daemon, a browser, and what must hold of every page that is opened here: nothing on the console that
// was not foretold, no request to anywhere else.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import fs from "node:fs";
import { createRequire } from "node:module";
import net from "node:net";
import os from "node:os";
import path from "node:path";

const root = path.resolve(import.meta.dirname ?? path.dirname(new URL(import.meta.url).pathname), "../..");
const modules = process.env.PAGE_MODULES ?? path.join(root, "build/page");
const { chromium } = createRequire(path.join(modules, "package.json"))("playwright-core");

export const PATIENCE_MS = 1000 * Number(process.env.PATIENCE ?? 120); // a busy machine is allowed for; nothing waits that long unless it fails

export async function until(what, condition) {
  const end = Date.now() + PATIENCE_MS;
  for (;;) {
    const value = await condition();
    if (value) return value;
    assert.ok(Date.now() < end, `not within ${PATIENCE_MS / 1000} s: ${typeof what === "function" ? what() : what}`);
    await new Promise((done) => setTimeout(done, 25));
  }
}

// A free port that nobody is given while its daemon is away (tests/ports.py).
async function fixedPort() {
  const [low] = fs.readFileSync("/proc/sys/net/ipv4/ip_local_port_range", "utf8").split(/\s+/).map(Number);
  const from = Math.max(1025, low - 10000);
  if (low - from < 100) return 0;
  for (;;) {
    const server = net.createServer();
    const port = await new Promise((done) => {
      server.once("error", () => done(null));
      server.listen(from + Math.floor(Math.random() * (low - from)), "127.0.0.1", () => done(server.address().port));
    });
    if (port === null) continue;
    await new Promise((done) => server.close(done));
    return port;
  }
}

export class Daemon {
  constructor(...options) {
    this.folder = fs.mkdtempSync(path.join(os.tmpdir(), "fbard-page-"));
    this.options = options;
    this.address = null;
  }

  async start() {
    this.address ??= `127.0.0.1:${await fixedPort()}`;
    const ports = path.join(this.folder, "ports.json");
    fs.rmSync(ports, { force: true });
    const log = fs.openSync(path.join(this.folder, "log.txt"), "a");
    this.process = spawn(
      process.env.FBARD ?? path.join(root, "build/fbard"),
      ["--http", this.address, "--publish", "tcp://127.0.0.1:0", "--port-file", ports, "--data-dir", path.join(this.folder, "data"), "--threads", "1", "--slots", "2", ...this.options],
      { stdio: ["ignore", log, log] },
    );
    fs.closeSync(log);
    await until("fbard is ready", () => {
      assert.equal(this.process.exitCode, null, fs.readFileSync(path.join(this.folder, "log.txt"), "utf8"));
      return fs.existsSync(ports);
    });
    this.url = JSON.parse(fs.readFileSync(ports, "utf8")).http;
    this.address = new URL(this.url).host; // a restart comes back at the same place
    return this;
  }

  async end(signal = "SIGTERM") {
    if (this.process.exitCode !== null || this.process.signalCode !== null) return;
    const ended = new Promise((done) => this.process.once("exit", done));
    this.process.kill(signal);
    await ended;
  }

  async remove() {
    await this.end();
    fs.rmSync(this.folder, { recursive: true, force: true });
  }

  async ask(method, where, body, headers = {}) {
    const response = await fetch(this.url + where, {
      method,
      headers: body === undefined ? headers : { "Content-Type": "application/json", ...headers },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
    assert.ok(response.ok, `${method} ${where}: ${response.status}`);
    return response;
  }

  async get(where) {
    return (await this.ask("GET", where)).json();
  }

  // Seconds of processor time that the process has used, by the kernel's account (proc(5)).
  cpu() {
    const fields = fs.readFileSync(`/proc/${this.process.pid}/stat`, "utf8").split(") ")[1].split(" ");
    return (Number(fields[11]) + Number(fields[12])) / 100;
  }
}

// Chromium draws by its software renderer, so that machines without graphics do.
export async function launch() {
  return chromium.launch({
    timeout: PATIENCE_MS,
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: [
      "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
      "--disable-background-networking", "--disable-component-update", "--disable-sync",
      "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
      ...(process.getuid() === 0 ? ["--no-sandbox"] : []), // as root chromium has none
    ],
  }); // prettier-ignore
}

// A page under watch. `watch.foretold` are patterns of what may be on the console now.
// `script` runs in it before its own.
export async function open(browser, url, options = {}, script = null) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, reducedMotion: "reduce", ...options });
  const page = await context.newPage();
  if (script !== null) await page.addInitScript(script);
  page.setDefaultTimeout(PATIENCE_MS);
  const watch = { page, context, foretold: [], wrong: [], requests: [], pending: new Set() };
  page.on("console", (message) => {
    const text = message.text();
    const isDriver = message.type() === "warning" && text.includes("GL Driver Message"); // of screenshots
    if (["error", "warning"].includes(message.type()) && !isDriver && !watch.foretold.some((p) => p.test(text)))
      watch.wrong.push(`${message.type()}: ${text} (${message.location().url})`);
  });
  page.on("pageerror", (error) => watch.wrong.push(error.stack));
  context.on("request", (request) => {
    watch.requests.push(request.url());
    if (!/\/(events|stream)(\?|$)/.test(request.url())) watch.pending.add(request);
    const from = new URL(request.url());
    if (from.origin !== new URL(url).origin && from.protocol !== "blob:") watch.wrong.push(`request to ${request.url()}`);
  });
  context.on("response", (response) => watch.pending.delete(response.request()));
  context.on("requestfailed", (request) => watch.pending.delete(request));
  await page.goto(url);
  return watch;
}

// Once all that the page has asked for has come (but for what has no end), and what the browser says of it.
export async function answered(watch) {
  await until(() => `answers to ${[...watch.pending].map((request) => request.url())}`, () => watch.pending.size === 0);
  await watch.page.evaluate(() => null);
}

// What a picture shows: {share} of pixels that are not background, {saturated} of those with a hue,
// {colors} told apart in steps of 16, {darkest, lightest} of those that are not background (relative luminance, 0..255), {background},
// {place}: the middle of those with a hue, px.
export async function look(browser, png) {
  const page = (look.page ??= await browser.newPage()); // of its own, without the policy of ours
  return page.evaluate(async (data) => {
    const image = await createImageBitmap(await (await fetch(`data:image/png;base64,${data}`)).blob());
    const canvas = new OffscreenCanvas(image.width, image.height);
    const ctx = canvas.getContext("2d");
    ctx.drawImage(image, 0, 0);
    const { data: p } = ctx.getImageData(0, 0, image.width, image.height);
    const light = (k) => 0.2126 * p[k] + 0.7152 * p[k + 1] + 0.0722 * p[k + 2];
    const corner = 4 * (image.width * 3 + image.width - 4); // no frame, no text there
    const seen = new Set();
    let [n, colorful, darkest, lightest, sumX, sumY] = [0, 0, 255, 0, 0, 0];
    for (let k = 0; k < p.length; k += 4) {
      if (Math.abs(p[k] - p[corner]) + Math.abs(p[k + 1] - p[corner + 1]) + Math.abs(p[k + 2] - p[corner + 2]) < 12) continue;
      n++;
      if (Math.max(p[k], p[k + 1], p[k + 2]) - Math.min(p[k], p[k + 1], p[k + 2]) > 48) {
        colorful++;
        sumX += (k / 4) % image.width;
        sumY += Math.floor(k / 4 / image.width);
      }
      seen.add(((p[k] >> 4) << 8) | ((p[k + 1] >> 4) << 4) | (p[k + 2] >> 4));
      darkest = Math.min(darkest, light(k));
      lightest = Math.max(lightest, light(k));
    }
    return { width: image.width, height: image.height, share: (4 * n) / p.length, saturated: (4 * colorful) / p.length, colors: seen.size, darkest, lightest, background: light(corner), place: [sumX / colorful, sumY / colorful] };
  }, png.toString("base64"));
}
