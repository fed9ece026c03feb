/** Points, boxes and range rings in WebGL 2, and the boxes' labels as HTML above them. */

import { corners } from "./boxes.js";
import { OrbitCamera, project } from "./camera.js";

/** Shaders of points colored by height: a ramp of so many colors from the ground to some metres above it. */
const pointShaders = (colors) => ({
  vertex: `#version 300 es
    uniform mat4 matrix; uniform float ratio, ground, span; uniform vec3 ramp[${colors}]; in vec4 point; out vec3 color;
    void main() {
      gl_Position = matrix * vec4(point.xyz, 1.0);
      gl_PointSize = ratio * clamp(70.0 / gl_Position.w, 1.3, 3.5);
      float place = clamp((point.z - ground) / span, 0.0, 1.0) * ${(colors - 1).toFixed(1)};
      int low = min(int(place), ${colors - 2});
      color = mix(ramp[low], ramp[low + 1], place - float(low));
      color *= 0.75 + 0.6 * point.w;
    }`,
  fragment: `#version 300 es
    precision mediump float; in vec3 color; out vec4 pixel;
    void main() { pixel = vec4(color, 1.0); }`,
});

// A line is a strip of two triangles, because WebGL draws thin ones only. `other` is its other end.
const LINES = {
  vertex: `#version 300 es
    uniform mat4 matrix; uniform vec2 size; uniform float width;
    in vec3 place; in vec3 other; in float side; in vec4 tint; out vec4 color;
    void main() {
      vec4 here = matrix * vec4(place, 1.0), there = matrix * vec4(other, 1.0);
      vec2 along = normalize((there.xy / max(there.w, 0.01) - here.xy / max(here.w, 0.01)) * size);
      gl_Position = here + vec4(vec2(-along.y, along.x) * side * width / size * here.w, 0.0, 0.0);
      color = tint;
    }`,
  fragment: `#version 300 es
    precision mediump float; in vec4 color; out vec4 pixel;
    void main() { pixel = color; }`,
};

const RINGS_M = [20, 40, 60, 80];
const GROUND_SHARE = 0.1; // of the points lies below what is taken as the ground (asca_pillars/pictures/colors.py)
const RING_COLOR = [0.55, 0.65, 0.75, 0.28];
const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

export class Scene {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {HTMLElement} labels lies over the canvas
   * @param {{ramp: number[][], span_m: number}} heights colors (0..255) of points from the ground to `span_m` above it
   */
  constructor(canvas, labels, { ramp, span_m: span }) {
    this.canvas = canvas;
    this.labels = labels;
    this.camera = new OrbitCamera();
    this.gl = canvas.getContext("webgl2", { antialias: true });
    if (!this.gl) throw new Error("this browser does not give WebGL 2, which draws the scene");
    this.heights = { ramp: ramp.flat().map((value) => value / 255), span: [span], ground: [0] };
    this.points = { program: program(this.gl, pointShaders(ramp.length)), count: 0, buffer: this.gl.createBuffer() };
    this.lines = { program: program(this.gl, LINES), count: 0, buffer: this.gl.createBuffer() };
    this.labeled = [];
    this.listen();
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  /**
   * Show a scan and its boxes.
   * @param {Float32Array} points x, y, z, reflectance of each of N points
   * @param {{class: string, score: number, box: Float32Array, color: number[]}[]} boxes color: red, green, blue 0..1
   */
  show(points, boxes) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.points.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, points, gl.STATIC_DRAW);
    this.points.count = points.length / 4;
    const ground = groundHeight(points);
    this.heights.ground = [ground];
    const segments = [...rings(ground), ...boxes.flatMap(boxSegments)];
    const vertices = Float32Array.from(segments.flatMap(segmentVertices));
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lines.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    this.lines.count = vertices.length / 11;
    this.labeled = [
      ...RINGS_M.map((radius) => ({ place: [radius, 0, ground], text: `${radius} m`, name: "ring" })),
      ...boxes.map(({ class: class_, score, color, box: [x, y, z, , , height] }) => ({
        place: [x, y, z + height / 2 + 0.3],
        text: `${class_} ${score.toFixed(2)}`,
        color,
      })),
    ];
    this.labels.replaceChildren(...this.labeled.map(label));
    this.redraw();
  }

  /** Look at a place on the ground, metres, from nearby. */
  lookAt([x, y]) {
    this.camera.target = [x, y, -1];
    this.camera.distance = Math.min(this.camera.distance, 22);
    this.redraw();
  }

  redraw() {
    this.pending ??= requestAnimationFrame(() => {
      this.pending = undefined;
      this.draw();
    });
  }

  draw() {
    const { gl, canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.059, 0.078, 0.102, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const matrix = this.camera.matrix(width / Math.max(height, 1));
    this.drawArrays(this.points, gl.POINTS, matrix, { ratio: [ratio], ...this.heights }, { point: 4 });
    const ofLines = { size: [canvas.width, canvas.height], width: [2 * ratio] };
    this.drawArrays(this.lines, gl.TRIANGLES, matrix, ofLines, { place: 3, other: 3, side: 1, tint: 4 });
    this.placeLabels(matrix, width, height);
  }

  /** Draw a buffer of interleaved attributes, given by name and number of floats. */
  drawArrays({ program: shader, buffer, count }, mode, matrix, uniforms, attributes) {
    const { gl } = this;
    gl.useProgram(shader);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.uniformMatrix4fv(gl.getUniformLocation(shader, "matrix"), false, matrix);
    for (const [name, value] of Object.entries(uniforms)) {
      const size = name === "ramp" ? 3 : value.length; // an array of colors
      gl[`uniform${size}fv`](gl.getUniformLocation(shader, name), value);
    }
    const stride = 4 * Object.values(attributes).reduce((sum, size) => sum + size, 0);
    let offset = 0;
    for (const [name, size] of Object.entries(attributes)) {
      const place = gl.getAttribLocation(shader, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, stride, offset);
      offset += 4 * size;
    }
    gl.drawArrays(mode, 0, count);
  }

  placeLabels(matrix, width, height) {
    this.labeled.forEach(({ place }, index) => {
      const at = project(matrix, place, width, height);
      const { style } = this.labels.children[index];
      style.display = at ? "" : "none";
      if (at) style.transform = `translate(${at[0].toFixed(1)}px, ${at[1].toFixed(1)}px) translate(-50%, -100%)`;
    });
  }

  listen() {
    const { canvas, camera } = this;
    const pointers = new Map();
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      const here = [event.clientX, event.clientY];
      if (other) camera.zoom(distance(before, other) / Math.max(distance(here, other), 1));
      else if (event.shiftKey || event.buttons !== 1) camera.move(dx, dy);
      else camera.turn(dx, dy);
      pointers.set(event.pointerId, here);
      this.redraw();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      camera.zoom(Math.exp(event.deltaY * 0.001));
      this.redraw();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => {
      camera.reset();
      this.redraw();
    });
  }
}

