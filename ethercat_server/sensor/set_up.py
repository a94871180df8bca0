"""The steps that identify a sensor, set it up, and change its settings while it streams, in OP or by way of
PREOP; if that fails, the former settings are in force again afterwards.

They are `Steps` over an `Sdo`: the same code runs at start-up and, between two exchanges, when a sensor comes
back.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping, Sequence
from typing import Final

from bota_ethercat.settings import (
    BASE_SAMPLING_RATE_HZ,
    SETTINGS,
    SettingValue,
    check_combination,
    rate_divisor,
    sinc_length_of,
)
from bota_ethercat.text.untrusted import visible
from ethercat_server.errors import OBJECT_MISSING, BusError, SdoAbortError, extended
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.sensor import SETTLING_S, Identity, Sensor
from ethercat_server.sensor.undo import Former, or_undone

_LAST: Final = dictionary.SETTING_WRITE_ORDER[-1]  # sinc_length
_OFFSETS: Final = tuple((dictionary.FORCE_TORQUE_OFFSET, sub) for sub in range(1, 7))

_SAVE_TIMEOUT_S: Final = 5.0

# How the sentence of a change that failed goes on.
IN_FORCE: Final = "; the former settings are in force"
LATER: Final = "; it gets its former settings when it is back"
FORMER: Final = Former("the former settings", IN_FORCE, LATER, "configure it again")

NO_SETTINGS: Final[Mapping[str, SettingValue]] = {}

log = logging.getLogger(__name__)


def identify(sdo: Sdo, sii_name: str) -> Steps[Identity]:
    """Read the sensor's identity; fields that its firmware has no object for are empty."""
    name = yield from _read_text(sdo, dictionary.DEVICE_NAME)
    hardware = yield from _read_text(sdo, dictionary.HARDWARE_VERSION)
    firmware = yield from _read_text(sdo, dictionary.FIRMWARE_VERSION)
    serial = yield from _read(sdo, dictionary.SERIAL_NUMBER)
    return Identity(name or sii_name, int.from_bytes(serial or b"", "little"), hardware, firmware)


def set_up(sdo: Sdo, sensor: Sensor, *, asked: bool = False) -> Steps[None]:
    """Write the wanted settings that are not in force yet, in the device's order, and verify them.

    `asked`: because somebody asks for other ones. The sensor must be in PREOP. Afterwards `settings` and
    `rate_hz` are what is in force. BusError says which setting did not take.
    """
    written = yield from _write_differing(sdo, sensor, preop=True)
    held = {name: _setting_text(name, found) for name, found in written.items() if found is not None}
    # The valid SINC range depends on the filters before it, and only the sampling rate shows what it is.
    # With CHOP, which may divide the rate, not even that shows it.
    right = (yield from _divisor(sdo, sensor)) == 1
    rate_hz = sensor.rate_hz
    if not right or ((written or sensor.wanted.get("chop")) and not sensor.sinc_guessed):
        yield from write_setting(sdo, sensor, _LAST)
        yield from _check_rate(sdo, sensor)
    found = [(f"{name} = ", text, _text(sensor.wanted[name])) for name, text in held.items()]
    if rate_hz != sensor.rate_hz:
        found.append(("a sampling rate of ", f"{rate_hz} Hz", f"{sensor.rate_hz} Hz"))
        held[_LAST] = str(rate_hz)
    if found and asked:
        texts = ", ".join(f"{what}{now} (was {before})" for what, before, now in found)
        log.info("sensor %d was changed as requested: %s", sensor.number, texts)
    elif found:
        unset = ", ".join(name for name in held if name not in sensor.asked)
        log.info(
            "sensor %d held %s: what is wanted was written and verified%s",
            sensor.number, ", ".join(f"{what}{before} (wanted: {now})" for what, before, now in found),
            unset and f"; nobody set {unset}: --unset-settings keep leaves what the sensor has",
        )  # fmt: skip
    yield from _finish_set_up(sdo, sensor)


