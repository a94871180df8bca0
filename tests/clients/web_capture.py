"""The picture of the browser page in docs/monitor.md, which carries a digest of the page that it shows.

    python -m tests.clients.web_capture

makes it again; it needs Chromium.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from pathlib import Path
from typing import Final

from PIL import Image, PngImagePlugin

from bota_clients.monitor.web.server import read_page
from tests.clients import monitor_states as made
from tests.clients.devtools import browser
from tests.clients.monitor_states import RATE_HZ, frame, now
from tests.clients.report_capture import digest_in
from tests.clients.web_pages import Web

PICTURE: Final = Path(__file__).resolve().parents[2] / "docs" / "web.png"
AGAIN: Final = "make it again: python -m tests.clients.web_capture"
_WIDTH, _HEIGHT = 1180, 830
_COLORS: Final = 200
_SECONDS: Final = 10.5

__all__ = ["AGAIN", "PICTURE", "digest", "digest_in"]


def digest() -> str:
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


def make(picture: Path) -> None:
    """Draw the picture."""
    web = Web()
    with tempfile.TemporaryDirectory() as scratch, web.serving(), browser(Path(scratch)) as page:
        page.size(_WIDTH, _HEIGHT, dark=True)
        page.open(f"{web.origin}/#token={web.hub.token}")
        page.wait_for("document.querySelector('#identity')?.innerText.includes('Sensor 0')")
        _feed(web)
        page.wait_for("document.querySelector('[data-axis=Fx]').innerText.includes('.')")
        page.wait_for(f"document.querySelector('#force').plot.data[0].length > {_SECONDS * 190}")
        page.wait_for("document.querySelector('#link').innerText.includes('connected 10 s')")
        page.click("#pause")
        page.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        drawn = Path(scratch) / "drawn.png"
        page.screenshot(drawn)
        if page.complaints:
            sys.exit(f"Chromium's console said: {page.complaints}")
        notes = PngImagePlugin.PngInfo()
        notes.add_text("Source", digest())
        with Image.open(drawn) as image:
            whole = image.convert("RGB")
            few = whole.quantize(_COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            few.save(picture, optimize=True, pnginfo=notes)


if __name__ == "__main__":
    make(PICTURE)
