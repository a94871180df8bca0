"""Polls the server's `status` and `describe` over the stream's connection, and never waits for a reply."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

from bridge.stream.link import Link
from protocol.errors import ConnectionFailedError
from protocol.text.json_text import JsonObject


class ServerStatus:
    """`ask` once a second, `collect` often."""

    def __init__(self) -> None:
        self.status: Mapping[str, Any] = {}
        self._link: Link | None = None
        self._connects = 0
        self._waiting: dict[str, Future[JsonObject]] = {}
        self._asked_s = 0.0

    def collect(self, link: Link) -> JsonObject | None:
        """Take what was answered; returns a `describe` reply, once."""
        if not link.is_connected or link.connects != self._connects:
            self._connects, self.status, self._waiting = link.connects, {}, {}
        self._link = link
        described = None
        for action in [action for action, reply in self._waiting.items() if reply.done()]:
            reply = self._waiting.pop(action)
            if reply.exception() is not None or reply.result().get("ok") is not True:
                continue
            if action == "status":
                self.status = reply.result()
            else:
                described = reply.result()
        return described

    def ask(self, now_s: float) -> None:
        """Ask again, unless an answer is still owed."""
        if self._link is None or not self._link.is_connected or self._waiting:
            return
        self._asked_s = now_s
        try:
            for action in ("status", "describe"):
                self._waiting[action] = self._link.client.request(action)
        except ConnectionFailedError:
            self._waiting = {}  # the reader will notice

    def owed_s(self, now_s: float) -> float:
        """How long an answer has been owed."""
        return now_s - self._asked_s if self._waiting else 0.0
