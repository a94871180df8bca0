// Puts the page together: what comes over the link goes into traces, readings, arrows and cards.

import { byId, dark, element, fill, setText } from "./dom.js";
import { Link } from "./link.js";
import { GROUPS, History, Trace } from "./traces.js";
import { Wrench } from "./wrench.js";

const SPANS_S = [5, 10, 30, 60];
const READ_MS = 200;
const DRAW_MS = 40;

const history = new History();
const traces = GROUPS.map((group) => new Trace(group));
const wrench = new Wrench(byId("wrench"));
let paused = null;
let span = 10;
let newest = null;
let sensor = null;
let control = false;
let refused = null;
let troubles = { link: "not connected yet", server: null };
let drawn = 0;
let read = 0;

byId("traces").append(...traces.map((trace) => trace.card));
traces.forEach((trace) => trace.start());

const link = new Link({
  points(batch) {
    if (batch.points !== link.sensor) return;
    history.add(batch, sensor?.nominal_hz ? 1 / sensor.nominal_hz : 0.01);
    newest = batch.newest;
  },
  state: showState,
  reply(message) {
    control = message.control;
    refused = message.refused;
    showMessage(null);
    showControl();
  },
  trouble(text) {
    if (text && !link.connected) control = false;
    troubles.link = text;
    showControl();
    showTrouble();
  },
});

// What the server is, in words that it gives.

function showState(state) {
  const { address, message } = state;
  troubles.server = state.trouble;
  sensor = state.sensor;
  setText(byId("link").lastElementChild, `${address} ${state.link}`);
  if (!sensor && state.sensors.length) choose(state.sensors[0].position);
  if (sensor) showSensor(sensor);
  fill(byId("sensors"), [state.sensors, link.sensor], ([sensors, shown]) => sensors.map((each) => {
    const button = element("button", { type: "button", "aria-pressed": each.position === shown, class: each.ok === false ? "bad" : "" },
      each.ok === null ? `${each.position}` : `${each.position} ${each.ok ? "ok" : "error"}`);
    button.title = each.name;
    button.addEventListener("click", () => choose(each.position));
    return button;
  }));
  byId("sensors").hidden = state.sensors.length < 2;
  const rows = [...state.server, ...state.clients.map((client, i) => [i ? "" : "Clients", client])];
  fill(byId("server").lastElementChild, rows, pairs);
  fill(byId("events").lastElementChild, state.events, (events) => events.map((text) => element("li", {}, text)).reverse());
  byId("events").hidden = !state.events.length;
  showMessage(message);
  showControl();
  showTrouble();
}

function showSensor(found) {
  setText(byId("identity"), found.identity);
  fill(byId("warnings").lastElementChild, [found.alerts, found.has_sample], warnings);
  const present = found.alerts.filter((alert) => alert.present);
  const bad = present.some((alert) => alert.severity === "trouble");
  byId("warnings").classList.toggle("bad", bad);
  byId("warnings").classList.toggle("warn", present.length > 0 && !bad);
  fill(byId("stream").lastElementChild, found.stream, pairs);
  fill(byId("lost").lastElementChild, found.losses, (losses) =>
    losses.map(([text, bad]) => element("li", { class: bad ? "bad" : "" }, text)));
  fill(byId("settings").querySelector("dl"), found.settings, (settings) => settings.flatMap(([name, value, meaning]) => [
    element("dt", {}, ...broken(name)), element("dd", {}, element("b", {}, value), element("small", {}, meaning))]));
  for (const trace of traces) {
    const { group } = trace;
    if (!group.imu) {
      const i = group.id === "force" ? 0 : 1;
      trace.unit = found.units[i];
      trace.digits = trace.unit === "counts" ? 0 : group.digits;
      setText(trace.unitText, trace.unit);
    }
    trace.card.classList.toggle("off", Boolean(group.imu && found.imu_off));
    for (const reading of trace.readings) {
      const range = found.peaks?.[reading.axis];
      setText(reading.peaks, range ? range.map((value) => value === null ? "--" : value.toFixed(trace.digits).replace("-", "−")).join(" … ") : "");
      reading.row.classList.toggle("saturated", found.saturated.includes(reading.axis));
    }
  }
}

/** A name that may be broken after an underscore. */
const broken = (name) => name.split(/(?<=_)/).flatMap((part) => [part, element("wbr", {})]);

const pairs = (rows) => rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]);

function warnings([alerts, hasSample]) {
  if (!alerts.length) return [element("p", { class: "none" }, hasSample ? "none" : "no sample yet")];
  return alerts.map((alert) => element("div", { class: `alert ${alert.severity} ${alert.present ? "present" : "past"}` },
    element("p", {}, element("b", {}, alert.level), ` ${alert.when}: ${alert.text}`),
    element("p", { class: "remedy" }, alert.remedy)));
}

