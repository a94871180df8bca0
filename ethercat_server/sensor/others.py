"""The slaves beside the sensors: listed, looked at now and then for their presence, and left alone."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Final

from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlStatus
from ethercat_server.sensor.look import Slave

_MOST_LISTED: Final = 64
_ABSENT_AFTER: Final = 3
"""Unanswered reads in a row; a single lost datagram says nothing."""
_ABSENT: Final = "ABSENT"

log = logging.getLogger(__name__)


class Others:
    """The slaves that are no sensors."""

    def __init__(self, bus: Bus, slaves: Sequence[Slave]) -> None:
        self._bus = bus
        self._slaves = slaves
        self.rows: list[dict[str, Any]] = [slave.as_json() for slave in slaves[:_MOST_LISTED]]
        """`others` of the `describe` reply; kept up to date."""
        self._unanswered = [0] * len(self.rows)
        self._turn = -1

    def look_at_next(self) -> None:
        """Read the AL state of the next one, with one datagram."""
        if not self.rows:
            return
        self._turn = turn = (self._turn + 1) % len(self.rows)
        row, slave = self.rows[turn], self._slaves[turn]
        data = self._bus.read_at(slave.position, reg.AL_STATUS, reg.AL_STATUS_SIZE)
        if data is not None:
            if row["state"] == _ABSENT:
                log.info("%s is back", slave)
            row["state"], self._unanswered[turn] = AlStatus.parse(data).state.name, 0
            return
        self._unanswered[turn] += 1
        if self._unanswered[turn] == _ABSENT_AFTER:
            row["state"] = _ABSENT
            log.warning("%s does not answer any more", slave)
