"""For tests of the compensation in the node: a sensor at rest in known poses, the stages as topics."""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import WrenchStamped

from ft_compensation.quantities import NO_WRENCH, Payload, Wrench
from protocol.pdo import encode
from tests.bridge.conftest import PATIENCE_S, Listener
from tests.bridge.streaming import Stream
from tests.compensation.making import TOOL, load

UP, SIDE, OVER = (0, 0, 1), (1, 0, 0), (0, 0, -1)
ZERO6 = [0.0] * 6
QUICK: dict[str, object] = {
    "rest.duration": 0.3,
    "bias_ramp_time": 0.0,
    "accelerometer.time_constant": 0.05,
    # This machine may be busy: ages and rates are judged elsewhere.
    "diagnostics.age_warn": 10.0,
    "diagnostics.age_error": 20.0,
    "diagnostics.rate_tolerance": 1.0,
    "diagnostics.lost_warn": 1000,
}


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


def hold(stream: Stream, up: Sequence[float], **changes: Any) -> None:
    """From now on the sensor rests so."""
    stream.changes = {"process_data": sensed(up, **changes)}


class Stages:
    """Subscriptions to `wrench_compensated` and what was subtracted."""

    def __init__(self, listener: Listener) -> None:
        # On a busy machine the listener falls behind: it is to go on with what is recent.
        self.final = listener.subscribe(WrenchStamped, "wrench_compensated", depth=20)
        self.bias = listener.subscribe(WrenchStamped, "compensation/bias", depth=20)
        self.gravity = listener.subscribe(WrenchStamped, "compensation/gravity", depth=20)
        self.inertia = listener.subscribe(WrenchStamped, "compensation/inertia", depth=20)

    def forget(self) -> None:
        for messages in (self.final, self.bias, self.gravity, self.inertia):
            forget(messages)

    def settle(self, wanted: Sequence[float], within: float = 1e-3) -> None:
        """Wait until the compensated wrench is so."""
        self.forget()
        settle(self.final, wanted, within)


def forget(messages: queue.Queue[Any]) -> None:
    while not messages.empty():
        messages.get()


def six(message: Any) -> list[float]:
    """A WrenchStamped's six numbers."""
    f, m = message.wrench.force, message.wrench.torque
    return [f.x, f.y, f.z, m.x, m.y, m.z]


def stamp_ns(message: Any) -> int:
    """A message's time, ns since the Unix epoch."""
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def is_near(message: Any, wanted: Sequence[float], within: float = 1e-3) -> bool:
    return all(abs(a - b) <= within for a, b in zip(six(message), wanted, strict=True))


def settle(messages: queue.Queue[Any], wanted: Sequence[float], within: float = 1e-3) -> Any:
    """The first message that is so."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        message = messages.get(timeout=PATIENCE_S)
        if is_near(message, wanted, within):
            return message
        assert time.monotonic() < deadline, f"waited in vain for {wanted}; last: {six(message)}"


def comes_to_rest(messages: queue.Queue[Any], seconds: float = 0.4) -> None:
    """Wait until no message comes any more."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        forget(messages)
        time.sleep(seconds)
        if messages.empty():
            return
    raise AssertionError("messages go on coming")


def weight(up: Sequence[float], payload: Payload = TOOL) -> list[float]:
    """What the tool's weight is in the sensor's frame."""
    return list(load(up, payload, NO_WRENCH).values)