function showTrouble() {
  const text = troubles.link ? `Connection lost: ${troubles.link}; reconnecting`
    : troubles.server ? `Server ${troubles.server}` : null;
  const old = !text && sensor?.old ? `No new sample for ${sensor.old}: these values are old` : null;
  byId("trouble").hidden = !text && !old;
  setText(byId("trouble"), text ?? old ?? "");
  document.body.classList.toggle("stale", Boolean(text || old || !sensor?.has_sample));
  if (troubles.link) setText(byId("link").lastElementChild, "connection lost");
  document.title = `${text || old ? "✗ " : ""}${sensor ? `Sensor ${sensor.position} – ` : ""}ethercat-monitor`;
  byId("link").className = text ? "bad" : old ? "warn" : "good";
}

/** What the monitor last said; a token that it refused stays. */
function showMessage(message) {
  const said = refused ? { text: refused, bad: true } : message;
  byId("message").hidden = !said;
  byId("message").classList.toggle("bad", Boolean(said?.bad));
  setText(byId("message"), said?.text ?? "");
}

// What people do.

function choose(position) {
  history.clear();
  newest = null;
  link.select(position);
}

function showControl() {
  for (const button of [byId("tare"), byId("reset")]) {
    button.disabled = !(control && sensor && !troubles.link && !troubles.server);
    button.title = control ? "" : "Only in a page opened by the link that ethercat-monitor printed";
  }
}

byId("spans").append(...SPANS_S.map((seconds) => {
  const button = element("button", { type: "button", "aria-pressed": seconds === span }, `${seconds} s`);
  button.addEventListener("click", () => {
    span = seconds;
    for (const other of byId("spans").children) other.setAttribute("aria-pressed", other === button);
    for (const trace of traces) trace.span = seconds;
    drawn = 0;
  });
  return button;
}));

byId("pause").addEventListener("click", () => {
  paused = paused ? null : { history: history.copy(), edge: history.edge() };
  for (const trace of traces) trace.read(newest);
  setText(byId("pause"), paused ? "Resume" : "Pause");
  byId("pause").setAttribute("aria-pressed", Boolean(paused));
});

byId("reset").addEventListener("click", () => link.send({ do: "reset" }));
byId("tare").addEventListener("click", () => {
  byId("ask").dataset.sensor = link.sensor;
  byId("ask").firstElementChild.textContent = `Tare sensor ${link.sensor}? Its reading becomes zero. Keep it stationary.`;
  byId("ask").showModal();
});
byId("ask").addEventListener("click", ({ target }) => {
  if (!target.value) return;
  if (target.value !== "no") link.send({ do: target.value, sensor: Number(byId("ask").dataset.sensor) });
  byId("ask").close();
});

// The token comes behind the # of the link, which no request carries, and does not stay in the address.
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  let token = given;
  try {
    if (given) sessionStorage.setItem("token", given);
    else token = sessionStorage.getItem("token");
  } catch { /* then it lasts until the page is loaded again */ }
  if (given) window.history.replaceState(null, "", location.pathname);
  if (token) link.show(token);
}

addEventListener("hashchange", takeToken);
takeToken();
showControl();

// Drawing: as often as a trace moves by a pixel, at most 25 times a second.

function frame(now) {
  requestAnimationFrame(frame);
  const width = traces[0].box.clientWidth || 300;
  const edge = paused ? paused.edge : history.edge();
  if (edge !== null && now - drawn >= Math.max(DRAW_MS, (span / width) * 1000) - 4) {
    drawn = now;
    for (const trace of traces) trace.draw(paused?.history ?? history, edge);
    if (!paused) arrows();
  }
  if (!paused && now - read >= READ_MS) {
    read = now;
    for (const trace of traces) trace.read(newest);
  }
}

function arrows() {
  const units = [traces[0].unit, traces[1].unit];
  const vectors = newest ? [newest.slice(0, 3), newest.slice(3, 6)].map((vector) => vector.map((v) => v ?? NaN)) : [null, null];
  const full = wrench.draw(...vectors, units);
  ["force", "torque"].forEach((name, i) => {
    const size = vectors[i] ? Math.hypot(...vectors[i]).toFixed(traces[i].digits) : "--";
    setText(byId(`${name}-length`), `${size} ${units[i]} (full arrow ${full[i]} ${units[i]})`);
  });
}

dark.addEventListener("change", () => {
  drawn = 0;
  for (const trace of traces) trace.plot.redraw();
});
wrench.draw(null, null, ["N", "Nm"]);
requestAnimationFrame(frame);
