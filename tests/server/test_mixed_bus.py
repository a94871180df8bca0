"""Sensors among the devices of other vendors: they stream as if alone, and nothing is done to the others."""

from __future__ import annotations

import itertools
import random
import struct
from typing import Final

import pytest

from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.foreign.chain import parse_chain, slaves_in
from ethercat_server.virtual_sensor.foreign.slave import ForeignSlave
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.slave.al import AlState
from tests.exchanging import Exchange
from tests.simulated_links import chain, registers
from tests.simulation import OLD, Asked, Simulation, check_frames, more_if_long, reading

READING_THE_SII: Final = range(reg.SII_OWNER, reg.SII_DATA)
"""All that may be written to a slave that is no sensor."""
KINDS: Final = ("EK1100", "EL3102", "DRIVE", "DRIVE:PREOP")


def mixed(text: str, machine: Machine | None = None) -> Simulation:
    """A server on this chain, its sensors with clocks of their own."""
    sensors = [SensorOptions(signal="clock", serial=1 + n, ppm=150.0 - 200 * n) for n in range(2)]
    return Simulation(backend=MemoryBackend(*slaves_in(parse_chain(text), sensors), machine=machine))


def every_chain() -> list[str]:
    """Every order of one or two sensors among other devices, six slaves at most."""
    found = []
    for others in range(6):
        for sensors in (1, 2):
            if others + sensors > 6:
                continue
            for places in itertools.combinations(range(others + sensors), sensors):
                kinds = itertools.cycle(KINDS[others % 3 :] + KINDS[: others % 3])
                found.append(
                    ",".join("BOTA" if at in places else next(kinds) for at in range(others + sensors))
                )
    return found


def foreign(simulation: Simulation) -> list[ForeignSlave]:
    return [slave for slave in simulation.backend.sensors.slaves if isinstance(slave, ForeignSlave)]


def memory_of(backend: MemoryBackend, position: int) -> bytearray:
    """Registers and process data of a slave."""
    life = backend.sensors.slaves[position].life
    assert life is not None
    return life.esc.memory


def check_each(simulation: Simulation) -> None:
    for number in range(len(simulation.sensors)):
        check_frames(frame for frame in simulation.frames if frame.sensor == number)


def states_of(text: str) -> list[AlState]:
    """In which the others were found."""
    kinds = [kind for kind in text.split(",") if kind != "BOTA"]
    return [AlState.PREOP if "PREOP" in kind else AlState.INIT for kind in kinds]


def assert_left_alone(simulation: Simulation, states: list[AlState]) -> None:
    for slave, state in zip(foreign(simulation), states, strict=True):
        assert slave.life is not None
        assert slave.life.al.state == state
        assert {address for address, _ in slave.writes} <= set(READING_THE_SII), slave.writes


@pytest.mark.parametrize("text", more_if_long(every_chain()[::6], every_chain()))
def test_sensors_stream_as_if_alone(text: str) -> None:
    places = [at for at, kind in enumerate(text.split(",")) if kind == "BOTA"]
    simulation = mixed(text)
    simulation.run(1.0)
    check_each(simulation)
    for number, sensor in enumerate(simulation.sensors):
        assert sensor.position == places[number]
        assert len([frame for frame in simulation.frames if frame.sensor == number]) > 700
    assert [row["position"] for row in simulation.others.rows] == [
        at for at in range(len(text.split(","))) if at not in places
    ]
    assert_left_alone(simulation, states_of(text))
    simulation.close()
    assert_left_alone(simulation, states_of(text))


def test_one_that_goes_away_is_told_and_costs_the_sensor_before_it_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """`describe` has the others, and who is gone."""
    simulation = mixed("EK1100,BOTA,EL3102,BOTA,DRIVE:PREOP")
    client = simulation.connect()

    def others() -> list[tuple[int, str, str]]:
        return [(row["position"], row["name"], row["state"]) for row in client.ask("describe")["others"]]

    described = client.ask("describe")
    assert [(row["sensor"], row["position"]) for row in described["sensors"]] == [(0, 1), (1, 3)]
    assert (described["others"][0]["vendor"], described["others"][0]["product"]) == (2, 0x044C2C52)
    assert others() == [(0, "EK1100", "INIT"), (2, "EL3102", "INIT"), (4, "DRIVE", "PREOP")]
    simulation.run(0.5)
    simulation.command("power off #4")
    simulation.run(2.5)
    assert others()[2] == (4, "DRIVE", "ABSENT")
    assert "'DRIVE' at position 4" in caplog.text
    simulation.command("power on #4")
    simulation.run(1.0)
    assert others()[2] == (4, "DRIVE", "INIT")
    check_each(simulation)
    assert simulation.events == []


