"""The client: samples, conditions, requests and events over TCP, and real-time scheduling."""

from protocol.client.client import Client, NoSampleError, connect
from protocol.client.reading import Condition, Reading
from protocol.client.real_time import Scheduling, make_real_time
from protocol.client.session import ClientEvent, Connected, Disconnected

__all__ = [
    "Client", "ClientEvent", "Condition", "Connected", "Disconnected", "NoSampleError", "Reading",
    "Scheduling", "connect", "make_real_time",
]  # fmt: skip
