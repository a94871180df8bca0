"""Poses, windows and samples with known truth, for the tests of compensation."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bota_ethercat.pdo import STANDARD_GRAVITY, Sample, Vector3
from bota_ft_compensation.identification.poses import Pose
from bota_ft_compensation.quantities import Payload, Wrench

SEED = int(os.environ.get("TEST_SEED", "0"))  # another one in every long run
TOOL = Payload(0.8, (0.004, -0.006, 0.055))
BIAS = Wrench((3.0, -1.5, 7.25), (0.2, -0.05, 0.125))
# The six directions that may point up.
AXES = ((0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0))


def gravity_for(up: Sequence[float]) -> Vector3:
    size = sum(part * part for part in up) ** 0.5
    x, y, z = (-STANDARD_GRAVITY * part / size for part in up)
    return x, y, z


def load(up: Sequence[float], payload: Payload = TOOL, bias: Wrench = BIAS) -> Wrench:
    force = [payload.mass * part for part in gravity_for(up)]
    torque = np.cross(payload.center, force).tolist()
    return Wrench.of([a + b for a, b in zip([*force, *torque], bias.values, strict=True)])


def pose(
    up: Sequence[float],
    payload: Payload = TOOL,
    bias: Wrench = BIAS,
    noise: random.Random | None = None,
    deviation: float = 0.02,
) -> Pose:
    """A pose with noise on the mean: `deviation` N, a fiftieth of that in Nm."""
    values = load(up, payload, bias).values
    if noise is not None:
        values = tuple(  # type: ignore[assignment]
            value + noise.gauss(0.0, deviation if i < 3 else deviation / 50) for i, value in enumerate(values)
        )
    return Pose(Wrench.of(values), gravity_for(up))


def check_coverage(shares: Sequence[float], least: float = 0.2, draws: float = math.inf) -> None:
    """Of errors as shares of their 95 % intervals: within 1, nearly all; 0.41 in the mean if they are normal,
    and far less if the intervals are too wide. By so many independent `draws`, to three deviations.
    """
    chance = 3.0 / math.sqrt(draws)
    assert np.mean(np.array(shares) <= 1.0) > 0.9 - 0.22 * chance
    assert least < np.mean(shares) < 0.55 + 0.31 * chance


def written_parameters(path: Path) -> dict[str, Any]:
    """What a parameter file gives every node, as ROS's own parser would read it."""
    found: dict[str, Any] = yaml.safe_load(path.read_text())["/**"]["ros__parameters"]
    return found


def sample(**changed: Any) -> Sample:
    values: dict[str, Any] = {
        "force": (0.0, 0.0, 0.0),
        "torque": (0.0, 0.0, 0.0),
        "acceleration": (0.0, 0.0, STANDARD_GRAVITY),
        "angular_rate": (0.0, 0.0, 0.0),
        "temperature": 30.0,
        "orientation": None,
        "status": 0,
        "warnings": 0,
        "force_torque_saturated": 0,
        "acceleration_saturated": 0,
        "angular_rate_saturated": 0,
    }
    return Sample(**(values | changed))


def noisy(noise: random.Random, wrench: Wrench, up: Sequence[float] = (0, 0, 1), **changed: Any) -> Sample:
    """A sample at rest with the noise of a healthy sensor at SINC 51, about half of what Bota allows."""

    def spread(values: Sequence[float], deviation: float) -> Vector3:
        x, y, z = (value + noise.gauss(0.0, deviation) for value in values)
        return x, y, z

    return sample(
        **{
            "force": spread(wrench.force, 0.3),
            "torque": spread(wrench.torque, 0.007),
            "acceleration": spread([-part for part in gravity_for(up)], 0.02),
            "angular_rate": spread((0.0, 0.0, 0.0), 0.0007),
        }
        | changed
    )
