"""Contact: how often a free sensor is one, where it is said to be, and when nothing is said."""

from __future__ import annotations

import math
from itertools import islice, pairwise

import numpy as np
import pytest

from bota_ethercat.client import Client
from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.response import healthy_noise, imu_noise
from bota_ethercat.settings import SettingValue
from bota_ethercat.world import Felt
from bota_ft_compensation.alignment import align
from bota_ft_compensation.bounds import Bounds
from bota_ft_compensation.contact import (
    Capsule,
    ContactDetector,
    Plane,
    Surface,
    Uncertainty,
    Why,
    correlation,
    detector_of,
)
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import (
    NO_PAYLOAD,
    ZERO,
    Accelerometer,
    CompensationError,
    Payload,
    length,
)
from bota_ft_compensation.stationary import triple
from ethercat_server.simulation.server import MemoryChannel
from tests.compensation import motion
from tests.compensation.coverage import begun
from tests.compensation.making import SEED
from tests.compensation.motion import Array, Imperfection
from tests.simulation import Simulation, more_if_long

RATE_HZ = 800.0
CHI_2 = 5.991  # 95 %, 2 degrees of freedom
NOISE = (0.1, 0.1, 0.1, 0.006, 0.006, 0.002)  # N, Nm
TOOL = Payload(1.5, (0.004, -0.006, 0.055))
EXACT = Uncertainty.of(NOISE, 1e-9, 1e-9, Payload())
FACE = Plane((0.0, 0.0, 0.02), (0.0, 0.0, 1.0), 0.05)
SLANTED = Plane((0.02, 0.0, 0.1), (0.6, 0.0, 0.8), 0.05)
BALL = Capsule((0.0, 0.0, 0.1), (0.0, 0.0, 0.1), 0.04)
ROD = Capsule((0.0, 0.0, 0.05), (0.0, 0.0, 0.25), 0.03)
# A surface, a point on it, and the normal there.
PLACES: dict[str, tuple[Surface, Vector3, Vector3]] = {
    "plane": (FACE, (0.02, 0.01, 0.02), (0.0, 0.0, 1.0)),
    "slanted": (SLANTED, (0.02, 0.02, 0.1), (0.6, 0.0, 0.8)),
    "ball": (BALL, (0.0192, 0.0144, 0.132), (0.48, 0.36, 0.8)),
    "side": (ROD, (0.024, 0.018, 0.15), (0.8, 0.6, 0.0)),
    "end": (ROD, (0.0144, 0.0108, 0.274), (0.48, 0.36, 0.8)),
}


FORCES = (1.0, 5.0, 20.0)
EXACTLY = Accelerometer(scale_interval=(5e-4,) * 3, cross_axis_interval=(5e-4,) * 6)
# A ball of 40 mm is small for what 1 N tells.
CASES = [(place, force) for place in PLACES for force in FORCES[place in {"ball", "end"} :]]


def detector(surface: Surface, uncertainty: Uncertainty = EXACT) -> ContactDetector:
    """One that is in contact."""
    made = ContactDetector(surface, uncertainty, RATE_HZ)
    assert made.update((0.0, 0.0, 100.0), ZERO)
    return made


def pushed(
    point: Vector3, force: Vector3 | Array, moment: Vector3 = (0.0, 0.0, 0.0)
) -> tuple[Vector3, Vector3]:
    return triple(np.array(force)), triple(np.cross(np.array(point), np.array(force)) + np.array(moment))


