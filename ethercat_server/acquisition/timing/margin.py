"""How long after the expected instant of a sample a poll should look for it."""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.acquisition.timing.estimate import ROOT_2_PI
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming

_PRICE_NS: Final = 15_000.0
"""Age that is given up to save an exchange."""
_LOSS_PERIODS: Final = 10.0
"""Age that is given up to lose no sample, in periods, where there is no time for a second poll."""
_NO_TIME: Final = 0.5
"""There is none if a round trip takes more than this part of a period."""
_LARGEST_MARGIN: Final = 0.4
_LESSON: Final = 1.2
"""By this factor an early look costs more where it teaches nothing, for events date the samples."""


def has_no_time_for_two(timing: ExchangeTiming, period_ns: float) -> bool:
    """Whether there is no time for a second poll of a sample."""
    return timing.usual_ns > _NO_TIME * period_ns


def margin_ns(
    timing: ExchangeTiming, period_ns: float, phase_variance: float, *, by_events: bool = False
) -> float:
    """How long after the expected instant a poll should look, so that samples are youngest on the whole.

    An early look costs a second exchange, or the sample where there is no time for one. The margin is where
    a little more of it costs as much as it saves: where the density of the look's instant is 1 / cost.
    """
    single = has_no_time_for_two(timing, period_ns)
    cost_ns = _LOSS_PERIODS * period_ns if single else timing.usual_ns + _PRICE_NS
    if by_events:
        cost_ns *= _LESSON
    deviation_ns = math.sqrt(phase_variance + timing.variance)
    ratio = cost_ns / (deviation_ns * ROOT_2_PI)
    if ratio <= 1:
        return 0.0
    return min(deviation_ns * math.sqrt(2 * math.log(ratio)), _LARGEST_MARGIN * period_ns)
