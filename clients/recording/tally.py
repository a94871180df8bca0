"""Counts what is recorded and what is missing, sensor by sensor."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from protocol.framing import DataFlag, DataMessage

_GAP, _REPEATED, _INVALID = (int(f) for f in (DataFlag.GAP, DataFlag.REPEATED, DataFlag.INVALID))


@dataclass(slots=True)
class SensorTally:
    """What came of one sensor."""

    frames: int = 0
    repeated: int = 0
    invalid: int = 0
    withheld: int = 0
    """Frames that the server had but did not send, because they were not read in time: `sequence` jumps."""
    gaps: int = 0
    """GAP without a jump: places where the server itself lost samples, or cannot rule it out."""
    next_sequence: int = -1


@dataclass(slots=True)
class Tally:
    """What came of all sensors."""

    sensors: dict[int, SensorTally] = field(default_factory=dict)
    dropped: int = 0
    """Frames that came but could not be written."""

    def count(self, frame: DataMessage) -> None:
        """Count a frame that is recorded."""
        sensor = self.sensors.get(frame.sensor)
        if sensor is None:
            sensor = self.sensors.setdefault(frame.sensor, SensorTally())
        expected, sensor.next_sequence = sensor.next_sequence, frame.sequence + 1
        sensor.frames += 1
        if frame.sequence > expected >= 0:
            sensor.withheld += frame.sequence - expected
        elif frame.flags & _GAP:
            sensor.gaps += 1
        if frame.flags & _REPEATED:
            sensor.repeated += 1
        if frame.flags & _INVALID:
            sensor.invalid += 1

    def start_again(self) -> None:
        """The server may have been restarted: its numbers begin anew."""
        for sensor in self.sensors.values():
            sensor.next_sequence = -1

    @property
    def frames(self) -> int:
        """Frames of all sensors."""
        return sum(sensor.frames for sensor in self.sensors.values())

    def brief(self) -> str:
        """The same as `losses` in few words, the sensors' counts one after the other; from any thread."""
        sensors = [sensor for _, sensor in sorted(dict(self.sensors).items())]
        missing = self.dropped + sum(sensor.withheld for sensor in sensors)
        found = [f"{missing} lost"] if missing else []
        for name, counts in (
            ("gaps", [sensor.gaps for sensor in sensors]),
            ("invalid", [sensor.invalid for sensor in sensors]),
        ):
            if any(counts):
                found.append(f"{'+'.join(map(str, counts))} {name}")
        return ", ".join(found) or "nothing lost"

    def as_json(self) -> dict[str, dict[str, int]]:
        """By place on the bus."""
        rows = {str(place): asdict(sensor) for place, sensor in sorted(self.sensors.items())}
        for row in rows.values():
            del row["next_sequence"]
        return rows

    def losses(self) -> list[str]:
        """What is missing, in words; nothing if nothing is."""
        found = []
        if self.dropped:
            found.append(f"{_frames(self.dropped)} came but could not be written")
        for place, sensor in sorted(self.sensors.items()):
            if sensor.withheld:
                found.append(f"{_frames(sensor.withheld)} of sensor {place} not read in time")
            if sensor.gaps:
                found.append(
                    f"sensor {place}: {sensor.gaps} times samples were or may have been lost on the bus (GAP)"
                )
            if sensor.invalid:
                found.append(f"{_frames(sensor.invalid)} of sensor {place} invalid")
        return found


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
