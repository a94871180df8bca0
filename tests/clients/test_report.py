"""What the report finds in a sensor that has a fault, and that it finds nothing in one that has none.

The samples are the virtual sensor's own, taken through the server's own stream in simulated time.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bota_clients.recording.columns import Columns
from bota_clients.report.checks import Examination, examine, longest_runs
from bota_clients.report.series import CHANNELS, FORCE, Subject, limit_origin, noise_limit, subject
from bota_clients.report.spectrum import welch
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.verdict import Level
from bota_ethercat.pdo import STANDARD_GRAVITY, ImuUnits
from bota_ethercat.sensor.meaning import meaning
from ethercat_server.virtual_sensor.measurement import scene
from tests.clients.simulated import Script, decoded, described, sensor, simulate, subject_of

SLOW = 512
"""SINC length for what does not depend on the rate: 100 Hz."""
SINC, SECONDS = 128, 7
"""Of `healthy`: 400 Hz."""
ROW = described(SINC)
QUIET = {Level.GOOD, Level.NOT_APPLICABLE}


def wrong(examination: Examination) -> dict[str, Level]:
    """The checks that found something or could not be made."""
    return {check.name: check.level for check in examination.checks if check.level not in QUIET}


def found(examination: Examination, name: str) -> str:
    [check] = [check for check in examination.checks if check.name == name]
    assert check.level is Level.GOOD or check.remedy, "says what to do"
    assert "`" not in check.found + check.matters + check.remedy, "the page shows it as it is"
    return check.found


def changed(given: Subject, **columns: Any) -> Subject:
    return replace(given, columns=replace(given.columns, **columns))


@pytest.fixture(scope="module")
def healthy() -> Subject:
    """A contact, a moving wrist, noise."""
    return sensor(SECONDS, sinc_length=SINC)


@pytest.fixture
def frames() -> tuple[DataMessage, ...]:
    """Those of `healthy`."""
    return simulate(SECONDS, sinc_length=SINC)


# A healthy sensor: it turns, shakes a little and touches things, and that is no fault.


@pytest.mark.parametrize(
    ("sinc_length", "seconds", "options"),
    [
        (51, 4.2, {"begin": 2.0, "seed": 2, "ppm": 150.0}),
        (64, 4.2, {"begin": 2.0, "seed": 4, "ppm": -80.0, "pdo_size": 77}),
        (256, 20, {"seed": 7, "ppm": 200.0}), (1024, 40, {"seed": 8}),
    ],
)  # fmt: skip
def test_nothing_is_found_on_a_healthy_sensor(sinc_length: int, seconds: float, options: Any) -> None:
    examination = examine(sensor(seconds, sinc_length=sinc_length, **options))
    assert not wrong(examination)
    assert examination.verdict.headline == "Good"
    assert examination.verdict.sentence == "All checks passed."


def test_the_noise_is_that_of_the_sensor_whatever_it_does(healthy: Subject) -> None:
    examination = examine(healthy)
    assert not wrong(examination)
    source = scene.Scene(0, noise=True)
    source.set_sinc_length(SINC)
    readings = np.array([source.reading(n, 0, 0.0).force_torque for n in range(2000)])
    assert examination.noise.deviation[:6] == pytest.approx(readings.std(axis=0), rel=0.06)
    assert np.ptp(healthy.columns.force[:, 2]) > 20 * examination.noise.deviation[2], "there was a contact"


def test_frames_that_the_bus_loses_are_no_lost_samples() -> None:
    assert not wrong(examine(sensor(10, script=Script(lost_frames=0.05), sinc_length=SLOW)))


# Faults that the virtual sensor can have.


@pytest.mark.parametrize(
    ("command", "check", "words"),
    [
        ("noise force.y 0.6", "Noise of force and torque", "Force y has a noise of 0.58"),
        ("noise torque.z 0.02", "Noise of force and torque", "Torque z has a noise of 0.0193"),
        ("noise acceleration.x 0.02", "Noise of the IMU", "Acceleration x has a noise of 0.19"),
        ("noise angular_rate.z 10", "Noise of the IMU", "Angular rate z has a noise of 0.17"),
        ("limit force.z 9", "Saturation", "Force z was saturated in"),
        ("limit torque.y 0.3", "Saturation", "Torque y was saturated in"),
        ("limit angular_rate.x 5", "Saturation", "Angular rate x was saturated in"),
        ("freeze torque.x", "Stuck values", "Torque x was constant at"),
        ("freeze angular_rate.y", "Stuck values", "Angular rate y was constant at"),
        ("skip 2", "Lost samples", "were lost. In "),
    ],
)
def test_an_injected_fault_is_found_and_nothing_else(command: str, check: str, words: str) -> None:
    examination = examine(sensor(6.5, command, seed=5, sinc_length=SLOW))
    assert wrong(examination) == {check: Level.TROUBLE}
    assert words in found(examination, check)
    assert examination.verdict.headline == "Trouble"
    assert check.lower().replace("imu", "IMU") in examination.verdict.sentence


@pytest.mark.parametrize(("sinc_length", "seconds"), [(64, 4.2), (128, 6), (512, 16)])
def test_noise_that_comes_and_goes_is_found(sinc_length: int, seconds: float) -> None:
    script = Script(((0.6 * seconds, "noise force.x 30"), (0.8 * seconds, "noise force.x 0")))
    examination = examine(sensor(seconds, script=script, sinc_length=sinc_length, seed=5))
    assert wrong(examination) == {"Noise of force and torque": Level.TROUBLE}
    assert "Force x is noisy in" in found(examination, "Noise of force and torque")
    assert examination.noise.noisy[1:].sum() == 0


def test_a_little_noise_that_comes_and_goes_is_pointed_out() -> None:
    script = Script(((5.0, "noise torque.y 0.005"), (8.0, "noise torque.y 0")))
    examination = examine(sensor(10, script=script, seed=5, sinc_length=SLOW))
    assert wrong(examination) == {"Noise of force and torque": Level.LOOK}
    assert "Torque y is noisy in" in found(examination, "Noise of force and torque")


@pytest.mark.parametrize(
    ("signal", "sinc_length"),
    [
        ("scene", 32),
        *((signal, length) for signal in ("scene", "poses", "turn") for length in (128, 512, 1024)),
    ],
)
def test_no_window_of_a_sensor_that_moves_and_touches_things_is_noisy(signal: str, sinc_length: int) -> None:
    seconds = {32: 4.2, 128: 5, 512: 10}.get(sinc_length, 20)
    begin = 2.0 if signal == "scene" else 0.0
    given = sensor(seconds, signal=signal, sinc_length=sinc_length, pdo_size=77, seed=2, begin=begin)
    examination = examine(given)
    assert not wrong(examination)
    assert examination.noise.noisy.sum() == 0


def test_a_sensor_that_is_shaken_for_a_while_is_not_called_noisy() -> None:
    sizes = {"acceleration.x": 0.05, "acceleration.y": 0.05, "force.x": 1.5, "torque.y": 0.05}
    shaken = [(5.0, f"noise {channel} {size}") for channel, size in sizes.items()]
    over = [(8.0, f"noise {channel} 0") for channel in sizes]
    assert not wrong(examine(sensor(10, script=Script((*shaken, *over)), sinc_length=SLOW)))


def test_noise_below_the_limit_is_measured_and_not_called_a_fault() -> None:
    examination = examine(sensor(10, "noise force.x 0.08", seed=5, sinc_length=SLOW))
    assert not wrong(examination)
    noise = examination.noise.deviation
    assert noise[0] == pytest.approx(np.hypot(noise[1], 0.08), rel=0.05)


def test_the_share_of_lost_samples_is_told() -> None:
    examination = examine(sensor(20, "skip 2", seed=9, sinc_length=SLOW))
    lost = examination.timing.lost
    assert lost / (lost + examination.series.count) == pytest.approx(0.02, abs=0.006)
    assert lost + examination.series.count == pytest.approx(20 * 100, abs=10), "none is counted twice"
    assert "All of them never reached the server" in found(examination, "Lost samples")
    assert examination.spectrum is not None
    assert examination.spectrum.filled == pytest.approx(lost, abs=5)


def test_one_imu_axis_that_is_louder_than_the_others_is_pointed_out() -> None:
    examination = examine(sensor(10, "noise angular_rate.x 1", seed=5, sinc_length=SLOW))
    assert wrong(examination) == {"Noise of the IMU": Level.LOOK}
    assert "Angular rate x has 2" in found(examination, "Noise of the IMU")


def test_a_channel_that_sticks_for_half_a_second_is_found() -> None:
    script = Script(((4.0, "freeze force.x"), (4.5, "thaw force.x")))
    examination = examine(sensor(5, script=script, sinc_length=SLOW))
    assert wrong(examination) == {"Stuck values": Level.TROUBLE}
    [run] = [run for run in longest_runs(examination.series) if run.is_stuck(8)]
    assert run.channel is CHANNELS[0]
    assert (run.begin_s, run.length_s) == pytest.approx((4.0, 0.5), abs=0.03)
    assert "Force x was constant at" in found(examination, "Stuck values")


def test_a_sensor_that_gives_the_same_data_for_ever_is_found() -> None:
    examination = examine(sensor(8, script=Script(((5.0, "stick"),)), sinc_length=SLOW))
    assert wrong(examination) == {"Silent or stuck sensor": Level.TROUBLE}
    assert "the longest 3.00 s" in found(examination, "Silent or stuck sensor")


def test_a_sensor_that_never_gave_anything_new_is_no_healthy_one() -> None:
    examination = examine(sensor(5, signal="constant", sinc_length=SLOW))
    assert examination.verdict.level is Level.TROUBLE
    assert "No new sample for 5.0 s" in found(examination, "Silent or stuck sensor")
    assert wrong(examination)["Noise of force and torque"] is Level.NOT_POSSIBLE


def test_warnings_are_told_with_their_remedy() -> None:
    script = Script(((2.0, "warn 0x20 80"), (4.0, "warn 0x40 8")))
    examination = examine(sensor(5, script=script, sinc_length=SINC))
    assert wrong(examination) == {"Warnings": Level.TROUBLE}
    words = found(examination, "Warnings")
    assert re.search(
        r"Overtemperature \(warning\) in (79|80|81) samples, first (1.99|2.00) s after the start", words
    )
    assert "Wrong supply voltage (fatal) in 8 samples" in words
    [check] = [check for check in examination.checks if check.name == "Warnings"]
    assert "let it cool down" in check.remedy
    assert "Remove sensor from power supply" in check.remedy


def test_a_shaken_sensor_is_not_called_noisy() -> None:
    sizes = {"acceleration.x": 0.05, "acceleration.y": 0.05, "force.x": 1.0, "torque.y": 0.05}
    examination = examine(
        sensor(6, *(f"noise {channel} {size}" for channel, size in sizes.items()), sinc_length=SLOW)
    )
    assert set(wrong(examination).values()) == {Level.NOT_POSSIBLE}
    assert "shaken" in found(examination, "Noise of force and torque")
    assert examination.verdict.headline == "Not conclusive"


# What the frames say, changed by hand.


def test_frames_that_the_client_did_not_take_are_told_apart_from_those_the_server_missed(
    frames: tuple[DataMessage, ...],
) -> None:
    kept = [frame for number, frame in enumerate(frames) if not 1000 <= number < 1080]
    kept[1000] = kept[1000]._replace(flags=DataFlag.GAP)
    examination = examine(subject_of(kept, ROW))
    assert wrong(examination) == {"Lost samples": Level.TROUBLE}
    assert (examination.timing.lost, examination.timing.withheld) == (80, 80)
    assert "not read in time" in found(examination, "Lost samples")


def test_one_frame_in_some_is_no_loss(frames: tuple[DataMessage, ...]) -> None:
    examination = examine(subject_of(frames[::4], ROW))
    assert not wrong(examination)
    assert examination.series.step == 4


def test_invalid_frames_are_a_silence(frames: tuple[DataMessage, ...]) -> None:
    kept = [
        frame._replace(flags=DataFlag.INVALID) if 2000 <= number < 2025 else frame
        for number, frame in enumerate(frames)
    ]
    examination = examine(subject_of(kept, ROW))
    assert wrong(examination) == {"Silent or stuck sensor": Level.TROUBLE}, "62 ms, and 0.9 %"
    assert "25 invalid ones" in found(examination, "Silent or stuck sensor")
    assert examination.timing.lost == 0


@pytest.mark.parametrize("flag", [DataFlag.INVALID, DataFlag.REPEATED])
@pytest.mark.parametrize("withheld", [True, False])
def test_one_frame_of_a_silence_hides_no_loss(
    frames: tuple[DataMessage, ...], flag: DataFlag, withheld: bool
) -> None:
    kept = [
        frame._replace(flags=flag) if number == 2100 else frame
        for number, frame in enumerate(frames)
        if not 2000 <= number < 2400 or number == 2100
    ]
    if not withheld:  # the server saw none of them, and numbered none
        kept = [frame._replace(sequence=number) for number, frame in enumerate(kept)]
    kept[2001] = kept[2001]._replace(flags=DataFlag.GAP)
    examination = examine(subject_of(kept, ROW))
    assert wrong(examination) == {"Lost samples": Level.TROUBLE, "Silent or stuck sensor": Level.LOOK}
    assert examination.timing.lost == pytest.approx(399, abs=2)
    assert examination.timing.withheld == (examination.timing.lost if withheld else 0)
    assert examination.timing.silences.max() < 0.01


def test_a_sensor_that_is_lost_is_looked_after_less_often_and_that_is_no_loss(
    frames: tuple[DataMessage, ...],
) -> None:
    kept = [
        frame._replace(flags=DataFlag.INVALID) if 2000 <= number < 2500 else frame
        for number, frame in enumerate(frames)
        if not 2010 <= number < 2490 or number % 33 == 0
    ]
    kept = [frame._replace(sequence=number) for number, frame in enumerate(kept)]
    examination = examine(subject_of(kept, ROW))
    assert wrong(examination) == {"Silent or stuck sensor": Level.TROUBLE}
    assert examination.timing.silences.max() == pytest.approx(1.25, abs=0.01)


def test_a_wall_clock_that_was_set_and_stamps_that_go_back_are_found(healthy: Subject) -> None:
    stamps = healthy.columns.stamp_ns.copy()
    stamps[2000:] += 2_500_000_000
    examination = examine(changed(healthy, stamp_ns=stamps))
    assert wrong(examination) == {"Stamps": Level.LOOK}
    assert "adjusted 1 time, by up to 2.50 s" in found(examination, "Stamps")
    moments = healthy.columns.monotonic_ns.copy()
    moments[2000:] -= 2_500_000_000
    examination = examine(changed(healthy, monotonic_ns=moments, stamp_ns=healthy.columns.stamp_ns))
    assert "1 stamp not later than the one before" in found(examination, "Stamps")


def test_late_stamps_are_uneven_and_no_losses(healthy: Subject) -> None:
    jitter = np.random.default_rng(1).choice([0, 0, 0, 1, 2], len(healthy.columns)) * 600_000
    c = healthy.columns
    examination = examine(
        changed(healthy, monotonic_ns=c.monotonic_ns + jitter, stamp_ns=c.stamp_ns + jitter)
    )
    assert wrong(examination) == {"Stamps": Level.LOOK}
    assert examination.timing.lost == 0


def test_settings_that_are_not_those_in_force_are_found(healthy: Subject) -> None:
    examination = examine(replace(healthy, settings={**healthy.settings, "sinc_length": 64}))
    assert wrong(examination)["Sampling rate"] is Level.TROUBLE
    assert "the settings say 800.000 Hz" in found(examination, "Sampling rate")


def test_without_settings_nothing_is_called_healthy(healthy: Subject) -> None:
    examination = examine(replace(healthy, settings={}, rate_hz=0.0))
    assert set(wrong(examination)) == {"Noise of force and torque", "Sampling rate"}
    assert examination.verdict.headline == "Not conclusive"
    raw = examine(replace(healthy, settings={**healthy.settings, "calibration_matrix": False}))
    assert "raw counts" in found(raw, "Noise of force and torque")


def test_an_imu_that_is_off_is_no_reason_not_to_be_healthy(healthy: Subject) -> None:
    nothing = np.zeros((len(healthy.columns), 3))
    settings = {**healthy.settings, "imu_active": 0}
    off = replace(changed(healthy, acceleration=nothing, angular_rate=nothing), settings=settings)
    examination = examine(off)
    assert not wrong(examination)
    assert "Not applicable: noise of the IMU, gravity" in examination.verdict.sentence
    assert wrong(examine(replace(off, settings=healthy.settings)))["Stuck values"] is Level.TROUBLE


@pytest.mark.parametrize(
    ("scale", "words"),
    [(STANDARD_GRAVITY, "--imu-raw-units si"), (1 / STANDARD_GRAVITY, "omit --imu-raw-units si")],
)
def test_an_accelerometer_in_the_wrong_unit_is_told(healthy: Subject, scale: float, words: str) -> None:
    examination = examine(changed(healthy, acceleration=healthy.columns.acceleration * scale))
    [check] = [check for check in examination.checks if check.name == "Gravity"]
    assert check.level is Level.LOOK
    assert words in check.remedy


def test_imu_units_are_taken_as_told(frames: tuple[DataMessage, ...]) -> None:
    si = subject_of(frames, imu_units=ImuUnits.SI)
    assert np.linalg.norm(si.columns.acceleration, axis=1).mean() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers_are_found_and_spoil_nothing_else(healthy: Subject, value: float) -> None:
    force = healthy.columns.force.copy()
    force[100:110, 1] = value
    examination = examine(changed(healthy, force=force))
    assert wrong(examination) == {"Numbers": Level.TROUBLE}
    assert "Force y" in found(examination, "Numbers")


@pytest.mark.parametrize("count", [0, 1, 2, 50, 400])
def test_too_little_is_not_conclusive(healthy: Subject, count: int) -> None:
    short = replace(healthy, columns=healthy.columns.where(np.arange(len(healthy.columns)) < count))
    examination = examine(short)
    assert examination.verdict.headline == "Not conclusive"
    assert Level.TROUBLE not in wrong(examination).values()


def test_no_frames_at_all() -> None:
    examination = examine(subject({}, None, decoded([]), "nothing", 0))
    assert examination.verdict.headline == "Not conclusive"
    assert examination.subject.name == "not known"


LAST = 2**63 - 1
HOSTILE: list[Callable[[Columns], dict[str, Any]]] = [
    lambda c: {"force": c.force * 1e38, "torque": -c.torque * 1e38},
    lambda c: {"monotonic_ns": c.monotonic_ns[::-1].copy()},
    lambda c: {"monotonic_ns": c.monotonic_ns * 0, "stamp_ns": c.stamp_ns * 0 + LAST},
    lambda c: {"monotonic_ns": np.where(np.arange(len(c)) == 7, LAST, c.monotonic_ns)},
    lambda c: {"sequence": c.sequence[::-1].copy(), "flags": c.flags + DataFlag.GAP},
    lambda c: {"flags": np.random.default_rng(1).integers(0, 256, len(c))},
    lambda c: {"warnings": c.warnings + 0xFFFFFFFF, "force_torque_saturated": c.warnings + 0xFFFF},
    lambda c: {
        "force": c.force * np.nan,
        "acceleration": c.force * np.inf,
        "temperature": c.temperature * np.nan,
    },
    lambda c: {"temperature": c.temperature * 1e30, "angular_rate": c.force * 0},
]


@pytest.mark.parametrize("spoil", HOSTILE)
def test_nonsense_is_examined_without_an_error(
    healthy: Subject, spoil: Callable[[Columns], dict[str, Any]]
) -> None:
    given = replace(healthy, columns=healthy.columns.where(np.arange(len(healthy.columns)) < 1200))
    examination = examine(changed(given, **spoil(given.columns)))
    assert examination.verdict.headline != "Good"
    assert all(check.found.endswith(".") for check in examination.checks)


def test_descriptions_are_taken_for_what_they_are() -> None:
    row = {
        "name": ["a"],
        "serial": -1,
        "rate_hz": "fast",
        "firmware": "x" * 5000,
        "hardware": "\x1b[31m\u202e",
    }
    settings: dict[Any, Any] = {"sinc_length": "64", "fir": 1, "no such": 1, 7: 7, "fast": True}
    settings |= {f"s{number}": number for number in range(99)}
    made = subject(row, settings, decoded([]), "s", 0)
    assert made.settings == {"fast": True}
    assert (made.rate_hz, made.nominal_period_s) == (0.0, None)
    assert len(made.firmware) <= 80
    assert made.hardware.isprintable()
    assert len(made.remarks) <= 21


def test_a_rate_that_chop_divides_is_that_of_the_report() -> None:
    settings = {"sinc_length": 64, "fir": False, "chop": True}
    made = subject({"rate_hz": 400}, settings, decoded([]), "s", 0)
    assert made.nominal_period_s == 0.0025
    assert subject({"rate_hz": 800}, settings, decoded([]), "s", 0).nominal_period_s == 0.00125
    assert meaning(settings, 400).lines()[:2] == [
        "sampling rate 400 Hz",
        "force and torque: cut-off not in the table, added delay not in the table",
    ]


# Spectra.


def test_the_spectrum_is_that_of_welchs_method() -> None:
    n = np.arange(200)
    values = np.sin(0.7 * n) + 0.3 * np.cos(2.1 * n) + ((n * 7919) % 101) / 101 + 0.02 * n
    # Computed with scipy.signal.welch(values, 100, nperseg=64, detrend="linear").
    reference = {
        0: 1.16199719e-04, 1: 5.53943861e-04, 2: 9.26685543e-04, 7: 2.06227916e-01, 8: 7.45506054e-02,
        16: 4.07035419e-04, 21: 1.51885126e-02, 22: 1.10013511e-02, 31: 1.94318454e-04, 32: 9.94339144e-05,
    }  # fmt: skip
    density = welch(values, 100.0, 64)
    assert density.shape == (33,)
    assert {index: density[index] for index in reference} == pytest.approx(reference, rel=1e-7)
    noise = np.random.default_rng(1).normal(scale=2.0, size=20_000)
    power = welch(noise, 800.0, 256)
    assert power.sum() * 800 / 256 == pytest.approx(noise.var(), rel=0.02), "its integral is the variance"
    assert (welch(np.zeros(64), 1.0, 64) > 0).all(), "can be drawn on a logarithmic scale"


# Limits.


def test_limits_are_botas_at_the_published_lengths_and_between_them_in_between() -> None:
    for channel in CHANNELS[:6]:
        assert noise_limit(channel, 51) == channel.limit_short
        assert noise_limit(channel, 1024) == pytest.approx(channel.limit_long)
        lengths = (32, 51, 64, 128, 256, 341, 1024, 2048)
        limits = [noise_limit(channel, length) for length in lengths]
        assert limits == sorted(limits, reverse=True)
    assert noise_limit(CHANNELS[0], 229) == pytest.approx(np.sqrt(0.6 * 0.1), rel=0.01), (
        "half-way in the logarithm"
    )
    assert CHANNELS[2].group is FORCE
    assert (CHANNELS[2].limit_short, CHANNELS[2].limit_long) == (0.6, 0.08)
    assert "own test limits for SINC 51" in limit_origin(51)
    assert "interpolated between" in limit_origin(64)
    assert "extrapolated from" in limit_origin(32)


def test_a_description_of_the_simulation_is_that_of_a_server() -> None:
    assert described(128)["rate_hz"] == 400
