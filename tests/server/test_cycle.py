"""The loop in simulated time: stalls, lost frames, the sockets' turn, a machine that is slow."""

from __future__ import annotations

import functools
import itertools
import logging
import random
import re
from collections.abc import Sequence

import pytest

from bota_ethercat.distribution import RecentDistribution
from bota_ethercat.framing import DataFlag, DataMessage
from ethercat_server.acquisition import health
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.sampling.trust import TrustState
from ethercat_server.simulation.machine import REALTIME_START_NS, START_NS, Machine, SimulatedClock
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation, check_frames, fresh, life_of, more_if_long, reading

PERIOD_NS = 1_250_000


def simulation(machine: Machine | None = None, **options: object) -> Simulation:
    sensor = SensorOptions(**{"signal": "clock", "ppm": 150.0, **options})  # type: ignore[arg-type]
    return Simulation(sensor, machine=machine or Machine())


def numbers(frames: Sequence[DataMessage]) -> list[int]:
    """The sensor's own numbers of the samples that were handed out as new."""
    return [reading(frame).number for frame in fresh(frames)]


def lost(frames: Sequence[DataMessage]) -> int:
    """Samples that are missing between the first and the last."""
    got = numbers(frames)
    assert got == sorted(set(got)), "none twice, none out of order"
    return got[-1] - got[0] + 1 - len(got)


def ages_ns(running: Simulation) -> list[int]:
    """Of the samples when they were handed out."""
    made = zip(running.frames, running.published_ns, strict=True)
    return sorted(at_ns - reading(frame).instant_ns for frame, at_ns in made)


def check_lost(running: Simulation, least: int = 1, off_by: int = 0) -> None:
    """What was lost is flagged, and `lost_samples` has it, once the samples after it have come."""
    running.backend.become(Machine())
    running.run(0.1)
    check_frames(running.frames)
    assert lost(running.frames) >= least
    counted = running.status()["sensors"][0]["lost_samples"]
    assert counted == pytest.approx(lost(running.frames), abs=off_by)


def test_every_sample_is_handed_out_once_and_its_stamp_is_its_instant() -> None:
    running = simulation()
    running.run(4.0)
    got = numbers(running.frames)
    assert lost(running.frames[800:]) == 0
    assert len(got) > 3100
    for frame in running.frames[800:]:
        assert abs(frame.monotonic_ns - reading(frame).instant_ns) < 60_000
    status = running.status()
    assert status["sensors"][0]["clock"]["mode"] == "locked"
    assert status["sensors"][0]["clock"]["offset_ppm"] == pytest.approx(150, abs=5)
    assert status["cycles"] < 1.5 * len(got), "hardly more than one exchange a sample"


def test_a_stamp_is_the_monotonic_moment_despite_preemption(monkeypatch: pytest.MonkeyPatch) -> None:
    time_ns, chance = SimulatedClock.time_ns, random.Random(1)

    def preempted(clock: SimulatedClock) -> int:
        before_ns, after_ns = chance.choices((0, 1_000_000, 3_000_000), weights=(3, 1, 1), k=2)
        clock.stall(before_ns)
        now_ns = time_ns(clock)
        clock.stall(after_ns)
        return now_ns

    monkeypatch.setattr(SimulatedClock, "time_ns", preempted)
    running = simulation()
    running.run(2.0)
    (offset_ns,) = {frame.stamp_ns - frame.monotonic_ns for frame in running.frames}
    assert abs(offset_ns - (REALTIME_START_NS - START_NS)) < 1000


@pytest.mark.parametrize("seconds", [-3600, 3600, -1e-5, 1e-5])
def test_stamps_follow_a_clock_that_is_set_at_once_and_by_exactly_as_much(seconds: float) -> None:
    running = simulation()
    running.at(1.0, lambda: running.clock.set_realtime_back(-seconds))
    running.run(1.0)
    before = running.frames[-1]
    running.run(0.03)
    after = running.frames[-1]
    assert after.stamp_ns - before.stamp_ns - round(seconds * 1e9) == after.monotonic_ns - before.monotonic_ns


