"""Who owns the other end of a connection, and who may change something."""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator

import pytest

from ethercat_server.errors import UsageError
from ethercat_server.serving.permissions import controlling_uids
from ethercat_server.serving.transport import open_diagnostics, peer_uid
from tests.server.as_another_user import NO_OTHER_USER

NOBODY = pwd.getpwnam("nobody")
AS_NOBODY = pytest.mark.skipif(NO_OTHER_USER is not None, reason=NO_OTHER_USER or "")


@pytest.fixture
def diagnostics() -> Iterator[socket.socket]:
    with open_diagnostics() as opened:
        yield opened


@contextlib.contextmanager
def listener(host: str) -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=family) as opened:
        opened.settimeout(10)
        yield opened


def test_the_kernel_was_asked_before_there_is_a_loop(diagnostics: socket.socket) -> None:
    """It loads modules for the first question about a family."""
    answers = []
    with contextlib.suppress(BlockingIOError):
        while True:
            answers.append(diagnostics.recv(4096))
    assert len(answers) == 2
    with (
        open_diagnostics() as asked_already,
        listener("127.0.0.1") as waiting,
        socket.create_connection(waiting.getsockname()),
    ):
        accepted, _ = waiting.accept()
        with accepted:
            assert peer_uid(asked_already, accepted) == os.geteuid(), "none of them is taken for its answer"


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_owner_of_a_connection_is_found(diagnostics: socket.socket, host: str) -> None:
    with listener(host) as waiting, socket.create_connection(waiting.getsockname()[:2]):
        accepted, _ = waiting.accept()
        with accepted:
            assert peer_uid(diagnostics, accepted) == os.geteuid()


def test_the_owner_of_a_socket_of_ipv6_with_an_address_of_ipv4_is_found(diagnostics: socket.socket) -> None:
    """What dual-stack clients connect to 127.0.0.1 with."""
    with listener("127.0.0.1") as waiting, socket.socket(socket.AF_INET6) as client:
        client.connect(("::ffff:127.0.0.1", waiting.getsockname()[1]))
        accepted, _ = waiting.accept()
        with accepted:
            assert peer_uid(diagnostics, accepted) == os.geteuid()


@AS_NOBODY
def test_another_user_is_told_apart(diagnostics: socket.socket) -> None:
    bash = shutil.which("bash")
    assert bash
    with listener("127.0.0.1") as waiting:
        port = waiting.getsockname()[1]
        command = [bash, "-c", f"exec 3<>/dev/tcp/127.0.0.1/{port}; read -r line <&3"]
        other = subprocess.Popen(command, user=NOBODY.pw_uid, group=NOBODY.pw_gid, extra_groups=[], cwd="/")
        accepted, _ = waiting.accept()
        with accepted:
            assert peer_uid(diagnostics, accepted) == NOBODY.pw_uid
        other.wait(timeout=10)


def test_a_socket_that_nobody_holds_any_more_has_no_owner(diagnostics: socket.socket) -> None:
    with listener("127.0.0.1") as waiting:
        for linger in (b"", struct.pack("ii", 1, 0)):
            client = socket.create_connection(waiting.getsockname())
            if linger:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            client.sendall(b"x")
            accepted, _ = waiting.accept()
            with accepted:
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

    with listener("0.0.0.0") as waiting:
        fake = Elsewhere(waiting.getsockname()[1])
        assert peer_uid(diagnostics, fake) is None  # type: ignore[arg-type]


def test_root_and_the_user_of_sudo_may_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SUDO_UID", raising=False)
    assert controlling_uids((), ()) == {0}
    monkeypatch.setenv("SUDO_UID", "1234")
    assert controlling_uids((), ()) == {0, 1234}
    monkeypatch.setenv("SUDO_UID", "-1")
    assert controlling_uids((), ()) == {0}


def test_named_users_and_groups_may_control() -> None:
    group = grp.getgrgid(NOBODY.pw_gid).gr_name
    assert NOBODY.pw_uid in controlling_uids(("nobody",), ())
    assert NOBODY.pw_uid in controlling_uids((), (group,)), "it is their primary group"
    assert 4711 in controlling_uids(("4711",), ()), "a number needs no entry"
    with pytest.raises(UsageError, match="no-such-user: there is no such user"):
        controlling_uids(("no-such-user",), ())
    with pytest.raises(UsageError, match="no-such-group: there is no such group"):
        controlling_uids((), ("no-such-group",))
