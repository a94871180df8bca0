"""For tests of the compensation in the node: a sensor at rest in known poses, the stages as topics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from bota_ethercat.pdo import encode
from ft_compensation.quantities import NO_WRENCH, Payload, Wrench
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer
from tests.compensation.making import TOOL, load

UP, SIDE, OVER = (0, 0, 1), (1, 0, 0), (0, 0, -1)
ZERO6 = [0.0] * 6
QUICK: dict[str, object] = {"rest.duration": 0.3, "bias_ramp_time": 0.0}


def sensed(
    up: Sequence[float],
    payload: Payload = TOOL,
    bias: Wrench = NO_WRENCH,
    size: int = 61,
    **changes: float,
) -> bytes:
    """Process data of a sensor at rest with `up` pointing up. `changes` are added: `force_x=1.0`, ..."""
    names = [f"{quantity}.{axis}" for quantity in ("force", "torque", "acceleration") for axis in "xyz"]
    length = math.sqrt(sum(part * part for part in up))
    values = dict(zip(names, [*load(up, payload, bias).values, *(part / length for part in up)], strict=True))
    for name, change in changes.items():
        position, axis = name.rsplit("_", 1)
        values[f"{position}.{axis}"] = values.get(f"{position}.{axis}", 0.0) + change
    return encode(size, values)


def hold(server: SimulatedServer, up: Sequence[float], **changes: Any) -> None:
    """From now on the sensor rests so."""
    server.changes = {"process_data": sensed(up, **changes)}


class Stages:
    """What the node publishes of the compensation."""

    def __init__(self, node: SimulatedNode) -> None:
        self._node = node
        names = ("wrench_compensated", "compensation/bias", "compensation/tool")
        self.all = self.final, self.bias, self.tool = [node.hear(name) for name in names]

    def forget(self) -> None:
        for messages in self.all:
            messages.clear()

    def first(self) -> list[float]:
        """The first compensated wrench since `forget`."""
        self._node.run_until(lambda: self.final, "wrench_compensated")
        return six(self.final[0])

    def settle(self, wanted: Sequence[float], within: float = 1e-3) -> None:
        """Wait until the compensated wrench is so."""
        self.forget()
        self._node.run_until(
            lambda: self.final and is_near(self.final[-1], wanted, within),
            lambda: f"{wanted}; last: {six(self.final[-1]) if self.final else None}",
        )

    def are_silent(self) -> bool:
        """Whether nothing is published for a while."""
        self.forget()
        self._node.run(0.5)
        return not any(self.all)


def six(message: Any) -> list[float]:
    """A WrenchStamped's six numbers."""
    f, m = message.wrench.force, message.wrench.torque
    return [f.x, f.y, f.z, m.x, m.y, m.z]


def stamp_ns(message: Any) -> int:
    """A message's time, ns since the Unix epoch."""
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def is_near(message: Any, wanted: Sequence[float], within: float = 1e-3) -> bool:
    return all(abs(a - b) <= within for a, b in zip(six(message), wanted, strict=True))


def weight(up: Sequence[float], payload: Payload = TOOL) -> list[float]:
    """What the tool's weight is in the sensor's frame."""
    return list(load(up, payload, NO_WRENCH).values)
