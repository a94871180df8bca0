"""The picture in docs/report.md: made from a fixed recording, and able to tell whether it is still that.

    python -m tests.clients.report_capture

makes it again. The picture carries a digest of the page that it shows, less what another version of
Matplotlib may draw otherwise.
"""

from __future__ import annotations

import contextlib
import hashlib
import html
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from unittest import mock

from PIL import Image, PngImagePlugin

from bota_clients.report import plots
from bota_clients.report.checks import examine
from bota_clients.report.page import render
from tests.clients import chromium
from tests.clients.simulated import sensor

PICTURE: Final = Path(__file__).resolve().parents[2] / "docs" / "report.png"
AGAIN: Final = "make it again: python -m tests.clients.report_capture"
_KEY: Final = "Source"
_WIDTH, _HEIGHT = 960, 3480
_COLORS: Final = 160


def fixed_page() -> str:
    """The page of the picture: a noisy axis, and some samples lost."""
    noisy = sensor(12, "noise force.y 0.6", "skip 0.3", seed=12)
    return render([examine(noisy)], made="2026-01-01 00:01 UTC", program="ethercat-report")


@contextlib.contextmanager
def undrawn() -> Iterator[None]:
    """Pages without lines in their plots, which take a second each."""

    def draw(_name: str, title: str, description: str, *_: object) -> str:
        return f"<svg><title>{html.escape(title)}</title><desc>{html.escape(description)}</desc></svg>"

    with mock.patch.object(plots, "draw", draw), mock.patch.object(plots, "draw", draw):
        yield


def digest(page: str) -> str:
    """Of everything but the lines of the plots: their texts count, and the style sheet."""

    def texts(match: re.Match[str]) -> str:
        return " ".join(re.findall(r"<(?:title|desc|text)\b[^>]*>([^<]*)<", match[0]))

    return hashlib.sha256(re.sub(r"<svg.*?</svg>", texts, page, flags=re.DOTALL).encode()).hexdigest()


def digest_in(picture: Path) -> str:
    """What the picture says it was made from."""
    with Image.open(picture) as image:
        return str(image.info.get(_KEY))


def make(picture: Path) -> None:
    """Draw the picture."""
    page = fixed_page()
    with tempfile.TemporaryDirectory() as scratch:
        source, drawn = Path(scratch) / "report.html", Path(scratch) / "drawn.png"
        source.write_text(page, encoding="utf-8")
        said = chromium.screenshot(source, drawn, _WIDTH, _HEIGHT)
        if said:
            sys.exit(f"Chromium's console said: {said}")
        notes = PngImagePlugin.PngInfo()
        notes.add_text(_KEY, digest(page))
        with Image.open(drawn) as image:
            whole = image.convert("RGB")
            few = whole.quantize(_COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            few.save(picture, optimize=True, pnginfo=notes)


if __name__ == "__main__":
    make(PICTURE)
