"""The node's process: signals, the scheduling of its threads, executors that stop, Fast DDS's profile."""

from __future__ import annotations

import contextlib
import gc
import os
import queue
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor

from bota_ethercat.client import Scheduling
from bota_ethercat_bridge import client, process
from bota_ethercat_bridge import node as program
from bota_ethercat_bridge.rclpy_internals import Spinner
from tests import without_ipv6
from tests.bridge.real_node import PATIENCE_S, Log, StartProcess
from tests.bridge.scripted_server import ScriptedServer
from tests.rights import needs_root, skip_if_forbidden
from tests.server.running import Program, free_port, full_listener


@pytest.mark.parametrize(
    ("missing", "remedy"),
    [("rclpy", "source ROS 2"), ("std_msgs", "source ROS 2"), ("bota_ethercat", "build the package")],
)
def test_a_missing_module_is_named(
    missing: str, remedy: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(client, "StopSignals", lambda: None)  # which blocks them in this process
    for name in [name for name in sys.modules if name.split(".")[0] in {missing, "bota_ethercat_bridge"}]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    assert client.main([]) == 1
    said = capsys.readouterr().err
    assert re.match(rf"bridge-client: {missing} cannot be loaded \(.*\): {remedy}", said)
    if missing == "rclpy":
        assert client.check_subscription() == 1
        assert capsys.readouterr().err == said


def test_the_node_runs_with_what_favors_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    interval_s, found = sys.getswitchinterval(), list[object]()

    def spin(_: object) -> int:
        found.extend((sys.getswitchinterval() < interval_s, gc.get_freeze_count() > 0))
        return 7

    monkeypatch.setattr(rclpy, "init", lambda **_: None)
    monkeypatch.setattr(rclpy, "try_shutdown", lambda: None)
    monkeypatch.setattr(program.BridgeNode, "create", lambda: None)
    monkeypatch.setattr(program, "spin", spin)
    try:
        assert program.run([]) == 7
    finally:
        sys.setswitchinterval(interval_s)
        gc.unfreeze()
    assert found == [True, True]


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        (
            {"ROS_DOMAIN_ID": "233"},
            "ROS_DOMAIN_ID is 233: set it to a whole number from 0 to 232, or unset it",
        ),
        ({"ROS_DOMAIN_ID": "-3"}, "ROS_DOMAIN_ID is -3: set it to a whole number from 0 to 232, or unset it"),
        ({"ROS_DOMAIN_ID": "ten"}, "ROS_DOMAIN_ID is not an integral number: set it to a whole number, or"),
        (
            {"RMW_IMPLEMENTATION": "rmw_other_cpp"},
            "RMW_IMPLEMENTATION is 'rmw_other_cpp', which cannot be lo",
        ),
        (
            {"HOME": "/proc/home", "ROS_LOG_DIR": ""},
            "set HOME, or ROS_LOG_DIR to a directory for its log, which",
        ),
        (
            {"ROS_STATIC_PEERS": "@@"},
            "ROS cannot create the node (error creating node: Unable to resolve peer",
        ),
    ],
)
def test_what_the_environment_makes_impossible_is_a_sentence(variables: dict[str, str], said: str) -> None:
    """Processes: at some of it the middleware ends them by itself, and ROS reads the rest once."""
    done = subprocess.run(
        [sys.executable, "-m", "bota_ethercat_bridge.client"], env={**os.environ, **variables},
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    *_, line = done.stderr.splitlines()
    assert line.startswith("bridge-client: ")
    assert said in line
    assert done.returncode in (1, 2)
    assert "/project/src" not in line


HANGING = """
import ctypes, sys
import rclpy, rclpy.node
def hang(*_, **__):
    print("hangs", flush=True)
    ctypes.PyDLL(None).sleep(600)  # with Python's lock, as rclpy calls the middleware
{where} = hang
from bota_ethercat_bridge import client
sys.exit(client.main([]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("where", ["rclpy.init", "rclpy.node.Node.__init__"])
def test_a_signal_ends_it_while_the_middleware_hangs(where: str, number: signal.Signals) -> None:
    """A process: only the kernel ends one whose Python cannot run."""
    command = [sys.executable, "-c", HANGING.format(where=where)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as node:
        assert node.stdout is not None
        try:
            assert node.stdout.readline() == "hangs\n"
            node.send_signal(number)
            _, said = node.communicate(timeout=PATIENCE_S)
        finally:
            node.kill()
    assert (node.returncode, said) == (-number, "")


@needs_root
def test_without_ipv6_it_waits_for_the_server() -> None:
    """A process: the kernel gives it no IPv6 socket, although `localhost` has such an address."""
    port = free_port()
    arguments = ("--ros-args", "-p", f"server_port:={port}", "-r", f"__ns:=/test_{port}")
    under = sys.executable, str(Path(without_ipv6.__file__))
    with contextlib.closing(Program("bota_ethercat_bridge.client", arguments, under)) as node:
        node.wait_for(f"no server at localhost:{port} (Connection refused)")
        with ScriptedServer(port):
            node.wait_for("connected to")


def test_a_second_signal_counts_only_when_it_is_meant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with the time at which it comes: a terminal and a launcher may send theirs within a second."""
    signals = iter([(100.0, signal.SIGINT), (100.9, signal.SIGINT), (101.0, signal.SIGTERM)])
    now_s, called, ended = 0.0, list[int](), queue.Queue[int]()

    def wait(_: object) -> int:
        nonlocal now_s
        now_s, number = next(signals)
        return number

    def end(code: int) -> None:
        ended.put(code)
        threading.Event().wait()  # as a process that ends

    monkeypatch.setattr(signal, "sigwait", wait)
    monkeypatch.setattr(os, "_exit", end)
    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic=lambda: now_s))
    monkeypatch.setattr(signal, "pthread_sigmask", lambda *_: None)
    monkeypatch.setattr(signal, "sigtimedwait", lambda *_: None)
    stop_signals = process.StopSignals()
    assert stop_signals.begin()
    stop_signals.call(called.append)
    assert ended.get(timeout=PATIENCE_S) == 128 + signal.SIGTERM
    assert called == [signal.SIGINT]
    assert next(signals, None) is None


