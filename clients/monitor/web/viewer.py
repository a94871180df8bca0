"""One page that is connected: what it says and wants, and whether it keeps up. No sockets, no clock.

It acknowledges states by number. One that lags more than two seconds is sent nothing until it has caught up,
then the newest: it never has more than that on the way.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from clients.monitor.tare import WAYS
from clients.monitor.web.access import Token
from protocol.errors import BadMessageError
from protocol.sensor_choice import MOST_PLACES
from protocol.text.json_text import JsonObject, parse_json_object
from protocol.text.untrusted import whole

MOST_BYTES: Final = 1024
"""Maximum length of a message from a page."""
MOST_BEHIND: Final = 10
"""States without an acknowledgement."""
_MOST_MESSAGES: Final = 40
"""Between two states."""


class Wish(NamedTuple):
    """What a page asks for."""

    action: str
    """`reset`, or one of WAYS to tare."""
    sensor: int


class Viewer:
    """A page.

    Attributes:
        sensor: position of the sensor that it shows.
        control: whether it has shown the token.
        missed: whether it was not sent the last points, because it was behind.
        end: why its connection must be closed; empty if not.
    """

    def __init__(self, token: Token) -> None:
        self._token = token
        self.sensor = 0
        self.control = False
        self.missed = False
        self.end = ""
        self._unseen: deque[int] = deque()
        """Numbers of the states that it has been sent and has not acknowledged."""
        self._messages = 0

    @property
    def behind(self) -> bool:
        """Whether it has too much on the way already."""
        return len(self._unseen) >= MOST_BEHIND

    def sends(self, number: int) -> None:
        """State `number` is sent to it."""
        self._unseen.append(number)
        self._messages = 0

    def hear(self, text: str | bytes) -> Wish | str | None:
        """Take its message: a wish that is granted, or the sentence with which it is refused."""
        self._messages += 1
        if self._messages > _MOST_MESSAGES:
            self.end = "Too many messages"
            return None
        try:
            message = parse_json_object(text.encode() if isinstance(text, str) else text)
        except (BadMessageError, UnicodeEncodeError):
            self.end = "Not a message of this page"
            return None
        return self._obey(message)

    def _obey(self, message: JsonObject) -> Wish | str | None:
        seen, position = whole(message.get("seen")), whole(message.get("sensor"))
        while seen is not None and self._unseen and self._unseen[0] <= seen:
            self._unseen.popleft()
        if position is not None and 0 <= position < MOST_PLACES:
            self.sensor = position
        if "token" in message:
            self.control = self._token.is_right(message["token"])
            if not self.control:
                return "The token in this link is not that of this run: open the link that it printed"
        action = message.get("do")
        if action is None:
            return None
        if not isinstance(action, str) or action not in {"reset", *WAYS}:
            self.end = "Not a message of this page"
            return None
        if not self.control:
            return "Only a page opened by the link that ethercat-monitor printed may do this"
        return Wish(action, self.sensor)
