"""Faults while streaming, in simulated time: same connections, same settings, nothing old as new."""

from __future__ import annotations

import functools
import itertools
import logging
import random
from typing import Any

import pytest

from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RequestError
from bota_ethercat.framing import DataFlag
from bota_ethercat.settings import SettingValue, sampling_rate_hz
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import PROCESSED_BIT, SHORTEST_FRAME, SOURCE_ADDRESS, Command, build
from ethercat_server.sensor.undo import Former, or_undone
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.sensor import Firmware
from tests.server.running import OLD
from tests.simulation import Client, Simulation, check_frames, fresh, life_of, more_if_long, reading

CLOCK = SensorOptions(signal="clock", ppm=150.0)
WANTED = {"acceleration_range_g": 8}
OFFSET = 0x8000


def streaming(
    *sensors: SensorOptions, machine: Machine | None = None, **settings: SettingValue
) -> tuple[Simulation, Client]:
    """A server on a sensor, and a client that has subscribed."""
    simulation = Simulation(*(sensors or (CLOCK,)), machine=machine, settings={**WANTED, **settings})
    client = simulation.subscribe()
    client.fresh(50)
    return simulation, client


def state(client: Client, sensor: int = 0) -> str:
    found: str = client.described(sensor)["state"]
    return found


@pytest.mark.parametrize("times", more_if_long([2], [2, 20]))
@pytest.mark.parametrize(
    ("fault", "seconds", "loses_settings"),
    [
        ("lose 300", 0.5, False), ("deaf 2", 2.0, False), ("power cycle 2", 2.0, True),
        ("safeop 0x1B", 0.0, False),
    ],
)  # fmt: skip
def test_samples_flow_again_on_the_same_connection_half_a_second_after_the_sensor_can_answer(
    fault: str, seconds: float, loses_settings: bool, times: int
) -> None:
    """Every time."""
    simulation, client = streaming()
    for _ in range(times):
        client.frames.clear()
        able_ns = simulation.clock.now_ns + seconds * 1e9
        simulation.command(fault)
        lost = client.wait_event("sensor_lost")
        assert (lost["sensor"], bool(lost["message"])) == (0, True)
        assert client.wait_event("sensor_back")["settings"]["acceleration_range_g"] == 8
        during = list(client.frames)
        first = client.fresh(1)
        assert simulation.clock.now_ns - able_ns < 0.5e9
        if loses_settings:
            assert reading(first[0]).number < 2000, "the sensor started anew"
        after = client.fresh(100)
        if seconds:  # the return from SAFEOP takes less time than it takes to call a sensor silent
            assert 0 in {f.wkc for f in during if f.flags & DataFlag.INVALID}
        assert any(f.flags & DataFlag.GAP for f in during + first + after)
    assert state(client) == simulation.stats()["al_state"] == "OP"
    assert client.ask("status")["sensors"][0]["recoveries"] == times
    # Only what the sensor does not hold anyway: the range, and SINC, which is to be last.
    assert simulation.written() == [("0x8004", 0, "02"), ("0x8006", 1, "4000")] * (1 + times * loses_settings)
    assert simulation.stats()["calibration_writes"] == 0
    check_frames(simulation.frames)


def test_a_stuck_sensor_stays_visible_as_repeated() -> None:
    simulation, client = streaming()
    simulation.command("stick")
    while not client.collect(1)[0].flags & DataFlag.REPEATED:
        pass
    frames = client.collect(20)
    assert all(f.flags & OLD for f in frames)
    assert len({f.process_data for f in frames}) == 1
    simulation.frames.clear()
    simulation.run(0.1)
    assert len(simulation.frames) == pytest.approx(80, abs=2), "one a period"
    assert {frame.flags for frame in simulation.frames} == {DataFlag.REPEATED}
    simulation.command("unstick")
    assert len(client.fresh(50)) == 50
    assert state(client) == "OP"
    from_the_start = Simulation(SensorOptions(signal="constant", last_bit=False)).subscribe()
    assert all(f.flags & DataFlag.REPEATED for f in from_the_start.collect(10))


