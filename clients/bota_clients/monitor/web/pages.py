"""What the connected pages are sent, and what they may have done. No sockets.

States are sent as `state_text` makes them; frames as points of the traces: the extremes of every 10 ms, so
that no peak is lost. A message with points has `points`, position of the sensor; `start`, time of the first
point, `times` after it; `columns`, values of each of the 13 channels; `newest`, those of the newest sample.
Times are the server's CLOCK_MONOTONIC in s, values in SI units or counts, both to six decimals; null: not a
finite number. A page that was too slow for the points before them is told to begin its traces anew.

`WebModel.add_frames` and `connected` are called by the reader's thread, everything else by one other.
"""

from __future__ import annotations

import hmac
import json
import math
import secrets
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from itertools import takewhile
from typing import Any, Final

import numpy as np

from bota_clients.monitor import words
from bota_clients.monitor.model import Model, State
from bota_clients.monitor.recording import MonitorRecording
from bota_clients.monitor.screen import table
from bota_clients.monitor.tare import WAYS, Say
from bota_clients.numbers import duration
from bota_clients.recording.columns import Floats
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.errors import BadMessageError
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.observer import COMMON
from bota_ethercat.pdo import STANDARD_GRAVITY, ImuUnits, PdoType
from bota_ethercat.sensor_choice import MAX_SENSORS
from bota_ethercat.text.json_text import JsonObject, finite, parse_json_object
from bota_ethercat.text.untrusted import whole

MOST_PAGES: Final = 8
TOO_MANY: Final = f"{MOST_PAGES} pages are connected already: close one of them"
KEPT_S: Final = 60.0
MOST_BYTES: Final = 1024  # of a message from a page
BEHIND_S: Final = 2.0  # points that wait longer for a page are too many for it
_SILENT_S: Final = 0.1
STEP_NS: Final = 10_000_000  # of the traces
# Six axes of the wrench, acceleration, angular rate, temperature.
CHANNELS: Final = tuple(field.name for field in COMMON.fields if field.type is PdoType.REAL)

Values = tuple[float, ...]
_ANEW: Final = '{"anew":true}'


class Points:
    """One sensor's points. A step with one sample is one point, others are two: each channel's extremes."""

    def __init__(self, position: int, imu_units: ImuUnits) -> None:
        self._position = position
        factors = {"acceleration": STANDARD_GRAVITY, "angular_rate": math.pi / 180.0}
        to_si = {} if imu_units is ImuUnits.SI else factors  # from the process data's units
        self._scale = [to_si.get(name.split(".")[0], 1.0) for name in CHANNELS]
        self._samples: list[tuple[int, Values]] = []  # that are no points yet
        self.last = (-1, -1)  # number and time of the newest frame

    def add(self, frames: Iterable[DataMessage]) -> None:
        """Frames of any sensors as they came; REPEATED, INVALID and old ones bring nothing."""
        for sequence, _, time_ns, sensor, flags, _, process_data in frames:
            is_old = sequence <= self.last[0] and time_ns <= self.last[1]
            if sensor == self._position and not flags & NOT_NEW and not is_old:
                self.last = sequence, time_ns
                self._samples.append((time_ns, COMMON.reals.unpack_from(process_data)))

    def batch(self, *, silent: bool = False) -> dict[str, Any] | None:
        """The points of the steps that are over, as a message; None without any. `silent`: of all steps."""
        if not self._samples:
            return None
        samples, newest = self._samples, self._samples[-1]
        steps = np.array([time_ns // STEP_NS for time_ns, _ in samples])
        end = len(steps) if silent else int(np.argmax(steps == steps[-1]))
        if not end:
            return None
        self._samples = samples[end:]
        times = np.array([time_ns for time_ns, _ in samples[:end]])
        values = np.array([row for _, row in samples[:end]]) * self._scale
        values[~np.isfinite(values)] = math.nan
        first = np.flatnonzero(np.diff(steps[:end], prepend=-1))
        last = np.append(first[1:], end) - 1
        ends = np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)
        falls = values[first] > values[last]
        points = np.stack([np.where(falls, *ends[::-1]), np.where(falls, *ends)], axis=1)
        kept = np.stack([np.full(len(first), True), last > first], axis=1)
        at = np.stack([times[first], times[last]], axis=1)[kept]
        return {
            "points": self._position,
            "start": int(at[0]) * 1e-9,
            "times": _rounded((at - at[0]) * 1e-9),
            "newest": _rounded(np.multiply(newest[1], self._scale)),
            "columns": [_rounded(column) for column in points[kept].T],
        }


def _rounded(values: Floats) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in np.round(values, 6).tolist()]