def test_stamps_rise_while_the_clock_is_only_slewed() -> None:
    running = simulation()
    for millisecond in range(2000):
        running.at(0.001 * millisecond, lambda: running.clock.set_realtime_back(0.5e-6))
    running.run(2.0)
    stamps = [frame.stamp_ns for frame in running.frames]
    assert stamps == sorted(set(stamps))
    assert running.clock.time_ns() - stamps[-1] < 3e6


# chrony's largest by default, phc2sys' and adjtimex' (a tick 10 % longer), ntpd's.
SLEWS = (1 / 12, -1 / 13, 0.1, -0.1, 0.04, -0.02, 0.0005)


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize(
    ("slew", "sinc_length"), more_if_long([(0.1, 64), (-0.1, 512)], itertools.product(SLEWS, (32, 64, 512)))
)
def test_a_slew_costs_no_sample_and_stamps_follow_it(slew: float, sinc_length: int, dc: str) -> None:
    sensor = SensorOptions(signal="clock", ppm=150.0, dc=dc)
    running = Simulation(sensor, machine=Machine(), settings={"sinc_length": sinc_length})
    running.run(2.0)
    start = len(running.frames)
    for now in (slew, 0.0, -slew, 0.0):
        running.backend.become(Machine(slew=now))
        running.run(1.0)
    got = running.frames[start:]
    check_frames(got)
    assert lost(got) == running.status()["sensors"][0]["lost_samples"] == 0
    errors_ns = sorted(abs(frame.monotonic_ns - reading(frame).instant_ns) for frame in got)
    assert errors_ns[-5] < 10_000, "all but those of the samples in which it changed"
    assert errors_ns[-1] < 40_000
    (offset_ns,) = {frame.stamp_ns - frame.monotonic_ns for frame in got}
    assert abs(offset_ns - (REALTIME_START_NS - START_NS)) < 1000
    running.clock.stall(100 * PERIOD_NS)
    running.backend.become(Machine(slew=slew))
    running.run(0.5)
    running.clock.stall(100 * PERIOD_NS)
    check_lost(running, 10)


def test_a_stall_is_counted_and_followed_by_no_burst() -> None:
    running, periods = simulation(), 30
    running.at(1.0, lambda: running.clock.stall(periods * PERIOD_NS))
    running.run(1.0 + periods * 1.25e-3)
    cycles = running.status()["cycles"]
    running.run(3 * 1.25e-3)
    assert running.status()["cycles"] - cycles < periods / 2, "it does not make up for the stall"
    running.run(1.0)
    status = running.status()
    assert status["missed_deadlines"] >= periods - 2
    check_lost(running, periods - 3)
    got = numbers(running.frames)
    after = next(n for n, pair in enumerate(itertools.pairwise(got)) if pair[1] - pair[0] > 5) + 1
    assert fresh(running.frames)[after].flags & DataFlag.GAP


