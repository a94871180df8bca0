"""The last samples that were measured before an instant: of a recording, or of a stream with the same result.

    windows = Windows(32)
    windows.configure(in_force)  # of the timeline, whenever it changes
    windows.add(columns(frames))  # DATA messages of one sensor, in order
    arrays = windows.at(np.array([windows.until_ns]))

Samples are in slots, one for each period of the sensor; the slot of a lost sample stays empty. A sample was
measured at its stamp less the delay of the filters, and each channel has filters of its own. Instants and
stamps are ns of the server's CLOCK_MONOTONIC.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.identify.tool_file import tool_parameters
from bota_clients.recording.columns import Bools, Columns, Ints, NewSamples
from bota_clients.recording.order import TimeAxis
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import Delays
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import SettingValue
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE
from bota_ft_compensation.identification.parameter_file import stream_of
from bota_ft_compensation.stream import CompensatedStream

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
_GAP: Final = int(DataFlag.GAP)
_CHANNELS: Final = {FORCE_TORQUE: slice(0, 6), ACCELERATION: slice(6, 9), ANGULAR_RATE: slice(9, 12)}
_SLOT: Final = np.dtype([
    ("measured_ns", "i8", 3),  # by channel; of an empty slot by its place between two samples
    ("latest_ns", "i8", 3),  # the latest of these so far
    ("values", "f4", 12),  # force, torque, acceleration, angular rate: N, Nm, m/s², rad/s; NaN: empty
    ("valid", "?", 3),  # by channel
    ("compensated", "f4", 6),  # N, Nm; NaN: not known
    ("bounds", "f4", 2),  # 95 %, of what is wrong with its force and torque
    ("monotonic_ns", "i8"),  # stamp; of an empty slot by its place
    ("sequence", "i8"),  # -1: there was no such frame, or it is not known which
    ("number", "i8"),  # of the sample, from 0 on; -1: empty
])  # fmt: skip
_EMPTY: Final = np.array(
    [((-1,) * 3, (-1,) * 3, (math.nan,) * 12, (False,) * 3, (math.nan,) * 6, (math.nan,) * 2, -1, -1, -1)],
    _SLOT,
)


class Rows:
    """Rows of an array: new ones come at its end, old ones go at its beginning."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._whole = np.dtype((np.void, dtype.itemsize))  # a row copied at once, and not field by field
        self._room, self._dtype = np.zeros(0, self._whole), dtype
        self._begin = self._end = 0

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def array(self) -> Array:
        """Those that are kept, until the next change."""
        return self._room[self._begin : self._end].view(self._dtype)

    def add(self, rows: Array) -> None:
        end = self._end + len(rows)
        if end > len(self._room):
            kept = self._room[self._begin : self._end]
            self._begin, self._end, end = 0, len(kept), len(kept) + len(rows)
            self._room = np.concatenate([kept, np.zeros(2 * end - len(kept), self._whole)])
        self._room[self._end : end] = rows.view(self._whole)
        self._end = end

    def take(self, count: int) -> Array:
        """The oldest, which go."""
        taken = self.array[:count]
        self._begin += len(taken)
        return taken


def interpolated(at: Ints, here: Ints, there: Ints) -> Ints:
    """One clock by another, in ns, without loss of digits."""
    passed = np.interp(at - here[0], here - here[0], there - there[0])
    return np.asarray(there[0] + np.rint(passed).astype(np.int64))


def read_tool(path: Path) -> Mapping[str, Any]:
    """Parameters of the ROS 2 node, as `ethercat-identify --yaml` writes them; RecordingError."""
    with tool_parameters(path) as found:
        Windows(1, tool=found)
        return found


