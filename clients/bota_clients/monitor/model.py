"""What the monitor knows of the server and its sensors.

One thread feeds a `Model`, another takes its `State`; a lock protects it. Methods take the time as an
argument, but for the time of day. In states, times are seconds, ages µs, values SI units; None means unknown.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

from bota_ethercat.control import Event
from bota_ethercat.framing import DataMessage
from bota_ethercat.health import history
from bota_ethercat.health.judge import Observation, emergency, judge, saturated_axes
from bota_ethercat.health.observer import COMMON, StreamObserver, by_sensor
from bota_ethercat.health.sentences import event_sentence
from bota_ethercat.health.verdict import LIMITS, NOTHING_WRONG, Finding, Level, Verdict
from bota_ethercat.pdo import PDO_FIELDS, ImuUnits, Sample, SampleDecoder
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import SETTINGS, SettingValue
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import mapping, number, rows, text, whole

SILENT_S: Final = LIMITS.stale_after  # a server normally sends a frame per sample period
_WRENCH: Final = tuple(COMMON.index(f.name) for f in PDO_FIELDS if f.name.startswith(("force.", "torque.")))
_WINDOW_NS: Final = 5 * 10**9  # of rate, jitter and age
_JUDGED_NS: Final = 10**9  # of a verdict
_JUDGED_S: Final = _JUDGED_NS * 1e-9
_MESSAGE_S: Final = 30.0


class Range(NamedTuple):
    """Minimum and maximum."""

    low: float
    high: float


class Spread(NamedTuple):
    """A distribution in µs: its median, and p99 or the worst, as `which` says."""

    p50: float
    high: float
    which: str = "p99"


class Clock(NamedTuple):
    """How the server follows a sensor's sampling clock: `locked` or `oversampling`."""

    mode: str
    offset_ppm: float | None
    uncertainty_us: float | None


class Alert(NamedTuple):
    """A finding on a stream; `ago_s` is None if it is present, else the time since it last was."""

    level: Level
    text: str
    remedy: str
    ago_s: float | None


class Client(NamedTuple):
    """A client of the server; its rate is that of the frames sent to it between two replies to `status`."""

    peer: str
    this: bool
    rate_hz: float | None
    sent: int
    withheld: int


class Message(NamedTuple):
    """The latest message for the user."""

    text: str
    bad: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorState:
    """One sensor. Counts are since connecting, rate, jitter and age are those of the last five seconds."""

    position: int
    name: str = ""
    serial: int | None = None
    firmware: str = ""
    al_state: str = ""
    nominal_hz: float | None = None
    settings: Mapping[str, SettingValue] = field(default_factory=dict)
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
    age_us: Spread | None = None  # on arrival; only on the server's own machine
    missed: int = 0  # frames that the server numbered and that did not come
    gaps: int = 0
    repeated: int = 0
    invalid: int = 0
    silent_s: float | None = None  # since the last new sample
    clock: Clock | None = None
    lost_on_bus: int | None = None
    recoveries: int | None = None
    hand_out_us: Spread | None = None  # age when the server hands them out
    zero: str = ""  # its drift, in words

    @property
    def units(self) -> tuple[str, str]:
        """Of force and of torque: counts if the calibration matrix is off."""
        return ("counts", "counts") if self.settings.get("calibration_matrix") is False else ("N", "Nm")

    @property
    def imu_off(self) -> bool:
        """Whether the IMU is off."""
        return self.settings.get("imu_active") == 0

    @property
    def delay_ms(self) -> dict[str, float | None]:
        """Of the filters in effect, by channel; as `describe` has it, also where a recording has not."""
        return delays_ms(self.settings, self.nominal_hz)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerState:
    """The server."""

    address: str
    connected: bool = False
    since_s: float | None = None  # since it was connected or disconnected
    since_clock: str = ""  # the time of day of that
    reason: str = ""  # why it is not connected: one sentence
    heard_s: float | None = None  # since anything came from it, while connected
    version: str = ""
    replay: str = ""  # what it replays; empty if it has sensors
    uptime_s: float | None = None
    cycles: int | None = None
    missed_deadlines: int | None = None
    lost_frames: int | None = None
    wake_us: Spread | None = None
    exchange_us: Spread | None = None

    @property
    def silent(self) -> bool:
        """Whether it is connected but sends nothing."""
        return self.heard_s is not None and self.heard_s >= SILENT_S


