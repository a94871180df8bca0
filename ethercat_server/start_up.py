"""Brings the sensors from power-on to streaming: find, check, set up, map, OP.

What the sensors must be is checked before anything is written to one of them.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from ethercat_server import objects
from ethercat_server.bus import Bus, SlaveIdentity
from ethercat_server.errors import OBJECT_MISSING, BusError, SdoAbortError, UsageError
from ethercat_server.options import ServerOptions
from protocol.errors import PdoSizeError
from protocol.pdo import layout_for
from protocol.settings import BASE_SAMPLING_RATE_HZ, SETTINGS, SettingValue

_MODEL_NAME: Final = re.compile(r"BFT-[A-Z]{4}-ECAT-M8")
_SETTLE_S: Final = 0.5
"""How long Bota's own driver waits for new filter settings to take."""

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Sensor:
    """One sensor on the bus, as found and set up."""

    place: int
    identity: SlaveIdentity
    name: str
    hardware: str = ""
    firmware: str = ""
    serial: int = 0
    pdo_size: int = 0
    rate_hz: int = 0
    state: str = "PREOP"
    settings: dict[str, SettingValue] = field(default_factory=dict)

    @property
    def period_ns(self) -> float:
        """Nominal sample period; 0x8011 rounds the rate to whole Hz, so it follows from the SINC length."""
        return 1e9 * self.settings["sinc_length"] / BASE_SAMPLING_RATE_HZ

    def describe(self) -> dict[str, Any]:
        """The sensor's part of the `describe` reply."""
        return {
            "sensor": self.place,
            "name": self.name,
            "serial": self.serial,
            "hardware": self.hardware,
            "firmware": self.firmware,
            "pdo_size": self.pdo_size,
            "rate_hz": self.rate_hz,
            "state": self.state,
            "settings": dict(self.settings),
        }


def bring_up(bus: Bus, options: ServerOptions, check_interrupt: Callable[[], None]) -> list[Sensor]:
    """Take every sensor on the open `bus` to OP with the wanted settings.

    `check_interrupt` is called between the steps and may raise to give up. BusError says which sensor did
    not do what.
    """
    identities = bus.scan()
    bus.check_preop()
    sensors = [_identify(bus, place, identity) for place, identity in enumerate(identities)]
    _check_places(sensors, options)
    for sensor in sensors:
        check_interrupt()
        wanted = options.wanted_settings(sensor.place)
        _write_settings(bus, sensor, wanted, options.asked_settings(sensor.place))
        sensor.rate_hz = _check_rate(bus, sensor.place, wanted)
        sensor.settings = _read_settings(bus, sensor.place, wanted)
    check_interrupt()
    for sensor, size in zip(sensors, bus.map_process_data(), strict=True):
        try:
            sensor.pdo_size = layout_for(size).size
        except PdoSizeError as error:
            raise BusError(f"sensor {sensor.place} ({sensor.name}) maps {error}") from None
    check_interrupt()
    bus.go_operational()
    for sensor in sensors:
        sensor.state = "OP"
    return sensors


def _identify(bus: Bus, place: int, identity: SlaveIdentity) -> Sensor:
    if (identity.vendor, identity.product) != (objects.VENDOR_ID, objects.PRODUCT_CODE):
        raise BusError(
            f"the slave at place {place} of {bus.ifname} is {identity.name or 'nameless'!r} (vendor "
            f"0x{identity.vendor:08X}, product 0x{identity.product:08X}), not a Bota Gen-0 sensor (vendor "
            f"0x{objects.VENDOR_ID:08X}, product {objects.PRODUCT_CODE}): connect only such sensors"
        )
    name = _read_text(bus, place, objects.DEVICE_NAME) or identity.name
    if not _MODEL_NAME.fullmatch(name):
        raise BusError(
            f"sensor {place} on {bus.ifname} is a {name!r}, a model this server does not know: "
            f"it knows the Gen-0 models {', '.join(objects.MODELS)}"
        )
    return Sensor(
        place,
        identity,
        name,
        hardware=_read_text(bus, place, objects.HARDWARE_VERSION),
        firmware=_read_text(bus, place, objects.FIRMWARE_VERSION),
        serial=int(_read_value(bus, place, objects.SERIAL_NUMBER) or 0),
    )


