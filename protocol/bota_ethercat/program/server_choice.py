# SPDX-License-Identifier: Apache-2.0
"""Which server a program uses: `--server`, else $BOTA_SERVER, else the user's file, else this machine's."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from bota_ethercat.address import DEFAULT_HOST, DEFAULT_PORT, Address

VARIABLE: Final = "BOTA_SERVER"
THIS_MACHINE: Final = Address(DEFAULT_HOST, DEFAULT_PORT)
HELP: Final = (
    f"(default: ${VARIABLE}, else `server` in ~/.config/bota-ethercat/config.toml, else {THIS_MACHINE})"
)
_LOCAL: Final = frozenset({DEFAULT_HOST, "127.0.0.1", "::1"})
_ADDRESS: Final = re.compile(
    r"\d+ | [^/:\[\]]*:\d+ | \[[^/\]]*\](:\d+)? | [0-9a-f]*:[0-9a-f]*:[0-9a-f:.]*", re.ASCII | re.I | re.X
)


def is_address(text: str) -> bool:
    """Whether an argument has the form of an address, and so is no file: PORT, HOST:PORT, [::1], ::1.

    `./12001` is a file, and so is a mere HOST.
    """
    return _ADDRESS.fullmatch(text) is not None


def default_server(environment: Mapping[str, str] = os.environ) -> Address:
    """The server where none is given; ValueError names the variable or the file that is wrong."""
    if text := environment.get(VARIABLE):
        try:
            return Address.parse(text)
        except ValueError as error:
            raise ValueError(f"${VARIABLE}: {error}") from None
    path = _file(environment)
    return THIS_MACHINE if path is None else _in_file(path)


def own_server(environment: Mapping[str, str] = os.environ) -> Address:
    """Where a program that serves listens by default: `default_server` if that is this machine."""
    default = default_server(environment)
    return default if default.host in _LOCAL else THIS_MACHINE


def _file(environment: Mapping[str, str]) -> Path | None:
    folder, home = environment.get("XDG_CONFIG_HOME"), environment.get("HOME")
    if not (folder or home):
        return None
    base = Path(folder) if folder else Path(str(home)) / ".config"
    return base / "bota-ethercat" / "config.toml"


def _in_file(path: Path) -> Address:
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return THIS_MACHINE
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path} is not TOML in UTF-8: {error}") from None
    server = content.pop("server", str(THIS_MACHINE))
    if content or not isinstance(server, str):
        raise ValueError(f'{path} takes one key: server = "{THIS_MACHINE}"')
    try:
        return Address.parse(server)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
