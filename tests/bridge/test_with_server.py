"""The node and the server as processes, as in use."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped

from ethercat_server.virtual_sensor.signals import CONSTANT
from tests.bridge.real_node import PATIENCE_S, Listener, StartProcess
from tests.bridge.simulated_node import level, six, values
from tests.server.running import needs_bus
from tests.server.running import server as server_process


@needs_bus
@pytest.mark.bus
def test_both_as_processes(listener: Listener, start_process: StartProcess) -> None:
    """As in use, with pysoem, TCP, DDS and signals: from the first sample to the end of both."""
    with server_process(
        "virtual", "--virtual=--signal rest --noise none", "--set", "sinc_length=512"
    ) as running:
        node = start_process(running.port)
        arrays = listener.subscribe(DiagnosticArray, "diagnostics")
        wrenches = listener.subscribe(WrenchStamped, "wrench", depth=20)
        try:
            wrench = wrenches.get(timeout=PATIENCE_S)
        except queue.Empty:
            arrived = listener.messages.qsize()
            pytest.fail(f"no wrench, and {arrived} arrays; node: {node.log}; server: {running.said()}")
        assert six(wrench) == pytest.approx(CONSTANT)
        array: dict[str, Any] = {}
        while not array or {level(array["link"]), level(array["sensor"])} != {"ok"}:
            statuses = arrays.get(timeout=PATIENCE_S).status
            array = {status.name.rpartition(" ")[2]: status for status in statuses}
        assert values(array["stream"])["expected_hz"] == "100.0"

        def granted(ask: Callable[[], tuple[bool, str]]) -> None:
            """Asked again while a busy machine has lost the sensor."""
            deadline = time.monotonic() + PATIENCE_S
            while not (answer := ask())[0]:
                assert "(not_ready)" in answer[1], answer
                assert time.monotonic() < deadline, answer

        granted(lambda: listener.set_parameter("settings.chop", True))
        assert listener.parameters("settings.chop") == [True]
        granted(lambda: listener.trigger("sensor_tare"))
        listener.supervise("ft_sensors", "1")
        assert node.ends() == 0
        assert running.wait() == 0
        assert "Traceback" not in node.log
