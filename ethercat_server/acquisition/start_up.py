"""Brings the bus from power-on to streaming: find, check, set up, map, OP.

What the sensors must be is checked before anything is written to one of them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Protocol

from ethercat_server.errors import BusError, SdoAbortError, UsageError
from ethercat_server.ethercat.backend import CheckInterrupt, SlaveIdentity
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave.coe import BlockingSdo, Sdo, finish
from ethercat_server.ethercat.slave.sii import has_coe
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.scan import scan
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState, is_known_model
from ethercat_server.sensor.set_up import identify, read_offset, set_up
from protocol.errors import PdoSizeError
from protocol.pdo import layout_for
from protocol.settings import SettingValue

log = logging.getLogger(__name__)


class Wanted(Protocol):
    """What is asked of the sensors: command line and configuration of the server, or nothing at all."""

    @property
    def sensor_name(self) -> str | None:
        """The model that the first sensor must be; None for any."""

    @property
    def force(self) -> bool:
        """Whether to take over a bus that is in use."""

    def wanted_settings(self, position: int, name: str, serial: int, /) -> dict[str, SettingValue]:
        """The settings to be in force in a sensor."""

    def asked_settings(self, position: int, name: str, serial: int, /) -> dict[str, SettingValue]:
        """Those among them that a person asked for."""

    def check_sensors(self, found: Mapping[int, Identity], /) -> None:
        """UsageError if something is asked of a sensor that is not there."""


class AsFound:
    """Nothing is asked: the sensors stay set as they are."""

    sensor_name = None

    def __init__(self, *, force: bool = False) -> None:
        self.force = force

    def wanted_settings(self, _position: int, _name: str, _serial: int) -> dict[str, SettingValue]:
        """See `Wanted`."""
        return {}

    asked_settings = wanted_settings

    def check_sensors(self, found: Mapping[int, Identity]) -> None:
        """See `Wanted`."""


def bring_up(bus: Bus, wanted: Wanted, check_interrupt: CheckInterrupt) -> list[Sensor]:
    """Take every sensor on the open `bus` to OP with the wanted settings.

    `check_interrupt` is called between the steps and may raise to give up. BusError says which sensor did
    not do what.
    """
    sensors = find_sensors(bus, wanted, check_interrupt)
    for sensor in sensors:
        sdo = GuardedSdo(BlockingSdo(bus, sensor.position, check_interrupt))
        finish(set_up(sdo, sensor), clock=bus.clock)
        _tell_offset(sdo, sensor)
    check_interrupt()
    enter_op(bus, sensors, check_interrupt)
    return sensors


def find_sensors(bus: Bus, wanted: Wanted, check_interrupt: CheckInterrupt) -> list[Sensor]:
    """Find the sensors on the open `bus`, in PREOP, and ask them who they are; nothing is written."""
    slaves = scan(bus, check_interrupt, force=wanted.force)
    for position, slave in enumerate(slaves):
        _check_vendor(bus.ifname, position, slave)
    bus.backend.check_preop(check_interrupt)
    sensors = [_find(bus, position, slave, wanted, check_interrupt) for position, slave in enumerate(slaves)]
    _check_places(bus.ifname, sensors, wanted)
    return sensors


def enter_op(bus: Bus, sensors: list[Sensor], check_interrupt: CheckInterrupt) -> None:
    """Map the process data of all `sensors` and take them from PREOP to OP, set as they are."""
    for sensor, size in zip(sensors, bus.backend.map_process_data(), strict=True):
        try:
            sensor.pdo_size = layout_for(size).size
        except PdoSizeError as error:
            bus.check_answers(sensor.position)
            who = f"sensor {sensor.position} ({sensor.identity.name})"
            if size == 0:  # the master could not read the mapping
                raise BusError(f"{who} did not answer what it maps: check cable and power") from None
            raise BusError(f"{who} maps {error}") from None
    bus.go_operational(check_interrupt)
    for sensor in sensors:
        sensor.enter(SensorState.STREAMING)


def _tell_offset(sdo: Sdo, sensor: Sensor) -> None:
    """A tare of before, saved or not, is in all samples: it is to be known, and to outlive a power cut."""
    try:
        offset = finish(read_offset(sdo), clock=sdo.clock)
    except SdoAbortError:
        return
    rows = [dictionary.BY_ADDRESS[dictionary.FORCE_TORQUE_OFFSET, sub] for sub in range(1, 7)]
    texts = [f"{row.name} {value:g} {row.unit}" for row, value in zip(rows, offset, strict=True) if value]
    if texts:
        sensor.offset = offset
        log.info("sensor %d has a tare in force (saved or not): %s", sensor.position, ", ".join(texts))


def check_sii(ifname: str, position: int, slave: SlaveIdentity) -> None:
    """BusError if the slave's SII could not be read: nothing is known of it, its mailbox is not set up."""
    if not slave.vendor and not slave.product:
        raise BusError(
            f"the SII (EEPROM) of the slave at position {position} of {ifname} cannot be read, so it does "
            "not say what it is: power it off and on; if that does not help, its EEPROM is damaged"
        )


def _check_vendor(ifname: str, position: int, slave: SlaveIdentity) -> None:
    check_sii(ifname, position, slave)
    if (slave.vendor, slave.product) != (dictionary.VENDOR_ID, dictionary.PRODUCT_CODE):
        raise BusError(
            f"the slave at position {position} of {ifname} is {slave.name or 'nameless'!r} (vendor "
            f"0x{slave.vendor:08X}, product 0x{slave.product:08X}), not a Bota Gen-0 sensor (vendor "
            f"0x{dictionary.VENDOR_ID:08X}, product {dictionary.PRODUCT_CODE}): connect only such sensors"
        )


def _find(
    bus: Bus, position: int, slave: SlaveIdentity, wanted: Wanted, check_interrupt: CheckInterrupt
) -> Sensor:
    try:
        identity = finish(identify(BlockingSdo(bus, position, check_interrupt), slave.name), clock=bus.clock)
    except BusError:
        if finish(has_coe(bus, position), clock=bus.clock):
            raise
        raise BusError(
            f"sensor {position} on {bus.ifname} has no CoE mailbox, and so no objects to set it up by: it is "
            "no Bota Gen-0 sensor, or its EEPROM is damaged"
        ) from None
    if not is_known_model(identity.name):
        raise BusError(
            f"sensor {position} on {bus.ifname} is a {identity.name!r}, a model this server does not know: "
            f"it knows the Gen-0 models {', '.join(dictionary.MODELS)}"
        )
    who = (position, identity.name, identity.serial)
    return Sensor(position, identity, wanted.wanted_settings(*who), frozenset(wanted.asked_settings(*who)))


def _check_places(ifname: str, sensors: list[Sensor], wanted: Wanted) -> None:
    if wanted.sensor_name is not None and sensors[0].identity.name != wanted.sensor_name:
        raise BusError(
            f"the sensor on {ifname} is a {sensors[0].identity.name}, not a {wanted.sensor_name}: "
            "correct the name on the command line or leave it out"
        )
    try:
        wanted.check_sensors({sensor.position: sensor.identity for sensor in sensors})
    except UsageError as error:
        raise BusError(str(error)) from None  # a sensor that is switched on later: the service tries again
