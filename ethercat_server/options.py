"""What the server is asked to do: command line and configuration file, read into one checked object."""

from __future__ import annotations

import argparse
import functools
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ethercat_server import __version__
from ethercat_server.config_file import EMPTY, read_config
from ethercat_server.errors import UsageError
from ethercat_server.server_settings import SERVER_SETTINGS, ServerSetting
from protocol.errors import SettingError
from protocol.sensor_choice import SensorChoice
from protocol.settings import SETTINGS, SettingValue, check_combination, start_up_defaults

if TYPE_CHECKING:
    from ethercat_server.sensor import Identity

VIRTUAL_INTERFACE: Final = "virtual"
"""The interface name that stands for a virtual bus with a virtual sensor on it."""


@dataclass(frozen=True, slots=True)
class ServerOptions:
    """Everything the server needs to know to start."""

    ifname: str
    port: int
    sensor_name: str | None = None
    virtual_arguments: str = ""
    server: Mapping[str, Any] = field(
        default_factory=lambda: {name: setting.default for name, setting in SERVER_SETTINGS.items()}
    )
    """The server's own settings, by the names of SERVER_SETTINGS."""
    common_settings: dict[str, SettingValue] = field(default_factory=dict)
    """The file's for every sensor."""
    sensor_settings: dict[SensorChoice, dict[str, SettingValue]] = field(default_factory=dict)
    """The file's for single sensors; these win."""
    assigned_settings: dict[str, SettingValue] = field(default_factory=dict)
    """The command line's; these win over both."""

    @property
    def is_virtual(self) -> bool:
        """Whether to bring up a virtual bus."""
        return self.ifname == VIRTUAL_INTERFACE

    def asked_settings(self, place: int, name: str, serial: int) -> dict[str, SettingValue]:
        """The settings a person asked for, for the sensor at `place` with this name and serial number."""
        asked: dict[str, SettingValue] = {}
        for _, settings in self._sources(place, name, serial):
            asked |= settings
        return asked

    def wanted_settings(self, place: int, name: str, serial: int) -> dict[str, SettingValue]:
        """The same over the start-up defaults; UsageError if they contradict one another."""
        wanted = {**start_up_defaults(), **self.asked_settings(place, name, serial)}
        try:
            check_combination(wanted)
        except SettingError as error:
            sources = ", ".join(source for source, _ in self._sources(place, name, serial))
            raise UsageError(
                f"what is asked of sensor {place} ({name} with serial {serial}) contradicts itself: {error}; "
                f"correct one of {sources}"
            ) from None
        return wanted

    def _sources(self, place: int, name: str, serial: int) -> list[tuple[str, dict[str, SettingValue]]]:
        """Where something is asked of this sensor, and what; the later wins."""
        single = [choice for choice in self.sensor_settings if choice.matches(place, name, serial)]
        single.sort(key=lambda choice: choice.precedence)
        sources = [
            ("[sensor]", self.common_settings),
            *((f"[sensor.{choice}]", self.sensor_settings[choice]) for choice in single),
            ("--set", self.assigned_settings),
        ]
        return [(source, settings) for source, settings in sources if settings]

    def check_sensors(self, found: Mapping[int, Identity]) -> None:
        """UsageError if there are settings for a sensor that is not among those `found`, by place."""
        missing = [
            str(choice)
            for choice in self.sensor_settings
            if not any(choice.matches(place, who.name, who.serial) for place, who in found.items())
        ]
        if missing:
            there = "; ".join(f"{place}: {who}" for place, who in found.items())
            raise UsageError(
                f"the configuration has settings for sensor {', '.join(missing)}, but the bus has only "
                f"{there}: switch that sensor on, or correct the table's name"
            )

    def check(self) -> None:
        """SettingError if what is asked of any one sensor contradicts itself."""
        for own in ({}, *self.sensor_settings.values()):
            check_combination(
                {**start_up_defaults(), **self.common_settings, **own, **self.assigned_settings}
            )


