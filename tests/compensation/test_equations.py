"""IV.1 to IV.5 against loads and physics that are written elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from bota_ft_compensation.compensator import Compensator
from bota_ft_compensation.quantities import NO_WRENCH, ZERO, Payload, Wrench
from tests.compensation.making import gravity_for, load


def test_what_the_environment_does_is_left_of_any_load_in_any_pose() -> None:
    draw = np.random.default_rng(4)
    for _ in range(500):
        up, contact, bias = (
            draw.normal(size=3).tolist(),
            Wrench.of(draw.normal(size=6)),
            Wrench.of(draw.normal(size=6)),
        )
        tool = Payload(draw.uniform(0, 10), tuple(draw.uniform(-1, 1, 3).tolist()))
        x, y, z = gravity_for(up)
        stages = Compensator(tool, bias).compensate(*load(up, tool, bias).plus(contact), (-x, -y, -z))
        assert stages.corrected.values == pytest.approx(load(up, tool, contact).values)
        assert stages.tool.values == pytest.approx(load(up, tool, NO_WRENCH).values)
        assert stages.final.values == pytest.approx(contact.values)


def test_stages_add_up_and_have_their_signs() -> None:
    compensator = Compensator(Payload(1.0, (0.1, 0.2, 0.3)), Wrench.of(range(6)))
    measured = Wrench((5.0, 6.0, 7.0), (0.5, 0.6, 0.7))
    stages = compensator.compensate(*measured, (0.1, 0.2, 9.9))
    total = stages.bias.plus(stages.tool).plus(stages.final)
    assert total.values == pytest.approx(measured.values)
    assert stages.corrected.values == pytest.approx(measured.plus(stages.bias, -1.0).values)
    # Upright sensor, 1 kg: the load on the sensor points down, along gravity.
    stages = Compensator(Payload(1.0, ZERO)).compensate((0.0, 0.0, -9.8), ZERO, (0.0, 0.0, 9.8))
    assert stages.tool.force == (0.0, 0.0, -9.8)
    assert stages.final.force == ZERO
