"""Every exception that `protocol` raises.

ProtocolError
+-- PdoSizeError          process data of a size no sensor has
+-- RemoteProtocolError   the peer broke the framing: answer it, then close the connection
+-- BadMessageError       one message was no JSON object: answer it and carry on
+-- RequestError          one request cannot be granted: answer it and carry on
+-- SettingError          a setting's name or value is wrong
"""

from __future__ import annotations

from collections.abc import Sequence


class ProtocolError(Exception):
    """Base of all errors here; its text is one sentence for a person."""


class PdoSizeError(ProtocolError):
    """Process data of a size that no known sensor has."""

    def __init__(self, size: int, known: Sequence[int]) -> None:
        choices = " or ".join(str(n) for n in known)
        super().__init__(f"process data of {size} bytes: a Bota Gen-0 sensor maps {choices}")
        self.size = size


class RemoteProtocolError(ProtocolError):
    """The peer sent bytes that are not this protocol; nothing after them can be trusted."""


class BadMessageError(ProtocolError):
    """One message was not a JSON object; the framing is intact and the next message can be read."""


class RequestError(ProtocolError):
    """A request that is refused. `code` is one of `protocol.control.ErrorCode`."""

    def __init__(self, code: str, message: str, **extra: object) -> None:
        super().__init__(message)
        self.code = code
        self.extra = extra


class SettingError(ProtocolError):
    """A setting that does not exist, or a value that it cannot have."""
