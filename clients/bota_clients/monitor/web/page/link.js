// The connection to ethercat-monitor: comes back by itself, and notices silence.

const RETRY_MS = 1000;
const SILENT_MS = 1500;
const GIVEN_UP_MS = 5000;
const HEADER_BYTES = 16;
export const CHANNELS = 13;

/** The points of a message; clients/monitor/web/points.py says how they are laid out. */
export function decode(buffer) {
  const head = new DataView(buffer);
  const count = head.getUint16(2, true);
  const values = new Float32Array(buffer, HEADER_BYTES);
  const part = (index) => values.subarray(CHANNELS + index * count, CHANNELS + (index + 1) * count);
  const start = head.getFloat64(8, true);
  return {
    sensor: head.getUint8(1),
    skipped: head.getUint32(4, true) === 1,
    newest: values.subarray(0, CHANNELS),
    times: Float64Array.from(part(0), (after) => start + after),
    columns: Array.from({ length: CHANNELS }, (_, channel) => part(1 + channel)),
  };
}

/** Calls `on.state`, `on.points`, `on.reply` with messages and `on.trouble` with a text, or null. */
export class Link {
  constructor(on) {
    this.on = on;
    this.sensor = 0;
    this.token = null;
    setInterval(() => this.#watch(), 250);
    this.#open();
  }

  get connected() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  send(message) {
    if (this.connected) this.socket.send(JSON.stringify(message));
  }

  select(sensor) {
    this.sensor = sensor;
    this.send({ sensor });
  }

  show(token) {
    this.token = token;
    this.send({ token });
  }

  #open() {
    const socket = new WebSocket(`ws://${location.host}/stream`);
    this.socket = socket;
    this.heard = performance.now();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.send({ sensor: this.sensor });
      if (this.token) this.send({ token: this.token });
    };
    socket.onmessage = ({ data }) => this.socket === socket && this.#take(data);
    socket.onclose = ({ reason }) => {
      if (this.socket !== socket) return;
      this.on.trouble(reason || "ethercat-monitor does not answer: it has ended, or cannot be reached");
      setTimeout(() => this.#open(), RETRY_MS);
    };
  }

  #take(data) {
    this.heard = performance.now();
    if (data instanceof ArrayBuffer) {
      this.on.points(decode(data));
      return;
    }
    const message = JSON.parse(data);
    if ("state" in message) {
      this.send({ seen: message.state });
      this.on.trouble(null);
      this.on.state(message);
    } else this.on.reply(message);
  }

  #watch() {
    const silent = performance.now() - this.heard;
    if (!this.connected || silent < SILENT_MS) return;
    this.on.trouble(`nothing came from ethercat-monitor for ${Math.floor(silent / 1000)} s`);
    if (silent < GIVEN_UP_MS) return;
    const silentSocket = this.socket;
    this.#open();
    silentSocket.close();
  }
}
