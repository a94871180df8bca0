# SPDX-License-Identifier: Apache-2.0
"""Every exception that `protocol` raises."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bota_ethercat.text.untrusted import printable


class ProtocolError(Exception):
    """Base of all errors here; the text is one sentence for users."""


class FileError(ProtocolError):
    """A file cannot be written, or would replace another."""


class PdoSizeError(ProtocolError):
    """Process data of a size that no known sensor has."""


class RemoteProtocolError(ProtocolError):
    """The peer broke the framing, so nothing after it can be trusted: answer, then close the connection."""


class BadMessageError(ProtocolError):
    """One message was not a JSON object; the framing is intact: answer it and carry on."""


class RequestError(ProtocolError):
    """A request that is refused: answer it and carry on.

    `code` is one of `bota_ethercat.control.ErrorCode`.
    """

    def __init__(self, code: str, message: str, **extra: object) -> None:
        super().__init__(message)
        self.code = code
        self.extra = extra


class SettingError(ProtocolError):
    """A setting that does not exist, or a value that is not allowed."""


class ConnectionFailedError(ProtocolError):
    """The connection cannot be made or has ended; the text says why. Close it."""


class UnreachableError(ConnectionFailedError):
    """Nothing answers at that address; a client's own is the sentence of `health.sentences.no_server`."""


class NoReplyError(ConnectionFailedError):
    """A request was not answered in time; it may have been carried out."""


class RefusedError(ProtocolError):
    """The server refused a request; the connection goes on. The text is its message, made safe to print.

    `code` is one of `bota_ethercat.control.ErrorCode`, `abort_code` the SDO abort code behind it, if any.
    """

    def __init__(self, code: str, message: str, abort_code: int | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.abort_code = abort_code

    @classmethod
    def of(cls, reply: Mapping[str, Any]) -> RefusedError:
        """The error of a `reply` that refuses a request."""
        error = reply.get("error")
        if not isinstance(error, dict):
            return cls("internal", "the server gave no reason")
        abort_code = error.get("abort_code")
        return cls(
            printable(error.get("code", "no code"), 40),
            printable(error.get("message", "the server gave no reason"), 1000),
            abort_code if isinstance(abort_code, int) and not isinstance(abort_code, bool) else None,
        )
