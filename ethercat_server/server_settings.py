"""The server's own settings, not the sensors': one table for command line and configuration file."""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

DEFAULT_RT_PRIORITY: Final = 80


class ServerSetting(NamedTuple):
    """One setting. On the command line it is `--flag VALUE`, in the file `flag = VALUE` with underscores."""

    name: str
    metavar: str
    meaning: str
    parse: Callable[[str], Any]
    """The value of a text; ValueError says what it must be."""
    default: Any
    many: bool = False
    """Takes several values: the flag may be repeated, the file has a list."""
    at_once: bool = False
    """SIGHUP puts a change into force; others wait for the next start."""

    @property
    def flag(self) -> str:
        """Its name on the command line, where one names one value at a time."""
        name = self.name.removesuffix("s") if self.many else self.name.removesuffix("_s")
        return "--" + name.replace("_", "-")

    def check(self, value: object) -> Any:
        """The value in a configuration file, checked; ValueError says what it must be."""
        if self.many:
            if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
                raise ValueError('a list of texts, such as ["a", "b"]')
            return tuple(self.parse(item) for item in value)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError("a number")
        return self.parse(str(value))


def whole(low: int, high: int) -> Callable[[str], int]:
    """Parses a whole number from `low` to `high`."""

    def parse(text: str) -> int:
        if text.isdecimal() and low <= int(text) <= high:
            return int(text)
        raise ValueError(f"a whole number from {low} to {high}")

    return parse


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if 0.1 <= seconds <= 1e6:
        return seconds
    raise ValueError("seconds, from 0.1 to 1000000")


def _address(text: str) -> str:
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise ValueError("an IP address of this machine, such as 127.0.0.1 or 0.0.0.0") from None


def _name(text: str) -> str:
    if text and text.isprintable():
        return text
    raise ValueError("a name")


_ROWS: Final = (
    ServerSetting(
        "hosts", "ADDRESS", "address to listen on; clients from other machines may look but not touch "
        "(default 127.0.0.1 and ::1)",
        _address, ("127.0.0.1", "::1"), many=True,
    ),
    ServerSetting(
        "control_users", "NAME", "user who may configure the sensor and shut the server down, beside root, "
        "the server's own user and the one who ran sudo",
        _name, (), many=True, at_once=True,
    ),
    ServerSetting(
        "control_groups", "NAME", "group whose members may do so too", _name, (), many=True, at_once=True,
    ),
    ServerSetting(
        "rt_priority", "N", "SCHED_FIFO priority, used when allowed; 0 for ordinary scheduling",
        whole(0, 99), DEFAULT_RT_PRIORITY,
    ),
    ServerSetting("cpu", "N", "the only CPU to run on, used when allowed", whole(0, 4095), None),
    ServerSetting(
        "stall_timeout_s", "S", "close a client that has taken nothing of what waits for it for so long",
        _seconds, 10.0, at_once=True,
    ),
    ServerSetting(
        "idle_timeout_s", "S", "close a client that is not subscribed and has asked nothing for so long",
        _seconds, 300.0, at_once=True,
    ),
)  # fmt: skip

SERVER_SETTINGS: Final[Mapping[str, ServerSetting]] = {row.name: row for row in _ROWS}
