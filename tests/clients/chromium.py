"""Chromium without a window: screenshots, paper, and what its console says."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

_NAMES: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PROGRAM: Final = next((found for name in _NAMES if (found := shutil.which(name))), None)
needs_chromium = pytest.mark.skipif(PROGRAM is None, reason="no Chromium here: apt install chromium")

DARK: Final = "--blink-settings=preferredColorScheme=0"


def run(page: Path, scratch: Path, *options: str) -> str:
    """What Chromium's console said while it showed `page`."""
    assert PROGRAM is not None
    always = (
        "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
        "--force-device-scale-factor=1", "--force-color-profile=srgb", "--enable-logging=stderr",
        f"--user-data-dir={scratch / 'chromium'}",
    )  # fmt: skip
    command = [PROGRAM, *always, *options, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return "\n".join(line for line in said if "source: chrome://" not in line)  # its own pages


def screenshot(page: Path, picture: Path, width: int, height: int, *options: str) -> str:
    """Draw `page` into the PNG `picture`; what the console said."""
    said = run(page, picture.parent, f"--screenshot={picture}", f"--window-size={width},{height}", *options)
    assert picture.exists(), "Chromium drew nothing"
    return said
