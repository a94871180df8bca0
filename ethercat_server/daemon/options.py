"""The configuration of the server: command line and TOML file, [server] for itself, [sensor] and [sensor.0]
for the sensors."""

from __future__ import annotations

import argparse
import functools
import ipaddress
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from bota_ethercat.address import DEFAULT_PORT, PORT
from bota_ethercat.errors import SettingError
from bota_ethercat.option_types import choice, text
from bota_ethercat.program.arguments import Parser, number, of_type, typed, whole
from bota_ethercat.sensor_choice import SensorChoice
from bota_ethercat.settings import (
    SETTINGS,
    SettingValue,
    check_combination,
    check_settings,
    parse_assignment,
    start_up_defaults,
)
from bota_ethercat.text.did_you_mean import did_you_mean
from ethercat_server.acquisition.terminal_choice import CHOICE
from ethercat_server.errors import UsageError
from ethercat_server.ethercat.options import ALLOW_IP, ALLOW_IP_HELP, VIRTUAL_INTERFACE
from ethercat_server.process import realtime

if TYPE_CHECKING:
    from ethercat_server.sensor.sensor import Identity

_PORT: Final = of_type(PORT)
DEFAULTS: Final = "defaults"
KEEP: Final = "keep"


class ServerSetting(NamedTuple):
    """One setting. On the command line it is `--flag VALUE`, in the file `flag = VALUE` with underscores."""

    name: str
    metavar: str
    meaning: str
    parse_argument: Callable[[str], Any]  # ArgumentTypeError says what a value must be
    default: Any
    many: bool = False  # takes several values: a repeatable flag, a list in the file

    @property
    def flag(self) -> str:
        """Its name on the command line: singular, because each flag gives one value."""
        name = self.name.removesuffix("s") if self.many else self.name.removesuffix("_s")
        return "--" + name.replace("_", "-")

    def check(self, value: object) -> Any:
        """The value in a configuration file, checked; ArgumentTypeError says what it must be."""
        values = value if self.many and isinstance(value, list) else [value]
        checked = tuple(self.parse_argument(str(each)) for each in values)
        return checked if self.many else checked[0]


_ADDRESS: Final = typed(
    lambda text: str(ipaddress.ip_address(text)),
    "an IP address of this machine, such as 127.0.0.1 or 0.0.0.0",
)
_NAME: Final = of_type(text("a name", lambda name: name and name.isprintable()))
_SECONDS: Final = number(0.1, 1e6, "a number of seconds")
_UNSET: Final = of_type(choice(DEFAULTS, KEEP))
_TERMINAL: Final = of_type(
    text("0xVENDOR:0xPRODUCT, POSITION or 0xVENDOR:0xPRODUCT@POSITION", CHOICE.fullmatch)
)
_ROWS: Final = (
    ServerSetting(
        "hosts", "ADDRESS", "address to listen on; remote clients are read-only "
        "(default 127.0.0.1 and ::1)",
        _ADDRESS, ("127.0.0.1", "::1"), many=True,
    ),
    ServerSetting(
        "control_users", "NAME", "user who may configure the sensors and shut the server down, besides root, "
        "the server's own user and the user who ran sudo",
        _NAME, (), many=True,
    ),
    ServerSetting(
        "control_groups", "NAME", "group whose members may do so as well", _NAME, (), many=True,
    ),
    ServerSetting(
        "user", "NAME", "user that a server started by root becomes before it serves clients (default: who "
        "ran sudo; 'root' to stay root)",
        _NAME, None,
    ),
    ServerSetting(
        "unset_settings", "WHAT", f"what settings that nobody set become at start: '{DEFAULTS}' writes the "
        f"server's, '{KEEP}' leaves the sensor's",
        _UNSET, DEFAULTS,
    ),
    ServerSetting(
        "rt_priority", "N", "SCHED_FIFO priority, if permitted; 0 for ordinary scheduling",
        whole(0, 99), realtime.DEFAULT_PRIORITY,
    ),
    ServerSetting(
        "terminals", "WHICH", "slave beside the sensors whose inputs are read, too: VENDOR:PRODUCT (such as "
        "0x2:0x0C1E3052), its POSITION on the wire, or VENDOR:PRODUCT@POSITION",
        _TERMINAL, (), many=True,
    ),
    ServerSetting("cpu", "N", "pin the server to this CPU, if permitted", whole(0, 4095), None),
    ServerSetting(
        "stall_timeout_s", "S", "timeout in seconds for a client that does not read what is queued for it",
        _SECONDS, 10.0,
    ),
    ServerSetting(
        "idle_timeout_s", "S", "timeout in seconds for a client that is not subscribed and sends no request",
        _SECONDS, 300.0,
    ),
)  # fmt: skip

SERVER_SETTINGS: Final[Mapping[str, ServerSetting]] = {row.name: row for row in _ROWS}


