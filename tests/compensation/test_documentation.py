"""docs/compensation.md: its example runs, its mistakes look as it says."""

from __future__ import annotations

import doctest
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bota_ethercat.sensor.response import healthy_noise
from bota_ft_compensation.compensator import Compensator
from bota_ft_compensation.quantities import NO_WRENCH, Payload
from tests.compensation.making import BIAS, TOOL, gravity_for, load

ROOT = Path(__file__).parent.parent.parent
PAGE = (ROOT / "docs" / "compensation.md").read_text()

# What points up: the sensor upright, rolled by 90° about its x axis, and by 180°.
UPS = ((0, 0, 1), (0, 1, 0), (0, 0, -1))
GRAVITY = np.array([gravity_for(up) for up in UPS])
# The bias of a tare with the tool on, upright.
TARED = load(UPS[0])

MISTAKES: dict[str, dict[str, Any]] = {
    "none": {},
    "bias not subtracted": {"bias": NO_WRENCH},
    "tare with the tool on, no gravity compensation": {"bias": TARED, "mass": 0.0},
    "tare with the tool on, and gravity compensation": {"bias": TARED},
    "mass 25 % too small": {"mass": 0.75 * TOOL.mass},
    "rotation the wrong way round": {"gravity": GRAVITY * (1, -1, 1)},
    "frame turned by 90° about z": {"gravity": GRAVITY[:, [1, 0, 2]] * (1, -1, 1)},
    "center of gravity wrong": {"center": (0.0, 0.0, 0.1)},
}


def left_over(mistake: str) -> NDArray[np.float64]:
    """What compensation leaves in each pose, (n, 6)."""
    known = {"bias": BIAS, "mass": TOOL.mass, "center": TOOL.center, "gravity": GRAVITY, **MISTAKES[mistake]}
    compensator = Compensator(Payload(known["mass"], known["center"]), known["bias"])
    poses = zip(UPS, (-known["gravity"]).tolist(), strict=True)
    return np.array([compensator.compensate(*load(up), (*felt,)).final.values for up, felt in poses])


def table_of_mistakes() -> dict[str, list[float]]:
    rows = re.findall(r"^\| ([^|]+) \|((?: [\d.]+ \|){3})", PAGE, re.MULTILINE)
    return {name: [float(number) for number in re.findall(r"[\d.]+", cells)] for name, cells in rows}


def test_the_example_runs_and_every_mistake_is_tried() -> None:
    failed, tried = doctest.testfile(str(ROOT / "docs" / "compensation.md"), module_relative=False)
    assert tried > 10
    assert not failed
    assert table_of_mistakes().keys() == MISTAKES.keys()
    left = left_over("center of gravity wrong")
    assert np.abs(left[:, :3]).max() < 1e-9
    assert np.abs(left[:, 3:]).max() > 0.1


def test_the_noise_of_short_and_long_filters_is_that_of_a_healthy_sensor() -> None:
    size, healthy = 0.1 * math.sqrt(3.0), [healthy_noise(length)[0] for length in (32, 64)]
    told = f"{size:.2f} N in all, and {size * healthy[0] / healthy[1]:.2f} N at SINC 32"
    assert told in PAGE.replace("\n", " ")


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_mistakes_look_as_the_page_says(mistake: str) -> None:
    force = np.linalg.norm(left_over(mistake)[:, :3], axis=1)
    assert table_of_mistakes()[mistake] == pytest.approx(force, abs=0.051)