/** A color of red, green, blue 0..1 as CSS writes it. */
export function cssColor(color) {
  return `rgb(${color.map((value) => Math.round(value * 255)).join(" ")})`;
}

/** The height (m) that a tenth of the points lie below, as NumPy's percentile has it; 0 without points. */
export function groundHeight(points) {
  const heights = Float32Array.from({ length: points.length / 4 }, (_, row) => points[4 * row + 2]).sort();
  if (heights.length === 0) return 0;
  const place = GROUND_SHARE * (heights.length - 1);
  const low = Math.floor(place);
  return heights[low] + (place - low) * (heights[Math.min(low + 1, heights.length - 1)] - heights[low]);
}

function distance([x0, y0], [x1, y1]) {
  return Math.hypot(x1 - x0, y1 - y0);
}

/** The HTML of a label. */
function label({ text, color, name = "" }) {
  const span = Object.assign(document.createElement("span"), { textContent: text, className: name });
  if (color) span.style.color = cssColor(color);
  return span;
}

/** Rings around the sensor on the ground, and a line straight ahead. */
function rings(ground) {
  const steps = 96;
  const at = (radius, step) => {
    const angle = (step / steps) * 2 * Math.PI;
    return [radius * Math.cos(angle), radius * Math.sin(angle), ground];
  };
  const circles = RINGS_M.flatMap((radius) =>
    Array.from({ length: steps }, (_, step) => [at(radius, step), at(radius, step + 1), RING_COLOR]),
  );
  return [...circles, [[0, 0, ground], [RINGS_M.at(-1), 0, ground], RING_COLOR]];
}

/** The twelve edges of a box, and an arrow on its roof that shows the heading. */
function boxSegments({ box, color }) {
  const [x, y, z, length, , height, yaw] = box;
  const tint = [...color, 1];
  const floor = corners(box).map(([cx, cy]) => [cx, cy, z - height / 2]);
  const places = [...floor, ...floor.map(([cx, cy]) => [cx, cy, z + height / 2])];
  const nose = [x + Math.cos(yaw) * length * 0.5, y + Math.sin(yaw) * length * 0.5, z + height / 2];
  const tip = [x + Math.cos(yaw) * (length * 0.5 + 0.8), y + Math.sin(yaw) * (length * 0.5 + 0.8), z + height / 2];
  return [...EDGES.map(([a, b]) => [places[a], places[b], tint]), [nose, tip, tint]];
}

/** Two triangles of eleven numbers a vertex: place, other end, side, color. */
function segmentVertices([start, end, color]) {
  // Seen from the other end, left is right: so the sides of the end's vertices are the other way round.
  const vertex = (place, other, side) => [...place, ...other, side, ...color];
  const [a, b, c, d] = [vertex(start, end, 1), vertex(start, end, -1), vertex(end, start, 1), vertex(end, start, -1)];
  return [...a, ...b, ...d, ...b, ...c, ...d];
}

function program(gl, { vertex, fragment }) {
  const linked = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(linked));
  return linked;
}
