"""The whole server with virtual sensors, for a simulated node: both in the same simulated time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bota_ethercat.errors import UnreachableError
from ethercat_server.acquisition.stream import Made
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.bridge.simulated_node import STEP_S, Wire
from tests.simulation import Simulation

SLOW = {"sinc_length": 512}
"""100 samples a second: what is tested here is no question of speed."""


class Serving(Simulation):
    """Stops after each sample, so that the node gets it at once."""

    def note(self, made: Sequence[Made]) -> None:
        super().note(made)
        self.cycle.stop()


class WholeServer:
    """A `World`. Samples come at 100 Hz."""

    def __init__(self, *sensors: SensorOptions) -> None:
        self.simulation = Serving(*sensors, settings=SLOW)
        self.clock = self.simulation.clock
        self.monotonic_ns, self.time_ns = self.clock.monotonic_ns, self.clock.time_ns
        self.is_stopped = False
        """As by SIGSTOP."""
        self._wire: Wire | None = None

    def accept(self, wire: Wire) -> Callable[[bytes], object]:
        try:
            self._stream = self.simulation.transport.connect()
        except ConnectionRefusedError:
            raise UnreachableError("Connection refused") from None
        self._wire = wire
        return self._stream.send

    def close(self) -> None:
        """End the server, as by SIGTERM."""
        self.simulation.close()

    def start_again(self) -> None:
        """Start another server on the same sensors."""
        self.simulation = Serving(backend=self.simulation.backend, settings=SLOW)

    def step(self) -> None:
        """Let time pass until there is something for the node, STEP_S at most."""
        until_ns = self.clock.now_ns + round(STEP_S * 1e9)
        if self.is_stopped or not self.simulation.transport.listening():
            self.clock.advance(until_ns)
        else:
            self.simulation.run(STEP_S)
        if self._wire is not None:
            self._wire.feed(self._stream.recv_all())
            if self._stream.at_end:
                self._wire.end()
                self._wire = None
