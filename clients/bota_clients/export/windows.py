"""The last samples that were measured before an instant: of a recording, or of a stream with the same result.

    windows = Windows(32)
    windows.configure(description["settings"], description["rate_hz"])  # again whenever they change
    windows.take(frames)  # DATA messages of one sensor, in order
    arrays = windows.at([windows.until_ns])

Samples are in slots, one for each period of the sensor; the slot of a lost sample stays empty. A sample was
measured at its stamp less the delay of the filters, and each channel has filters of its own. Instants and
stamps are ns of the server's CLOCK_MONOTONIC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, cast

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.recording.columns import Columns, Ints, decode
from bota_ethercat.client.reading import Delays
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import ImuUnits, Vector3
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import SettingValue, known_settings
from ft_compensation.alignment import align
from ft_compensation.compensator import Compensator
from ft_compensation.quantities import (
    EXACT,
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    Accelerometer,
    Payload,
    Wrench,
    vector,
)
from ft_compensation.specific_force import specific_forces
from ft_compensation.stationary import BAD_WRENCH

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
_CHANNELS: Final = Delays._fields
_PARTS: Final = slice(0, 6), slice(6, 9), slice(9, 12)  # of the values, by channel
_LOST: Final = math.nan


@dataclass(frozen=True)
class Tool:
    """What is subtracted for `force_torque_compensated`."""

    payload: Payload = NO_PAYLOAD
    bias: Wrench = NO_WRENCH
    accelerometer: Accelerometer = EXACT
    imu_position: Vector3 = ZERO  # m from the wrench origin; zeros: by the sensor's model

    @classmethod
    def read(cls, path: Path) -> Self:
        """From parameters of the ROS 2 node, as `ethercat-identify --yaml` writes them; RecordingError."""
        import yaml  # noqa: PLC0415 - of the extra `dataset`

        try:
            with path.open(encoding="utf-8") as file:
                found: Any = yaml.safe_load(file)
            while "ros__parameters" not in found:
                found = next(iter(found.values()))
            found = found["ros__parameters"]
            given = {key.partition(".")[2]: found[key] for key in found if key.startswith("accelerometer.")}
            parts = {name: tuple(map(float, row)) for name, row in given.items()}
            payload = Payload(
                float(found.get("tool_mass", 0.0)),
                vector(found.get("tool_center_of_gravity", ZERO), "tool_center_of_gravity"),
                tuple(map(float, found.get("tool_inertia", NO_PAYLOAD.inertia))),
            )
            bias = Wrench.of(found.get("bias", NO_WRENCH.values))
            position = vector(found.get("imu_position", ZERO), "imu_position")
            return cls(payload, bias, Accelerometer(**cast(Any, parts)), position)
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
        except (yaml.YAMLError, AttributeError, StopIteration, TypeError, ValueError) as error:
            why = " ".join(str(error).split())
            raise RecordingError(
                f"{path} does not have a tool's parameters, as ethercat-identify --yaml writes them: {why}"
            ) from None


class _Slots(NamedTuple):
    """n slots, oldest first; values of an empty one are NaN."""

    monotonic_ns: Array  # (n,) stamp of the sample; of an empty slot by its place between two samples
    measured_ns: Array  # (n, 3) when each channel was measured
    values: Array  # (n, 12) force, torque, acceleration, angular rate: N, Nm, m/s², rad/s
    valid: Array  # (n, 3) whether each channel was measured
    compensated: Array  # (n, 6) N, Nm; NaN where it is not known

    def cut(self, begin: int) -> _Slots:
        return _Slots(*(part[begin:] for part in self))

    def plus(self, other: _Slots) -> _Slots:
        return _Slots(*map(np.concatenate, zip(self, other, strict=True)))


_NONE: Final = _Slots(
    np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 12)), np.zeros((0, 3), bool),
    np.zeros((0, 6)),
)  # fmt: skip


class Windows:
    """The newest samples of one sensor, and windows of them. For instants that ascend.

    Attributes:
        begin_ns: when the first sample was stamped; -1 before it.
    """

    def __init__(
        self,
        length: int,
        *,
        hold: bool = False,
        tool: Tool | None = None,
        imu_units: ImuUnits = ImuUnits.G_DPS,
    ) -> None:
        """Of `length` samples. With a `tool` there is a compensated wrench.

        `hold`: an empty slot has value and age of the last valid one of its window, instead of NaN.
        """
        self.begin_ns = -1
        self._length, self._hold, self._tool, self._units = length, hold, tool, imu_units
        self._slots = _NONE
        self._run = 0  # the slot with which the settings in force begin
        self._newest, self._gap = (0, 0), False  # stamp and sequence of the newest sample; GAP since
        self._in_force: tuple[Mapping[str, object], float] | None = None

    def configure(self, settings: Mapping[str, object], rate_hz: float, name: str = "") -> None:
        """Settings and rate of the frames that follow, as `describe` has them; RecordingError if of no use.

        `name` is the sensor's.
        """
        if (settings, rate_hz) == self._in_force:
            return
        if not rate_hz:
            raise RecordingError("the sampling rate is not known, so lost samples have no place")
        self._in_force, self._rate_hz, self._run = (settings, rate_hz), rate_hz, len(self._slots.valid)
        known = known_settings(settings)
        delays = Delays.parse(delays_ms(known, rate_hz))
        # Where a delay is unknown, a sample counts as measured only when it was stamped: never too early.
        self._delay_ns = np.array([delay or 0 for delay in delays])
        self._has_imu = known.get("imu_active") != 0
        self._alignment = align(known, rate_hz)
        # As many slots are kept for the compensation, and at either end of a longer gap.
        self._tail = self._alignment.taps.shape[1] + math.ceil(self._alignment.gap_s * rate_hz)
        self._edge = max(self._length, self._tail)
        if self._tool is None:
            return
        (cx, cy, cz), position = self._tool.payload.center, self._tool.imu_position
        x, y, z = position if any(position) else (0.0, 0.0, IMU_HEIGHTS.get(name[4:8], 0.0))
        self._lever = cx - x, cy - y, cz - z
        wrong: dict[str, SettingValue] = {"calibration_matrix": False}
        if self._tool.payload.mass:
            wrong |= {"inertia_compensation": True, "coordinate_system": True, "imu_active": 0}
        for setting, value in wrong.items():
            if known.get(setting) == value:
                raise RecordingError(
                    f"the wrench cannot be compensated: {setting} was {str(value).lower()}; leave out --tool"
                )

    @property
    def until_ns(self) -> int:
        """The last instant of which nothing that comes later can be a part; -1 before the first sample."""
        measured = self._slots.measured_ns
        return int(measured.max(axis=0).min()) if len(measured) else -1

    def take(self, frames: Sequence[DataMessage]) -> Columns:
        """Take the next frames of the sensor, also REPEATED and INVALID ones; decoded. RecordingError."""
        table = decode(frames, self._units)
        # GAP of a frame that brings no sample is that of the next sample.
        gaps = np.cumsum(np.append(self._gap, table.flags & int(DataFlag.GAP) != 0))
        at = np.flatnonzero(table.fresh)
        self._gap = bool(gaps[-1] > (gaps[at[-1] + 1] if len(at) else 0))
        if not len(at):
            return table
        samples = table.where(table.fresh)
        stamps, sequence = samples.monotonic_ns, samples.sequence
        if self.begin_ns < 0:
            self.begin_ns = int(stamps[0])
            self._newest = int(stamps[0]), int(sequence[0]) - 1
        passed = np.diff(stamps, prepend=self._newest[0])
        if (passed[int(self.begin_ns == stamps[0]) :] <= 0).any():
            raise RecordingError("the server's machine was restarted meanwhile: record again")
        broken = (np.diff(gaps[at + 1], prepend=0) > 0) | (np.diff(sequence, prepend=self._newest[1]) != 1)
        room = np.rint(passed * (self._rate_hz * 1e-9)).astype(np.int64) - 1
        self._newest = int(stamps[-1]), int(sequence[-1])
        self._append(samples, passed, np.where(broken, np.maximum(room, 0), 0))
        return table

    def _append(self, samples: Columns, passed: Ints, lost: Ints) -> None:
        """Samples, each `passed` ns after the one before, with so many `lost` in between."""
        kept = np.minimum(lost, 2 * self._edge)
        end = np.cumsum(kept + 1) - 1  # where each sample is
        of = np.repeat(np.arange(len(end)), kept + 1)
        number = np.arange(end[-1] + 1) - (end - kept)[of] + 1  # in its gap, from 1
        number += np.where(number > self._edge, (lost - kept)[of], 0)
        since_ns = np.rint(passed[of] * (number / (lost[of] + 1))).astype(np.int64)
        stamps = (samples.monotonic_ns - passed)[of] + since_ns
        values = np.full((len(of), 12), _LOST)
        values[end] = np.hstack([samples.force, samples.torque, samples.acceleration, samples.angular_rate])
        values[~np.isfinite(values)] = _LOST
        valid = np.zeros((len(of), 3), bool)
        wrong = (
            samples.force_torque_saturated | samples.warnings & int(BAD_WRENCH),
            samples.acceleration_saturated | (not self._has_imu),
            samples.angular_rate_saturated | (not self._has_imu),
        )
        valid[end] = np.column_stack(wrong) == 0
        for channel, part in enumerate(_PARTS):
            valid[:, channel] &= np.isfinite(values[:, part]).all(axis=1)
        old = len(self._slots.valid)
        empty = np.full((len(of), 6), _LOST)
        slots = self._slots = self._slots.plus(
            _Slots(stamps, stamps[:, np.newaxis] - self._delay_ns, values, valid, empty)
        )
        if self._tool is not None:
            begin = max(self._run, old - self._tail)
            slots.compensated[old:] = self._compensate(slots.cut(begin), self._tool)[old - begin :]

    def _compensate(self, slots: _Slots, tool: Tool) -> Array:
        """(n, 6) N, Nm."""
        imu = slots.values[:, 6:].copy()
        felt = turning = rising = np.zeros((len(imu), 3))
        if tool.payload.mass:
            imu[:, :3] = np.column_stack(tool.accelerometer.correct(cast(Vector3, tuple(imu[:, :3].T))))
            imu[~slots.values[:, 6:9].any(axis=1)] = _LOST  # it is off
            times = slots.monotonic_ns * 1e-9
            felt, turning, rising = specific_forces(imu, times, self._alignment, self._lever)
        force, torque = slots.values[:, :3].T, slots.values[:, 3:6].T
        compensate = cast(Any, Compensator(tool.payload, tool.bias).compensate)  # of arrays as of numbers
        stages = compensate(force, torque, felt.T, (turning.T, rising.T))
        return np.vstack(stages.final).T

    def at(self, instants_ns: Ints) -> Arrays:
        """Windows of these f instants; the last sample of each is the newest.

        `force_torque`, `force_torque_compensated` (f, length, 6) N, Nm; `imu` (f, length, 6) m/s², rad/s;
        of each channel `..._age` (f, length) s before the instant and `..._valid` (f, length). ValueError for
        an instant after `until_ns`.
        """
        if len(instants_ns) and instants_ns[-1] > self.until_ns:
            raise ValueError(
                f"{instants_ns[-1]} ns is after {self.until_ns} ns: its samples are not all here"
            )
        slots, found, imu = self._slots, Arrays(), []
        for channel, (name, part) in enumerate(zip(_CHANNELS, _PARTS, strict=True)):
            index = self._ends(instants_ns, channel)[:, np.newaxis] + np.arange(-self._length, 0)
            is_there, index = index >= 0, np.maximum(index, 0)
            filled = valid = slots.valid[index, channel] & is_there
            if self._hold:
                held = np.maximum.accumulate(np.where(valid, np.arange(self._length), -1), axis=1)
                index, filled = np.take_along_axis(index, held, 1), held >= 0
            age_s = (instants_ns[:, np.newaxis] - slots.measured_ns[index, channel]) * 1e-9
            found[f"{name}_age"] = np.where(filled, age_s, _LOST).astype(np.float32)
            found[f"{name}_valid"] = valid
            values = np.where(filled[:, :, np.newaxis], slots.values[index, part], _LOST).astype(np.float32)
            if channel > 0:
                imu.append(values)
                continue
            found[name] = values
            if self._tool is not None:
                wrench = np.where(filled[:, :, np.newaxis], slots.compensated[index], _LOST)
                found[f"{name}_compensated"] = wrench.astype(np.float32)
                found[f"{name}_compensated_valid"] = valid & np.isfinite(wrench).all(axis=2)
        found["imu"] = np.concatenate(imu, axis=2)
        return found

    def forget(self, before_ns: int) -> None:
        """What windows of this instant and later ones do not need; else everything is kept."""
        if len(self._slots.valid):
            ends = [int(self._ends(np.array([before_ns]), channel)[0]) for channel in range(3)]
            begin = max(min(ends) - self._edge, 0)
            self._slots, self._run = self._slots.cut(begin), max(self._run - begin, 0)

    def _ends(self, instants_ns: Ints, channel: int) -> Ints:
        """The slot behind the newest one that was measured before or at each of these instants."""
        measured = np.maximum.accumulate(self._slots.measured_ns[:, channel])
        return np.searchsorted(measured, instants_ns, "right")
