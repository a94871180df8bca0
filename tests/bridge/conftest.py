"""For all tests of the node: ROS, and the fixtures of those that have it in real time."""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.scripted_server import ScriptedServer
from tests.server.running import steady_addresses


class _WithoutRos(pytest.Module):
    def collect(self) -> Iterator[Any]:
        pytest.skip("rclpy is missing: pip install the extra 'ros' or source ROS 2", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: Any) -> pytest.Module | None:
    missing = importlib.util.find_spec("rclpy") is None
    return _WithoutRos.from_parent(parent, path=module_path) if missing else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.ros)


@pytest.fixture(scope="session", autouse=True)
def _ros() -> Iterator[None]:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_LOG_DIR", tempfile.gettempdir())
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    yield
    rclpy.try_shutdown()


@pytest.fixture
def listener() -> Iterator[Any]:
    from tests.bridge.real_node import Listener

    with steady_addresses():
        opened = Listener()
        yield opened
        opened.close()


@pytest.fixture
def start(listener: Any) -> Iterator[Any]:
    from tests.bridge.real_node import NodeThread, starter

    with starter(listener, NodeThread) as start_node:
        yield start_node


@pytest.fixture
def start_process(listener: Any) -> Iterator[Any]:
    from tests.bridge.real_node import NodeProcess, starter

    with starter(listener, NodeProcess) as start_node:
        yield start_node


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as scripted:
        yield scripted
