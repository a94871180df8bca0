"""The wrench filtered, held to analytic responses; and in other frames, held to statics."""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.pdo import Vector3
from bota_ft_compensation.outputs import WrenchFilter, WrenchTransform, cutoff_problem, low_pass
from bota_ft_compensation.quantities import ZERO, Quaternion

RATE_HZ = 800.0
STEP_NS = 1_250_000


def gain(cutoff_hz: float, frequency_hz: float, rate_hz: float = RATE_HZ) -> float:
    z = cmath.exp(-2j * math.pi * frequency_hz / rate_hz)
    b, a1, a2, _ = low_pass(cutoff_hz, rate_hz)
    return abs(b * (1.0 + z) ** 2 / (1.0 + a1 * z + a2 * z * z))


def designed(cutoff_hz: float = 10.0, rate_hz: float = RATE_HZ) -> WrenchFilter:
    made = WrenchFilter()
    made.design(cutoff_hz, rate_hz)
    return made


def run(made: WrenchFilter, signal: Callable[[int], float], count: int, first: int = 0) -> list[float]:
    """Fx of the filtered samples; the other axes get multiples of it, and give the same multiples."""
    found = []
    for number in range(first, first + count):
        x = signal(number)
        force, torque = made.step((x, 2 * x, -x), (0.5 * x, 0.0, 3 * x), number * STEP_NS)
        expected = (2 * force[0], -force[0], 0.5 * force[0], 0.0, 3 * force[0])
        assert (*force[1:], *torque) == pytest.approx(expected, abs=1e-9)
        found.append(force[0])
    return found


@pytest.mark.parametrize("rate_hz", [150.0, 800.0, 1600.0])
@pytest.mark.parametrize("cutoff_hz", [0.05, 1.0, 10.0, 60.0, 74.0])
def test_the_low_pass_is_butterworths(cutoff_hz: float, rate_hz: float) -> None:
    """|H|² = 1 / (1 + (f / f_c)^4), with both frequencies warped as the bilinear transform does."""
    warped_cutoff = math.tan(math.pi * cutoff_hz / rate_hz)
    for part in (0.01, 0.1, 0.5, 1.0, 1.5, 5.0):
        if part * cutoff_hz < rate_hz / 2:
            ratio = math.tan(math.pi * part * cutoff_hz / rate_hz) / warped_cutoff
            expected = 1.0 / math.sqrt(1.0 + ratio**4)
            assert gain(cutoff_hz, part * cutoff_hz, rate_hz) == pytest.approx(expected, rel=1e-6)
    assert gain(cutoff_hz, rate_hz / 2, rate_hz) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("frequency_hz", [2.0, 10.0, 40.0])
def test_a_sine_comes_out_as_the_response_says(frequency_hz: float) -> None:
    found = run(designed(), lambda n: math.sin(2 * math.pi * frequency_hz * n / RATE_HZ), 1600)
    assert max(found[800:]) == pytest.approx(gain(10.0, frequency_hz), abs=1e-3)


@pytest.mark.parametrize("cutoff_hz", [10.0, 40.0])
def test_a_ramp_comes_out_later_by_the_delay_that_is_said(cutoff_hz: float) -> None:
    made = designed(cutoff_hz)
    found = run(made, lambda n: 2.0 * n / RATE_HZ, 1600)  # 2 N a second
    assert 1599 / RATE_HZ - found[-1] / 2.0 == pytest.approx(made.delay_s, abs=1e-9)


def test_delays_are_as_the_documentation_says() -> None:
    page = (Path(__file__).parents[2] / "docs" / "ros2.md").read_text()
    rows = re.search(r"\| ?Cut-off ?\|(.*)\n.*\n\| ?Delay at 800 Hz ?\|(.*)", page)
    assert rows is not None
    cutoffs, delays = (
        re.findall(rf"([\d.]+) {unit}", row) for row, unit in zip(rows.groups(), ("Hz", "ms"), strict=True)
    )
    assert len(cutoffs) == len(delays) == 4
    for cutoff, ms in zip(cutoffs, delays, strict=True):
        assert designed(float(cutoff)).delay_s * 1e3 == pytest.approx(float(ms), abs=0.051)


def test_neither_the_first_sample_nor_another_cut_off_makes_a_step() -> None:
    assert run(designed(), lambda _: 42.0, 800) == pytest.approx([42.0] * 800, abs=1e-6)
    made = designed(1.0)
    before = run(made, lambda n: 10.0 + (n % 2), 2000)[-1]
    made.design(2.0, RATE_HZ)
    assert run(made, lambda n: 10.0 + (n % 2), 1, first=2000)[0] == pytest.approx(before, abs=0.01)


def test_after_a_pause_it_begins_anew_and_after_a_few_lost_samples_it_goes_on() -> None:
    made = designed()  # its memory is 16 ms, 13 samples
    run(made, lambda _: 0.0, 100)
    assert run(made, lambda _: 42.0, 1, first=110)[0] < 1.0
    assert run(made, lambda _: 42.0, 2, first=124) == pytest.approx([42.0] * 2)
    assert run(made, lambda _: 7.0, 1, first=50) == pytest.approx([7.0])  # the clock was set back
    fast = designed(390.0)
    run(fast, lambda _: 0.0, 10)
    assert run(fast, lambda _: 1.0, 1, first=12)[0] < 1.0  # two lost
    assert run(fast, lambda _: 5.0, 1, first=16) == pytest.approx([5.0])


