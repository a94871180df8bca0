"""What is looked at before a bus is scanned, and that looking changes nothing."""

from __future__ import annotations

import pytest

from ethercat_server.acquisition.start_up import AsFound, bring_up
from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, Command, build
from ethercat_server.sensor.scan import look_safely
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.virtual_sensor.foreign.slave import ForeignSlave
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.slave.al import AlState
from tests.simulated_links import chain, registers
from tests.simulation import Asked


def no_check() -> None:
    pass


@pytest.mark.parametrize("state", [AlState.OP, AlState.BOOT])
@pytest.mark.parametrize("drive", [0, 1, 2])
def test_a_drive_at_work_is_not_touched(drive: int, state: AlState) -> None:
    """In BOOT its firmware may be being written."""
    kinds = ["BOTA:OP"] * 3
    kinds[drive] = "DRIVE:OP"
    backend = chain(",".join(kinds))
    found = backend.sensors.slaves[drive]
    assert isinstance(found, ForeignSlave)
    assert found.life is not None
    found.life.esc.memory[reg.AL_STATUS] = state
    before = registers(backend)
    with pytest.raises(BusError, match=rf"no Bota sensors \(position {drive} in {state.name}\).*--force"):
        bring_up(bus := Bus(backend), Asked(), no_check)
    bus.close()
    assert registers(backend) == before
    assert not found.writes
    assert found.turning


def test_force_takes_it_over() -> None:
    backend = chain("BOTA:OP,DRIVE:OP")
    found = bring_up(Bus(backend), AsFound(force=True), no_check)
    assert ([s.position for s in found.sensors], [o.position for o in found.others]) == ([0], [1])
    assert [image[0x0130] & 0x0F for image in registers(backend)] == [AlState.OP, AlState.PREOP]


@pytest.mark.parametrize("pdo_size", [61, 77])
def test_a_sensor_left_in_op_is_no_obstacle(pdo_size: int) -> None:
    backend = MemoryBackend(*(SensorOptions(pdo_size=size, state=AlState.OP) for size in (pdo_size, 61)))
    sensors = bring_up(Bus(backend), Asked(), no_check).sensors
    assert [sensor.streams for sensor in sensors] == [True, True]


def test_a_drive_that_is_not_at_work_may_be_scanned() -> None:
    slaves = look_safely(Bus(chain("BOTA:OP,DRIVE:PREOP")), no_check)
    assert [slave.name for slave in slaves] == ["BFT-SENS-ECAT-M8", "DRIVE"]


def test_an_eeprom_is_not_asked_without_pause_whether_it_has_read_a_word() -> None:
    backend = MemoryBackend()
    bring_up(Bus(backend), Asked(), no_check)
    assert backend.sensors.frames < 1500, "half of them are for the EEPROM: 107 reads of 2 ms"


class OthersFrames(MemoryBackend):
    """Frames of another master come by, one each `every_s`."""

    def __init__(self, every_s: float, limit: int) -> None:
        super().__init__(SensorOptions())
        self._every_s, self._left = every_s, limit

    def receive(self, timeout_s: float) -> bytes | None:
        if not self._on_the_wire and self._left and timeout_s >= self._every_s:
            self._left -= 1
            self.clock.sleep(self._every_s)
            return bytes(build((Command.LRW, 0, 0, bytes(20))))
        return super().receive(timeout_s)


def test_another_master_is_left_alone() -> None:
    backend = OthersFrames(0.01, 1000)
    before = registers(backend)
    with pytest.raises(BusError, match=r"another EtherCAT master is sending on .*: stop it"):
        look_safely(Bus(backend), no_check)
    assert registers(backend) == before


def test_the_last_frames_of_a_killed_master_are_no_obstacle() -> None:
    assert len(look_safely(Bus(OthersFrames(0.001, 2)), no_check)) == 1


def test_a_slave_that_stops_answering_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = chain("BOTA:OP")
    send = backend.send

    def lose_single_reads(frame: bytes | bytearray) -> None:
        if frame[DATAGRAM_INDEX - 1] != Command.APRD:
            send(frame)

    monkeypatch.setattr(backend, "send", lose_single_reads)
    with pytest.raises(BusError, match="slave 0 on memory does not answer: check cable and power"):
        look_safely(Bus(backend), no_check)


def test_a_bus_that_loses_frames_is_looked_at_all_the_same() -> None:
    backend = chain("BOTA:OP,DRIVE:OP")
    backend.command("lose 2")
    with pytest.raises(BusError, match="position 1 in OP"):
        look_safely(Bus(backend), no_check)
