# SPDX-License-Identifier: Apache-2.0
"""Which server a program uses: `--server`, else $BOTA_SERVER, else this machine's."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Final

from bota_ethercat.address import DEFAULT_HOST, DEFAULT_PORT, Address

VARIABLE: Final = "BOTA_SERVER"
THIS_MACHINE: Final = Address(DEFAULT_HOST, DEFAULT_PORT)
HELP: Final = f"(default: ${VARIABLE}, else {THIS_MACHINE})"
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
    """The server where none is given; ValueError if the variable is wrong."""
    if text := environment.get(VARIABLE):
        try:
            return Address.parse(text)
        except ValueError as error:
            raise ValueError(f"${VARIABLE}: {error}") from None
    return THIS_MACHINE


def own_server(environment: Mapping[str, str] = os.environ) -> Address:
    """Where a program that serves listens by default: `default_server` if that is this machine."""
    default = default_server(environment)
    return default if default.host in _LOCAL else THIS_MACHINE