@pytest.mark.parametrize("fault", ["power cycle 0.3", "deaf 0.3", "error 0x1B @0"])
@pytest.mark.parametrize("text", ["EK1100,BOTA,DRIVE:PREOP", "DRIVE:PREOP,BOTA,BOTA", "BOTA,EL3102"])
def test_a_sensor_among_others_comes_back(text: str, fault: str) -> None:
    simulation = mixed(text)
    simulation.run(0.5)
    simulation.command(fault)
    simulation.run(3.0)
    assert all(sensor.streams for sensor in simulation.sensors)
    check_each(simulation)
    assert_left_alone(simulation, states_of(text))


@pytest.mark.parametrize("seed", more_if_long(range(4), range(40)))
def test_on_a_wire_that_loses_frames(seed: int) -> None:
    text = random.Random(seed).choice(every_chain())
    simulation = mixed(text, Machine(seed=seed, lost=0.01))
    simulation.run(1.0)
    for number in range(len(simulation.sensors)):
        new = [f for f in simulation.frames if f.sensor == number and not f.flags & OLD]
        assert len(new) > 700
        assert all(reading(b).instant_ns > reading(a).instant_ns for a, b in itertools.pairwise(new))
    assert all(
        {address for address, _ in slave.writes} <= set(READING_THE_SII) for slave in foreign(simulation)
    )


def test_addresses_that_others_answer_to_are_not_taken() -> None:
    """What another master left: its station addresses, and FMMUs that are active still."""
    backend = chain("DRIVE:OP,BOTA,DRIVE:OP")
    before = registers(backend)
    with pytest.raises(BusError, match="slaves at work"):
        bring_up(Bus(backend), Asked(), lambda: None)
    assert registers(backend) == before

    class Forced(Asked):
        force = True

    sensors, others = bring_up(bus := Bus(backend), Forced(), lambda: None)
    assert [sensor.streams for sensor in sensors] == [True]
    assert [slave.status.state.name for slave in others] == ["PREOP"] * 2
    theirs = {before[at][reg.STATION_ADDRESS : reg.STATION_ADDRESS + 2] for at in (0, 2)}
    assert bus.stations[0].to_bytes(2, "little") not in theirs
    assert bus.process_data.counters == [(3,)]
    assert Exchange(bus)() == 3, "no FMMU of another answers to it"
    taken = [range(start, start + size) for image in (before[0], before[2]) for start, size in fmmus(image)]
    assert taken
    (own, _), *_ = fmmus(registers(backend)[1])
    assert not any(own in area for area in taken)


def fmmus(registers: bytes) -> list[tuple[int, int]]:
    """Logical start and length of those that are active."""
    rows = (struct.unpack_from("<IH", registers, reg.FMMU + at * reg.FMMU_SIZE) for at in range(2))
    return [(start, size) for start, size in rows if size]


def test_a_station_that_another_sensor_has_as_its_alias_is_not_taken() -> None:
    backend = chain("BOTA,DRIVE,BOTA")
    memory = memory_of(backend, 2)
    memory[reg.STATION_ALIAS : reg.STATION_ALIAS + 2] = b"\x01\x10"
    simulation = Simulation(backend=backend)
    assert simulation.bus.stations == [0x1002, 0x1003]


def test_more_fmmus_than_ours_were_used_by_the_master_before() -> None:
    """Such as the one with which masters watch for a full mailbox."""
    backend = chain("BOTA,DRIVE")
    unit = struct.pack("<IHBBHBBB3x", 0x5000, 1, 0, 7, reg.MAILBOX_IN_STATUS, 0, 1, 1)
    backend.sensors.slaves[0].life.esc.write(reg.FMMU + 2 * reg.FMMU_SIZE, unit)  # type: ignore[union-attr]
    simulation = Simulation(backend=backend)
    simulation.run(0.3)
    assert {len(frame.process_data) for frame in simulation.frames} == {61}


