"""Requests to the server from other threads than the reader's: every one answered, refused or timed out.

They go over the stream's connection; the reader finds the reply among the samples and hands it over.
"""

from __future__ import annotations

import threading
from typing import Final

from bridge.parameters.table import Parameters
from bridge.stream.connection import Connection, RefusalError, refusal
from bridge.stream.link import Link
from protocol.errors import ConnectionFailedError
from protocol.text.json_text import JsonObject

CONFIGURE_TIMEOUT_S: Final = 10.0
DESCRIBE_TIMEOUT_S: Final = 3.0
SHUTDOWN_TIMEOUT_S: Final = 3.0


class RequestFailedError(Exception):
    """A request was not granted; the text is the server's sentence, or says why there is none."""


class RefusedError(RequestFailedError):
    """The server refused; the text is its own sentence."""


class Requests:
    """Asks the server that `link` is connected to."""

    def __init__(self, parameters: Parameters, link: Link) -> None:
        self._parameters = parameters
        self._link = link
        self._waiting: set[threading.Event] = set()
        """One for each waiting request: set once its reply has arrived, or is no longer wanted."""
        self._ending = False

    def cancel(self) -> None:
        """Make whoever waits for a reply give up, now and from now on: the node ends."""
        self._ending = True
        for over in list(self._waiting):
            over.set()

    def ask(self, action: str, timeout_s: float, **values: object) -> JsonObject:
        """The reply that grants the request; RequestFailedError otherwise. Blocks for `timeout_s` at most."""
        connection = self._link.connection
        if connection is None:
            raise RequestFailedError(f"{self._link.absence}: ask again when the node is connected")
        try:
            return self._exchange(connection, action, timeout_s, values)
        except ConnectionFailedError as error:
            raise RequestFailedError(f"the server at {self._link.address} is gone: {error}") from None

    def _exchange(
        self, connection: Connection, action: str, timeout_s: float, values: dict[str, object]
    ) -> JsonObject:
        over = threading.Event()
        self._waiting.add(over)
        try:
            waiting = connection.send_request(action, **values)
            waiting.add_done_callback(lambda _: over.set())
            if not self._ending:
                self._link.clock.wait(over, timeout_s)
        finally:
            self._waiting.discard(over)
        if not waiting.done():
            connection.forget(waiting)
            why = "the node ends" if self._ending else f"no reply within {timeout_s:g} s"
            raise RequestFailedError(
                f"the server at {self._link.address} did not answer {action}: {why}; "
                "whether it was done is not known"
            )
        reply = waiting.result()
        if reply.get("ok") is not True:
            raise RefusedError(refusal(reply))
        return reply

    def shut_server_down(self, timeout_s: float = SHUTDOWN_TIMEOUT_S) -> str:
        """Ask the server to shut down; a sentence. RefusedError if it will not, RequestFailedError if nobody
        knows.

        Where there is no connection it makes one attempt of its own.
        """
        address = self._link.address
        connection, own = self._link.connection, None
        try:
            if connection is None:
                own = Connection(self._parameters.server_host, self._parameters.server_port, timeout_s)
                own.ask("shutdown")
            else:
                self._exchange(connection, "shutdown", timeout_s, {})
        except (RefusedError, RefusalError) as error:
            raise RefusedError(f"the server at {address} refused to shut down: {error}") from None
        except RequestFailedError:
            raise RequestFailedError(
                f"the server at {address} did not answer the request to shut down"
            ) from None
        except ConnectionFailedError as error:
            raise RequestFailedError(
                f"the server at {address} could not be told to shut down: {error}"
            ) from None
        finally:
            if own is not None:
                own.close()
        return f"the server at {address} is shutting down"
