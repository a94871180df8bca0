"""What a report is about: one sensor's settings and frames, and its new, valid samples on a time axis.

Everything comes from a file or the network: texts are cut to one printable line; settings that are unknown
or invalid are omitted, with a remark. A sample is a frame that is neither REPEATED nor INVALID. Times are
seconds of CLOCK_MONOTONIC since the first frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from bota_clients.recording.columns import Columns
from bota_ethercat.errors import SettingError
from bota_ethercat.framing import DataFlag
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SETTINGS, SettingValue, rate_divisor
from bota_ethercat.text.untrusted import printable, whole

_LONGEST_TEXT: Final = 80
_MOST_REMARKS: Final = 20
_HIGHEST_RATE_HZ: Final = 100_000.0


@dataclass(frozen=True)
class Subject:
    """One sensor and its frames."""

    position: int
    name: str
    serial: int | None
    hardware: str
    firmware: str
    rate_hz: float
    """Nominal, as described; 0 if unknown."""
    settings: Mapping[str, SettingValue]
    """Those that exist and have a valid value."""
    columns: Columns
    source: str
    """A file name or a server's address."""
    age_p99_us: float | None = None
    """Of the samples on arrival; None from a recording, or another machine."""
    remarks: tuple[str, ...] = ()
    """Sentences about the recording for the reader of the report."""

    @property
    def who(self) -> str:
        """Name and serial number."""
        return f"{self.name}, serial {_text(self.serial)}"

    @property
    def sinc_length(self) -> int | None:
        """None if unknown."""
        return self.settings.get("sinc_length")

    @property
    def nominal_period_s(self) -> float | None:
        """From the settings; None if unknown."""
        if self.sinc_length is not None:
            divisor = rate_divisor(self.sinc_length, round(self.rate_hz), self.settings.get("chop"))
            return self.sinc_length * (divisor or 1) / BASE_SAMPLING_RATE_HZ
        return 1 / self.rate_hz if 0 < self.rate_hz <= _HIGHEST_RATE_HZ else None

    def with_remarks(self, remarks: Iterable[str]) -> Subject:
        """The same with more remarks, up to a limit."""
        every = [*self.remarks, *(printable(remark, 300) for remark in remarks)]
        if len(every) > _MOST_REMARKS:
            left_out = len(every) - _MOST_REMARKS
            every = [*every[:_MOST_REMARKS], f"{left_out} more remarks are omitted."]
        return replace(self, remarks=tuple(every))


def known_settings(values: object) -> tuple[dict[str, SettingValue], list[str]]:
    """The settings in `values` that exist, and a remark for each that does not."""
    known: dict[str, SettingValue] = {}
    remarks = []
    if not isinstance(values, Mapping):
        return {}, ["The settings are not known."]
    for name, value in values.items():
        setting = SETTINGS.get(name) if isinstance(name, str) else None
        if setting is None:
            remarks.append(f"The unknown setting {printable(name, 40)!r} was ignored.")
            continue
        try:
            known[setting.name] = setting.check(value)
        except SettingError as error:
            remarks.append(f"A setting was ignored: {printable(error)}.")
    return known, remarks


def subject(
    description: Mapping[str, Any], settings: object, columns: Columns, source: str, position: int
) -> Subject:
    """The sensor that one row of a reply to `describe` describes."""
    known, remarks = known_settings(settings)
    return Subject(
        position=position,
        name=_text(description.get("name")),
        serial=whole(description.get("serial")),
        hardware=_text(description.get("hardware")),
        firmware=_text(description.get("firmware")),
        rate_hz=_rate(description.get("rate_hz")),
        settings=known,
        columns=columns,
        source=printable(source),
    ).with_remarks(remarks)


