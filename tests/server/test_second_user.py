"""Another user may look but not touch, however they go about it; nor may the root of another machine."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from protocol.control import ACTIONS, request
from protocol.text.bare_json import encode_bare_json
from tests.server.as_another_user import NO_OTHER_USER, NOBODY
from tests.server.running import Server, Veth, free_port, needs_bus, server, wait_until

pytestmark = [
    pytest.mark.bus,
    needs_bus,
    pytest.mark.skipif(NO_OTHER_USER is not None, reason=NO_OTHER_USER or ""),
]

CONTROL: dict[str, dict[str, Any]] = {
    "shutdown": {},
    "configure": {"sensor": 0, "settings": {"fir": True}},
    "tare": {"sensor": 0, "samples": 10},
    "sdo_write": {"sensor": 0, "index": 0x8010, "subindex": 1, "hex": "00"},
}
"""What changes something, with everything it needs."""


@pytest.fixture(scope="module")
def shared() -> Iterator[Server]:
    """One server for all: none of these may change it."""
    with server("virtual", "--virtual", "--signal clock") as running:
        yield running


def as_nobody(port: int, what: str, argument: object) -> list[Any]:
    """What a client that runs as another user prints."""
    command = [sys.executable, "-m", "tests.server.stranger", "127.0.0.1", str(port), what]
    done = subprocess.run(
        [*command, json.dumps(argument)], check=False, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def what_can_be_changed(running: Server) -> Any:
    """The settings, once the sensor is in OP: one that is starved is away for a moment."""
    settings: list[Any] = []

    def in_op() -> bool:
        with running.connect() as client:
            sensors = client.ask("describe")["sensors"]
        settings[:] = [sensor["settings"] for sensor in sensors]
        return all(sensor["state"] == "OP" for sensor in sensors)

    wait_until(in_op, "OP")
    return settings


def test_they_may_look(shared: Server) -> None:
    described, status = as_nobody(shared.port, "ask", [request("describe", 1), request("status", 2)])
    assert described["sensors"][0]["name"] == "BFT-SENS-ECAT-M8"
    assert status["ok"]
    assert status["cycles"] > 0
    assert as_nobody(shared.port, "stream", 200)[0] >= 200


@pytest.mark.parametrize("action", CONTROL)
def test_they_may_not_touch(shared: Server, action: str) -> None:
    if action not in ACTIONS:
        pytest.skip(f"the server has no {action}")
    before = what_can_be_changed(shared)
    message = request(action, 1, **CONTROL[action])
    denied, *others = as_nobody(shared.port, "ask", [message, message, request("describe", 2)])
    assert (denied["reply"], denied["ok"], denied["error"]["code"]) == (action, False, "denied")
    assert str(NOBODY.pw_uid) in denied["error"]["message"], "it says as whom they were seen"
    assert [other["ok"] for other in others] == [False, True]
    assert what_can_be_changed(shared) == before
    assert f"(uid {NOBODY.pw_uid}): " in shared.said(), "the administrator can see who tried"


@pytest.mark.parametrize("action", CONTROL)
def test_what_they_claim_to_be_changes_nothing(shared: Server, action: str) -> None:
    if action not in ACTIONS:
        pytest.skip(f"the server has no {action}")
    before = what_can_be_changed(shared)
    asked = CONTROL[action]
    replies = as_nobody(
        shared.port,
        "ask",
        [
            {"action": action, **asked, "user": "root"},
            {"action": action, **asked, "uid": 0},
            {"user": "root", "uid": 0, "euid": 0, "sudo": True, "action": action, **asked},
            {"action": action, **asked, "id": {"user": "root", "uid": 0}},
        ],
    )
    assert [reply["error"]["code"] for reply in replies] == ["bad_request"] * 3 + ["denied"]
    assert what_can_be_changed(shared) == before


@pytest.mark.parametrize("action", ["shutdown", "configure"])
def test_asking_and_being_gone_at_once_changes_nothing(shared: Server, action: str) -> None:
    """The kernel shows a socket that nobody holds any more as root's."""
    if action not in ACTIONS:
        pytest.skip(f"the server has no {action}")
    before = what_can_be_changed(shared)
    with shared.connect() as watcher:
        watcher.ask("subscribe")
        as_nobody(shared.port, "hit", request(action, **CONTROL[action]))
        assert what_can_be_changed(shared) == before, "after all that it sent was read"
        assert shared.process.poll() is None
        told = {event["event"] for event in watcher.events}
        assert told <= {"sensor_lost", "sensor_back"}, "a busy machine starves the sensor, nothing else"
        watcher.fresh(100)


