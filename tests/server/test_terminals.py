"""Terminals: inputs of slaves beside the sensors, read because the configuration names them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

from bota_ethercat.client import Client as StreamClient
from bota_ethercat.errors import RefusedError
from bota_ethercat.framing import DataFlag, DataMessage
from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.acquisition.terminals import Terminal
from ethercat_server.errors import BusError, SetUpError
from ethercat_server.ethercat.exchange import Area, make_frames
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from ethercat_server.sensor.scan import Slave
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine
from ethercat_server.simulation.server import MemoryChannel
from ethercat_server.virtual_sensor.options import SensorOptions, parse_chain, slaves_in
from tests.server.running import server, virtual_sensor, wait_until
from tests.simulation import (
    Simulation,
    asked,
    chain,
    check_frames,
    fresh,
    more_if_long,
    registers,
)

ANALOG, DIGITAL = "0x2:0x0C1E3052", "0x2:0x03F03052"
REPEATED, INVALID = int(DataFlag.REPEATED), int(DataFlag.INVALID)
FAULTS = "power cycle 0.2 #2", "safeop 0x1B #2", "disconnect #2", "error 0x1E #2"
LATE_NS = 2_000_000  # a value is at most this much older than its stamp


def reading(text: str, *terminals: str, machine: Machine | None = None) -> Simulation:
    """A server on this chain that reads these terminals, beside a slow sensor, which takes less time."""
    backend = MemoryBackend(*slaves_in(parse_chain(text), [SensorOptions(signal="clock")]), machine=machine)
    return Simulation(backend=backend, wanted=asked({"sinc_length": 512}, terminals=terminals))


def wait_for(simulation: Simulation, *wanted: str) -> None:
    """Until `describe` has these states."""
    asking = simulation.connect()
    for _ in range(400):
        if (states := [row["state"] for row in asking.ask("describe")["terminals"]]) == [*wanted]:
            return
        simulation.run(0.05)
    raise AssertionError(states)


def check_digital(frames: Iterable[DataMessage]) -> list[DataMessage]:
    """The bits of an EL1008 count tenths of a second: nothing old passes for new. The invalid ones."""
    frames = list(frames)
    assert all(after.monotonic_ns > before.monotonic_ns for before, after in itertools.pairwise(frames))
    for frame in frames:
        now = {(frame.monotonic_ns - age_ns) // 100_000_000 & 0xFF for age_ns in (0, LATE_NS)}
        assert frame.flags & INVALID or frame.process_data[0] in now
    counts = [frame.process_data[0] for frame in frames if not frame.flags & INVALID]
    assert all((after - before) % 256 < 128 for before, after in itertools.pairwise(counts)), "no way back"
    return [frame for frame in frames if frame.flags & INVALID]


def test_inputs_are_read_beside_the_sensor() -> None:
    simulation = reading("EK1100,BOTA,EL3102,EL1008", ANALOG, "3")
    client, other = simulation.connect(), simulation.subscribe()
    described = client.ask("subscribe", terminals=[1, 0], fresh_only=False)
    assert [row["name"] for row in described["others"]] == ["EK1100"]
    analog, digital = described["terminals"]
    assert (analog["position"], analog["product"], analog["pdo_size"]) == (2, 0x0C1E3052, 6)
    assert [(*row.values(),) for row in analog["layout"]] == [
        ("Channel 1 Status", "u8", 0, 8), ("Channel 1 Value", "i16", 8, 16),
        ("Channel 2 Status", "u8", 24, 8), ("Channel 2 Value", "i16", 32, 16),
    ]  # fmt: skip
    bits = [(f"Channel {n + 1} Input", "bool", n, 1) for n in range(8)]
    assert [(*row.values(),) for row in digital["layout"]] == bits
    wait_for(simulation, "OP", "OP")
    client.terminal_frames.clear()
    client.frames.clear()
    simulation.run(1.0)
    assert not other.terminal_frames, "nobody gets what he has not asked for"
    of = [[frame for frame in client.terminal_frames if frame.sensor == number] for number in (0, 1)]
    assert not check_digital(of[1])
    assert len(of[0]) == len(of[1]) >= len(fresh(client.frames)) > 90, "one for each exchange"
    for frames in of:
        assert all(after.sequence == before.sequence + 1 for before, after in itertools.pairwise(frames))
        assert all(frame.flags in (0, REPEATED) and frame.wkc == 1 for frame in frames)
        ahead = {frame.stamp_ns - frame.monotonic_ns for frame in (*frames, *client.frames)}
        assert len(ahead) == 1, "the clocks of the samples"
    check_frames(simulation.frames)


def test_what_does_not_change_comes_every_10_ms() -> None:
    simulation = Simulation(backend=chain("BOTA,EL1008"), wanted=asked(terminals=[DIGITAL]))
    client = simulation.subscribe(terminals=[0])
    wait_for(simulation, "OP")
    client.terminal_frames.clear()
    simulation.run(1.0)
    assert sum(not frame.flags for frame in client.terminal_frames) in (9, 10, 11)
    assert 80 <= len(client.terminal_frames) <= 110
    for before, after in itertools.pairwise(client.terminal_frames):
        assert not after.flags or after.monotonic_ns - before.monotonic_ns >= 10_000_000


@pytest.mark.parametrize("choice", more_if_long([DIGITAL, "2"], [DIGITAL, "2", f"{DIGITAL}@2"]))
def test_terminals_are_named_by_what_and_where_they_are(choice: str) -> None:
    described = reading("EL1008,BOTA,EL1008", choice).connect().ask("describe")
    assert [row["position"] for row in described["terminals"]] == ([0, 2] if choice == DIGITAL else [2])


@pytest.mark.parametrize(
    ("text", "choice", "sentence"),
    [
        ("BOTA,EL3102", DIGITAL, "no terminal 0x2:0x03F03052 is on the bus .'EL3102' at position 1"),
        ("BOTA,EL3102", f"{ANALOG}@2", "no terminal"),
        ("BOTA,EL3102", "0", "no terminal 0 is on the bus"),
        ("BOTA,DRIVE", "1", "'DRIVE' at position 1 .* has outputs, which nobody would write"),
        ("EK1100,BOTA", "0", "'EK1100' at position 0 .* has no inputs"),
        ("BOTA,EL3102:OP", ANALOG, "slaves at work"),
        ("BOTA,EL3102:OP", f"{DIGITAL}@1", "slaves at work"),
        ("BOTA,DRIVE:OP", "1", "slaves at work"),
    ],
)
def test_what_is_no_terminal_ends_the_start_with_a_sentence(text: str, choice: str, sentence: str) -> None:
    backend = chain(text)
    before = [image[reg.AL_STATUS] for image in registers(backend)]
    with pytest.raises(BusError, match=sentence):
        Simulation(backend=backend, wanted=asked(terminals=[choice]))
    assert [image[reg.AL_STATUS] for image in registers(backend)] == before


def test_a_terminal_whose_firmware_is_being_written_is_not_touched() -> None:
    backend = chain("BOTA,EL3102:OP")
    terminal: Any = backend.sensors.slaves[1]
    terminal.life.esc.memory[reg.AL_STATUS] = AlState.BOOT
    before = registers(backend)
    with pytest.raises(BusError, match=r"slaves at work .*position 1 in BOOT"):
        Simulation(backend=backend, wanted=asked(terminals=["1"]))
    assert registers(backend) == before


def test_nothing_is_read_that_nobody_names() -> None:
    simulation = reading("BOTA,EL3102")
    assert type(simulation.cycle) is Cycle
    assert "terminals" not in simulation.connect().ask("describe")
    assert simulation.connect().refused("subscribe", terminals=[0])["code"] == "bad_request"


@pytest.mark.parametrize("fault", more_if_long(FAULTS[:2], FAULTS))
def test_a_lost_terminal_costs_the_sensor_nothing_and_comes_back(fault: str) -> None:
    simulation = reading("EK1100,BOTA,EL1008", DIGITAL)
    client = simulation.subscribe(terminals=[0], fresh_only=False)
    wait_for(simulation, "OP")
    simulation.run(0.1)
    simulation.command(fault)
    wait_for(simulation, "LOST")
    simulation.command("connect #2")
    wait_for(simulation, "OP")
    simulation.run(0.1)
    invalid = check_digital(client.terminal_frames)
    assert {frame.flags for frame in invalid} == {REPEATED | INVALID}
    assert len({frame.process_data for frame in invalid}) == 1, "the last good one"
    assert not client.terminal_frames[-1].flags & INVALID
    check_frames(simulation.frames)
    assert client.ask("status")["sensors"][0]["invalid"] == 0
    assert simulation.events == []


@pytest.mark.long
@pytest.mark.parametrize("seed", range(30))
def test_on_a_wire_that_loses_frames_delays_some_and_is_silent_for_a_while(seed: int) -> None:
    machine = Machine(seed=seed, lost=0.01, late=0.02, late_ns=LATE_NS)
    simulation = reading("BOTA,EL1008,EL3102", "1", "2", machine=machine)
    client = simulation.subscribe(terminals=[0, 1])
    wait_for(simulation, "OP", "OP")
    simulation.run(1.0)
    simulation.command("deaf 0.3")
    simulation.run(2.0)
    wait_for(simulation, "OP", "OP")
    check_digital(frame for frame in client.terminal_frames if frame.sensor == 0)
    check_frames(simulation.frames)


def test_an_answer_that_was_overtaken_is_not_handed_out() -> None:
    """A fifth of the answers comes after that to the next exchange."""
    machine = Machine(seed=2, late=0.2, late_ns=LATE_NS)
    backend = MemoryBackend(*slaves_in(parse_chain("BOTA,EL1008"), [SensorOptions(signal="clock")]))
    simulation = Simulation(backend=backend, wanted=asked({"sinc_length": 64}, terminals=["1"]))
    client = simulation.subscribe(terminals=[0], fresh_only=False)
    wait_for(simulation, "OP")
    backend.become(machine)
    client.terminal_frames.clear()
    simulation.run(3.0)
    assert not check_digital(client.terminal_frames)
    check_frames(simulation.frames)


@pytest.mark.parametrize("state", ["INIT", "PREOP"])
def test_at_the_end_terminals_are_in_the_state_in_which_they_were_found(state: str) -> None:
    simulation = reading(f"BOTA,EL3102:{state},EL1008:{state}", ANALOG, DIGITAL)
    wait_for(simulation, "OP", "OP")
    simulation.command("power cycle 0.1 #2")
    simulation.run(0.5)
    wait_for(simulation, "OP", "OP")
    simulation.close()
    for image in registers(simulation.backend)[1:]:
        assert image[reg.AL_STATUS : reg.AL_STATUS + 6] == AlState[state].request() + bytes(4)
        assert image[reg.STATION_ADDRESS : reg.STATION_ADDRESS + 2] == bytes(2)
        assert image[reg.FMMU : reg.FMMU + 2 * reg.FMMU_SIZE] == bytes(2 * reg.FMMU_SIZE), "nothing is mapped"


def test_only_inputs_are_mapped_and_no_memory_but_the_mailbox_is_written() -> None:
    simulation = reading("BOTA,EL3102", ANALOG)
    wait_for(simulation, "OP")
    image, slave = registers(simulation.backend)[1], simulation.backend.sensors.slaves[1]
    rows = reg.FMMU_LAYOUT.iter_unpack(image[reg.FMMU : reg.FMMU + 3 * reg.FMMU_SIZE])
    assert [(row[1], row[4], row[6]) for row in rows if row[7]] == [(6, 0x1180, reg.FMMU_READ)]
    outputs = reg.SYNC_MANAGER + 2 * reg.SYNC_MANAGER_SIZE
    assert image[outputs : outputs + reg.SM_ACTIVATE + 1] == bytes(7)
    assert max(address for address, _ in slave.writes) == 0x1000  # type: ignore[attr-defined]


@pytest.mark.parametrize("choice", ["1", f"{ANALOG}@1"])
def test_a_server_that_was_killed_finds_its_terminal_by_its_position(choice: str) -> None:
    """Nobody has taken it out of OP."""
    simulation = reading("BOTA,EL3102", f"{ANALOG}@1")
    wait_for(simulation, "OP")
    wait_for(Simulation(backend=simulation.backend, wanted=asked(terminals=[choice])), "OP")


def test_other_pdos_than_the_sii_has_are_not_decoded(caplog: pytest.LogCaptureFixture) -> None:
    simulation = reading("BOTA,EL3102", "1")
    life: Any = simulation.backend.sensors.slaves[1].life
    read = life.objects.read
    life.objects.read = lambda *address: b"\1" if address == (0x1C13, 0) else read(*address)
    client = simulation.subscribe(terminals=[0])
    simulation.run(3.0)
    assert caplog.text.count("maps other PDOs than its SII says") == 1
    wait_for(simulation, "LOST")
    assert not client.terminal_frames
    check_frames(client.frames)


def test_more_inputs_than_fmmus_are_refused() -> None:
    simulation = reading("BOTA,EL3102", "1")
    wait_for(simulation, "OP")
    (controller, _), inputs = simulation.bus.terminals[0], [(3, 0x1180, 1, 0)] * 17
    with pytest.raises(SetUpError, match="FMMUs for 17 inputs: do not name it"):
        simulation.bus.finish(controller.map_inputs(0, inputs))


def test_padding_optional_pdos_types_and_equal_names_in_the_sii() -> None:
    bit, gap, value, *more = (
        {"index": index, "subindex": 1, "name": name, "type": kind, "bits": bits}
        for index, name, kind, bits in (
            (0x6000, "Input", 1, 1), (0, "", 0, 7), (0x6001, "Input", 8, 32),
            (0x6002, "LREAL", 0x11, 64), (0x6003, "LINT", 0x15, 64), (0x6004, "ULINT", 0x1B, 64),
        )
    )  # fmt: skip
    managers = [{"start": 0x1000, "size": 1, "control": 0, "enabled": True, "kind": "inputs"}] * 2
    rows = (0, [bit, gap, value]), (0xFF, [bit]), (1, [bit, gap, *more])
    pdos = [{"name": "A", "sync_manager": manager, "entries": entries} for manager, entries in rows]
    content = {"vendor": 2, "product": 3, "revision": 1, "name": "X", "rx_pdos": pdos[1:2], "tx_pdos": pdos}
    status = AlStatus(AlState.INIT, error=False, code=0)
    terminal = Terminal(0, Slave(1, status, {**content, "sync_managers": managers}))
    assert terminal.size == 30
    assert [(*row.values(),) for row in terminal.row["layout"]] == [
        ("A Input", "bool", 0, 1), ("A Input 0x6001:1", "f32", 8, 32), ("A Input 0x6000:1", "bool", 40, 1),
        ("A LREAL", "f64", 48, 64), ("A LINT", "i64", 112, 64), ("A ULINT", "u64", 176, 64),
    ]  # fmt: skip


def test_more_than_a_frame_carries_is_refused() -> None:
    sensor = [Area(0, 1, reg.FMMU_WRITE), Area(1, 62, reg.FMMU_READ)]
    with pytest.raises(BusError, match="do not fit the frame"):
        make_frames([sensor], [None], lrw=True, terminals=[Area(62, 1480, reg.FMMU_READ)])


def test_the_python_client_decodes_by_the_layout() -> None:
    simulation = reading("BOTA,EL3102,EL1008", ANALOG, DIGITAL)
    wait_for(simulation, "OP", "OP")
    with StreamClient(1, terminals=[0, 1, 7], channel=MemoryChannel(simulation)).connect() as client:
        while len(client.terminal_frames) < 20:
            client.poll(0.1)
        newest = {frame.sensor: frame for frame in client.terminal_frames}
        analog, digital = (client.decode_terminal(newest[number]) for number in (0, 1))
        assert [*analog] == [f"Channel {n} {what}" for n in (1, 2) for what in ("Status", "Value")]
        assert [*digital.values()] == [newest[1].process_data[0] >> bit & 1 for bit in range(8)]
        with pytest.raises(RefusedError, match="terminal 2, but the bus has 2"):
            client.ask("subscribe", terminals=[2])


@pytest.mark.long
@pytest.mark.bus
def test_over_a_real_interface() -> None:
    with (
        virtual_sensor("--chain", "EK1100,BOTA,EL3102,EL1008", "--signal", "clock") as (veth, sensor),
        server(veth.near, "--terminal", ANALOG, "--terminal", f"{DIGITAL}@3") as running,
        running.connect() as client,
    ):

        def wait_for(*states: str) -> None:
            wait_until(
                lambda: [row["state"] for row in client.ask("describe")["terminals"]] == [*states],
                f"{states}",
            )

        client.ask("subscribe", terminals=[0, 1])
        wait_for("OP", "OP")
        assert len(client.fresh(400)) == 400
        assert len({frame.process_data for frame in client.terminal_frames if frame.sensor == 0}) > 100
        sensor.command("power cycle 0.5 #3")
        wait_for("OP", "LOST")
        wait_for("OP", "OP")
        client.send("shutdown")
        assert running.wait() == 0
        assert [sensor.stats_of_foreign(at)["al_state"] for at in (2, 3)] == ["INIT", "INIT"]