@pytest.mark.parametrize(
    ("place", "newtons", "bound"),
    more_if_long(
        [("plane", 1.0, 0.0), *((*case, 0.3) for case in CASES)],
        ((*case, bound) for case in CASES for bound in (0.0, 0.3)),
    ),
)
def test_in_95_percent_the_region_has_the_point(place: str, newtons: float, bound: float) -> None:
    """With friction, noise, an error of weight at the tool's center of gravity, and one of torque."""
    surface, point, normal = PLACES[place]
    draw = np.random.default_rng([SEED, 91])
    known = Uncertainty.of(NOISE, bound, 0.03 * bound, TOOL if bound else NO_PAYLOAD)
    contact, inside, found, count = detector(surface, known), 0, 0, 3000
    for _ in range(count):
        sideways = np.cross(normal, draw.normal(size=3))
        force = newtons * (0.3 * draw.uniform() * sideways / np.linalg.norm(sideways) - normal)
        weight = draw.normal(size=3) * known.tool
        error = draw.normal(size=3) * known.torque + np.cross(TOOL.center, weight)
        f, m = pushed(point, force)
        where = contact.locate(triple(f + draw.normal(size=3) * known.force + weight), triple(m + error))
        if where.region is not None:
            found += 1
            inside += where.region.contains(point)
    assert found > 0.95 * count, "1 N at the side is told from errors of 0.3 N and 9 mNm in 98 %"
    is_curved = place in {"ball", "end"} and newtons < FORCES[-1]  # within the region, which is flat
    assert 0.93 < inside / found < (1.0 if is_curved else 0.97)


@pytest.mark.parametrize("place", PLACES)
def test_the_point_is_where_the_force_is(place: str) -> None:
    surface, point, normal = PLACES[place]
    where = detector(surface).locate(*pushed(point, -10.0 * np.array(normal) + (0.5, -1.0, 0.3)))
    assert where.why is Why.POINT
    assert where.is_press
    assert where.point == pytest.approx(point)
    assert where.region is not None
    assert where.region.normal == pytest.approx(normal)
    covariance = np.reshape(where.region.covariance(), (3, 3))
    assert np.linalg.eigvalsh(covariance)[[0, 2]] * CHI_2 == pytest.approx([0.0, where.region.largest**2])


@pytest.mark.parametrize("motion_n", [0.0, 0.3])
@pytest.mark.parametrize("axis", range(3))
def test_contact_ends_within_what_95_percent_of_its_errors_keep_to(axis: int, motion_n: float) -> None:
    """Of noise, weight or motion at a center of gravity on an axis, and inertia that is not known."""
    draw, center = np.random.default_rng([SEED, 93, axis]), triple(0.06 * np.eye(3)[axis])
    known = Uncertainty(0.1, (0.006, 0.008, 0.002), 0.15, center, 1e-4, motion_n)
    contact, turning, beyond, count = (
        ContactDetector(FACE, known, RATE_HZ),
        ((3.0, -4.0, 5.0), (20.0, 30.0, -40.0)),
        0,
        8000,
    )
    spun = 1e-4 * math.hypot(20.0, 30.0, 40.0, 3.0**2 + 4.0**2 + 5.0**2)
    for _ in range(count):
        weight = max(0.15, motion_n) * draw.normal(size=3)
        moment = np.cross(center, weight) + np.hypot(known.torque, spun) * draw.normal(size=3)
        contact.is_contact = True
        beyond += contact.update(triple(0.1 * draw.normal(size=3) + weight), triple(moment), turning)
    assert beyond / count == pytest.approx(0.05, abs=0.01)


PULL = pushed((0.02, 0.01, 0.02), (0.5, -1.0, 10.0))


