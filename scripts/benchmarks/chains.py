"""What is compared: this project and the polling design, each up to a TCP client and to a ROS subscriber, and
a bare C program. Each function runs one and returns its figures, and the ages for the plot.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import PORT, Chain, Setup, chain, recording, start_server
from scripts.benchmarks.processes.polling import TOPIC as POLLING_TOPIC
from scripts.benchmarks.statistics import Floats
from scripts.demonstration.child import Child

Figures = dict[str, Any]
_CLIENT: Final = "scripts.benchmarks.processes.client"
_YARDSTICK: Final = "scripts.benchmarks.processes.yardstick"
_POLLING: Final = "scripts.benchmarks.processes.polling"
_PORTS_BESIDE: Final = 1
"""The other programs' port is the server's and this."""


def yardstick(setup: Setup, ifname: str, sensor: int, program: Path) -> tuple[Figures, Floats]:
    """The C program, and its C client."""
    port = PORT + _PORTS_BESIDE
    with chain(setup) as running:
        running.start_canaries()
        own = running.directory / "yardstick"
        how = ("--port", port, "--rate", setup.rate_hz, "--priority", setup.priority)
        running.start_master(own, _YARDSTICK, program, own, "--ifname", ifname, *how)
        running.watch("sensor", sensor)
        path = running.directory / "client"
        running.watch("client", _start_c_client(running, program, port, path).pid)
        usage = running.record(path)
        running.stop()
        figures, ages = running.figures(path)
        return {**figures, **usage, "server": _loop(own)}, ages


def _start_c_client(running: Chain, program: Path, port: int, path: Path) -> Child:
    times = (running.setup.warm_up_s, running.setup.seconds)
    return running.start_command_recorder(path, program, "client", port, path, *times)


def _loop(path: Path) -> Figures:
    """How late a loop woke, and how long its exchanges took."""
    late, exchange = statistics.read_numbers(path, 2).astype(float).T
    return {"wake_us": statistics.spread_us(late), "exchange_us": statistics.spread_us(exchange)}


def project_tcp(
    setup: Setup, ifname: str, sensor: int, program: Path | None = None
) -> tuple[Figures, Floats]:
    """Server and a TCP client: Python's, or the C program's."""
    with chain(setup) as running:
        running.start_canaries()
        running.watch("sensor", sensor)
        link = start_server(running, ifname)
        path, arguments = recording(running, "client")
        client = (
            _start_c_client(running, program, PORT, path)
            if program
            else running.start_recorder(path, _CLIENT, *arguments, "--port", PORT)
        )
        running.watch("client", client.pid)
        usage = running.record(path)
        status = link.ask("status")
        link.close()
        running.stop()
        figures, ages = running.figures(path)
    hand_out = max(row["age_us"]["p50"] for row in status["sensors"])
    figures["hand_out_to_client_us"] = round(figures["age_us"]["p50"] - _true(hand_out, figures), 1)
    named = ("wake_us", "exchange_us", "missed_deadlines", "lost_frames")
    server = {name: status[name] for name in named}
    server["clocks"] = [row["clock"] for row in status["sensors"]]
    return {**figures, **usage, "server": server}, ages


def _true(hand_out_us: float, figures: Figures) -> float:
    """The server's age at hand-out is by its own stamp; with the stamp's error it is by the true instant."""
    error: float = figures["stamp_error_us"]["p50"]
    return hand_out_us + error


def project_ros(setup: Setup, ifname: str, sensor: int) -> tuple[Figures, Floats]:
    """Server, a node for each sensor, and a ROS subscriber."""
    with chain(setup) as running:
        running.start_canaries()
        running.watch("sensor", sensor)
        start_server(running, ifname).close()
        topics = [f"/benchmark_{position}" for position in range(setup.sensors)]
        for position, topic in enumerate(topics):
            node = running.start(
                f"node-{position}", "bridge.client", "--ros-args", "-r", f"__node:=bridge_{position}",
                "-p", f"server_port:={PORT}", "-p", f"sensor:={position}", "-p", f"array_topic:={topic}",
            )  # fmt: skip
            running.watch("node" if setup.sensors == 1 else f"node {position}", node.pid)
        return _subscribe(running, topics)


def polling_tcp(setup: Setup, ifname: str, sensor: int) -> tuple[Figures, Floats]:
    """The polling loop, and a polling client without ROS."""
    with chain(setup) as running:
        running.start_canaries()
        own = _start_polling_server(running, ifname, sensor)
        path, arguments = recording(running, "client")
        port = ("--port", PORT + _PORTS_BESIDE, "--rate", setup.rate_hz)
        client = running.start_recorder(path, _POLLING, "client", *arguments, *port)
        running.watch("client", client.pid)
        usage = running.record(path)
        running.stop()
        figures, ages = running.figures(path)
        return {**figures, **usage, "server": _loop(own)}, ages


def polling_ros(setup: Setup, ifname: str, sensor: int) -> tuple[Figures, Floats]:
    """The polling loop and node, and a ROS subscriber."""
    with chain(setup) as running:
        running.start_canaries()
        _start_polling_server(running, ifname, sensor)
        port = ("--port", PORT + _PORTS_BESIDE, "--rate", setup.rate_hz)
        node = running.start("polling-node", _POLLING, "node", *port)
        running.watch("node", node.pid)
        return _subscribe(running, [POLLING_TOPIC])


def _start_polling_server(running: Chain, ifname: str, sensor: int) -> Any:
    own = running.directory / "polling-server"
    port = ("--port", PORT + _PORTS_BESIDE, "--rate", running.setup.rate_hz)
    running.start_master(own, _POLLING, "server", own, "--ifname", ifname, *port)
    running.watch("sensor", sensor)
    return own


def _subscribe(running: Chain, topics: list[str]) -> tuple[Figures, Floats]:
    path, arguments = recording(running, "subscriber")
    subscriber = running.start_recorder(path, "scripts.benchmarks.processes.subscriber", *arguments, *topics)
    running.watch("subscriber", subscriber.pid)
    usage = running.record(path)
    running.stop()
    figures, ages = running.figures(path)
    return {**figures, **usage}, ages
