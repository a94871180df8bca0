// Light or dark: as the system is, or as the button says. Before the first paint, so not a module.
"use strict";
{
  const system = matchMedia("(prefers-color-scheme: dark)");
  const root = document.documentElement;
  let chosen = null;
  try { chosen = localStorage.getItem("theme"); } catch { /* storage may be forbidden */ }

  const dark = () => (chosen ?? (system.matches ? "dark" : "light")) === "dark";

  function show() {
    root.dataset.theme = dark() ? "dark" : "light";
    document.dispatchEvent(new Event("theme"));
  }

  system.addEventListener("change", show);
  document.addEventListener("DOMContentLoaded", () => {
    document.getElementById("theme").addEventListener("click", () => {
      const other = dark() ? "light" : "dark";
      chosen = other === (system.matches ? "dark" : "light") ? null : other;
      try {
        if (chosen) localStorage.setItem("theme", chosen);
        else localStorage.removeItem("theme");
      } catch { /* then for this page only */ }
      show();
    });
  });
  show();
}