def _check_places(sensors: list[Sensor], options: ServerOptions) -> None:
    if options.sensor_name is not None and sensors[0].name != options.sensor_name:
        raise BusError(
            f"the sensor on {options.ifname} is a {sensors[0].name}, not a {options.sensor_name}: "
            "correct the name on the command line or leave it out"
        )
    absent = [place for place in options.sensor_settings if place >= len(sensors)]
    if absent:
        raise UsageError(
            f"the configuration has settings for sensor {absent[0]}, but the bus has {len(sensors)}: "
            "correct the table's number"
        )


def _write_settings(
    bus: Bus, sensor: Sensor, wanted: dict[str, SettingValue], asked: dict[str, SettingValue]
) -> None:
    for name in objects.SETTING_WRITE_ORDER:
        if name not in wanted:
            continue
        entry = objects.BY_SETTING[name]
        data = entry.encode_setting(wanted[name])
        try:
            bus.sdo_write(sensor.place, *entry.address, data)
            # SINC is proved by the sampling rate: a real device read back 2048 at 341.
            held = data if name == "sinc_length" else bus.sdo_read(sensor.place, *entry.address)
        except SdoAbortError as error:
            if error.abort_code in OBJECT_MISSING and name not in asked:
                log.warning("sensor %d (%s) has no setting %s; left out", sensor.place, sensor.name, name)
                continue
            raise BusError(f"the setting {name} = {wanted[name]} did not take: {error}") from None
        if held != data:
            raise BusError(
                f"the setting {name} = {wanted[name]} did not take: sensor {sensor.place} holds "
                f"{held.hex()} after {data.hex()} was written; power it off and on, then start again"
            )


def _check_rate(bus: Bus, place: int, wanted: dict[str, SettingValue]) -> int:
    """The sampling rate the sensor reports, Hz; BusError if it is not what the SINC length implies."""
    expected = BASE_SAMPLING_RATE_HZ / wanted["sinc_length"]
    deadline = time.monotonic() + _SETTLE_S
    while True:
        rate = int.from_bytes(bus.sdo_read(place, *objects.SAMPLING_RATE), "little")
        # Table III.4 rounds some rates up and some down.
        if abs(rate - expected) <= 1.0:
            return rate
        if time.monotonic() > deadline:
            raise BusError(
                f"sensor {place} samples at {rate} Hz, but sinc_length {wanted['sinc_length']} implies "
                f"{expected:.0f} Hz: power it off and on, or choose another sinc_length"
            )
        time.sleep(0.02)


def _read_settings(bus: Bus, place: int, wanted: dict[str, SettingValue]) -> dict[str, SettingValue]:
    held: dict[str, SettingValue] = {}
    for name, setting in SETTINGS.items():
        entry = objects.BY_SETTING[name]
        try:
            held[name] = entry.decode_setting(bus.sdo_read(place, *entry.address), setting.is_bool)
        except SdoAbortError:
            continue
        except ValueError as error:
            log.warning("sensor %d: %s", place, error)
    held["sinc_length"] = wanted["sinc_length"]
    return held


def _read_text(bus: Bus, place: int, address: tuple[int, int]) -> str:
    return str(_read_value(bus, place, address) or "").strip()


def _read_value(bus: Bus, place: int, address: tuple[int, int]) -> float | int | str | None:
    entry = objects.BY_ADDRESS[address]
    try:
        data = bus.sdo_read(place, *address)
    except SdoAbortError:
        return None
    if entry.type.size and len(data) != entry.type.size:
        return int.from_bytes(data, "little")
    return entry.type.unpack(data)
