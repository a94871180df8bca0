"""The demo, started by scripts/demo in a network namespace of its own.

Starts `ethercat-server virtual`, `bridge-client` and an rclpy subscriber, shows what arrives, and judges it.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client import Client, Connected, Disconnected
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import SampleDecoder
from bota_ethercat.program.arguments import number
from scripts.benchmarks.records import PORT, REAL_TIME
from scripts.chain import Chain, ScriptError, Stopped, ignore_signals, loopback_up, stoppable
from scripts.demonstration.measure import FULL_RATE, Figures, Measurement, verdict

TOPIC: Final = "/wrench"
_SHOW_S: Final = 1.0
_VECTORS: Final = (
    ("force", "N", 2), ("torque", "Nm", 3), ("acceleration", "m/s²", 3), ("angular_rate", "rad/s", 4),
)  # fmt: skip


@contextlib.contextmanager
def listening(measurement: Measurement) -> Iterator[deque[str]]:
    """Two threads take what comes from the server and on the ROS topic; yields what is to be told."""
    import rclpy  # noqa: PLC0415 - only now are signals handled
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

    from bota_ethercat_bridge.rclpy_internals import taking  # noqa: PLC0415

    told, is_over = deque[str](maxlen=9), threading.Event()
    client = Client(PORT, raw=True)

    def on_message(message: Any) -> None:
        now_ns, stamp, wrench = time.time_ns(), message.header.stamp, message.wrench
        values = [getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"]
        measurement.add_message(stamp.sec * 10**9 + stamp.nanosec, values, now_ns)

    def subscribe() -> None:
        while not is_over.is_set():
            take(0.1)

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("demo", start_parameter_services=False)
    take = taking(node, node.create_subscription(WrenchStamped, TOPIC, on_message, 50))
    threads = [
        threading.Thread(target=each, daemon=True)
        for each in (partial(receive, client, measurement, told), subscribe)
    ]
    for thread in threads:
        thread.start()
    try:
        yield told
    finally:
        is_over.set()
        client.close()
        for thread in threads:
            thread.join(3)
        node.destroy_node()
        rclpy.try_shutdown()


def receive(client: Client, measurement: Measurement, told: deque[str]) -> None:
    """Take what comes from the server until the client is closed; a connection that ends is told."""
    with contextlib.suppress(ConnectionFailedError):
        while True:
            for item in client.poll_all(_SHOW_S):
                if isinstance(item, DataMessage):
                    measurement.add_frame(item)
                elif isinstance(item, Disconnected) and item.was_connected:
                    measurement.interrupted()
                    told.append(f"the connection to the server ended ({item.reason}): connecting again")
                elif isinstance(item, Connected) and item.again:
                    told.append("connected again; what the server sent meanwhile is not compared")


def show(measurement: Measurement) -> None:
    """A line: the rate and age of the messages since the last one, all losses, and the latest sample."""
    newest, frame = measurement.take_newest(), measurement.latest
    figures = (
        f"{newest.rate_hz:7.1f} Hz  age {newest.age_ms[0]:.2f} ms  lost {newest.lost + newest.lost_before}  "
        f"repeated {newest.repeated}"
    )
    measurement.latest = None
    if frame is not None:
        sample = SampleDecoder(len(frame.process_data)).decode(frame.process_data)
        for name, unit, digits in _VECTORS:
            values = " ".join(f"{value:+.{digits}f}" for value in getattr(sample, name))
            figures += f"  {unit} {values}"
    print(f"{figures}{'' if frame else '  no samples from the server'}", flush=True)


def print_summary(summary: Figures, sensor: Mapping[str, Any]) -> None:
    """The figures of the whole run."""
    print("What arrived on the ROS topic:")
    for name, value in (
        ("Messages", summary.messages),
        ("Mean rate", f"{summary.rate_hz:.1f} Hz"),
        ("Sensor's own rate", f"{sensor['rate_hz']} Hz"),
        ("Lost", summary.lost + summary.lost_before),
        ("  before or withheld (GAP)", summary.lost_before),
        ("  between server and subscriber", summary.lost),
        ("Repeated", summary.repeated),
        ("Age at the subscriber, p50", f"{summary.age_ms[0]:.2f} ms"),
        ("Age at the subscriber, p99", f"{summary.age_ms[1]:.2f} ms"),
        ("All finite", "yes" if summary.all_finite else "NO"),
        ("All are samples of the sensor", "NO" if summary.unknown else "yes"),
    ):
        print(f"  {name:<34}{value:>10}")
    if summary.paused_s:
        print(f"For {summary.paused_s:.0f} s no message came; the rate is that of the rest.")
    if summary.lost + summary.lost_before:
        print("Samples are missing: other programs had the processors for some time. docs/tuning.md helps.")


def run(seconds: float | None) -> int:
    """The demo itself; returns the exit code. ScriptError or Stopped end it early."""
    loopback_up()
    binaries = Path(sys.executable).parent
    with Chain() as chain:
        chain.start("ethercat-server", binaries / "ethercat-server", "virtual", PORT)
        chain.start("bridge-client", binaries / "bridge-client", "--ros-args", "-p", f"server_port:={PORT}",
                    "-p", f"rt_priority:={REAL_TIME}")  # fmt: skip
        sensor = chain.connect(1).description["sensors"][0]
        measurement = Measurement(float(sensor["rate_hz"]))
        with listening(measurement) as told:
            chain.wait(lambda: measurement.messages > 0, f"nothing arrived on {TOPIC}")
            measurement.begin()
            print(f"{sensor['name']}, serial {sensor['serial']}, {sensor['rate_hz']} Hz, virtual", flush=True)
            with contextlib.suppress(Stopped):
                end = time.monotonic() + (seconds or float("inf"))
                while (left := end - time.monotonic()) > 0:
                    chain.sleep(min(_SHOW_S, left))
                    while told:
                        print(told.popleft(), flush=True)
                    show(measurement)
            ignore_signals()
            summary = measurement.summary()  # what comes while they end is none of the figures
        troubles = chain.stop()
    print_summary(summary, sensor)
    if trouble := verdict(summary, float(sensor["rate_hz"])) or next(iter(troubles), None):
        raise ScriptError(trouble)
    if summary.rate_hz < FULL_RATE * float(sensor["rate_hz"]):
        print(f"Only {summary.rate_hz:.0f} messages/s arrived: this machine was too busy to keep up.")
    return 0


def _demo() -> int:
    seconds = number(0.5, 1e6, "a number of seconds")
    parser = argparse.ArgumentParser(prog="scripts/demo", description="The whole chain, without hardware.")
    parser.add_argument("--seconds", type=seconds, help="end after this number of seconds, not at Ctrl-C")
    return run(parser.parse_args().seconds)


def main() -> int:
    """Parse the arguments and run."""
    sys.stdout.reconfigure(errors="replace")  # type: ignore[union-attr]
    return stoppable(_demo, "demo", "stopped before anything was measured", 0)


if __name__ == "__main__":
    sys.exit(main())