def _rate(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value <= _HIGHEST_RATE_HZ else 0.0


def _text(value: object) -> str:
    return "not known" if value is None or value == "" else printable(value, _LONGEST_TEXT)


SHORT_SINC: Final = 51
LONG_SINC: Final = 1024
"""The two lengths for which limits are published."""
_IMU_LIMIT: Final = 0.1


class Group(NamedTuple):
    """Three channels of one kind; the name is that of the array in `columns.Columns`."""

    name: str
    title: str
    unit: str
    saturation: str
    """The array with its saturation bits."""
    first_bit: int

    @property
    def is_imu(self) -> bool:
        """Whether the IMU measures it."""
        return self.saturation != "force_torque_saturated"


GROUPS: Final[tuple[Group, ...]] = (
    Group("force", "Force", "N", "force_torque_saturated", 0),
    Group("torque", "Torque", "Nm", "force_torque_saturated", 3),
    Group("acceleration", "Acceleration", "m/s²", "acceleration_saturated", 0),
    Group("angular_rate", "Angular rate", "rad/s", "angular_rate_saturated", 0),
)
FORCE, TORQUE, ACCELERATION, ANGULAR_RATE = GROUPS


class Channel(NamedTuple):
    """One measured quantity."""

    group: Group
    axis: int
    """0, 1, 2 for x, y, z."""
    limit_short: float
    """Noise of a healthy sensor at SINC 51, standard deviation in the group's unit."""
    limit_long: float
    """The same at SINC 1024."""

    @property
    def title(self) -> str:
        """For people: Force z."""
        return f"{self.group.title} {'xyz'[self.axis]}"

    @property
    def bit(self) -> int:
        """Its bit in the saturation field of its group."""
        return 1 << (self.group.first_bit + self.axis)


_LIMITS: Final = (
    (FORCE, (0.6, 0.6, 0.6), (0.1, 0.1, 0.08)),
    (TORQUE, (0.014, 0.014, 0.005), (0.0015, 0.0015, 0.0007)),
    (ACCELERATION, (_IMU_LIMIT,) * 3, (_IMU_LIMIT,) * 3),
    (ANGULAR_RATE, (_IMU_LIMIT,) * 3, (_IMU_LIMIT,) * 3),
)
CHANNELS: Final[tuple[Channel, ...]] = tuple(
    Channel(group, axis, short[axis], long[axis]) for group, short, long in _LIMITS for axis in range(3)
)
"""In the order of `/sensone_sensor_data`: force, torque, acceleration, angular rate."""


def noise_limit(channel: Channel, sinc_length: int) -> float:
    """Noise (standard deviation) below which the channel is healthy at this SINC length.

    Interpolated along the straight line through the two published limits in a log-log plot, as noise falls
    with a power of the averaging length; beyond the two lengths the same line is followed.
    """
    if channel.group.is_imu:
        return channel.limit_short  # the SINC filter is not the IMU's
    power = math.log(channel.limit_long / channel.limit_short) / math.log(LONG_SINC / SHORT_SINC)
    return float(channel.limit_short * (sinc_length / SHORT_SINC) ** power)


def limit_origin(sinc_length: int) -> str:
    """Where the limits of force and torque for this length come from, a sentence."""
    if sinc_length in (SHORT_SINC, LONG_SINC):
        return f"Limits of force and torque: Bota's own test limits for SINC {sinc_length}."
    how = "interpolated between" if SHORT_SINC < sinc_length < LONG_SINC else "extrapolated from"
    return (
        f"Limits of force and torque for SINC {sinc_length} are {how} Bota's own test limits, which are "
        f"published for SINC {SHORT_SINC} and {LONG_SINC} only (a straight line in a log-log plot)."
    )


Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

_LONGER: Final = 1.5
"""An interval of more than this many periods has room for a lost sample."""
_SURELY_LONGER: Final = 2.5
"""One of more than this has lost some whether they are marked or not."""
_SHORT: Final = 0.75
"""An interval shorter than this follows one that a late stamp made too long."""
_COVERED_PERIODS: Final = 4
_COVERED_S: Final = 0.01
"""A frame without a sample tells of a silence as far as this, or `_COVERED_PERIODS`, from a sample, ..."""
_COVERED_BETWEEN_S: Final = 0.1
"""... and as far as this from the next such frame: the server looks less often after a sensor it has lost."""


@dataclass(frozen=True)
class Series:
    """Samples of one subject; n samples."""

    subject: Subject

    @cached_property
    def frames(self) -> Columns:
        """Every frame, also those that are no samples."""
        return self.subject.columns

    @cached_property
    def samples(self) -> Columns:
        """The n samples."""
        return self.frames.where(self.frames.fresh)

    @property
    def count(self) -> int:
        """n."""
        return len(self.samples)

    @cached_property
    def frame_time(self) -> Floats:
        """Of every frame, s since the first."""
        moments = self.frames.monotonic_ns
        return np.asarray((moments - moments[:1]) * 1e-9, np.float64)

    @cached_property
    def time(self) -> Floats:
        """(n,) s since the first frame."""
        return self.frame_time[self.frames.fresh]

    @cached_property
    def duration(self) -> float:
        """From the first frame to the last, s; 0 if there are fewer than two."""
        return float(max(np.ptp(self.frame_time), 0.0)) if len(self.frame_time) else 0.0

    @cached_property
    def values(self) -> Floats:
        """(n, 12): the channels in the order of `CHANNELS`."""
        s = self.samples
        return np.hstack([s.force, s.torque, s.acceleration, s.angular_rate])

    @cached_property
    def finite(self) -> Bools:
        """(n, 12) where a value is a finite number."""
        return np.isfinite(self.values)

    @cached_property
    def saturated(self) -> Bools:
        """(n, 12) where the sensor says that a channel is saturated."""
        return (
            np.column_stack([getattr(self.samples, c.group.saturation) & c.bit != 0 for c in CHANNELS])
            if self.count
            else np.zeros((0, len(CHANNELS)), bool)
        )

    @cached_property
    def intervals(self) -> Floats:
        """(n - 1,) from one sample to the next, s."""
        return np.diff(self.time)

    @cached_property
    def step(self) -> int:
        """One sample in so many was asked of the server (`every`)."""
        jumps = np.diff(self.frames.sequence)
        return max(1, int(np.median(jumps))) if len(jumps) else 1

    @cached_property
    def nominal_period(self) -> float | None:
        """What the settings say of the interval between two samples, s."""
        period = self.subject.nominal_period_s
        return None if period is None else period * self.step

    @cached_property
    def period(self) -> float:
        """The usual interval between two samples, s; what the settings say if there are none."""
        forward = self.intervals[self.intervals > 0]
        return float(np.median(forward)) if len(forward) else self.nominal_period or 1e-3

    @property
    def rate(self) -> float:
        """Hz."""
        return 1 / self.period

    @cached_property
    def silent(self) -> Bools:
        """(n - 1,) whether REPEATED or INVALID frames lie between one sample and the next."""
        return self.others > 0

    @cached_property
    def others(self) -> Ints:
        """(n - 1,) how many REPEATED or INVALID frames that are."""
        return np.diff(np.flatnonzero(self.frames.fresh)) - 1

    @cached_property
    def missing(self) -> Ints:
        """(n - 1,) how many samples are missing between one and the next, beside those of a silent sensor.

        Told by the time that passed and by the mark GAP. A stamp that is late makes one interval long and the
        next one short: that is no loss. Where the sensor was silent, it is the time of which no frame tells.
        """
        wide = self.intervals / self.period
        if not len(wide):
            return np.zeros(0, np.int64)
        following = np.append(wide[1:], 1.0)
        late_stamp = following < _SHORT
        periods = np.where(late_stamp, wide + following - 1, wide)
        missing = np.round(np.clip(periods, 0, 1e12)).astype(np.int64) - 1
        marked = (self.samples.flags[1:] & DataFlag.GAP != 0) | (np.diff(self.samples.sequence) > self.step)
        lost = ((wide > _LONGER) & marked) | (wide > _SURELY_LONGER)
        return np.where(self.silent, self._untold, np.where(lost, np.maximum(missing, 0), 0))

    @cached_property
    def _untold(self) -> Ints:
        """(n - 1,) samples that have room between frames too far apart to tell of a silence."""
        fresh, intervals = self.frames.fresh, np.diff(self.frame_time)
        near = np.where(fresh[:-1] | fresh[1:], _COVERED_S, _COVERED_BETWEEN_S)
        wide = intervals > np.maximum(near, _COVERED_PERIODS * self.period)
        room = np.round(np.clip(intervals / self.period, 0, 1e12)).astype(np.int64) - 1
        summed = np.concatenate(([0], np.cumsum(np.where(wide, room, 0))))
        return np.diff(summed[np.flatnonzero(fresh)])

    @cached_property
    def broken(self) -> Bools:
        """(n - 1,) whether the samples on either side do not follow one another."""
        return (
            self.silent
            | (self.missing > 0)
            | (self.intervals <= 0)
            | (self.intervals > _SURELY_LONGER * self.period)
        )

    @cached_property
    def imu_off(self) -> bool:
        """Whether the IMU is switched off."""
        return self.subject.settings.get("imu_active") == 0
