"""Says once that frames take long, and what that costs: a USB network card is easily taken for granted."""

from __future__ import annotations

import logging
from typing import Final

from ethercat_server.acquisition.exchange_timing import ExchangeTiming

# A usual round trip above this is a slow network card's, or a slow driver's.
SLOW_US: Final = 300.0
# A usual round trip through a PCIe card, system calls included.
_PCIE_US: Final = 100.0
_SLOW_SECONDS: Final = 5

log = logging.getLogger(__name__)


def cost(usual_us: float) -> str:
    """What a slow round trip costs, as part of a sentence."""
    older_us = (usual_us - _PCIE_US) / 2
    return f"samples are {older_us:.0f} µs older than through a PCIe network card, but none is lost by it"


class RoundTripHealth:
    """Of the exchanges on `ifname`. `check` is to be called once a second."""

    def __init__(self, timing: ExchangeTiming, ifname: str) -> None:
        self._timing = timing
        self._ifname = ifname
        self._slow_s = 0

    def check(self) -> None:
        """What the last second showed."""
        usual_us = self._timing.usual_ns / 1000
        if self._slow_s < _SLOW_SECONDS:
            self._slow_s = self._slow_s + 1 if usual_us > SLOW_US else 0
            if self._slow_s == _SLOW_SECONDS:
                log.info("frames take %.0f µs through %s: %s", usual_us, self._ifname, cost(usual_us))
