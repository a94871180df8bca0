"""Another EtherCAT master on the wire: found before this one starts, and while it runs."""

from __future__ import annotations

import logging
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import FIRST_INDEX
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, PROCESSED_BIT, SOURCE, SOURCE_ADDRESS

_LISTEN_S: Final = 0.1
# Frames of others in that time or, later, in a second that are a master's; fewer may be late answers, or the
# last ones of a server that was killed.
_MASTER_FRAMES: Final = 3
_GONE_S: Final = 10  # seconds without any after which it has gone
RECENT_NS: Final = 1_000_000_000

log = logging.getLogger(__name__)


def refuse_other_master(bus: Bus) -> None:
    """BusError if another master is sending; nothing is sent."""
    if (count := bus.listen(_LISTEN_S)) >= _MASTER_FRAMES:
        raise BusError(
            f"another EtherCAT master is sending on {bus.ifname} ({count} frames in {_LISTEN_S:g} s): stop "
            "it, or name the interface that the sensor is connected to; --force takes its slaves over"
        )


class OtherMaster:
    """One that sends while the bus runs; call `check` once a second."""

    def __init__(self, ifname: str) -> None:
        self._ifname = ifname
        self._frames = self._frames_checked = 0
        self._frame_ns = -RECENT_NS  # when the last one came
        self._gone_s = _GONE_S

    def see(self, frame: bytes, now_ns: int) -> None:
        """A frame arrived that answers no exchange: it counts if another master sent it."""
        at = SOURCE_ADDRESS
        if len(frame) <= DATAGRAM_INDEX:
            return
        source = bytes([frame[at] & ~PROCESSED_BIT]) + frame[at + 1 : at + 6]
        # Of our own only single datagrams arrive here, and answers that come late or twice.
        if source != SOURCE or frame[DATAGRAM_INDEX] < FIRST_INDEX:
            self._frames += 1
            self._frame_ns = now_ns

    def is_recent(self, now_ns: int) -> bool:
        """Whether a frame of it has just come."""
        return now_ns - self._frame_ns < RECENT_NS

    def check(self) -> None:
        """Log once that there is another master, and once that it has gone."""
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
