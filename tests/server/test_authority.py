"""Who owns the other end of a connection, and who may control: another user may only read.

Who a client is only the kernel knows, so these are real sockets.
"""

from __future__ import annotations

import contextlib
import fcntl
import grp
import itertools
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from bota_ethercat.control import request
from bota_ethercat.framing import encode_json
from ethercat_server.errors import UsageError
from ethercat_server.serving.bare_json import encode_bare_json
from ethercat_server.serving.permissions import Permissions
from ethercat_server.serving.transport import open_diagnostics, peer_uid
from tests.rights import NOBODY, needs_another_user, socket_of
from tests.server.running import (
    HERE,
    THERE,
    Server,
    Veth,
    another_machine,
    free_port,
    on_a_bus,
    server,
    steady_addresses,
    wait_until,
)

RESET = struct.pack("ii", 1, 0)  # SO_LINGER with which a close resets the connection


@pytest.fixture
def diagnostics() -> Iterator[socket.socket]:
    with open_diagnostics() as opened:
        yield opened


@contextlib.contextmanager
def accepted_from(
    host: str = "127.0.0.1", uid: int | None = None, family: socket.AddressFamily | None = None, to: str = ""
) -> Iterator[tuple[socket.socket, socket.socket]]:
    """A connection that was accepted on `host`, and the client's end of it, which called it `to`."""
    own = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=own) as waiting, socket_of(uid, family or own) as client:
        waiting.settimeout(10)
        client.connect((to or host, waiting.getsockname()[1]))
        accepted, _ = waiting.accept()
        with accepted:
            yield accepted, client


def test_the_kernel_was_asked_before_there_is_a_loop(diagnostics: socket.socket) -> None:
    """It loads modules for the first question about a family."""
    answers = []
    with contextlib.suppress(BlockingIOError):
        while True:
            answers.append(diagnostics.recv(4096))
    assert len(answers) == 2
    with open_diagnostics() as asked_already, accepted_from() as (accepted, _):
        assert peer_uid(asked_already, accepted) == os.geteuid(), "none of them is taken for its answer"


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"host": "::1"},
        # What dual-stack clients connect to 127.0.0.1 with.
        {"family": socket.AF_INET6, "to": "::ffff:127.0.0.1"},
        pytest.param({"uid": NOBODY.pw_uid}, marks=needs_another_user),
    ],
    ids=str,
)
def test_the_owner_of_a_connection_is_found(diagnostics: socket.socket, how: dict[str, Any]) -> None:
    with accepted_from(**how) as (accepted, _):
        assert peer_uid(diagnostics, accepted) == how.get("uid", os.geteuid())


@pytest.mark.parametrize("reset", [False, True])
def test_a_socket_that_nobody_holds_any_more_has_no_owner(diagnostics: socket.socket, reset: bool) -> None:
    with accepted_from() as (accepted, client):
        if reset:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        client.sendall(b"x")
        assert peer_uid(diagnostics, accepted) == os.geteuid()
        client.close()  # the kernel now shows it as root's, or not at all
        assert peer_uid(diagnostics, accepted) is None


def test_who_only_listens_on_the_port_is_not_the_owner(diagnostics: socket.socket) -> None:
    """For a connection that is not in its tables the kernel answers with the listener on that port."""

    class Elsewhere:
        """A connection from another machine, whose port happens to be one that listens here."""

        family = socket.AF_INET

        def __init__(self, port: int) -> None:
            self._port = port

        def getpeername(self) -> tuple[str, int]:
            return ("127.0.0.1", self._port)

        def getsockname(self) -> tuple[str, int]:
            return ("127.0.0.1", 1)

    with socket.create_server(("0.0.0.0", 0)) as waiting:
        assert peer_uid(diagnostics, Elsewhere(waiting.getsockname()[1])) is None  # type: ignore[arg-type]


def test_root_its_own_user_and_the_user_of_sudo_may_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SUDO_UID", raising=False)
    assert Permissions().control_uids == {0, os.geteuid()}
    assert Permissions(own_uid=7).control_uids == {0, 7}, "the one that it becomes"
    for uid, controlling in (("1234", {0, 7, 1234}), ("-1", {0, 7})):
        monkeypatch.setenv("SUDO_UID", uid)
        assert Permissions(own_uid=7).control_uids == controlling


