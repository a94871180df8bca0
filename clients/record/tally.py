"""Counts what is recorded and what is missing, sensor by sensor."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from protocol.accounting import StreamAccounting, StreamCounts
from protocol.framing import DataMessage


@dataclass(slots=True)
class Tally:
    """What came of all sensors."""

    sensors: dict[int, StreamCounts] = field(default_factory=dict)
    """By position on the bus."""
    dropped: int = 0
    """Frames that came but could not be written."""
    _accounting: dict[int, StreamAccounting] = field(default_factory=dict)

    def count(self, frame: DataMessage) -> None:
        """Count a frame that is recorded."""
        accounting = self._accounting.get(frame.sensor)
        if accounting is None:
            accounting = self._accounting[frame.sensor] = StreamAccounting(fresh_only=False)
            self.sensors[frame.sensor] = accounting.counts
        accounting.take(frame.sequence, frame.monotonic_ns, frame.flags)

    def start_again(self) -> None:
        """A new connection: the server may have been restarted, and its numbering with it."""
        for accounting in self._accounting.values():
            accounting.begin()

    @property
    def frames(self) -> int:
        """Frames of all sensors."""
        return sum(sensor.frames for sensor in self.sensors.values())

    def brief(self) -> str:
        """The same as `losses` in few words, the sensors' counts joined by +; from any thread."""
        sensors = [sensor for _, sensor in sorted(dict(self.sensors).items())]
        missing = self.dropped + sum(sensor.withheld for sensor in sensors)
        found = [f"{missing} lost"] if missing else []
        for name, counts in (
            ("gaps", [sensor.lost for sensor in sensors]),  # without a rate, one for each GAP
            ("invalid", [sensor.invalid for sensor in sensors]),
        ):
            if any(counts):
                found.append(f"{'+'.join(map(str, counts))} {name}")
        return ", ".join(found) or "nothing lost"

    def as_json(self) -> dict[str, dict[str, int]]:
        """By position on the bus: `frames`, and the counts of `protocol.accounting`."""
        return {
            str(position): {"frames": sensor.frames, **asdict(sensor)}
            for position, sensor in sorted(self.sensors.items())
        }

    def losses(self) -> list[str]:
        """What is missing, in words; nothing if nothing is."""
        found = []
        if self.dropped:
            found.append(f"{_frames(self.dropped)} came but could not be written")
        for position, sensor in sorted(self.sensors.items()):
            if sensor.withheld:
                found.append(f"{_frames(sensor.withheld)} of sensor {position} not read in time")
            if lost := sensor.lost:
                found.append(
                    f"sensor {position}: {lost} times samples were or may have been lost on the bus (GAP)"
                )
            if sensor.invalid:
                found.append(f"{_frames(sensor.invalid)} of sensor {position} invalid")
        return found


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
