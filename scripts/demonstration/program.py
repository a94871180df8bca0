"""The demo, started by scripts/demo in a network namespace of its own.

Starts `ethercat-server virtual`, `bridge-client` and an rclpy subscriber that counts as `check_subscription`
does, shows what arrives, and judges it. Time and memory do not grow with the run.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from bota_ethercat.distribution import Distribution
from bota_ethercat.program.arguments import number
from bota_ethercat_bridge.subscription import Counted, report
from scripts.benchmarks.records import PORT, REAL_TIME
from scripts.chain import Chain, ScriptError, Stopped, ignore_signals, loopback_up, stoppable

TOPIC: Final = "/wrench"
_PUBLISHED: Final = "/bridge/published"
_DEPTH: Final = 50
_SHOW_S: Final = 1.0
_FULL_RATE: Final = 0.95  # fewer messages than this part of the samples: something could not keep up
_LEAST_RATE: Final = 0.6  # fewer than this part, and something is wrong
_PAUSE_NS: Final = 10**9  # without a message for longer: this computer was suspended, say


class Rate:
    """Messages per second, but for pauses."""

    def __init__(self) -> None:
        self._intervals = self._span_ns = 0
        self._newest_ns: int | None = None
        self.paused_ns = 0

    def arrived(self, now_ns: int) -> None:
        """By CLOCK_MONOTONIC."""
        passed_ns = now_ns - (now_ns if self._newest_ns is None else self._newest_ns)
        if passed_ns > _PAUSE_NS:
            self.paused_ns += passed_ns
        elif self._newest_ns is not None:
            self._intervals, self._span_ns = self._intervals + 1, self._span_ns + passed_ns
        self._newest_ns = now_ns

    @property
    def hz(self) -> float:
        """0 if it is not known."""
        return self._intervals * 1e9 / self._span_ns if self._span_ns else 0.0


class Shown(Counted):
    """What arrived on the topic: counted as a whole, and since the last line."""

    def __init__(self) -> None:
        super().__init__(TOPIC)
        self.rate, self.all_finite = Rate(), True
        self._begin_line()

    def _begin_line(self) -> None:
        self._line_rate, self._line_ages, self._values = Rate(), Distribution(), tuple[float, ...]()

    def take(self, message: Any, now_ns: int, monotonic_ns: int) -> None:
        """A message, when it arrived: since 1970, and by CLOCK_MONOTONIC."""
        self.receive(message.header.stamp, now_ns)
        self._line_ages.count(array("f", [self.age_ns]))
        for rate in (self.rate, self._line_rate):
            rate.arrived(monotonic_ns)
        wrench = message.wrench
        self._values = (*(getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"),)
        self.all_finite = self.all_finite and all(map(math.isfinite, self._values))

    def line(self) -> str:
        """Of the messages since the last line: rate, age and the newest; of the run what is missing."""
        age_ms, shown = self._line_ages.summary_us()["p50"] / 1e3, "  nothing arrived"
        if values := [f"{value:+.2f}" for value in self._values]:
            shown = f"  age {age_ms:.2f} ms  N {' '.join(values[:3])}  Nm {' '.join(values[3:])}"
        text = f"{self._line_rate.hz:7.1f} Hz  lost {self.lost}, missing {self.missing}{shown}"
        self._begin_line()
        return text

    def verdict(self, nominal_hz: float) -> str | None:
        """What is wrong, in one sentence; None if all is well."""
        if not self.received:
            return "nothing arrived on the ROS topic"
        if not self.all_finite:
            return "a message held a number that is not finite"
        if not _LEAST_RATE * nominal_hz <= self.rate.hz <= 1.05 * nominal_hz:
            return f"{self.rate.hz:.1f} messages/s arrived and the sensor makes {nominal_hz:g} samples/s"
        return None

    def summary(self, nominal_hz: float) -> Iterator[str]:
        """Of the whole run, a sentence each."""
        yield f"{self.rate.hz:.1f} messages/s arrived, of the sensor's {nominal_hz:g} samples/s"
        yield from report(self, _DEPTH, best_effort=False)
        if self.rate.paused_ns:
            yield f"for {self.rate.paused_ns * 1e-9:.0f} s no message came; the rate is that of the rest"
        if self.missing or self.rate.hz < _FULL_RATE * nominal_hz:
            yield "other programs had the processors for some time: docs/tuning.md helps"


@contextlib.contextmanager
def subscribed(shown: Callable[[], Shown]) -> Iterator[Callable[[float], object]]:
    """Yields what waits, at most for so many seconds, and hands on what is there."""
    import rclpy  # noqa: PLC0415 - only now are signals handled
    from diagnostic_msgs.msg import DiagnosticArray  # noqa: PLC0415
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

    from bota_ethercat_bridge.rclpy_internals import taking  # noqa: PLC0415

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("demo", start_parameter_services=False)
    take, published = (
        node.create_subscription(kind, name, act, depth)
        for kind, name, act, depth in (
            (WrenchStamped, TOPIC, lambda it: shown().take(it, time.time_ns(), time.monotonic_ns()), _DEPTH),
            (DiagnosticArray, _PUBLISHED, lambda report: shown().published(report), 10),
        )
    )
    try:
        yield taking(node, published, take)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def run(seconds: float | None) -> int:
    """The demo itself; returns the exit code. ScriptError or Stopped end it early."""
    loopback_up()
    binaries = Path(sys.executable).parent
    with Chain() as chain:
        chain.start("ethercat-server", binaries / "ethercat-server", "virtual", PORT)
        chain.start("bridge-client", binaries / "bridge-client", "--ros-args", "-p", f"server_port:={PORT}",
                    "-p", f"rt_priority:={REAL_TIME}")  # fmt: skip
        sensor = chain.connect(1).description["sensors"][0]
        shown, nominal_hz = Shown(), float(sensor["rate_hz"])

        def arrived() -> bool:
            take(0.0)
            return shown.received > 0

        with subscribed(lambda: shown) as take:
            chain.wait(arrived, f"nothing arrived on {TOPIC}")
            shown = Shown()  # what came while things were starting does not count
            print(f"{sensor['name']}, serial {sensor['serial']}, {nominal_hz:g} Hz, virtual", flush=True)
            with contextlib.suppress(Stopped):
                end = time.monotonic() + (seconds or math.inf)
                while (now := time.monotonic()) < end:
                    line_end = min(now + _SHOW_S, end)
                    while (left := line_end - time.monotonic()) > 0:
                        take(left)
                    chain.check()
                    print(shown.line(), flush=True)
            ignore_signals()
        troubles = chain.stop()
    for sentence in shown.summary(nominal_hz):
        print(sentence)
    if trouble := shown.verdict(nominal_hz) or next(iter(troubles), None):
        raise ScriptError(trouble)
    return 0


def _demo() -> int:
    seconds = number(0.5, 1e6, "a number of seconds")
    parser = argparse.ArgumentParser(prog="scripts/demo", description="The whole chain, without hardware.")
    parser.add_argument("--seconds", type=seconds, help="end after this number of seconds, not at Ctrl-C")
    return run(parser.parse_args().seconds)


if __name__ == "__main__":
    sys.exit(stoppable(_demo, "demo", "stopped before anything was measured", 0))