def test_named_users_and_groups_may_control() -> None:
    group = grp.getgrgid(NOBODY.pw_gid).gr_name
    assert NOBODY.pw_uid in Permissions(["nobody"]).control_uids
    assert NOBODY.pw_uid in Permissions(groups=[group]).control_uids, "it is their primary group"
    assert 4711 in Permissions(["4711"]).control_uids, "a number needs no entry"
    with pytest.raises(UsageError, match="no-such-user: there is no such user"):
        Permissions(["no-such-user"])
    with pytest.raises(UsageError, match="no-such-group: there is no such group"):
        Permissions(groups=["no-such-group"])


# -- at one server for all of these, which none may change but the last

# What changes something, with everything it needs.
CONTROL: dict[str, dict[str, Any]] = {
    "shutdown": {},
    "configure": {"sensor": 0, "settings": {"fir": True}},
    "tare": {"sensor": 0, "samples": 10},
    "sdo_write": {"sensor": 0, "index": 0x8010, "subindex": 1, "hex": "00"},
}


def with_server(test: Callable[..., None]) -> Callable[..., None]:
    marked: Callable[..., None] = needs_another_user(test)
    return on_a_bus(marked)


@pytest.fixture(scope="module")
def veth() -> Iterator[Veth]:
    """The cable to another machine."""
    with steady_addresses(fcntl.LOCK_EX), Veth() as found:
        found.ip("address", "add", f"{HERE}/30", "dev", found.near)
        yield found


@pytest.fixture(scope="module")
def shared(veth: Veth) -> Iterator[Server]:
    with server("virtual", "--set", "sinc_length=512", "--host", "127.0.0.1", "--host", HERE) as running:
        yield running


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


@with_server
def test_another_user_may_not_control_whatever_they_claim_to_be(shared: Server) -> None:
    before = what_can_be_changed(shared)
    with shared.connect(NOBODY.pw_uid) as stranger:
        for action, asked in CONTROL.items():
            *denied, described = stranger.answers(
                request(action, 1, **asked),
                request(action, 1, **asked),
                {"action": action, **asked, "user": "root"},
                {"action": action, **asked, "uid": 0},
                {"user": "root", "uid": 0, "euid": 0, "sudo": True, "action": action, **asked},
                {"action": action, **asked, "id": {"user": "root", "uid": 0}},
                request("describe", 2),
            )
            codes = [reply["error"]["code"] for reply in denied]
            assert codes == ["denied"] * 2 + ["bad_request"] * 3 + ["denied"]
            assert denied[0]["reply"] == action
            seen = f"denied to {NOBODY.pw_name} (uid {NOBODY.pw_uid}): "
            assert seen in denied[0]["error"]["message"], "it says as whom they were seen"
            assert described["ok"]
    assert what_can_be_changed(shared) == before
    shared.wait_for(f"(uid {NOBODY.pw_uid}): ")  # the administrator can see who tried


def reset(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)


GOING: Sequence[Callable[[socket.socket], None]] = (
    lambda _: None,
    lambda _: None,
    lambda sock: sock.shutdown(socket.SHUT_WR),
    lambda sock: sock.shutdown(socket.SHUT_RD),
    reset,
)


@with_server
def test_asking_and_being_gone_at_once_changes_nothing(shared: Server) -> None:
    """The kernel shows a socket that nobody holds any more as root's."""
    before, descriptors = what_can_be_changed(shared), Path(f"/proc/{shared.process.pid}/fd")
    with shared.connect() as watcher:
        watcher.ask("subscribe")
        opened = len(list(descriptors.iterdir()))
        for number, (action, go, _) in enumerate(itertools.product(CONTROL, GOING, range(6))):
            encode = encode_bare_json if number % 3 == 0 else encode_json
            # The server may be rid of it already.
            with socket_of(NOBODY.pw_uid) as sock, contextlib.suppress(OSError):
                sock.connect(("127.0.0.1", shared.port))
                sock.sendall(encode(request(action, **CONTROL[action])))
                go(sock)
        assert what_can_be_changed(shared) == before, "after all that it sent was read"
        wait_until(lambda: len(list(descriptors.iterdir())) <= opened, "all connections to be closed")
        told = {event["event"] for event in watcher.events}
        assert told <= {"sensor_lost", "sensor_back"}, "a busy machine starves the sensor, nothing else"
        watcher.fresh(10)


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
@with_server
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
            assert described["ok"], "they may read"
    assert what_can_be_changed(shared) == before


@with_server
def test_root_may_control(shared: Server) -> None:
    """The last one: it ends the server."""
    with shared.connect() as client:
        assert client.ask("shutdown")["ok"]
    assert shared.wait() == 0