@functools.cache
def build_parser() -> argparse.ArgumentParser:
    """The command line of `ethercat-server`."""
    parser = argparse.ArgumentParser(
        prog="ethercat-server",
        usage="%(prog)s [options] IFACE [SENSOR_NAME] PORT",
        description="Owns the EtherCAT bus, sets its Bota sensors up and streams their samples over TCP.",
        epilog="settings: " + "; ".join(f"{row.name} ({row.meaning})" for row in SETTINGS.values()),
    )
    parser.add_argument(
        "arguments", nargs="+", metavar="IFACE [SENSOR_NAME] PORT",
        help="network interface ('virtual' for a virtual sensor), name the first sensor must have, TCP port",
    )  # fmt: skip
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments",
        help="a setting of every sensor at start-up; may be given more than once",
    )  # fmt: skip
    parser.add_argument(
        "--config", type=Path, metavar="FILE.toml",
        help="settings from a file: [server] for those below, [sensor] or [sensor.0], [sensor.1] for sensors",
    )  # fmt: skip
    parser.add_argument(
        "--virtual", default="", metavar="ARGUMENTS",
        help="arguments for the virtual sensor, such as '--pdo 77 --sensors 2' (see ethercat-virtual-sensor)",
    )  # fmt: skip
    for setting in SERVER_SETTINGS.values():
        text = setting.meaning + ("; may be given more than once" if setting.many else "")
        if not setting.many and setting.default is not None:
            text += f" (default {setting.default:g})"
        parser.add_argument(
            setting.flag, dest=setting.name, metavar=setting.metavar, help=text,
            type=_parse_with(setting), action="append" if setting.many else "store",
        )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return parser


def parse_options(argv: Sequence[str] | None = None) -> ServerOptions:
    """Read the command line and the file it names; UsageError says what is wrong with either.

    argparse itself exits with code 2 for what it finds.
    """
    parsed = build_parser().parse_intermixed_args(argv)
    arguments: list[str] = parsed.arguments
    if len(arguments) not in {2, 3}:
        raise UsageError(
            f"{len(arguments)} arguments given: it takes IFACE [SENSOR_NAME] PORT, "
            "for example 'ethercat-server ens5 12001'"
        )
    config = read_config(parsed.config) if parsed.config else EMPTY
    assigned = parse_assignments(parsed.assignments)
    options = ServerOptions(
        ifname=arguments[0],
        port=_port(arguments[-1]),
        sensor_name=arguments[1] if len(arguments) == 3 else None,
        virtual_arguments=parsed.virtual,
        server={
            name: _first_given(getattr(parsed, name), config.server.get(name), setting)
            for name, setting in SERVER_SETTINGS.items()
        },
        common_settings=config.common,
        sensor_settings=config.by_sensor,
        assigned_settings=assigned,
    )
    try:
        shlex.split(options.virtual_arguments)
    except ValueError as error:
        raise UsageError(f"--virtual {options.virtual_arguments}: {str(error).lower()}") from None
    if options.virtual_arguments and not options.is_virtual:
        raise UsageError(f"--virtual goes with the interface 'virtual', not with {options.ifname}")
    try:
        options.check()
    except SettingError as error:
        raise UsageError(str(error)) from None
    return options


def parse_assignments(assignments: Sequence[str]) -> dict[str, SettingValue]:
    """The settings in NAME=VALUE texts; UsageError names the one that is wrong."""
    values: dict[str, SettingValue] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        setting = SETTINGS.get(name.strip())
        if not equals:
            raise UsageError(f"--set {assignment}: it must be NAME=VALUE, for example --set sinc_length=64")
        if setting is None:
            raise UsageError(f"no setting {name.strip()!r}: the settings are " + ", ".join(SETTINGS))
        try:
            values[setting.name] = setting.parse(text)
        except SettingError as error:
            raise UsageError(f"--set {assignment}: {error}") from None
    return values


def _parse_with(setting: ServerSetting) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        try:
            return setting.parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} must be {error}") from None

    return parse


def _first_given(on_command_line: Any, in_file: Any, setting: ServerSetting) -> Any:
    if on_command_line is not None:
        return tuple(on_command_line) if setting.many else on_command_line
    return setting.default if in_file is None else in_file


def _port(text: str) -> int:
    try:
        port = int(text)
    except ValueError:
        raise UsageError(f"port {text!r} is no number: it must be from 1 to 65535") from None
    if not 1 <= port <= 65535:
        raise UsageError(f"port {port} is out of range: it must be from 1 to 65535")
    return port
