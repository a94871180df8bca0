"""Bad input and trouble at start: one sentence, a non-zero exit, nothing left behind."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from ethercat_server.acquisition.start_up import Wanted, bring_up
from ethercat_server.daemon.cli import main
from ethercat_server.daemon.options import parse_options
from ethercat_server.errors import ServerError, SetUpError, StopRequestedError
from ethercat_server.ethercat import mapping, nic
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave.controller import SlaveController
from ethercat_server.ethercat.slave.registers import FMMU, FMMU_SIZE, SYNC_MANAGER, pack_sync_manager
from ethercat_server.process import realtime
from ethercat_server.sensor import scan
from ethercat_server.sensor.objects.dictionary import BY_SETTING
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.virtual_sensor.firmware.dictionary import Dictionary
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.ended import run_here
from tests.server.commands import command
from tests.server.running import (
    ATTEMPTS,
    Program,
    Server,
    Veth,
    free_port,
    needs_bus,
    starved,
    virtual_sensor,
    wait_until,
)
from tests.simulation import Asked
from tests.tool import odd_firmware

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
        ("lo PORT", 1, "loopback"),
        ("virtual PORT --set colour=1", 2, "no setting 'colour'"),
        ("virtual PORT --config /nonexistent.toml", 2, "cannot read the configuration"),
    ],
)
def test_wrong_arguments(caplog: pytest.LogCaptureFixture, arguments: str, code: int, complaint: str) -> None:
    assert re.search(complaint, fails(caplog, *arguments.split(), code=code))


def test_port_taken(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        said = fails(caplog, "virtual", str(port))
    assert f"port {port} on 127.0.0.1 is in use by another program" in said


def test_too_few_open_files() -> None:
    """A process, whose listening sockets are too many."""
    command = f"ulimit -n 6; exec {sys.executable} -m ethercat_server.daemon.cli lo {free_port()}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False, timeout=60)
    sentence = "the server may open too few files (ulimit -n): allow it 256 at least"
    assert (done.returncode, done.stderr) == (1, f"ethercat-server: {sentence}\n")


@pytest.mark.bus
@needs_bus
def test_interfaces_without_a_sensor(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
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


# -- sensors that are not what they must be, in memory


def refused(backend: MemoryBackend, wanted: Wanted | None = None, code: int = 1) -> str:
    """Why a start fails; the sensors are in INIT afterwards."""
    bus = Bus(backend)
    with pytest.raises(ServerError) as info:
        bring_up(bus, wanted or Asked(), lambda: None)
    bus.close()
    assert all(sensor.statistics()["al_state"] in ("INIT", None) for sensor in backend.sensors.sensors)
    assert info.value.exit_code == code
    return str(info.value)


@pytest.mark.parametrize(
    ("way", "complaint"),
    [
        (
            odd_firmware.foreign,
            "no Bota Gen-0 sensor .* only 'BFT-SENS-ECAT-M8' at position 0 .vendor 0x0000DEAD",
        ),
        (odd_firmware.other_product, "vendor 0x0000B07A, product 0x00000007"),
        (odd_firmware.wrong_rate, "samples at 500 Hz, but sinc_length 64 implies 800 Hz"),
        (odd_firmware.no_mailbox, "sensor 0 on memory has no CoE mailbox, and so no objects to set it up by"),
    ],
)
def test_a_slave_that_is_wrong_in_one_way(
    monkeypatch: pytest.MonkeyPatch, way: Callable[[pytest.MonkeyPatch], None], complaint: str
) -> None:
    way(monkeypatch)
    assert re.search(complaint, refused(MemoryBackend()))


@pytest.mark.parametrize(
    ("identity", "complaint"),
    [
        (b"", "the SII .EEPROM. of the slave at position 0 of memory cannot be read"),
        (b"\xad\xde\0\0\1", "only 'nameless' at position 0 .vendor 0x0000DEAD"),
    ],
)
def test_what_the_eeprom_does_not_say(
    monkeypatch: pytest.MonkeyPatch, identity: bytes, complaint: str
) -> None:
    image = (bytes(16) + identity).ljust(128, b"\0").ljust(130, b"\xff")
    monkeypatch.setattr(scan, "read_image", lambda *_: image)
    assert re.search(complaint, refused(MemoryBackend()))


@pytest.mark.parametrize("size", [0, 8, 1487, 0xFFFF])
def test_mailboxes_that_no_frame_can_carry(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """pysoem would write beyond its buffers."""
    read_image = scan.read_image

    def odd_image(bus: Bus, position: int, check_interrupt: CheckInterrupt) -> bytes:
        image = bytearray(read_image(bus, position, check_interrupt))
        image[0x18 * 2 + 6 : 0x18 * 2 + 8] = size.to_bytes(2, "little")
        return bytes(image)

    monkeypatch.setattr(scan, "read_image", odd_image)
    assert f"has mailboxes of 128 and {size} bytes, which no frame can carry" in refused(MemoryBackend())


@pytest.mark.parametrize(
    ("size", "complaint"),
    [(65, "process data of 65 bytes: .* 61 or 77"), (0, "process data of 0 bytes")],
)
def test_process_data_of_another_size(monkeypatch: pytest.MonkeyPatch, size: int, complaint: str) -> None:
    monkeypatch.setattr(Bus, "map_process_data", lambda *_: [size])
    assert re.search(f"sensor 0 .BFT-SENS-ECAT-M8. maps {complaint}", refused(MemoryBackend()))


@pytest.mark.parametrize("unit", [0, 1])
@pytest.mark.parametrize("times", [1, 2, 9])
def test_an_fmmu_that_was_not_written(monkeypatch: pytest.MonkeyPatch, unit: int, times: int) -> None:
    """SOEM does not notice; without outputs the sensor's watchdog would take it out of OP again and again."""
    map_process_data, left = mapping.map_process_data, [times]

    def odd(sensors: Sequence[SlaveController], *arguments: Any) -> None:
        map_process_data(sensors, *arguments)
        left[0] -= 1
        if left[0] >= 0:
            sensors[0].write(FMMU + unit * FMMU_SIZE, bytes(FMMU_SIZE))

    monkeypatch.setattr(mapping, "map_process_data", odd)
    if times < 3:
        assert bring_up(Bus(MemoryBackend()), Asked(), lambda: None).sensors[0].streams
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
        mapping.assign_stations(self.bus, positions, ())
        if self.step != "mailboxes":
            for position in positions:
                managers = pack_sync_manager(0x1000, 128, 0x26) + pack_sync_manager(0x1080, 128, 0x22)
                assert self.bus.write_at(position, SYNC_MANAGER, managers)

    def map_process_data(self, _: CheckInterrupt) -> None:
        self._do("map_process_data")


