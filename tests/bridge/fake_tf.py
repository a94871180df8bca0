"""tf2_ros, which is not on PyPI: a stand-in by its public names, with one transform."""

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
        self.stamp_ns: Callable[[], int] = time.time_ns
        self.height = 0.0
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

    def lookup_transform(self, target_frame: str, source_frame: str, latest: Any) -> TransformStamped:
        assert latest.nanoseconds == 0
        self.asked.append((target_frame, source_frame))
        if self.error:
            raise FakeTfError(self.error)
        found = TransformStamped()
        found.header.stamp.sec, found.header.stamp.nanosec = divmod(self.stamp_ns(), 10**9)
        found.transform.translation.z = self.height
        r = found.transform.rotation
        r.x, r.y, r.z, r.w = self.quaternion
        return found
