"""The monitor on a server with two virtual sensors: as a program, in a terminal and in pipes."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bota_clients.monitor import cli, program
from bota_clients.monitor.cli import parse
from bota_clients.monitor.model import Model, State
from bota_clients.monitor.reader import MonitorReader
from bota_clients.monitor.tare import tare
from bota_clients.recording.reader import open_recording
from bota_ethercat.address import Address
from bota_ethercat.client import Client
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.bridge.scripted_server import ScriptedServer
from tests.clients.running import frames_in, signalled
from tests.served_simulation import ServedSimulation, served
from tests.server.running import PATIENCE_S, free_port, wait_until
from tests.simulation import simulated_bus, simulated_server

SENSORS = [SensorOptions(model=model, pdo_size=77) for model in ("BFT-SENS-ECAT-M8", "BFT-ROKS-ECAT-M8")]
COMMAND = str(Path(sys.executable).with_name("ethercat-monitor"))
LEAVE_ALTERNATE_SCREEN = b"\x1b[?1049l"
SHOW_CURSOR = b"\x1b[?25h"


@pytest.fixture(scope="module")
def shared() -> Iterator[ServedSimulation]:
    """At 100 Hz, because nothing here is about the rate."""
    with served(*SENSORS, sinc_length=512) as server:
        yield server


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Runs the program here, where a second is over when there are samples: exit code, output and errors."""
    handler = signal.getsignal(signal.SIGTERM)
    models: list[Model] = []

    def model(*arguments: Any) -> Model:
        models.append(Model(*arguments))
        return models[-1]

    def sleep(_: float) -> None:
        before = samples(models[-1])
        wait_until(lambda: samples(models[-1]) > before + 20, "samples")

    def running(*arguments: str) -> tuple[int, str, str]:
        code = cli.main(arguments)
        return code, *capsys.readouterr()

    monkeypatch.setattr(program, "Model", model)
    monkeypatch.setattr(
        program, "time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic, time=time.time)
    )
    monkeypatch.setattr(program, "_ANSWER_S", PATIENCE_S)
    yield running
    signal.signal(signal.SIGTERM, handler)


class Terminal:
    """The monitor in a terminal of 80 by 24."""

    def __init__(self, *arguments: str, cwd: Path | None = None, **environment: str) -> None:
        self.near, far = pty.openpty()
        termios.tcsetwinsize(far, (24, 80))
        self.before = termios.tcgetattr(far)
        self.far = far
        self.seen = b""
        self.process = subprocess.Popen(
            [COMMAND, *arguments], stdin=far, stdout=far, stderr=far, start_new_session=True, cwd=cwd,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "", "LINES": "", **environment},
        )  # fmt: skip

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        if self.near >= 0:
            os.close(self.near)
        os.close(self.far)

    def read(self) -> bytes:
        """Everything so far."""
        while select.select((self.near,), (), (), 0.02)[0]:
            self.seen += os.read(self.near, 65536)
        return self.seen

    def wait_for(self, text: str) -> None:
        wait_until(lambda: text.encode() in self.read(), f"{text!r} in {self.seen[-2000:]!r}")

    def type(self, keys: str) -> None:
        os.write(self.near, keys.encode())

    def hang_up(self) -> None:
        """Close the window: what is written from then on fails."""
        os.close(self.near)
        self.near = -1

    def end(self) -> int:
        """Its exit code, once it has ended."""
        wait_until(lambda: self.read() is not None and self.process.poll() is not None, "its end")
        return self.process.wait()

    def is_as_it_was(self) -> bool:
        back = LEAVE_ALTERNATE_SCREEN in self.read() and SHOW_CURSOR in self.seen
        return back and termios.tcgetattr(self.far) == self.before


