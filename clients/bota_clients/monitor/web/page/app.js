// Puts the page together: from the link into traces, readings and cards.

import { byId, element, fill, setText } from "./dom.js";
import { Link } from "./link.js";
import { GROUPS, History, signed, Trace } from "./traces.js";

const SPANS_S = [5, 10, 30, 60];
const READ_MS = 200;
const DRAW_MS = 40;

const history = new History();
const traces = GROUPS.map((group) => new Trace(group));
let paused = null;
let span = 10;
let newest = null, sensor = null, refused = null, control = false;
let troubles = { link: "not connected yet", server: null };
let drawn = 0, read = 0;

byId("traces").append(...traces.map((trace) => trace.card));
traces.forEach((trace) => trace.start());

const link = new Link({
  points(batch) {
    if (batch.points !== link.sensor) return;
    history.add(batch, sensor?.nominal_hz ? 1 / sensor.nominal_hz : 0.01);
    newest = batch.newest;
  },
  anew: () => history.clear(),
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

function showState(state) {
  troubles.server = state.trouble;
  sensor = state.sensors.find((each) => each.sensor === link.sensor) ?? null;
  setText(byId("link").lastElementChild, `${state.address} ${state.link}`);
  if (!sensor && state.sensors.length) choose(state.sensors[0].sensor);
  if (sensor) showSensor(sensor);
  fill(byId("sensors"), [state.sensors.map((each) => [each.sensor, each.name, each.verdict]), link.sensor], ([rows, shown]) =>
    rows.map(([position, name, verdict]) => {
      const button = element("button", { type: "button", "aria-pressed": position === shown, title: name,
        class: verdict === "trouble" ? "bad" : "" }, `${position} ${verdict === "trouble" ? "error" : "ok"}`);
      button.addEventListener("click", () => choose(position));
      return button;
    }));
  byId("sensors").hidden = state.sensors.length < 2;
  setText(byId("table"), state.table.join("\n"));
  setText(byId("record"), state.recording ? "Stop recording" : "Record");
  showMessage(state.message);
  showControl();
  showTrouble();
}

function showSensor(found) {
  setText(byId("identity"), found.identity);
  fill(byId("warnings").lastElementChild, [found.alerts, found.force !== null], warnings);
  const present = found.alerts.filter((alert) => alert.present);
  const bad = present.some((alert) => alert.severity === "trouble");
  byId("warnings").classList.toggle("bad", bad);
  byId("warnings").classList.toggle("warn", present.length > 0 && !bad);
  const peaks = [...found.force_min_max ?? [], ...found.torque_min_max ?? []];
  traces.forEach((trace, i) => {
    trace.units(found.units[i]);
    trace.card.classList.toggle("off", i > 1 && found.force !== null && found.acceleration === null);
    trace.readings.forEach((reading, axis) => {
      const range = peaks[3 * i + axis];
      setText(reading.peaks, range ? range.map((value) => signed(value, trace.digits)).join(" … ") : "");
      reading.row.classList.toggle("saturated", found.saturated.includes(reading.axis));
    });
  });
}

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
  document.body.classList.toggle("stale", Boolean(text || old || !sensor || sensor.force === null));
  if (troubles.link) setText(byId("link").lastElementChild, "connection lost");
  document.title = `${text || old ? "✗ " : ""}${sensor ? `Sensor ${sensor.sensor} – ` : ""}ethercat-monitor`;
  byId("link").className = text ? "bad" : old ? "warn" : "good";
}

/** What the monitor last said, or why it refused the token. */
function showMessage(message) {
  const said = refused ? { text: refused, bad: true } : message;
  byId("message").hidden = !said;
  byId("message").classList.toggle("bad", Boolean(said?.bad));
  setText(byId("message"), said?.text ?? "");
}

function choose(position) {
  history.clear();
  newest = null;
  link.select(position);
}

function showControl() {
  for (const id of ["tare", "reset", "record"]) {
    byId(id).disabled = !(control && !troubles.link && (id === "record" || (sensor && !troubles.server)));
    byId(id).title = control ? "" : "Only by the link that ethercat-monitor printed";
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

for (const id of ["reset", "record"]) byId(id).addEventListener("click", () => link.send({ do: id }));
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

// The token is behind the #, which no request carries, and leaves the address.
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

// Drawing: for each pixel of movement, at most 25 times a second.

function frame(now) {
  requestAnimationFrame(frame);
  const width = traces[0].box.clientWidth || 300;
  const edge = paused ? paused.edge : history.edge();
  if (edge !== null && now - drawn >= Math.max(DRAW_MS, (span / width) * 1000) - 4) {
    drawn = now;
    for (const trace of traces) trace.draw(paused?.history ?? history, edge);
  }
  if (!paused && now - read >= READ_MS) {
    read = now;
    for (const trace of traces) trace.read(newest);
  }
}

requestAnimationFrame(frame);
