"""tf2_ros, which is not on PyPI: a stand-in by its public names, with one transform, known up to a time."""

from __future__ import annotations

import sys
import time
import types
from collections.abc import Callable
from typing import Any

import pytest
from geometry_msgs.msg import TransformStamped


class FakeTfError(Exception):
    """What a lookup raises."""


class FakeTf:
    """The buffer; `listening` counts those who fill it."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.error: str | None = "frame does not exist"
        self.newest_ns: Callable[[], int] = time.time_ns  # 0: it is static
        self.height: Callable[[int], float] = lambda at_ns: 0.0
        self.quaternion = (0.0, 0.0, 0.0, 1.0)
        self.asked: list[tuple[str, str]] = []
        self.listening = 0
        fake = self

        class TransformListener:
            def __init__(self, buffer: Any, node: Any, *, spin_thread: bool) -> None:
                assert buffer is fake
                assert not spin_thread
                fake.listening += 1

            def unregister(self) -> None:
                fake.listening -= 1

        module = types.ModuleType("tf2_ros")
        names = {"Buffer": lambda: fake, "TransformListener": TransformListener}
        vars(module).update(names, TransformException=FakeTfError)
        patch.setitem(sys.modules, "tf2_ros", module)

    def lookup_transform(self, target_frame: str, source_frame: str, at: Any) -> TransformStamped:
        self.asked.append((target_frame, source_frame))
        newest_ns = self.newest_ns()
        if self.error or at.nanoseconds > newest_ns > 0:
            raise FakeTfError(self.error or "extrapolation into the future")
        at_ns, found = at.nanoseconds or newest_ns, TransformStamped()
        found.header.stamp.sec, found.header.stamp.nanosec = divmod(at_ns, 10**9)
        found.transform.translation.z = self.height(at_ns)
        r = found.transform.rotation
        r.x, r.y, r.z, r.w = self.quaternion
        return found
