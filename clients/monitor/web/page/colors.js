// The colors of the style sheet as a canvas needs them; renewed when the theme changes.

export const colors = {};

const NAMES = ["paper", "raised", "ink", "muted", "grid", "missed", "x", "y", "z", "torque"];

export function renew() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) colors[name] = style.getPropertyValue(`--${name}`).trim();
}

document.addEventListener("theme", renew);
renew();
