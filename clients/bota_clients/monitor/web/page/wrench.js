// The wrench as two arrows on a drawing of the sensor: a parallel projection on a plain canvas.

import { colors } from "./dom.js";

const LEAST = { N: 5, Nm: 0.2, counts: 1000 };

/** The length that an arrow of full size stands for: 1, 2 or 5 times a power of ten. It shrinks late, so as not to flicker. */
function fit(full, length, unit) {
  const wanted = Math.max(length, LEAST[unit] ?? 1);
  const power = 10 ** Math.floor(Math.log10(wanted));
  const nice = [1, 2, 5, 10].find((step) => step * power >= wanted * 0.999) * power;
  return nice > full || wanted < 0.15 * full ? nice : full;
}

export class Wrench {
  constructor(canvas) {
    this.canvas = canvas;
    this.yaw = -0.62;
    this.pitch = 0.42;
    this.full = [0, 0];
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.yaw += event.movementX * 0.01;
      this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + event.movementY * 0.01));
      this.#again();
    });
    new ResizeObserver(() => this.#again()).observe(canvas);
  }

  #again() {
    if (this.last) this.draw(...this.last);
  }

  /** Draw; the lengths that full arrows stand for. `force`, `torque`: three numbers each, or null. */
  draw(force, torque, units) {
    this.last = [force, torque, units];
    const { canvas } = this;
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineCap = pen.lineJoin = "round";
    this.center = [width / 2, height / 2];
    this.unit = Math.min(width / 2.3, height / 2.2);
    this.#body(pen);
    this.#axes(pen);
    return [[force, colors.ink, 0], [torque, colors.torque, 1]].map(([vector, color, i]) => {
      const size = vector ? Math.hypot(...vector) : 0;
      const full = fit(this.full[i], Number.isFinite(size) ? size : 0, units[i]);
      this.full[i] = full;
      if (vector && Number.isFinite(size) && size > full * 0.01) this.#arrow(pen, vector.map((v) => v / full), color, i === 1);
      return full;
    });
  }

  #project([x, y, z]) {
    const across = x * Math.cos(this.yaw) - y * Math.sin(this.yaw);
    const away = x * Math.sin(this.yaw) + y * Math.cos(this.yaw);
    const up = z * Math.cos(this.pitch) + away * Math.sin(this.pitch);
    return [this.center[0] + this.unit * across, this.center[1] - this.unit * up];
  }

  #path(pen, points) {
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.#project(point));
  }

  #circle(pen, radius, z) {
    this.#path(pen, Array.from({ length: 49 }, (_, i) => {
      const turn = (i * Math.PI) / 24;
      return [radius * Math.cos(turn), radius * Math.sin(turn), z];
    }));
  }

  #body(pen) {
    pen.lineWidth = 1.25;
    pen.strokeStyle = colors.muted;
    pen.fillStyle = colors.raised;
    const [radius, depth] = [0.36, -0.16];
    const far = this.pitch >= 0 ? [depth, 0] : [0, depth];
    this.#circle(pen, radius, far[0]);
    pen.fill();
    pen.stroke();
    const side = [Math.cos(-this.yaw) * radius, Math.sin(-this.yaw) * radius];
    this.#path(pen, [[...side, 0], [...side, depth], [-side[0], -side[1], depth], [-side[0], -side[1], 0]]);
    pen.fill();
    for (const sign of [1, -1]) {
      this.#path(pen, [[sign * side[0], sign * side[1], 0], [sign * side[0], sign * side[1], depth]]);
      pen.stroke();
    }
    this.#circle(pen, radius, far[1]);
    pen.fill();
    pen.stroke();
    pen.strokeStyle = colors.grid;
    this.#circle(pen, radius * 0.55, far[1]);
    pen.stroke();
  }

  #axes(pen) {
    pen.font = `600 ${Math.max(11, this.unit * 0.11)}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const [name, axis] of [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]]) {
      pen.strokeStyle = pen.fillStyle = colors[name];
      pen.lineWidth = 1.5;
      this.#path(pen, [[0, 0, 0], axis.map((v) => v * 0.62)]);
      pen.stroke();
      pen.fillText(name, ...this.#project(axis.map((v) => v * 0.7)));
    }
  }

  #arrow(pen, vector, color, twice) {
    const [x0, y0] = this.#project([0, 0, 0]);
    const [x1, y1] = this.#project(vector);
    const length = Math.hypot(x1 - x0, y1 - y0);
    pen.strokeStyle = pen.fillStyle = color;
    pen.lineWidth = Math.max(3, this.unit * 0.035);
    const [dx, dy] = length ? [(x1 - x0) / length, (y1 - y0) / length] : [0, -1];
    const head = Math.min(Math.max(11, this.unit * 0.12), length * 0.6);
    pen.beginPath();
    pen.moveTo(x0, y0);
    pen.lineTo(x1 - dx * head * 0.8, y1 - dy * head * 0.8);
    pen.stroke();
    for (let i = 0; i < (twice ? 2 : 1); i++) {
      const [tx, ty] = [x1 - dx * i * head * 0.85, y1 - dy * i * head * 0.85];
      pen.beginPath();
      pen.moveTo(tx, ty);
      pen.lineTo(tx - dx * head - dy * head * 0.5, ty - dy * head + dx * head * 0.5);
      pen.lineTo(tx - dx * head + dy * head * 0.5, ty - dy * head - dx * head * 0.5);
      pen.fill();
    }
  }
}
