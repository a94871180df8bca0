"""The start of a server: what is looked at and set up, beside other devices too; it ends in one sentence.

After that nothing is left behind, and the devices of others are as they were.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import pytest

from ethercat_server.acquisition.start_up import Started, Wanted, bring_up
from ethercat_server.daemon.cli import main
from ethercat_server.daemon.options import parse_options
from ethercat_server.errors import BusError, ServerError, SetUpError, StopRequestedError, UsageError
from ethercat_server.ethercat import nic
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import claimed
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.controller import SlaveController
from ethercat_server.ethercat.slave.registers import FMMU, FMMU_SIZE, SYNC_MANAGER, pack_sync_manager
from ethercat_server.ethercat.soem import SoemBackend
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, Command, build
from ethercat_server.process import realtime
from ethercat_server.sensor import scan
from ethercat_server.sensor.objects.dictionary import BY_SETTING
from ethercat_server.sensor.scan import scan_if_free
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.virtual_sensor import virtual_bus
from ethercat_server.virtual_sensor.dictionary import Dictionary
from ethercat_server.virtual_sensor.foreign import ForeignSlave
from ethercat_server.virtual_sensor.options import SensorOptions, parse_chain, slaves_in
from tests.ended import completed, run_here
from tests.rights import NET_ADMIN, NET_RAW, without
from tests.server.running import (
    ATTEMPTS,
    Program,
    Server,
    Veth,
    free_port,
    needs_bus,
    on_a_bus,
    starved,
    virtual_sensor,
    wait_until,
)
from tests.simulation import (
    Exchange,
    Simulation,
    asked,
    chain,
    check_frames,
    life_of,
    more_if_long,
    registers,
)
from tests.tool import odd_firmware

Way = Callable[[pytest.MonkeyPatch], None]

# -- what ends before there is a bus, in this process


def descriptors() -> set[str]:
    return {path.name for path in Path("/proc/self/fd").iterdir()}


def interfaces() -> set[str]:
    return {name for _, name in socket.if_nameindex()}


def fails(caplog: pytest.LogCaptureFixture, *arguments: str, code: int = 1) -> str:
    """Run a server here that cannot start; returns the sentence it said."""
    port, before = free_port(), descriptors()
    caplog.clear()
    ended = run_here(main, *(argument.replace("PORT", str(port)) for argument in arguments))
    assert ended.code == code, (ended, caplog.text)
    with socket.socket() as sock:
        assert sock.connect_ex(("127.0.0.1", port)) != 0
    assert descriptors() <= before
    wait_until(lambda: f"ecat{os.getpid()}" not in interfaces(), "the virtual bus to be gone")
    assert "Traceback" not in caplog.text
    (said,) = caplog.messages
    return said


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        ("nope0 PORT", 1, "no network interface 'nope0' on this machine: there are .*lo"),
        ("a-name-that-is-too-long PORT", 1, "1 to 15 characters"),
        ("virtual PORT --set colour=1", 2, "no setting 'colour'"),
    ],
)
def test_wrong_arguments(caplog: pytest.LogCaptureFixture, arguments: str, code: int, complaint: str) -> None:
    assert re.search(complaint, fails(caplog, *arguments.split(), code=code))


def test_too_few_open_files() -> None:
    """A process, whose listening sockets are too many."""
    command = f"ulimit -n 6; exec {sys.executable} -m ethercat_server.daemon.cli lo {free_port()}"
    done = completed("bash", "-c", command, timeout=60)
    sentence = "the server may open too few files (ulimit -n): allow it 256 at least"
    assert (done.returncode, done.stderr) == (1, f"ethercat-server: {sentence}\n")


@on_a_bus
def test_interfaces_without_sensor(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel's flags of an interface, pysoem's scan."""
    with Veth() as veth:
        with monkeypatch.context() as unprepared:  # or this process would stay so
            unprepared.setattr(realtime, "prepare", lambda *_, **__: None)
            said = fails(caplog, veth.near, "PORT", "--user", "root")
        assert "no EtherCAT slave answers" in said
        monkeypatch.setattr(nic, "_CARRIER_TIMEOUT_S", 0.1)
        veth.ip("link", "set", veth.near, "down")
        assert f"{veth.near} is down: bring it up" in fails(caplog, veth.near, "PORT")
        veth.ip("link", "set", veth.far, "down")
        veth.ip("link", "set", veth.near, "up")
        assert f"{veth.near} has no carrier: check the cable" in fails(caplog, veth.near, "PORT")


