"""The offset (object 0x8000) that the sensor itself adds to every sample, and how it affects the bias."""

from __future__ import annotations

from bridge.stream.link import Link
from ft_compensation.quantities import NO_WRENCH, Wrench


class OwnOffset:
    """Follows what the server reports; used by the executor's thread and the reader's."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.of_bias: Wrench | None = None
        """The offset that the bias was taken with; None if it was never known."""
        self._appeared = False
        """Whether the offset became known only after the bias was taken."""
        self.has_bias = False
        """Whether there is a bias. Zero may be one: what a tare finds where the sensor reads nothing."""

    @property
    def now(self) -> Wrench | None:
        """The sensor's current offset; None if unknown."""
        offset = self._link.offset
        return None if offset is None else Wrench.of(offset)

    @property
    def to_keep(self) -> Wrench | None:
        """`of_bias`; None where there is no bias, which goes with any offset."""
        return self.of_bias if self.has_bias else None

    def begin(self, bias: Wrench, *, is_measured: bool = False) -> Wrench | None:
        """`bias` goes with the current offset, which is returned. Zero is no bias, unless it was measured."""
        self.has_bias = is_measured or bias != NO_WRENCH
        self.of_bias, self._appeared = self.now, False
        return self.of_bias

    def follow(self) -> Wrench | None:
        """The shift of the bias that the current offset requires, once; None: no shift."""
        now, before = self.now, self.of_bias
        if now is None or now == before:
            return None
        self.of_bias = now
        if not self.has_bias:
            return None
        self._appeared = self._appeared or before is None
        return None if before is None else now.plus(before, -1.0)

    def doubt(self) -> str:
        """Why the bias may no longer fit the sensor, a sentence; empty if it does."""
        if not self.has_bias or not self._link.is_connected:
            return ""
        if self._appeared:
            return "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"
        if self.of_bias is not None and self._link.offset is None:
            return "the sensor's own offset is no longer known: the bias may be wrong, tare"
        return ""

    def after_tare(self) -> str:
        """What a tare of the sensor means for the bias, a sentence; empty if nothing."""
        if not self.has_bias:
            return ""
        if self._link.offset is None:
            return "The node's own bias was for the old offset: call ~/tare or ~/clear_tare"
        return "The node's own bias was shifted by the change, so wrench_compensated is unchanged"
