# SPDX-License-Identifier: Apache-2.0
"""The offset that the sensor itself adds to every sample (object 0x8000): what its changes do to a bias.

A tare of the sensor, another client, or a power cycle changes it, and a bias with it.
"""

from __future__ import annotations

from bota_ft_compensation.quantities import NO_WRENCH, Wrench


class OwnOffset:
    """How changes of the sensor's own offset affect a bias; offsets in N and Nm.

    None: unknown. So is one that is being changed: the server says so before it writes the first number.
    """

    def __init__(self) -> None:
        self.of_bias: Wrench | None = None  # the offset that the bias goes with, or the last without a bias
        self._appeared = False  # whether the offset became known only after the bias was taken
        # Whether there is a bias. Zero may be one: what a tare finds where the sensor reads nothing.
        self.has_bias = False

    def begin(self, bias: Wrench, offset: Wrench | None, *, is_measured: bool = False) -> None:
        """`bias` goes with this offset. Zero is no bias, unless it was measured."""
        self.has_bias = is_measured or bias != NO_WRENCH
        self.of_bias, self._appeared = offset, False

    def follow(self, now: Wrench | None) -> Wrench | None:
        """The shift of the bias that the current offset requires, once; None: the offset is as it was."""
        before = self.of_bias
        if now is None or now == before:
            return None
        self.of_bias = now
        if before is None:
            self._appeared = self.has_bias
            return None
        return now.plus(before, -1.0) if self.has_bias else NO_WRENCH

    def doubt(self, now: Wrench | None) -> str:
        """Why samples with this offset cannot be compensated, a sentence; empty if they can."""
        if self._appeared:
            return "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"
        if self.of_bias is not None and now is None:
            return "the sensor's own offset is being changed, or is no longer known: if this lasts, tare"
        return ""