class ConfigFile(NamedTuple):
    """A file's content, checked."""

    server: dict[str, Any]  # by the names of SERVER_SETTINGS
    common: dict[str, SettingValue]  # for every sensor
    by_sensor: dict[SensorChoice, dict[str, SettingValue]]  # for single sensors; these override the others


EMPTY: Final = ConfigFile({}, {}, {})


def read_config(path: Path) -> ConfigFile:
    """Read a configuration file; UsageError names file and key."""
    import tomllib  # noqa: PLC0415 - for this only

    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # Windows' editors put a mark first
    except OSError as error:
        raise UsageError(f"cannot read the configuration {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"the configuration {path} is not a text file: it must be TOML in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"the configuration {path} is not valid TOML: {error}") from None
    for key, value in content.items():
        if key not in {"server", "sensor"} or not isinstance(value, dict):
            raise UsageError(
                f"the configuration {path} has an unexpected {key!r}: it takes tables [server] and [sensor]"
            )
    try:
        return ConfigFile(_server(content.get("server", {})), *_sensors(content.get("sensor", {})))
    except (SettingError, UsageError) as error:
        raise UsageError(f"the configuration {path}: {error}") from None


def _server(table: dict[str, Any]) -> dict[str, Any]:
    values = {}
    for key, value in table.items():
        setting = SERVER_SETTINGS.get(key)
        if setting is None:
            guess = did_you_mean(key, SERVER_SETTINGS)
            raise UsageError(f"[server] has no {key!r}: it takes {', '.join(SERVER_SETTINGS)}{guess}")
        try:
            values[key] = setting.check(value)
        except argparse.ArgumentTypeError as error:
            raise UsageError(f"[server] {key} = {error}") from None
    return values


def _sensors(
    table: dict[str, Any],
) -> tuple[dict[str, SettingValue], dict[SensorChoice, dict[str, SettingValue]]]:
    common = {key: value for key, value in table.items() if not isinstance(value, dict)}
    single = {key: value for key, value in table.items() if isinstance(value, dict)}
    by_sensor = {}
    for key, values in single.items():
        try:
            choice = SensorChoice.parse(key)
        except ValueError as error:
            raise SettingError(f"[sensor.{key}]: the table must be named by {error}") from None
        by_sensor[choice] = check_settings(values)
    return check_settings(common), by_sensor


def _defaults() -> dict[str, Any]:
    return {name: setting.default for name, setting in SERVER_SETTINGS.items()}


class ServerOptions(NamedTuple):
    """Everything the server needs to know to start."""

    ifname: str
    port: int
    sensor_name: str | None = None
    virtual_arguments: str = ""
    file: ConfigFile = EMPTY  # the configuration file's content
    force: bool = False  # whether to take over a bus that is in use
    allow_ip: bool = False  # whether to use an interface of the machine's network
    server: Mapping[str, Any] = _defaults()  # by the names of SERVER_SETTINGS
    assigned: Mapping[str, SettingValue] = {}  # settings from the command line

    @property
    def terminals(self) -> Sequence[str]:
        return tuple(self.server["terminals"])

    @property
    def keep_unset(self) -> bool:
        return bool(self.server["unset_settings"] == KEEP)

    def asked_settings(self, number: int, name: str, serial: int) -> dict[str, SettingValue]:
        """The settings the user gave for the sensor `number` with this name and serial number."""
        asked: dict[str, SettingValue] = {}
        for _, settings in self._sources(number, name, serial):
            asked |= settings
        return asked

    def wanted_settings(self, number: int, name: str, serial: int) -> dict[str, SettingValue]:
        """The start-up defaults, unless kept, overridden by these; UsageError if that is inconsistent."""
        wanted = self._unset() | self.asked_settings(number, name, serial)
        try:
            check_combination(wanted)
        except SettingError as error:
            sources = ", ".join(source for source, _ in self._sources(number, name, serial))
            raise UsageError(
                f"the settings for sensor {number} ({name}, serial {serial}) are inconsistent: {error}; "
                f"correct one of {sources}"
            ) from None
        return wanted

    def _unset(self) -> dict[str, SettingValue]:
        return {} if self.keep_unset else start_up_defaults()

    def _sources(self, number: int, name: str, serial: int) -> list[tuple[str, Mapping[str, SettingValue]]]:
        """Where settings for this sensor come from, and which; later ones override earlier ones."""
        single = [choice for choice in self.file.by_sensor if choice.matches(number, name, serial)]
        single.sort(key=lambda choice: choice.precedence)
        sources = [
            ("[sensor]", self.file.common),
            *((f"[sensor.{choice}]", self.file.by_sensor[choice]) for choice in single),
            ("--set", self.assigned),
        ]
        return [(source, settings) for source, settings in sources if settings]

    def check_sensors(self, found: Mapping[int, Identity]) -> None:
        """UsageError if there are settings for a sensor that is not among those `found`, by number."""
        missing = [
            str(choice)
            for choice in self.file.by_sensor
            if not any(choice.matches(number, who.name, who.serial) for number, who in found.items())
        ]
        if missing:
            there = "; ".join(f"{number}: {who}" for number, who in found.items())
            raise UsageError(
                f"the configuration has settings for sensor {', '.join(missing)}, but the bus has only "
                f"{there}: connect that sensor, or correct the name of the table"
            )

    def check(self) -> None:
        """SettingError if the settings of any sensor are inconsistent."""
        for own in ({}, *self.file.by_sensor.values()):
            check_combination({**self._unset(), **self.file.common, **own, **self.assigned})


