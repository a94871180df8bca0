"""The local clock of a slave controller: ns since power-on, of a crystal of its own that may be steered.

Whatever changes, the time goes on from what it is, but for `jump`. Without accumulating rounding errors.
"""

from __future__ import annotations

from typing import Final

RATE_SCALE: Final = 10**12
"""Rates are in parts of this."""


class LocalClock:
    """Local time at any instant of the machine's clock since the latest change. All times are in ns."""

    def __init__(self, now: int) -> None:
        self._anchor = now
        self._local = 0  # at the anchor, times the scale
        self._rate = 0  # at the anchor: deviation of the crystal, and what steers it
        self._steered = 0
        self._change, self._ramp = 0, 0  # of the rate, in so many ns from the anchor on
        self._stopped = False

    def at(self, instant: int) -> int:
        """Local time at an instant."""
        if self._ramp or self._stopped:
            return self._scaled(instant) // RATE_SCALE
        return (self._local + (instant - self._anchor) * (RATE_SCALE + self._rate)) // RATE_SCALE

    def _scaled(self, instant: int) -> int:
        if self._stopped:
            return self._local
        elapsed = instant - self._anchor
        scaled = self._local + elapsed * (RATE_SCALE + self._rate)
        if self._ramp and elapsed > 0:
            part = min(elapsed, self._ramp)
            scaled += self._change * part * part // (2 * self._ramp) + self._change * (elapsed - part)
        return scaled

    def _go_on_from(self, now: int) -> None:
        self._local = self._scaled(now)
        if self._ramp and not self._stopped:
            part = min(now - self._anchor, self._ramp)
            done = self._change * part // self._ramp
            self._rate += done
            self._change, self._ramp = self._change - done, self._ramp - part
        self._anchor = now

    def set_ppm(self, now: int, ppm: float, ramp_ns: int = 0) -> None:
        """Set the error of its crystal, positive for a fast one, at once or within a time."""
        self._go_on_from(now)
        change = round(ppm * 1e6) + self._steered - self._rate
        if ramp_ns:
            self._change, self._ramp = change, ramp_ns
        else:
            self._rate, self._ramp = self._rate + change, 0

    def steer(self, now: int, rate: int) -> None:
        """Run at this rate in addition to the crystal's."""
        self._go_on_from(now)
        self._rate += rate - self._steered
        self._steered = rate

    def jump(self, now: int, ns: int) -> None:
        """Jump forward, or back if negative."""
        self._go_on_from(now)
        self._local += ns * RATE_SCALE

    def stop(self, now: int, stopped: bool) -> None:
        """Stand still, or run on from there."""
        self._go_on_from(now)
        self._stopped = stopped
