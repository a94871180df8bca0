"""The page's style sheet: light, dark, narrow and on paper. Colours of the plots are variables here."""

from __future__ import annotations

from typing import Final

# Axis colours differ in lightness as well as hue (after Okabe and Ito) and are never the only difference.
_LIGHT: Final = """
  --paper: #ffffff; --ink: #1b1f24; --muted: #5b6570; --grid: #e3e7eb; --raised: #f5f7f9;
  --x: #c44601; --y: #00795c; --z: #1763c6; --plain: #5d7896; --limit: #7a3e9d;
  --good: #14713d; --warn: #8a5a00; --bad: #b3201b;
"""
_DARK: Final = """
  --paper: #14181d; --ink: #e6e9ec; --muted: #9aa5b0; --grid: #2b333c; --raised: #1c2229;
  --x: #ff9a57; --y: #3fd0a4; --z: #79b4ff; --plain: #8fabc9; --limit: #cfa0ee;
  --good: #5fd08c; --warn: #f0b848; --bad: #ff8078;
"""

CSS: Final = f"""
:root {{ color-scheme: light dark; --font: system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;{_LIGHT}}}
@media screen and (prefers-color-scheme: dark) {{ :root {{{_DARK}}} }}
* {{ box-sizing: border-box; }}
body {{ margin: 0 auto; padding: 1.5rem 1.25rem 4rem; max-width: 62rem;
  background: var(--paper); color: var(--ink); font: 1rem/1.5 var(--font); overflow-wrap: break-word; }}
h1 {{ font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; }}
h2 {{ font-size: 1.25rem; margin: 2.5rem 0 .5rem; padding-bottom: .25rem;
  border-bottom: 1px solid var(--grid); }}
h3 {{ font-size: 1.05rem; margin: 1.75rem 0 .25rem; }}
p {{ margin: .4rem 0; max-width: 48rem; }}
.sub, figcaption, .hint {{ color: var(--muted); font-size: .875rem; }}
.verdict {{ margin: 1.25rem 0; padding: .9rem 1.1rem; border: 1px solid var(--grid);
  border-left: .5rem solid var(--tone); background: var(--raised); border-radius: .25rem; }}
.verdict strong {{ display: block; font-size: 1.35rem; color: var(--tone); }}
.verdict p {{ margin: .2rem 0 0; }}
.ok {{ --tone: var(--good); }} .fault {{ --tone: var(--bad); }} .attention {{ --tone: var(--warn); }}
.not-possible, .not-applicable {{ --tone: var(--muted); }}
.level {{ white-space: nowrap; font-weight: 600; color: var(--tone); overflow-wrap: normal; }}
.level b {{ display: inline-block; width: 1.25em; text-align: center; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; width: 100%; margin: .75rem 0; font-size: .925rem; }}
caption {{ text-align: left; color: var(--muted); font-size: .875rem; padding-bottom: .25rem; }}
th, td {{ text-align: left; vertical-align: top; padding: .4rem .75rem .4rem 0;
  border-bottom: 1px solid var(--grid); }}
td {{ overflow-wrap: anywhere; }} .facts td {{ min-width: 12rem; }}
thead th {{ color: var(--muted); font-weight: 600; font-size: .85rem; }}
tbody th {{ font-weight: 500; }}
td.number, th.number {{ text-align: right; padding-right: 1.75rem; white-space: nowrap;
  font-variant-numeric: tabular-nums; overflow-wrap: normal; }}
table.facts {{ width: auto; }}
table.facts th {{ color: var(--muted); font-weight: 500; padding-right: 1.5rem; white-space: nowrap; }}
figure {{ margin: .75rem 0 1.25rem; }}
figure svg {{ display: block; width: 100%; height: auto; }}
figure svg * {{ stroke-linejoin: round; stroke-linecap: butt; }}
nav ul {{ padding-left: 1.2rem; }} a {{ color: var(--z); }}
article + article {{ margin-top: 4rem; border-top: 3px solid var(--grid); padding-top: 1.5rem; }}
footer {{ margin-top: 3rem; color: var(--muted); font-size: .875rem; }}
@page {{ margin: 14mm 13mm; }}
@media print {{
  :root {{ color-scheme: light; }}
  :root {{ font-size: 9pt; }}
  body {{ max-width: none; padding: 0; }}
  h2, h3, caption {{ break-after: avoid; }}
  figure, tr, .verdict, .keep {{ break-inside: avoid; }}
  figure svg {{ max-height: 105mm; }}
  .wide {{ overflow: visible; }}
  article + article {{ break-before: page; border: 0; }}
  .verdict, * {{ print-color-adjust: exact; -webkit-print-color-adjust: exact; }}
  nav {{ display: none; }}
}}
"""