@functools.cache
def build_parser() -> argparse.ArgumentParser:
    """The command line of `ethercat-server`."""
    parser = Parser(
        "ethercat-server",
        "EtherCAT master for Bota force/torque sensors: streams their samples over TCP.",
        "settings: " + "; ".join(f"{row.name} ({row.meaning})" for row in SETTINGS.values()),
        usage="%(prog)s [options] IFACE [SENSOR_NAME] [PORT]",
    )
    interface = f"network interface ('{VIRTUAL_INTERFACE}' for a simulated sensor)"
    parser.add_argument("ifname", metavar="IFACE", help=interface)
    parser.add_argument("sensor_name", metavar="SENSOR_NAME", nargs="?", help="model of the first sensor")
    parser.add_argument(
        "port", metavar="PORT", nargs="?", type=_PORT, help=f"TCP port (default {DEFAULT_PORT})"
    )
    parser.add_argument(
        "--force", action="store_true",
        help="take over a bus in use: slaves of others in SAFEOP or OP are taken to PREOP, machines stop",
    )  # fmt: skip
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments",
        help="set a setting of every sensor at start-up; repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--config", type=Path, metavar="FILE.toml",
        help="configuration file: [server] for the options below, [sensor] or [sensor.0] for settings",
    )  # fmt: skip
    parser.add_argument(
        "--virtual", default="", metavar="ARGUMENTS",
        help="arguments of the simulated sensor, such as '--pdo 77' (see ethercat-virtual-sensor)",
    )  # fmt: skip
    for setting in SERVER_SETTINGS.values():
        text = setting.meaning + ("; repeatable" if setting.many else "")
        if not setting.many and setting.default is not None:
            text += f" (default {setting.default})"
        parser.add_argument(
            setting.flag, dest=setting.name, metavar=setting.metavar, help=text,
            type=setting.parse_argument, action="append" if setting.many else "store",
        )  # fmt: skip
    return parser


def parse_options(argv: Sequence[str] | None = None) -> ServerOptions:
    """Parse the command line and the file it names; UsageError says what is wrong.

    argparse itself exits with code 2 for the errors it finds.
    """
    parser, words = build_parser(), list(sys.argv[1:] if argv is None else argv)
    if "--virtual" in words[:-1]:  # its value begins with dashes, too
        at = words.index("--virtual")
        words[at : at + 2] = [f"--virtual={words[at + 1]}"]
    parsed = parser.parse_intermixed_args(words)
    if parsed.port is None and (parsed.sensor_name or "")[:1].isdigit():  # no model's name
        try:
            parsed.sensor_name, parsed.port = None, _PORT(parsed.sensor_name)
        except argparse.ArgumentTypeError as error:
            parser.error(f"argument PORT: {error}")
    file = read_config(parsed.config) if parsed.config else EMPTY
    given = {
        name: tuple(value) if setting.many else value
        for name, setting in SERVER_SETTINGS.items()
        if (value := getattr(parsed, name)) is not None
    }
    options = ServerOptions(
        parsed.ifname, parsed.port or DEFAULT_PORT, parsed.sensor_name, parsed.virtual, file,
        force=parsed.force,
        allow_ip=parsed.allow_ip,
        server=_defaults() | file.server | given,
        assigned=parse_assignments(parsed.assignments),
    )  # fmt: skip
    try:
        shlex.split(options.virtual_arguments)
    except ValueError as error:
        raise UsageError(f"--virtual {options.virtual_arguments}: {str(error).lower()}") from None
    if options.virtual_arguments and options.ifname != VIRTUAL_INTERFACE:
        raise UsageError(f"--virtual requires the interface 'virtual', not {options.ifname}")
    try:
        options.check()
    except SettingError as error:
        raise UsageError(str(error)) from None
    return options


def parse_assignments(assignments: Sequence[str]) -> dict[str, SettingValue]:
    """The settings in NAME=VALUE arguments; UsageError names the one that is wrong."""
    values: dict[str, SettingValue] = {}
    for assignment in assignments:
        try:
            name, values[name] = parse_assignment(assignment)
        except SettingError as error:
            raise UsageError(f"--set {assignment}: {error}") from None
    return values