@pytest.mark.parametrize("step", ["scan", "mailboxes", "map_process_data", "nothing mapped"])
def test_a_master_that_lost_frames_has_misled_is_replaced(step: str) -> None:
    """As pysoem is, which does not repeat what it writes."""
    backend = MemoryBackend()
    bus = Bus(backend)
    backend.master = misled = Misled(bus, step)  # type: ignore[assignment]
    assert bring_up(bus, Asked(), lambda: None).sensors[0].streams
    assert misled.failed == (step in ("scan", "map_process_data"))


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("sii error", "the SII .EEPROM. of the slave at position 0 of memory cannot be read"),
        ("sii busy", "the SII .EEPROM. of the slave at position 0 of memory cannot be read"),
        (
            "abort 0x8006 1 0x06090030",
            "sinc_length = 128 did not take.*: the value is out of range .abort 0x06090030",
        ),
    ],
)
def test_what_a_sensor_refuses_is_named(command: str, complaint: str) -> None:
    backend = MemoryBackend()
    backend.command(command)
    assert re.search(complaint, refused(backend, Asked({"sinc_length": 128})))


def test_a_start_is_given_up_between_two_transfers() -> None:
    """Nothing more is written to the sensor then; it goes to INIT."""
    backend = MemoryBackend()
    (sensor,) = backend.sensors.sensors

    def check_interrupt() -> None:
        if sensor.statistics()["sdo_writes"]:
            raise StopRequestedError("asked to stop while starting")

    bus = Bus(backend)
    with pytest.raises(StopRequestedError):
        bring_up(bus, Asked({"fir": True, "acceleration_range_g": 8}), check_interrupt)
    bus.close()
    assert len(sensor.statistics()["sdo_writes"]) == 1
    assert sensor.statistics()["al_state"] == "INIT"


