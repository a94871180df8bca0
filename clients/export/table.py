"""The lines of the table. Names are identifiers, so that pandas and MATLAB keep them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from typing import Final

from protocol.accounting import NOT_NEW
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import ImuUnits, Sample, SampleDecoder

_SECOND: Final = 1_000_000_000
_VECTORS: Final = (("force", "N"), ("torque", "Nm"), ("acceleration", "m_s2"), ("angular_rate", "rad_s"))
_FLAGS: Final = (DataFlag.GAP, DataFlag.REPEATED, DataFlag.INVALID)
COLUMNS: Final = (
    "time_s", "stamp_utc", "sensor", "sequence",
    *(f"{name}_{axis}_{unit}" for name, unit in _VECTORS for axis in "xyz"),
    "temperature_degC",
    *(f"orientation_{axis}" for axis in "xyzw"),
    *(str(flag.name).lower() for flag in _FLAGS),
    "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated", "warnings", "status",
)  # fmt: skip


class Table:
    """Makes lines of frames.

    Attributes:
        written: number of samples.
        left_out: number of frames that are no new sample.
    """

    def __init__(self, units: ImuUnits, *, everything: bool) -> None:
        """With `everything` frames that are no new sample have a line too."""
        self.written = self.left_out = 0
        self._units, self._everything = units, everything
        self._decoders: dict[int, Callable[[bytes], Sample]] = {}
        self._gaps: dict[int, int] = {}

    def lines(self, frames: Iterable[DataMessage]) -> Iterator[str]:
        """The names, then a line for each; PdoSizeError."""
        yield ",".join(COLUMNS) + "\n"
        first_ns: int | None = None
        last_ns = stamp_ns = 0
        second, date = -1, ""
        for frame in frames:
            # A gap before a frame that is left out is before the next sample.
            flags = frame.flags | self._gaps.pop(frame.sensor, 0)
            if flags & NOT_NEW and not self._everything:
                self.left_out += 1
                self._gaps[frame.sensor] = flags & DataFlag.GAP
                continue
            self.written += 1
            first_ns = frame.monotonic_ns if first_ns is None else first_ns
            if frame.monotonic_ns < last_ns - _SECOND:  # its machine was restarted: only the stamps go on
                first_ns += frame.monotonic_ns - last_ns - max(0, frame.stamp_ns - stamp_ns)
            last_ns, stamp_ns = frame.monotonic_ns, frame.stamp_ns
            whole, ns = divmod(stamp_ns, _SECOND)
            if whole != second:
                second, date = whole, f"{datetime.fromtimestamp(whole, UTC):%Y-%m-%dT%H:%M:%S}"
            cells = [_seconds(last_ns - first_ns), f"{date}.{ns:09d}Z", frame.sensor, frame.sequence]
            yield f"{','.join(map(str, cells))},{self._values(frame.process_data, flags)}\n"

    def _values(self, data: bytes, flags: int) -> str:
        decode = self._decoders.get(len(data))
        if decode is None:
            decode = self._decoders[len(data)] = SampleDecoder(len(data), self._units).decode
        sample = decode(data)
        # Nine digits keep a REAL32 to the bit.
        reals = ",".join([f"{value:.9g}" for value in (*sample.array, sample.temperature)])
        orientation = ",".join([f"{value:.9g}" for value in sample.orientation or ()]) or ",,,"
        whole = (
            *(int(bool(flags & flag)) for flag in _FLAGS), sample.force_torque_saturated,
            sample.acceleration_saturated, sample.angular_rate_saturated, sample.warnings, sample.status,
        )  # fmt: skip
        return f"{reals},{orientation},{','.join(map(str, whole))}"


def _seconds(ns: int) -> str:
    whole, rest = divmod(abs(ns), _SECOND)
    return f"{'-' if ns < 0 else ''}{whole}.{rest:09d}"
