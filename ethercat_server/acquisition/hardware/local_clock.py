"""The local clock of a slave controller, followed on CLOCK_MONOTONIC.

Each exchange tells the local time at which its frame reached the slave: some time between sending and return.
The shorter the round trip, the better that is known, so of each block of exchanges only the shortest counts.
Offset and rate are a Kalman filter's: a crystal's rate is constant but for a slow drift.
"""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming

_WRAP: Final = 1 << 32
"""Local times are given modulo this, in ns: 4.3 s."""
_BLOCK: Final = 32
"""Exchanges; the first blocks are shorter."""
_FIRST_BLOCK: Final = 4
_LEAST_VARIANCE: Final = 4_000.0**2
"""Of the middle of the shortest round trip."""
_FIRST_RATE: Final = 200e-6
"""Standard deviation of the rate's error at first; crystals are off by 100e-6 at most."""
_MOST_RATE: Final = 0.001
"""A clock that is further off is none."""
_JITTER: Final = 1e-4
"""Variance that the phase gains, ns² in each ns: 10 ns in a ms."""
_DRIFT: Final = 1.7e-23
"""Variance that the rate gains in each ns: 1 ppm in a minute."""
_EXCESS_GAIN: Final = 1 / 8
_CONTRADICTS: Final = 5.0
_CONTRADICTIONS: Final = 3
"""Consecutive blocks beyond `_CONTRADICTS` standard deviations after which the clock has jumped."""
_PULL_GAIN: Final = 0.15
_PULLED: Final = 1.0
_RATE_STEP: Final = 50e-6
"""The rate has changed by about this once the mean error exceeds `_PULLED` standard deviations."""
_KNOWN_NS: Final = 10_000.0
_KNOWN: Final = 1 / 32
_KNOWN_BLOCKS: Final = 12
_STILL: Final = 5
"""The clock is known after `_KNOWN_BLOCKS` blocks, once its standard deviation is below `_KNOWN_NS` or the
part `_KNOWN` of the shortest round trip, and until it exceeds that `_STILL` times."""


class LocalClock:
    """Of one slave. Local times are whole ns that never wrap; other times are CLOCK_MONOTONIC, ns."""

    __slots__ = (
        "_back_ns", "_best_local", "_best_ns", "_best_took_ns", "_block", "_blocks", "_contradictions",
        "_covariance", "_doubt_ns", "_left", "_local_at", "_low", "_pull", "_rate_variance", "_time_at",
        "_timing", "excess_ns", "is_known", "local", "rate", "restarts", "variance",
    )  # fmt: skip

    def __init__(self, timing: ExchangeTiming) -> None:
        """`timing` is that of the bus: it knows the shortest round trip."""
        self._timing = timing
        self.local = 0
        """Local time of the newest exchange."""
        self.excess_ns = 0.0
        """What the exchanges that count usually take beyond the shortest."""
        self._low = self._back_ns = 0
        self.restarts = -1
        """How often it turned out to have jumped, or not to run like a clock."""
        self._restart()

    def _restart(self) -> None:
        self.restarts += 1
        self.is_known = False
        """Whether `time` can be used."""
        self.rate = 0.0
        """By what part CLOCK_MONOTONIC is faster."""
        self._blocks = self._contradictions = 0
        self._block = self._left = _FIRST_BLOCK
        self._best_took_ns = math.inf
        self._best_ns, self._best_local = 0.0, 0
        self._time_at, self._local_at = 0.0, 0
        self.variance = self._covariance = 0.0
        """Of `time`, in ns²."""
        self._rate_variance = _FIRST_RATE**2
        self._pull = self._doubt_ns = 0.0

    def time(self, local: int) -> float:
        """CLOCK_MONOTONIC at a local time of recently."""
        passed = local - self._local_at
        return self._time_at + passed + passed * self.rate

    def follow(self, low: int, back_ns: int) -> int:
        """The local time of an exchange that was back then; `low` is it modulo 2**32. They come in order."""
        passed = low - self._low
        self.local += passed + round((back_ns - self._back_ns - passed) / _WRAP) * _WRAP
        self._low, self._back_ns = low, back_ns
        return self.local

    def learn(self, sent_ns: int, arrived_ns: int) -> None:
        """Learn from the exchange that was followed last: sent, and begun to arrive, then."""
        took_ns = arrived_ns - sent_ns
        if took_ns < self._best_took_ns:
            self._best_took_ns = took_ns
            self._best_local, self._best_ns = self.local, sent_ns + took_ns / 2
        self._left -= 1
        if not self._left:
            self._block = self._left = min(_BLOCK, self._block + _FIRST_BLOCK)
            excess_ns = self._best_took_ns - self._timing.least_ns
            self._best_took_ns = math.inf
            self.excess_ns += _EXCESS_GAIN * (excess_ns - self.excess_ns)
            # Where within the excess the slave was is unknown, and the bias may be the same every time.
            self._correct(excess_ns * excess_ns / 4 + _LEAST_VARIANCE)

    def fits(self, sent_ns: int, back_ns: int) -> bool:
        """Whether the newest exchange agrees with it: else the clock has jumped."""
        return sent_ns - self._doubt_ns < self.time(self.local) < back_ns + self._doubt_ns

    def _correct(self, variance: float) -> None:
        """The best exchange of a block, with the variance of when its frame was at the slave."""
        if not self._blocks:
            self._blocks = 1
            self._time_at, self._local_at, self.variance = self._best_ns, self._best_local, variance
            return
        passed = self._best_local - self._local_at
        self._time_at, self._local_at = self.time(self._best_local), self._best_local
        self.variance += passed * (2 * self._covariance + passed * self._rate_variance + _JITTER)
        self._covariance += passed * self._rate_variance
        self._rate_variance += passed * _DRIFT
        error_ns, total = self._best_ns - self._time_at, self.variance + variance
        if error_ns * error_ns > _CONTRADICTS * _CONTRADICTS * total:
            self._contradictions += 1
            if self._contradictions == _CONTRADICTIONS:
                self._restart()
            return
        self._contradictions = 0
        self._pull += _PULL_GAIN * (error_ns / math.sqrt(total) - self._pull)
        self._time_at += error_ns * self.variance / total
        self.rate += error_ns * self._covariance / total
        self._rate_variance -= self._covariance * self._covariance / total
        self._covariance -= self._covariance * self.variance / total
        self.variance -= self.variance * self.variance / total
        if abs(self._pull) > _PULLED:
            self._pull = 0.0
            self._rate_variance += _RATE_STEP**2
        self._blocks += 1
        if abs(self.rate) > _MOST_RATE:
            self._restart()
        else:
            self._doubt_ns = _CONTRADICTS * math.sqrt(self.variance)
            enough_ns = max(_KNOWN_NS, _KNOWN * self._timing.least_ns) * (_STILL if self.is_known else 1)
            self.is_known = self._blocks >= _KNOWN_BLOCKS and self.variance < enough_ns * enough_ns
