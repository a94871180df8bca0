# SPDX-License-Identifier: Apache-2.0
"""The offset of the sensor's own, and how its changes affect the node's bias."""

from __future__ import annotations

from bridge.stream.link import Link
from ft_compensation.quantities import NO_WRENCH, Wrench


class OwnOffset:
    """The offset (object 0x8000) that the sensor itself adds to every sample, and how it affects the bias.

    Follows what the server reports; used by the executor's thread and the reader's.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        # The offset that the bias was taken with; None if it was never known.
        self._of_bias: Wrench | None = None
        self._appeared = False  # whether the offset became known only after the bias was taken
        # Whether there is a bias. Zero may be one: what a tare finds where the sensor reads nothing.
        self._has_bias = False

    @property
    def now(self) -> Wrench | None:
        """The sensor's current offset; None if unknown."""
        offset = self._link.info.offset
        return None if offset is None else Wrench.of(offset)

    def begin(self, bias: Wrench, *, is_measured: bool = False) -> None:
        """`bias` goes with the current offset. Zero is no bias, unless it was measured."""
        self._has_bias = is_measured or bias != NO_WRENCH
        self._of_bias, self._appeared = self.now, False

    def follow(self) -> Wrench | None:
        """The shift of the bias that the current offset requires, once; None: no shift."""
        now, before = self.now, self._of_bias
        if now is None or now == before:
            return None
        self._of_bias = now
        if not self._has_bias:
            return None
        self._appeared = self._appeared or before is None
        return None if before is None else now.plus(before, -1.0)

    def doubt(self) -> str:
        """Why the bias may no longer fit the sensor, a sentence; empty if it does."""
        if not self._has_bias or not self._link.is_connected:
            return ""
        if self._appeared:
            return "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"
        if self._of_bias is not None and self._link.info.offset is None:
            return "the sensor's own offset is no longer known: the bias may be wrong, tare"
        return ""
