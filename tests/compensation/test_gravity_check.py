"""Whether gravity looks right: said within seconds of rest, and never of correct operation, in any motion."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ft_compensation.imu import GravityCheck

G = STANDARD_GRAVITY
UP = (0.0, 0.0, G)
Motion = Callable[[float], tuple[Vector3, Vector3, Vector3]]  # s: what is read, turned, felt by the source


def still(read: Vector3, felt: Vector3 = UP, rate: Vector3 = (0.01, 0.0, 0.03)) -> Motion:
    return lambda _: (read, rate, felt)


def looked(motion: Motion, seconds: float, *, by_imu: bool = False, rate_hz: float = 800.0) -> set[str]:
    """What is told in so long, as the node asks it."""
    told, check, noise, number = (
        set[str](),
        GravityCheck(),
        np.random.default_rng(1).normal(0.0, 0.03, 4096),
        0,
    )
    while (time_s := number / rate_hz) < seconds:
        (x, y, z), turning, felt = motion(time_s)
        dx, dy, dz = noise[number % 4000 : number % 4000 + 3].tolist()
        sample: Any = SimpleNamespace(
            acceleration=(x + dx, y + dy, z + dz), angular_rate=turning, warnings=0, acceleration_saturated=0,
            angular_rate_saturated=0,
        )  # fmt: skip
        check.look(sample, felt, time_s, by_imu=by_imu)
        told.add(check.problem)
        number = max(number + 1, math.ceil(check.due_s * rate_hz))
    return told - {""}


@pytest.mark.parametrize("rate_hz", [100.0, 800.0, 1600.0])
@pytest.mark.parametrize(
    ("read", "felt", "by_imu", "told"),
    [
        (
            (0.0, 0.0, 1.04),
            (0.0, 0.0, 1.04),
            True,
            "reads 1 m/s² at rest, where gravity is 9.81: check imu_raw",
        ),
        ((0.0, 0.0, 96.2), (0.0, 0.0, 96.2), True, "reads 96 m/s² at rest"),
        ((0.0, 0.0, G), (0.0, 0.0, 7.0), True, "taken for 7 m/s², .* check accelerometer.offset"),
        ((0.0, 0.0, G), (0.0, 0.0, 1.0), False, "taken for 1 m/s², where .* reads 9.8: check gravity$"),
        ((0.0, 0.0, G), (0.0, 0.0, -G), False, "is 180° from the accelerometer's"),
        ((0.0, G * 0.6, G * 0.8), UP, False, "is 37° from the accelerometer's"),
        ((0.0, 1.9, math.sqrt(G * G - 1.9**2)), UP, False, ""),  # an accelerometer that is a little off
        ((0.0, 0.0, G), (0.0, 0.0, 8.0), True, ""),
        ((0.0, 0.0, G + 1.9), UP, False, ""),
    ],
)
def test_what_is_wrong_at_rest_is_said_within_seconds(
    read: Vector3, felt: Vector3, by_imu: bool, told: str, rate_hz: float
) -> None:
    """Also by a gyroscope whose rest reads 1.7, as its 1.7 °/s taken for rad/s do."""
    rate = (1.7, 0.0, 0.0) if read[2] == 1.04 else (0.03, 0.0, 0.0)
    found = looked(still(read, felt, rate), 2.2, by_imu=by_imu, rate_hz=rate_hz)
    assert len(found) == bool(told)
    assert re.search(told, "".join(found))


def shaken(frequency_hz: float, amplitude: float = 4.0) -> Motion:
    """Linearly, m/s²."""
    return lambda time_s: (
        (amplitude * math.cos(2.0 * math.pi * frequency_hz * time_s), 0.0, G), (0.0, 0.0, 0.01), UP,
    )  # fmt: skip


def swung(frequency_hz: float) -> Motion:
    """About y by 0.6 rad at the end of 1 m, by the orientation of a robot that knows it exactly."""

    def motion(time_s: float) -> tuple[Vector3, Vector3, Vector3]:
        w = 2.0 * math.pi * frequency_hz
        angle, rate = 0.6 * math.cos(w * time_s), -0.6 * w * math.sin(w * time_s)
        felt = (-G * math.sin(angle), 0.0, G * math.cos(angle))
        return (felt[0] - w * w * angle, 0.0, felt[2] + rate * rate), (0.0, rate, 0.0), felt

    return motion


def picked(time_s: float) -> tuple[Vector3, Vector3, Vector3]:
    """Half a second with 3 m/s², as long back, and a rest, 30 times a minute."""
    phase = time_s % 2.0
    return (3.0 if phase < 0.5 else -3.0 if phase < 1.0 else 0.0, 0.0, G), (0.0, 0.0, 0.01), UP


def turned(time_s: float) -> tuple[Vector3, Vector3, Vector3]:
    """About the vertical, 0.8 m from the axis."""
    return (-0.8 * 4.0, 0.0, G), (0.0, 0.0, 2.0), UP


MOTIONS = {
    **{f"shaken {hz}": shaken(hz) for hz in (0.25, 0.5, 1.0, 2.0, 3.0, 10.0, 20.0, 50.0, 61.8, 100.0, 161.8)},
    "swung 0.5": swung(0.5), "swung 1": swung(1.0), "swung 2": swung(2.0), "picked": picked, "turned": turned,
}  # fmt: skip


@pytest.mark.parametrize("minutes", [1, pytest.param(60, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", MOTIONS)
def test_correct_operation_in_motion_is_never_called_wrong(name: str, minutes: int) -> None:
    assert not looked(MOTIONS[name], 60.0 * minutes)
