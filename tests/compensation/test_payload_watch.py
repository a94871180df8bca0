"""A tool that was changed or lost is noticed in ordinary motion; contacts and drift are not taken for one."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest

from bota_ethercat.pdo import Vector3
from ft_compensation.compensator import Compensator
from ft_compensation.payload_watch import PayloadWatch
from ft_compensation.quantities import NO_PAYLOAD, Payload, Wrench
from tests.compensation.making import AXES, BIAS, TOOL, gravity_for, load

TILTED = ((1, 1, 1), (-1, 1, 0.5), (0.3, -1, 0.2), (0, 0, -1))
NOISE_N = 0.3
PERIOD_S = 1 / 800


class Arm:
    """Rests for two seconds in one pose after the other, compensated for `TOOL` and `BIAS`."""

    def __init__(self, seed: int = 0) -> None:
        self.said: list[str] = []
        self.watch = PayloadWatch(TOOL, self.said.append)
        self.time_s = 1e9
        self._noise = random.Random(seed)

    def hold(
        self,
        up: Sequence[float],
        payload: Payload = TOOL,
        bias: Wrench = BIAS,
        touch: Vector3 = (0.0, 0.0, 0.0),
        turn: float = 0.0,
        seconds: float = 2.0,
    ) -> None:
        gravity = gravity_for(up)
        felt = -gravity[0], -gravity[1], -gravity[2]
        for _ in range(round(seconds / PERIOD_S)):
            self.time_s += PERIOD_S
            if not self.watch.is_due(self.time_s):
                continue
            force, torque = load(up, payload, bias)
            x, y, z = (
                part + more + self._noise.gauss(0.0, NOISE_N) for part, more in zip(force, touch, strict=True)
            )
            final = Compensator(TOOL, BIAS).compensate((x, y, z), torque, felt).final
            self.watch.look(final.force, gravity, (turn, 0.0, 0.0), self.time_s)


def test_the_right_tool_is_never_doubted_nor_what_turns_looked_at() -> None:
    arm = Arm()
    for up in [*AXES, *TILTED] * 3:
        arm.hold(up)
    assert arm.watch.finding == ""
    arm = Arm()
    for up in [*AXES, *TILTED] * 2:
        arm.hold(up, NO_PAYLOAD, turn=0.3)
    assert arm.said == []


@pytest.mark.parametrize(
    ("payload", "kilograms"), [(NO_PAYLOAD, "0.0"), (Payload(1.3, TOOL.center), "1.3"), (Payload(0.6), "0.6")]
)
def test_another_tool_is_said_once_with_its_mass(payload: Payload, kilograms: str) -> None:
    arm = Arm()
    for up in AXES:
        arm.hold(up)
    for pose in [*AXES, *TILTED] * 2:
        arm.hold(pose, payload)
    assert len(arm.said) == 1
    assert arm.said[0].startswith(f"a tool of {kilograms}")
    assert "tool_mass is 0.80 kg" in arm.watch.finding
    for up in AXES:
        arm.hold(up)
    assert arm.watch.finding == ""  # it is back
    for up in AXES:
        arm.hold(up, payload)
    assert len(arm.said) == 1


def test_it_takes_three_orientations_and_ten_seconds() -> None:
    arm = Arm()
    for up in [AXES[0], AXES[2]] * 8:
        arm.hold(up, NO_PAYLOAD)
    assert arm.said == []
    arm = Arm()
    for up in AXES:
        arm.hold(up, NO_PAYLOAD, seconds=0.6)
    assert arm.said == []


def test_after_a_tare_without_the_tool_it_is_noticed_in_the_other_poses() -> None:
    """The bias then holds the weight that is not there, in one pose."""
    arm = Arm()
    x, y, z = (b - w for b, w in zip(BIAS.force, load(AXES[0], TOOL).force, strict=True))
    tared = Wrench((x + BIAS.force[0], y + BIAS.force[1], z + BIAS.force[2]), BIAS.torque)
    for pose in AXES * 3:
        arm.hold(pose, NO_PAYLOAD, tared)
    assert len(arm.said) == 1


@pytest.mark.parametrize("seed", range(5))
def test_contacts_are_not_taken_for_a_tool(seed: int) -> None:
    """In every pose something else pushes, and in some nothing; or always the same, along the tool."""
    draw, arm, pressing = random.Random(seed), Arm(seed), Arm(seed)
    for up in [*AXES, *TILTED] * 3:
        size = draw.choice((0.0, 5.0, 20.0))
        arm.hold(up, touch=(draw.gauss(0, size), draw.gauss(0, size), draw.gauss(0, size)), seconds=1.5)
        pressing.hold(up, touch=(0.0, 0.0, -10.0), seconds=1.5)
    assert arm.said == []
    assert pressing.said == []


def test_a_drift_of_the_bias_is_not_taken_for_a_tool() -> None:
    arm = Arm()
    for number, up in enumerate([*AXES, *TILTED] * 3):
        arm.hold(up, bias=Wrench((3.0, -1.5 + 0.05 * number, 7.25 + 0.1 * number), BIAS.torque))
    assert arm.said == []


def test_a_clock_that_is_set_back_stops_nothing() -> None:
    arm = Arm()
    arm.hold(AXES[0], NO_PAYLOAD)
    arm.time_s -= 1e6
    for up in [*AXES, *TILTED] * 2:
        arm.hold(up, NO_PAYLOAD)
    assert len(arm.said) == 1
