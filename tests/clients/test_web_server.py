"""`ethercat-monitor --web` over real sockets, which are what is tested here, and as a program."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from bota_clients.monitor import cli
from bota_clients.monitor.web.pages import MOST_PAGES, TOO_MANY
from bota_clients.monitor.web.server import HEADERS
from bota_clients.recording.reader import open_recording
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.clients.running import frames_in
from tests.clients.web_pages import Web
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, Program, free_port, has_ipv6, wait_until


@pytest.fixture(scope="module")
def web() -> Iterator[Web]:
    shared = Web()
    with shared.serving():
        yield shared


@contextlib.contextmanager
def stream_of(port: int, origin: str = "") -> Iterator[ClientConnection]:
    """As the page opens it, or a page of another `origin`."""
    given = Origin(origin or f"http://localhost:{port}")
    with connect(f"ws://localhost:{port}/stream", origin=given, compression=None) as stream:
        yield stream


def message(stream: ClientConnection, key: str) -> dict[str, Any]:
    """The next message with this key."""
    while key not in (found := json.loads(stream.recv(PATIENCE_S))):
        pass
    return dict(found)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_page_is_served_on_both_loopback_addresses_and_nothing_is_kept(web: Web, host: str) -> None:
    if host == "::1" and not has_ipv6():
        pytest.skip("no IPv6 here")
    for name, status in (("localhost", 200), ("evil.example", 403)):
        asking = http.client.HTTPConnection(host, web.port, timeout=PATIENCE_S)
        asking.request("GET", "/", headers={"Host": name})
        answer = asking.getresponse()
        assert answer.status == status
        assert dict(answer.getheaders()).items() >= HEADERS.items()
        assert answer.read().startswith(b"The page is for this machine only") is (status == 403)
        assert web.pages.token not in str(answer.headers)
        asking.close()
    with pytest.raises(InvalidStatus, match="403"), stream_of(web.port, "http://evil.example"):
        pass


@pytest.mark.parametrize(
    ("text", "code"), [("x" * 2000, 1009), ("[]", 1008), (b"\x00\x01", 1008)], ids=["long", "list", "bytes"]
)
def test_what_no_page_sends_ends_its_connection_and_no_other(web: Web, text: str, code: int) -> None:
    with stream_of(web.port) as good, stream_of(web.port) as bad:
        bad.send(text)
        with pytest.raises(ConnectionClosed) as closed:
            message(bad, "never")
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == code
        assert message(good, "state")


def test_one_page_too_many_is_told_so(web: Web) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MOST_PAGES):
            message(stack.enter_context(stream_of(web.port)), "state")
        with stream_of(web.port) as late, pytest.raises(ConnectionClosed) as closed:
            late.recv(PATIENCE_S)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.reason == TOO_MANY


def test_a_port_in_use_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    with socket.create_server(("127.0.0.1", free_port())) as other:
        port = other.getsockname()[1]
        assert cli.main(["--web", str(port), "--server", "localhost:1"]) == 1
    signal.signal(signal.SIGTERM, handler)
    sentence = f"ethercat-monitor: localhost:{port} is in use: choose another port with --web PORT\n"
    assert capsys.readouterr() == ("", sentence)


def test_the_program_shows_tares_records_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    """With a real server: the link that it prints is enough to tare, and to record into its folder."""
    port = free_port()
    with served(SensorOptions(signal="rest")) as server:
        program = Program(
            "bota_clients.monitor.cli", ["--server", f"localhost:{server.port}", "--web", str(port)],
            under=["env", "--chdir", str(tmp_path)],
        )  # fmt: skip
        try:
            program.wait_for("Ctrl-C ends it")
            link = re.search(rf"http://localhost:{port}/#token=(\S+)", program.said())
            assert link is not None
            with stream_of(port) as stream:
                stream.send(json.dumps({"token": link[1]}))
                assert message(stream, "control") == {"control": True, "refused": None}
                assert message(stream, "points")["points"] == 0
                stream.send('{"do":"tare"}')
                while "was tared; residual" not in (
                    said := str(message(stream, "state")["state"]["message"])
                ):
                    assert "not tared" not in said
                stream.send('{"do":"record"}')
                while not message(stream, "state")["state"]["recording"]:
                    pass
                wait_until(lambda: sum(map(frames_in, tmp_path.glob("*.mcap"))) > 0, "frames")
                stream.send('{"do":"record"}')
                while message(stream, "state")["state"]["recording"]:
                    pass
                assert "nothing was lost" in str(message(stream, "state")["state"]["message"])
                with open_recording(next(tmp_path.glob("*.mcap"))) as stopped:
                    assert (stopped.cut_off, stopped.end and stopped.end["reason"]) == (None, "asked to stop")
                    stopped.path.unlink()
                stream.send('{"do":"record"}')
                wait_until(lambda: sum(map(frames_in, tmp_path.glob("*.mcap"))) > 0, "frames")
                program.signal(signal.SIGINT)
                with pytest.raises(ConnectionClosed):
                    message(stream, "never")
            assert program.wait() == 0
            *_, ended = said_lines = program.said().splitlines()
            assert (len(said_lines), ended.startswith("Recorded recording-")) == (3, True), said_lines
            with open_recording(next(tmp_path.glob("*.mcap"))) as whole:
                assert whole.cut_off is None
        finally:
            program.close()
