// Runs the monitor's page in Node with a stub of a browser: `node page_in_node.mjs APP.js`, messages on standard input.
// Prints what then stands in the elements that have an id, and what the page sent.

import fs from "node:fs";
import { pathToFileURL } from "node:url";

class Element {
  constructor(tag) {
    Object.assign(this, { tag, children: [], dataset: {}, classList: { toggle() {} }, textContent: "", clientWidth: 300, clientHeight: 100 });
  }
  get lastElementChild() { return this.last ??= new Element("child"); }
  get firstElementChild() { return this.first ??= new Element("child"); }
  get text() { return [this.textContent, this.first?.text, this.last?.text, ...this.children.map((each) => each.text ?? each)].filter(Boolean).join(" "); }
  setAttribute(name, value) { this[name] = value; }
  append(...children) { this.children.push(...children); }
  replaceChildren(...children) { this.children = children; }
  addEventListener(name, act) { this[name] = act; }
  showModal() {}
  close() {}
}

const ids = {}, sent = [];
let frame, socket;
Object.assign(globalThis, {
  document: { getElementById: (id) => (ids[id] ??= new Element(id)), createElement: (tag) => new Element(tag),
    documentElement: new Element("html"), body: new Element("body") },
  getComputedStyle: () => ({ fontSize: "16px", getPropertyValue: () => "#000" }),
  ResizeObserver: class { observe() {} },
  location: { host: "localhost", hash: "#token=abc", pathname: "/" },
  sessionStorage: { setItem() {} },
  window: { history: { replaceState: (...to) => sent.push(`address ${to[2]}`) } },
  addEventListener() {},
  setInterval() {},
  requestAnimationFrame: (draw) => { frame = draw; },
  uPlot: class {
    constructor() { this.scales = { x: { max: 0 } }; }
    batch(act) { act(); }
    setData(data) { ids[`plot ${Object.keys(ids).length}`] = { text: String(data[0].length) }; }
    setScale() {}
  },
  WebSocket: class {
    static OPEN = 1;
    readyState = 1;
    constructor() { socket = this; }
    send(message) { sent.push(message); }
  },
});
await import(pathToFileURL(process.argv[2]));
socket.onopen();
for (const data of fs.readFileSync(0, "utf8").trim().split("\n")) socket.onmessage({ data });
frame(performance.now() + 1e6);
ids.record.click();
ids.tare.click();
ids.ask.click({ target: { value: "tare" } });
console.log(JSON.stringify({ sent, ...Object.fromEntries(Object.entries(ids).map(([id, each]) => [id, each.text])) }));
