"""What the connected pages are sent, and what they may have done. No sockets.

`WebModel.take` and `connected` are called by the reader's thread, everything else by one other.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import secrets
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from typing import Any, Final

from bota_clients.monitor import words
from bota_clients.monitor.model import AXES, Model, SensorState, State, clock_text
from bota_clients.monitor.tare import WAYS, Say
from bota_clients.monitor.web.points import Feed, after_skipped, start_s
from bota_clients.numbers import duration
from bota_ethercat.errors import BadMessageError
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.verdict import Level
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.sensor_choice import MOST_PLACES
from bota_ethercat.text.json_text import JsonObject, encode_json_text, finite, parse_json_object
from bota_ethercat.text.untrusted import whole

MOST_PAGES: Final = 8
TOO_MANY: Final = f"{MOST_PAGES} pages are connected already: close one of them"
KEPT_S: Final = 60.0
MOST_BYTES: Final = 1024  # of a message from a page
MOST_BEHIND: Final = 10  # states without an acknowledgement
_MOST_MESSAGES: Final = 40  # between two states
_SILENT_S: Final = 0.1

Send = Callable[[str | bytes], None]


class WebModel(Model):
    """The monitor's model, whose frames also go to the traces."""

    def __init__(self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        super().__init__(address, imu_units)
        self.feed = Feed(imu_units)

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        """See `Model`."""
        self.feed.restart()
        super().connected(description, own_peer, now_s)

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """See `Model`."""
        super().take(frames, now_s)
        self.feed.take(frames)


class Page:
    """A connected page. It acknowledges states by number; while it lags by two seconds it is sent nothing.

    Attributes:
        sensor: position of the sensor that it shows.
        control: whether it has shown the token.
        missed: whether it was not sent the last points, because it was behind.
        end: why its connection must be closed; empty if not.
    """

    def __init__(self, send: Send) -> None:
        self.send = send
        self.sensor = 0
        self.control = False
        self.missed = False
        self.end = ""
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
        self._kept: dict[int, deque[bytes]] = defaultdict(deque)  # of the last minute, by position

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
        """Send new points to the pages that keep up; one that lags is told later that it has missed some."""
        silent = now_s - self._points_s > _SILENT_S
        for position, batch in self._model.feed.batches(silent=silent).items():
            self._points_s = now_s
            kept = self._kept[position]
            kept.append(batch)
            while not start_s(batch) - KEPT_S <= start_s(kept[0]) <= start_s(batch):  # or of another server
                kept.popleft()
            for page in self._pages:
                if page.sensor == position:
                    if not page.behind:
                        page.send(after_skipped(batch) if page.missed else batch)
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
            page.send(encode_json_text({"control": page.control, "refused": refused}).decode())

    def _do(self, page: Page, message: JsonObject) -> str | None:
        """Do what it asks for; why not."""
        seen, position, action = whole(message.get("seen")), whole(message.get("sensor")), message.get("do")
        while seen is not None and page.unseen and page.unseen[0] <= seen:
            page.unseen.popleft()
        if position is not None and 0 <= position < MOST_PLACES and position != page.sensor:
            page.sensor = position
            self._send_kept(page)
        if "token" in message:
            given = message["token"] if isinstance(message["token"], str) else ""
            page.control = hmac.compare_digest(given.encode(errors="replace"), self.token.encode())
            if not page.control:
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
            self._say("Peaks and past warnings are reset")
        elif self._taring is not None and self._taring.is_alive():
            self._say("A tare is running already", True)
        else:
            self._taring = self._tare(page.sensor, self._say, action)
        return None

    def _send_kept(self, page: Page) -> None:
        for batch in self._kept.get(page.sensor, ()):
            page.send(batch)

    def _say(self, text: str, bad: bool = False) -> None:
        self._model.say(f"{clock_text()} {text}", bad)


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
                "name": s.name,
                "ok": None if trouble else s.verdict.level < Level.TROUBLE,
            }
            for s in state.sensors
        ],
        "sensor": next((_sensor(sensor) for sensor in state.sensors if sensor.position == position), None),
    }
    return json.dumps(finite(message), allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def _sensor(sensor: SensorState) -> dict[str, Any]:
    sample, rate_hz = sensor.sample, sensor.nominal_hz
    stream = {
        "Rate": words.rate(sensor),
        "Age": words.times(sensor.age_us, "worst"),
        "Age at hand-out": words.times(sensor.hand_out_us, "p99"),
        "Jitter": words.jitter(sensor),
        "Clock": words.clock(sensor),
    }
    if sample is not None:
        stream["Temperature"] = f"{sample.temperature:.1f} °C"
        if sample.orientation is not None:
            stream["Orientation xyzw"] = " ".join(f"{part:+.2f}" for part in sample.orientation)
    return {
        "position": sensor.position,
        "identity": "  ".join(part for part in (words.who(sensor), sensor.al_state) if part),
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
                value_meaning(name, value, round(rate_hz) if rate_hz else None, sensor.settings.get("chop")),
            )
            for name, value in sensor.settings.items()
        ],
    }
