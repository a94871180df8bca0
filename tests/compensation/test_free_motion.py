"""Mass, center of gravity, bias and tensor from free motion alone; what is no free motion is refused."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.alignment import align
from bota_ft_compensation.identification.free_motion import (
    _Answer,
    _known,
    _left,
    _Model,
    _noise,
    _steiner,
    _together,
    identify_in_motion,
)
from bota_ft_compensation.identification.inertia import Turned, turn
from bota_ft_compensation.identification.payload import Identified, Joint
from bota_ft_compensation.quantities import EXACT, CompensationError, Payload, likely_inertia
from bota_ft_compensation.turning import crossing
from tests.compensation import motion
from tests.compensation.making import BIAS, SEED, check_coverage
from tests.compensation.motion import IMU, Array, Felt, imperfect, settings, tensor, tool_of
from tests.compensation.test_inertia import RATE_HZ, path_of, recorded
from tests.simulation import more_if_long


def identified(felt: Felt) -> Identified:
    turned = turn(felt.times, np.hstack(felt[1:]), align(settings(), RATE_HZ), EXACT, IMU)
    return identify_in_motion(turned, IMU)


@pytest.mark.parametrize("count", more_if_long([2], [2, 8]))
def test_intervals_cover_95_percent_in_every_kind_of_motion(count: int) -> None:
    shares: dict[str, list[float]] = {}
    for seed in range(1000 * SEED, 1000 * SEED + count):
        tool, true = tool_of(seed, mass=0.4 + 0.15 * (seed % 17)), imperfect(seed).known
        for name in ("turned", *motion.moves(0)):
            found = identified(recorded(name, seed, tool))
            assert found.accelerometer is not None
            read = found.accelerometer.calibration
            for what, value, half, truth in (
                ("mass", (found.payload.mass,), (found.mass_interval,), (tool.mass,)),
                ("center", found.payload.center, found.payload.center_interval, tool.center),
                ("bias", found.bias.values, found.bias_interval.values, BIAS.values),
                ("inertia", found.payload.inertia, found.payload.inertia_interval, tool.inertia),
                ("scale", read.scale, read.scale_interval, true.scale),
                ("cross axes", read.cross_axis, read.cross_axis_interval, true.cross_axis),
            ):
                shares.setdefault(what, []).extend(np.abs(np.subtract(value, truth)) / half)
            assert name != "turned" or len(found.notes) == 1, "that the offset cannot be told from the bias"
            assert found.mass_interval < 0.012 * tool.mass
            assert max(found.payload.center_interval) < 1e-3
    for what, found_of in shares.items():
        check_coverage(
            found_of, 0.03 if what in ("mass", "scale") else 0.1, count
        )  # of one IMU for each seed


def upward(felt: Felt, newtons: float) -> Felt:
    rotation = motion.rotations(path_of("turned", SEED + 6)(felt.times)[1])
    return pushed(felt, newtons * rotation[:, 2])


def pushed(felt: Felt, force: motion.Array, at: Sequence[float] = (0.02, 0.1, 0.1)) -> Felt:
    return felt._replace(force=felt.force + force, torque=felt.torque + np.cross(at, force))


def held(felt: Felt, newtons: float = 2.0, at: Sequence[float] = (0.02, 0.1, 0.1)) -> Felt:
    grip = np.random.default_rng(SEED).normal(0.0, newtons, size=(42, 3))
    return pushed(
        felt, np.stack([np.interp(felt.times * 2.0, range(42), axis) for axis in grip.T], axis=1), at
    )


def part_of_the_time(felt: Felt, share: float, times: float = 1.0) -> Felt:
    return pushed(felt, (felt.times[:, None] % 4.0 < 4.0 * share) * times * np.array([4.0, -2.0, 1.0]))


FREE = "not those of a tool that moves freely"
REFUSED: dict[str, tuple[Callable[[Felt], Felt], str]] = {
    "held": (held, FREE),
    "hardly held": (lambda felt: held(felt, 0.4), FREE),
    "hardly held where it makes no torque": (lambda felt: held(felt, 0.4, (0.0, 0.0, 0.0)), FREE),
    "pulled up": (lambda felt: upward(felt, 4.0), FREE),
    "pushed": (lambda felt: part_of_the_time(felt, 0.5), FREE),
    "sign of the force": (lambda felt: felt._replace(force=-felt.force), "mass would be negative"),
    "sign of the torque": (lambda felt: felt._replace(torque=-felt.torque), FREE),
    "of one axis": (lambda felt: felt._replace(torque=felt.torque * [1, -1, 1]), FREE),
    "sign of the acceleration": (
        lambda felt: felt._replace(acceleration=-felt.acceleration),
        "negative|freely",
    ),
    "sign of the rate": (lambda felt: felt._replace(rate=-felt.rate), r"gravity turns -\d"),
    "°/s": (lambda felt: felt._replace(rate=np.degrees(felt.rate)), r"gravity turns 0\.0\d.* °/s"),
    "g": (
        lambda felt: felt._replace(acceleration=felt.acceleration / STANDARD_GRAVITY),
        r"accelerometer reads \d\.\d+ m/s² mostly, where gravity is 9\.81",
    ),
    "kgf": (lambda felt: felt._replace(force=felt.force / STANDARD_GRAVITY), FREE),
    "Nmm": (lambda felt: felt._replace(torque=felt.torque * 1e3), FREE),
    "short": (lambda felt: Felt(*(part[felt.times < 6.0] for part in felt)), "at least 10 s of motion"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_free_motion_is_refused_by_what_the_physics_shows(what: str) -> None:
    change, told = REFUSED[what]
    with pytest.raises(CompensationError, match=told):
        identified(change(recorded("turned", SEED + 6, tool_of(SEED + 6))))


def test_a_touch_is_left_out_and_hardly_any_motion_is_refused() -> None:
    tool = tool_of(SEED + 6)
    found = identified(part_of_the_time(recorded("turned", SEED + 6, tool), 0.2))
    assert found.payload.mass == pytest.approx(tool.mass, abs=0.01)
    assert found.payload.center == pytest.approx(tool.center, abs=4e-4)
    told = re.sub("[23]. %", "SHARE", found.notes[1])
    assert told == "something touched the tool in SHARE of the time, which is left out"
    with pytest.raises(CompensationError, match=r"do not suffice.*about each axis|cannot be told from zero"):
        identified(recorded("still", SEED + 6, tool))
    found = identified(recorded("about x", SEED + 6, tool))
    assert found.payload.mass == pytest.approx(tool.mass, abs=1.5 * found.mass_interval)
    assert "hardly turned about y and z" in found.notes[0]
    xx, *unseen = found.payload.inertia[:3]
    assert xx == pytest.approx(tool.inertia[0], abs=found.payload.inertia_interval[0])
    assert unseen == pytest.approx(likely_inertia(found.payload)[0][1:3], rel=0.01)


@pytest.mark.parametrize("times", [1.0, 12.0])
def test_a_touch_of_any_force_is_left_out(times: float) -> None:
    tool = tool_of(SEED + 6)
    found = identified(part_of_the_time(recorded("turned", SEED + 6, tool), 0.3, times))
    assert found.payload.mass == pytest.approx(tool.mass, abs=1.5 * found.mass_interval)
    assert found.mass_interval < 0.012 * tool.mass


# -- step by step, against the equations of motion of one instant and their numerical derivatives

X: dict[str, slice] = {
    "mass": slice(0, 1), "moment": slice(1, 4), "tensor": slice(4, 10), "bias": slice(10, 16),
    "drift": slice(16, 22), "offset": slice(22, 25), "scale": slice(25, 28), "crossed": slice(28, 34),
    "gyroscope": slice(34, 43), "place": slice(43, 46), "in poses": slice(46, 52),
}  # fmt: skip


class Read(NamedTuple):
    acceleration: Array  # what an IMU reads at one instant
    rate: Array
    spin: Array
    minute: float


def wrench_of(x: Array, read: Read) -> Array:
    """(6,) of a rigid body, N and Nm about the wrench origin, by these 52 unknowns."""
    part = {name: x[where] for name, where in X.items()}
    xy, xz, yx, yz, zx, zy = part["crossed"]
    a, b, c = (read.acceleration - part["offset"]) / (1.0 + part["scale"])
    felt = np.array([a - xy * b - xz * c, b - yx * a - yz * c, c - zx * a - zy * b])
    true = np.eye(3) - part["gyroscope"].reshape(3, 3)
    w, spin, place = true @ read.rate, true @ read.spin, IMU + part["place"]

    def on(arm: Array) -> Array:
        return np.asarray(np.cross(spin, arm) + np.cross(w, np.cross(w, arm)))

    origin, h, inertia = felt - on(place), part["moment"], tensor(part["tensor"])
    force = -part["mass"] * origin - on(h)
    torque = -np.cross(h, origin) - inertia @ spin - np.cross(w, inertia @ w)
    return np.concatenate([force, torque]) + part["bias"] + part["drift"] * read.minute


def derivative(of: Callable[[Array], Array], x: Array) -> Array:
    steps = 1e-6 * np.eye(len(x))
    return np.stack([(of(x + step) - of(x - step)) / 2e-6 for step in steps], axis=-1)


def unknowns_of(draw: np.random.Generator) -> Array:
    x = 0.02 * draw.normal(size=52)
    x[X["mass"]], x[X["moment"]], x[X["bias"]] = 1.5, draw.normal(size=3) * 0.1, draw.normal(size=6)
    return np.asarray(x)


def instants(reads: Sequence[Read]) -> Turned:
    rate, spin = np.array([each.rate for each in reads]), np.array([each.spin for each in reads])
    arm = crossing(spin) + crossing(rate) @ crossing(rate)
    felt = np.array([each.acceleration for each in reads]) - arm @ np.array(IMU)
    nothing, times = np.zeros((len(reads), 3)), np.array([60.0 * each.minute for each in reads])
    return Turned(nothing, nothing, felt, spin, rate[:, :, None] * rate[:, None], times)


def test_the_design_is_that_of_the_equations_of_motion_and_all_derivatives() -> None:
    draw = np.random.default_rng(SEED)
    reads = [
        Read(9.0 * draw.normal(size=3), 3.0 * draw.normal(size=3), 20.0 * draw.normal(size=3), minute / 120.0)
        for minute in np.arange(-9.5, 10.0).tolist()
    ]
    x = unknowns_of(draw)
    design, explained = _Model(instants(reads), IMU).at(x)
    for row, read in enumerate(reads):
        assert design[row] @ x - explained[row] == pytest.approx(wrench_of(x, read), abs=1e-9)
        assert design[row] == pytest.approx(derivative(partial(wrench_of, read=read), x), abs=1e-6)


def steiner(x: Array) -> Array:
    mass, h = x[0], x[X["moment"]]
    return np.asarray(((h @ h) * np.eye(3) - np.outer(h, h))[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]] / mass)


def test_center_and_tensor_about_it_have_the_covariance_of_what_they_are_made_of() -> None:
    draw = np.random.default_rng(SEED)
    x, root = unknowns_of(draw), draw.normal(size=(52, 52))

    def about_center(x: Array) -> Array:
        tensor = x[X["tensor"]] - steiner(x)
        return np.concatenate([x[:1], x[X["moment"]] / x[0], tensor, x[10:]])

    jacobian = derivative(about_center, x)
    expected = jacobian @ root @ root.T @ jacobian.T
    assert _together(x, root @ root.T) == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert _steiner(x)[0] == pytest.approx(steiner(x))


def test_what_is_left_is_what_the_covariance_makes_of_each_pose_and_turn() -> None:
    draw, still = np.random.default_rng(SEED), np.zeros(3)
    x, root = unknowns_of(draw), 0.01 * draw.normal(size=(52, 52))
    x[22:46], kept = 0.0, x[X["moment"]] / x[0]
    root[X["drift"]] = 0.0

    def made(felt: Array, spin: Array) -> Array:
        """(6, 52) of an instant at which the center of gravity feels this."""
        felt = felt - np.cross(spin, kept - IMU)
        found = derivative(lambda x: wrench_of(x, Read(felt, still, spin, 0.0)), x)
        found[:, X["bias"]], found[:, X["in poses"]] = 0.0, np.eye(6)
        return found

    poses = [sign * STANDARD_GRAVITY * axis for sign in (1, -1) for axis in np.eye(3)]
    rows = [made(each, still) for each in poses]
    spun = [(made(still, 10.0 * axis) - made(still, still)) / 10.0 for axis in np.eye(3)]
    pairs = [(rows[a] - rows[b]) / np.linalg.norm(poses[a] - poses[b]) for a in range(6) for b in range(a)]
    expected = [
        math.sqrt(np.mean([np.sum((each @ root)[part] ** 2) / 3 for each in kind]))
        for part in (slice(3), slice(3, 6))
        for kind in (rows, pairs, spun)
    ]
    answer = _Answer(x, root @ root.T, 100.0, np.zeros((1, 6)), 1.0)
    assert _left(answer, IMU, X["in poses"]) == pytest.approx(expected, rel=1e-4)


def test_the_noise_of_samples_is_what_is_left_less_what_the_imu_makes() -> None:
    draw, payload = np.random.default_rng(SEED), Payload(1.5, (0.01, 0.03, 0.2))
    left = draw.normal(size=(500, 6)) * [0.02, 0.02, 0.002, 1e-3, 4e-3, 3e-4]
    still = np.zeros(3)
    turned = instants([Read(still, still, still, 0.0)])._replace(noisier=5.0, imu_noise=0.004)
    found = _noise(turned, _Answer(np.zeros(52), np.eye(52), 1.0, left, 1.0), payload)
    for axis, value in enumerate(found):
        whole = float(np.mean(left[:, axis] ** 2))
        arm = 1.0 if axis < 3 else math.hypot(*np.delete(payload.center, axis - 3))
        assert value == pytest.approx(5.0 * math.sqrt(max(whole - (1.5 * 0.004 * arm) ** 2, whole / 10)))


def test_of_the_imu_is_known_before_what_is_typical_and_what_poses_say() -> None:
    expected = np.diag([0.4**2] * 3 + [0.005**2] * 9 + [0.006**2] * 9 + [1.3e-3**2] * 3)
    for row, column in itertools.product(range(3), repeat=2):
        gyroscope = 12 + 3 * row + column
        if row == column:
            expected[gyroscope, gyroscope] = 0.01**2
            continue
        crossed, mirrored = ([(r, c) for r in range(3) for c in range(3) if r != c].index(each)
                             for each in ((row, column), (column, row)))  # fmt: skip
        for one, sign in ((6 + crossed, 1), (gyroscope, 1), (6 + mirrored, -1), (12 + 3 * column + row, -1)):
            for own in (6 + crossed, gyroscope):
                expected[own, one] += sign * 0.03**2
    known, towards, begin = _known(None)
    assert np.linalg.inv(known[22:46, 22:46]) == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert (np.delete(np.diag(known), range(22, 46)).tolist(), towards.any()) == ([1e-6] * 28, begin.any())
    draw = np.random.default_rng(SEED)
    root, told = draw.normal(size=(22, 22)) + 9 * np.eye(22), draw.normal(size=22)
    of = [0, 46, 47, 48, 1, 2, 3, 49, 50, 51, *range(22, 34)]
    more, towards, begin = _known(Joint(told, root @ root.T))
    more = more - known
    more[22:34, 22:34] += np.linalg.inv(expected[:12, :12])
    assert more[np.ix_(of, of)] == pytest.approx(np.linalg.inv(root @ root.T), rel=1e-4, abs=1e-3)
    assert towards[of] == pytest.approx(np.linalg.inv(root @ root.T) @ told)
    assert begin.tolist() == [
        told[of.index(n)] if n in of else told[of.index(n + 36)] if 10 <= n < 16 else 0.0 for n in range(52)
    ]
