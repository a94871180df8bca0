// The last minute of all channels, and the four plots of it.
/* global uPlot */

import { CHANNELS } from "./link.js";
import { colors, element } from "./dom.js";

const KEPT_S = 62;
const STEP_S = 0.01;
const BEHIND_S = 0.08; // the right edge is where there are points already
const LEAK = 0.02;

/** Times and values as uPlot wants them; a null is a gap. */
export class History {
  constructor() {
    this.clear();
  }

  clear() {
    this.times = [];
    this.columns = Array.from({ length: CHANNELS }, () => []);
    this.offset = null;
  }

  /** `period`: of the samples, in seconds. */
  add({ start, times, columns }, period) {
    let last = this.times.at(-1);
    if (start <= last) this.clear(); // another server, or a restarted machine
    times.forEach((after, i) => {
      if (start + after - last > 2.5 * Math.max(STEP_S, period)) {
        this.#push(last + 1e-4);
      }
      last = start + after;
      this.#push(last, columns, i);
    });
    const newest = this.times.at(-1);
    const offset = newest - performance.now() / 1000;
    this.offset = this.offset === null || offset > this.offset || this.offset - offset > 1
      ? offset : this.offset + LEAK * (offset - this.offset);
    if (newest - this.times[0] > KEPT_S + 5) this.#trim(newest - KEPT_S);
  }

  /** The time at the right edge; null without points. */
  edge() {
    return this.offset === null ? null : performance.now() / 1000 + this.offset - BEHIND_S;
  }

  copy() {
    return Object.assign(new History(), structuredClone({ ...this }));
  }

  #push(time, columns, i) {
    this.times.push(time);
    for (let channel = 0; channel < CHANNELS; channel++) {
      this.columns[channel].push(columns?.[channel][i] ?? null);
    }
  }

  #trim(before) {
    const count = this.times.findIndex((time) => time >= before);
    this.times.splice(0, count);
    for (const column of this.columns) column.splice(0, count);
  }
}

/** The kinds of traces: channels are those of a message. */
export const GROUPS = [
  { id: "force", title: "Force", axes: ["Fx", "Fy", "Fz"], first: 0, unit: "N", digits: 2, least: 1 },
  { id: "torque", title: "Torque", axes: ["Mx", "My", "Mz"], first: 3, unit: "Nm", digits: 3, least: 0.05 },
  { id: "acceleration", title: "Acceleration", axes: ["ax", "ay", "az"], first: 6, unit: "m/s²", digits: 2, least: 1, imu: true },
  { id: "angular-rate", title: "Angular rate", axes: ["ωx", "ωy", "ωz"], first: 9, unit: "rad/s", digits: 3, least: 0.1, imu: true },
];

export const signed = (value, digits) =>
  value === null || !Number.isFinite(value)
    ? "--"
    : `${value < 0 && Number(value.toFixed(digits)) !== 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

/** One plot with the readings of its axes. */
export class Trace {
  constructor(group) {
    this.group = group;
    this.unit = group.unit;
    this.digits = group.digits;
    this.span = 10;
    this.range = null;
    this.readings = group.axes.map((axis, i) => {
      const value = element("output", { "data-axis": axis });
      const peaks = element("small", {});
      return { axis, value, peaks, row: element("div", { class: `reading ${"xyz"[i]}` }, element("span", {}, axis), value, peaks) };
    });
    this.unitText = element("small", {}, group.unit);
    this.box = element("div", { class: "plot", role: "img", "aria-label": `${group.title} over time` });
    this.card = element("section", { id: group.id, class: "card trace" },
      element("div", { class: "head" }, element("h2", {}, `${group.title} `, this.unitText)),
      element("div", { class: "readings" }, ...this.readings.map(({ row }) => row)), this.box);
  }

  /** Once it is in the page. */
  start() {
    // Whole pixels: uPlot takes the digits before "px" and multiplies them by the device pixel ratio.
    const em = Math.round(0.78 * parseFloat(getComputedStyle(document.documentElement).fontSize));
    const axis = { stroke: colors.muted, font: `${em}px system-ui, sans-serif`,
      grid: { stroke: colors.grid, width: 1 }, ticks: { show: false } };
    this.plot = new uPlot({
      ...this.#size(), padding: [6, 8, 0, 0], legend: { show: false }, pxAlign: 0,
      cursor: { show: false },
      scales: { x: { time: false }, y: { range: (_, low, high) => this.#range(low, high) } },
      axes: [
        { ...axis, size: 2 * em, gap: 4, splits: () => this.#splits(),
          values: (u, at) => at.map((t) => { const s = Math.round(t - u.scales.x.max); return s ? `−${-s}` : "0 s"; }) },
        { ...axis, size: 4.4 * em, gap: 4, space: 2.6 * em,
          values: (_, at) => at.map((value) => String(Number(value.toPrecision(6))).replace("-", "−")) },
      ],
      series: [{}, ...["x", "y", "z"].map((name) => (
        { stroke: colors[name], width: 1, points: { show: false }, spanGaps: false }))],
    }, [[], [], [], []], this.box);
    new ResizeObserver(() => this.plot.setSize(this.#size())).observe(this.box);
  }

  /** Of force and torque: those of the sensor. */
  units(unit) {
    this.unit = unit ?? this.group.unit;
    this.digits = this.unit === "counts" ? 0 : this.group.digits;
    this.unitText.textContent = this.unit;
  }

  draw(history, edge) {
    const { first } = this.group;
    this.plot.batch(() => {
      this.plot.setData([history.times, ...history.columns.slice(first, first + 3)], false);
      this.plot.setScale("x", { min: edge - this.span, max: edge });
    });
  }

  read(newest) {
    this.readings.forEach(({ value }, i) => {
      value.textContent = newest ? signed(newest[this.group.first + i], this.digits) : "--";
    });
  }

  #size() {
    return { width: Math.max(80, this.box.clientWidth), height: Math.max(60, this.box.clientHeight) };
  }

  #splits() {
    const { max } = this.plot.scales.x;
    const step = [1, 2, 5, 10, 20].find((s) => this.span / s <= Math.max(2, this.box.clientWidth / 62)) ?? 30;
    return Array.from({ length: Math.floor(this.span / step) + 1 }, (_, i) => max - i * step).reverse();
  }

  /** Changes only if something does not fit, or would fit in half of it. */
  #range(low, high) {
    const { least } = this;
    if (low === null || !Number.isFinite(low) || !Number.isFinite(high)) return this.range ?? [-1, 1];
    const middle = (low + high) / 2;
    const half = Math.max((high - low) / 2, least / 2);
    const now = this.range;
    if (!now || low < now[0] || high > now[1] || half < 0.3 * (now[1] - now[0]) / 2)
      this.range = [middle - 1.2 * half, middle + 1.2 * half];
    return this.range;
  }

  get least() {
    return this.unit === "counts" ? 1000 : this.group.least;
  }
}
