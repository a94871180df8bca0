# SPDX-License-Identifier: Apache-2.0
"""Tells a virtual sensor what it feels: `ethercat-virtual-sensor IFACE --world PATH`."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence

from bota_ethercat.world import REST, Felt, encode


class World:
    """The way to the virtual sensor whose `--world` is `path`, which may start, end and start again.

    with World("/tmp/world") as world:
        world.send(time.monotonic(), wrench=(0, 0, -10, 0, 0, 0))
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(
        self,
        t: float,
        wrench: Sequence[float],
        acceleration: Sequence[float] = REST.acceleration,
        angular_rate: Sequence[float] = REST.angular_rate,
        temperature: float = REST.temperature,
        sensor: int = 0,
    ) -> bool:
        """What a sensor feels at `t`, s of CLOCK_MONOTONIC; False if there is none, or it is behind.

        In the sensor's frame: force (N) and torque (Nm), specific force (m/s²), angular rate (rad/s).
        """
        felt = Felt(tuple(wrench), tuple(acceleration), tuple(angular_rate), temperature)
        try:
            self._socket.sendto(encode(t, felt, sensor), self.path)
        except (BlockingIOError, ConnectionError, FileNotFoundError):
            return False
        return True

    def close(self) -> None:
        """Close the socket; the sensor does with the last values what its `--world-lost` says."""
        self._socket.close()

    def __enter__(self) -> World:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
