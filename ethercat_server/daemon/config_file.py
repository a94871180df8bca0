"""The TOML configuration file: [server] for the server, [sensor] and [sensor.0] for the sensors."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from ethercat_server.daemon.server_settings import SERVER_SETTINGS
from ethercat_server.errors import UsageError
from protocol.errors import SettingError
from protocol.sensor_choice import SensorChoice
from protocol.settings import SettingValue, check_settings
from protocol.text.did_you_mean import did_you_mean


class ConfigFile(NamedTuple):
    """A file's content, checked."""

    server: dict[str, Any]
    """By the names of SERVER_SETTINGS."""
    common: dict[str, SettingValue]
    """Settings for every sensor."""
    by_sensor: dict[SensorChoice, dict[str, SettingValue]]
    """Settings for single sensors."""


EMPTY = ConfigFile({}, {}, {})


def read_config(path: Path) -> ConfigFile:
    """Read a configuration file; UsageError names file and key."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
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
        except ValueError as error:
            raise UsageError(f"[server] {key} = {value!r} must be {error}") from None
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
