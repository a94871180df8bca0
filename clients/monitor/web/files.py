"""The files of the page, read once, and the answer to a request for one of them."""

from __future__ import annotations

from http import HTTPStatus
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Final, NamedTuple

from clients.monitor.web.access import HEADERS, refused_host, refused_origin

STREAM: Final = "/stream"
"""Where the page opens its WebSocket."""

_TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
"""What is served, by the ending of the name."""


class Answer(NamedTuple):
    """To an HTTP request."""

    status: HTTPStatus
    headers: dict[str, str]
    body: bytes


class Files:
    """The page."""

    def __init__(self) -> None:
        self.by_path: Final = dict(_found(files("clients.monitor.web") / "page", "/"))
        """Body and type of each file by its path."""
        self.by_path["/"] = self.by_path.pop("/index.html")

    def answer(self, path: str, host: str | None, origin: str | None) -> Answer | None:
        """The answer to a GET; None for a stream that may be opened."""
        path = path.partition("?")[0]
        refused = refused_host(host) or (refused_origin(origin, host) if path == STREAM else None)
        if refused:
            return _answer(HTTPStatus.FORBIDDEN, refused.encode() + b"\n")
        if path == STREAM:
            return None
        if path not in self.by_path:
            return _answer(HTTPStatus.NOT_FOUND, b"There is no such file.\n")
        return _answer(HTTPStatus.OK, *self.by_path[path])


def _answer(status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> Answer:
    return Answer(status, {"Content-Type": kind, "Content-Length": str(len(body)), **HEADERS}, body)


def _found(folder: Traversable, path: str) -> list[tuple[str, tuple[bytes, str]]]:
    found = []
    for entry in folder.iterdir():
        if entry.is_dir():
            found += _found(entry, f"{path}{entry.name}/")
        elif (kind := _TYPES.get(entry.name.rpartition(".")[2])) is not None:
            found.append((path + entry.name, (entry.read_bytes(), kind)))
    return found
