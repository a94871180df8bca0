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
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.identify.tool_file import tool_parameters
from bota_clients.recording.columns import Columns, Ints
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import Delays
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE
from bota_ft_compensation.identification.parameter_file import stream_of
from bota_ft_compensation.stream import CompensatedStream

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
_CHANNELS: Final = {FORCE_TORQUE: slice(0, 6), ACCELERATION: slice(6, 9), ANGULAR_RATE: slice(9, 12)}
_SLOT: Final = np.dtype([
    ("measured_ns", "i8", 3),  # by channel; of an empty slot by its place between two samples
    ("values", "f4", 12),  # force, torque, acceleration, angular rate: N, Nm, m/s², rad/s; NaN: empty
    ("valid", "?", 3),  # by channel
    ("compensated", "f4", 6),  # N, Nm; NaN: not known
    ("bounds", "f4", 2),  # 95 %, of what is wrong with its force and torque
    ("monotonic_ns", "i8"),  # stamp; of an empty slot by its place
    ("sequence", "i8"),  # -1: there was no such frame, or it is not known which
    ("number", "i8"),  # of the sample, from 0 on; -1: empty
])  # fmt: skip
_WHOLE: Final = np.dtype((np.void, _SLOT.itemsize))  # a slot copied at once, and not field by field


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
        tool: parameters of the node; None: there is no compensated wrench.
        stream: what compensates; None without a tool.
    """

    def __init__(
        self,
        length: int,
        *,
        tool: Mapping[str, Any] | None = None,
        imu_units: ImuUnits = ImuUnits.G_DPS,
    ) -> None:
        """Of `length` samples. With a `tool`, parameters of the ROS 2 node, there is a compensated wrench."""
        self.begin_ns, self.tool = -1, tool
        self._length, self.imu_units = length, imu_units
        self.stream: CompensatedStream | None = None
        self._slots = np.zeros(0, _SLOT)
        self._until_ns = np.full(3, -1)  # by channel: the latest measured
        self._newest = (0, 0)  # stamp and sequence of the newest sample
        self._taken = self._epoch = 0  # samples; of what is in force
        self._begins = False  # another stream, which the first sample after a pause need not say
        self._made_of: tuple[Mapping[str, object], float] | None = None
        self._doubt_ns = 0
        if tool is not None:
            self.stream = stream_of(tool)

    def configure(self, in_force: InForce) -> None:
        """What is in force for what follows; RecordingError.

        A bias is shifted with the sensor's own offset; where only one of this and the tool's `sensor_offset`
        is known there is no compensated wrench.
        """
        settings, rate_hz = in_force.info.settings, in_force.info.rate_hz
        self._begins, self._epoch = self._begins or in_force.epoch != self._epoch, in_force.epoch
        if self.stream is not None:
            self._follow(in_force, self.stream)
        if (settings, rate_hz) == self._made_of:
            return
        if not rate_hz:
            raise RecordingError("the sampling rate is not known, so lost samples have no place")
        self._made_of, self._known, self._rate_hz = (settings, rate_hz), settings, rate_hz
        # Where a delay is unknown, a sample counts as measured only when it was stamped: never too early.
        self._delay_ns = np.array([delay or 0 for delay in Delays.parse(delays_ms(settings, rate_hz))])

    def _follow(self, in_force: InForce, stream: CompensatedStream) -> None:
        """What is in force for what follows, the sensor's own offset too."""
        was_announced = stream.offset is None  # of what came since then nothing is compensated
        stream.configure(in_force)
        self._doubt_ns = in_force.doubt_ns
        if stream.follow_offset() is None:
            return
        newest_ns = self._newest[0]
        if self.begin_ns >= 0 and not was_announced:
            since_ns = newest_ns - self.doubt_ns - self._delay_ns[0]
            self._slots["compensated"][self._slots["measured_ns"][:, 0] >= since_ns] = math.nan

    @property
    def doubt_ns(self) -> int:
        """How long before an offset was reported samples may have part of it; 0 without a tool."""
        return self._doubt_ns

    @property
    def until_ns(self) -> int:
        """The last instant of which nothing that comes later can be a part; -1 before the first sample."""
        return int(self._until_ns.min())

    def add(self, frames: Columns) -> Columns:
        """Take the next frames of the sensor, also REPEATED and INVALID ones; the samples. RecordingError."""
        samples = frames if frames.fresh.all() else frames.where(frames.fresh)
        if not len(samples):
            return samples
        stamps, sequence = samples.monotonic_ns, samples.sequence
        if self.begin_ns < 0:
            self.begin_ns, self._newest = int(stamps[0]), (int(stamps[0]) - 1, int(sequence[0]) - 1)
        passed = np.diff(stamps, prepend=self._newest[0])
        if (passed <= 0).any():
            raise RecordingError("the server's machine was restarted meanwhile: record again")
        further = np.diff(sequence, prepend=self._newest[1])
        is_gap = (samples.flags & int(DataFlag.GAP) != 0) | (further != 1)
        is_gap[0], self._begins = is_gap[0] or self._begins, False
        self._newest = int(stamps[-1]), int(sequence[-1])
        lost = np.maximum(np.rint(passed * (self._rate_hz * 1e-9)).astype(np.int64) - 1, 0) * is_gap
        # Of the slots of lost samples the first ones do: a window is not longer.
        kept = np.minimum(lost, self._length)
        end = np.cumsum(kept + 1) - 1  # where each sample is
        of = np.repeat(np.arange(len(end)), kept + 1)
        after = np.arange(len(of)) - (end - kept)[of] + 1  # periods since the sample before
        since_ns = np.rint(passed[of] * (after / (lost[of] + 1))).astype(np.int64)
        since_ns[end] = passed
        slots = np.zeros(len(of), _SLOT)
        slots["monotonic_ns"] = (stamps - passed)[of] + since_ns
        slots["measured_ns"] = slots["monotonic_ns"][:, np.newaxis] - self._delay_ns
        # A frame that was not read in time has a number, a sample that the server never had does not.
        slots["sequence"] = np.where((further == lost + 1)[of], (sequence - further)[of] + after, -1)
        at: Any = end if kept.any() else slice(None)
        slots["sequence"][at], slots["number"] = sequence, -1
        slots["number"][at] = np.arange(self._taken, self._taken + len(end))
        self._taken += len(end)
        values = np.hstack([samples.force, samples.torque, samples.acceleration, samples.angular_rate])
        slots["values"] = math.nan
        slots["values"][at] = np.where(np.isfinite(values), values, math.nan)
        is_off = self._known.get("imu_active") == 0
        for place, (channel, part) in enumerate(_CHANNELS.items()):
            is_good = (channel.flagged(samples) == 0) & np.isfinite(values[:, part]).all(axis=1)
            slots["valid"][at, place] = is_good & (channel is FORCE_TORQUE or not is_off)
        slots["compensated"][at], slots["bounds"][at] = (
            (math.nan, math.nan) if self.stream is None else self.stream.compensate(samples)
        )
        self._until_ns = np.maximum(self._until_ns, slots["measured_ns"].max(axis=0))
        self._slots = np.concatenate([self._slots.view(_WHOLE), slots.view(_WHOLE)]).view(_SLOT)
        return samples

    def at(self, instants_ns: Ints, *, is_partial: bool = False) -> Arrays:
        """Windows of these f instants; the last sample of each is the newest.

        `force_torque`, `force_torque_compensated` (f, length, 6) N, Nm; `imu` (f, length, 6) m/s², rad/s;
        of each channel `..._age` (f, length) s before the instant and `..._valid` (f, length). ValueError for
        an instant after `until_ns`, of which not all samples are here: if `is_partial`, these are not valid.
        """
        if not is_partial and (instants_ns > self.until_ns).any():
            raise ValueError(f"after {self.until_ns} ns not all samples are here: take more")
        slots, found = self._slots if len(self._slots) else np.zeros(1, _SLOT), Arrays()
        for channel, ((name, *_), part) in enumerate(_CHANNELS.items()):
            ends = self._ends(instants_ns, channel)
            if is_partial and len(self._slots):
                late_ns = np.maximum(instants_ns - self._slots["measured_ns"][-1, channel], 0)
                ends = ends + np.int64(late_ns * (self._rate_hz * 1e-9))
            index = ends[:, np.newaxis] + np.arange(-self._length, 0)
            is_there = (index >= 0) & (index < len(self._slots))
            index = np.clip(index, 0, len(slots) - 1)
            valid = slots["valid"][index, channel] & is_there
            age_s = (instants_ns[:, np.newaxis] - slots["measured_ns"][index, channel]) * 1e-9
            values, wrench = slots["values"][index, part], slots["compensated"][index]
            age_s[~valid] = values[~valid] = wrench[~valid] = math.nan
            found |= {name: values, f"{name}_age": age_s.astype(np.float32), f"{name}_valid": valid}
            if self.stream is not None and not channel:
                found[f"{name}_compensated"] = wrench
                found[f"{name}_compensated_valid"] = valid & np.isfinite(wrench).all(axis=2)
        found["imu"] = np.concatenate([found.pop("acceleration"), found.pop("angular_rate")], axis=2)
        return found

    def forget(self, before_ns: int) -> None:
        """What windows of this instant and later ones do not need; without this everything is kept."""
        ends = [int(self._ends(np.array([before_ns]), channel)[0]) for channel in range(3)]
        begin = max(min(ends) - self._length, 0)
        self._slots = self._slots[begin:].copy()

    def take(self, *, rest: bool) -> Array:
        """The slots that nothing that comes later can change, or the rest; they are in no window then."""
        settled = np.array([self.until_ns - self.doubt_ns - 1])
        end = len(self._slots) if rest else int(self._ends(settled, 0)[0])
        taken, self._slots = self._slots[:end], self._slots[end:].copy()
        return taken

    def _ends(self, instants_ns: Ints, channel: int) -> Ints:
        """The slot behind the newest one that was measured before or at each of these instants."""
        measured = np.maximum.accumulate(self._slots["measured_ns"][:, channel])
        return np.searchsorted(measured, instants_ns, "right")
