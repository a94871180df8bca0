"""The verdict on a stream: what is seen of a second of frames, and the sentence that it gets."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import pytest

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.judge import Observation, judge, who_was_late
from bota_ethercat.health.limits import LIMITS, Level, Verdict
from bota_ethercat.health.observer import StreamObserver
from bota_ethercat.pdo import encode
from tests.clients.simulated import simulate

PERIOD_NS = 1_250_000
START_NS = 10**12
BATCH_NS = 50_000_000
SECOND_NS = 10**9
COUNT = 800


class Stream(NamedTuple):
    """A second of one sensor's frames, and how old each is when it comes."""

    frames: Sequence[DataMessage]
    age_ns: int = 200_000

    def verdict(self) -> Verdict:
        """As whoever reads twenty times a second, and waited for the last frame each time, sees it."""
        start_ns = self.frames[0].monotonic_ns - 500_000 + self.age_ns
        observer = StreamObserver(1e9 / PERIOD_NS, start_ns, window_ns=5 * SECOND_NS)
        for begin_ns in range(start_ns, start_ns + SECOND_NS, BATCH_NS):
            came = [f for f in self.frames if begin_ns <= f.monotonic_ns + self.age_ns < begin_ns + BATCH_NS]
            observer.add_frames(came, came[-1].monotonic_ns + self.age_ns if came else begin_ns + BATCH_NS)
            for newest in came[-1:]:
                observer.note_age(newest, newest.monotonic_ns + self.age_ns)
        return judge(observer.observation(start_ns + SECOND_NS, SECOND_NS)._replace(locked=True))


def frame(k: int, period_ns: float = PERIOD_NS, flags: int = 0, **values: float) -> DataMessage:
    moment_ns = START_NS + round(k * period_ns)
    noise = 0.01 * math.sin(k * k)
    data = {"force.z": -8 + noise, "torque.x": noise, "acceleration.z": 1.0, "temperature": 30.0, **values}
    return DataMessage(k, moment_ns, moment_ns, 0, flags, 3, encode(61, data))


def second(period_ns: float = PERIOD_NS, **changed: Mapping[int, DataMessage]) -> list[DataMessage]:
    other = changed.get("other", {})
    return [other.get(k) or frame(k, period_ns) for k in range(int(SECOND_NS / period_ns))]


def of_simulation(*commands: str) -> list[DataMessage]:
    """The last second of a virtual sensor's two, when the server has found its clock."""
    every = simulate(2.0, *commands, seed=1)
    return [f for f in every if f.monotonic_ns > every[-1].monotonic_ns - SECOND_NS + 2 * PERIOD_NS]


