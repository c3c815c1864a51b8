// Particles by WebGL2: discs in 2D, lit balls in 3D, and the lines of the walls. Draws only when asked
// to.

const VERTEX = `#version 300 es
uniform mat4 transform;
uniform float pixels;   // of a particle, times the depth that it is divided by
uniform vec2 range;
uniform float flat2d;
in vec3 position;
in float value;
out float t;
flat out float size;
void main() {
  gl_Position = transform * vec4(position, 1.0);
  float wide = pixels / (flat2d > 0.5 ? 1.0 : gl_Position.w);
  gl_PointSize = clamp(wide, 1.5, 256.0);
  size = gl_PointSize;
  t = value != value ? -1.0 : clamp((value - range.x) / max(range.y - range.x, 1e-30), 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D map;
uniform float flat2d;
in float t;
flat in float size;
out vec4 color;
void main() {
  vec3 base = t < 0.0 ? vec3(0.5) : texture(map, vec2(t * 0.99609375 + 0.001953125, 0.5)).rgb;
  vec2 q = 2.0 * gl_PointCoord - 1.0;
  float r2 = dot(q, q);
  if (size > 3.0 && r2 > 1.0) discard;
  float light = 1.0;
  if (flat2d < 0.5 && size > 2.5) {
    vec3 n = vec3(q.x, -q.y, sqrt(max(0.0, 1.0 - r2)));
    light = 0.55 + 0.5 * max(0.0, dot(n, normalize(vec3(-0.4, 0.6, 0.75))));
  } else if (size > 5.0) {
    light = 1.0 - 0.18 * smoothstep(0.55, 1.0, r2);
  }
  color = vec4(base * light, 1.0);
}`;
const LINE_VERTEX = `#version 300 es
uniform mat4 transform;
in vec3 position;
void main() { gl_Position = transform * vec4(position, 1.0); }`;
const LINE_FRAGMENT = `#version 300 es
precision mediump float;
uniform vec4 ink;
out vec4 color;
void main() { color = ink; }`;

const FIELD_OF_VIEW = (30 * Math.PI) / 180;

// What a picture of all particles would take longer than this, shows a part of them as long as the view moves or frames
// come: without a graphics processor 200,000 particles take some 100 ms, in which the page would not answer.
const SMOOTH_MS = 40;
const LEAST_PARTICLES = 5000; // fewer are no picture any more
const SETTLE_MS = 200; // of rest, then all are drawn
const SETTLE_SHARE = 4; // and so many times what all of them take: the page must answer in between;
const SETTLED_MS = 1000; // but not longer

function program(gl, vertex, fragment) {
  const p = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
      throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(p, shader);
  }
  gl.bindAttribLocation(p, 0, "position");
  gl.bindAttribLocation(p, 1, "value");
  gl.linkProgram(p);
  return p;
}

function rgb(text) {
  const parts = text.match(/[\d.]+/g).map(Number);
  return [parts[0] / 255, parts[1] / 255, parts[2] / 255, parts[3] ?? 1];
}

function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
      out[4 * c + r] = sum;
    }
  return out;
}

// Where from, and how much of it: shared by all views, so that they show the same.
export class Camera {
  constructor() {
    this.dimension = 2;
    this.target = [0, 0, 0];
    this.half = 1; // height of the view at the target, halved, m
    this.yaw = -0.6;
    this.pitch = 0.45;
    this.touched = false;
    this.listeners = new Set();
  }

  changed() {
    for (const listener of this.listeners) listener();
  }

  // Shows the box from `low` to `high`; `aspect` is width by height of the view.
  fit(low, high, dimension, aspect) {
    const size = [0, 1, 2].map((d) => high[d] - low[d]);
    this.dimension = dimension;
    this.target = [0, 1, 2].map((d) => (low[d] + high[d]) / 2);
    if (dimension === 2) {
      this.half = 0.56 * Math.max(size[1], size[0] / aspect, 1e-9);
    } else {
      const [x, y] = this.axes();
      let wide = 0;
      let tall = 0;
      for (let k = 0; k < 8; k++) {
        const corner = [0, 1, 2].map((d) => ((k >> d) & 1 ? 0.5 : -0.5) * size[d]);
        wide = Math.max(wide, Math.abs(corner.reduce((s, c, d) => s + c * x[d], 0)));
        tall = Math.max(tall, Math.abs(corner.reduce((s, c, d) => s + c * y[d], 0)));
      }
      this.half = 1.5 * Math.max(tall, wide / aspect, 1e-9);
    }
    this.changed();
  }