@pytest.mark.parametrize(
    ("where", "frame_us"),
    more_if_long([("machine", 40), ("wire", 3000)], itertools.product(("machine", "wire"), (40, 3000))),
)
def test_a_hold_up_counts_as_the_periods_that_it_takes(
    where: str, frame_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where many exchanges are under way at once; this computer is blamed for its own only."""
    running = simulation(Machine(frame_ns=frame_us * 1e3))
    running.run(2.0)
    carry, clock = running.backend.carry, running.clock
    for periods in (16, 40, 80, 120):
        before, until_ns = running.status()["missed_deadlines"], clock.now_ns + periods * PERIOD_NS
        if where == "machine":
            running.at(0.0005, functools.partial(clock.stall, periods * PERIOD_NS))
        else:

            def held(until_ns: int = until_ns) -> tuple[int, int] | None:
                times = carry()
                return times and (times[0], max(times[1], until_ns - clock.now_ns))

            monkeypatch.setattr(running.backend, "carry", held)
        running.run(periods * 1.25e-3 + 0.1)
        missed = running.status()["missed_deadlines"] - before
        # A frame that is away for more than 100 ms may be lost, and not late.
        assert (periods if where == "machine" else min(periods, 80)) - 6 <= missed <= periods + 2
        why = running.recovery.causes.explain("", clock.now_ns)
        said = re.search(r"stood still for (\d+) ms", why)
        assert bool(said) is (where == "machine" and periods > 16), "20 ms explain no loss"
        assert said is None or int(said[1]) == pytest.approx(periods * 1.25, abs=8)
        running.run(1.2)


@pytest.mark.parametrize(
    ("longer_us", "jitter_us", "busy_s"),
    more_if_long(
        [(150, 50, (2, 6)), (620, 10, (2, 4, 5, 7))],
        [(150, 50, (2, 6)), (620, 10, (2, 4, 5, 7)), (60, 30, (2, 5))],
    ),
)
def test_event_times_stay_in_use_while_frames_are_held_up_on_their_way_out(
    longer_us: float, jitter_us: float, busy_s: Sequence[float]
) -> None:
    """On a busy machine frames leave late for some time: the registers are right, and samples keep them."""
    running, chance = simulation(), random.Random(1)
    carry, began_ns = running.backend.carry, running.clock.now_ns

    def busy() -> tuple[int, int] | None:
        times, seconds = carry(), (running.clock.now_ns - began_ns) * 1e-9
        if times is None or not sum(seconds > each for each in busy_s) % 2:
            return times
        longer_ns = 1000 * (longer_us + chance.expovariate(1) * jitter_us)
        return round(times[0] + longer_ns), round(times[1] + longer_ns)

    running.backend.carry = busy  # type: ignore[method-assign]
    running.run(busy_s[0] - 0.1)
    events = running.streams[0].clock.events
    assert events is not None
    assert events.trust.state is TrustState.TRUSTED
    while running.clock.now_ns - began_ns < (busy_s[-1] + 1.0) * 1e9:
        running.run(0.1)
        assert events.trust.state is TrustState.TRUSTED, events.trust.why
    assert events.local_clock.restarts == 0
    check_frames(running.frames)


@pytest.mark.parametrize("sinc_length", [64, 2048])
def test_lost_frames_cost_no_sample_when_the_next_exchange_comes_in_time(sinc_length: int) -> None:
    running = simulation(sinc_length=sinc_length)
    running.run(1.25)
    before = len(running.frames)
    for n in range(20):
        running.at(0.05 * n, "lose 1")
    running.run(1.25)
    assert running.status()["lost_frames"] >= 20
    assert lost(running.frames[before:]) <= 2
    assert running.events == []


@pytest.mark.parametrize("seconds", more_if_long([3.0], [3.0, 60.0]))
def test_what_is_lost_is_flagged_and_counted_on_a_bad_wire(seconds: float) -> None:
    running = simulation(Machine(seed=7, lost=0.05, stall_every_s=0.5, stall_ns=20e6, wake_ns=40_000))
    running.run(seconds)
    check_lost(running, round(8 * seconds))
    assert running.events == [], "single lost frames and stalls are no lost sensor"


@pytest.mark.parametrize("dc", ["", "none"])
def test_stalls_of_any_length_are_counted(dc: str) -> None:
    running, chance = simulation(dc=dc), random.Random(1)
    running.run(0.5)
    for _ in range(60):
        running.clock.stall(chance.uniform(0.2, 20) * PERIOD_NS)
        running.run(chance.uniform(0.005, 0.05))
    check_lost(running, 300)


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize("late_ms", more_if_long([15], [2, 5, 15]))
def test_samples_that_pass_while_the_sensor_itself_is_held_up_are_counted(dc: str, late_ms: int) -> None:
    """Frames wait for it, and all find the same sample then: no silence, for others came before it."""
    running = simulation(dc=dc)
    running.run(0.5)
    running.backend.become(Machine(late=0.01, late_ns=late_ms * 1e6))
    running.run(3.0)
    check_lost(running, 2 * late_ms)


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize("jitter_us", more_if_long([700], [300, 400, 700]))
@pytest.mark.parametrize("seed", more_if_long([0], range(6)))
def test_what_is_lost_is_counted_though_frames_take_unevenly_long(seed: int, jitter_us: int, dc: str) -> None:
    """A starved slave looks at its data anywhere within an exchange: of the first it is not sure."""
    running = simulation(Machine(seed=seed, frame_jitter_ns=jitter_us * 1e3, wake_ns=50e3), dc=dc)
    running.run(2.0)
    check_lost(running, off_by=1)


def test_polls_of_several_sensors_are_merged_if_exchanges_cost_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """As they do on a real machine: without cost there is nothing to save."""
    sensors = [SensorOptions(serial=n, signal="clock", ppm=37.0 * n) for n in range(4)]
    running = Simulation(*sensors, machine=Machine())
    publish = running.hub.publish

    def busy(made: Sequence[OutgoingFrame], now_ns: int) -> None:
        publish(made, now_ns)
        running.clock.advance(running.clock.now_ns + 15_000 + 15_000 * len(made))

    monkeypatch.setattr(running.hub, "publish", busy)
    running.run(1.5)
    before = running.status()["cycles"]
    running.published_ns.clear()
    running.frames.clear()
    running.run(0.5)
    assert running.status()["cycles"] - before < 0.8 * len(fresh(running.frames))
    ages = ages_ns(running)
    assert ages[len(ages) * 99 // 100] < 300_000
    assert sum(stream.lost_samples for stream in running.streams) == 0


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize("seed", more_if_long([6, 8], range(40)))
def test_a_sensor_that_samples_just_after_another_is_followed_as_well(seed: int, dc: str) -> None:
    """Polls that wait for the other's come late: none would bound the phase on the other side."""
    sensors = [SensorOptions(serial=n, signal="clock", ppm=150.0, dc=dc) for n in (1, 2)]
    running, chance = Simulation(*sensors, machine=Machine(seed=seed)), random.Random(seed)
    running.run(0.3)
    running.frames.clear()
    for _ in range(12):
        # It stops until a sample comes to be while the next frame passes.
        made = life_of(running.backend, 1).sampler.clock
        next_ns = made.instant(made.number_at(running.clock.now_ns + chance.randrange(2_000_000, 5_000_000)))
        running.clock.stall(next_ns - running.clock.now_ns - chance.uniform(5_000, 35_000))
        running.run(chance.uniform(0.02, 0.06))
    for number in range(2):
        frames = [frame for frame in running.frames if frame.sensor == number]
        check_frames(frames)
        plain = [frame for frame in frames if not frame.flags & DataFlag.GAP]
        assert max(abs(frame.monotonic_ns - reading(frame).instant_ns) for frame in plain) < 80_000


def test_the_sockets_have_their_turn_even_if_every_deadline_has_passed() -> None:
    turns: list[int] = []
    running = simulation(Machine(frame_ns=900_000, frame_jitter_ns=0))
    running.on_serve = turns.append
    running.run(1.0)
    assert len(turns) >= 90, "every 10 ms"


def test_status_distributions_count_every_cycle() -> None:
    running = simulation()
    running.run(0.5)
    status = running.status()
    assert status["cycles"] >= 400
    for name in ("wake_us", "exchange_us"):
        everything, recent = status[name], status["last_10s"][name]
        assert set(everything) == {"p50", "p99", "p999", "max"}
        assert everything == recent, "a short run lies within the last ten seconds"
    assert status["sensors"][0]["age_us"] == status["last_10s"]["age_us"][0]
    assert 0 < status["sensors"][0]["age_us"]["p50"] < PERIOD_NS / 1000


@pytest.mark.parametrize(
    ("seed", "dc"),
    more_if_long([(4, "none"), (23, "")], [(4, "none"), *((n, "") for n in range(1, 25))]),
)
def test_what_a_stuck_sensor_leaves_out_is_flagged(seed: int, dc: str) -> None:
    running, draw = simulation(Machine(seed=seed), dc=dc), random.Random(seed)
    running.run(2.0)
    for _ in range(24):  # it is freed at any instant of its period, before and after polls
        running.at(0.0, "stick")
        running.at(0.02 + draw.random() * PERIOD_NS / 1e9, "unstick")
        running.run(0.1)
    check_frames(running.frames)
    assert running.status()["sensors"][0]["lost_samples"] == 0, "what was not there cannot be lost"


def test_a_stall_during_a_silence_makes_one_frame_and_no_burst() -> None:
    running = simulation()
    running.run(2.0)
    running.frames.clear()
    running.at(0.0, "stick")
    running.at(0.05, lambda: running.clock.stall(50e6))
    running.run(0.2)
    silent = sum(bool(frame.flags & (DataFlag.REPEATED | DataFlag.INVALID)) for frame in running.frames)
    assert abs(silent - 0.15 / (PERIOD_NS / 1e9)) < 6, silent


def test_without_an_event_gap_follows_the_sample_that_ends_a_silence_and_the_next() -> None:
    """The slave may have held back either: one may be missing after it; after some silences more may be."""

    def flags_after(seed: int) -> list[int]:
        running = simulation(Machine(seed=seed), dc="none")
        running.run(2.0)
        running.frames.clear()
        running.at(0.0, "stick")
        running.at(0.02, "unstick")
        running.run(0.1)
        flags = [frame.flags for frame in running.frames]
        return flags[max(at for at, flag in enumerate(flags) if flag & DataFlag.REPEATED) + 2 :]

    found = [flags_after(seed) for seed in range(6)]
    assert all(flags[:2] == [DataFlag.GAP, DataFlag.GAP] for flags in found)
    assert min(sum(map(bool, flags)) for flags in found) == 2, "and no more of them than that"
    assert not any(flags[-1] for flags in found)


# -- slow network cards, and many sensors with clocks of their own: nothing is lost by it

SETTLED_S = 3.0


def card(milliseconds: float, jitter_us: float = 0.0) -> Machine:
    """Round trips of this time, with up to so much more on either way."""
    return Machine(frame_ns=milliseconds * 1e6, frame_jitter_ns=5e3, even_jitter_ns=jitter_us * 1e3)


def run(machine: Machine, sinc_length: int, seconds: float = 1.5, ppm: float = -300.0) -> Simulation:
    """Runs a sensor; `frames` has what came after it has settled."""
    sensor = SensorOptions(signal="clock", ppm=ppm, sinc_length=sinc_length)
    running = Simulation(sensor, machine=machine, settings={"sinc_length": sinc_length})
    running.run(SETTLED_S)
    running.frames.clear()
    running.published_ns.clear()
    running.run(seconds)
    return running


def of_each(running: Simulation) -> dict[int, list[DataMessage]]:
    """The frames by sensor."""
    by_sensor: dict[int, list[DataMessage]] = {}
    for frame in running.frames:
        by_sensor.setdefault(frame.sensor, []).append(frame)
    return by_sensor


# SINC length (64: 800 Hz), round trip in ms, jitter in µs.
CARDS = [
    (64, 0.86, 0), (64, 2.0, 0), (64, 3.0, 0), (64, 2.8, 400),
    (32, 0.44, 0), (32, 0.86, 0), (32, 2.0, 0), (32, 1.8, 400),
]  # fmt: skip


@pytest.mark.parametrize(
    ("sinc_length", "milliseconds", "jitter_us"), more_if_long([CARDS[2], CARDS[7]], CARDS)
)
def test_a_slow_card_costs_age_and_no_sample(
    sinc_length: int, milliseconds: float, jitter_us: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger=health.__name__)
    running = run(card(milliseconds, jitter_us), sinc_length, seconds=2.1)  # it is logged after 5 s
    assert running.events == []
    check_frames(running.frames)
    assert lost(running.frames) <= 0.001 * len(running.frames)
    status = running.status()
    clock = status["sensors"][0]["clock"]
    assert clock["mode"] == "locked"
    assert clock["uncertainty_us"] < 1000 * milliseconds
    errors_us = [abs(f.monotonic_ns - reading(f).instant_ns) / 1000 for f in running.frames]
    within = sum(error <= clock["uncertainty_us"] for error in errors_us)
    assert within > 0.99 * len(errors_us)
    ages = ages_ns(running)
    assert ages[len(ages) // 2] <= 1e6 * milliseconds + 10_000
    (message,) = [each for each in caplog.messages if each.startswith("frames take ")]
    assert re.fullmatch(r"frames take \d+ µs through memory: samples are \d+ µs older than .* card", message)
    assert status["round_trip"]["usual_us"] == pytest.approx(1000 * milliseconds + jitter_us / 2, rel=0.1)


@pytest.mark.parametrize("milliseconds", [0.05, 2.0])
def test_register_reads_cost_a_slow_card_no_sample(milliseconds: float) -> None:
    running = run(card(milliseconds), 64, seconds=0.1)
    client = running.connect()
    running.frames.clear()
    began_ns = running.clock.now_ns
    for _ in range(20):
        assert client.ask("sdo_read", name="Sampling rate")["value"] == 800
    assert len(running.frames) >= (running.clock.now_ns - began_ns) // PERIOD_NS - 1
    assert lost(running.frames) == 0


@pytest.mark.parametrize("count", more_if_long([4], [4, 8, 16]))
def test_many_sensors_with_clocks_of_their_own(count: int) -> None:
    chance = random.Random(count)
    sensors = [
        SensorOptions(serial=n + 1, signal="clock", ppm=chance.uniform(-300, 300)) for n in range(count)
    ]
    running = Simulation(*sensors)
    running.run(1.5)
    running.frames.clear()
    running.published_ns.clear()
    before = running.status()["cycles"]
    running.run(0.5)
    by_sensor = of_each(running)
    assert len(by_sensor) == count
    for frames in by_sensor.values():
        check_frames(frames)
    assert sum(map(lost, by_sensor.values())) <= 0.001 * len(running.frames)
    ages = ages_ns(running)
    assert ages[int(0.99 * len(ages))] < 1_250_000
    assert running.status()["cycles"] - before < 400 * count * 1.15


@pytest.mark.parametrize("sinc_length", more_if_long([512], [64, 512]))
def test_process_data_in_two_frames_is_as_complete(sinc_length: int) -> None:
    sensors = [
        SensorOptions(serial=n + 1, signal="clock", pdo_size=77, ppm=10.0 * n, sinc_length=sinc_length)
        for n in range(20)
    ]
    running = Simulation(*sensors, settings={"sinc_length": sinc_length})
    running.run(0.4)
    running.frames.clear()
    running.run(0.2)
    by_sensor = of_each(running)
    assert sorted(by_sensor) == list(range(20))
    for frames in by_sensor.values():
        check_frames(frames)
        assert lost(frames) <= 1
    running.command("power off @19")
    running.run_until(lambda: running.events, "it is missed")
    assert [(event["event"], event["sensor"]) for event in running.events] == [("sensor_lost", 19)]


# -- the fixed-memory distribution against exact percentiles


def test_percentiles_are_exact_to_a_few_percent() -> None:
    noise, recent = random.Random(0), RecentDistribution()
    assert recent.summaries_us()[0] == {"p50": 0, "p99": 0, "p999": 0, "max": 0}
    values = sorted(int(10 ** noise.uniform(0, 10)) for _ in range(50_000))
    for value in values:
        recent.record(value)
    summary, _ = recent.summaries_us()
    for name, fraction in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999), ("max", 1)):
        exact_us = values[int(fraction * (len(values) - 1))] / 1000
        assert exact_us <= summary[name] * 1.001
        assert summary[name] <= exact_us * 1.05
    for extreme in (10**15, -5, -5e9):
        recent.record(extreme)
    assert recent.summaries_us()[0]["max"] == pytest.approx(10**12)


def test_recent_forgets_after_ten_rolls_and_reading_takes_no_longer_with_time() -> None:
    noise, recent = random.Random(1), RecentDistribution()
    recent.record(5_000_000)
    for _ in range(9):
        recent.roll()
        for _ in range(300):
            recent.record(noise.gammavariate(4, 20_000))
    assert recent.summaries_us()[1]["max"] == 5000
    recent.roll()
    everything, last = recent.summaries_us()
    assert last["p50"] == pytest.approx(73, rel=0.1)
    assert last["max"] < everything["max"] == 5000
    for _ in range(50):
        recent.roll()
    assert len(recent.slots) == 10
    assert len(recent.before.counts) < 300