def test_their_reading_does_not_keep_root_from_its_work(shared: Server) -> None:
    if "sdo_read" not in ACTIONS:
        pytest.skip("the server has no sdo_read")
    command = [sys.executable, "-m", "tests.server.stranger", "127.0.0.1", str(shared.port), "press"]
    message = json.dumps(request("sdo_read", index=0x1008))
    pressing = subprocess.Popen([*command, message], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert pressing.stdout is not None
        assert pressing.stdout.readline(), "they did not get in"
        with shared.connect() as client:
            replies = [client.ask("configure", settings={"fir": False}) for _ in range(20)]
            assert all(reply["ok"] for reply in replies), [reply.get("error") for reply in replies]
        assert pressing.poll() is None
    finally:
        pressing.communicate("\n", timeout=30)
    assert pressing.returncode == 0


def test_root_may_still_touch() -> None:
    with server("virtual") as running:
        as_nobody(running.port, "hit", request("shutdown"))
        with running.connect() as client:
            assert client.ask("shutdown")["ok"]
        assert running.wait() == 0


# -- another machine, whose root is not ours


@contextlib.contextmanager
def another_machine(veth: Veth) -> Iterator[list[str]]:
    """A network namespace with the far end of `veth` in it, and what runs a command there."""
    keeper = subprocess.Popen(["unshare", "--net", "sleep", "100"])
    there = ["nsenter", f"--net=/proc/{keeper.pid}/ns/net"]
    try:
        own = Path("/proc/self/ns/net").readlink()
        wait_until(lambda: Path(f"/proc/{keeper.pid}/ns/net").readlink() != own, "the namespace", 10)
        veth.ip("address", "add", "10.77.12.1/30", "dev", veth.near)
        veth.ip("link", "set", veth.far, "netns", str(keeper.pid))
        for command in (
            ["address", "add", "10.77.12.2/30", "dev", veth.far],
            ["link", "set", veth.far, "up"],
        ):
            subprocess.run([*there, "ip", *command], check=True)
        yield there
    finally:
        keeper.kill()
        keeper.wait()


FROM_PORT = """
import socket, sys
own, port, count = map(int, sys.argv[1:4])
sock = socket.socket()
sock.bind(("10.77.12.2", own))
sock.settimeout(20)
sock.connect(("10.77.12.1", port))
sock.sendall(sys.stdin.buffer.read())
answers = sock.makefile()
for _ in range(count):
    print(answers.readline(), end="")
"""


@pytest.mark.skipif(not shutil.which("nsenter"), reason="no nsenter (util-linux) here")
@pytest.mark.parametrize("port_is_heard", [False, True], ids=["its port is free here", "root listens on it"])
def test_root_of_another_machine_is_a_stranger(port_is_heard: bool) -> None:
    """Asked for a connection that it does not have, the kernel tells of who listens on the port."""
    asked = [{"action": action, **CONTROL[action]} for action in CONTROL if action in ACTIONS]
    asked.append(request("describe"))
    with contextlib.ExitStack() as stack:
        veth = stack.enter_context(Veth())
        there = stack.enter_context(another_machine(veth))
        running = stack.enter_context(server("virtual", "--host", "127.0.0.1", "--host", "10.77.12.1"))
        own = free_port()
        if port_is_heard:
            stack.enter_context(socket.create_server(("0.0.0.0", own)))
        arguments = [str(own), str(running.port), str(len(asked))]
        done = subprocess.run(
            [*there, sys.executable, "-c", FROM_PORT, *arguments],
            input=b"".join(map(encode_bare_json, asked)),
            check=False, capture_output=True, timeout=60,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        *denied, described = map(json.loads, done.stdout.splitlines())
        assert [answer["error"]["code"] for answer in denied] == ["denied"] * (len(asked) - 1)
        assert described["ok"], "they may look"
        with running.connect() as client:
            assert client.ask("describe")["sensors"] == described["sensors"]
