"""Looks into the mailboxes of the sensors that stream, and tells the clients of emergencies.

While nobody asks a sensor for an object, nobody else reads what it puts there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bota_ethercat.control import Event, event
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave.emergencies import Emergency
from ethercat_server.sensor.sensor import Sensor


class Mailboxes:
    """Of all sensors of the bus. `announce` sends an event to the clients."""

    def __init__(self, bus: Bus, sensors: Sequence[Sensor], announce: Callable[[JsonObject], None]) -> None:
        self._bus = bus
        self._sensors = sensors
        self._announce = announce
        self._turn = -1
        bus.emergencies.tell = self._tell

    def look_at_next(self) -> None:
        """Look at the next sensor's: one datagram, a second one to read one message that is there."""
        self._turn = (self._turn + 1) % len(self._sensors)
        if self._sensors[self._turn].streams:
            self._bus.slaves[self._turn].sdo.look()

    def _tell(self, number: int, emergency: Emergency, count: int) -> None:
        message = f"sensor {number} reports {emergency}"
        keys = {**emergency.as_json(), "count": count, "message": message}
        self._announce(event(Event.EMERGENCY, sensor=number, **keys))