  // The view's right, up and towards the eye, in the scene.
  axes() {
    if (this.dimension === 2) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return [[cy, 0, -sy], [-sy * sp, cp, -cy * sp], [sy * cp, sp, cy * cp]];
  }

  matrix(aspect) {
    const [x, y, z] = this.axes();
    const dot = (a) => a.reduce((s, v, d) => s + v * this.target[d], 0);
    const far = this.half / Math.tan(FIELD_OF_VIEW / 2);
    const back = this.dimension === 2 ? 0 : far;
    // prettier-ignore
    const look = [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x), -dot(y), -dot(z) - back, 1];
    if (this.dimension === 2)
      return multiply([1 / (this.half * aspect), 0, 0, 0, 0, 1 / this.half, 0, 0, 0, 0, -1e-6, 0, 0, 0, 0, 1], look);
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const [near, end] = [far * 0.02, far * 20];
    // prettier-ignore
    return multiply([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (end + near) / (near - end), -1, 0, 0, (2 * end * near) / (near - end), 0], look);
  }

  pan(dx, dy, height) {
    const [x, y] = this.axes();
    const m = (2 * this.half) / height;
    for (let d = 0; d < 3; d++) this.target[d] -= m * (dx * x[d] - dy * y[d]);
    this.touched = true;
    this.changed();
  }

  orbit(dx, dy) {
    if (this.dimension === 2) return;
    this.yaw -= 0.008 * dx;
    this.pitch = Math.min(1.55, Math.max(-1.55, this.pitch + 0.008 * dy));
    this.touched = true;
    this.changed();
  }

  // `x`, `y`: the point that stays, in half heights from the middle.
  zoom(factor, x = 0, y = 0) {
    const half = Math.min(1e9, Math.max(1e-9, this.half * factor));
    const [right, up] = this.axes();
    for (let d = 0; d < 3; d++) this.target[d] += (this.half - half) * (x * right[d] + y * up[d]);
    this.half = half;
    this.touched = true;
    this.changed();
  }
}