@pytest.mark.parametrize("model", ["BFT-ROKS-ECAT-M8", "BFT-SENS-ECAT-M8"])
def test_another_sensor_is_refused_and_the_right_one_taken_back(model: str) -> None:
    """Of another model, and of the same."""
    simulation, client = streaming()
    written = simulation.written()
    simulation.command(f"swap {model} 4711")
    client.wait_event("sensor_lost")
    refused = client.wait_event("sensor_lost")
    assert refused["reason"] == "different_sensor"
    assert refused["found"] == {"name": model, "serial": 4711}
    assert "4711" in refused["message"]
    assert state(client) == "REFUSED"
    frames = client.collect(30)
    assert all(f.flags & DataFlag.INVALID for f in frames), "nothing of the other sensor may come through"
    simulation.backend.become(Machine(lost=0.2))
    simulation.run(2.0)
    simulation.backend.become(Machine())
    assert client.events == [], "a lost datagram is no other sensor to be looked at"
    assert simulation.written() == written, "and nothing is written to it"
    simulation.command("swap BFT-SENS-ECAT-M8 1")
    back = client.wait_event("sensor_back")
    assert back["sensor"] == 0
    assert len(client.fresh(50)) == 50
    assert state(client) == "OP"
    check_frames(simulation.frames)


def test_an_interface_that_is_down_is_the_reason_and_is_asked_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulation, client = streaming()
    asked: list[int] = []

    def why_silent() -> str:
        asked.append(simulation.clock.now_ns)
        return "ens5 is down: bring it up with 'sudo ip link set ens5 up'"

    monkeypatch.setattr(simulation.backend, "why_silent", why_silent)
    simulation.command("power off")
    assert client.wait_event("sensor_lost")["reason"].startswith("no frame comes back: ens5 is down")
    simulation.run(2.0)
    assert len(asked) == 1


def chain_of_two() -> tuple[Simulation, Client]:
    return streaming(CLOCK, SensorOptions(signal="clock", serial=2))


def lost(client: Client) -> list[tuple[int, str]]:
    return [(e["sensor"], e["reason"]) for e in client.events if e["event"] == "sensor_lost"]


def test_one_that_dies_or_leaves_op_while_another_is_out_is_lost_too() -> None:
    simulation, client = chain_of_two()
    simulation.command("power off @1")
    simulation.run(0.1)
    assert lost(client) == [(1, "it does not answer")]
    simulation.command("safeop 0x1B @0")
    client.wait_event("sensor_back", 0)
    assert [reason[:15] for _, reason in lost(client)[1:]] == ["it is in SAFEOP"]
    simulation.command("power off @0")
    simulation.run(0.3)
    assert [number for number, _ in lost(client)] == [1, 0, 0]


def test_one_that_dies_while_another_is_out_and_counted_is_lost_too() -> None:
    """One in OP that does not stream yet adds the same to the working counter as the other.

    In the frame the place of the other is as it was sent then.
    """
    simulation, client = chain_of_two()
    simulation.sensors[0].change_interrupted = True  # so that it is asked for its settings, in vain
    simulation.command("mute-mailbox 100000 @0")
    simulation.recovery.sensors[0].lose("its settings are to be put right")
    simulation.run(0.1)
    simulation.command("power off @1")
    simulation.run(0.3)
    check_frames([frame for frame in simulation.frames if frame.sensor == 1], complete=False)
    assert [number for number, _ in lost(client)] == [0, 1]
    assert (state(client, 0), state(client, 1)) == ("LOST", "LOST")
    assert simulation.stats()["al_state"] == "OP"


