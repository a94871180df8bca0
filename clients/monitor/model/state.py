"""The state at one moment, frozen: all that a view uses. Times are seconds, ages in µs, values in SI units.

`None` means unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from protocol.health.limits import LIMITS
from protocol.health.verdict import NOTHING_WRONG, Level, Verdict
from protocol.pdo import PDO_FIELDS, Sample
from protocol.settings import SettingValue

WRENCH_FIELDS: Final = tuple(f.name for f in PDO_FIELDS if f.name.startswith(("force.", "torque.")))
"""The six axes of the wrench, as the process data names them."""
AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""The same as people write them."""
SILENT_S: Final = LIMITS.stale_after
"""A server that sends nothing for this time is silent; it normally sends a frame per sample period."""


class Range(NamedTuple):
    """Minimum and maximum."""

    low: float
    high: float


class Spread(NamedTuple):
    """A distribution in µs."""

    p50: float
    worst: float


class Clock(NamedTuple):
    """How the server follows a sensor's sampling clock."""

    mode: str
    """`locked` or `oversampling`."""
    offset_ppm: float | None
    uncertainty_us: float | None


class Alert(NamedTuple):
    """Something the judge of streams found."""

    level: Level
    text: str
    remedy: str
    ago_s: float | None
    """None if present; else the time since it last was."""


class Client(NamedTuple):
    """One client of the server."""

    peer: str
    is_this: bool
    rate_hz: float | None
    """Frames per second sent to it between the last two replies to `status`."""
    sent: int
    withheld: int


class Message(NamedTuple):
    """The latest message for the user."""

    text: str
    bad: bool = False


@dataclass(frozen=True, slots=True)
class StreamState:
    """How one sensor's samples arrive; counts are since connecting."""

    samples: int = 0
    rate_hz: float | None = None
    jitter_us: float | None = None
    """Standard deviation of the intervals between the stamps of samples that follow one another."""
    jitter_worst_us: float | None = None
    """The interval furthest from the mean one."""
    age_us: Spread | None = None
    """Age of a sample on arrival; only on the server's own machine."""
    missed: int = 0
    """Frames that the server numbered and that did not come here."""
    gaps: int = 0
    """Frames marked GAP."""
    repeated: int = 0
    invalid: int = 0
    silent_s: float | None = None
    """Time since the last new sample; None if there was none."""


@dataclass(frozen=True, slots=True)
class SensorState:
    """One sensor."""

    position: int
    name: str = ""
    serial: int | None = None
    firmware: str = ""
    al_state: str = ""
    nominal_hz: float | None = None
    raw_counts: bool = False
    """Force and torque are counts, not N and Nm: the calibration matrix is off."""
    imu_off: bool = False
    sample: Sample | None = None
    old_s: float | None = None
    """Age of its values if they are stale."""
    peaks: tuple[Range, ...] | None = None
    """Of the six axes since the reset; every sample counts."""
    traces: tuple[tuple[Range | None, ...], ...] = ((),) * len(AXES)
    """Of the six axes, oldest first: a range per time step, None without samples."""
    saturated: frozenset[str] = frozenset()
    """The axes that are saturated now."""
    verdict: Verdict = NOTHING_WRONG
    """On the last second."""
    alerts: tuple[Alert, ...] = ()
    """Present ones first, then the latest."""
    stream: StreamState = field(default_factory=StreamState)
    clock: Clock | None = None
    bus_lost: int | None = None
    """Samples lost on the bus since the server's start."""
    recoveries: int | None = None
    hand_out_us: Spread | None = None
    """Age of the samples when the server hands them out, last ten seconds."""
    settings: Mapping[str, SettingValue] = field(default_factory=dict)
    """Those that `describe` has."""

    @property
    def units(self) -> tuple[str, str]:
        """Of force and of torque."""
        return ("counts", "counts") if self.raw_counts else ("N", "Nm")


@dataclass(frozen=True, slots=True)
class ServerState:
    """The server."""

    address: str
    connected: bool = False
    since_s: float | None = None
    """Time since it was connected or disconnected."""
    since_clock: str = ""
    """The time of day of that."""
    reason: str = ""
    """Why it is not connected: one sentence."""
    heard_s: float | None = None
    """Time since anything came from it, while connected."""
    version: str = ""
    replay: str = ""
    """What it replays; empty if it has sensors."""
    uptime_s: float | None = None
    cycles: int | None = None
    missed_deadlines: int | None = None
    lost_frames: int | None = None
    wake_us: Spread | None = None
    """Wake-up lateness of its loop: p50 and p99 of the last ten seconds."""
    exchange_us: Spread | None = None
    """How long an exchange on the bus took: the same."""

    @property
    def silent(self) -> bool:
        """Whether it is connected but sends nothing."""
        return self.heard_s is not None and self.heard_s >= SILENT_S


@dataclass(frozen=True, slots=True)
class State:
    """Everything."""

    server: ServerState
    sensors: tuple[SensorState, ...] = ()
    clients: tuple[Client, ...] = ()
    message: Message | None = None
    events: tuple[str, ...] = ()
    """The server's latest events in words, oldest first."""
