"""A trace of the observations replays to the same decisions, to the bit, whatever happened."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import random
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ethercat_server.daemon.loss_traces import LossTraces
from ethercat_server.doctor.cli import main as doctor
from ethercat_server.doctor.trace import find_losses, save, show
from ethercat_server.errors import ServerError
from ethercat_server.sampling.replay import Decision, Record, Trace, TraceError
from ethercat_server.sampling.trace import RECORD, Clocks, RecordKind, Ring, learn_note
from ethercat_server.simulation.machine import Machine
from ethercat_server.simulation.server import MemoryChannel
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.ended import run_here
from tests.simulation import SimulatedServer, Simulation, fresh, simulated_bus
from tests.traces.decisions import DECISIONS, NAMES, decisions


def trace_of(simulation: Simulation) -> bytes:
    """As a client gets it, part by part."""
    data, size = b"", 1
    while len(data) < size:
        part = simulation.cycle.tracing.part(len(data))
        size = part["size"]
        data += base64.b64decode(part["data"])
    assert len(data) == size
    return data


def check_replay(simulation: Simulation, numbers: Sequence[int] = (0,)) -> Trace:
    """Each new sample of the trace has the instant that was handed out with it."""
    trace = Trace(trace_of(simulation))
    steps = list(trace.replay())
    assert steps
    for number in numbers:
        dated = [
            int(step.instant_ns)
            for step in steps
            if step.record.kind is RecordKind.FRESH and step.record.sensor == number
        ]
        handed_out = [
            frame.monotonic_ns
            for frame in fresh(simulation.frames)
            if frame.sensor == number and frame.monotonic_ns > dated[0]
        ]
        assert len(handed_out) > 100
        # A stamp is later than the one before, if by a ns; nothing else differs. The first samples after a
        # return are not handed out.
        expected = {*itertools.accumulate(dated, lambda before, instant: max(before + 1, instant)), *dated}
        assert set(handed_out) <= expected
    return trace


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize(
    "machine",
    [
        Machine(),
        Machine(seed=2, lost=0.02, late=0.02),
        Machine(seed=3, stall_every_s=0.1, stall_ns=5e6),
        Machine(seed=4, frame_ns=2e6, frame_jitter_ns=2e5),
    ],
    ids=["quiet", "bad wire", "stalls", "slow card"],
)
def test_a_replay_makes_the_same_decisions(machine: Machine, dc: str) -> None:
    simulation = Simulation(SensorOptions(signal="clock", ppm=150.0, dc=dc), machine=machine)
    simulation.run(2.0)
    trace = check_replay(simulation)
    assert any(record.latched for record in trace.records) == (dc == "")


def test_a_replay_begins_anew_where_a_sensor_came_back_and_where_event_times_are_given_up() -> None:
    simulation = Simulation(
        SensorOptions(signal="clock", ppm=150.0), SensorOptions(signal="clock", serial=2, dc="stuck")
    )
    simulation.at(1.0, "power cycle 0.1 @0")
    simulation.run(3.0)
    assert simulation.status()["sensors"][0]["recoveries"]
    check_replay(simulation, (0, 1))


def test_the_ring_has_the_last_minute_and_is_read_while_it_goes_on() -> None:
    simulation = Simulation(settings={"sinc_length": 1024})
    simulation.run(100.0)
    size = simulation.cycle.tracing.part(0)["size"]
    parts = []
    for offset in itertools.count(0, 24 << 10):
        if offset >= size:
            break
        parts.append(base64.b64decode(simulation.cycle.tracing.part(offset)["data"]) if offset else b"")
        simulation.run(0.05)
    trace = Trace(trace_of(simulation))
    seconds = (trace.records[-1].sent_ns - trace.records[0].sent_ns) * 1e-9
    assert 40 < seconds <= 100
    check_replay(simulation)


@pytest.mark.parametrize(("late_ns", "told"), [(None, 0), (-5.0, 1), (0.0, 1), (7.4, 8), (1e12, 0xFFFFFFFF)])
def test_that_it_had_not_slept_is_not_that_it_woke_in_time(late_ns: float | None, told: int) -> None:
    exchange = (1000, 9000, b"", 3, 0)
    note = learn_note(exchange, 4000, RecordKind.LEARNED, late_ns)
    assert note == (exchange, (3000, 0, told, 0), 0, RecordKind.LEARNED)


def test_what_the_ring_has_lost_meanwhile_is_zeros() -> None:
    """A ring of three records, and a file that begins with the oldest snapshot that is still in it."""
    ring, made = Ring(0.02), list[bytes]()

    def add(*numbers: int) -> None:
        for n in numbers:
            exchange = (1000 + n, 1500 + 2 * n, b"", 3, 0)
            ring.add([(exchange, (n, n % 2, 7 * n, 1), 4, RecordKind.FRESH)])
            made.append(RECORD.pack(1000 + n, 500 + n, n, 7 * n, 4, 1 | 0x80 * (n % 2), 3))

    def snapshot(number: int) -> None:
        ring.snapshot(cast("Clocks", SimpleNamespace(state=lambda: {"number": number})))

    snapshot(0)
    add(0, 1)
    snapshot(1)
    add(2)
    snapshot(2)
    add(3)
    frozen = ring.freeze({"about": "it"})
    header = json.loads(frozen.header)
    assert header["snapshots"] == [{"before": 0, "number": 1}, {"before": 1, "number": 2}]
    assert (header["about"], header["version"], frozen.header[-1:]) == ("it", 1, b"\n")

    def whole(step: int) -> bytes:
        parts = [frozen.read(at, step) for at in range(0, frozen.size, step)]
        assert [len(part) for part in parts[:-1]] == [step] * (len(parts) - 1)
        return b"".join(parts).removeprefix(frozen.header)

    assert whole(7) == whole(10_000) == b"".join(made[2:])
    assert frozen.read(frozen.size, 5) == b""
    add(4)
    assert whole(10_000) == b"".join(made[2:4]), "what came later is not in it"
    add(5)
    assert whole(24) == bytes(24) + made[3]
    add(6)
    assert ring.freeze({}).size == len(ring.freeze({}).header), "no snapshot is left"


def test_a_file_is_hostile() -> None:
    simulation = Simulation()
    simulation.run(0.5)
    whole = trace_of(simulation)
    header = json.loads(whole.partition(b"\n")[0])
    for damaged in (
        b"", b"\n", b"{}\n", whole[:100], b"[" * 100_000, json.dumps({**header, "version": 2}).encode(),
        json.dumps({**header, "snapshots": 3}).encode(),
    ):  # fmt: skip
        with pytest.raises(TraceError):
            Trace(damaged)
    for key, value in (("round_trip", {"learn": 1}), ("sensors", [{}]), ("sensors", [{"events": []}])):
        snapshot = {**header["snapshots"][0], key: value}
        data = json.dumps({**header, "snapshots": [snapshot]}).encode() + b"\n" + whole.partition(b"\n")[2]
        with pytest.raises(TraceError):
            list(Trace(data).replay())
    chance = random.Random(1)
    for _ in range(200):
        mutated = bytearray(whole)
        for _ in range(chance.randint(1, 5)):
            mutated[chance.randrange(len(mutated))] = chance.randrange(256)
        try:
            for _ in itertools.islice(Trace(bytes(mutated)).replay(), 100):
                pass
        except TraceError:
            pass


def test_the_doctor_keeps_a_trace_and_shows_what_was_lost_and_why(tmp_path: Path) -> None:
    path = tmp_path / "a.trace"
    with simulated_bus("--sinc", 64) as bus:
        simulation = SimulatedServer(bus)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("bota_ethercat.client.client.TcpChannel", lambda *_: MemoryChannel(simulation))
            simulation.run(1.0)
            simulation.at(0.5, lambda: simulation.clock.stall(20e6))
            simulation.at(1.0, "skip 3")
            simulation.run(2.0)
            saved = run_here(doctor, "--trace", path)
        assert "ethercat-doctor" in saved.out
    shown = run_here(doctor, path).out
    assert "this computer sent nothing for 2" in shown
    assert "lost: it was polled and gave none" in shown
    data = bytearray(path.read_bytes())
    for at in range(len(data) - 10 * RECORD.size, len(data), RECORD.size):  # as of a clock that was broken
        struct.pack_into("<Q", data, at, struct.unpack_from("<Q", data, at)[0] + 10**17)
    path.write_bytes(data)
    assert len(run_here(doctor, path).out.splitlines()) < len(shown.splitlines()) + 20
    path.write_bytes(b'{"format": "another"}\n')
    assert "it is no trace of the sampling clocks" in run_here(doctor, path).err


def test_what_a_held_up_exchange_cost_is_not_blamed_on_the_sensor() -> None:
    """The exchange that was held up does not tell how many samples passed; the one after it does."""
    simulation = Simulation(SensorOptions(signal="clock"), machine=Machine(seed=5, late=0.02, late_ns=4e6))
    simulation.run(5.0)
    steps = list(check_replay(simulation).replay())
    found = [loss for loss in find_losses(0, steps) if not loss.text.startswith("maybe")]
    assert len(found) > 10
    assert "sensor" not in {loss.cause for loss in found}


def step(
    sent_ns: int,
    lost: int = 0,
    uncertain: bool = False,
    kind: RecordKind = RecordKind.FRESH,
    sensor: int = 0,
    took_ns: int = 100_000,
) -> Decision:
    """A hand-made one: a sample so many after the one before, that was dated by its event."""
    return Decision(
        Record(sent_ns, took_ns, 0, 0, sensor, kind, False, 3), sent_ns, lost + 1, uncertain, True, True
    )


def found(steps: Sequence[Decision]) -> list[tuple[str, str]]:
    """Cause and text of each loss in them."""
    return [loss[2:] for loss in find_losses(0, steps)]


def shown(steps: Sequence[Decision]) -> list[str]:
    """What the doctor shows of a trace with these decisions."""
    about = {"program": "x 1", "sensors": [{"model": "M8"}]}
    made = SimpleNamespace(about=about, records=steps, replay=lambda: iter(steps))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ethercat_server.doctor.trace.Trace", lambda _: made)
        return [*show(Path("/dev/null"))]


@pytest.mark.parametrize(
    ("asleep_ms", "took_ms", "expected"),
    [
        (1.0, 2.5, ("card or slave", "2 lost: an exchange took 2.50 ms")),
        (1.0, 0.62, ("card or slave", "2 lost: an exchange took 0.62 ms")),
        (1.0, 0.58, ("sensor", "2 lost: it was polled and gave none")),
        (1.48, 0.1, ("sensor", "2 lost: it was polled and gave none")),
        (1.52, 0.1, ("machine", "2 lost: this computer sent nothing for 1.52 ms")),
        (1.3, 0.1, ("sensor", "2 lost: it was polled and gave none")),
        (1.4, 2.5, ("card or slave", "2 lost: an exchange took 2.50 ms")),
        (2.5, 0.1, ("machine", "2 lost: this computer sent nothing for 2.50 ms")),
        (2.5, 2.5, ("machine", "2 lost: this computer sent nothing for 2.50 ms")),
    ],
)
def test_the_cause_of_a_loss_is_what_took_the_time(
    asleep_ms: float, took_ms: float, expected: tuple[str, str]
) -> None:
    """Between two exchanges, or in one: the pause after a long one, too, counts from when it was back."""
    steps, sent_ns = list[Decision](), 1_000_000_000
    for number in range(30):
        lost, long_one = number == 20, number in (19, 20)
        sent_ns += round((asleep_ms if lost else 0.9) * 1e6)
        took_ns = round((took_ms if long_one else 0.1) * 1e6)
        steps.append(step(sent_ns, 2 * lost, took_ns=took_ns))
        sent_ns += took_ns
    assert found(steps) == [expected]


def test_a_sensor_that_takes_no_part_is_told_once() -> None:
    kinds = [RecordKind.FRESH] * 5 + [RecordKind.INVALID] * 4 + [RecordKind.FRESH] * 5
    steps = [step(10**9 + number * 10**6, 4 * (number == 9), kind=kind) for number, kind in enumerate(kinds)]
    assert found(steps) == [
        ("not in the exchange", "it took no part in an exchange (working counter 3)"),
        ("not in the exchange", "4 lost: while it took no part"),
    ]


def test_what_was_uncertain_is_told_where_it_is_counted() -> None:
    """Once, with the reason of the sample at which it came up; the first has nothing before it."""

    def of(*told: tuple[int, bool]) -> list[tuple[str, str]]:
        steps = list[Decision]()
        for number in range(20):
            count, uncertain = dict(enumerate(told, 8)).get(number, (1, number == 0))
            took_ns = 2_000_000 if number == 8 and uncertain else 100_000
            steps.append(step(10**9 + number * 10**6, count - 1, uncertain, took_ns=took_ns))
        return found(steps)

    held = "an exchange took 2.00 ms"
    assert of((1, True)) == [("uncertain", f"maybe one lost: {held}")]
    assert of((1, True), (2, False)) == [
        ("uncertain", f"maybe one lost: {held}"),
        ("card or slave", f"1 lost: {held}"),
    ]
    assert of((1, True), (1, True), (1, False)) == [("uncertain", f"maybe one lost: {held}")]
    assert of((0, False)) == [("uncertain", "a sample that was counted as lost came late")]


def test_of_what_was_before_the_first_record_nothing_is_known() -> None:
    steps = [step(10**9, uncertain=True), step(10**9 + 10**6, 1)]
    assert found(steps) == [("uncertain", "1 lost: what came before is not in the trace")]


def test_a_trace_is_shown_line_by_line() -> None:
    """With a pause of 20 s in it."""
    steps = list[Decision]()
    for number in range(1200):
        kind = RecordKind.READ if number in (5, 6, 7) else RecordKind.FRESH
        kind = RecordKind.INVALID if number in (150, 151) else kind
        lost = 3 if number in (152, 155, *range(405, 1005, 30)) else 1
        at = 10**9 + number * 10**7 + 20_000_000_000 * (number >= 600)
        record = Record(at, 100_000 + 100 * (number % 100), 0, 0, 0, kind, number % 2 > 0, 3)
        steps.append(Decision(record, at - 50_000, lost, number == 0, number < 900, number % 2 > 0))
    lines = shown(steps)
    assert lines[:14] == [
        "written by x 1, 1200 records",
        "\nsensor 0 (M8)",
        "  32.0 s: 1195 samples, 44 lost, 3 polls without a new sample, 2 invalid exchanges",
        "  age when it was here p50 155, p99 160, max 160 µs",
        "  followed 74 % of the time, dated by the slave controller 49 %",
        "  exchanges p50 105, p99 110, max 110 µs",
        f"      0 s {'.' * 15}i{'.' * 24}{'s..' * 6}s{'.' * 41}",
        f"     20 s {'.' * 61}{'s..' * 13}",
        f"     30 s {'.' * 20}",
        "  ? uncertain, s sensor, c card or slave, m machine, i not in the exchange",
        "   1.5000 s  sensor 0: it took no part in an exchange (working counter 3)",
        "   1.5200 s  sensor 0: 2 lost: while it took no part",
        "   1.5500 s  sensor 0: 2 lost: it was polled and gave none",
        "   4.0500 s  sensor 0: 2 lost: it was polled and gave none",
    ]
    assert (len(lines), lines[-1]) == (31, "(3 more)")


@pytest.mark.parametrize(("losses", "last"), [(20, "20 lost: it was"), (21, "(1 more)")])
def test_of_many_losses_the_first_are_shown(losses: int, last: str) -> None:
    assert last in shown([step(10**9 + lost * 10**7, lost) for lost in range(losses + 1)])[-1]


def test_sensors_are_shown_one_by_one_and_their_losses_in_order() -> None:
    """The header does not describe the second one."""
    steps = [
        step(10**9 + number * 10**7 + sensor, number == lost, sensor=sensor)
        for number in range(40)
        for sensor, lost in ((0, 30), (2, 20))
    ]
    lines = shown(steps)
    table = [
        "  0.4 s: 40 samples, 1 lost, 0 polls without a new sample, 0 invalid exchanges",
        "  age when it was here p50 100, p99 100, max 100 µs",
        "  followed 100 % of the time, dated by the slave controller 100 %",
        "  exchanges p50 100, p99 100, max 100 µs",
    ]
    assert lines == [
        "written by x 1, 80 records",
        "\nsensor 0 (M8)", *table, "      0 s ...s", lines[7],
        "\nsensor 2 (None)", *table, "      0 s ..s.", lines[7],
        "   0.2000 s  sensor 2: 1 lost: it was polled and gave none",
        "   0.3000 s  sensor 0: 1 lost: it was polled and gave none",
    ]  # fmt: skip


def given(*parts: bytes, said: int = 0, **more: object) -> Callable[..., Any]:
    """A client of a server that answers each request with the next of these parts of its trace."""
    answers, whole = iter(parts), b"".join(parts)

    def ask(action: str, offset: int) -> dict[str, Any]:
        part = next(answers)
        assert (action, whole[offset:].startswith(part)) == ("trace", True)
        return {"data": base64.b64encode(part).decode(), "size": said or len(whole), **more}

    def client(*where: object, **how: bool) -> Any:
        assert (where, how) == ((12001, "localhost"), {"stream": False, "reconnect": False})
        return SimpleNamespace(connect=lambda: contextlib.nullcontext(SimpleNamespace(ask=ask)))

    return client


def test_a_trace_comes_in_parts_and_is_whole_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulation, path, server = Simulation(), tmp_path / "a.trace", "server at localhost:12001"
    simulation.run(0.2)
    data, foreign = trace_of(simulation), "the program at localhost:12001 is not a compatible ethercat-server"
    for client, to, why in (
        (given(data[:1000], data[1000:-1], data[-1:]), path, ""),
        (given(data[:9], b"", said=len(data)), path, f"the {server} ended its trace early: ask again"),
        (given(b"{}\n"), path, f"no trace of the {server}: it is no trace of"),
        (given(data, data="?"), path, foreign),
        (given(data, size=None), path, foreign),
        (given(data), tmp_path, f"{tmp_path} cannot be written: Is a directory"),
    ):
        monkeypatch.setattr("ethercat_server.doctor.trace.Client", client)
        if why:
            with pytest.raises(ServerError, match=f"^{re.escape(why)}"):
                save(to)
        else:
            assert save(to) == f"{path}: {len(data) // 1024} KiB; 'ethercat-doctor {path}' shows it"
        assert path.read_bytes() == data
    head, rest = data.split(b"\n", 1)
    for sensors, model in (("M8", "None"), (["M8"], "None"), ([{"model": "M" * 41}], "M" * 37 + "...")):
        path.write_bytes(json.dumps({**json.loads(head), "sensors": sensors}).encode() + b"\n" + rest)
        assert [*show(path)][1] == f"\nsensor 0 ({model})"


def test_a_loss_that_nothing_explains_leaves_a_trace_and_few_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    simulation = Simulation(settings={"sinc_length": 512})
    traces = LossTraces(simulation.server)
    written = []

    def second(command: str = "") -> None:
        if command:
            simulation.command(command)
        simulation.run(1.0)
        traces.each_second()
        if traces.writing is not None:
            traces.writing.join()
            traces.writing = None
            written.append(max(tmp_path.iterdir(), key=lambda path: path.stat().st_mtime_ns))

    second()
    simulation.at(0.1, lambda: simulation.clock.stall(50e6))
    simulation.at(0.2, "power cycle 0.1")
    second()
    assert simulation.status()["sensors"][0]["recoveries"] == 1, "this computer stood still just before"
    for _ in range(4):
        second()
    assert not written
    for _ in range(6):
        second("power cycle 0.1")
    assert len(written) == 1, "the others are too soon after it"
    [line] = [
        line for line in run_here(doctor, written[0]).out.splitlines() if "s: " in line and "lost" in line
    ]
    assert "invalid exchanges" in line
    for _ in range(4):
        for _ in range(610):
            traces.each_second()
        for _ in range(4):
            second("power cycle 0.1")
    assert len(written) == 5
    assert len(list(tmp_path.iterdir())) == 3, "the oldest is written over"


@pytest.mark.parametrize("name", NAMES)
def test_decisions_on_real_traces_are_the_known_ones(name: str) -> None:
    """After a change of the clocks: `python -m tests.traces.decisions`, and look at the difference."""
    assert decisions(name) == json.loads(DECISIONS.read_text())[name]
