"""Applies settings to a sensor that streams: in OP what can be, by way of PREOP what must; saves them.

Whatever fails, the former settings are in force again afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from bota_ethercat.settings import SETTINGS, SettingValue, check_combination
from ethercat_server.errors import BusError, CutOffError, SdoAbortError, extended
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.slave.coe import Sdo, Steps
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.sensor import Sensor
from ethercat_server.sensor.set_up import read_settings, write_setting

_SAVE_TIMEOUT_S: Final = 5.0

# How the sentence of a change that failed goes on.
IN_FORCE: Final = "; the former settings are in force"
LATER: Final = "; it gets its former settings when it is back"
_AGAIN: Final = "configure it again"


class Change:
    """What the wanted `settings` would change of a sensor; SettingError if they contradict others."""

    def __init__(self, sensor: Sensor, settings: Mapping[str, SettingValue]) -> None:
        self.wanted = {**sensor.wanted, **settings}
        check_combination(self.wanted)
        changed = {name for name in settings if sensor.settings.get(name) != settings[name]}
        # In the order in which they are to be written.
        self.names = [name for name in dictionary.SETTING_WRITE_ORDER if name in changed]

    @property
    def needs_preop(self) -> bool:
        """Whether the sensor takes one of them in PREOP only."""
        return any(SETTINGS[name].preop_only for name in self.names)


def apply_in_op(sdo: Sdo, sensor: Sensor, change: Change) -> Steps[None]:
    """Write what has changed and verify it; BusError if it fails, which says that the former is in force."""
    before, asked = sensor.wanted, sensor.asked
    sensor.wanted, sensor.asked = change.wanted, asked | set(change.names)
    written = []
    try:
        for name in change.names:
            written.append(name)
            yield from write_setting(sdo, sensor, name)
        yield from read_settings(sdo, sensor)
    except BusError as error:
        sensor.wanted, sensor.asked, sensor.change_interrupted = before, asked, True
        if isinstance(error, CutOffError):
            raise extended(error, LATER) from None
        try:
            for name in written:
                if name in sensor.settings:
                    yield from write_setting(sdo, sensor, name, sensor.settings[name])
        except BusError as worse:
            raise extended(error, f"; restoring the former settings failed too: {worse}; {_AGAIN}") from None
        sensor.change_interrupted = False
        raise extended(error, IN_FORCE) from None


def save(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    """Have the sensor save its parameters to flash; BusError if it does not report success."""
    command, status = dictionary.CONTROL_COMMAND, dictionary.CONTROL_STATUS
    deadline = Deadline(sdo.clock, _SAVE_TIMEOUT_S)
    try:
        yield from sdo.write(*command, bytes((dictionary.SAVE_PARAMETERS,)))
        while True:
            answer = int.from_bytes((yield from sdo.read(*status)), "little")
            if answer == 0:
                return
            if deadline.passed:
                break
            yield
    except SdoAbortError as error:
        raise extended(error, "; its settings are in force until its power goes, but not saved") from None
    except BusError as error:  # lost, or without an answer
        raise extended(
            error, "; whether it saved all, some or none of its settings is not known: save again"
        ) from None
    raise BusError(
        f"sensor {sensor.number} did not save its settings (status {answer}): they are in force until its "
        "power goes; save again"
    )
