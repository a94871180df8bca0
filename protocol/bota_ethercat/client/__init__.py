# SPDX-License-Identifier: Apache-2.0
"""The client: samples, conditions, requests and events over TCP, and real-time scheduling."""

from bota_ethercat.client.client import Client, NoSampleError, connect
from bota_ethercat.client.reading import Condition, Reading
from bota_ethercat.client.session import ClientEvent, Connected, Disconnected
from bota_ethercat.client.world import World
from bota_ethercat.program.real_time import Scheduling, make_real_time

__all__ = [
    "Client", "ClientEvent", "Condition", "Connected", "Disconnected", "NoSampleError", "Reading",
    "Scheduling", "World", "connect", "make_real_time",
]  # fmt: skip
