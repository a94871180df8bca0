"""Clients over TCP: a framed connection, and the small blocking client. The only sockets in `protocol`."""

from protocol.client.blocking import Client, connect

__all__ = ["Client", "connect"]