class WebModel(Model):
    """The monitor's model, whose frames also become points of the traces."""

    def __init__(self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        super().__init__(address, imu_units)
        self._points: dict[int, Points] = {}
        self._points_lock = threading.Lock()

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        with self._points_lock:
            for points in self._points.values():
                points.last = (-1, -1)  # the server may count from the beginning again
        super().connected(description, own_peer, now_s)

    def add_frames(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """See `Model`."""
        super().add_frames(frames, now_s)
        with self._points_lock:
            for position in {frame.sensor for frame in frames}:
                self._points.setdefault(position, Points(position, self._imu_units)).add(frames)

    def batches(self, *, silent: bool = False) -> list[dict[str, Any]]:
        """The messages with points that are due; `silent` as in `Points.batch`."""
        with self._points_lock:
            made = [points.batch(silent=silent) for points in self._points.values()]
        return [batch for batch in made if batch is not None]


class Page:
    def __init__(self) -> None:
        self.sensor = 0  # position of the one that it shows
        self.control = False  # whether it has shown the token
        self.sent = 0  # number of the newest points that it was sent; 0: none
        self.end = ""  # why its connection must be closed; empty if not


class Pages:
    """The connected pages, the model that they show, and the token with which one may tare and record."""

    def __init__(
        self,
        model: WebModel,
        tare: Callable[[int, Say, str], threading.Thread],
        recorder: MonitorRecording,
    ) -> None:
        """`tare` starts one of WAYS with the sensor at a position."""
        self.token: Final = secrets.token_urlsafe(24)
        self.connected: set[Page] = set()
        self._model = model
        self._tare, self._recorder = tare, recorder
        self._taring: threading.Thread | None = None
        self._points_s = 0.0
        self._number = 0
        # Points of the last minute by position: their number, the time of the first, and the message.
        self._kept: dict[int, deque[tuple[int, float, str]]] = defaultdict(deque)

    def join(self) -> Page | None:
        """A page has connected; None if there are enough."""
        if len(self.connected) >= MOST_PAGES:
            return None
        page = Page()
        self.connected.add(page)
        return page

    def state(self, now_s: float) -> str:
        if ended := self._recorder.ended():
            self._model.say(*ended)
        return state_text(self._model.state(now_s), recording=self._recorder.running)

    def collect(self, now_s: float) -> None:
        """Keep the points that have come since the last call."""
        silent = now_s - self._points_s > _SILENT_S
        for batch in self._model.batches(silent=silent):
            self._number += 1
            self._points_s, start_s, kept = now_s, batch["start"], self._kept[batch["points"]]
            kept.append((self._number, start_s, _json(batch)))
            while not start_s - KEPT_S <= kept[0][1] <= start_s:  # or of another server
                kept.popleft()

    def points(self, page: Page) -> list[str]:
        """What the page has not been sent of its sensor, oldest first: at first the last minute."""
        kept = self._kept.get(page.sensor, ())
        new = [*takewhile(lambda each: each[0] > page.sent, reversed(kept))]
        if not new:
            return []
        anew = page.sent > 0 and new[0][1] - new[-1][1] > BEHIND_S
        page.sent = new[0][0]
        return [_ANEW, new[0][2]] if anew else [text for *_, text in reversed(new)]

    def handle(self, page: Page, text: str | bytes) -> str | None:
        """A message of a page, whose `end` may be set afterwards; the answer, if there is one."""
        try:
            message = parse_json_object(text.encode() if isinstance(text, str) else text)
        except (BadMessageError, UnicodeEncodeError):
            page.end = "Not a message of this page"
            return None
        before = page.control
        refused = self._do(page, message)
        if refused or page.control != before:
            return _json({"control": page.control, "refused": refused})
        return None

    def _do(self, page: Page, message: JsonObject) -> str | None:
        """Do what it asks for; why not."""
        position, action = whole(message.get("sensor")), message.get("do")
        if position is not None and 0 <= position < MAX_SENSORS and position != page.sensor:
            page.sensor, page.sent = position, 0
        if "token" in message and not self._check_token(page, message["token"]):
            return "The token in this link is not that of this run: open the link that it printed"
        if action is None:
            return None
        if action not in ("reset", "record", *WAYS):
            page.end = "Not a message of this page"
            return None
        if not page.control:
            return "Only a page opened by the link that ethercat-monitor printed may do this"
        if action == "reset":
            self._model.reset()
            self._model.say("Peaks and past warnings are reset")
        elif action == "record":
            self._model.say(self._recorder.toggle(time.monotonic()))
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


def state_text(state: State, *, recording: bool = False) -> str:
    """The state as JSON: what `--json` prints, and words for the page."""
    found = words.json_object(state, time.time())
    for row, sensor in zip(found["sensors"], state.sensors, strict=True):
        row["identity"], row["alerts"] = words.identity(sensor), [
            words.alert(each) | {"level": each.level.words, "when": words.seen(each.ago_s),
                                 "present": each.ago_s is None}
            for each in sensor.alerts
        ]  # fmt: skip
        row["old"] = None if sensor.old_s is None else duration(sensor.old_s)
    found["link"], found["trouble"] = words.link(state.server), words.trouble(state.server)
    found["recording"] = recording
    found["message"], found["table"] = state.message and state.message._asdict(), table(state)
    return _json({"state": finite(found)})


def _json(message: object) -> str:
    return json.dumps(message, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