def test_a_setting_that_is_accepted_and_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    write, range_of = Dictionary.write, BY_SETTING["acceleration_range_g"].address

    def forgetful(self: Dictionary, index: int, subindex: int, data: bytes, state: Any) -> None:
        if (index, subindex) != range_of:
            write(self, index, subindex, data, state)

    monkeypatch.setattr(Dictionary, "write", forgetful)
    said = refused(MemoryBackend(), Asked({"acceleration_range_g": 8}))
    assert re.search(
        "the setting acceleration_range_g = 8 did not take: sensor 0 holds .. after .. was", said
    )


def test_models_and_their_names() -> None:
    """Any known one if none is asked for, else the one that is."""
    strange = MemoryBackend(SensorOptions(model="BFT-GENA-THING"))
    assert "'BFT-GENA-THING', a model this server does not know" in refused(strange)
    rokubi, wanted = MemoryBackend(SensorOptions(model="BFT-ROKS-ECAT-M8")), Asked()
    wanted.sensor_name = "BFT-SENS-ECAT-M8"
    assert "is a BFT-ROKS-ECAT-M8, not a BFT-SENS-ECAT-M8" in refused(rokubi, wanted)
    wanted.sensor_name = "BFT-ROKS-ECAT-M8"
    assert [sensor.streams for sensor in bring_up(Bus(rokubi), wanted, lambda: None).sensors] == [True]


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
    sensors = bring_up(Bus(backend), options, lambda: None).sensors
    assert [sensor.settings["fir"] for sensor in sensors] == [False, True]


def test_tables_that_contradict_one_another(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text(
        "[sensor]\nfir = true\n[sensor.BFT-SENS-ECAT-M8]\nfir = false\n[sensor.0]\nfast = true\n"
    )
    options = parse_options(["memory", "1", "--config", str(config)])
    said = refused(MemoryBackend(), options, code=2)
    assert "are inconsistent: fast is true but fir is false" in said


# -- real processes


@pytest.mark.bus
@needs_bus
def test_not_allowed_names_the_capabilities() -> None:
    """The kernel's rights, and a real exit code."""
    # Drops the capabilities from the bounding set, so that the new program has none, even as root.
    pr_capbset_drop = 24

    def drop() -> None:
        libc = ctypes.CDLL(None)
        for capability in (12, 13):
            libc.prctl(pr_capbset_drop, capability, 0, 0, 0)

    with Veth() as veth:
        done = subprocess.run(
            [sys.executable, "-m", "ethercat_server.daemon.cli", veth.near, str(free_port())],
            preexec_fn=drop, capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("ethercat-server: not allowed to open ")
    assert "CAP_NET_ADMIN and CAP_NET_RAW missing" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.bus
@needs_bus
def test_a_virtual_bus_without_rights_is_a_sentence() -> None:
    """Two processes and their exit codes."""
    done = subprocess.run(
        ["setpriv", "--bounding-set", "-net_admin,-net_raw",
         sys.executable, "-m", "ethercat_server.daemon.cli", "virtual", str(free_port())],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1
    first, last = done.stderr.splitlines()
    assert first.startswith("ethercat-virtual-sensor: cannot create a veth pair: ")
    assert last.endswith("it needs root, or CAP_NET_ADMIN and CAP_NET_RAW")


@pytest.mark.bus
@needs_bus
def test_a_virtual_sensor_that_does_not_start(caplog: pytest.LogCaptureFixture) -> None:
    """Its process and its exit code."""
    said = fails(caplog, "virtual", "PORT", "--virtual", "--sensors 0")
    assert said.startswith("the virtual sensor did not start (exit code 2): see its message above")


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


@pytest.mark.bus
@needs_bus
def test_stopped_while_starting() -> None:
    """A real signal: when there is no bus yet, and while a sensor does not do what it is told."""
    assert "Traceback" not in stop_in_time("virtual")
    with virtual_sensor(module="tests.server.odd_sensor") as (veth, sensor):
        command(sensor, "ignore 4")
        assert stop_in_time(veth.near, sensor).endswith("stopped during start-up\n")
