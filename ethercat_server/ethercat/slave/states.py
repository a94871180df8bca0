"""Takes one slave from AL state to AL state, one or two datagrams a step. Source: ETG.1000.6."""

from __future__ import annotations

from ethercat_server.errors import BusError, SetUpError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave import times
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from ethercat_server.ethercat.slave.coe import Steps


class GoneError(SetUpError):
    """The slave stopped answering in the middle."""


class StateMachine:
    """The AL state machine of sensor `number`; each datagram is tried `attempts` times."""

    def __init__(self, bus: Bus, number: int, attempts: int = 1) -> None:
        self._bus = bus
        self._number = number
        self._attempts = range(attempts)

    def status(self) -> AlStatus | None:
        """Its AL status; None if it does not answer."""
        for _ in self._attempts:
            data = self._bus.read_register(self._number, reg.AL_STATUS, reg.AL_STATUS_SIZE)
            if data is not None:
                return AlStatus.parse(data)
        return None

    def write(self, address: int, data: bytes) -> None:
        """Write registers; GoneError if it does not answer."""
        if not any(self._bus.write_register(self._number, address, data) for _ in self._attempts):
            raise self._gone()

    def go(self, state: AlState) -> Steps[None]:
        """Request an AL state and wait for it; an error is acknowledged first. GoneError, or BusError."""
        status = self.status()
        if status is not None and status.error:
            yield from self._acknowledge(status)
        self.write(reg.AL_CONTROL, state.request())
        deadline = Deadline(self._bus.clock, times.STATE_S[state])
        while True:
            status = yield from self._next_status()
            if status.state is state and not status.error:
                return
            if status.error or deadline.passed:
                raise BusError(f"sensor {self._number} does not go to {state.name}: it is in {status}")

    def _acknowledge(self, status: AlStatus) -> Steps[None]:
        """Acknowledge an error and wait until it is gone: a request before would overwrite the acknowledge.

        The slave looks at AL control when it comes to it, and sees only what was written last.
        """
        self.write(reg.AL_CONTROL, status.acknowledge())
        deadline = Deadline(self._bus.clock, times.ACKNOWLEDGE_S)
        while (now := (yield from self._next_status())).error:
            if deadline.passed:
                raise BusError(
                    f"sensor {self._number} keeps its error although it was acknowledged: it is in {now}"
                )

    def _next_status(self) -> Steps[AlStatus]:
        yield
        status = self.status()
        if status is None:
            raise self._gone()
        return status

    def _gone(self) -> GoneError:
        return GoneError(f"sensor {self._number} does not answer: check cable and power")
