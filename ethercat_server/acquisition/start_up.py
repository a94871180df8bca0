"""Brings the bus from power-on to streaming: find, check, set up, map, OP.

What the sensors must be is checked before anything is written to one of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, Protocol, TypeVar

from bota_ethercat.errors import PdoSizeError, SettingError
from bota_ethercat.pdo import layout_for
from bota_ethercat.settings import SETTINGS, SettingValue, check_combination, start_up_defaults
from ethercat_server.acquisition.terminal_choice import named_positions
from ethercat_server.acquisition.terminals import Terminal, find_terminals
from ethercat_server.errors import BusError, SdoAbortError, SetUpError, UsageError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.sensor import models
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.scan import Slave, scan_if_free
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState, is_known_model
from ethercat_server.sensor.set_up import identify, read_in_force, read_offset, set_up

T = TypeVar("T")
_ATTEMPTS: Final = 3
_MAILBOX_BYTES: Final = range(16, 1487)

log = logging.getLogger(__name__)


class Wanted(Protocol):
    """What is asked of the sensors: command line and configuration of the server, or nothing at all."""

    @property
    def sensor_name(self) -> str | None:
        """The model that the first sensor must be; None for any."""

    @property
    def force(self) -> bool:
        """Whether to take over a bus that is in use."""

    @property
    def keep_unset(self) -> bool:
        """Whether settings that nobody asked for stay as the sensors have them, not the defaults."""

    @property
    def terminals(self) -> Sequence[str]:
        """The slaves beside the sensors that are read, too; see `find_terminals`."""

    def wanted_settings(self, number: int, name: str, serial: int, /) -> dict[str, SettingValue]:
        """The settings to be in force in a sensor."""

    def asked_settings(self, number: int, name: str, serial: int, /) -> dict[str, SettingValue]:
        """Those among them that a person asked for."""

    def check_sensors(self, found: Mapping[int, Identity], /) -> None:
        """UsageError if something is asked of a sensor that is not there."""


class AsFound:
    """Nothing is asked: the sensors stay set as they are."""

    sensor_name = None
    keep_unset = True
    terminals = ()

    def __init__(self, *, force: bool = False) -> None:
        self.force = force

    def wanted_settings(self, _number: int, _name: str, _serial: int) -> dict[str, SettingValue]:
        return {}

    asked_settings = wanted_settings

    def check_sensors(self, found: Mapping[int, Identity]) -> None:
        """Accept all: nothing is asked of any."""


class Started(NamedTuple):
    """The sensors on a bus, by number, and the slaves beside them: left alone, and read."""

    sensors: list[Sensor]
    others: list[Slave]
    terminals: list[Terminal]


def bring_up(bus: Bus, wanted: Wanted, check_interrupt: CheckInterrupt) -> Started:
    """Take every sensor on the open `bus` to OP with the wanted settings.

    `check_interrupt` is called between the steps and may raise to give up. BusError says which sensor did
    not do what.
    """
    found = _find_sensors(bus, wanted, check_interrupt)
    for sensor in found.sensors:
        sdo = GuardedSdo(bus.slaves[sensor.number].sdo)
        bus.finish(_prepare(sdo, sensor, wanted), check_interrupt)

    def enter_op(again: bool) -> None:
        if again:
            bus.scan_again(check_interrupt)
        for sensor, size in zip(found.sensors, bus.map_process_data(check_interrupt), strict=True):
            try:
                sensor.pdo_size = layout_for(size).size
            except PdoSizeError as error:
                # Also what it seems to be if the answer to one of the master's questions was lost.
                raise SetUpError(f"sensor {sensor.number} ({sensor.identity.name}) maps {error}") from None
        bus.enter_op(check_interrupt)

    _try_again(enter_op)
    for sensor in found.sensors:
        sensor.enter(SensorState.STREAMING)
        sensor.settle(bus.clock)
    return found


def _find_sensors(bus: Bus, wanted: Wanted, check_interrupt: CheckInterrupt) -> Started:
    """Find the sensors on the open `bus`, in PREOP, and ask them who they are; nothing is written."""
    ours = named_positions(wanted.terminals)
    slaves = scan_if_free(bus, check_interrupt, force=wanted.force, ours=ours)
    of_sensors = [slave for slave in slaves if slave.is_sensor]
    others = [slave for slave in slaves if not slave.is_sensor]
    unread = next((slave for slave in others if slave.sii is None), None)
    if unread is not None and (not of_sensors or unread.position < of_sensors[-1].position):
        # It may be a sensor: those behind it would have other numbers, and settings, than they should.
        raise BusError(
            f"the SII (EEPROM) of the slave at position {unread.position} of {bus.ifname} cannot be read, so "
            "it does not say what it is: power it off and on; if that does not help, its EEPROM is damaged"
        )
    if not of_sensors:
        raise BusError(
            f"no Bota Gen-0 sensor (vendor 0x{models.VENDOR_ID:08X}, product {models.PRODUCT_CODE}) "
            f"is on {bus.ifname}, only {', '.join(map(str, others))}: check the sensor's cable and power, "
            "and that this is the interface it is connected to"
        )
    for number, slave in enumerate(of_sensors):
        if not slave.has_coe or not any(_mailbox_sizes(slave)):
            raise BusError(
                f"sensor {number} on {bus.ifname} has no CoE mailbox, and so no objects to set it up by: its "
                "EEPROM is damaged"
            )
    terminals = find_terminals(others, wanted.terminals)
    for slave in (*of_sensors, *(terminal.slave for terminal in terminals)):
        _check_mailboxes(bus.ifname, slave)
    bus.input_sizes = {terminal.slave.position: terminal.size for terminal in terminals}
    others = [slave for slave in others if slave.position not in bus.input_sizes]

    def find(again: bool) -> list[Sensor]:
        positions, sii = [slave.position for slave in of_sensors], [slave.sii for slave in slaves]
        bus.scan(positions, sii, check_interrupt, again=again)
        return [_find(bus, number, slave, wanted, check_interrupt) for number, slave in enumerate(of_sensors)]

    sensors = _try_again(find)
    for number, terminal in enumerate(terminals, len(sensors)):
        terminal.start(bus, number)
    if wanted.sensor_name is not None and sensors[0].identity.name != wanted.sensor_name:
        raise BusError(
            f"the sensor on {bus.ifname} is a {sensors[0].identity.name}, not {wanted.sensor_name!r}: "
            "correct the name on the command line or leave it out"
        )
    try:
        wanted.check_sensors({sensor.number: sensor.identity for sensor in sensors})
    except UsageError as error:
        raise BusError(str(error)) from None  # a sensor that is switched on later: the service tries again
    for slave in others:
        level = logging.WARNING if slave.sii is None else logging.INFO
        log.log(level, "%s is left alone: it stays in %s", slave, slave.status)
    return Started(sensors, others, terminals)


def _try_again(attempt: Callable[[bool], T]) -> T:
    """What `attempt` returns; SetUpError, which lost frames explain, has it called with True."""
    for number in range(_ATTEMPTS - 1):
        try:
            return attempt(number > 0)
        except SetUpError as error:
            log.warning("%s: trying again", error)
    return attempt(True)


def _prepare(sdo: Sdo, sensor: Sensor, wanted: Wanted) -> Steps[None]:
    """In PREOP: write what is wanted, or only read what is in force."""
    if isinstance(wanted, AsFound):
        yield from read_in_force(sdo, sensor)
        if "sinc_length" not in sensor.wanted:
            raise BusError(f"sensor {sensor.number} does not report its sampling rate: power it off and on")
    else:
        if wanted.keep_unset:
            yield from _keep_unset(sdo, sensor)
        yield from set_up(sdo, sensor)
    yield from _note_offset(sdo, sensor)


def _keep_unset(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    """Want what the sensor has where nobody asked for anything; BusError if the two are inconsistent."""
    asked = dict(sensor.wanted)
    yield from read_in_force(sdo, sensor, asked)
    kept = {name: value for name, value in sensor.wanted.items() if name not in asked}
    sensor.wanted = {"sinc_length": start_up_defaults()["sinc_length"], **kept, **asked}
    try:
        check_combination(sensor.wanted)
    except SettingError as error:
        raise BusError(f"sensor {sensor.number} keeps settings that contradict those set: {error}") from None
    sensor.asked = frozenset(sensor.wanted)
    texts = [
        f"{name} = {str(value).lower()}"
        for name, value in kept.items()
        if SETTINGS[name].default not in (None, value)
    ]
    log.info("sensor %d keeps what nobody set: %s", sensor.number, ", ".join(texts) or "the defaults")


def _note_offset(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    """A tare of before, saved or not, is in all samples: it is to be known, and to outlive a power cut."""
    try:
        offset = sensor.offset = yield from read_offset(sdo)
    except SdoAbortError:
        return
    rows = [dictionary.BY_ADDRESS[dictionary.FORCE_TORQUE_OFFSET, sub] for sub in range(1, 7)]
    texts = [f"{row.name} {value:g} {row.unit}" for row, value in zip(rows, offset, strict=True) if value]
    if texts:
        log.info("sensor %d has a tare in force (saved or not): %s", sensor.number, ", ".join(texts))


def _mailbox_sizes(slave: Slave) -> list[int]:
    assert slave.sii is not None
    return [size for _, size in slave.sii["mailboxes"].values()]


def _check_mailboxes(ifname: str, slave: Slave) -> None:
    """BusError for mailboxes that no master can use: pysoem would not notice."""
    if any(sizes := _mailbox_sizes(slave)) and not all(size in _MAILBOX_BYTES for size in sizes):
        raise BusError(
            f"the SII (EEPROM) of the slave at position {slave.position} of {ifname} has mailboxes of "
            f"{' and '.join(map(str, sizes))} bytes, which no frame can carry: its EEPROM is damaged"
        )


def _find(bus: Bus, number: int, slave: Slave, wanted: Wanted, check_interrupt: CheckInterrupt) -> Sensor:
    identity = bus.finish(identify(bus.slaves[number].sdo, slave.name), check_interrupt)
    if not is_known_model(identity.name):
        raise BusError(
            f"sensor {number} on {bus.ifname} is a {identity.name!r}, a model this server does not know: "
            f"it knows the Gen-0 models {', '.join(models.MODELS)}"
        )
    who = (number, identity.name, identity.serial)
    asked = frozenset(wanted.asked_settings(*who))
    return Sensor(number, identity, wanted.wanted_settings(*who), asked, slave.position)