@pytest.mark.parametrize(
    ("surface", "wrench", "why"),
    [
        (FACE, pushed((0.02, 0.01, 0.02), (3.0, -1.0, -10.0), (0.0, 0.0, 0.2)), Why.FREE_MOMENT),
        (FACE, pushed((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), (0.2, 0.0, 0.0)), Why.FREE_MOMENT),
        (FACE, pushed((0.02, 0.01, 0.02), (10.0, 0.0, 0.1)), Why.TOO_WEAK),
        (FACE, pushed((0.02, 0.01, 0.02), (0.0, 0.0, -0.15)), Why.TOO_WEAK),
        (FACE, pushed((0.08, 0.01, 0.02), (0.0, 0.0, -10.0)), Why.OFF_SURFACE),
        (BALL, pushed((0.06, 0.0, 0.1), (0.0, 0.0, -10.0)), Why.OFF_SURFACE),
        (BALL, pushed((0.041, 0.0, 0.1), (0.0, 0.0, -10.0)), Why.TOO_WEAK),
        (ROD, pushed((0.0, 0.0, 0.3), (-10.0, 0.0, 0.0)), Why.OFF_SURFACE),
        (ROD, pushed((0.05, 0.0, 0.2), (0.0, -10.0, 0.0)), Why.OFF_SURFACE),
        (ROD, pushed((0.0, 0.0, 0.28), (0.0, 0.0, -10.0)), Why.POINT),
        (FACE, PULL, Why.POINT),
    ],
)
def test_without_a_point_it_says_why(surface: Surface, wrench: tuple[Vector3, Vector3], why: Why) -> None:
    where = detector(surface).locate(*wrench)
    assert where.why is why, where.why.value
    assert (where.region is None) is (why is not Why.POINT)
    assert where.is_press is (wrench is not PULL)


def noise_of(settings: dict[str, SettingValue], count: int) -> Array:
    """(count, 6): white noise through the sensor's filters."""
    return motion.noise_like(settings, (count, 6), [SEED, 92])


def alarms(contact: ContactDetector, rows: Array) -> int:
    """How often it begins to say contact."""
    said = [contact.update((a, b, c), (d, e, f)) for a, b, c, d, e, f in rows.tolist()]
    return sum(now and not before for before, now in pairwise([False, *said]))


@pytest.mark.parametrize("fir", [False, True])
def test_noise_alone_is_contact_as_often_as_stated(fir: bool) -> None:
    """Also of correlated samples: of neither is it many times less."""
    chosen, seconds, per_s = motion.settings(fir=fir), 400, 0.2
    contact = ContactDetector(FACE, EXACT, RATE_HZ, correlation(chosen), per_s * 3600.0)
    rows = noise_of(chosen, int(seconds * RATE_HZ)) * NOISE
    expected = per_s * seconds
    assert 0.4 * expected < alarms(contact, rows) < expected + 3.0 * math.sqrt(expected)


@pytest.mark.long
def test_in_an_hour_it_is_contact_at_most_once() -> None:
    rows = noise_of(motion.settings(), int(3600 * RATE_HZ)) * NOISE
    assert alarms(ContactDetector(FACE, EXACT, RATE_HZ, correlation(motion.settings())), rows) <= 3


@pytest.mark.timeout(900)
@pytest.mark.parametrize("minutes", more_if_long([1], [1, 60]))
def test_the_noise_of_the_gyroscope_on_an_identified_bar_is_no_contact(minutes: int) -> None:
    """At rest, with the noise that a healthy sensor may have: what the tensor makes of it was 80 an hour."""
    tensor, half = (0.015, 0.015, 0.001, 0.0, 0.0, 0.0), (1.5e-4,) * 6
    bar, aligned = (
        Payload(2.0, (0.004, -0.006, 0.08), tensor, (1e-5,) * 3, half),
        align(motion.settings(), RATE_HZ),
    )
    known, imu = EXACTLY._replace(offset_interval=(0.003,) * 3), Imperfection(*imu_noise({}))
    bounds = Bounds(bar, known, aligned, ImuSource(bar.center, motion.IMU).lever_of(""))
    contact, alarms, beyond = detector_of(FACE, bar, bounds, aligned.settings, RATE_HZ), 0, []
    for seed in range(1000 * SEED, 1000 * SEED + minutes):
        rest = motion.shaken(1.0, 0.0)
        felt = motion.filtered(rest, bar, 61.0, motion.settings(), seed=seed, imu=imu)
        left = motion.left_over(felt, bar, aligned, settling_s=1.0)
        noise = motion.noise_like(aligned.settings, (len(left.times), 6), [seed, 92])
        alarms += alarms_of(contact, left, noise * healthy_noise(64))
        beyond.append(np.mean(contact.is_contact))  # of the limit of the end
    assert np.mean(beyond) < 0.02
    assert alarms <= 1


