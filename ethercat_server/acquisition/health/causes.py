"""Why a sensor is lost that is in order: another master on the wire, or a busy computer."""

from __future__ import annotations

import logging
from typing import Final

from ethercat_server.ethercat.datagrams import FIRST_INDEX
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, PROCESSED_BIT, SOURCE, SOURCE_ADDRESS

# Frames of others in a second that are a master's; fewer may be late answers from before the loop.
_MASTER_FRAMES: Final = 3
# Seconds without any after which it has gone.
_GONE_S: Final = 10
_RECENT_NS: Final = 1_000_000_000
# Standing still for so long in that time explains a missing answer, or the end of a watchdog.
_STALL_NS: Final = 20_000_000

log = logging.getLogger(__name__)


class Causes:
    """Of the bus on `ifname`. `check` is to be called once a second."""

    def __init__(self, ifname: str) -> None:
        self._ifname = ifname
        self._frames = self._frames_checked = 0
        """Of other masters."""
        self._frame_ns = self._stall_ns = -_RECENT_NS
        """When the last one came, when this computer stood still last."""
        self._stalled_ns = 0
        """For how long, all in all, without longer breaks in between."""
        self._gone_s = _GONE_S

    def stray(self, frame: bytes, now_ns: int) -> None:
        """A frame has arrived that answers no exchange."""
        at = SOURCE_ADDRESS
        if len(frame) <= DATAGRAM_INDEX:
            return
        source = bytes([frame[at] & ~PROCESSED_BIT]) + frame[at + 1 : at + 6]
        # Of our own only single datagrams arrive here, and answers that come late or twice.
        if source != SOURCE or frame[DATAGRAM_INDEX] < FIRST_INDEX:
            self._frames += 1
            self._frame_ns = now_ns

    def stood_still(self, late_ns: float, now_ns: int) -> None:
        """This computer did something else for so long."""
        if now_ns - self._stall_ns > _RECENT_NS:
            self._stalled_ns = 0
        self._stalled_ns += int(late_ns)
        self._stall_ns = now_ns

    def explain(self, reason: str, now_ns: int, otherwise: str = "") -> str:
        """Why a sensor is lost, with what explains it; `otherwise` if nothing does."""
        if now_ns - self._frame_ns < _RECENT_NS:
            otherwise = f"check for another EtherCAT master, whose frames arrive on {self._ifname}"
        elif now_ns - self._stall_ns < _RECENT_NS and self._stalled_ns > _STALL_NS:
            stalled_ms = self._stalled_ns / 1e6
            otherwise = f"this computer stood still for {stalled_ms:.0f} ms, check it with ethercat-doctor"
        return f"{reason}: {otherwise}" if otherwise else reason

    def check(self) -> None:
        """Say once that there is another master, and once that it has gone."""
        frames, self._frames_checked = self._frames - self._frames_checked, self._frames
        if frames >= _MASTER_FRAMES:
            if self._gone_s >= _GONE_S:
                log.warning(
                    "another EtherCAT master is sending on %s (%d frames in a second): stop it, for two "
                    "masters disturb each other's slaves",
                    self._ifname, frames,
                )  # fmt: skip
            self._gone_s = 0
        elif self._gone_s < _GONE_S and not frames:
            self._gone_s += 1
            if self._gone_s == _GONE_S:
                log.info("the other EtherCAT master on %s has stopped sending", self._ifname)
