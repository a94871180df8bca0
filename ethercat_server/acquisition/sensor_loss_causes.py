"""What explains the loss of a sensor: another master, or this computer stood still."""

from __future__ import annotations

from typing import Final

from bota_ethercat.health.advice import STOOD_STILL
from ethercat_server.ethercat.other_master import RECENT_NS, OtherMaster

# Stalls of this length in the time that is recent explain a missing answer, or an expired watchdog.
_STALL_NS: Final = 20_000_000


class SensorLossCauses:
    """On the bus of an interface."""

    def __init__(self, ifname: str) -> None:
        self._ifname, self.other_master = ifname, OtherMaster(ifname)
        self._stall_ns = -RECENT_NS  # when this computer stood still last
        self._stalled_ns = 0  # sum of the stalls that followed each other within `RECENT_NS`

    def see_stall(self, late_ns: float, now_ns: int) -> None:
        """The loop did not run for `late_ns`."""
        if now_ns - self._stall_ns > RECENT_NS:
            self._stalled_ns = 0
        self._stalled_ns += int(late_ns)
        self._stall_ns = now_ns

    def known_cause(self, now_ns: int) -> str:
        """What explains the loss of a sensor now; "" if nothing does."""
        if self.other_master.is_recent(now_ns):
            return f"check for another EtherCAT master, whose frames arrive on {self._ifname}"
        if now_ns - self._stall_ns < RECENT_NS and self._stalled_ns > _STALL_NS:
            return f"this {STOOD_STILL.format(f' for {self._stalled_ns / 1e6:.0f} ms')}"
        return ""

    def explain(self, reason: str, now_ns: int, otherwise: str = "") -> str:
        """Why a sensor is lost, with what explains it; `otherwise` if nothing does."""
        cause = self.known_cause(now_ns) or otherwise
        return f"{reason}: {cause}" if cause else reason
