"""One exchange of process data after the other, for tests of what an exchange brings."""

from __future__ import annotations

from ethercat_server.ethercat.bus import Bus


class Exchange:
    """Sends the process data of `bus`, and waits for it."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.inputs: dict[int, bytes] = {}
        """Of each sensor, as of the last exchange that came back."""

    def __call__(self, timeout_s: float = 0.01) -> int:
        """The working counter of all frames; -1 if one did not come back in time."""
        process_data, clock = self.bus.process_data, self.bus.clock
        until_ns = clock.monotonic_ns() + round(timeout_s * 1e9)
        began_ns, awaited, total = clock.monotonic_ns(), len(process_data.inputs), 0
        process_data.send()
        while awaited:
            left_ns = until_ns - clock.monotonic_ns()
            if left_ns <= 0 or (frame := self.bus.backend.receive(left_ns * 1e-9)) is None:
                return -1
            answer = process_data.take(frame, clock.monotonic_ns())
            if answer is not None and answer.sent_ns > began_ns:
                awaited -= 1
                total += answer.wkc
                for at in process_data.inputs[answer.which]:
                    self.inputs[at.number] = frame[at.start : at.end]
        return total
