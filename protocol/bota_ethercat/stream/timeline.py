# SPDX-License-Identifier: Apache-2.0
"""What is in force for the samples of each sensor: one fold of descriptions, events and frames.

The rules, which hold for a connection and for a recording alike:

- Everything is fed in the order in which the server sent it. What was said last counts, so a description that
  the server made before an event never overrides that event, whoever reads the reply later.
- Frames that follow a message have what it says in force, those before it do not.
- An event without a key leaves what the key says as it was; a description says all.
- A new sample of a sensor that was lost says that it is back.
- What is known of a sensor outlives a connection. A new connection begins a new `epoch` of each sensor.

`StreamTimeline` in the C++ header (stream.hpp) keeps the same rules.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from bota_ethercat.control import Event, event_sentence
from bota_ethercat.replies import Description, SensorInfo, position_of
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import text

# Writing an offset takes twelve requests, each of one or two exchanges, or a few ms of a real mailbox, and
# the server reports it once all six numbers are written.
_DOUBT_S, _DOUBT_PERIODS = 0.1, 24
DOUBT_AFTER: Final = 2  # sample periods: one may have been measured before the last number was written


class InForce(NamedTuple):
    """What a sensor is and how it is set, from one message on until the next; never changed in place.

    Attributes:
        info: identity, AL state, settings, sampling rate, delays of the filters, own offset.
        lost: the server's sentence while it has lost the sensor; None: it has it.
        epoch: raised by all that makes samples another stream: a connection, the loss of the sensor and its
            return, other settings, another rate, another sensor.
        clock: identifies the server's CLOCK_MONOTONIC; equal ids share it, another one is of a machine that
            was restarted, or of another. Empty: not known.
    """

    info: SensorInfo
    lost: str | None = None
    epoch: int = 0
    clock: str = ""

    @property
    def sensor(self) -> int:
        """Its position."""
        return self.info.sensor

    @property
    def is_described(self) -> bool:
        """Whether anything is known of it."""
        return self.info != SensorInfo(self.info.sensor)

    @property
    def doubt_ns(self) -> int:
        """How long before a change of the offset was reported samples may have part of it."""
        return round(max(_DOUBT_S, _DOUBT_PERIODS / self.info.rate_hz if self.info.rate_hz else 0.0) * 1e9)

    @property
    def doubt_after_ns(self) -> int:
        """How long after it they may not have it yet."""
        return round(DOUBT_AFTER * 1e9 / self.info.rate_hz) if self.info.rate_hz else 0

    def is_other_stream(self, before: InForce) -> bool:
        """Whether it is another sensor than `before`, or has other settings or another rate."""
        was, now = before.info, self.info
        return before.is_described and (
            was.identity != now.identity or (was.settings, was.rate_hz) != (now.settings, now.rate_hz)
        )


class Timeline:
    """What is in force now, by position on the bus. Each method returns what it changed, by sensor."""

    def __init__(self) -> None:
        self._now: dict[int, InForce] = {}

    def __getitem__(self, sensor: int) -> InForce:
        return self._now.get(sensor) or InForce(SensorInfo(sensor))

    def __iter__(self) -> Iterator[int]:
        return iter(self._now)

    def connected(self, description: JsonObject) -> list[InForce]:
        """A connection begins, with this description."""
        for sensor, known in self._now.items():
            self._now[sensor] = known._replace(epoch=known.epoch + 1, lost=None)
        self.describe(description)
        return list(self._now.values())

    def describe(self, description: JsonObject) -> list[InForce]:
        """A reply to `describe` or `subscribe`."""
        clock = text(description.get("boot_id"))
        return self._take(
            self[info.sensor]._replace(info=info, clock=clock)
            for info in Description.parse(description).sensors
        )

    def event(self, message: JsonObject) -> list[InForce]:
        """An event of the server."""
        kind, position = message.get("event"), position_of(message)
        if position is None:
            return []
        was = self[position]
        epoch = was.epoch + 1
        if kind == Event.SENSOR_LOST:
            state = "REFUSED" if message.get("reason") == "different_sensor" else "LOST"
            now = InForce(was.info._replace(state=state), event_sentence(message), epoch, was.clock)
        elif kind in (Event.SENSOR_BACK, Event.RECONFIGURED):
            now = InForce(was.info.changed_by(message)._replace(state="OP"), None, epoch, was.clock)
        elif kind == Event.OFFSET_CHANGED:
            now = was._replace(info=was.info.changed_by({"offset": message.get("offset")}))
        else:
            return []
        return self._take([now])

    def sampled(self, sensor: int) -> list[InForce]:
        """A new sample of a sensor: it is not lost."""
        was = self[sensor]
        if was.lost is None:
            return []
        return self._take([was._replace(info=was.info._replace(state="OP"), lost=None)])

    def _take(self, found: Iterable[InForce]) -> list[InForce]:
        changed = []
        for now in found:
            was = self[now.sensor]
            if now.is_other_stream(was):
                now = now._replace(epoch=was.epoch + 1)  # noqa: PLW2901
            if now != self._now.get(now.sensor):
                self._now[now.sensor] = now
                changed.append(now)
        return changed