def set_up_in_op(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    """After a change that was interrupted in OP: write the wanted settings that OP permits; see `set_up`."""
    yield from _write_differing(sdo, sensor, preop=False)
    yield from _finish_set_up(sdo, sensor)


def _write_differing(sdo: Sdo, sensor: Sensor, *, preop: bool) -> Steps[dict[str, bytes | None]]:
    """Write what is wanted and not in force, but SINC; returns what was read of that."""
    written = {}
    for name in dictionary.SETTING_WRITE_ORDER[:-1]:
        if name in sensor.wanted and (preop or not SETTINGS[name].preop_only):
            entry = dictionary.BY_SETTING[name]
            found = yield from _read(sdo, entry.address)
            if found != entry.encode_setting(sensor.wanted[name]):
                yield from write_setting(sdo, sensor, name)
                written[name] = found
    return written


def _finish_set_up(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    yield from read_settings(sdo, sensor)
    if sensor.offset is not None and (yield from read_offset(sdo)) != sensor.offset:
        yield from write_offset(sdo, sensor.offset)
    sensor.change_interrupted, sensor.offset_is_certain = False, True


def write_setting(sdo: Sdo, sensor: Sensor, name: str, value: SettingValue | None = None) -> Steps[None]:
    """Write one setting, to what is wanted if no value is given; BusError if it did not take."""
    entry, value = dictionary.BY_SETTING[name], sensor.wanted[name] if value is None else value
    data = entry.encode_setting(value)
    try:
        yield from sdo.write(*entry.address, data)
        # SINC is proved by the sampling rate: a real device read back 2048 at 341.
        held = data if name == "sinc_length" else (yield from sdo.read(*entry.address))
    except SdoAbortError as error:
        if error.abort_code in OBJECT_MISSING and name not in sensor.asked:
            log.warning(
                "sensor %d (%s) has no setting %s; left out", sensor.number, sensor.identity.name, name
            )
            return
        raise SdoAbortError(f"the setting {name} = {value} did not take: {error}", error.abort_code) from None
    if held != data:
        raise BusError(
            f"the setting {name} = {value} did not take: sensor {sensor.number} holds {held.hex()} after "
            f"{data.hex()} was written; power it off and on, then start again"
        )


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
    wanted, asked, before = sensor.wanted, sensor.asked, sensor.settings
    written = []

    def write() -> Steps[None]:
        for name in change.names:
            written.append(name)
            yield from write_setting(sdo, sensor, name)
        yield from read_settings(sdo, sensor)

    def undo() -> Steps[None]:
        sensor.wanted, sensor.asked = wanted, asked
        for name in written:
            if name in before:
                yield from write_setting(sdo, sensor, name, before[name])

    sensor.wanted, sensor.asked = change.wanted, asked | set(change.names)
    try:
        yield from or_undone(write(), undo, FORMER, sensor)
    except BusError:
        sensor.wanted, sensor.asked = wanted, asked
        raise


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
            yield None
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


def _setting_text(name: str, data: bytes) -> str:
    """For people: the setting in what was read of its object."""
    try:
        return _text(dictionary.BY_SETTING[name].decode_setting(data))
    except ValueError:
        return f"0x{data.hex()}"


def _text(value: SettingValue) -> str:
    return str(value).lower()


def read_offset(sdo: Sdo) -> Steps[tuple[float, ...]]:
    """The six force/torque offsets in force."""
    found = []
    for address in _OFFSETS:
        entry, data = dictionary.BY_ADDRESS[address], (yield from sdo.read(*address))
        try:
            found.append(float(entry.type.unpack(data)))
        except struct.error:
            raise BusError(
                f"the offset {entry.name} is {data.hex() or 'nothing'}, which is no {entry.type.name}"
            ) from None
    return tuple(found)


def pack_offset(offset: Sequence[float]) -> list[bytes]:
    """The six offsets as REAL32; ValueError if one is too large."""
    try:
        return [
            dictionary.BY_ADDRESS[address].type.pack(v) for address, v in zip(_OFFSETS, offset, strict=True)
        ]
    except OverflowError:
        raise ValueError(f"{max(offset, key=abs):g} is larger than a REAL32 can be") from None


def write_offset(sdo: Sdo, offset: Sequence[float]) -> Steps[tuple[float, ...]]:
    """Write the six offsets and verify them; returns them as REAL32. BusError if one does not take."""
    held = []
    for address, value, data in zip(_OFFSETS, offset, pack_offset(offset), strict=True):
        entry = dictionary.BY_ADDRESS[address]
        yield from sdo.write(*address, data)
        if (yield from sdo.read(*address)) != data:
            raise BusError(f"the offset {entry.name} = {value:g} did not take")
        held.append(float(entry.type.unpack(data)))
    return tuple(held)


def _divisor(sdo: Sdo, sensor: Sensor) -> Steps[int | None]:
    """Read the rate; see `rate_divisor`."""
    sensor.rate_hz = int.from_bytes((yield from sdo.read(*dictionary.SAMPLING_RATE)), "little")
    return rate_divisor(sensor.wanted[_LAST], sensor.rate_hz, sensor.wanted.get("chop"))


def _check_rate(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    deadline = Deadline(sdo.clock, SETTLING_S)
    # A divided rate may be one from before: it counts once it has had the time to change.
    while (divisor := (yield from _divisor(sdo, sensor))) != 1 and not deadline.passed:
        yield None
    length = sensor.wanted[_LAST]
    nominal = BASE_SAMPLING_RATE_HZ / length
    if divisor is None:
        raise BusError(
            f"sensor {sensor.number} samples at {sensor.rate_hz} Hz, but sinc_length {length} implies "
            f"{nominal:.0f} Hz: power it off and on, or choose another sinc_length"
        )
    if divisor > 1:
        log.info(
            "sensor %d samples at %d Hz: CHOP divides the %.0f Hz of sinc_length %d by %d",
            sensor.number, sensor.rate_hz, nominal, length, divisor,
        )  # fmt: skip


def read_settings(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    """Read the settings in force."""
    held: dict[str, SettingValue] = {}
    for name in SETTINGS:
        data = yield from _read(sdo, dictionary.BY_SETTING[name].address)
        if data is None:
            continue
        try:
            held[name] = dictionary.BY_SETTING[name].decode_setting(data)
        except ValueError as error:
            log.warning("sensor %d: %s", sensor.number, error)
    held["sinc_length"] = sensor.wanted["sinc_length"]
    sensor.set_in_force(held)


def read_in_force(sdo: Sdo, sensor: Sensor, asked: Mapping[str, SettingValue] = NO_SETTINGS) -> Steps[None]:
    """Read settings and rate, and take them as wanted.

    The SINC length that is `asked` for is in force if it has the rate and what is read does not.
    """
    length, rate, chop = yield from read_sinc(sdo)
    sensor.rate_hz = rate or 0
    held = sinc_length_of(length, rate, chop, asked.get("sinc_length"))
    sensor.sinc_guessed = chop and held not in (length, asked.get("sinc_length"))
    sensor.wanted = {"sinc_length": held or 0}
    yield from read_settings(sdo, sensor)
    if not held:
        sensor.set_in_force({name: value for name, value in sensor.settings.items() if name != "sinc_length"})
    sensor.wanted = dict(sensor.settings)


def read_sinc(sdo: Sdo) -> Steps[tuple[int | None, int | None, bool]]:
    """SINC length as read back, sampling rate, CHOP: they show the length in force. None: unreadable."""
    length = yield from _read(sdo, dictionary.BY_SETTING[_LAST].address)
    rate = yield from _read(sdo, dictionary.SAMPLING_RATE)
    chop = yield from _read(sdo, dictionary.BY_SETTING["chop"].address)
    numbers = [None if data is None else int.from_bytes(data, "little") for data in (length, rate)]
    return numbers[0], numbers[1], any(chop or b"")


def _read(sdo: Sdo, address: tuple[int, int]) -> Steps[bytes | None]:
    try:
        return (yield from sdo.read(*address))
    except SdoAbortError:
        return None


def _read_text(sdo: Sdo, address: tuple[int, int]) -> Steps[str]:
    data = yield from _read(sdo, address)
    # Up to the first NUL: strings come padded, and from the wire, so only what can be printed is kept.
    text = (data or b"").split(b"\0")[0].decode("ascii", errors="replace").strip()
    return visible(text)
