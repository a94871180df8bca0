// Small helpers for the page's elements and colors. Texts are set as text: nothing that a sensor says becomes markup.

export const byId = (id) => document.getElementById(id);

export function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

/** Set the text if it is another one. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

const shown = new WeakMap();

/** Fill `node` with what `make` gives for `value`, if that is not what it shows. */
export function fill(node, value, make) {
  const text = JSON.stringify(value);
  if (shown.get(node) === text) return;
  shown.set(node, text);
  node.replaceChildren(...make(value));
}

/** The colors of the style sheet as a canvas needs them. */
const style = getComputedStyle(document.documentElement);
export const colors = Object.fromEntries(["muted", "grid", "x", "y", "z"].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
