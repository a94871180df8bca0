# SPDX-License-Identifier: Apache-2.0
"""ROS 2 messages of fixed layout serialized as CDR, without ROS: what the node publishes.

ROS's own conversion takes longer than handing the message to the middleware does.
"""

from __future__ import annotations

import struct
from typing import Final

_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"  # how CDR begins on every machine that ROS 2 is built for
_NS_PER_S: Final = 1_000_000_000


class StampedNumbers:
    """A message of a `std_msgs/Header` with this frame_id and `count` float64."""

    def __init__(self, frame_id: str, count: int) -> None:
        text = frame_id.encode() + b"\0"
        # Alignment counts from behind the four bytes of CDR's own: sec and nanosec are 8, the length is 4.
        padded = len(text) + -(12 + len(text)) % 8
        self._rest = struct.pack(f"<I{padded}s", len(text), text)
        self._struct = struct.Struct(f"<4siI{len(self._rest)}s{count}d")

    def pack(self, stamp_ns: int, *values: float) -> bytes:
        """The message of this time, ns since 1970; struct.error unless there are `count` values."""
        return self._struct.pack(_LITTLE_ENDIAN, *divmod(stamp_ns, _NS_PER_S), self._rest, *values)
