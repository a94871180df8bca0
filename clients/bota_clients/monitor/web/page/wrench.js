// The wrench as two arrows beside the sensor's axes: a parallel projection on a plain canvas.

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
    canvas.width = Math.round(width * ratio); // this clears it
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.lineCap = pen.lineJoin = "round";
    this.center = [width / 2, height / 2];
    this.unit = Math.min(width / 2.3, height / 2.2);
    pen.font = `600 ${Math.max(11, this.unit * 0.11)}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const [name, axis] of [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]]) {
      this.#arrow(pen, axis.map((v) => v * 0.62), colors[name], 1.5, 0);
      pen.fillText(name, ...this.#project(axis.map((v) => v * 0.7)));
    }
    return [[force, colors.ink, 1], [torque, colors.torque, 2]].map(([vector, color, heads], i) => {
      const size = vector ? Math.hypot(...vector) : NaN;
      const full = fit(this.full[i], Number.isFinite(size) ? size : 0, units[i]);
      this.full[i] = full;
      if (size > full * 0.01) this.#arrow(pen, vector.map((v) => v / full), color, Math.max(3, this.unit * 0.035), heads);
      return full;
    });
  }

  #project([x, y, z]) {
    const across = x * Math.cos(this.yaw) - y * Math.sin(this.yaw);
    const away = x * Math.sin(this.yaw) + y * Math.cos(this.yaw);
    const up = z * Math.cos(this.pitch) + away * Math.sin(this.pitch);
    return [this.center[0] + this.unit * across, this.center[1] - this.unit * up];
  }

  /** From the center; a torque has two heads, as is usual. */
  #arrow(pen, vector, color, width, heads) {
    const [x0, y0] = this.center;
    const [x1, y1] = this.#project(vector);
    const length = Math.hypot(x1 - x0, y1 - y0);
    const [dx, dy] = length ? [(x1 - x0) / length, (y1 - y0) / length] : [0, -1];
    const head = Math.min(Math.max(11, this.unit * 0.12), length * 0.6);
    pen.strokeStyle = pen.fillStyle = color;
    pen.lineWidth = width;
    pen.beginPath();
    pen.moveTo(x0, y0);
    pen.lineTo(x1 - (heads ? dx * head * 0.8 : 0), y1 - (heads ? dy * head * 0.8 : 0));
    pen.stroke();
    for (let i = 0; i < heads; i++) {
      const [tx, ty] = [x1 - dx * i * head * 0.85, y1 - dy * i * head * 0.85];
      pen.beginPath();
      pen.moveTo(tx, ty);
      pen.lineTo(tx - dx * head - dy * head * 0.5, ty - dy * head + dx * head * 0.5);
      pen.lineTo(tx - dx * head + dy * head * 0.5, ty - dy * head - dx * head * 0.5);
      pen.fill();
    }
  }
}
