"""Who may see the page and who may tare: checks of a request's Host and Origin, and the token.

A page of another site can make a browser send requests here, even under a host name of its own that resolves
to this machine (DNS rebinding). Then Host or Origin has that name. Requests are answered only under a name of
this machine, any port, because `ssh -L` may forward another one; the stream only to the page itself.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from typing import Final
from urllib.parse import urlsplit

HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Of every response."""


def is_loopback(host: str) -> bool:
    """Whether a host, without port, is this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refused_host(host: str | None) -> str | None:
    """Why a request with this Host is refused, one sentence; None if it is not."""
    try:
        name = urlsplit(f"//{host}").hostname if host else None
    except ValueError:
        name = None
    if name and is_loopback(name):
        return None
    return "The page is for this machine only: open http://localhost:PORT/, from elsewhere over ssh -L."


def refused_origin(origin: str | None, host: str | None) -> str | None:
    """Why a stream is refused to a page of `origin`, one sentence; None if it is not."""
    if origin is not None and host and origin.lower() == f"http://{host.lower()}":
        return None
    return "The stream is for the page that is served here, and not for others."


class Token:
    """The secret in the link that the terminal prints; who has it may tare."""

    def __init__(self) -> None:
        self.text: Final = secrets.token_urlsafe(24)

    def is_right(self, given: object) -> bool:
        """Compare in constant time."""
        if not isinstance(given, str):
            return False
        return hmac.compare_digest(given.encode(errors="replace"), self.text.encode())