def test_a_sensor_that_keeps_its_error_is_not_asked_for_op(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    simulation, client = streaming(sinc_length=512)
    asked: list[int] = []
    monkeypatch.setattr(life_of(simulation.backend), "al_control", asked.append)
    simulation.command("safeop 0x1B")
    client.wait_event("sensor_lost")
    keeps = "sensor 0 keeps its error although it was acknowledged: it is in SAFEOP"
    simulation.run_until(lambda: keeps in caplog.text, keeps)
    assert {value & 0x1F for value in asked} == {0x14}, "SAFEOP, with an acknowledge"


@pytest.mark.parametrize("another_is_out", [False, True])
def test_a_lost_datagram_is_no_lost_sensor(monkeypatch: pytest.MonkeyPatch, another_is_out: bool) -> None:
    simulation, client = chain_of_two()
    if another_is_out:
        simulation.command("power off @1")
        client.wait_event("sensor_lost", 1)
    read, count = simulation.bus.read_register, itertools.count()

    def lose_every_other(number: int, address: int, size: int) -> Steps[bytes | None]:
        lose = (number, address) == (0, reg.AL_STATUS) and next(count) % 2 == 0
        return None if lose else (yield from read(number, address, size))

    monkeypatch.setattr(simulation.bus, "read_register", lose_every_other)
    simulation.run(1.2)
    assert next(count) > 10
    assert lost(client) == []


def test_a_sensor_that_is_slow_to_change_its_state_comes_back_too(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It looks at AL control a few exchanges after it was written, and finds what was written last."""
    act, work = Firmware.al_control, Firmware.check_watchdog
    waiting: dict[Firmware, tuple[int, int]] = {}

    def remember(self: Firmware, value: int) -> None:
        due, _ = waiting.get(self, (self.clock() + 3_000_000, 0))
        waiting[self] = due, value

    def look(self: Firmware, now: int) -> None:
        work(self, now)
        if self in waiting and now >= waiting[self][0]:
            act(self, waiting.pop(self)[1])

    monkeypatch.setattr(Firmware, "al_control", remember)
    monkeypatch.setattr(Firmware, "check_watchdog", look)
    simulation, client = streaming()
    simulation.command("safeop 0x1B")
    client.wait_event("sensor_lost")
    client.wait_event("sensor_back")
    assert len(client.fresh(50)) == 50
    # As long as the acknowledge is on its way the error is no refusal of OP.
    assert "does not go to OP" not in caplog.text


# -- faults by the hundred

ANY_FAULT = (
    "deaf 0.02", "deaf 0.2", "power cycle 0.01", "power cycle 0.3", "safeop 0x1B", "error 0x11", "lose 1",
    "lose 5", "lose 60", "damage 5", "flap", "mute-mailbox 1", "mute-mailbox 3", "stick", "unstick",
    "swap BFT-ROKS-ECAT-M8 4711", "swap BFT-SENS-ECAT-M8 1",
)  # fmt: skip
ANY_REQUEST: tuple[tuple[str, dict[str, Any]], ...] = (
    ("configure", {"settings": {"imu_active": 3}}),
    ("configure", {"settings": {"imu_active": 1}}),
    ("configure", {"settings": {"chop": True}}),
    ("configure", {"settings": {"chop": False}, "save": True}),
    ("tare", {"samples": 20}),
    ("sdo_read", {"name": "Sampling rate"}),
    ("status", {}),
)


def any_machine(chance: random.Random, seed: int) -> Machine:
    return Machine(
        seed=seed,
        wake_ns=chance.choice([15e3, 100e3]),
        lost=chance.choice([0, 0.01, 0.03]),
        late=chance.choice([0, 0.01, 0.03]),
        stall_every_s=chance.choice([0, 0.3]),
        stall_ns=chance.choice([2e6, 20e6, 150e6]),
    )


@pytest.mark.parametrize("seed", more_if_long(range(2), range(20)))
def test_whatever_happens_the_stream_is_true_and_comes_back(seed: int) -> None:
    """Twenty faults in some ten seconds, on a bad machine, while clients configure, tare and save."""
    chance = random.Random(seed)
    simulation, listener = streaming(machine=any_machine(chance, seed))
    asking = simulation.connect()
    offset, asked = sensor_offset(asking), []
    at = 0.0
    for _ in range(20):
        at += chance.uniform(0.01, 0.6)
        fault = chance.choice(ANY_FAULT)
        # A sensor without power refuses some.
        simulation.at(at, lambda fault=fault: simulation.backend.command(fault))  # type: ignore[misc]
        if chance.random() < 0.5:
            action, keys = chance.choice(ANY_REQUEST)
            at += chance.uniform(-0.01, 0.03)
            simulation.at(
                max(0, at),
                lambda action=action, keys=keys: asked.append(asking.send(action, **keys)),  # type: ignore[misc]
            )
    simulation.run(at + 0.1)
    for command in ("swap BFT-SENS-ECAT-M8 1", "hear", "mute-mailbox 0", "unstick"):
        simulation.backend.command(command)
    for number in asked:
        asking.reply(number)
    simulation.run_until(lambda: simulation.sensors[0].streams, "the sensor to be back")
    simulation.run(1.0)

    assert len(listener.fresh(100)) == 100
    check_frames(simulation.frames)
    sent = [frame.sequence for frame in listener.frames]
    assert sent == sorted(set(sent))
    assert not listener.at_end
    assert not asking.at_end
    # What the server says is in force the sensor holds.
    described = asking.described()
    for name, value in described["settings"].items():
        if name in ("imu_active", "chop", "acceleration_range_g"):
            assert setting_value(name, read_object(asking, name=name)["hex"]) == value, name
    assert described["settings"]["acceleration_range_g"] == 8
    rate = read_object(asking, name="Sampling rate")["value"]
    assert rate == described["rate_hz"] == sampling_rate_hz(described["settings"]["sinc_length"])
    now = sensor_offset(asking)
    tared = [reply for reply in asking.replies if reply["reply"] == "tare" and reply["ok"]]
    assert now == pytest.approx(tared[-1]["new_offset"] if tared else offset)


def sensor_offset(asking: Client) -> list[float]:
    return [read_object(asking, index=OFFSET, subindex=n, type="f32")["value"] for n in range(1, 7)]


def read_object(asking: Client, **keys: Any) -> dict[str, Any]:
    """Asked again while the sensor is out: a machine may stall for longer than its watchdog waits."""
    simulation = asking.simulation
    for _ in range(50):
        simulation.run_until(lambda: simulation.sensors[0].streams, "the sensor to be back")
        reply = asking.ask("sdo_read", **keys)
        if reply["ok"]:
            return reply
        assert reply["error"]["code"] == "not_ready", reply
    raise AssertionError(f"{keys} could not be read: {reply}")


def setting_value(name: str, raw: str) -> int | bool:
    number = int.from_bytes(bytes.fromhex(raw), "little")
    return {"acceleration_range_g": 2 << number}.get(name, bool(number) if name == "chop" else number)


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize("lost", more_if_long([0.1], [0.0, 0.1]))
def test_time_out_of_op_is_no_lost_samples(dc: str, lost: float) -> None:
    """Exchanges go on while it comes back, and bring samples as soon as it is in OP; steps are repeated."""
    simulation, client = streaming(SensorOptions(signal="clock", ppm=150.0, dc=dc))
    stream = simulation.streams[0]
    for recovery in range(7):
        simulation.backend.become(Machine(lost=lost))
        simulation.run(0.2)
        simulation.command("safeop 0x1B" if recovery % 3 else f"power cycle {0.06 * recovery}")
        client.wait_event("sensor_lost")
        missed, before = stream.lost_samples, len(simulation.frames)
        client.wait_event("sensor_back")
        simulation.backend.become(Machine())
        client.fresh(1)
        assert fresh(simulation.frames[before:])[0].flags & DataFlag.GAP
        assert stream.lost_samples == missed


@pytest.mark.parametrize("fault", ["safeop 0x1B", "power cycle 0.1"])
def test_three_samples_are_discarded_after_a_return_and_not_shown_as_the_last_good_ones(fault: str) -> None:
    simulation, client = streaming()
    for microseconds in range(500, 5000, 500):
        for goes_on in (True, False):
            simulation.command(fault)
            client.wait_event("sensor_lost")
            client.wait_event("sensor_back")
            now, at = life_of(simulation.backend).inputs(), len(simulation.frames)
            if goes_on:
                simulation.run(0.02)
                first = simulation.frames[at]
                assert first.flags == DataFlag.GAP, (
                    "it is not silent before it had time for its first samples"
                )
                assert reading(first).number - reading(first._replace(process_data=now)).number >= 2
            else:
                simulation.run(microseconds * 1e-6)
                simulation.command("deaf 0.1")
                simulation.run(0.02)
                assert simulation.frames[-1].flags == DataFlag.INVALID
                client.wait_event("sensor_back")
    check_frames(simulation.frames)
    (stream,), period_ns = simulation.streams, 1_250_000
    stream.silent_at_ns = 0
    stream.recover(period_ns)
    assert stream.silent_at_ns > simulation.clock.now_ns + period_ns, "its first samples may still come"


def test_event_times_that_were_trusted_are_tried_again_after_a_return_however_they_fail() -> None:
    simulation, client = streaming()
    (stream,) = simulation.streams
    simulation.run(2.0)
    assert stream.status()["clock"]["stamps"] == "hardware"
    simulation.command("power cycle 0.1")
    client.wait_event("sensor_back")
    assert stream.clock.events is not None
    assert not stream.clock.by_events
    assert stream.clock.events.trust.was_trusted


@pytest.mark.parametrize("was", [False, True])
def test_a_change_that_is_undone_leaves_the_doubt_of_one_before(was: bool) -> None:
    def change() -> Steps[None]:
        yield from ()
        raise RequestError(ErrorCode.SENSOR, "no answer")

    def undo() -> Steps[object]:
        yield from ()
        assert sensor.change_interrupted, "while it is not done"
        return None

    simulation, _ = streaming()
    sensor = simulation.sensors[0]
    sensor.change_interrupted = was
    with pytest.raises(RequestError, match=r"no answer; as it was"):
        next(or_undone(change(), undo, Former("it", "; as it was", "", ""), sensor))
    assert sensor.change_interrupted is was


@pytest.mark.parametrize("most", more_if_long([3], [3, 20]))
@pytest.mark.parametrize("seed", more_if_long([0], range(5)))
def test_one_that_returns_with_a_slow_eeprom_costs_the_other_nothing(seed: int, most: int) -> None:
    """Two sensors, 3 or 20 power cuts of the second; its EEPROM takes 30 ms a read."""

    def lost(cuts: int) -> int:
        simulation = Simulation(
            CLOCK, SensorOptions(signal="clock", serial=2, eeprom_ms=30.0), machine=Machine(seed=seed)
        )
        for cut in range(cuts):
            simulation.at(0.5 + 0.5 * cut, "power cycle 0.1 @1")
        simulation.run(0.5 + 0.5 * most)
        first, second = simulation.status()["sensors"]
        assert second["recoveries"] == cuts
        assert simulation.sensors[1].streams
        check_frames(frame for frame in simulation.frames if frame.sensor == 0)
        assert not any(frame.flags & OLD for frame in simulation.frames if frame.sensor == 0)
        return int(first["lost_samples"])

    assert lost(most) <= lost(0)


def test_a_busy_computer_is_named_where_it_explains_the_loss() -> None:
    """And only there: the same AL error without a stall, or a second after it, is the sensor's."""
    simulation, client = streaming(sinc_length=512)
    for stall_ns, later_s, named in (
        (300e6, 0.0, True),
        (0.0, 0.0, False),
        (150e6, 1.5, False),
        (5e6, 0.0, False),
    ):
        simulation.at(0.005, functools.partial(simulation.clock.stall, stall_ns))
        simulation.run(0.01 + later_s)
        if not (lost := [event for event in client.events if event["event"] == "sensor_lost"]):
            simulation.command("safeop 0x1B")
            lost = [client.wait_event("sensor_lost")]
        assert ("this computer stood still for" in lost[0]["message"]) is named
        client.events.clear()
        simulation.run(1.5)
        client.events.clear()


def test_a_busy_computer_is_named_in_place_of_the_cable_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for why, said in (
        ("check cable and power", "this computer stood still for"),
        ("ens5 is down", "ens5 is down"),
    ):
        simulation, client = streaming()
        monkeypatch.setattr(simulation.backend, "why_silent", lambda why=why: why)
        simulation.at(0.005, functools.partial(simulation.clock.stall, 60e6))
        simulation.run(0.01)
        simulation.command("power off")
        reason = client.wait_event("sensor_lost")["reason"]
        assert reason.startswith(f"no frame comes back: {said}")
        assert "cable" not in reason
        assert ("stood still" in reason) is ("stood still" in said)


@pytest.mark.parametrize(
    ("source", "index"),
    more_if_long([("021011223344", 0x95)], [("021011223344", 0x95), ("010101010101", 3)]),  # IgH's, SOEM's
)
def test_another_master_on_the_wire_is_named_and_so_is_its_end(
    source: str, index: int, caplog: pytest.LogCaptureFixture
) -> None:
    simulation, client = streaming(sinc_length=512)  # the fewer samples, the faster it is simulated
    caplog.set_level(logging.INFO)
    on = True
    simulation.backend.become(Machine(late=0.1, late_ns=150e6))
    simulation.run(2.0)
    assert "no frame comes back: check cable and power" in caplog.text
    assert "another" not in caplog.text, "late answers are its own"
    assert "stood still" not in caplog.text
    simulation.backend.become(Machine())
    client.wait_event("sensor_back")
    simulation.run(1.0)
    client.events.clear()

    def send() -> None:
        """Its frames are seen, too, once the slaves have processed them."""
        theirs = build((Command.BRD, 0, 0x130, bytes(2)), source=bytes.fromhex(source), first_index=index)
        theirs[SOURCE_ADDRESS] |= PROCESSED_BIT
        simulation.backend.put_on_the_wire(bytes(theirs.ljust(SHORTEST_FRAME, b"\0")))
        if on:
            simulation.at(0.01, send)

    send()
    simulation.run(1.5)
    simulation.command("disconnect")
    lost = client.wait_event("sensor_lost")["message"]
    assert lost.endswith("check for another EtherCAT master, whose frames arrive on memory")
    assert caplog.text.count("another EtherCAT master is sending on memory") == 1
    on = False
    simulation.run(15.0)
    assert caplog.text.count("the other EtherCAT master on memory has stopped sending") == 1


# -- however slow the machine: a sensor that answers at all streams, comes back, and keeps its settings

FRAME_MS = (1, 3, 5, 10, 20, 30)
MACHINES = {
    **{f"frames take {ms} ms": Machine(frame_ns=ms * 1e6, frame_jitter_ns=1e6) for ms in FRAME_MS},
    **{f"{ms} ms, often more": Machine(frame_ns=ms * 1e6, frame_jitter_ns=10e6) for ms in FRAME_MS},
    **{
        f"{ms} ms, with stalls": Machine(
            frame_ns=ms * 1e6, frame_jitter_ns=3e6, wake_ns=10e6, stall_every_s=0.3, stall_ns=200e6
        )
        for ms in FRAME_MS
    },
    "frames get lost too": Machine(
        frame_ns=5e6, frame_jitter_ns=5e6, wake_ns=10e6, stall_every_s=0.5, stall_ns=200e6, lost=0.02
    ),
}


USUAL = ("30 ms, with stalls", "frames get lost too")


@pytest.mark.parametrize("machine", more_if_long(USUAL, MACHINES))
def test_samples_come_and_come_back_after_a_power_cut(machine: str) -> None:
    simulation, client = streaming()
    simulation.run(0.5)
    simulation.backend.become(MACHINES[machine])
    for _ in range(2):
        simulation.run_until(lambda: not client.events and client.fresh(20), "samples", 20)
        simulation.command("power cycle 0.3")
        client.events.clear()
        client.wait_event("sensor_lost")
        back = client.wait_event("sensor_back")
        assert back["settings"]["acceleration_range_g"] == 8
        client.fresh(20)
        client.events.clear()
    assert client.ask("status")["ok"]
    check_frames(simulation.frames)
    simulation.backend.become(Machine())
    simulation.run(1.0)
    simulation.frames.clear()
    simulation.run(0.5)
    assert len(fresh(simulation.frames)) > 390, "as fast as the machine again"


@pytest.mark.parametrize("milliseconds", more_if_long([30], FRAME_MS))
def test_a_sensor_is_not_lost_because_its_frames_take_long(milliseconds: int) -> None:
    simulation, client = streaming()
    simulation.run(0.5)
    simulation.backend.become(Machine(frame_ns=milliseconds * 1e6, frame_jitter_ns=0.2e6))
    simulation.run(2.0)
    client.events.clear()
    before = simulation.status()["lost_frames"]
    simulation.run(2.0)
    assert client.events == []
    assert simulation.status()["lost_frames"] - before <= 4
    assert len(client.fresh(50)) == 50


def test_a_single_late_answer_makes_the_loop_wait_longer_for_some_exchanges_only() -> None:
    simulation, client = streaming()
    simulation.run(1.0)
    simulation.backend.become(Machine(frame_ns=5e6))
    client.frames.clear()
    simulation.run(0.02)
    simulation.backend.become(Machine())
    simulation.run(0.1)
    before = simulation.status()["sensors"][0]["lost_samples"]
    for _ in range(10):
        simulation.command("lose 1")
        client.fresh(20)
    assert simulation.status()["sensors"][0]["lost_samples"] - before <= 1


def test_an_incomplete_answer_is_forgotten_if_complete_ones_follow() -> None:
    """So two that are far apart are no reason to read the sensors' states."""
    running = Simulation()
    running.run(0.2)
    running.recovery.check_answer(complete=False)
    assert running.recovery.incomplete
    running.run(0.05)
    assert not running.recovery.incomplete