@pytest.mark.parametrize(
    ("index", "subindex"), [(0x1C13, 0), (0x1C13, 1), (0x1A00, 0)], ids=lambda number: f"{number:#x}"
)
def test_a_mapping_that_cannot_be_is_one_sentence(index: int, subindex: int) -> None:
    backend = chain("BOTA,DRIVE")
    life = backend.sensors.sensors[0].life
    assert life is not None
    read = life.read
    life.read = lambda *address: bytes(4 * [0xFF]) if address == (index, subindex) else read(*address)  # type: ignore[method-assign]
    life.length = lambda *address: len(life.read(*address))  # type: ignore[method-assign]
    with pytest.raises(BusError, match=f"sensor 0 has 0xffffffff in object 0x{index:04X}:{subindex}"):
        bring_up(Bus(backend), Asked(), lambda: None)


@pytest.mark.parametrize("state", ["INIT", "PREOP"])
def test_a_device_in_the_place_of_a_sensor_keeps_its_eeprom(state: str) -> None:
    """The sensor was taken out, and the cable goes to the next device."""
    simulation = mixed(f"BOTA,BOTA,DRIVE:{state}")
    simulation.run(0.3)
    (drive,), memory = foreign(simulation), memory_of(simulation.backend, 2)
    memory[reg.SII_OWNER] = 1
    del simulation.backend.sensors.slaves[1]
    simulation.backend.sensors.rewire()
    drive.writes.clear()
    simulation.run(2.0)
    assert memory[reg.SII_OWNER] == 1
    assert len(drive.writes) < 60
    assert {address for address, _ in drive.writes} <= (set(READING_THE_SII) if state == "INIT" else set())
    assert [sensor.streams for sensor in simulation.sensors] == [True, False]


def test_one_that_does_not_say_what_it_is(caplog: pytest.LogCaptureFixture) -> None:
    """It may be a sensor: the one behind it would be sensor 0 then, with the settings of another."""
    for text, start in (
        ("BOTA,BOTA,EK1100", False),
        ("BOTA,EK1100,DRIVE", False),
        ("EK1100,BOTA,DRIVE", True),
    ):
        backend = chain(text)
        backend.command(f"sii busy #{2 if start else 0}")
        if start:
            assert [sensor.position for sensor in Simulation(backend=backend).sensors] == [1]
        else:
            with pytest.raises(BusError, match="position 0 of memory cannot be read"):
                bring_up(Bus(backend), Asked(), lambda: None)
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["'nameless' at position 2 (its SII cannot be read) is left alone: it stays in INIT"]


def test_what_another_master_left_is_ended() -> None:
    """A sensor would wait for SYNC0, and for its EEPROM."""
    backend = chain("BOTA:OP,EK1100")
    for at in range(2):
        memory_of(backend, at)[reg.DC_ACTIVATION + 1] = 3
        memory_of(backend, at)[reg.SII_OWNER] = 0
    assert bring_up(Bus(backend), Asked(), lambda: None).sensors[0].streams
    assert [memory_of(backend, at)[reg.DC_ACTIVATION + 1] for at in range(2)] == [0, 3]
    assert [memory_of(backend, at)[reg.SII_OWNER] for at in range(2)] == [1, 0]


@pytest.mark.parametrize("seconds", [0.0, 0.4, 60.0])
def test_firmware_that_reads_its_eeprom_may_finish(seconds: float) -> None:
    backend = chain("DRIVE,BOTA")
    drive = backend.sensors.slaves[0]
    assert isinstance(drive, ForeignSlave)
    memory = memory_of(backend, 0)
    memory[reg.SII_OWNER : reg.SII_OWNER + 2] = b"\1\1"
    began_ns = backend.clock.now_ns

    def finish() -> None:
        assert not drive.writes
        memory[reg.SII_OWNER + 1] = 0

    if seconds < 1:
        backend.clock.at(began_ns + round(seconds * 1e9), finish)
    assert bring_up(Bus(backend), Asked(), lambda: None).others[0].name == "DRIVE"
    assert memory[reg.SII_OWNER] == 1, "it is the firmware's again"
