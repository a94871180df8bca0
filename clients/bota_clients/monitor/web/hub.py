"""What the connected pages are sent, and what they may have done. No sockets.

States are sent as `state_text` makes them; frames as points of the traces: the extremes of every 10 ms, so
that no peak is lost. A message with points has `points`, position of the sensor; `start`, time of the first
point, `times` after it; `columns`, values of each of the 13 channels; `newest`, those of the newest sample;
`skipped`, if the page was not sent the points before because it was slow. Times are the server's
CLOCK_MONOTONIC in s, values in SI units or counts, both to six decimals; null: not a finite number.

`WebModel.take` and `connected` are called by the reader's thread, everything else by one other.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import math
import secrets
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from bota_clients.monitor import words
from bota_clients.monitor.model import Model, SensorState, State
from bota_clients.monitor.tare import WAYS, Say
from bota_clients.numbers import duration
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.errors import BadMessageError
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.limits import Level
from bota_ethercat.health.observer import COMMON
from bota_ethercat.pdo import AXES, STANDARD_GRAVITY, ImuUnits, PdoType
from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.sensor_choice import MAX_SENSORS
from bota_ethercat.text.json_text import JsonObject, finite, parse_json_object
from bota_ethercat.text.untrusted import whole

MOST_PAGES: Final = 8
TOO_MANY: Final = f"{MOST_PAGES} pages are connected already: close one of them"
KEPT_S: Final = 60.0
MOST_BYTES: Final = 1024  # of a message from a page
MOST_BEHIND: Final = 10  # states without an acknowledgement
_MOST_MESSAGES: Final = 40  # between two states
_SILENT_S: Final = 0.1
STEP_NS: Final = 10_000_000  # of the traces
MOST_POINTS: Final = 4096  # that wait to be taken: 20 s
# Six axes of the wrench, acceleration, angular rate, temperature.
CHANNELS: Final = tuple(field.name for field in COMMON.fields if field.type is PdoType.REAL)

Values = tuple[float, ...]
Send = Callable[[str], None]


class Points:
    """One sensor's points. A step with one sample is one point, others are two: each channel's extremes."""

    def __init__(self, position: int, imu_units: ImuUnits) -> None:
        self._position = position
        factors = {"acceleration": STANDARD_GRAVITY, "angular_rate": math.pi / 180.0}
        to_si = {} if imu_units is ImuUnits.SI else factors  # from the process data's units
        self._scale = [to_si.get(name.split(".")[0], 1.0) for name in CHANNELS]
        self._step: list[tuple[int, Values]] = []  # its samples so far
        self._points: deque[tuple[int, Values]] = deque(maxlen=MOST_POINTS)
        self._newest: Values = ()
        self.last = (-1, -1)  # number and time of the newest frame

    def take(self, frames: Iterable[DataMessage]) -> None:
        """Frames of any sensors as they came; REPEATED, INVALID and old ones bring nothing."""
        for sequence, _, time_ns, sensor, flags, _, process_data in frames:
            is_old = sequence <= self.last[0] and time_ns <= self.last[1]
            if sensor != self._position or flags & NOT_NEW or is_old:
                continue
            if self._step and time_ns // STEP_NS != self._step[0][0] // STEP_NS:
                self._end_step()
            self.last = sequence, time_ns
            self._newest = COMMON.reals.unpack_from(process_data)
            self._step.append((time_ns, self._newest))

    def batch(self, *, silent: bool = False) -> dict[str, Any] | None:
        """The points since the last one, as a message; None without any. `silent`: end the step now."""
        if silent and self._step:
            self._end_step()
        if not self._points:
            return None
        times, values = zip(*self._points, strict=True)
        self._points.clear()
        columns = zip(*values, strict=True)
        return {
            "points": self._position,
            "start": times[0] * 1e-9,
            "times": [_plain((time_ns - times[0]) * 1e-9) for time_ns in times],
            "newest": list(map(_plain, self._newest, self._scale)),
            "columns": [
                [_plain(v, s) for v in column] for column, s in zip(columns, self._scale, strict=True)
            ],
        }

    def _end_step(self) -> None:
        times, samples = zip(*self._step, strict=True)
        first, second = zip(*map(_extremes, zip(*samples, strict=True)), strict=True)
        self._points.append((times[0], first))
        if len(times) > 1:
            self._points.append((times[-1], second))
        self._step.clear()


def _plain(value: float, scale: float = 1.0) -> float | None:
    return round(value * scale, 6) if math.isfinite(value) else None


def _extremes(column: Values) -> tuple[float, float]:
    """Minimum and maximum in the order in which they came."""
    if not math.isfinite(sum(column)):
        column = tuple(value for value in column if math.isfinite(value)) or (math.nan,)
    low, high = min(column), max(column)
    return (low, high) if column.index(low) < column.index(high) else (high, low)


class WebModel(Model):
    """The monitor's model, whose frames also become points of the traces."""

    def __init__(self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        super().__init__(address, imu_units)
        self._points: dict[int, Points] = {}
        self._points_lock = threading.Lock()

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        """See `Model`."""
        with self._points_lock:
            for points in self._points.values():
                points.last = (-1, -1)  # the server may count from the beginning again
        super().connected(description, own_peer, now_s)

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """See `Model`."""
        super().take(frames, now_s)
        with self._points_lock:
            for position in {frame.sensor for frame in frames}:
                self._points.setdefault(position, Points(position, self._imu_units)).take(frames)

    def batches(self, *, silent: bool = False) -> list[dict[str, Any]]:
        """The messages with points that are due; `silent` as in `Points.batch`."""
        with self._points_lock:
            made = [points.batch(silent=silent) for points in self._points.values()]
        return [batch for batch in made if batch is not None]


class Page:
    """A connected page. It acknowledges states by number; while it lags by two seconds it is sent nothing."""

    def __init__(self, send: Send) -> None:
        self.send = send
        self.sensor = 0  # position of the one that it shows
        self.control = False  # whether it has shown the token
        self.missed = False  # whether it was not sent the last points, because it was behind
        self.end = ""  # why its connection must be closed; empty if not
        self.unseen: deque[int] = deque()  # states that it has not acknowledged
        self.messages = 0  # since the last state

    @property
    def behind(self) -> bool:
        """Whether it has too much on the way already."""
        return len(self.unseen) >= MOST_BEHIND


class Hub:
    """The connected pages, the model that they show, and the token with which one may tare."""

    def __init__(self, model: WebModel, tare: Callable[[int, Say, str], threading.Thread]) -> None:
        """`tare` starts one of WAYS with the sensor at a position."""
        self.token: Final = secrets.token_urlsafe(24)
        self._model = model
        self._tare = tare
        self._taring: threading.Thread | None = None
        self._pages: set[Page] = set()
        self._number = 0
        self._points_s = 0.0
        # Points of the last minute by position: the time of the first, and the message.
        self._kept: dict[int, deque[tuple[float, str]]] = defaultdict(deque)

    def join(self, send: Send, now_s: float) -> Page | None:
        """A page has connected: it gets the state and the last minute; None if there are enough."""
        if len(self._pages) >= MOST_PAGES:
            return None
        page = Page(send)
        self._pages.add(page)
        self.send_states(now_s)
        self._send_kept(page)
        return page

    def leave(self, page: Page) -> None:
        """Its connection has ended."""
        self._pages.discard(page)

    def send_states(self, now_s: float) -> None:
        """Send the state to the pages that keep up."""
        self._number += 1
        state, texts = self._model.state(now_s), dict[int, str]()
        for page in self._pages:
            if not page.behind:
                page.unseen.append(self._number)
                page.messages = 0
                if page.sensor not in texts:
                    texts[page.sensor] = state_text(state, page.sensor, self._number)
                page.send(texts[page.sensor])

    def send_points(self, now_s: float) -> None:
        """Send new points to the pages that keep up; to others, the next ones are marked `skipped`."""
        silent = now_s - self._points_s > _SILENT_S
        for batch in self._model.batches(silent=silent):
            self._points_s, start_s, text = now_s, batch["start"], _json(batch)
            kept = self._kept[batch["points"]]
            kept.append((start_s, text))
            while not start_s - KEPT_S <= kept[0][0] <= start_s:  # or of another server
                kept.popleft()
            for page in self._pages:
                if page.sensor == batch["points"]:
                    if not page.behind:
                        page.send(_json(batch | {"skipped": True}) if page.missed else text)
                    page.missed = page.behind

    def take(self, page: Page, text: str | bytes) -> None:
        """A message of a page; afterwards `page.end` may be set."""
        page.messages += 1
        if page.messages > _MOST_MESSAGES:
            page.end = "Too many messages"
            return
        try:
            message = parse_json_object(text.encode() if isinstance(text, str) else text)
        except (BadMessageError, UnicodeEncodeError):
            page.end = "Not a message of this page"
            return
        before = page.control
        refused = self._do(page, message)
        if refused or page.control != before:
            page.send(_json({"control": page.control, "refused": refused}))

    def _do(self, page: Page, message: JsonObject) -> str | None:
        """Do what it asks for; why not."""
        seen, position, action = whole(message.get("seen")), whole(message.get("sensor")), message.get("do")
        while seen is not None and page.unseen and page.unseen[0] <= seen:
            page.unseen.popleft()
        if position is not None and 0 <= position < MAX_SENSORS and position != page.sensor:
            page.sensor = position
            self._send_kept(page)
        if "token" in message and not self._check_token(page, message["token"]):
            return "The token in this link is not that of this run: open the link that it printed"
        if action is None:
            return None
        if action not in ("reset", *WAYS):
            page.end = "Not a message of this page"
            return None
        if not page.control:
            return "Only a page opened by the link that ethercat-monitor printed may do this"
        if action == "reset":
            self._model.reset()
            self._model.say("Peaks and past warnings are reset")
        elif self._taring is not None and self._taring.is_alive():
            self._model.say("A tare is running already", True)
        else:
            self._taring = self._tare(page.sensor, self._model.say, action)
        return None

    def _check_token(self, page: Page, given: object) -> bool:
        """Whether the page may control from now on."""
        text = given if isinstance(given, str) else ""
        page.control = hmac.compare_digest(text.encode(errors="replace"), self.token.encode())
        return page.control

    def _send_kept(self, page: Page) -> None:
        for _, text in self._kept.get(page.sensor, ()):
            page.send(text)


def is_loopback(host: str) -> bool:
    """Whether a host, without port, is this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def state_text(state: State, position: int, number: int) -> str:
    """State `number` for a page that shows the sensor at `position`, as JSON; unknown values are null."""
    trouble = words.trouble(state.server)
    message = {
        "state": number,
        "address": state.server.address,
        "link": words.link(state.server),
        "trouble": trouble,
        "server": words.server_facts(state.server),
        "clients": [words.client(client) for client in state.clients],
        "message": state.message and state.message._asdict(),
        "events": state.events,
        "sensors": [
            {
                "position": s.position,
                "name": s.info.name,
                "ok": None if trouble else s.verdict.level < Level.TROUBLE,
            }
            for s in state.sensors
        ],
        "sensor": next((_sensor(sensor) for sensor in state.sensors if sensor.position == position), None),
    }
    return _json(finite(message))


def _json(message: object) -> str:
    return json.dumps(message, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def _sensor(sensor: SensorState) -> dict[str, Any]:
    sample, rate_hz = sensor.sample, sensor.info.rate_hz or None
    stream = {
        "Rate": words.rate(sensor),
        "Filter delay": words.delays(sensor),
        "Age": words.times(sensor.age_us),
        "Age at hand-out": words.times(sensor.hand_out_us),
        "Jitter": words.jitter(sensor),
        "Clock": words.clock(sensor),
    }
    if sample is not None:
        stream["Temperature"] = f"{sample.temperature:.1f} °C"
        if sample.orientation is not None:
            stream["Orientation xyzw"] = " ".join(f"{part:+.2f}" for part in sample.orientation)
    return {
        "position": sensor.position,
        "identity": words.identity(sensor),
        "old": None if sensor.old_s is None else duration(sensor.old_s),
        "has_sample": sample is not None,
        "nominal_hz": rate_hz,
        "units": sensor.units,
        "imu_off": sensor.imu_off,
        "peaks": sensor.peaks and dict(zip(AXES, sensor.peaks, strict=True)),
        "saturated": sorted(sensor.saturated),
        "alerts": [
            words.alert(a) | {"level": a.level.words, "when": words.seen(a.ago_s), "present": a.ago_s is None}
            for a in sensor.alerts
        ],
        "stream": list(stream.items()),
        "losses": words.losses(sensor),
        "settings": [
            (
                name,
                str(value).lower(),
                value_meaning(
                    name, value, round(rate_hz) if rate_hz else None, sensor.info.settings.get("chop")
                ),
            )
            for name, value in sensor.info.settings.items()
        ],
    }