HALF = math.sqrt(0.5)
UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)
ABOUT_X: Quaternion = (HALF, 0.0, 0.0, HALF)  # a quarter of a turn: y of the turned frame is z of the other
NUMBERS = st.floats(-100.0, 100.0)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
QUATERNIONS = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(
        lambda q: (q[0] / math.hypot(*q), q[1] / math.hypot(*q), q[2] / math.hypot(*q), q[3] / math.hypot(*q))
    )
)
TRANSFORMS = st.builds(WrenchTransform.of, VECTORS, QUATERNIONS)


def near(values: tuple[float, ...]) -> object:
    return pytest.approx(values, abs=1e-9)


def test_a_push_at_the_tool_center_point_or_at_the_sensor() -> None:
    """The TCP is 0.2 m in front of the sensor, which feels 5 N across at that arm: 1 Nm.

    A push at the sensor acts 0.2 m behind the TCP: about y it turns the other way than in front.
    """
    tcp = WrenchTransform.of((0.0, 0.0, 0.2), UPRIGHT).inverse()
    force, torque = tcp.apply((5.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    assert force == near((5.0, 0.0, 0.0))
    assert torque == near(ZERO)
    assert tcp.apply((5.0, 0.0, 0.0), ZERO).torque == near((0.0, -1.0, 0.0))


def test_a_weight_on_a_stretched_arm_in_the_base() -> None:
    """The sensor is 0.8 m before the base and 0.5 m above, its z axis horizontal along the base's -y.

    A kilogram hangs on it: in the base 9.81 N down, and about its origin 0.8 m x 9.81 N, tipping forward
    (about +y); the height has no part in it.
    """
    base = WrenchTransform.of((0.8, 0.0, 0.5), ABOUT_X)
    weight = 9.81
    force, torque = base.apply((0.0, -weight, 0.0), ZERO)  # the sensor's y axis points up
    assert force == near((0.0, 0.0, -weight))
    assert torque == near((0.0, 0.8 * weight, 0.0))


def test_a_pure_torque_and_a_quaternion_that_is_nearly_one() -> None:
    force, torque = WrenchTransform.of((3.0, -2.0, 1.0), ABOUT_X).apply(ZERO, (0.0, 2.0, 0.0))
    assert force == near(ZERO)
    assert torque == near((0.0, 0.0, 2.0))
    force = WrenchTransform.of(ZERO, (0.0, 0.0, 0.0, 0.995)).apply((1.0, 2.0, 3.0), ZERO).force
    assert force == near((1.0, 2.0, 3.0))


@given(TRANSFORMS, VECTORS, VECTORS)
def test_there_and_back_is_where_it_was(transform: WrenchTransform, force: Vector3, torque: Vector3) -> None:
    there = transform.apply(force, torque)
    assert transform.inverse().apply(*there).values == pytest.approx((*force, *torque), abs=1e-8)


@pytest.mark.parametrize(
    ("translation", "quaternion"),
    [
        (ZERO, (0.0, 0.0, 0.0, 0.0)), (ZERO, (0.5, 0.5, 0.5, 0.6)), (ZERO, (0.0, 0.0, math.nan, 1.0)),
        ((0.0, math.inf, 0.0), UPRIGHT), ((math.nan, 0.0, 0.0), UPRIGHT),
    ],
)  # fmt: skip
def test_what_is_no_pose(translation: Vector3, quaternion: Quaternion) -> None:
    with pytest.raises(ValueError, match=r"a rotation is a quaternion of length 1|three finite numbers"):
        WrenchTransform.of(translation, quaternion)


@pytest.mark.parametrize(
    ("cutoff_hz", "kept_ns", "forgotten_ns"),
    [(100.0, 4_370_000, 4_380_000), (1.0, 159_000_000, 159_300_000), (100.0, 0, -1)],
)
def test_after_which_pause_the_low_pass_begins_anew(
    cutoff_hz: float, kept_ns: int, forgotten_ns: int
) -> None:
    """3.5 sample periods, or its memory where that is longer; or a clock that was set back."""
    for passed_ns, is_anew in ((kept_ns, False), (forgotten_ns, True)):
        made = designed(cutoff_hz, 800.0)
        made.step((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 10**9)
        found = made.step((8.0, 0.0, 0.0), (0.0, 0.0, 0.0), 10**9 + passed_ns)
        assert (found.force[0] == pytest.approx(8.0)) is is_anew


def test_a_cut_off_is_below_half_of_the_sampling_rate() -> None:
    assert not cutoff_problem(399.99, 800.0)
    assert cutoff_problem(400.0, 800.0) == (
        "filter.cutoff is 400 Hz, but must be below half of the sampling rate, 400 Hz: lower it"
    )
