"""Mass, center of gravity, bias and tensor from free motion alone; what is no free motion is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.alignment import align
from bota_ft_compensation.identification.free_motion import identify_in_motion
from bota_ft_compensation.identification.inertia import turn
from bota_ft_compensation.identification.payload import Identified
from bota_ft_compensation.quantities import EXACT, CompensationError, likely_inertia
from tests.compensation import motion
from tests.compensation.making import BIAS, SEED, check_coverage
from tests.compensation.motion import IMU, Felt, imperfect, settings, tool_of
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
        check_coverage(found_of, 0.03 if what in ("mass", "scale") else 0.1)  # of one IMU for each seed


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
    assert [note.split(" in ")[0] for note in found.notes[1:]] == ["something touched the tool"]
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
    assert found.payload.mass == pytest.approx(tool.mass, abs=found.mass_interval)
    assert found.mass_interval < 0.01


def test_the_center_of_a_heavy_tool_is_known_better() -> None:
    """Its interval is that of the moment by the mass."""
    light, heavy = (
        identified(recorded("turned", SEED + 6, tool_of(SEED + 6, mass=mass))).payload.center_interval
        for mass in (0.5, 4.0)
    )
    assert np.all(np.array(heavy) < np.array(light))


def test_what_is_made_of_a_sample_does_not_depend_on_where_the_recording_begins() -> None:
    felt = recorded("turned", SEED + 6, tool_of(SEED + 6))
    whole, part = (
        turn(
            felt.times[rows],
            np.hstack([each[rows] for each in felt[1:]]),
            align(settings(), RATE_HZ),
            EXACT,
            IMU,
        )
        for rows in (slice(None), slice(800, None))
    )
    rows = np.searchsorted(whole.times, part.times - 1e-6)
    same = np.abs(whole.times[rows] - part.times) < 1e-6
    assert same.sum() > 100
    assert part.felt[same] == pytest.approx(whole.felt[rows][same], abs=1e-6)
    assert part.spun[same] == pytest.approx(whole.spun[rows][same], abs=1e-6)
