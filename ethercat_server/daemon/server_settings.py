"""The settings of the server itself: one table for command line and configuration file."""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from ethercat_server.process import realtime

DEFAULTS: Final = "defaults"
KEEP: Final = "keep"
DEFAULT_RT_PRIORITY: Final = realtime.DEFAULT_PRIORITY


class ServerSetting(NamedTuple):
    """One setting. On the command line it is `--flag VALUE`, in the file `flag = VALUE` with underscores."""

    name: str
    metavar: str
    meaning: str
    parse: Callable[[str], Any]
    """Parses a value; ValueError says what it must be."""
    default: Any
    many: bool = False
    """Takes several values: a repeatable flag, a list in the file."""
    at_once: bool = False
    """A reload (SIGHUP) applies a change; others need a restart."""
    text: bool = False
    """A single string."""

    @property
    def flag(self) -> str:
        """Its name on the command line: singular, because each flag gives one value."""
        name = self.name.removesuffix("s") if self.many else self.name.removesuffix("_s")
        return "--" + name.replace("_", "-")

    def check(self, value: object) -> Any:
        """The value in a configuration file, checked; ValueError says what it must be."""
        if self.many:
            if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
                raise ValueError('a list of strings, such as ["a", "b"]')
            return tuple(self.parse(item) for item in value)
        if self.text:
            if not isinstance(value, str):
                raise ValueError('a string, such as "a"')
            return self.parse(value)
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


def _unset(text: str) -> str:
    if text in (DEFAULTS, KEEP):
        return text
    raise ValueError(f"'{DEFAULTS}' or '{KEEP}'")


def _name(text: str) -> str:
    if text and text.isprintable():
        return text
    raise ValueError("a name")


_ROWS: Final = (
    ServerSetting(
        "hosts", "ADDRESS", "address to listen on; remote clients are read-only "
        "(default 127.0.0.1 and ::1)",
        _address, ("127.0.0.1", "::1"), many=True,
    ),
    ServerSetting(
        "control_users", "NAME", "user who may configure the sensors and shut the server down, besides root, "
        "the server's own user and the user who ran sudo",
        _name, (), many=True, at_once=True,
    ),
    ServerSetting(
        "control_groups", "NAME", "group whose members may do so as well", _name, (), many=True, at_once=True,
    ),
    ServerSetting(
        "user", "NAME", "user that a server started by root becomes before it serves clients (default: who "
        "ran sudo; 'root' to stay root)",
        _name, None, text=True,
    ),
    ServerSetting(
        "unset_settings", "WHAT", f"what settings that nobody set become at start: '{DEFAULTS}' writes the "
        f"server's, '{KEEP}' leaves the sensor's",
        _unset, DEFAULTS, at_once=True, text=True,
    ),
    ServerSetting(
        "rt_priority", "N", "SCHED_FIFO priority, if permitted; 0 for ordinary scheduling",
        whole(0, 99), DEFAULT_RT_PRIORITY,
    ),
    ServerSetting("cpu", "N", "pin the server to this CPU, if permitted", whole(0, 4095), None),
    ServerSetting(
        "stall_timeout_s", "S", "timeout in seconds for a client that does not read what is queued for it",
        _seconds, 10.0, at_once=True,
    ),
    ServerSetting(
        "idle_timeout_s", "S", "timeout in seconds for a client that is not subscribed and sends no request",
        _seconds, 300.0, at_once=True,
    ),
)  # fmt: skip

SERVER_SETTINGS: Final[Mapping[str, ServerSetting]] = {row.name: row for row in _ROWS}
