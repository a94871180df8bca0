"""Clients over TCP: a framed connection, the small blocking client, real-time scheduling.

The only sockets in `protocol`.
"""

from protocol.client.client import Client, NoSampleError, connect
from protocol.client.real_time import Scheduling, make_real_time

__all__ = ["Client", "Scheduling", "connect", "make_real_time"]