PRIORITY, BELOW = 40, 39


@needs_root
def test_the_stream_is_real_time_no_service_is(server: ScriptedServer, start_process: StartProcess) -> None:
    cpu = min(os.sched_getaffinity(0))
    node = start_process(server.port, cpu=cpu, rt_priority=PRIORITY)
    node.says("connected to")
    node.says("the stream has ")
    skip_if_forbidden(node.log)
    assert f"the stream has SCHED_FIFO {PRIORITY}, CPU {cpu}, memory locked" in node.log
    found: Counter[tuple[str, int, object, bool]] = Counter()
    for task in Path(f"/proc/{node.process.pid}/task").iterdir():
        name, number = (task / "comm").read_text().strip(), int(task.name)
        policy, priority = os.sched_getscheduler(number), os.sched_getparam(number).sched_priority
        found[name.split(".")[0], policy, priority, len(os.sched_getaffinity(number)) == 1] += 1
        assert number != node.process.pid or policy == os.SCHED_OTHER, "the services' executor"
    anywhere = os.cpu_count() == 1
    names = {name for name, *_ in found} - {"dds"}
    assert sum(found[name, os.SCHED_FIFO, PRIORITY, True] for name in names) == 1
    assert sum(found[name, os.SCHED_FIFO, BELOW, anywhere] for name in names) == len(process.SHARING_LOCKS)
    assert {key[1:3] for key in found if key[0] == "dds"} == {(os.SCHED_FIFO, BELOW)}
    assert {key[1:3] for key in found} == {
        (os.SCHED_OTHER, 0), (os.SCHED_FIFO, BELOW), (os.SCHED_FIFO, PRIORITY)
    }  # fmt: skip


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Thread]:
    """A thread of the stream's name, and no way to change the process of the tests."""
    over = threading.Event()
    thread = threading.Thread(target=over.wait, name=process.STREAM)
    thread.start()
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: pytest.fail("nothing was granted"))
    yield thread
    over.set()
    thread.join()


def test_a_refusal_is_a_warning_and_no_change(
    stream: threading.Thread, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, int, int]] = []

    def refuse(priority: int, cpu: int, *, thread: int) -> Scheduling:
        asked.append((priority, cpu, thread))
        return Scheduling(refused=(f"SCHED_FIFO {priority} (a remedy)",))

    monkeypatch.setattr("bota_ethercat.program.real_time.make_real_time", refuse)
    lines = Log(None)
    process.prepare(0, -1, lines)  # nothing is asked for
    assert not lines.lines
    process.prepare(40, 1, lines)
    assert asked == [(40, 1, stream.native_id)]
    assert lines.warnings == [
        "the stream has ordinary scheduling; not granted: SCHED_FIFO 40 (a remedy); samples may be late on a "
        "busy machine"
    ]


def test_a_thread_that_fails_says_so() -> None:
    def fail() -> None:
        raise LookupError("a defect")

    heard: list[str] = []
    worker = process.Worker("reader", fail, heard.append)
    worker.start()
    assert worker.has_ended()
    assert heard == ["the reader failed: LookupError: a defect"]


# Executors run until they are told to stop.


def test_a_host_that_does_not_answer_is_said_so(start_process: StartProcess) -> None:
    """Connecting is pending: a process, because only the kernel leaves it so."""
    with full_listener() as port:
        start_process(port).says(f"no server at localhost:{port} (Connection timed out)")


def test_a_callback_that_raises_ends_it_and_is_told() -> None:
    def fail() -> Any:
        raise LookupError("of the callback")

    node, executor = rclpy.create_node("spinning"), SingleThreadedExecutor()
    executor.add_node(node)
    node.create_timer(0.001, fail)
    spinner = Spinner(executor)
    with pytest.raises(LookupError, match="of the callback"):
        spinner.run()
    spinner.stop()
    executor.shutdown()
    node.destroy_node()


# The profile for Fast DDS.


NAME = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILES = Path(__file__).parents[2] / "ros2_bridge/config/fastdds.xml"


@pytest.mark.long
def test_fast_dds_understands_it(
    server: ScriptedServer, start_process: StartProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In processes: the middleware reads its profiles once. And a signal ends one as it should."""
    monkeypatch.setenv(NAME, str(PROFILES))
    node = start_process(server.port)
    node.says("connected to")
    assert "XMLPARSER" not in node.log
    assert "the stream has " not in node.log, "real time is asked for"
    node.process.send_signal(signal.SIGHUP)
    assert node.ends() == 0
    assert "Traceback" not in node.log
    assert server.disconnected.wait(PATIENCE_S)
    wrong = tmp_path / "wrong.xml"
    wrong.write_text(PROFILES.read_text().replace("nackSupressionDuration", "nackDuration"))
    monkeypatch.setenv(NAME, str(wrong))
    start_process(server.port).says("XMLPARSER")  # this is how it would have said so