STREAMS: dict[str, tuple[Callable[[], Stream], Level, str]] = {
    "clean": (lambda: Stream(second()), Level.GOOD, "Nothing is wrong with the stream"),
    "clean, of the virtual sensor": (lambda: Stream(of_simulation()), Level.GOOD, "Nothing is wrong"),
    "skip 50": (lambda: Stream(of_simulation("skip 50")), Level.TROUBLE, " %) were lost: the machine"),
    "a few lost": (
        lambda: Stream([f if k != 400 else f._replace(flags=DataFlag.GAP)
                        for k, f in enumerate([*second()[:400], *(f._replace(sequence=f.sequence - 3) for f in
                                                                  second()[403:])])]),
        Level.LOOK, "3 of 800 samples (0.38 %) were lost",
    ),
    "one invalid frame": (
        lambda: Stream(second(other={400: frame(400, flags=DataFlag.INVALID)})),
        Level.LOOK, "1 frame was invalid, the sensor did not answer the bus: check its cable and power",
    ),
    "sensor lost": (
        lambda: Stream([f if f.sequence < 224 else f._replace(flags=DataFlag.INVALID) for f in second()]),
        Level.TROUBLE, "No new sample for 0.7 s, the sensor does not answer the bus: check its cable",
    ),
    "stuck": (
        lambda: Stream([f if f.sequence < 224 else f._replace(flags=DataFlag.REPEATED) for f in second()]),
        Level.TROUBLE, "No new sample for 0.7 s, the sensor repeats the same sample again and again",
    ),
    "slow rate": (
        lambda: Stream(second(1e9 / 760)), Level.LOOK, "760 samples a second instead of 800",
    ),
    "half the rate": (
        lambda: Stream(second(1e9 / 400)), Level.TROUBLE, "400 samples a second instead of 800",
    ),
    "old samples": (
        lambda: Stream(second(), age_ns=100_000_000), Level.TROUBLE, "Samples are 100.0 ms old on arrival",
    ),
    "a little old": (
        lambda: Stream(second(), age_ns=12_000_000), Level.LOOK, "Samples are 12.0 ms old on arrival (p99)",
    ),
    "saturated": (
        lambda: Stream(second(other={k: frame(k, force_torque_saturated=4) for k in range(400, 410)})),
        Level.TROUBLE, "Force/torque (ADC) saturated: Fz: reduce sensor loading",
    ),
    "overtemperature": (
        lambda: Stream(second(other={400: frame(400, warnings=0x20)})),
        Level.LOOK, "Overtemperature: power off the sensor and let it cool down",
    ),
    "hot": (
        lambda: Stream([frame(k, temperature=66.0) for k in range(COUNT)]),
        Level.LOOK, "The sensor has 66.0 °C: let it cool down",
    ),
    "repeated": (
        lambda: Stream(second(other={k: frame(k, flags=DataFlag.REPEATED) for k in range(400, 405)})),
        Level.LOOK, "5 frames were repeated, the sensor had nothing new: if it goes on, power-cycle it",
    ),
    "NaN": (
        lambda: Stream(second(other={400: frame(400, **cast(Any, {"force.z": math.nan}))})),
        Level.TROUBLE, "Samples have values that are not finite: power-cycle the sensor",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "seen",
    [
        Observation(silent_s=1.0, invalid=5),
        Observation(is_lost=True),
        Observation(samples=800, invalid=2),
        Observation(samples=800, recoveries=1),
        Observation(samples=800, recoveries=1, lost=400),
    ],
)
def test_a_computer_that_stood_still_is_blamed_in_place_of_the_cable(seen: Observation) -> None:
    for missed, cable in ((0, True), (8, True), (24, False)):
        verdict = judge(seen._replace(nominal_hz=800.0, missed_deadlines=missed))
        assert ("its cable" in verdict.sentence) is cable
        assert ("computer stood still" in verdict.sentence) is not cable
        assert "too busy" not in " ".join(finding.sentence for finding in verdict.findings)


# What each knows of itself in 8.4 s without a new sample, and who was late by that.
ITSELF: dict[str, tuple[dict[str, Any], str]] = {
    "the program did not look": ({"unread_s": 8.3, "busy": False}, "this computer did not run this program"),
    "the program did not look, and ran": ({"unread_s": 8.3, "busy": True}, "this program did other things"),
    "the samples were made in time": ({"held_s": 8.3}, "they came late"),
    "the server says it is lost": ({"is_lost": True}, "the sensor does not answer the bus"),
    "the sensor does not answer": ({"invalid": 5}, "the sensor does not answer the bus"),
    "the sensor repeats": ({"repeated": 5}, "the sensor repeats the same sample"),
    "the server owes an answer": ({"server_silent": True}, "the server does not answer"),
    "the sensor is out of OP": ({"state": "SAFEOP"}, "in state SAFEOP, not OP"),
    "the server's loop did not run": ({"missed_deadlines": 6400}, "The server's computer stood still"),
    "nothing": ({}, "the server sends none"),
}


@pytest.mark.parametrize("known", ITSELF)
def test_who_was_late_is_decided_by_what_each_knows_of_itself(known: str) -> None:
    """Who comes earlier hides those after it; 0.3 s in which the program did not look hide nobody."""
    fields, words = ITSELF[known]
    seen = Observation(silent_s=8.4, nominal_hz=800.0)
    for others in [name for name in ITSELF if [*ITSELF].index(name) >= [*ITSELF].index(known)]:
        both = seen._replace(**{**ITSELF[others][0], **fields})
        clause, remedy = who_was_late(both)
        assert words in f"{clause}: {remedy}", others
        if words not in ("this computer did not run this program", "this program did other things"):
            assert words in ": ".join(who_was_late(both._replace(unread_s=0.3, busy=False)))


def test_losses_and_old_samples_of_a_program_that_did_not_read_are_its_own() -> None:
    seen = Observation(samples=400, lost=400, skipped=300, nominal_hz=800.0)
    server = [each.sentence for each in judge(seen).findings]
    assert ["ethercat-doctor" in sentence for sentence in server] == [True, False]
    assert "the network, or the server's computer, is too slow" in server[1]
    for sentence in [each.sentence for each in judge(seen._replace(unread_s=1.0, busy=True)).findings]:
        assert sentence.endswith("this program did other things for 1.0 s: have it read more often")


def arriving(*batches: tuple[float, Sequence[tuple[int, float, int]]]) -> Observation:
    """Of each batch when it came, s, and of its frames number, stamp, s, and flags."""
    observer = StreamObserver(800.0, 0)
    for at_s, rows in batches:
        frames = [frame(k, flags=flags)._replace(monotonic_ns=round(at * 1e9)) for k, at, flags in rows]
        observer.add_frames(frames, round(at_s * 1e9))
    return observer.observation(round(batches[-1][0] * 1e9))


def test_stamps_and_numbers_tell_samples_that_came_late_from_samples_that_were_not_made() -> None:
    first = (0.01, [(1, 0.0, 0)])
    made = [(number, (number - 1) / 800, 0) for number in range(2, 1601)]
    late = arriving(first, (2.0, made))
    assert late.silent_s - late.held_s < 0.1
    # Most of them were withheld from a program that did not read.
    late = arriving(first, (2.0, [*made[:400], *made[-3:]]))
    assert late.silent_s - late.held_s < 0.1
    not_made = arriving(first, (2.0, [(2, 1.999, 0), (3, 2.0, 0)]))
    assert not_made.held_s < 0.1
    repeats = [(number, number / 800, int(DataFlag.REPEATED)) for number in range(2, 1600)]
    stuck = arriving(first, (1.0, repeats[:800]), (2.0, [*repeats[800:], (1600, 2.0, 0)]))
    assert stuck.held_s == 0.0


@pytest.mark.parametrize("explained", ["lost", "invalid", "repeated"])
def test_what_is_found_already_explains_a_low_rate(explained: str) -> None:
    """A twentieth of the periods has no sample: nothing, all and half of them are accounted for."""
    seen = Observation(seconds=10.0, samples=7600, rate_hz=760.0, nominal_hz=800.0)
    for count, keys in ((0, {"rate"}), (400, {explained}), (200, {explained, "rate"})):
        changed: dict[str, Any] = {explained: count}
        found = judge(seen._replace(**changed)).findings
        assert {finding.key for finding in found} == keys


def test_the_documented_verdicts_are_these() -> None:
    rows = (Path(__file__).parents[2] / "docs" / "programs.md").read_text().splitlines()
    for row in (
        f"| no new sample | | for {LIMITS.stale_after:g} s |",
        f"| lost samples, invalid frames | any | above {100 * LIMITS.lost_error:g} %, and at least "
        f"{1000 * LIMITS.lost_error_s:g} ms together |",
        f"| rate off by | {100 * LIMITS.rate_tolerance:g} % | {100 * LIMITS.rate_error:g} % |",
        f"| age on arrival (p99) | {1000 * LIMITS.age_warn:g} ms | {1000 * LIMITS.age_error:g} ms |",
        f"| temperature | {LIMITS.temperature_warn:g} °C; below {LIMITS.coldest:g} °C | "
        f"{LIMITS.temperature_error:g} °C |",
    ):
        assert row in rows
    assert any(f"emergency in the last {LIMITS.emergency_s:g} s" in row for row in rows)


@pytest.mark.parametrize("name", STREAMS)
def test_a_stream_gets_its_verdict_and_its_sentence(name: str) -> None:
    make, level, words = STREAMS[name]
    verdict = make().verdict()
    assert verdict.level is level
    assert words in verdict.sentence
