# SPDX-License-Identifier: Apache-2.0
"""The sensor's settings by name: type, allowed values, start-up default, meaning.

One table for the command line, the configuration file, the control channel and the ROS parameters. Their
objects are in `ethercat_server.sensor.objects.dictionary`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from bota_ethercat import option_types
from bota_ethercat.errors import SettingError
from bota_ethercat.option_types import OptionType
from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS
from bota_ethercat.text.did_you_mean import did_you_mean

SettingValue = bool | int
_BOOL: Final = (False, True)


class Setting(NamedTuple):
    """One setting, of the values `choices`."""

    name: str
    # What the server writes at start-up unless configured otherwise; None = not written.
    default: SettingValue | None
    choices: range | tuple[SettingValue, ...]
    meaning: str
    preop_only: bool  # can be written in PREOP only

    @property
    def type(self) -> OptionType[bool] | OptionType[int]:
        """What it may be."""
        if self.choices is _BOOL:
            return option_types.flag
        if isinstance(self.choices, range):
            return option_types.integer(self.choices[0], self.choices[-1])
        return option_types.choice(*self.choices)

    def check(self, value: object) -> SettingValue:
        """Return `value` if it is allowed, else raise SettingError with the choices."""
        return self._allowed(self.type.check, value)

    def parse(self, text: str) -> SettingValue:
        """The value of `text` from a command line; SettingError if it is not allowed."""
        return self._allowed(self.type.parse, text)

    def _allowed(self, convert: Callable[[Any], SettingValue], value: object) -> SettingValue:
        try:
            return convert(value)
        except ValueError as error:
            raise SettingError(f"{self.name} is {value!r}: it must be {error}") from None


SETTINGS: Final[Mapping[str, Setting]] = {
    row.name: row
    for row in (
        Setting("calibration_matrix", True, _BOOL, "force and torque in N and Nm, not raw counts", False),
        Setting("temperature_compensation", False, _BOOL, "correct the force/torque for temperature", False),
        Setting("imu_active", 1, range(0, 4), "IMU: 0 none, 1 internal, 2 external, 3 both", False),
        Setting("coordinate_system", None, _BOOL, "use the configured coordinate system", False),
        Setting(
            "inertia_compensation", None, _BOOL, "the sensor's own inertia and gravity compensation", False
        ),
        Setting("orientation_estimation", None, _BOOL, "the sensor estimates its orientation", False),
        Setting("acceleration_range_g", 2, (2, 4, 8, 16), "accelerometer full scale, g", True),
        Setting("angular_rate_range_dps", 250, (250, 500, 1000, 2000), "gyroscope full scale, °/s", True),
        Setting("acceleration_filter", 1, range(1, 9), "accelerometer filter profile", True),
        Setting("angular_rate_filter", 3, range(3, 10), "gyroscope filter profile", True),
        # The sensor accepts more lengths than its manual lists; which ones depends on the other filters.
        Setting(
            "sinc_length", 64, range(32, 2049), "SINC filter length; sampling rate = 51200 / length", True
        ),
        Setting("fir", False, _BOOL, "FIR filter: lower cut-off, more delay", True),
        Setting("fast", False, _BOOL, "FAST filter: switches the FIR filter off on steps; needs fir", True),
        Setting("chop", False, _BOOL, "CHOP filter: less drift, unpredictable latency", True),
    )
}

BASE_SAMPLING_RATE_HZ: Final = 51200  # the ADC's rate: sampling rate = 51200 / SINC length

# By how much CHOP may divide the sampling rate; no source says whether it does, so object 0x8011 decides.
_MAX_DIVIDED: Final = 8


def sampling_rate_hz(sinc_length: int) -> int:
    """The rate in whole Hz that object 0x8011 gives for a SINC length."""
    row = FORCE_TORQUE_FILTERS.get(sinc_length)  # 51 is rounded down, 205 up
    return round(BASE_SAMPLING_RATE_HZ / sinc_length) if row is None else row.rate_hz


def rate_divisor(sinc_length: int, rate_hz: int, chop: SettingValue | None = False) -> int | None:
    """By what the rate of a SINC length is divided if object 0x8011 gives `rate_hz`: 1, or with CHOP up to 8.

    None if the length does not explain the rate. The object rounds up or down to whole Hz.
    """
    if sinc_length <= 0:
        return None
    nominal = BASE_SAMPLING_RATE_HZ / sinc_length
    nearest = min(range(1, _MAX_DIVIDED + 1 if chop else 2), key=lambda by: abs(rate_hz - nominal / by))
    return nearest if abs(rate_hz - nominal / nearest) < 1.0 else None


def sinc_length_of(
    read: int | None,
    rate_hz: int | None,
    chop: SettingValue | None = False,
    asked: SettingValue | None = None,
) -> int | None:
    """The SINC length in force, from what object 0x8006:1 reads and the sampling rate in 0x8011.

    The rate decides: real devices read back 768 after 128, and 2048 at 150 Hz. Of several lengths with this
    rate it is the one read, else the one `asked` for, else the manual's.
    """
    if not rate_hz:
        return read
    allowed = SETTINGS["sinc_length"].choices
    for length in (read, asked):
        if length is not None and length in allowed and rate_divisor(length, rate_hz, chop):
            return length
    published = (length for length, row in FORCE_TORQUE_FILTERS.items() if row.rate_hz == rate_hz)
    return next(published, min(round(BASE_SAMPLING_RATE_HZ / rate_hz), allowed[-1]))


def setting_named(name: str) -> Setting:
    """The setting of that name; SettingError if there is none."""
    if name not in SETTINGS:
        known = f"the settings are {', '.join(SETTINGS)}{did_you_mean(name, SETTINGS)}"
        raise SettingError(f"no setting {name!r}: {known}")
    return SETTINGS[name]


def parse_assignment(text: str) -> tuple[str, SettingValue]:
    """Name and value in NAME=VALUE; SettingError."""
    name, equals, value = text.partition("=")
    if not equals:
        raise SettingError("it must be NAME=VALUE, for example --set sinc_length=64")
    return name.strip(), setting_named(name.strip()).parse(value)


def check_settings(values: Mapping[str, object]) -> dict[str, SettingValue]:
    """Return `values` if every name exists and every value is allowed; else raise SettingError."""
    rows = {name: setting_named(name) for name in values}
    return {name: row.check(values[name]) for name, row in rows.items()}


def known_settings(values: object) -> dict[str, SettingValue]:
    """Those of `values`, from a message or a file, that exist and are allowed."""
    found: dict[str, SettingValue] = {}
    for name, value in values.items() if isinstance(values, dict) else ():
        if name in SETTINGS:
            with contextlib.suppress(SettingError):
                found[name] = SETTINGS[name].check(value)
    return found


def check_combination(values: Mapping[str, SettingValue]) -> None:
    """Raise SettingError if settings that are each allowed contradict one another."""
    if values.get("fast") and values.get("fir") is False:
        raise SettingError("fast is true but fir is false: the FAST filter works only with the FIR filter on")


def start_up_defaults() -> dict[str, SettingValue]:
    """The settings that the server writes at start-up unless configured otherwise."""
    return {row.name: row.default for row in SETTINGS.values() if row.default is not None}