export class View {
  constructor(canvas, camera) {
    this.canvas = canvas;
    this.camera = camera;
    this.count = 0;
    this.dimension = 2;
    this.range = [0, 1];
    this.size = 0.01; // of a particle, m
    this.lines = 0;
    this.background = [1, 1, 1, 1];
    this.ink = [0, 0, 0, 1];
    this.pending = false;
    this.pace = 0; // ms that a particle takes to draw, as last measured, beyond
    this.least = null; // what a picture takes that has next to none, ms
    this.settling = 0; // timer: then all are drawn
    this.setUp();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.setUp();
      this.onrestored?.();
    });
    this.watcher = new ResizeObserver(() => this.request());
    this.watcher.observe(canvas);
    this.redraw = () => this.request();
    camera.listeners.add(this.redraw);
    this.hands();
  }

  setUp() {
    const gl = this.canvas.getContext("webgl2", { antialias: false, alpha: false });
    this.gl = gl;
    if (gl === null) return;
    this.points = program(gl, VERTEX, FRAGMENT);
    this.strokes = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.uniforms = {};
    for (const name of ["transform", "pixels", "range", "flat2d", "map"])
      this.uniforms[name] = gl.getUniformLocation(this.points, name);
    this.lineUniforms = { transform: gl.getUniformLocation(this.strokes, "transform"), ink: gl.getUniformLocation(this.strokes, "ink") };
    this.buffers = { position: gl.createBuffer(), value: gl.createBuffer(), line: gl.createBuffer() };
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]])
      gl.texParameteri(gl.TEXTURE_2D, key, value);
  }

  close() {
    clearTimeout(this.settling);
    this.watcher.disconnect();
    this.camera.listeners.delete(this.redraw);
    this.gl?.getExtension("WEBGL_lose_context")?.loseContext();
  }

  particles(positions, dimension, size) {
    const gl = this.gl;
    this.count = positions.length / 3;
    this.dimension = dimension;
    this.size = size;
    if (gl === null) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.position);
    gl.bufferData(gl.ARRAY_BUFFER, positions, gl.DYNAMIC_DRAW);
  }

  values(values) {
    const gl = this.gl;
    if (gl === null) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.value);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
  }

  colors(table) {
    const gl = this.gl;
    if (gl === null) return;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, table.length / 4, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, table);
  }

  // Pairs of points, x, y, z each.
  strokesOf(points) {
    const gl = this.gl;
    this.lines = points.length / 3;
    if (gl === null) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.line);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(points), gl.STATIC_DRAW);
  }

  theme(background, ink) {
    this.background = rgb(background);
    this.ink = rgb(ink);
  }

  get aspect() {
    return this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
  }

  request() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => this.hurry());
  }

  // Draws as many particles as SMOOTH_MS allow, and the rest once it is quiet.
  hurry() {
    clearTimeout(this.settling);
    const all = this.pace * this.count;
    const part = all > SMOOTH_MS ? Math.max(LEAST_PARTICLES, Math.floor(SMOOTH_MS / this.pace)) : this.count;
    this.draw(Math.min(part, this.count));
    if (part < this.count) this.settling = setTimeout(() => requestAnimationFrame(() => this.draw()), Math.min(SETTLED_MS, Math.max(SETTLE_MS, SETTLE_SHARE * all)));
  }

  // The next picture of the browser comes when this one is done.
  measure(began, count) {
    requestAnimationFrame(() => {
      if (document.hidden || count < LEAST_PARTICLES) return;
      const took = performance.now() - began;
      if (count <= 2 * LEAST_PARTICLES) this.least = Math.min(took, this.least ?? took);
      this.pace = Math.max(0, took - (this.least ?? 1000 / 60)) / count;
    });
  }

  draw(count = this.count) {
    this.pending = false;
    const gl = this.gl;
    if (gl === null || gl.isContextLost()) return;
    this.measure(performance.now(), count);
    const dense = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * dense));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * dense));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    const transform = this.camera.matrix(width / height);
    const flat = this.dimension === 2;
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (flat) gl.disable(gl.DEPTH_TEST);
    else gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (this.lines > 0) {
      gl.useProgram(this.strokes);
      gl.uniformMatrix4fv(this.lineUniforms.transform, false, transform);
      gl.uniform4fv(this.lineUniforms.ink, this.ink);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.line);
      gl.enableVertexAttribArray(0);
      gl.disableVertexAttribArray(1);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.drawArrays(gl.LINES, 0, this.lines);
    }
    if (count > 0) {
      gl.useProgram(this.points);
      gl.uniformMatrix4fv(this.uniforms.transform, false, transform);
      const perMetre = height / (2 * this.camera.half); // at the target
      const depth = flat ? 1 : this.camera.half / Math.tan(FIELD_OF_VIEW / 2);
      const wider = count === this.count ? 1 : 1.25 * (this.count / count) ** (1 / this.dimension); // a part of them, in no lattice, covers what all do
      gl.uniform1f(this.uniforms.pixels, wider * this.size * perMetre * depth);
      gl.uniform2f(this.uniforms.range, ...this.range);
      gl.uniform1f(this.uniforms.flat2d, flat ? 1 : 0);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.uniform1i(this.uniforms.map, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.position);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.value);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 1, gl.FLOAT, false, 0, 0);
      gl.drawArrays(gl.POINTS, 0, count);
    }
    this.ondrawn?.();
  }

  // Mouse, touch, wheel and keys.
  hands() {
    const canvas = this.canvas;
    const camera = this.camera;
    const fingers = new Map();
    const middle = () => {
      const all = [...fingers.values()];
      const x = all.reduce((s, f) => s + f.x, 0) / all.length;
      const y = all.reduce((s, f) => s + f.y, 0) / all.length;
      const spread = all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0;
      return { x, y, spread };
    };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      const before = middle();
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      const after = middle();
      const [dx, dy] = [after.x - before.x, after.y - before.y];
      const slides = camera.dimension === 2 || fingers.size > 1 || event.shiftKey || (event.buttons & 6) !== 0;
      if (slides) camera.pan(dx, dy, canvas.clientHeight);
      else camera.orbit(dx, dy);
      if (before.spread > 0 && after.spread > 0) camera.zoom(before.spread / after.spread, ...this.place(after));
    });
    for (const kind of ["pointerup", "pointercancel"])
      canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        const lines = event.deltaMode === 1 ? 18 : 1;
        camera.zoom(Math.exp(0.0015 * lines * event.deltaY), ...this.place({ x: event.clientX, y: event.clientY }));
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", (event) => {
      const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
      const arrow = arrows[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (arrow !== undefined && (camera.dimension === 2 || event.shiftKey)) camera.pan(40 * arrow[0], 40 * arrow[1], canvas.clientHeight);
      else if (arrow !== undefined) camera.orbit(15 * arrow[0], 15 * arrow[1]);
      else if (event.key === "+" || event.key === "=") camera.zoom(1 / 1.2);
      else if (event.key === "-") camera.zoom(1.2);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // A point of the screen, in half heights from the middle of the view.
  place({ x, y }) {
    const box = this.canvas.getBoundingClientRect();
    const half = box.height / 2;
    return [(x - box.left - box.width / 2) / half, (box.top + half - y) / half];
  }
}
