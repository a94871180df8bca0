"""The pictures in docs/ of monitor and report, each able to tell whether it is still of what it shows.

    python -m tests.clients.pictures report.png web.png

makes those of the terminal again, and those named, or both; they need Chromium. A picture carries a digest of
the page that it shows, for a report without what another version of Matplotlib may draw otherwise.
"""

from __future__ import annotations

import hashlib
import io
import re
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from PIL import Image, PngImagePlugin
from rich.console import Console
from rich.text import Text

from bota_clients.monitor.model import State
from bota_clients.monitor.screen import Look
from bota_clients.monitor.screen import render as render_screen
from bota_clients.monitor.web.server import read_page
from bota_clients.report.checks import Examination
from bota_clients.report.page import render
from tests.clients import monitor_states as made
from tests.clients.devtools import browser
from tests.clients.monitor_states import RATE_HZ, frame, now
from tests.clients.simulated import sensor
from tests.clients.web_pages import Web

DOCS: Final = Path(__file__).resolve().parents[2] / "docs"
AGAIN: Final = "make it again: python -m tests.clients.pictures"
_KEY: Final = "Source"
_SECONDS: Final = 10.5  # of the web page's traces


def digest_in(name: str) -> str:
    """What the picture says it was made from."""
    with Image.open(DOCS / name) as image:
        return str(image.info.get(_KEY))


def _keep(drawn: Path, name: str, source: str, colors: int, said: object) -> None:
    """Keep what was drawn as the picture of `source`, unless Chromium's console `said` something."""
    if said:
        sys.exit(f"Chromium's console said: {said}")
    notes = PngImagePlugin.PngInfo()
    notes.add_text(_KEY, source)
    with Image.open(drawn) as image:
        few = image.convert("RGB").quantize(colors, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(DOCS / name, optimize=True, pnginfo=notes)


def report_page() -> str:
    """A report on a noisy axis, and some samples lost."""
    noisy = sensor(12, "noise force.y 0.6", "skip 0.3", seed=12)
    return render([Examination(noisy)], made="2026-01-01 00:01 UTC", program="ethercat-report")


def report_digest(page: str) -> str:
    """Of everything but the lines of the plots: their texts count, and the style sheet."""

    def texts(match: re.Match[str]) -> str:
        return " ".join(re.findall(r"<(?:title|desc|text)\b[^>]*>([^<]*)<", match[0]))

    return hashlib.sha256(re.sub(r"<svg.*?</svg>", texts, page, flags=re.DOTALL).encode()).hexdigest()


def draw_report(name: str, scratch: Path) -> None:
    text, source = report_page(), scratch / "report.html"
    source.write_text(text, encoding="utf-8")
    with browser(scratch) as page:
        page.size(960, 3480)
        page.open(source.as_uri())
        page.screenshot(scratch / "drawn.png")
        _keep(scratch / "drawn.png", name, report_digest(text), 160, page.complaints)


def web_digest() -> str:
    """Of all files of the page."""
    found = hashlib.sha256()
    for path, (body, _) in sorted(read_page().items()):
        found.update(path.encode() + b"\0" + body)
    return found.hexdigest()


def _feed(web: Web) -> None:
    count = round(_SECONDS * RATE_HZ)
    web.model.take_status(made.status(), now(count - 1 - RATE_HZ))
    for first in range(0, count, 40):
        frames = [frame(k, {**made.moving(k), "warnings": 8} if k == 3000 else None)
                  for k in range(first, first + 40)]  # fmt: skip
        web.feed(*frames)
        web.model.note_age(frames[-1], frames[-1].monotonic_ns + 190_000 + first * first % 61_000)
    web.model.take_status(made.status(sent=RATE_HZ), web.now_s)


def draw_web(name: str, scratch: Path) -> None:
    web = Web()
    with web.serving(), browser(scratch) as page:
        page.size(1180, 830, dark=True)
        page.open(f"{web.origin}/#token={web.hub.token}")
        page.wait_for("document.querySelector('#identity')?.innerText.includes('Sensor 0')")
        _feed(web)
        page.wait_for("document.querySelector('[data-axis=Fx]').innerText.includes('.')")
        page.wait_for(f"document.querySelector('#force').plot.data[0].length > {_SECONDS * 190}")
        page.wait_for("document.querySelector('#link').innerText.includes('connected 10 s')")
        page.click("#pause")
        page.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        page.screenshot(scratch / "drawn.png")
        _keep(scratch / "drawn.png", name, web_digest(), 200, page.complaints)


def svg(state: State, look: Look, width: int, height: int) -> str:
    console = Console(
        width=width, height=height, record=True, file=io.StringIO(), force_terminal=True,
        color_system="truecolor", legacy_windows=False, _environ={},
    )  # fmt: skip
    head, body, foot = render_screen(state, look, width)
    room = height - len(head) - len(foot)
    for row in [*head, *body[:room], *[Text()] * (room - len(body)), *foot]:
        console.print(row, soft_wrap=True)
    return console.export_svg(title="ethercat-monitor", unique_id="monitor")


def captures() -> Mapping[str, str]:
    """The terminal's view: name of the file to what it holds."""
    return {
        "monitor.svg": svg(made.healthy(), Look(recording="REC 42 s"), 80, 24),
        "monitor-warnings.svg": svg(made.troubled(), Look(), 80, 24),
        "monitor-gone.svg": svg(made.gone(), Look(), 60, 15),
    }


if __name__ == "__main__":
    for file, drawing in captures().items():
        (DOCS / file).write_text(drawing)
    for each in sys.argv[1:] or ["report.png", "web.png"]:
        with tempfile.TemporaryDirectory() as folder:
            (draw_web if each == "web.png" else draw_report)(each, Path(folder))
