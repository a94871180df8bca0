"""What the monitor knows of the server and its sensors.

One thread feeds a `Model`, another takes its `State`; a lock protects it. Methods take the time as an
argument, but for the time of day. In states, times are seconds, ages µs, values SI units; None means unknown.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from bota_ethercat.control import event_sentence
from bota_ethercat.framing import DataMessage
from bota_ethercat.health import sentences
from bota_ethercat.health.judge import judge, saturated_axes
from bota_ethercat.health.limits import LIMITS, NOTHING_WRONG, Finding, Level, Verdict
from bota_ethercat.health.observer import COMMON, StreamObserver, by_sensor
from bota_ethercat.pdo import PDO_FIELDS, ImuUnits, Sample, SampleDecoder
from bota_ethercat.replies import (
    Description,
    DistributionStatus,
    SensorInfo,
    SensorStatus,
    Status,
)
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import mapping, text

if TYPE_CHECKING:  # NumPy is loaded only where there is a tool
    from bota_clients.monitor.compensated import Compensated, NewestCompensated

SILENT_S: Final = LIMITS.stale_after  # a server normally sends a frame per sample period
_WRENCH: Final = tuple(COMMON.index(f.name) for f in PDO_FIELDS if f.name.startswith(("force.", "torque.")))
_WINDOW_NS: Final = 5 * 10**9  # of rate, jitter and age
_JUDGED_NS: Final = 10**9  # of a verdict
_MESSAGE_S: Final = 30.0


class Range(NamedTuple):
    low: float
    high: float


class Percentiles(NamedTuple):
    """A distribution in µs: its median, and p99 or the worst, as `which` says."""

    p50: float
    high: float
    which: str = "p99"


class Alert(NamedTuple):
    """A finding on a stream; `ago_s` is None if it is present, else the time since it last was."""

    level: Level
    text: str
    remedy: str
    ago_s: float | None


class ServerClient(NamedTuple):
    """A client of the server; its rate is that of the frames sent to it between two replies to `status`."""

    peer: str
    this: bool
    rate_hz: float | None
    sent: int
    withheld: int


class Message(NamedTuple):
    text: str
    bad: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorView:
    """One sensor. Counts are since connecting, rate, jitter and age are those of the last five seconds."""

    position: int
    info: SensorInfo
    status: SensorStatus
    al_state: str = ""
    sample: Sample | None = None
    old_s: float | None = None  # age of its values if they are stale
    peaks: tuple[Range, ...] | None = None  # of the six axes since the reset; every sample counts
    saturated: frozenset[str] = frozenset()
    verdict: Verdict = NOTHING_WRONG  # on the last second
    alerts: tuple[Alert, ...] = ()  # present ones first, then the latest
    samples: int = 0
    rate_hz: float | None = None
    jitter_us: float | None = None  # standard deviation of the intervals between stamps
    jitter_worst_us: float | None = None  # the interval furthest from the mean one
    age_us: Percentiles | None = None  # on arrival; only on the server's own machine
    missed: int = 0  # frames that the server numbered and that did not come
    gaps: int = 0
    repeated: int = 0
    invalid: int = 0
    silent_s: float | None = None  # since the last new sample
    hand_out_us: Percentiles | None = None  # age when the server hands them out
    zero: str = ""  # its drift, in words
    compensated: Compensated | None = None  # of the newest sample, with a tool
    not_compensated: str = ""  # why not, a sentence

    @property
    def units(self) -> tuple[str, str]:
        """Of force and of torque: counts if the calibration matrix is off."""
        return ("counts", "counts") if self.info.settings.get("calibration_matrix") is False else ("N", "Nm")

    @property
    def imu_off(self) -> bool:
        return self.info.settings.get("imu_active") == 0

    @property
    def delay_ms(self) -> dict[str, float | None]:
        """Of the filters in effect, by channel; as `describe` has it, also where a recording has not."""
        return delays_ms(self.info.settings, self.info.rate_hz or None)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerState:
    address: str
    connected: bool = False
    since_s: float | None = None  # since it was connected or disconnected
    reason: str = ""  # why it is not connected: one sentence
    heard_s: float | None = None  # since anything came from it, while connected
    version: str = ""
    replay: str = ""  # what it replays; empty if it has sensors
    uptime_s: float | None = None
    status: Status = field(default_factory=Status)
    wake_us: Percentiles | None = None
    exchange_us: Percentiles | None = None

    @property
    def silent(self) -> bool:
        """Whether it is connected but sends nothing."""
        return self.heard_s is not None and self.heard_s >= SILENT_S


@dataclass(frozen=True, slots=True)
class State:
    """Everything, at one moment."""

    server: ServerState
    sensors: tuple[SensorView, ...] = ()
    clients: tuple[ServerClient, ...] = ()
    message: Message | None = None
    events: tuple[str, ...] = ()  # in words, oldest first


class _Sensor:
    """One sensor, judged whenever something arrives: no finding between two refreshes is missed."""

    def __init__(self, position: int, imu_units: ImuUnits, compensated: NewestCompensated | None) -> None:
        self.position, self.compensated = position, compensated
        # Lowest and highest of each axis since the reset; empty of one that was never finite.
        self.peaks: tuple[tuple[float, ...], ...] | None = None
        self._imu_units = imu_units
        self.observer = StreamObserver(0.0, 0, window_ns=_WINDOW_NS)
        self._hand_out = DistributionStatus()
        self._begins = True  # nothing has been told since it was connected
        self._newest: bytes | None = None
        self._verdict = NOTHING_WRONG
        self._saturated: frozenset[str] = frozenset()
        self._now: list[Finding] = []
        self._seen: dict[str, tuple[Finding, float]] = {}  # since the reset, each at its worst, and when last

    def reset(self) -> None:
        self.peaks, self._seen = None, {}
        self.observer.forget()

    def connected(self, now_s: float) -> None:
        """A connection was made: nothing before its first frame counts as lost."""
        self.observer.connected(_ns(now_s))
        self._begins = True

    def tell(self, now: InForce, now_s: float) -> None:
        """What is in force from here on."""
        was, self.observer.in_force = self.observer.in_force, now
        is_other = now.info.identity != was.info.identity
        if is_other and was.is_described:
            self.reset()
            self._newest = None
        elif now.info.offset != was.info.offset:  # the zero has moved
            self.peaks = None
        if self._begins or is_other or now.info.rate_hz != was.info.rate_hz:
            self.observer.begin(now.info.rate_hz, _ns(now_s))
        if self.compensated is not None and (self._begins or is_other):
            self.compensated.begin()
        self._begins = False

    def add_status(self, status: Status, now_s: float) -> None:
        self.observer.add_status(status, self.position, _ns(now_s))
        self._hand_out = status.recent_age_us(self.position)

    def add_frames(self, frames: Sequence[DataMessage], now_s: float) -> None:
        samples = self.observer.add_frames(frames, _ns(now_s))
        if self.compensated is not None:
            self.compensated.add(frames, self.observer.in_force)
        self._judge(now_s)
        if not samples:
            return
        self._newest = self.observer.newest
        columns = list(zip(*samples, strict=True))
        before = self.peaks or ((),) * len(_WRENCH)
        self.peaks = tuple(_range([*was, *columns[i]]) for was, i in zip(before, _WRENCH, strict=True))

    def _judge(self, now_s: float) -> None:
        seen, lost = self.observer.observation(_ns(now_s), _JUDGED_NS), self.observer.in_force.lost
        self._verdict = judge(seen)
        self._saturated = frozenset(axis for axes in saturated_axes(seen).values() for axis in axes)
        self._now = []
        for finding in self._verdict.findings:
            if lost is not None and finding.key == "silence":
                # The server's words of why it has lost the sensor may say what to do.
                why = lost if "check " in lost else f"{finding.remedy} ({lost})"
                finding = finding._replace(remedy=why)  # noqa: PLW2901
            self._now.append(finding)
            known, _ = self._seen.get(finding.key, (finding, 0.0))
            worst = max(finding, known, key=lambda one: (one.level, one.size))
            self._seen[finding.key] = worst, now_s

    def state(self, now_s: float, *, server_speaks: bool) -> SensorView:
        """The current state. Silence is the sensor's fault only if the server is not silent."""
        if server_speaks:
            self._judge(now_s)
        now = self._now if server_speaks else []
        keys = {finding.key for finding in now}
        latest = sorted(self._seen.items(), key=lambda entry: -entry[1][1])
        alerts = [Alert(finding.level, finding.found, finding.remedy, None) for finding in now]
        alerts += [
            Alert(finding.level, finding.found, finding.remedy, now_s - at_s)
            for key, (finding, at_s) in latest
            if key not in keys
        ]
        (info, lost, *_), status = self.observer.in_force, self.observer.status
        sample = self._newest and SampleDecoder(len(self._newest), self._imu_units).decode(self._newest)
        return SensorView(
            position=self.position,
            info=info,
            status=status,
            al_state="LOST" if lost is not None else info.state,
            sample=sample or None,
            peaks=tuple(Range(*(each or (0.0, 0.0))) for each in self.peaks) if self.peaks else None,
            saturated=self._saturated,
            verdict=self._verdict,
            alerts=tuple(alerts),
            hand_out_us=_percentiles(self._hand_out),
            zero=sentences.drift(status),
            compensated=None if self.compensated is None else self.compensated.latest,
            not_compensated=self.compensated.problem if self.compensated else "",
            **self._stream(_ns(now_s)),
        )

    def _stream(self, now_ns: int) -> dict[str, Any]:
        """How its samples arrive."""
        observer, counts = self.observer, self.observer.counts
        found: dict[str, Any] = {
            "samples": counts.new, "missed": counts.withheld, "gaps": counts.gaps,
            "repeated": counts.repeated, "invalid": counts.invalid,
        }  # fmt: skip
        if observer.newest is not None:
            seen, silent_s = observer.observation(now_ns), observer.silent_s(now_ns)
            # By the stamps; once they stop coming, by the clock here.
            silent = silent_s >= SILENT_S
            rate_hz = seen.samples / seen.seconds if silent and seen.seconds else seen.rate_hz
            found |= {"rate_hz": rate_hz, "silent_s": silent_s, "old_s": silent_s if silent else None}
        if jitter := observer.jitter_us(now_ns):
            found["jitter_us"], found["jitter_worst_us"] = jitter
        if ages := sorted(observer.ages_us(now_ns)):
            found["age_us"] = Percentiles(ages[len(ages) // 2], ages[-1], "worst")
        return found


class Model:
    """Takes everything that the server sends."""

    def __init__(
        self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS,
        compensated: Callable[[], NewestCompensated] | None = None,
    ) -> None:  # fmt: skip
        """`compensated` makes what compensates the samples of a sensor."""
        self._lock = threading.Lock()
        self._imu_units, self._compensated = imu_units, compensated
        self._sensors: dict[int, _Sensor] = {}
        self._server = ServerState(address=address)  # what does not depend on the time
        self._since_s: float | None = None
        self._own_peer = ""
        self._heard_s = 0.0
        self._read_s = math.inf  # when somebody looked last whether anything had come
        self._status = Status()
        self._status_s = 0.0
        self._clients: tuple[ServerClient, ...] = ()
        self._message: Message | None = None
        self._message_ends_s = 0.0  # 0: it has not been shown yet
        self._events: deque[str] = deque(maxlen=8)

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        """Connected; `own_peer` is the address of this end, as in `status`."""
        with self._lock:
            self._server = replace(self._server, connected=True, reason="")
            self._since_s = self._heard_s = now_s
            self._own_peer, self._status, self._clients = own_peer, Status(), ()
            self._describe(description, now_s)

    def tell(self, in_force: InForce, now_s: float) -> None:
        """What is in force for the sensor's frames from here on."""
        with self._lock:
            if (sensor := self._sensors.get(in_force.sensor)) is not None:
                sensor.tell(in_force, now_s)

    def gone(self, reason: str, now_s: float) -> None:
        """Disconnected, for this reason."""
        with self._lock:
            if self._server.connected or self._since_s is None:
                self._since_s = now_s
            self._server = replace(self._server, connected=False, reason=text(reason))
            self._clients = ()

    def add_frames(self, frames: Sequence[DataMessage], now_s: float) -> None:
        with self._lock:
            if frames:
                self._heard_s = now_s
            for position, of_one in by_sensor(frames).items():
                if position in self._sensors:
                    self._sensors[position].add_frames(of_one, now_s)

    def note_unread(self, seconds: float, busy: bool, now_s: float) -> None:
        """The frames that come next were not read for so long; see `ServerClient.take_unread`."""
        with self._lock:
            self._read_s = now_s
            if seconds >= SILENT_S:
                for sensor in self._sensors.values():
                    sensor.observer.note_unread((seconds, busy), _ns(now_s))

    def note_age(self, frame: DataMessage, now_ns: int) -> None:
        """This frame arrived exactly at this CLOCK_MONOTONIC."""
        with self._lock:
            if frame.sensor in self._sensors:
                self._sensors[frame.sensor].observer.note_age(frame, now_ns)

    def add_status(self, reply: JsonObject, now_s: float) -> None:
        status = Status.parse(reply)
        with self._lock:
            self._heard_s = now_s
            for sensor in self._sensors.values():
                sensor.add_status(status, now_s)
            seconds, before = now_s - self._status_s, {client.peer: client.sent for client in self._clients}
            clients = []
            for row in status.clients:
                peer, sent = row.peer, row.sent or 0
                rate = (sent - before[peer]) / seconds if peer in before and seconds > 0 else None
                clients.append(ServerClient(peer, peer == self._own_peer, rate, sent, row.withheld or 0))
            self._clients = tuple(sorted(clients, key=lambda c: (not c.this, -c.withheld, -c.sent)))
            self._status, self._status_s = status, now_s

    def add_event(self, event: JsonObject, now_s: float) -> None:
        with self._lock:
            self._heard_s = now_s
            self._events.append(f"{clock_text()} {event_sentence(event)}")

    def reset(self) -> None:
        with self._lock:
            for sensor in self._sensors.values():
                sensor.reset()

    def say(self, message: str, bad: bool = False) -> None:
        """Set the message for the user, with the time of day."""
        with self._lock:
            self._message, self._message_ends_s = Message(f"{clock_text()} {text(message)}", bad), 0.0

    def state(self, now_s: float) -> State:
        with self._lock:
            self._message_ends_s = self._message_ends_s or now_s + _MESSAGE_S
            if now_s > self._message_ends_s:
                self._message = None
            status, connected = self._status, self._server.connected
            recent, up_s = status.last_10s, status.uptime_s
            server = replace(
                self._server,
                since_s=None if self._since_s is None else now_s - self._since_s,
                heard_s=max(min(now_s, self._read_s) - self._heard_s, 0.0) if connected else None,
                uptime_s=up_s + now_s - self._status_s if up_s is not None and connected else up_s,
                status=status,
                wake_us=_percentiles(recent.wake_us) or _percentiles(status.wake_us),
                exchange_us=_percentiles(recent.exchange_us) or _percentiles(status.exchange_us),
            )
            speaks = server.connected and not server.silent
            sensors = [self._sensors[position] for position in sorted(self._sensors)]
            return State(
                server,
                tuple(sensor.state(now_s, server_speaks=speaks) for sensor in sensors),
                self._clients,
                self._message,
                tuple(self._events),
            )

    def _describe(self, description: JsonObject, now_s: float) -> None:
        replay = description.get("replay")
        files = mapping(replay).get("files")
        name = text(files[0]) if isinstance(files, list) and files else "a recording"
        replayed = name if isinstance(replay, dict) else ""
        known = Description.parse(description)
        self._server = replace(self._server, version=known.version, replay=replayed)
        before, self._sensors = self._sensors, {}
        for info in known.sensors:
            sensor = before.get(info.sensor) or _Sensor(
                info.sensor, self._imu_units, self._compensated and self._compensated()
            )
            self._sensors[info.sensor] = sensor
            sensor.connected(now_s)


def clock_text() -> str:
    return time.strftime("%H:%M:%S")


def _range(column: Sequence[float]) -> tuple[float, ...]:
    if not math.isfinite(sum(column)):
        column = [value for value in column if math.isfinite(value)]
    return (min(column), max(column)) if column else ()


def _percentiles(known: DistributionStatus) -> Percentiles | None:
    """A distribution in a reply to `status`; None if it is not known."""
    return None if known.p50 is None or known.p99 is None else Percentiles(known.p50, known.p99)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
