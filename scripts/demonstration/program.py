"""The demo, started by scripts/demo in a network namespace of its own.

Starts `ethercat-server virtual`, `bridge-client` and an rclpy subscriber, shows what arrives, and judges it.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import shutil
import signal
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final

from protocol.client import Client
from protocol.errors import ConnectionFailedError, ProtocolError
from scripts.demonstration.child import Child, DemoError
from scripts.demonstration.measure import FULL_RATE, Measurement, verdict
from scripts.demonstration.show import Screen, print_summary, say
from scripts.demonstration.stops import Canaries

PORT: Final = 12001
TOPIC: Final = "/sensone_sensor_data"
_START_TIMEOUT_S: Final = 30.0


class Stopped(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


def loopback_up() -> None:
    """Set the new namespace's loopback interface up, as `ip link set lo up` does."""
    siocgifflags, siocsifflags, iff_up = 0x8913, 0x8914, 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, siocgifflags, struct.pack("16sh14x", b"lo", 0))
        (flags,) = struct.unpack_from("h", answer, 16)
        fcntl.ioctl(any_socket, siocsifflags, struct.pack("16sh14x", b"lo", flags | iff_up))


def wait_for_server(server: Child) -> tuple[Client, dict[str, Any]]:
    """Connect as soon as the server describes a sensor; its row of the description."""
    deadline = time.monotonic() + _START_TIMEOUT_S
    while time.monotonic() < deadline:
        server.check()
        with contextlib.suppress(ProtocolError):
            client = Client(PORT)
            if sensors := client.description["sensors"]:
                return client, sensors[0]
            client.close()
        time.sleep(0.1)
    raise DemoError(f"the server did not get ready within {_START_TIMEOUT_S:g} s")


class Ears:
    """The two threads that listen: to the server and to the ROS topic."""

    def __init__(self, client: Client, measurement: Measurement) -> None:
        import rclpy  # noqa: PLC0415 - only now that the signals are in hand
        from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415
        from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415
        from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

        from bridge.spinning import Spinner  # noqa: PLC0415

        self._client = client
        self.measurement = measurement
        self.lock = threading.Lock()
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._rclpy = rclpy
        self._node = rclpy.create_node("demo")
        self._node.create_subscription(Float64MultiArray, TOPIC, self._on_message, 50)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._spinner = Spinner(self._executor)
        self._threads = [
            threading.Thread(target=self._hear_server, daemon=True),
            threading.Thread(target=self._spinner.run, daemon=True),
        ]
        client.subscribe()
        for thread in self._threads:
            thread.start()

    def _hear_server(self) -> None:
        with contextlib.suppress(ConnectionFailedError):
            for frame in self._client.frames():
                now_ns = time.monotonic_ns()
                with self.lock:
                    self.measurement.take_frame(frame, now_ns)

    def _on_message(self, message: Any) -> None:
        now_ns = time.monotonic_ns()
        with self.lock:
            self.measurement.take_message(message.data, now_ns)

    def close(self) -> None:
        """Stop listening."""
        self._client.close()
        self._spinner.stop()
        for thread in self._threads:
            thread.join(3)
        self._executor.shutdown()
        self._node.destroy_node()
        self._rclpy.try_shutdown()


def run(seconds: float | None, directory: Path) -> int:
    """The demo itself; returns the exit code. DemoError or Stopped end it early."""
    loopback_up()
    measurement = Measurement()
    binaries = Path(sys.executable).parent
    with contextlib.ExitStack() as stack:
        children: list[Child] = []

        def start(name: str, *command: str) -> Child:
            children.append(Child(name, [str(binaries / name), *command], directory))
            return children[-1]

        troubles: list[str | None] = []

        def stop_children() -> None:
            ignore_signals()
            # The client first: the server's end is not to look like a failure to it.
            troubles.extend([child.stop() for child in reversed(children)])

        stack.callback(stop_children)
        server = start("ethercat-server", "virtual", str(PORT))
        start("bridge-client", "--ros-args", "-p", f"server_port:={PORT}")
        client, sensor = wait_for_server(server)
        stack.callback(client.close)
        measurement.rate_hz = float(sensor["rate_hz"])
        # Before the threads that listen: each fork would keep them from reading.
        canaries = Canaries(directory, 1e9 / measurement.rate_hz)
        stack.callback(canaries.stop)
        ears = Ears(client, measurement)
        stack.callback(ears.close)
        wait_for_messages(children, measurement)
        canaries.wait()
        with ears.lock:
            measurement.begin()
        with contextlib.suppress(Stopped), Screen(sensor) as screen:
            show(screen, ears, children, seconds)
        ignore_signals()
        with ears.lock:  # what comes while they end is none of the figures
            summary = measurement.summary(canaries.stop())
    print_summary(summary, sensor)
    trouble = verdict(summary, float(sensor["rate_hz"])) or next(filter(None, troubles), None)
    if trouble is not None:
        raise DemoError(trouble)
    if summary.rate_hz < FULL_RATE * float(sensor["rate_hz"]):
        say(f"Only {summary.rate_hz:.0f} messages/s arrived: this machine was too busy to keep up.")
    return 0


def wait_for_messages(children: Sequence[Child], measurement: Measurement) -> None:
    """Wait until the ROS topic delivers the server's samples."""
    deadline = time.monotonic() + _START_TIMEOUT_S
    while not measurement.began:
        for child in children:
            child.check()
        if time.monotonic() > deadline:
            raise DemoError(f"nothing arrived on {TOPIC} within {_START_TIMEOUT_S:g} s")
        time.sleep(0.05)


def show(screen: Screen, ears: Ears, children: Sequence[Child], seconds: float | None) -> None:
    """Show what arrives until the time is over or Stopped is raised."""
    began = time.monotonic()
    due = began
    while seconds is None or time.monotonic() < began + seconds:
        due += screen.period_s
        end = due if seconds is None else min(due, began + seconds)
        time.sleep(max(end - time.monotonic(), 0))
        for child in children:
            child.check()
        with ears.lock:
            screen.show(ears.measurement)


def on_signal(_number: int, _frame: FrameType | None) -> None:
    """End what runs with Stopped."""
    ignore_signals()  # taking things down is not to be stopped half-way
    raise Stopped


def ignore_signals() -> None:
    """From here on there is only the way out."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _seconds(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0.5 <= float(text) <= 1e6:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a number of seconds from 0.5 to 1000000")


def main() -> int:
    """Parse the arguments and run."""
    sys.stdout.reconfigure(errors="replace")  # type: ignore[union-attr]
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    directory = Path(os.environ.get("DEMO_DIRECTORY") or tempfile.mkdtemp())
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        parser = argparse.ArgumentParser(
            prog="scripts/demo", description="The whole chain, without hardware."
        )
        parser.add_argument("--seconds", type=_seconds, help="end after so many seconds; else Ctrl-C ends it")
        return run(parser.parse_args().seconds, directory)
    except Stopped:
        print("stopped before anything was measured")
        return 0
    except BrokenPipeError:  # nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except DemoError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    finally:
        shutil.rmtree(directory, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
