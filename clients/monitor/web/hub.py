"""Who gets which message: the connected pages, the model that they show, the points of the traces.

No sockets. All but `WebModel.take` and `connected`, which the reader's thread calls, is for one thread.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Generic, TypeVar

from clients.monitor.model.server import Model, clock_text
from clients.monitor.tare import WAYS, Say
from clients.monitor.web.access import Token
from clients.monitor.web.message import state_text
from clients.monitor.web.points import Feed, after_skipped, start_s
from clients.monitor.web.viewer import Viewer, Wish
from protocol.framing import DataMessage
from protocol.pdo import ImuUnits
from protocol.text.json_text import JsonObject, encode_json_text

MOST_VIEWERS: Final = 8
TOO_MANY: Final = f"{MOST_VIEWERS} pages are connected already: close one of them"
KEPT_S: Final = 60.0
_SILENT_S: Final = 0.1

Page = TypeVar("Page")
"""What a message is sent to."""


class WebModel(Model):
    """The monitor's model, whose frames also go to the traces."""

    def __init__(self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        super().__init__(address, imu_units)
        self.feed = Feed(imu_units)
        self.on_points: Callable[[], None] = lambda: None
        """Called by the thread that feeds the model when there may be new points."""

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        """See `Model`."""
        self.feed.restart()
        super().connected(description, own_peer, now_s)

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """See `Model`."""
        super().take(frames, now_s)
        self.feed.take(frames)
        self.on_points()


class Hub(Generic[Page]):
    """The viewers, each by the page that it stands for."""

    def __init__(self, model: WebModel, token: Token, tare: Callable[[int, Say, str], object]) -> None:
        """`tare` tares the sensor at a position in the background, one of WAYS, and calls with the result."""
        self._model = model
        self._token = token
        self._tare = tare
        self._taring = False
        self._viewers: dict[Page, Viewer] = {}
        self._number = 0
        self._points_s = 0.0
        self._kept: dict[int, deque[bytes]] = defaultdict(deque)
        """The points of the last minute by position, for a page that comes later."""

    def join(self, page: Page) -> Viewer | None:
        """A page has connected; None if there are enough."""
        if len(self._viewers) >= MOST_VIEWERS:
            return None
        viewer = self._viewers[page] = Viewer(self._token)
        return viewer

    def leave(self, page: Page) -> None:
        """Its connection has ended."""
        self._viewers.pop(page, None)

    def hear(self, page: Page, text: str | bytes) -> str | None:
        """A message of a page; what to answer."""
        viewer = self._viewers[page]
        before = viewer.control
        heard = viewer.hear(text)
        refused = heard if isinstance(heard, str) else None
        if isinstance(heard, Wish):
            self._do(heard)
        if refused or viewer.control != before:
            return encode_json_text({"control": viewer.control, "refused": refused}).decode()
        return None

    def states(self, now_s: float) -> Iterator[tuple[list[Page], str]]:
        """The state that is due, for the pages that keep up."""
        self._number += 1
        pages: dict[int, list[Page]] = {}
        for page, viewer in self._viewers.items():
            if not viewer.behind:
                viewer.sends(self._number)
                pages.setdefault(viewer.sensor, []).append(page)
        if pages:
            state = self._model.state(now_s)
            for position, them in pages.items():
                yield them, state_text(state, position, self._number)

    def points(self, now_s: float) -> Iterator[tuple[list[Page], bytes]]:
        """The points that are due, for the pages that keep up: whoever lags misses them, and is told so."""
        silent = now_s - self._points_s > _SILENT_S
        for position, batch in self._model.feed.batches(silent=silent).items():
            self._points_s = now_s
            self._keep(position, batch)
            pages: dict[bool, list[Page]] = {}
            for page, viewer in self._viewers.items():
                if viewer.sensor == position:
                    if not viewer.behind:
                        pages.setdefault(viewer.missed, []).append(page)
                    viewer.missed = viewer.behind
            for missed, them in pages.items():
                yield them, after_skipped(batch) if missed else batch

    def kept(self, page: Page) -> list[bytes]:
        """The points of the last minute of the sensor that a page shows, for one that has just begun to."""
        return list(self._kept.get(self._viewers[page].sensor, ()))

    def _keep(self, position: int, batch: bytes) -> None:
        kept = self._kept[position]
        kept.append(batch)
        while not start_s(batch) - KEPT_S <= start_s(kept[0]) <= start_s(batch):  # or of another server
            kept.popleft()

    def _do(self, wish: Wish) -> None:
        if wish.action == "reset":
            self._model.reset()
            self._say("Peaks and past warnings are reset", False)
        elif self._taring:
            self._say("A tare is running already", True)
        else:
            self._taring = True
            self._say(WAYS[wish.action].begins.format(wish.sensor), False)
            self._tare(wish.sensor, self._tared, wish.action)

    def _tared(self, text: str, bad: bool) -> None:
        self._taring = False
        self._say(text, bad)

    def _say(self, text: str, bad: bool) -> None:
        self._model.say(f"{clock_text()} {text}", bad=bad)
