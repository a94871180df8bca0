"""The parameter `wrench_frames`: the frames, besides the sensor's, of the compensated wrench. No ROS.

Each is a text: `NAME`, whose pose TF tells, or `NAME x y z [qx qy qz qw]`, which is its pose in `frame_id`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final, NamedTuple

from bridge.parameters.row import ParameterError
from ft_compensation.outputs.frames import WrenchTransform

_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_FARTHEST_M: Final = 10.0


class WrenchFrame(NamedTuple):
    """A frame, and the end of a topic's name."""

    name: str
    fixed: WrenchTransform | None = None
    """From `frame_id` to it; None: from TF."""


def parse(texts: Sequence[str]) -> tuple[WrenchFrame, ...]:
    """The frames of all strings that are not empty; ParameterError."""
    frames = tuple(_frame(text) for text in texts if text.strip())
    names = [frame.name for frame in frames]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"parameter wrench_frames names {name!r} twice: give each frame once")
    return frames


def _frame(text: str) -> WrenchFrame:
    name, *words = text.split()
    if not _NAME.fullmatch(name):
        raise ParameterError(
            f"parameter wrench_frames has {name!r}, which cannot be part of a topic's name: use letters, "
            "digits and _, and no digit first"
        )
    if not words:
        return WrenchFrame(name)
    try:
        numbers = [float(word) for word in words]
        if len(numbers) not in (3, 7) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"{len(numbers)} numbers follow the name")
        x, y, z, qx, qy, qz, qw = numbers if len(numbers) == 7 else [*numbers, 0.0, 0.0, 0.0, 1.0]
        if max(abs(x), abs(y), abs(z)) > _FARTHEST_M:
            raise ValueError(f"that is farther than {_FARTHEST_M:g} m from the sensor")
        pose = WrenchTransform.of((x, y, z), (qx, qy, qz, qw))
    except ValueError as error:
        raise ParameterError(
            f"parameter wrench_frames has {text!r}: it must be NAME, NAME x y z, or NAME x y z qx qy qz qw, "
            f"in m ({error})"
        ) from None
    return WrenchFrame(name, pose.inverse())
