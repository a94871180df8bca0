"""Contact in C++ is contact in Python: the same cases, the same numbers."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from bota_ethercat.pdo import Vector3
from bota_ft_compensation.contact import ContactDetector, Plane, Uncertainty, Why
from bota_ft_compensation.quantities import ZERO, Turning
from bota_ft_compensation.stationary import triple
from tests.clients.cpp_programs import FAST, SANITIZED, driver_program, needs_gxx, patient
from tests.compensation.making import SEED
from tests.compensation.test_contact import NOISE, PLACES, TOOL, pushed

Case = tuple[str, Uncertainty, Vector3, Vector3, Turning]


def cases() -> list[Case]:
    """Weak and strong forces on and beside each surface, with and without a tool, free moments, pulls."""
    draw, made = np.random.default_rng([SEED, 95]), list[Case]()
    for number in range(400):
        place = list(PLACES)[number % len(PLACES)]
        _, point, normal = PLACES[place]
        bound = 0.3 * (number % 2)
        known = Uncertainty.of(NOISE, bound, 0.1 * bound, TOOL, 0.01 * bound)
        size = 10.0 ** draw.uniform(-1.0, 1.5)
        force = size * (draw.choice([-1.0, -1.0, -1.0, 1.0]) * np.array(normal) + 0.3 * draw.normal(size=3))
        moment = draw.choice([0.0, 0.0, 0.1]) * draw.normal(size=3)
        moved = triple(np.array(point) + draw.choice([0.0, 0.02]) * draw.normal(size=3))
        turning = triple(draw.normal(size=3)), triple(10.0 * draw.normal(size=3))
        made.append((place, known, *pushed(moved, force, triple(moment)), turning))
    return made


def told(case: Case) -> list[float]:
    place, known, force, torque, turning = case
    surface = PLACES[place][0]
    one = ContactDetector(surface, known, 800.0)
    other = ContactDetector(surface, known, 800.0, 0.394, 0.5)
    other.update((0.0, 0.0, 1000.0), ZERO)
    said = one.update(force, torque, turning), other.update(force, torque, turning)
    where = other.locate(force, torque, turning)
    numbers = (*said, list(Why).index(where.why), where.is_press, *where.point)
    center, normal, u, v, *matrix = where.region or (ZERO, ZERO, ZERO, ZERO, 0.0, 0.0, 0.0)
    return [float(each) for each in (*numbers, *center, *normal, *u, *v, *matrix)]


def line(case: Case) -> str:
    place, known, force, torque, (rate, spin) = case
    surface = PLACES[place][0]
    shape = (
        (*surface.center, *ZERO, surface.radius, *surface.normal)
        if isinstance(surface, Plane)
        else (*surface.start, *surface.end, surface.radius, *ZERO)
    )
    of = known.force, *known.torque, known.tool, *known.center, known.spin, known.motion
    return " ".join(map(repr, (*shape, *of, *force, *torque, *rate, *spin)))


@needs_gxx
@patient
@pytest.mark.parametrize("flags", [SANITIZED, FAST], ids=["sanitized", "fast"])
def test_it_is_that_of_python(flags: tuple[str, ...]) -> None:
    made = cases()
    answers = subprocess.run(
        [driver_program(flags), "contact"], input="\n".join(map(line, made)), capture_output=True,
        text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    assert {told(case)[2] for case in made} == set(range(len(Why)))
    for case, answer in zip(made, answers, strict=True):
        assert [*map(float, answer.split())] == pytest.approx(told(case), rel=1e-6, abs=1e-9), case