def test_a_port_that_is_taken(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        said = fails(caplog, "virtual", str(port))
    assert f"port {port} on 127.0.0.1 is in use by another program, process {os.getpid()} (" in said
    assert said.endswith(f"): stop that one, or choose port {port % 65535 + 1}")


@needs_bus
def test_an_interface_that_is_taken_is_said_before_a_port_that_is(caplog: pytest.LogCaptureFixture) -> None:
    """Another port would lead to the next error only."""
    with virtual_sensor() as (veth, sensor), socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        said = fails(caplog, veth.far, port, "--user", "root")
        assert said.startswith(f"{veth.far} is in use by a virtual sensor, process {sensor.process.pid} (")
        with claimed(veth.near), contextlib.closing(backend := SoemBackend(veth.near)):
            backend.open()
            said = fails(caplog, veth.near, port, "--user", "root")
        assert said.startswith(f"{veth.near} is in use by another EtherCAT master, process {os.getpid()} (")


# -- sensors that are not what they must be, in memory


def start(backend: MemoryBackend, wanted: Wanted | None = None) -> Started:
    return bring_up(Bus(backend), wanted or asked(), lambda: None)


def refused(backend: MemoryBackend, wanted: Wanted | None = None, code: int = 1) -> str:
    """Why a start fails; the sensors are in INIT afterwards."""
    bus = Bus(backend)
    with pytest.raises(ServerError) as info:
        bring_up(bus, wanted or asked(), lambda: None)
    bus.close()
    assert all(sensor.statistics()["al_state"] in ("INIT", None) for sensor in backend.sensors.sensors)
    assert info.value.exit_code == code
    return str(info.value)


def eeprom(identity: bytes) -> Way:
    image = (bytes(16) + identity).ljust(128, b"\0").ljust(130, b"\xff")
    return lambda patch: patch.setattr(scan, "read_image", lambda *_: image)


def maps(size: int) -> Way:
    return lambda patch: patch.setattr(Bus, "map_process_data", lambda *_: [size])


def forgetful(patch: pytest.MonkeyPatch) -> None:
    """Accepts a setting and does not keep it."""
    write, range_of = Dictionary.write, BY_SETTING["acceleration_range_g"].address

    def forget(self: Dictionary, index: int, subindex: int, data: bytes, state: Any) -> None:
        if (index, subindex) != range_of:
            write(self, index, subindex, data, state)

    patch.setattr(Dictionary, "write", forget)


UNREADABLE = "the SII .EEPROM. of the slave at position 0 of memory cannot be read"


@pytest.mark.parametrize(
    ("way", "said"),
    [
        (odd_firmware.foreign, "no Bota Gen-0 .* only 'BFT-SENS-ECAT-M8' at position 0 .vendor 0x0000DEAD"),
        (odd_firmware.other_product, "vendor 0x0000B07A, product 0x00000007"),
        (odd_firmware.wrong_rate, "samples at 500 Hz, but sinc_length 64 implies 800 Hz"),
        (odd_firmware.no_mailbox, "sensor 0 on memory has no CoE mailbox, and so no objects to set it up by"),
        (eeprom(b""), UNREADABLE),
        (eeprom(b"\xad\xde\0\0\1"), "only 'nameless' at position 0 .vendor 0x0000DEAD"),
        ("sii error", UNREADABLE),
        ("sii busy", UNREADABLE),
        (maps(65), "sensor 0 .BFT-SENS-ECAT-M8. maps process data of 65 bytes: .* 61 or 77"),
        (maps(0), "sensor 0 .BFT-SENS-ECAT-M8. maps process data of 0 bytes"),
        (
            "abort 0x8006 1 0x06090030",
            "sinc_length = 64 did not take.*: the value is out of range .abort 0x0609",
        ),
        (forgetful, "the setting acceleration_range_g = 8 did not take: sensor 0 holds .. after .. was"),
    ],
)
def test_a_sensor_wrong_in_one_way(monkeypatch: pytest.MonkeyPatch, way: Way | str, said: str) -> None:
    if not isinstance(way, str):
        way(monkeypatch)
    backend = MemoryBackend()
    if isinstance(way, str):
        backend.command(way)
    assert re.search(said, refused(backend, asked({"acceleration_range_g": 8})))


@pytest.mark.parametrize("blank", [b"\0", b"\xff"])
def test_a_blank_eeprom_beside_the_sensor_takes_no_longer_than_another(blank: bytes) -> None:
    def took_ns(image: bytes) -> int:
        backend = chain("BOTA,EK1100")
        life = backend.sensors.slaves[1].life
        assert life is not None
        life.esc.sii.image, life.esc.sii._read_ns = image or life.esc.sii.image, 2_000_000
        bus, began_ns = Bus(backend), backend.clock.now_ns
        bring_up(bus, asked(), lambda: None)
        bus.close()
        return backend.clock.now_ns - began_ns

    assert took_ns(blank * 0x4000) <= 1.1 * took_ns(b"")


@pytest.mark.parametrize(
    ("size", "terminals"),
    [*itertools.product((0, 15, 1487, 0xFFFF), ((), ("0",))), (16, ("0",)), (1486, ("0",))],
)
def test_mailboxes_that_no_frame_can_carry(
    monkeypatch: pytest.MonkeyPatch, size: int, terminals: Sequence[str]
) -> None:
    """pysoem would write beyond its buffers."""
    read_image = scan.read_image

    def odd_image(bus: Bus, position: int, check_interrupt: CheckInterrupt) -> bytes:
        image = bytearray(read_image(bus, position, check_interrupt))
        if position == 0:
            image[0x18 * 2 + 6 : 0x18 * 2 + 8] = size.to_bytes(2, "little")
        return bytes(image)

    monkeypatch.setattr(scan, "read_image", odd_image)
    backend = chain("EL3102,BOTA" if terminals else "BOTA")
    if 15 < size < 1487:
        assert start(backend, asked(terminals=terminals)).sensors
        return
    said = refused(backend, asked(terminals=terminals))
    assert f"position 0 of memory has mailboxes of 128 and {size} bytes, which no frame can carry" in said


@pytest.mark.parametrize("unit", [0, 1])
@pytest.mark.parametrize("times", [1, 2, 9])
def test_an_fmmu_that_was_not_written(monkeypatch: pytest.MonkeyPatch, unit: int, times: int) -> None:
    """SOEM does not notice; without outputs the sensor's watchdog would take it out of OP again and again."""
    map_process_data, left = Bus.map, [times]

    def odd(bus: Bus, slave: SlaveController, *arguments: Any) -> int:
        end = map_process_data(bus, slave, *arguments)
        left[0] -= 1
        if left[0] >= 0:
            bus.finish(slave.write(FMMU + unit * FMMU_SIZE, bytes(FMMU_SIZE)))
        return end

    monkeypatch.setattr(Bus, "map", odd)
    if times < 3:
        assert start(MemoryBackend()).sensors[0].streams
    else:
        assert "sensor 0 did not answer when it was mapped" in refused(MemoryBackend())


class Misled:
    """Numbers the sensors as SOEM does, but for a step that lost frames spoil."""

    def __init__(self, bus: Bus, step: str) -> None:
        self.bus, self.step = bus, step
        self.failed = 0

    def _do(self, step: str) -> None:
        if step == self.step:
            self.failed += 1
            raise SetUpError("sensor 0 maps process data of 57 bytes")

    def scan(self, positions: Sequence[int], _: CheckInterrupt) -> None:
        self._do("scan")
        self.bus.assign_stations(positions)
        if self.step != "mailboxes":
            for position in positions:
                managers = pack_sync_manager(0x1000, 128, 0x26) + pack_sync_manager(0x1080, 128, 0x22)
                assert self.bus.finish(self.bus.write_at(position, SYNC_MANAGER, managers))

    def map_process_data(self, _: CheckInterrupt) -> None:
        self._do("map_process_data")


@pytest.mark.parametrize(
    ("text", "step", "failed"),
    [
        ("BOTA", "scan", 1), ("BOTA", "mailboxes", 0), ("BOTA", "map_process_data", 1),
        ("BOTA", "nothing mapped", 0), ("BOTA,DRIVE:PREOP", "scan", 0),
    ],
)  # fmt: skip
def test_a_master_that_lost_frames_has_misled_is_replaced(text: str, step: str, failed: int) -> None:
    """As pysoem is, which does not repeat what it writes.

    Beside other slaves it is not asked: it would write to each before it counted them.
    """
    bus = Bus(backend := chain(text))
    backend.master = misled = Misled(bus, step)  # type: ignore[assignment]
    assert bring_up(bus, asked(), lambda: None).sensors[0].streams
    assert misled.failed == failed


class CountsOn(Misled):
    """Maps with mailbox counters of its own, as SOEM does: its last is the one that would be the next."""

    def map_process_data(self, check_interrupt: CheckInterrupt) -> None:
        bus = self.bus
        bus._soem = None
        bus.map_process_data(check_interrupt)
        bus._soem = self
        for slave in bus.slaves:
            bus.finish(slave.sdo.read(0x1008, 0))
            counter = max(2, slave.sdo._counter + 1 & 7)
            request = struct.pack("<HHBBHBHB4x", 10, 0, 0, 3 | counter << 4, 0x2000, 0x40, 0x1008, 0)
            assert bus.finish(bus.write_register(slave.number, 0x1000, request.ljust(128, b"\0")))
            bus.finish(bus.read_register(slave.number, 0x1080, 128))


def test_no_request_is_slow_whatever_counter_pysoem_left() -> None:
    bus = Bus(backend := chain("BOTA,BOTA"))
    backend.master = CountsOn(bus, "")  # type: ignore[assignment]
    bring_up(bus, asked(), lambda: None)
    for slave in bus.slaves:
        began_ns = backend.clock.now_ns
        bus.finish(slave.sdo.read(0x8011, 0))
        assert backend.clock.now_ns - began_ns < 100_000_000


def test_a_start_is_given_up_between_two_transfers() -> None:
    """Nothing more is written to the sensor then; it goes to INIT."""
    backend = MemoryBackend()
    (sensor,) = backend.sensors.sensors

    def check_interrupt() -> None:
        if sensor.statistics()["sdo_writes"]:
            raise StopRequestedError("asked to stop while starting")

    bus = Bus(backend)
    with pytest.raises(StopRequestedError):
        bring_up(bus, asked({"fir": True, "acceleration_range_g": 8}), check_interrupt)
    bus.close()
    assert len(sensor.statistics()["sdo_writes"]) == 1
    assert sensor.statistics()["al_state"] == "INIT"


def test_models_and_their_names() -> None:
    """Any known one if none is asked for, else the one that is."""
    strange = MemoryBackend(SensorOptions(model="BFT-GENA-THING"))
    assert "'BFT-GENA-THING', a model this server does not know" in refused(strange)
    rokubi = MemoryBackend(SensorOptions(model="BFT-ROKS-ECAT-M8"))
    wrong, right = (asked()._replace(sensor_name=f"BFT-{kind}-ECAT-M8") for kind in ("SENS", "ROKS"))
    assert "is a BFT-ROKS-ECAT-M8, not 'BFT-SENS-ECAT-M8'" in refused(rokubi, wrong)
    assert [sensor.streams for sensor in start(rokubi, right).sensors] == [True]


def test_settings_for_a_sensor_that_is_not_switched_on_yet(tmp_path: Path) -> None:
    """With the exit code 2 the service would stay as it is."""
    config = tmp_path / "c.toml"
    config.write_text("[sensor.1]\nfir = true\n")
    options = parse_options(["memory", "1", "--config", str(config)])
    backend = MemoryBackend(SensorOptions(), SensorOptions(serial=2))
    backend.command("power off @1")
    said = refused(backend, options)
    assert "settings for sensor 1, but the bus has only 0: BFT-SENS-ECAT-M8" in said
    assert said.endswith("connect that sensor, or correct the name of the table")
    backend.command("power on @1")
    sensors = start(backend, options).sensors
    assert [sensor.settings["fir"] for sensor in sensors] == [False, True]


# -- real processes


@on_a_bus
def test_without_rights_the_capabilities_are_named() -> None:
    """The kernel's rights, and a real exit code."""
    with Veth() as veth:
        server = (sys.executable, "-m", "ethercat_server.daemon.cli", veth.near, free_port())
        done = completed(*server, preexec_fn=without(NET_ADMIN, NET_RAW), timeout=60)
    assert done.returncode == 1
    (said,) = done.stderr.splitlines()
    assert said.startswith("ethercat-server: not allowed to open ")
    assert "CAP_NET_ADMIN and CAP_NET_RAW missing" in said


@on_a_bus
def test_a_virtual_sensor_that_does_not_start(caplog: pytest.LogCaptureFixture) -> None:
    """Its process and its exit code."""
    said = fails(caplog, "virtual", "PORT", "--virtual", "--sensors 0")
    assert said.startswith("the virtual sensor did not start (exit code 2): see its message above")


def test_no_virtual_sensor_is_started_for_a_user_that_there_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its process would say the same once more."""
    monkeypatch.setattr(subprocess, "Popen", pytest.fail)
    with pytest.raises(UsageError, match="there is no such user"):
        virtual_bus.VirtualBus(user="no-such-user").start()


@on_a_bus
def test_a_virtual_sensor_that_takes_too_long_is_not_said_to_lack_rights(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its process, which has not said anything yet."""
    monkeypatch.setattr(virtual_bus, "_START_TIMEOUT_S", 0.0)
    with pytest.raises(ServerError) as said, virtual_bus.VirtualBus():
        pass
    sentence = "the virtual sensor did not start within 0 s: this computer is too busy, start it again later"
    assert str(said.value) == sentence


@pytest.mark.parametrize(
    ("code", "missing", "words"),
    [
        (1, [], " (exit code 1): see its message above"),
        (
            1,
            ["CAP"],
            " (exit code 1): see its message above; it needs root, or a kernel with user namespaces",
        ),
        (2, ["CAP"], " (exit code 2): see its message above"),
        (-9, ["CAP"], ": its process was ended by SIGKILL, start it again"),
    ],
)
def test_why_a_virtual_sensor_did_not_start(
    code: int, missing: list[str], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(virtual_bus, "missing_capabilities", lambda: missing)
    assert virtual_bus._why_not_started(code) == f"the virtual sensor did not start{words}"


def stop_in_time(ifname: str, sensor: Program | None = None) -> str:
    """Start a server; SIGTERM as soon as its virtual bus is there, or `sensor` says something.

    Returns what it said.
    """
    for _ in range(ATTEMPTS):
        before, running = sensor.said() if sensor else "", Server(ifname)

        def due(before: str = before, running: Server = running) -> bool:
            come = sensor.said() != before if sensor else running.ifname in interfaces()
            return come or running.process.poll() is not None

        try:
            wait_until(due, "the moment")
            running.signal(signal.SIGTERM)
            code = running.wait()
            if not starved(said := running.said()):
                break
        finally:
            running.close()
    assert code == 0, said
    wait_until(lambda: running.ifname not in interfaces(), "the virtual bus to be gone")
    return said


@on_a_bus
def test_stopped_while_starting() -> None:
    """A real signal: when there is no bus yet, and while a sensor does not do what it is told."""
    assert "Traceback" not in stop_in_time("virtual")
    with virtual_sensor(module="tests.server.odd_sensor") as (veth, sensor):
        sensor.command("ignore 4")
        assert stop_in_time(veth.near, sensor).endswith("stopped during start-up\n")


# -- what is looked at before a bus is scanned, and that looking changes nothing


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
    with pytest.raises(BusError, match=rf"not Bota sensors \(position {drive} in {state.name}\).*--force"):
        bring_up(bus := Bus(backend), asked(), lambda: None)
    bus.close()
    assert registers(backend) == before
    assert not found.writes
    assert found.turning


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
        scan_if_free(Bus(backend), lambda: None)
    assert registers(backend) == before
    # The last frames of one that was killed are no obstacle.
    assert len(scan_if_free(Bus(OthersFrames(0.001, 2)), lambda: None)) == 1


def test_a_slave_that_stops_answering_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = chain("BOTA:OP")
    send = backend.send

    def lose_single_reads(frame: bytes | bytearray) -> None:
        if frame[DATAGRAM_INDEX - 1] != Command.APRD:
            send(frame)

    monkeypatch.setattr(backend, "send", lose_single_reads)
    with pytest.raises(BusError, match="slave 0 on memory does not answer: check cable and power"):
        scan_if_free(Bus(backend), lambda: None)


# -- a start that is given up at any moment: the sensors go to INIT, the other devices are as they were


def interrupting(at: int, then: Callable[..., None] = lambda *_: None) -> Callable[..., None]:
    """Ctrl-C at the call number `at`; the other calls do what `then` does."""
    count = 0

    def call(*arguments: float) -> None:
        nonlocal count
        count += 1
        if count == at:
            raise KeyboardInterrupt
        then(*arguments)

    return call


def states(backend: MemoryBackend) -> list[str]:
    backend.clock.sleep(0.1)
    backend.sensors.idle(backend.clock.now_ns)
    return [slave.life.state.name for slave in backend.sensors.slaves if slave.life is not None]


def owners(backend: MemoryBackend) -> list[int]:
    """Who may access the SII of each."""
    return [image[reg.SII_OWNER] for image in registers(backend)]


@pytest.mark.parametrize("at", more_if_long((1, 2, 9, 40), range(1, 60)))
def test_the_eeprom_is_given_back_before_the_bus_is_closed(at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two steps of its reading, Ctrl-C in the tool is an exception."""
    backend = chain("DRIVE:PREOP,BOTA")
    before = owners(backend)
    bus = Bus(backend)
    monkeypatch.setattr(backend.clock, "sleep", interrupting(at, backend.clock.sleep))
    with pytest.raises(KeyboardInterrupt) as raised:
        bring_up(bus, asked(), lambda: None)
    bus.close()
    assert owners(backend) == before, raised.value


def test_a_long_eeprom_can_be_given_up() -> None:
    """One of zeros has no end mark: 16 KB are read, 9 s."""
    backend = chain("BOTA,DRIVE")
    esc = backend.sensors.slaves[1].life.esc  # type: ignore[union-attr]
    esc.sii.image = bytes(0x5000)
    seen = [backend.clock.now_ns]
    bring_up(Bus(backend), asked(), lambda: seen.append(backend.clock.now_ns))
    assert max(after - before for before, after in itertools.pairwise(seen)) < 0.15e9


@pytest.mark.parametrize("at", range(1, 8))
def test_given_up_in_the_second_attempt(at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = chain("DRIVE:PREOP,BOTA,BOTA")
    bus = Bus(backend)
    check = interrupting(at)
    attempts: list[None] = []

    def fail(_: CheckInterrupt) -> None:
        attempts.append(None)
        raise SetUpError("a frame was lost")

    monkeypatch.setattr(bus, "enter_op", fail)
    with pytest.raises(KeyboardInterrupt):
        bring_up(bus, asked(), lambda: check() if attempts else None)
    bus.close()
    assert states(backend) == ["PREOP", "INIT", "INIT"]


# -- among the devices of other vendors sensors stream as if alone, and nothing is done to the others

# All that may be written to a slave that is no sensor.
READING_THE_SII: Final = range(reg.SII_OWNER, reg.SII_DATA)
KINDS: Final = ("EK1100", "EL3102", "DRIVE", "DRIVE:PREOP")


def mixed(text: str) -> Simulation:
    """A server on this chain, its sensors with clocks of their own."""
    sensors = [SensorOptions(signal="clock", serial=1 + n, ppm=150.0 - 200 * n) for n in range(2)]
    return Simulation(backend=MemoryBackend(*slaves_in(parse_chain(text), sensors)))


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


def only_the_sii_was_read(slave: ForeignSlave) -> bool:
    return {address for address, _ in slave.writes} <= set(READING_THE_SII)


def assert_left_alone(simulation: Simulation, text: str) -> None:
    """In the states in which they were found."""
    kinds = [kind for kind in text.split(",") if kind != "BOTA"]
    for slave, kind in zip(foreign(simulation), kinds, strict=True):
        assert slave.life is not None
        assert slave.life.state == (AlState.PREOP if "PREOP" in kind else AlState.INIT)
        assert only_the_sii_was_read(slave), slave.writes


@pytest.mark.parametrize("text", more_if_long(every_chain()[::14], every_chain()))
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
    assert_left_alone(simulation, text)
    simulation.close()
    assert_left_alone(simulation, text)


def test_one_that_goes_away_is_told_and_costs_the_others_nothing(caplog: pytest.LogCaptureFixture) -> None:
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


AMONG = ("EK1100,BOTA,DRIVE:PREOP", "DRIVE:PREOP,BOTA,BOTA", "BOTA,EL3102")
FAULTS = ("power cycle 0.3", "error 0x1B @0", "deaf 0.3")


@pytest.mark.parametrize(
    ("text", "fault"),
    more_if_long([*zip(AMONG, FAULTS, strict=True)], itertools.product(AMONG, FAULTS)),
)
def test_a_sensor_among_others_comes_back(text: str, fault: str) -> None:
    simulation = mixed(text)
    simulation.run(0.5)
    simulation.command(fault)
    simulation.run(3.0)
    assert all(sensor.streams for sensor in simulation.sensors)
    check_each(simulation)
    assert_left_alone(simulation, text)


def test_addresses_that_others_answer_to_are_not_taken() -> None:
    """What another master left: its station addresses, and FMMUs that are active still."""
    backend = chain("DRIVE:OP,BOTA,DRIVE:OP")
    before = registers(backend)
    with pytest.raises(BusError, match="slaves at work"):
        start(backend)
    assert registers(backend) == before

    sensors, others, _ = bring_up(bus := Bus(backend), asked()._replace(force=True), lambda: None)
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
    objects: Any = life_of(backend).objects
    read = objects.read
    objects.read = lambda *address: bytes(4 * [0xFF]) if address == (index, subindex) else read(*address)
    objects.length = lambda *address: len(objects.read(*address))
    with pytest.raises(BusError, match=f"sensor 0 has 0xffffffff in object 0x{index:04X}:{subindex}"):
        start(backend)


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
    simulation.run(1.0)
    assert memory[reg.SII_OWNER] == 1
    assert len(drive.writes) < 30
    assert only_the_sii_was_read(drive) if state == "INIT" else not drive.writes
    assert [sensor.streams for sensor in simulation.sensors] == [True, False]


def test_one_that_does_not_say_what_it_is(caplog: pytest.LogCaptureFixture) -> None:
    """It may be a sensor: the one behind it would be sensor 0 then, with the settings of another."""
    for text, starts in (
        ("BOTA,BOTA,EK1100", False),
        ("BOTA,EK1100,DRIVE", False),
        ("EK1100,BOTA,DRIVE", True),
    ):
        backend = chain(text)
        backend.command(f"sii busy #{2 if starts else 0}")
        if starts:
            assert [sensor.position for sensor in Simulation(backend=backend).sensors] == [1]
        else:
            with pytest.raises(BusError, match="position 0 of memory cannot be read"):
                start(backend)
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["'nameless' at position 2 (its SII cannot be read) is left alone: it stays in INIT"]


def test_what_another_master_left_is_ended() -> None:
    """OP is no obstacle; a sensor would wait for SYNC0, and for its EEPROM."""
    sensors = [SensorOptions(pdo_size=size) for size in (77, 61)]
    backend = MemoryBackend(*slaves_in(parse_chain("BOTA:OP,BOTA:OP,EK1100"), sensors))
    for at in range(3):
        memory_of(backend, at)[reg.DC_ACTIVATION + 1] = 3
        memory_of(backend, at)[reg.SII_OWNER] = 0
    assert [sensor.streams for sensor in start(backend).sensors] == [True, True]
    assert [memory_of(backend, at)[reg.DC_ACTIVATION + 1] for at in range(3)] == [0, 0, 3]
    assert [memory_of(backend, at)[reg.SII_OWNER] for at in range(3)] == [1, 1, 0]


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
    assert start(backend).others[0].name == "DRIVE"
    assert memory[reg.SII_OWNER] == 1, "it is the firmware's again"