def test_once_prints_both_sensors_and_says_fine(shared: ServedSimulation, run: Run) -> None:
    code, out, err = run("--once", "--server", str(shared.port))
    assert (code, err) == (0, ""), out
    assert "BFT-SENS-ECAT-M8" in out
    assert "BFT-ROKS-ECAT-M8" in out
    assert out.count("Force N ") == out.count("Torque Nm ") == 2
    assert out.count(" min ") == out.count(" max") == 4
    assert "client this one" in out
    assert re.search(r"\n(Good|Worth a look): .*\.\n$", out)


def test_once_without_a_server_is_exit_1_and_one_sentence(run: Run) -> None:
    port = free_port()
    code, out, err = run("--once", "--server", f"localhost:{port}")
    assert (code, out) == (1, "")
    assert err == (
        f"ethercat-monitor: no server at localhost:{port} (Connection refused): start ethercat-server, "
        "or give its address\n"
    )


@pytest.mark.parametrize(
    "arguments",
    [["localhost"], ["--seconds=0"], ["--once", "--seconds=3"]],
)  # fmt: skip
def test_wrong_usage_is_exit_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(arguments)
    assert ended.value.code == 2


def test_a_reader_that_goes_is_no_traceback(shared: ServedSimulation) -> None:
    command = f"set -o pipefail; {COMMAND} --json --server {shared.port} | head -n 1"
    done = subprocess.run(
        ["bash", "-c", command], check=False, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert json.loads(done.stdout)["connected"] is True
    assert done.stderr == ""
    assert done.returncode == 0


def test_ctrl_c_is_no_failure(shared: ServedSimulation, capsys: pytest.CaptureFixture[str]) -> None:
    ready = lambda: "connected" in capsys.readouterr().out  # noqa: E731
    assert signalled(cli.main, signal.SIGINT, ready, "--json", "--server", shared.port) == 0
    assert capsys.readouterr().err == ""


def test_a_dumb_terminal_gets_the_table_once_without_escape_sequences(shared: ServedSimulation) -> None:
    with Terminal("--server", str(shared.port), TERM="dumb", PYTHONIOENCODING="ascii") as terminal:
        terminal.end()
        seen = terminal.read().decode("ascii")
    assert seen.count("Force N ") == 2
    assert "\x1b" not in seen


def test_the_terminal_is_as_it_was_and_had_no_color(shared: ServedSimulation) -> None:
    with Terminal("--server", str(shared.port), NO_COLOR="1") as terminal:
        terminal.wait_for("BFT-SENS-ECAT-M8")
        terminal.process.send_signal(signal.SIGTERM)
        assert terminal.end() == 0
        assert terminal.is_as_it_was()
        assert b"Traceback" not in terminal.read()
        seen = terminal.seen.decode()
    codes = {code for style in re.findall(r"\x1b\[([0-9;]*)m", seen) for code in style.split(";")}
    assert "1" in codes  # bold
    colors = {"38", "48", *map(str, (*range(30, 38), *range(40, 48), *range(90, 98), *range(100, 108)))}
    assert not codes & colors, "NO_COLOR"


@pytest.mark.parametrize("way", ["the terminal closes", "SIGHUP and the terminal closes"])
def test_a_recording_ends_with_the_monitor(shared: ServedSimulation, way: str, tmp_path: Path) -> None:
    with Terminal("--server", str(shared.port), cwd=tmp_path) as terminal:
        terminal.wait_for("BFT-SENS-ECAT-M8")
        terminal.type("r")
        terminal.wait_for("REC ")
        wait_until(lambda: any(map(frames_in, tmp_path.glob("*.mcap"))), "frames in the recording")
        terminal.hang_up()
        if "SIGHUP" in way:  # which nohup ignores
            terminal.process.send_signal(signal.SIGHUP)
        terminal.process.wait(PATIENCE_S)
    (made,) = tmp_path.glob("*.mcap")
    with open_recording(made) as recording:
        assert recording.end is not None
        assert recording.end["reason"] == "asked to stop"


@contextlib.contextmanager
def reading(port: int) -> Iterator[Model]:
    model = Model("server")
    reader = MonitorReader(Address("localhost", port), model)
    reader.start()
    try:
        yield model
    finally:
        reader.close()


def state(model: Model) -> State:
    return model.state(time.monotonic())


def samples(model: Model) -> int:
    return min((sensor.samples for sensor in state(model).sensors), default=0)


@pytest.fixture(autouse=True)
def state_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where this user's last tares are kept."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


def test_a_tare_says_what_is_left_and_is_undone_and_cleared() -> None:
    address = Address("localhost", 1)

    def offset() -> list[float]:
        with Client(address.port, stream=False).connect() as client:
            found: list[float] = client.description["sensors"][0]["offset"]
            return found

    with simulated_bus("--signal", "rest") as bus, simulated_server(bus):
        assert tare(address, 0, "undo") == (
            "The tare of sensor 0 was not undone: no tare of sensor 0 by this user is known; clear the "
            "offset, or tare again", True,
        )  # fmt: skip
        text, bad = tare(address, 0)
        assert not bad
        assert re.fullmatch(r"Sensor 0 was tared; residual at most [0-9.]+ N and [0-9.]+ Nm", text)
        tared = offset()
        assert tare(address, 0, "undo") == ("The tare of sensor 0 was undone", False)
        assert offset() == [0.0] * 6
        assert not tare(address, 0, "undo")[1], "of the undoing"
        assert offset() == tared
        assert tare(address, 0, "clear") == ("The offset of sensor 0 was cleared", False)
        assert offset() == [0.0] * 6
        with Client(address.port, stream=False).connect() as client:
            client.ask("sdo_write", sensor=0, index=0x8000, subindex=1, type="f32", value=1.0)
        assert "the offset of sensor 0 has changed since" in tare(address, 0, "undo")[0]
        bus.command("on-write 0x8000 2 abort 0x8000 3 0x08000022")
        text, bad = tare(address, 0, "clear")
        assert bad
        assert text.startswith("The offset of sensor 0 was not cleared: ")
        assert offset() == [1.0, *[0.0] * 5]


def test_tare_says_why_not() -> None:
    with simulated_bus("--signal", "scene") as bus, simulated_server(bus) as server:
        text, bad = tare(Address("localhost", 1), 0)
        assert bad
        assert re.match("Sensor 0 was not tared: .*not at rest", text)
        server.hangs = True
        text, bad = tare(Address("localhost", 1), 0)
        assert bad
        assert re.match("Sensor 0 was not tared: .*no reply to describe", text)


def test_an_offset_that_is_unknown_or_not_taken_is_told() -> None:
    with ScriptedServer() as server:
        address = Address("localhost", server.port)
        assert tare(address, 0, "clear")[0].endswith("not cleared: its offset is unknown to the server")
        server.description["sensors"][0]["offset"] = [1.0] * 6
        assert tare(address, 0, "clear")[0].endswith("not cleared: the sensor did not take the offset")


@pytest.mark.parametrize("way", ["silent", "gone"])
def test_a_tare_without_an_answer_is_not_known(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bota_clients.monitor.tare._TIMEOUT_S", 0.05 if way == "silent" else PATIENCE_S)
    with ScriptedServer() as server:
        server.answers["tare"] = lambda _: server.drop() if way == "gone" else None
        text, bad = tare(Address("localhost", server.port), 0)
    assert bad
    assert text.startswith("It is unknown whether sensor 0 was tared: ")


def test_a_restart_of_the_server_is_seen_and_survived() -> None:
    with served(*SENSORS, sinc_length=512) as first, reading(first.port) as model:
        wait_until(lambda: samples(model) > 20, "samples")
        first.close()
        wait_until(lambda: not state(model).server.connected, "the end of the connection")
        assert state(model).server.reason
        with served(*SENSORS, port=first.port, sinc_length=512):
            wait_until(lambda: state(model).server.connected, "a new connection")
            wait_until(lambda: samples(model) > 20, "samples again")
            wait_until(lambda: not any(sensor.old_s for sensor in state(model).sensors), "fresh ones")
