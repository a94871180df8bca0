"""Another user may look but not touch, however they go about it; nor may the root of another machine.

Who a client is only the kernel knows, so these are real processes of real users, at one server for all.
"""

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

from bota_ethercat.control import request
from bota_ethercat.text.bare_json import encode_bare_json
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
HERE, THERE = "10.77.12.1", "10.77.12.2"


@pytest.fixture(scope="module")
def veth() -> Iterator[Veth]:
    """The cable to another machine."""
    with Veth() as found:
        found.ip("address", "add", f"{HERE}/30", "dev", found.near)
        yield found


@pytest.fixture(scope="module")
def shared(veth: Veth) -> Iterator[Server]:
    """None of these may change it, but for the last."""
    with server("virtual", "--set", "sinc_length=512", "--host", "127.0.0.1", "--host", HERE) as running:
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
    assert as_nobody(shared.port, "stream", 20)[0] >= 20


def test_they_may_not_touch_whatever_they_claim_to_be(shared: Server) -> None:
    before = what_can_be_changed(shared)
    messages: list[dict[str, Any]] = []
    for action, asked in CONTROL.items():
        messages += (
            request(action, 1, **asked),
            request(action, 1, **asked),
            {"action": action, **asked, "user": "root"},
            {"action": action, **asked, "uid": 0},
            {"user": "root", "uid": 0, "euid": 0, "sudo": True, "action": action, **asked},
            {"action": action, **asked, "id": {"user": "root", "uid": 0}},
            request("describe", 2),
        )
    replies = as_nobody(shared.port, "ask", messages)
    for number, action in enumerate(CONTROL):
        *denied, described = replies[7 * number : 7 * number + 7]
        codes = [reply["error"]["code"] for reply in denied]
        assert codes == ["denied"] * 2 + ["bad_request"] * 3 + ["denied"]
        assert denied[0]["reply"] == action
        seen = f"denied to {NOBODY.pw_name} (uid {NOBODY.pw_uid}): "
        assert seen in denied[0]["error"]["message"], "it says as whom they were seen"
        assert described["ok"]
    assert what_can_be_changed(shared) == before
    assert f"(uid {NOBODY.pw_uid}): " in shared.said(), "the administrator can see who tried"


def test_asking_and_being_gone_at_once_changes_nothing(shared: Server) -> None:
    """The kernel shows a socket that nobody holds any more as root's."""
    before = what_can_be_changed(shared)
    with shared.connect() as watcher:
        watcher.ask("subscribe")
        as_nobody(shared.port, "hit", [request(action, **asked) for action, asked in CONTROL.items()])
        assert what_can_be_changed(shared) == before, "after all that it sent was read"
        assert shared.process.poll() is None
        told = {event["event"] for event in watcher.events}
        assert told <= {"sensor_lost", "sensor_back"}, "a busy machine starves the sensor, nothing else"
        watcher.fresh(10)


# -- another machine, whose root is not ours


@contextlib.contextmanager
def another_machine(veth: Veth) -> Iterator[list[str]]:
    """A network namespace with the far end of `veth` in it, and what runs a command there."""
    keeper = subprocess.Popen(["unshare", "--net", "sleep", "1000"])
    there = ["nsenter", f"--net=/proc/{keeper.pid}/ns/net"]
    try:
        own = Path("/proc/self/ns/net").readlink()
        wait_until(lambda: Path(f"/proc/{keeper.pid}/ns/net").readlink() != own, "the namespace")
        veth.ip("link", "set", veth.far, "netns", str(keeper.pid))
        for command in (["address", "add", f"{THERE}/30", "dev", veth.far], ["link", "set", veth.far, "up"]):
            subprocess.run([*there, "ip", *command], check=True)
        yield there
    finally:
        keeper.kill()
        keeper.wait()


FROM_PORT = f"""
import socket, sys
own, port, count = map(int, sys.argv[1:4])
sock = socket.socket()
sock.bind(("{THERE}", own))
sock.settimeout(30)
sock.connect(("{HERE}", port))
sock.sendall(sys.stdin.buffer.read())
answers = sock.makefile()
for _ in range(count):
    print(answers.readline(), end="")
"""


@pytest.mark.skipif(not shutil.which("nsenter"), reason="no nsenter (util-linux) here")
def test_root_of_another_machine_is_a_stranger(shared: Server, veth: Veth) -> None:
    """Asked for a connection that it does not have, the kernel tells of who listens on the port."""
    asked = [{"action": action, **keys} for action, keys in CONTROL.items()]
    asked.append(request("describe"))
    before = what_can_be_changed(shared)
    with another_machine(veth) as there:
        for port_is_heard in (False, True):
            with contextlib.ExitStack() as stack:
                own = free_port()
                if port_is_heard:
                    stack.enter_context(socket.create_server(("0.0.0.0", own)))
                done = subprocess.run(
                    [*there, sys.executable, "-c", FROM_PORT, str(own), str(shared.port), str(len(asked))],
                    input=b"".join(map(encode_bare_json, asked)),
                    check=False, capture_output=True, timeout=60,
                )  # fmt: skip
            assert done.returncode == 0, done.stderr
            *denied, described = map(json.loads, done.stdout.splitlines())
            assert [answer["error"]["code"] for answer in denied] == ["denied"] * (len(asked) - 1)
            assert described["ok"], "they may look"
    assert what_can_be_changed(shared) == before


def test_root_may_still_touch(shared: Server) -> None:
    """The last one: it ends the server."""
    with shared.connect() as client:
        assert client.ask("shutdown")["ok"]
    assert shared.wait() == 0
