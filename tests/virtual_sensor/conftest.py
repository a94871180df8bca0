"""A veth pair and virtual sensor processes on its ends, always cleared away."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

import pytest

from tests.server.running import NO_BUS, Veth, VirtualSensor

Start = Callable[..., VirtualSensor]


@pytest.fixture
def veth() -> Iterator[tuple[str, str]]:
    """Names of the two ends, both up: the sensor's, the master's."""
    if NO_BUS is not None:
        pytest.skip(NO_BUS)
    with Veth() as pair:
        yield pair.far, pair.near


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts virtual sensors, and waits until they are ready unless they cannot be."""
    with contextlib.ExitStack() as running:

        def launch(*arguments: str, ready: bool = True, under: Sequence[str] = ()) -> VirtualSensor:
            program = VirtualSensor("ethercat_server.virtual_sensor.cli", arguments, under)
            running.callback(program.close)
            if ready:
                program.wait_for("ready")
            return program

        yield launch