@pytest.mark.parametrize("seed", more_if_long([0], range(6)))
@pytest.mark.parametrize("name", motion.moves(0))
def test_ordinary_moves_are_no_contact(name: str, seed: int) -> None:
    """With a tool whose inertia is not known, that of a rod, and the IMU's noise by its filters."""
    seed += 1000 * SEED + 300
    draw, chosen = np.random.default_rng(seed), motion.settings()
    x, y, z = draw.uniform((-0.02, -0.02, 0.02), (0.02, 0.02, 0.1)).tolist()
    mass, across = draw.uniform(0.7, 2.5), draw.uniform(0.0, 0.06)
    point, aligned = Payload(mass, (x, y, z)), align(chosen, RATE_HZ)
    tool = point._replace(inertia=(mass * across**2, mass * across**2, 1e-4, 0.0, 0.0, 0.0))
    acceleration_noise, rate_noise = imu_noise(chosen)
    imu = motion.imperfect(seed)._replace(acceleration_noise=acceleration_noise, rate_noise=rate_noise)
    felt = motion.filtered(motion.moves(seed)[name], tool, 20.0, chosen, seed=seed, imu=imu)
    left = motion.left_over(felt, point, aligned, imu.known, settling_s=1.0)
    noisy, _ = aligned.noise(length(point.center) + 0.026)
    known = Uncertainty.of(NOISE, 1e-9, 1e-9, point, mass * 0.06**2, noisy)
    assert not alarms_of(
        ContactDetector(FACE, known, RATE_HZ), left, noise_of(chosen, len(left.times)) * NOISE
    )


def alarms_of(contact: ContactDetector, left: motion.Left, noise: Array) -> int:
    """With the sensor's own `noise`, (n, 6)."""
    return begun(contact, left.force.T + noise[:, :3].T, left.torque.T + noise[:, 3:].T, left.turning)


def test_it_is_contact_until_the_wrench_is_what_noise_makes() -> None:
    contact = ContactDetector(FACE, EXACT, RATE_HZ)
    steps = (0.5, 0.7, 0.4, 0.34, 0.4, 0.6, 0.7)
    assert [contact.update((0.0, 0.0, force), ZERO) for force in steps] == [0, 1, 1, 0, 0, 0, 1]
    assert contact.locate((0.0, 0.0, 0.7), ZERO).why is Why.POINT
    assert not contact.update(ZERO, ZERO)
    assert contact.locate(ZERO, ZERO).why is Why.NO_CONTACT


def test_what_cannot_be_configured_is_refused() -> None:
    with pytest.raises(CompensationError, match="set them"):
        ContactDetector(FACE, EXACT, 0.0)


@pytest.mark.parametrize("newtons", [0.0, 1.0, 5.0, 20.0])
def test_of_the_virtual_sensor_it_tells_the_true_point(newtons: float) -> None:
    """Through its filters, with its noise, the server and the client, from a world that presses."""
    point = (0.012, -0.016, 0.02)  # 20 mm from the axis
    force, torque = pushed(point, (0.1 * newtons, 0.0, -newtons))
    known = Uncertainty.of(healthy_noise(64), 0.0, 0.0, NO_PAYLOAD)
    contact, found, inside = ContactDetector(FACE, known, RATE_HZ), 0, 0
    simulation = Simulation(world=lambda _: Felt((*force, *torque)))
    with Client(12001, channel=MemoryChannel(simulation)).connect() as sensor:
        for sample in islice(sensor, 2500):
            contact.update(sample.force, sample.torque)
            contact.is_contact |= newtons > 0.0  # 1 N is within this noise
            where = contact.locate(sample.force, sample.torque)
            if where.region is not None:
                found += 1
                inside += where.region.contains(point)
    assert found == 0 if newtons == 0.0 else found > 2000
    assert newtons == 0.0 or 0.93 < inside / found < 0.97
