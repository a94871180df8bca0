// The connection to ethercat-monitor: comes back by itself, and notices silence.

const RETRY_MS = 1000;
const SILENT_MS = 1500;
const GIVEN_UP_MS = 5000;
export const CHANNELS = 13;

/** Calls `on.state`, `on.points`, `on.anew` (see monitor/web/pages.py), `on.reply` with messages and `on.trouble` with a text, or null. */
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
    const message = JSON.parse(data);
    if ("points" in message) this.on.points(message);
    else if ("anew" in message) this.on.anew();
    else if ("state" in message) {
      this.on.trouble(null);
      this.on.state(message.state);
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
