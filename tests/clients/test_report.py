"""What the report finds in a sensor that has a fault, and that it finds nothing in one that has none.

The samples are the virtual sensor's own, taken through the server's own stream in simulated time.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bota_clients.report.checks import Check, Examination
from bota_clients.report.page import render
from bota_clients.report.series import CHANNELS, Histogram, Subject, limit_origin
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.limits import Level
from bota_ethercat.pdo import STANDARD_GRAVITY
from ethercat_server.virtual_sensor.signals import poses
from tests.bridge.test_soak import size
from tests.clients.simulated import sensor, simulate, subject_of, whole
from tests.descriptions import sensor_row
from tests.simulation import more_if_long
from tests.virtual_sensor.motions import measured, turning

SLOW = 512  # SINC length for what does not depend on the rate: 100 Hz
SINC, SECONDS = 128, 7  # of `healthy`: 400 Hz
ROW = sensor_row(sinc_length=SINC)
GOOD, NOT_POSSIBLE, LOOK, TROUBLE = Level.GOOD, Level.NOT_POSSIBLE, Level.LOOK, Level.TROUBLE
FORCE_TORQUE, IMU = "Noise of force and torque", "Noise of the IMU"
SILENT = "Silent or stuck sensor"


def expect(given: Subject, found: dict[str, tuple[Level, str]] | None = None) -> Examination:
    """The examination, which found this and nothing else: level and words (a pattern) by check."""
    examination, found = Examination(given), found or {}
    quiet = {GOOD, Level.NOT_APPLICABLE}
    wrong = {check.name: check for check in examination.checks if check.level not in quiet}
    assert {name: check.level for name, check in wrong.items()} == {
        n: level for n, (level, _) in found.items()
    }
    for name, (level, words) in found.items():
        check = wrong[name]
        assert re.search(words, check.found)
        assert check.remedy, "says what to do"
        assert not check.matters or level >= LOOK
        assert "`" not in check.found + check.matters + check.remedy, "the page shows it as it is"
    return examination


def check_of(examination: Examination, name: str) -> Check:
    return next(check for check in examination.checks if check.name == name)


def with_settings(given: Subject, settings: Mapping[str, Any] | None = None, **info: Any) -> Subject:
    """With these settings in force."""
    return replace(given, info=given.info._replace(settings=settings or {}, **info))


def changed(given: Subject, **columns: Any) -> Subject:
    return replace(given, parts=[replace(whole(given), **columns)])


@pytest.fixture(scope="module")
def healthy() -> Subject:
    """A contact, a moving wrist, noise."""
    return sensor(SECONDS, sinc_length=SINC)


@pytest.fixture
def frames() -> tuple[DataMessage, ...]:
    """Those of `healthy`."""
    return simulate(SECONDS, sinc_length=SINC)


# A healthy sensor: it turns, shakes a little and touches things, and that is no fault.


HEALTHY: list[tuple[int, float, Any]] = [
    (64, 4.2, {"begin": 2.0, "seed": 4, "ppm": -80.0, "pdo_size": 77}),
    (1024, 40, {"seed": 8}),
    (SLOW, 10, {"lost": 0.05}),  # frames that the bus loses are no lost samples
    *((SLOW, 10, {"world": world, "pdo_size": 77, "seed": 2}) for world in (poses, turning)),
]
HEALTHY_LONG: list[tuple[int, float, Any]] = [
    (256, 20, {"seed": 7, "ppm": 200.0}),
    (32, 4.2, {"pdo_size": 77, "seed": 2, "begin": 2.0}),
    (51, 4.2, {"begin": 2.0, "seed": 2, "ppm": 150.0}),
    *(
        (length, seconds, {"world": world, "pdo_size": 77, "seed": 2, "begin": 2.0 * (world is None)})
        for world in (None, poses, turning)
        for length, seconds in ((128, 5), (1024, 20))
    ),
]


@pytest.mark.parametrize(
    ("sinc_length", "seconds", "options"), more_if_long(HEALTHY, [*HEALTHY, *HEALTHY_LONG])
)
def test_nothing_is_found_on_a_healthy_sensor(sinc_length: int, seconds: float, options: Any) -> None:
    examination = expect(sensor(seconds, sinc_length=sinc_length, **options))
    assert (examination.headline, examination.sentence) == ("Good", "All checks passed.")
    assert examination.noise.noisy.sum() == 0


def test_the_noise_is_that_of_the_sensor_whatever_it_does(healthy: Subject) -> None:
    examination = expect(healthy)
    source = measured(sinc=SINC, noise=True)
    readings = np.array([source.reading(n, 0, 0.0).values[:6] for n in range(2000)])
    assert examination.noise.deviation[:6] == pytest.approx(readings.std(axis=0), rel=0.06)
    assert np.ptp(whole(healthy).force[:, 2]) > 20 * examination.noise.deviation[2], "there was a contact"


# Faults that the virtual sensor can have.


@pytest.mark.parametrize(
    ("command", "check", "level", "words"),
    [
        ("noise force.y 0.6", FORCE_TORQUE, TROUBLE, "^Force y has a noise of 0.6"),
        ("noise acceleration.x 0.02", IMU, TROUBLE, "^Acceleration x has a noise of 0.19"),
        ("noise angular_rate.z 10", IMU, TROUBLE, "^Angular rate z has a noise of 0.17"),
        ("limit force.z 9", "Saturation", TROUBLE, "saturated: Fz"),
        ("limit angular_rate.x 5", "Saturation", TROUBLE, "saturated: ωx"),
        ("freeze angular_rate.y", "Stuck values", TROUBLE, "^Angular rate y was constant at"),
        ("skip 2", "Lost samples", TROUBLE, "were lost"),
    ],
)
def test_an_injected_fault_is_found_and_nothing_else(
    command: str, check: str, level: Level, words: str
) -> None:
    examination = expect(sensor(6.5, command, seed=5, sinc_length=SLOW), {check: (level, words)})
    assert examination.headline == "Trouble"
    assert check.lower().replace("imu", "IMU") in examination.sentence


SHAKES = {"acceleration.x": 0.05, "acceleration.y": 0.05, "force.x": 1.5, "torque.y": 0.05}


@pytest.mark.parametrize(
    ("sinc_length", "seconds", "script", "found"),
    [
        *(
            (length, seconds, {0.6 * seconds: "noise force.x 30", 0.8 * seconds: "noise force.x 0"},
             {FORCE_TORQUE: (TROUBLE, "^Force x is noisy in")})
            for length, seconds in ((64, 4.2), (512, 16))
        ),
        (SLOW, 10, {5.0: "noise torque.y 0.005", 8.0: "noise torque.y 0"},
         {FORCE_TORQUE: (LOOK, "^Torque y is noisy in")}),
        (SLOW, 5, {4.0: "freeze force.x", 4.5: "thaw force.x"},
         {"Stuck values": (TROUBLE, r"^Force x .* for (49|50)\d ms \((49|50|51) samples\) from (3.9|4.0)")}),
        (SLOW, 8, {5.0: "stick"}, {SILENT: (TROUBLE, "No new sample for 3.0 s")}),
    ],
)  # fmt: skip
def test_a_fault_that_comes_and_goes_is_found(
    sinc_length: int, seconds: float, script: dict[float, str], found: dict[str, tuple[Level, str]]
) -> None:
    examination = expect(sensor(seconds, at=tuple(script.items()), sinc_length=sinc_length, seed=5), found)
    assert np.count_nonzero(examination.noise.noisy) == (FORCE_TORQUE in found)


def test_warnings_are_told_with_their_remedy() -> None:
    commands = (2.0, "warn 0x20 80"), (4.0, "warn 0x40 8")
    fatal = {"Warnings": (TROUBLE, r"Wrong supply voltage\. Overtemperature\.")}
    check = check_of(expect(sensor(5, at=commands, sinc_length=SINC), fatal), "Warnings")
    assert "let it cool down" in check.remedy
    assert "Remove sensor from power supply" in check.remedy


def test_a_sensor_that_is_shaken_is_not_called_noisy() -> None:
    begin = [(5.0, f"noise {channel} {size}") for channel, size in SHAKES.items()]
    end = [(8.0, f"noise {channel} 0") for channel in SHAKES]
    expect(sensor(10, at=(*begin, *end), sinc_length=SLOW))
    examination = Examination(sensor(6, *(command for _, command in begin), sinc_length=SLOW))
    assert {check.level for check in examination.checks} == {GOOD, NOT_POSSIBLE}
    assert "shaken" in check_of(examination, FORCE_TORQUE).found
    assert examination.headline == "Not conclusive"


def test_a_sensor_that_never_gave_anything_new_is_no_healthy_one() -> None:
    examination = Examination(sensor(5, signal="constant", last_bit=False, sinc_length=SLOW))
    assert examination.level is TROUBLE
    assert "No new sample for 5.0 s" in check_of(examination, SILENT).found
    assert check_of(examination, FORCE_TORQUE).level is NOT_POSSIBLE


@pytest.mark.parametrize("cuts", [(1, 2, 600), (0, 100, 101, 1000, 1050, 1060, 2000, 2410)])
def test_in_which_parts_the_frames_come_changes_nothing(cuts: Sequence[int]) -> None:
    """A silence, losses, frames that are old, a channel that is stuck, and one that is saturated."""
    script = ((2.0, "freeze force.x"), (2.5, "limit torque.z 0.05"), (4.0, "skip 3"), (5.5, "thaw force.x"))
    sent = list(simulate(SECONDS, at=script, sinc_length=SINC, seed=3))
    sent = flagged([*sent[:2400], *sent[2390:]], DataFlag.INVALID, range(1000, 1100))
    once, found = subject_of(sent, ROW), list[tuple[Any, ...]]()
    edges = [*cuts, len(sent)]
    parts = [whole(once).where(slice(*ends)) for ends in itertools.pairwise([0, *edges])]
    for each in once, replace(once, parts=[part for part in parts if len(part)]):
        examined = Examination(each)
        found.append(
            (examined.checks, examined.runs, examined.sentence, render([examined], made="", program=""))
        )
    assert found[0] == found[1]
    assert (examined.series.counts.old, examined.noise.windows) == (10, 13)


def test_of_more_numbers_than_are_kept_quantiles_are_near() -> None:
    numbers, found = np.random.default_rng(1).integers(0, 1 << 20, 1_000_000), Histogram()
    for part in np.array_split(numbers, 50):
        found.add(part)
    shares = (0.5, 0.95, 1.0)
    assert found.quantiles(*shares) == pytest.approx(np.quantile(numbers, shares), abs=16)
    assert size(found) < 8 << 20


# What the frames say, changed by hand.


def flagged(frames: Sequence[DataMessage], flag: DataFlag, rows: range) -> list[DataMessage]:
    return [frame._replace(flags=flag) if n in rows else frame for n, frame in enumerate(frames)]


def renumbered(frames: Sequence[DataMessage]) -> list[DataMessage]:
    """As by a server that saw no others."""
    return [frame._replace(sequence=number) for number, frame in enumerate(frames)]


def test_frames_that_the_client_did_not_take_are_told_apart_from_those_the_server_missed(
    frames: tuple[DataMessage, ...],
) -> None:
    kept = flagged([*frames[:1000], *frames[1080:]], DataFlag.GAP, range(1000, 1001))
    series = expect(subject_of(kept, ROW), {"Lost samples": (TROUBLE, "^80 of")}).series
    assert (series.lost, series.withheld) == (80, 80)


def test_where_two_of_three_samples_are_lost_the_usual_interval_is_not_the_period(
    frames: tuple[DataMessage, ...],
) -> None:
    kept = flagged(renumbered(frames[::3]), DataFlag.GAP, range(1, len(frames)))
    assert Examination(subject_of(kept, ROW)).series.lost == 2 * (len(kept) - 1)


def test_invalid_frames_are_a_silence(frames: tuple[DataMessage, ...]) -> None:
    kept = flagged(frames, DataFlag.INVALID, range(2000, 2025))  # 62 ms, and 0.9 %
    assert expect(subject_of(kept, ROW), {SILENT: (TROUBLE, "25 frames were invalid")}).series.lost == 0


@pytest.mark.parametrize("rows", [range(401), range(2400, 2801)])
def test_before_the_first_sample_and_after_the_last_is_silence_too(
    frames: tuple[DataMessage, ...], rows: range
) -> None:
    series = Examination(subject_of(flagged(frames, DataFlag.INVALID, rows), ROW)).series
    assert series.longest_silence == pytest.approx(1.0, rel=0.01)


def test_the_time_without_a_connection_is_not_in_the_sampling_rate(frames: tuple[DataMessage, ...]) -> None:
    """The server was restarted for 2 s: its numbers begin again."""
    kept = [*frames[:1000], *renumbered(frames[1800:])]
    series = Examination(subject_of(kept, ROW)).series
    assert 1 / series.mean_period == pytest.approx(1 / series.period, rel=1e-3)
    assert series.duration == pytest.approx(SECONDS, rel=0.01)


@pytest.mark.parametrize("flag", [DataFlag.INVALID, DataFlag.REPEATED])
@pytest.mark.parametrize("withheld", [True, False])
def test_one_frame_of_a_silence_hides_no_loss(
    frames: tuple[DataMessage, ...], flag: DataFlag, withheld: bool
) -> None:
    first = frames[2100]._replace(flags=flag | (DataFlag.GAP if withheld else 0))
    kept = [*frames[:2000], first, *frames[2400:]]
    kept = flagged(kept if withheld else renumbered(kept), DataFlag.GAP, range(2001, 2002))
    series = expect(subject_of(kept, ROW), {"Lost samples": (TROUBLE, ""), SILENT: (LOOK, "")}).series
    assert series.lost == pytest.approx(399, abs=2)
    assert series.withheld == (pytest.approx(series.lost, abs=2) if withheld else 0)
    assert series.longest_silence < 0.01


def test_a_sensor_that_is_lost_is_looked_after_less_often_and_that_is_no_loss(
    frames: tuple[DataMessage, ...],
) -> None:
    kept = flagged(frames, DataFlag.INVALID, range(2000, 2500))
    kept = [frame for n, frame in enumerate(kept) if not 2010 <= n < 2490 or n % 33 == 0]
    series = expect(subject_of(renumbered(kept), ROW), {SILENT: (TROUBLE, "")}).series
    assert series.longest_silence == pytest.approx(1.25, abs=0.01)


def test_a_wall_clock_that_was_set_and_stamps_that_go_back_are_found(healthy: Subject) -> None:
    c, later = whole(healthy), np.arange(len(whole(healthy))) >= 2000
    set_forward = changed(healthy, stamp_ns=c.stamp_ns + 2_500_000_000 * later)
    expect(set_forward, {"Stamps": (LOOK, "adjusted 1 time, by up to 2.50 s")})
    back = Examination(changed(healthy, monotonic_ns=c.monotonic_ns - 2_500_000_000 * later))
    assert "1 stamp not later than the one before" in check_of(back, "Stamps").found


def test_late_stamps_are_uneven_and_no_losses(healthy: Subject) -> None:
    c = whole(healthy)
    jitter = np.random.default_rng(1).choice([0, 0, 0, 1, 2], len(c)) * 600_000
    late = changed(healthy, monotonic_ns=c.monotonic_ns + jitter, stamp_ns=c.stamp_ns + jitter)
    assert expect(late, {"Stamps": (LOOK, "95 % of the intervals")}).series.lost == 0


def test_settings_that_are_not_those_in_force_are_found(healthy: Subject) -> None:
    check = check_of(
        Examination(with_settings(healthy, {**healthy.settings, "sinc_length": 64})), "Sampling rate"
    )
    assert (check.level, "the settings say 800.000 Hz" in check.found) == (TROUBLE, True)


def test_without_settings_nothing_is_called_healthy(healthy: Subject) -> None:
    unknown = dict.fromkeys((FORCE_TORQUE, "Sampling rate"), (NOT_POSSIBLE, "not known|Neither"))
    assert expect(with_settings(healthy, rate_hz=0.0), unknown).headline == "Not conclusive"
    raw = Examination(with_settings(healthy, {**healthy.settings, "calibration_matrix": False}))
    assert "raw counts" in check_of(raw, FORCE_TORQUE).found


def test_an_imu_that_is_off_is_no_reason_not_to_be_healthy(healthy: Subject) -> None:
    nothing = np.zeros((len(whole(healthy)), 3))
    constant = changed(healthy, acceleration=nothing, angular_rate=nothing)
    off = with_settings(constant, {**healthy.settings, "imu_active": 0})
    assert "Not applicable: noise of the IMU, gravity" in expect(off).sentence
    assert check_of(Examination(constant), "Stuck values").level is TROUBLE


@pytest.mark.parametrize(
    ("scale", "words"),
    [(STANDARD_GRAVITY, "--imu-raw-units si"), (1 / STANDARD_GRAVITY, "omit --imu-raw-units si")],
)
def test_an_accelerometer_in_the_wrong_unit_is_told(healthy: Subject, scale: float, words: str) -> None:
    check = check_of(
        Examination(changed(healthy, acceleration=whole(healthy).acceleration * scale)), "Gravity"
    )
    assert (check.level, words in check.remedy) == (LOOK, True)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers_are_found_and_spoil_nothing_else(healthy: Subject, value: float) -> None:
    force = whole(healthy).force.copy()
    force[100:110, 1] = value
    expect(changed(healthy, force=force), {"Numbers": (TROUBLE, "^Samples have values that")})


@pytest.mark.parametrize("count", [0, 1, 2, 50, 400])
def test_too_little_is_not_conclusive(healthy: Subject, count: int) -> None:
    short = replace(healthy, parts=[whole(healthy).where(slice(count))] * bool(count))
    examination = Examination(short)
    assert examination.headline == "Not conclusive"
    assert TROUBLE not in {check.level for check in examination.checks}


def test_a_rate_that_chop_divides_is_that_of_the_report() -> None:
    settings = {"sinc_length": 64, "fir": False, "chop": True}
    made = [subject_of([], {"sensor": 0, "rate_hz": rate_hz, "settings": settings}) for rate_hz in (400, 800)]
    assert [each.nominal_period_s for each in made] == [0.0025, 0.00125]


def test_limits_are_botas_at_the_published_lengths_and_between_them_in_between() -> None:
    table = {51: [0.6, 0.6, 0.6, 0.014, 0.014, 0.005], 1024: [0.1, 0.1, 0.08, 0.0015, 0.0015, 0.0007]}
    for length, limits in table.items():
        assert [channel.limit(length) for channel in CHANNELS] == pytest.approx([*limits, *[0.1] * 6])
    for channel in CHANNELS[:6]:
        limits = [channel.limit(length) for length in (32, 51, 64, 128, 256, 341, 1024, 2048)]
        assert limits == sorted(limits, reverse=True)
    assert CHANNELS[0].limit(229) == pytest.approx(np.sqrt(0.6 * 0.1), rel=0.01), "half-way in a log"
    assert "own test limits for SINC 51" in limit_origin(51)
    assert "interpolated between" in limit_origin(64)
    assert "extrapolated from" in limit_origin(32)
