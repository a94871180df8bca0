"""Requests to the server from other threads than the reader's: every one answered, refused or timed out."""

from __future__ import annotations

from typing import Final

from bridge.stream.link import Link, RequestFailedError
from protocol.client.client import Client
from protocol.errors import ConnectionFailedError, NoReplyError, RefusedError
from protocol.text.json_text import JsonObject

CONFIGURE_TIMEOUT_S: Final = 10.0
DESCRIBE_TIMEOUT_S: Final = 3.0
SHUTDOWN_TIMEOUT_S: Final = 3.0


class RequestRefusedError(RequestFailedError):
    """The server refused; the text is its own sentence."""


class Requests:
    """Asks the server that `link` is connected to."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._ending = False

    def cancel(self) -> None:
        """Make whoever waits for a reply give up, now and from now on: the node ends."""
        self._ending = True
        self._link.client.close()

    def ask(self, action: str, timeout_s: float, **values: object) -> JsonObject:
        """The reply that grants the request; RequestFailedError otherwise. Blocks for `timeout_s` at most."""
        link = self._link
        if not link.is_connected:
            raise RequestFailedError(f"{link.absence}: ask again when the node is connected")
        try:
            return link.client.ask(action, timeout_s, **values)
        except RefusedError as error:
            raise RequestRefusedError(f"{error} ({error.code})") from None
        except ConnectionFailedError as error:
            if not self._ending and not isinstance(error, NoReplyError):
                raise RequestFailedError(f"the server at {link.address} is gone: {error}") from None
            why = "the node ends" if self._ending else f"no reply within {timeout_s:g} s"
            raise RequestFailedError(
                f"the server at {link.address} did not answer {action}: {why}; "
                "whether it was done is not known"
            ) from None

    def shut_server_down(self, timeout_s: float = SHUTDOWN_TIMEOUT_S) -> str:
        """Ask the server to shut down; a sentence. RequestRefusedError if it will not, RequestFailedError if
        nobody knows.

        Where there is no connection it makes one attempt of its own.
        """
        client, address = self._link.client, self._link.address
        try:
            if self._link.is_connected:
                client.ask("shutdown", timeout_s)
            else:
                host, port = client.address
                with Client(port, host, stream=False, reconnect=False) as own:
                    own.connect().ask("shutdown", timeout_s)
        except RefusedError as error:
            raise RequestRefusedError(
                f"the server at {address} refused to shut down: {error} ({error.code})"
            ) from None
        except NoReplyError:
            raise RequestFailedError(
                f"the server at {address} did not answer the request to shut down"
            ) from None
        except ConnectionFailedError as error:
            raise RequestFailedError(
                f"the server at {address} could not be told to shut down: {error}"
            ) from None
        return f"the server at {address} is shutting down"