@dataclass(frozen=True, slots=True)
class State:
    """Everything, at one moment."""

    server: ServerState
    sensors: tuple[SensorState, ...] = ()
    clients: tuple[Client, ...] = ()
    message: Message | None = None
    events: tuple[str, ...] = ()  # in words, oldest first


class _Sensor:
    """One sensor, judged whenever something arrives: no finding between two refreshes is missed."""

    def __init__(self, position: int, imu_units: ImuUnits) -> None:
        self.position = position
        self.lost: str | None = None  # why the server has lost it, if it has
        self.peaks: tuple[Range, ...] | None = None
        self._imu_units = imu_units
        self.observer = StreamObserver(0.0, 0, window_ns=_WINDOW_NS)
        self._row: JsonObject = {}
        self._status: JsonObject = {}
        self._hand_out: Any = None
        self._newest: bytes | None = None
        self._verdict = NOTHING_WRONG
        self._saturated: frozenset[str] = frozenset()
        self._now: list[Finding] = []
        self._seen: dict[str, tuple[Finding, float]] = {}  # since the reset, each at its worst, and when last
        self.unread = 0.0, False, -math.inf  # the latest that matters of `Client.take_unread`, and when
        self._grown: dict[str, tuple[int, float]] = {}  # by how much counts of `status` last grew, and when
        self._emergency = "", 0.0
        self._emergencies: int | None = 0  # how many there were when `_emergency` was the last

    def reset(self) -> None:
        """Reset peaks and past warnings."""
        self.peaks = None
        self._seen, self._grown, self._emergency = {}, {}, ("", 0.0)
        self.observer.forget()

    def describe(self, row: JsonObject, now_s: float, *, anew: bool) -> None:
        """Take its row of `describe`; `anew`: after connecting; nothing before counts as lost."""
        before, self._row = self._row, row
        if anew:
            self.lost, self._status, self.observer = None, {}, StreamObserver(0.0, 0, window_ns=_WINDOW_NS)
            if before:
                self._grown["reconnects"] = 1, now_s
        if before and row.get("serial") != before.get("serial"):
            self.reset()
            self._newest = None
        if anew or not before or any(row.get(name) != before.get(name) for name in ("rate_hz", "serial")):
            self.observer.begin(number(row.get("rate_hz")) or 0.0, _ns(now_s))

    def take_status(self, row: JsonObject, hand_out: Any, missed_deadlines: Any, now_s: float) -> None:
        """Take its row of `status`, the distribution of ages at hand-out, and what its server missed."""
        row = {**row, "missed_deadlines": missed_deadlines}
        for name in ("not_finite", "recoveries", "missed_deadlines"):
            before, after = whole(self._status.get(name)), whole(row.get(name))
            if before is not None and after is not None and after > before:
                self._grown[name] = after - before, now_s
        count, last = whole(row.get("emergencies")), row.get("emergency")
        if count != self._emergencies and isinstance(last, dict):
            self._emergencies = count
            self._emergency = emergency(last), now_s - (number(last.get("ago_s")) or 0.0)
        self._status, self._hand_out = row, hand_out

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """Frames of this sensor as they came, oldest first."""
        samples = self.observer.take(frames, _ns(now_s))
        self._judge(now_s)
        if not samples:
            return
        self._newest = self.observer.newest
        columns = list(zip(*samples, strict=True))
        before = self.peaks or ((),) * len(_WRENCH)
        self.peaks = tuple(_range([*was, *columns[i]]) for was, i in zip(before, _WRENCH, strict=True))

    def _judge(self, now_s: float) -> None:
        seen = self._observation(now_s)
        self._verdict = judge(seen)
        self._saturated = frozenset(axis for axes in saturated_axes(seen).values() for axis in axes)
        self._now = []
        for finding in self._verdict.findings:
            if self.lost is not None and finding.key == "silence":
                # The server's words of why it has lost the sensor may say what to do.
                why = self.lost if "check " in self.lost else f"{finding.remedy} ({self.lost})"
                finding = finding._replace(remedy=why)  # noqa: PLW2901
            self._now.append(finding)
            known, _ = self._seen.get(finding.key, (finding, 0.0))
            worst = max(finding, known, key=lambda one: (one.level, one.size))
            self._seen[finding.key] = worst, now_s

    def _observation(self, now_s: float) -> Observation:
        mode = mapping(self._status.get("clock")).get("mode")
        said, at_s = self._emergency
        grown = {name: by for name, (by, then_s) in self._grown.items() if now_s - then_s < _JUDGED_S}
        seen = self.observer.observation(_ns(now_s), _JUDGED_NS)
        unread_s, busy, unread_at_s = self.unread
        return seen._replace(
            unread_s=unread_s if now_s - unread_at_s < _JUDGED_S else 0.0,
            busy=busy,
            not_finite=seen.not_finite + ("not_finite" in grown),
            recoveries=int("recoveries" in grown),
            missed_deadlines=grown.get("missed_deadlines", 0),
            reconnects=int("reconnects" in grown),
            locked=None if mode is None else mode == "locked",
            is_lost=self.lost is not None,
            state=text(self._row.get("state")),
            emergency=said if now_s - at_s < LIMITS.emergency_s else "",
            drift=history.drift(self._status, LIMITS),
            settings=mapping(self._row.get("settings")),
        )

    def state(self, now_s: float, *, server_speaks: bool) -> SensorState:
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
        row, status, clock = self._row, self._status, self._status.get("clock")
        settings = mapping(row.get("settings"))
        sample = self._newest and SampleDecoder(len(self._newest), self._imu_units).decode(self._newest)
        return SensorState(
            position=self.position,
            name=text(row.get("name")),
            serial=whole(row.get("serial")),
            firmware=text(row.get("firmware")),
            al_state="LOST" if self.lost is not None else text(row.get("state")),
            nominal_hz=number(row.get("rate_hz")),
            settings={name: settings[name] for name in SETTINGS if isinstance(settings.get(name), int)},
            sample=sample or None,
            peaks=self.peaks,
            saturated=self._saturated,
            verdict=self._verdict,
            alerts=tuple(alerts),
            clock=Clock(text(clock.get("mode")), *(number(clock.get(name)) for name in Clock._fields[1:]))
            if isinstance(clock, dict)
            else None,
            lost_on_bus=whole(status.get("lost_samples")),
            recoveries=whole(status.get("recoveries")),
            hand_out_us=_spread(self._hand_out),
            zero=history.drift(status),
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
            found["age_us"] = Spread(ages[len(ages) // 2], ages[-1], "worst")
        return found


class Model:
    """Takes everything that the server sends."""

    def __init__(self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        self._lock = threading.Lock()
        self._imu_units = imu_units
        self._sensors: dict[int, _Sensor] = {}
        self._server = ServerState(address=address)  # what does not depend on the time
        self._since_s: float | None = None
        self._own_peer = ""
        self._heard_s = 0.0
        self._read_s = math.inf  # when somebody looked last whether anything had come
        self._status: JsonObject = {}
        self._status_s = 0.0
        self._clients: tuple[Client, ...] = ()
        self._message: Message | None = None
        self._message_ends_s = 0.0  # 0: it has not been shown yet
        self._events: deque[str] = deque(maxlen=8)

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        """Connected; `own_peer` is the address of this end, as in `status`."""
        with self._lock:
            self._server = replace(self._server, connected=True, reason="", since_clock=clock_text())
            self._since_s = self._heard_s = now_s
            self._own_peer, self._status, self._clients = own_peer, {}, ()
            self._describe(description, now_s, anew=True)

    def described(self, description: JsonObject, now_s: float) -> None:
        """A later reply to `describe`."""
        with self._lock:
            self._describe(description, now_s, anew=False)

    def gone(self, reason: str, now_s: float) -> None:
        """Disconnected, for this reason."""
        with self._lock:
            if self._server.connected or self._since_s is None:
                self._since_s, self._server = now_s, replace(self._server, since_clock=clock_text())
            self._server = replace(self._server, connected=False, reason=text(reason))
            self._clients = ()

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """Take frames in order of arrival."""
        with self._lock:
            if frames:
                self._heard_s = now_s
            for position, of_one in by_sensor(frames).items():
                if position in self._sensors:
                    self._sensors[position].take(of_one, now_s)

    def note_unread(self, seconds: float, busy: bool, now_s: float) -> None:
        """The frames that come next were not read for so long; see `Client.take_unread`."""
        with self._lock:
            self._read_s = now_s
            if seconds >= SILENT_S:
                for sensor in self._sensors.values():
                    sensor.unread = seconds, busy, now_s

    def note_age(self, frame: DataMessage, now_ns: int) -> None:
        """This frame arrived exactly at this CLOCK_MONOTONIC."""
        with self._lock:
            if frame.sensor in self._sensors:
                self._sensors[frame.sensor].observer.note_age(frame, now_ns)

    def take_status(self, status: JsonObject, now_s: float) -> None:
        """A reply to `status`."""
        with self._lock:
            self._heard_s = now_s
            ages: Any = mapping(status.get("last_10s")).get("age_us")
            for place, row in enumerate(rows(status.get("sensors"))):
                if (sensor := self._sensor(row)) is not None:
                    hand_out = ages[place] if isinstance(ages, list) and place < len(ages) else None
                    sensor.take_status(row, hand_out, status.get("missed_deadlines"), now_s)
            seconds, before = now_s - self._status_s, {client.peer: client.sent for client in self._clients}
            clients = []
            for row in rows(status.get("clients")):
                peer, sent = text(row.get("peer")), whole(row.get("sent")) or 0
                rate = (sent - before[peer]) / seconds if peer in before and seconds > 0 else None
                withheld = whole(row.get("withheld")) or 0
                clients.append(Client(peer, peer == self._own_peer, rate, sent, withheld))
            self._clients = tuple(sorted(clients, key=lambda c: (not c.this, -c.withheld, -c.sent)))
            self._status, self._status_s = status, now_s

    def take_event(self, event: JsonObject, now_s: float) -> None:
        """An event of the server."""
        with self._lock:
            self._heard_s = now_s
            name, said = text(event.get("event")), event_sentence(event)
            if (sensor := self._sensor(event)) is not None:
                if name == Event.SENSOR_LOST:
                    sensor.lost = said
                elif name == Event.SENSOR_BACK:
                    sensor.lost = None
                elif name == Event.OFFSET_CHANGED:  # the zero has moved
                    sensor.peaks = None
            self._events.append(f"{clock_text()} {said}")

    def reset(self) -> None:
        """Reset peaks and past warnings."""
        with self._lock:
            for sensor in self._sensors.values():
                sensor.reset()

    def say(self, message: str, bad: bool = False) -> None:
        """Set the message for the user, with the time of day."""
        with self._lock:
            self._message, self._message_ends_s = Message(f"{clock_text()} {text(message)}", bad), 0.0

    def state(self, now_s: float) -> State:
        """The current state."""
        with self._lock:
            self._message_ends_s = self._message_ends_s or now_s + _MESSAGE_S
            if now_s > self._message_ends_s:
                self._message = None
            status, connected = self._status, self._server.connected
            timing = mapping(status.get("last_10s")) or status
            up_s = number(status.get("uptime_s"))
            server = replace(
                self._server,
                since_s=None if self._since_s is None else now_s - self._since_s,
                heard_s=max(min(now_s, self._read_s) - self._heard_s, 0.0) if connected else None,
                uptime_s=up_s + now_s - self._status_s if up_s is not None and connected else up_s,
                cycles=whole(status.get("cycles")),
                missed_deadlines=whole(status.get("missed_deadlines")),
                lost_frames=whole(status.get("lost_frames")),
                wake_us=_spread(timing.get("wake_us")),
                exchange_us=_spread(timing.get("exchange_us")),
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

    def _describe(self, description: JsonObject, now_s: float, *, anew: bool) -> None:
        replay = description.get("replay")
        files = mapping(replay).get("files")
        name = text(files[0]) if isinstance(files, list) and files else "a recording"
        replayed = name if isinstance(replay, dict) else ""
        self._server = replace(self._server, version=text(description.get("version")), replay=replayed)
        before, self._sensors = self._sensors, {}
        for row in rows(description.get("sensors")):
            if (position := whole(row.get("sensor"))) is not None:
                self._sensors[position] = before.get(position) or _Sensor(position, self._imu_units)
                self._sensors[position].describe(row, now_s, anew=anew)

    def _sensor(self, row: JsonObject) -> _Sensor | None:
        position = whole(row.get("sensor"))
        return None if position is None else self._sensors.get(position)


def clock_text() -> str:
    """The time of day."""
    return time.strftime("%H:%M:%S")


def _range(column: Sequence[float]) -> Range:
    if not math.isfinite(sum(column)):
        column = [value for value in column if math.isfinite(value)] or [0.0]
    return Range(min(column), max(column))


def _spread(values: Any) -> Spread | None:
    """The distribution in a reply to `status`; None if there is none."""
    middle, end = number(mapping(values).get("p50")), number(mapping(values).get("p99"))
    return None if middle is None or end is None else Spread(middle, end)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
