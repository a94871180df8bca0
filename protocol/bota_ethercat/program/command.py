# SPDX-License-Identifier: Apache-2.0
"""Commands in messages, as they work where this program runs."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Final

_SUDO_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"  # as Debian sets it


def command(row: str) -> str:
    """A row with a command line of one of the programs, as it works where this one runs.

    With the path of the program unless it is on PATH, or for sudo on that of sudo.
    """
    rest = row.removeprefix("sudo ")
    before, name = row[: -len(rest)], rest.split(" ")[0]
    for beside in (sys.argv[0], sys.executable):
        path = Path(beside).absolute().with_name(name)
        if not shutil.which(name, path=_SUDO_PATH if before else None) and os.access(path, os.X_OK):
            return before + shlex.quote(str(path)) + rest[len(name) :]
    return row
