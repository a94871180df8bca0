"""Brings the bus from power-on to streaming: find, check, set up, map, OP.

What the sensors must be is checked before anything is written to one of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from ethercat_server import objects
from ethercat_server.bus import Bus
from ethercat_server.errors import BusError, SdoAbortError, UsageError
from ethercat_server.options import ServerOptions
from ethercat_server.sdo import BlockingSdo, Sdo, Steps, finish
from ethercat_server.sensor import Sensor, identify, is_known_model, read_offset, set_up
from ethercat_server.sii import has_coe
from ethercat_server.soem import SlaveIdentity
from protocol.errors import PdoSizeError
from protocol.pdo import layout_for

log = logging.getLogger(__name__)


class _InterruptibleSdo(BlockingSdo):
    """A sensor that is slow to answer makes a start of many transfers long: one may give up between them."""

    def __init__(self, bus: Bus, slave: int, check_interrupt: Callable[[], None]) -> None:
        super().__init__(bus, slave)
        self._check_interrupt = check_interrupt

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        self._check_interrupt()
        return super().read(index, subindex)

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`."""
        self._check_interrupt()
        return super().write(index, subindex, data)


def bring_up(bus: Bus, options: ServerOptions, check_interrupt: Callable[[], None]) -> list[Sensor]:
    """Take every sensor on the open `bus` to OP with the wanted settings.

    `check_interrupt` is called between the steps and may raise to give up. BusError says which sensor did
    not do what.
    """
    sensors = find_sensors(bus, options, check_interrupt)
    for sensor in sensors:
        sdo = _InterruptibleSdo(bus, sensor.place, check_interrupt)
        finish(set_up(sdo, sensor))
        _tell_offset(sdo, sensor)
    check_interrupt()
    enter_op(bus, sensors, check_interrupt)
    return sensors


def find_sensors(bus: Bus, options: ServerOptions, check_interrupt: Callable[[], None]) -> list[Sensor]:
    """Find the sensors on the open `bus`, in PREOP, and ask them who they are; nothing is written."""
    slaves = bus.scan(check_interrupt)
    for place, slave in enumerate(slaves):
        _check_vendor(bus.ifname, place, slave)
    bus.check_preop(check_interrupt)
    sensors = [_find(bus, place, slave, options, check_interrupt) for place, slave in enumerate(slaves)]
    _check_places(sensors, options)
    return sensors


def enter_op(bus: Bus, sensors: list[Sensor], check_interrupt: Callable[[], None]) -> None:
    """Map the process data of all `sensors` and take them from PREOP to OP, set as they are."""
    for sensor, size in zip(sensors, bus.map_process_data(), strict=True):
        try:
            sensor.pdo_size = layout_for(size).size
        except PdoSizeError as error:
            bus.check_answers(sensor.place)
            raise BusError(f"sensor {sensor.place} ({sensor.identity.name}) maps {error}") from None
    bus.go_operational(check_interrupt)
    for sensor in sensors:
        sensor.state = "OP"


def _tell_offset(sdo: Sdo, sensor: Sensor) -> None:
    """A tare of before, saved or not, is in all samples: it is to be known, and to outlive a power cut."""
    try:
        offset = finish(read_offset(sdo))
    except SdoAbortError:
        return
    rows = [objects.BY_ADDRESS[objects.FORCE_TORQUE_OFFSET, sub] for sub in range(1, 7)]
    texts = [f"{row.name} {value:g} {row.unit}" for row, value in zip(rows, offset, strict=True) if value]
    if texts:
        sensor.offset = offset
        log.info("sensor %d has a tare in force (saved or not): %s", sensor.place, ", ".join(texts))


def check_sii(ifname: str, place: int, slave: SlaveIdentity) -> None:
    """BusError if the slave's SII could not be read: nothing is known of it, its mailbox is not set up."""
    if not slave.vendor and not slave.product:
        raise BusError(
            f"the SII (EEPROM) of the slave at place {place} of {ifname} cannot be read, so it does not say "
            "what it is: power it off and on; if that does not help, its EEPROM is damaged"
        )


def _check_vendor(ifname: str, place: int, slave: SlaveIdentity) -> None:
    check_sii(ifname, place, slave)
    if (slave.vendor, slave.product) != (objects.VENDOR_ID, objects.PRODUCT_CODE):
        raise BusError(
            f"the slave at place {place} of {ifname} is {slave.name or 'nameless'!r} (vendor "
            f"0x{slave.vendor:08X}, product 0x{slave.product:08X}), not a Bota Gen-0 sensor (vendor "
            f"0x{objects.VENDOR_ID:08X}, product {objects.PRODUCT_CODE}): connect only such sensors"
        )


def _find(
    bus: Bus, place: int, slave: SlaveIdentity, options: ServerOptions, check_interrupt: Callable[[], None]
) -> Sensor:
    try:
        identity = finish(identify(_InterruptibleSdo(bus, place, check_interrupt), slave.name))
    except BusError:
        if finish(has_coe(bus, place)):
            raise
        raise BusError(
            f"sensor {place} on {bus.ifname} has no CoE mailbox, and so no objects to set it up by: it is "
            "no Bota Gen-0 sensor, or its EEPROM is damaged"
        ) from None
    if not is_known_model(identity.name):
        raise BusError(
            f"sensor {place} on {bus.ifname} is a {identity.name!r}, a model this server does not know: "
            f"it knows the Gen-0 models {', '.join(objects.MODELS)}"
        )
    who = (place, identity.name, identity.serial)
    return Sensor(place, identity, options.wanted_settings(*who), frozenset(options.asked_settings(*who)))


def _check_places(sensors: list[Sensor], options: ServerOptions) -> None:
    if options.sensor_name is not None and sensors[0].identity.name != options.sensor_name:
        raise BusError(
            f"the sensor on {options.ifname} is a {sensors[0].identity.name}, not a {options.sensor_name}: "
            "correct the name on the command line or leave it out"
        )
    try:
        options.check_sensors({sensor.place: sensor.identity for sensor in sensors})
    except UsageError as error:
        raise BusError(str(error)) from None  # a sensor that is switched on later: the service tries again