class Windows:
    """The newest samples of one sensor, and windows of them, for instants that ascend.

    Attributes:
        begin_ns: stamp of the first sample; -1 before it.
        until_ns: last instant of which nothing that comes later can be a part; -1 before the first sample.
        tool: parameters of the node; None: there is no compensated wrench.
        stream: what compensates; None without a tool.
        axis: of time, on which `follow` puts the samples.
        doubt_ns: how long before an offset was reported samples may have part of it; 0 without a tool.
    """

    def __init__(
        self, length: int, *, tool: Mapping[str, Any] | None = None, imu_units: ImuUnits = ImuUnits.G_DPS
    ) -> None:
        """Of `length` samples. With a `tool`, parameters of the ROS 2 node, there is a compensated wrench."""
        self.begin_ns, self.tool, self.axis, self._new = -1, tool, TimeAxis(), NewSamples()
        self._length, self.imu_units = length, imu_units
        self._slots = Rows(_SLOT)
        self._latest_ns, self.until_ns = np.full(3, -1), -1  # the first by channel: the latest measured
        self._newest = (0, 0)  # stamp and sequence of the newest sample
        self._taken = self._epoch = 0  # samples; of what is in force
        self._begins = False  # another stream, which the first sample after a pause need not say
        self._settings, self._rate_hz = dict[str, SettingValue](), -1.0
        self._delay_ns: Array = np.zeros(3)  # by channel
        self.doubt_ns = 0
        self.stream: CompensatedStream | None = None if tool is None else stream_of(tool)

    def follow(self, batches: Iterable[tuple[InForce, Columns]]) -> Iterator[Columns]:
        """Take the next batches on one axis of time, each with what is in force; the samples of each."""
        for in_force, batch in self.axis.batches(batches):
            self.configure(in_force)
            yield self.add(batch)

    def configure(self, in_force: InForce) -> None:
        """What is in force for what follows; RecordingError.

        A bias is shifted with the sensor's own offset; where only one of this and the tool's `sensor_offset`
        is known there is no compensated wrench.
        """
        settings, rate_hz = in_force.info.settings, in_force.info.rate_hz
        self._begins, self._epoch = self._begins or in_force.epoch != self._epoch, in_force.epoch
        if (stream := self.stream) is not None:
            was_announced = stream.offset is None  # of what came since then nothing is compensated
            stream.configure(in_force)
            self.doubt_ns = in_force.doubt_ns
            if stream.follow_offset() is not None and self.begin_ns >= 0 and not was_announced:
                since_ns, slots = self._newest[0] - self.doubt_ns - self._delay_ns[0], self._slots.array
                slots["compensated"][slots["measured_ns"][:, 0] >= since_ns] = math.nan
        if (settings, rate_hz) == (self._settings, self._rate_hz):
            return
        if not rate_hz:
            raise RecordingError("the sampling rate is not known, so lost samples have no place")
        self._settings, self._rate_hz = dict(settings), rate_hz
        # Where a delay is unknown, a sample counts as measured only when it was stamped: never too early.
        self._delay_ns = np.array([delay or 0 for delay in Delays.parse(delays_ms(settings, rate_hz))])

    def add(self, frames: Columns) -> Columns:
        """Take the next frames of the sensor, also REPEATED and INVALID ones; the samples. RecordingError.

        A GAP of other frames is the next sample's.
        """
        is_new, flags = self._new.among(frames.flags)
        samples = replace(frames, flags=flags)
        samples = samples if is_new.all() else samples.where(is_new)
        if not len(samples):
            return samples
        stamps, sequence = samples.monotonic_ns, samples.sequence
        if self.begin_ns < 0:
            self.begin_ns, self._newest = int(stamps[0]), (int(stamps[0]) - 1, int(sequence[0]) - 1)
        passed = stamps - np.concatenate([self._newest[:1], stamps[:-1]])
        if passed.min() <= 0:
            raise RecordingError("the server's machine was restarted meanwhile: record again")
        further = sequence - np.concatenate([self._newest[1:], sequence[:-1]])
        self._newest = int(stamps[-1]), int(sequence[-1])
        slots = self._slots_of(samples)
        is_gap = (samples.flags & _GAP != 0) | (further != 1)
        is_gap[0], self._begins = is_gap[0] or self._begins, False
        if is_gap.any():
            slots = self._spread(slots, passed, further, is_gap)
        np.maximum.accumulate(slots["measured_ns"], axis=0, out=slots["latest_ns"])
        slots["latest_ns"] = np.maximum(slots["latest_ns"], self._latest_ns)
        self._latest_ns = slots["latest_ns"][-1]
        self.until_ns = min(self._latest_ns.tolist())
        self._slots.add(slots)
        return samples

    def _slots_of(self, samples: Columns) -> Array:
        slots = np.empty(len(samples), _SLOT)
        slots["monotonic_ns"], slots["sequence"] = samples.monotonic_ns, samples.sequence
        slots["measured_ns"] = samples.monotonic_ns[:, np.newaxis] - self._delay_ns
        slots["number"] = np.arange(self._taken, self._taken + len(slots))
        self._taken += len(slots)
        vectors = samples.force, samples.torque, samples.acceleration, samples.angular_rate
        values = np.concatenate(vectors, axis=1)
        is_finite = np.isfinite(values)
        if not (are_finite := is_finite.all()):
            values[~is_finite] = math.nan
        slots["values"] = values
        for place, (channel, part) in enumerate(_CHANNELS.items()):
            is_good = channel.flagged(samples) == 0
            slots["valid"][:, place] = is_good if are_finite else is_good & is_finite[:, part].all(axis=1)
        if self._settings.get("imu_active") == 0:
            slots["valid"][:, 1:] = False
        slots["compensated"], slots["bounds"] = (
            (math.nan, math.nan) if self.stream is None else self.stream.compensate(samples)
        )
        return slots

    def _spread(self, slots: Array, passed: Ints, further: Ints, is_gap: Bools) -> Array:
        """With empty slots where samples were lost: by how much time and sequence went on before each."""
        lost = np.maximum(np.rint(passed * (self._rate_hz * 1e-9)).astype(np.int64) - 1, 0) * is_gap
        # Of the slots of lost samples the first ones do: a window is not longer.
        kept = np.minimum(lost, self._length)
        end = np.cumsum(kept + 1) - 1  # where each sample is
        of = np.repeat(np.arange(len(end)), kept + 1)
        after = np.arange(len(of)) - (end - kept)[of] + 1  # periods since the sample before
        since_ns = np.rint(passed[of] * (after / (lost[of] + 1))).astype(np.int64)
        spread = np.repeat(_EMPTY, len(of))
        spread["monotonic_ns"] = (slots["monotonic_ns"] - passed)[of] + since_ns
        spread["measured_ns"] = spread["monotonic_ns"][:, np.newaxis] - self._delay_ns
        # A frame that was not read in time has a number, a sample that the server never had does not.
        is_numbered = (further == lost + 1)[of]
        spread["sequence"] = np.where(is_numbered, (slots["sequence"] - further)[of] + after, -1)
        spread[end] = slots
        return spread

    def at(self, instants_ns: Ints, *, is_partial: bool = False) -> Arrays:
        """Windows of these f instants; the last sample of each is the newest.

        `force_torque`, `force_torque_compensated` (f, length, 6) N, Nm; `imu` (f, length, 6) m/s², rad/s;
        of each channel `..._age` (f, length) s before the instant and `..._valid` (f, length). ValueError for
        an instant after `until_ns`, of which not all samples are here: if `is_partial`, these are not valid.
        """
        if not is_partial and (instants_ns > self.until_ns).any():
            raise ValueError(f"after {self.until_ns} ns not all samples are here: take more")
        slots, found, ends = self._slots.array, Arrays(), self._ends(instants_ns)
        if not len(slots):
            slots = _EMPTY
        elif is_partial:
            late_ns = np.maximum(instants_ns - slots["measured_ns"][-1][:, np.newaxis], 0)
            ends += (late_ns * (self._rate_hz * 1e-9)).astype(np.int64)
        index = ends[..., np.newaxis] + np.arange(-self._length, 0)  # (channel, f, length)
        is_there = (index >= 0) & (index < len(slots))
        seen = slots.take(index, mode="clip")
        for channel, ((name, *_), part) in enumerate(_CHANNELS.items()):
            rows, age = seen[channel], f"{name}_age"
            valid = rows["valid"][..., channel] & is_there[channel]
            age_s = (instants_ns[:, np.newaxis] - rows["measured_ns"][..., channel]) * 1e-9
            found |= {name: rows["values"][..., part].copy(), age: age_s.astype(np.float32)}
            found[name][~valid] = found[age][~valid] = math.nan
            found[f"{name}_valid"] = valid
            if self.stream is not None and not channel:
                wrench = rows["compensated"].copy()
                wrench[~valid] = math.nan
                found[f"{name}_compensated"] = wrench
                found[f"{name}_compensated_valid"] = np.isfinite(wrench).all(axis=2)
        found["imu"] = np.concatenate([found.pop("acceleration"), found.pop("angular_rate")], axis=2)
        return found

    def forget(self, before_ns: int) -> None:
        """What windows of this instant and later ones do not need; without this everything is kept."""
        self._slots.take(max(int(self._ends(np.array([before_ns])).min()) - self._length, 0))

    def take(self, *, rest: bool) -> Array:
        """The slots that nothing that comes later can change, or the rest; they are in no window then."""
        settled = np.array([self.until_ns - self.doubt_ns - 1])
        return self._slots.take(len(self._slots) if rest else int(self._ends(settled)[0, 0]))

    def _ends(self, instants_ns: Ints) -> Ints:
        """(3, f) By channel the slot behind the newest that was measured before or at each instant."""
        latest_ns = self._slots.array["latest_ns"].T
        return np.array([np.searchsorted(each, instants_ns, "right") for each in latest_ns])
