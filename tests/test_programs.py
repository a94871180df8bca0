"""What holds for every program on PATH: how it starts, what it prints where, what it needs."""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import pytest

from bota_clients.identify.cli import main as identify
from bota_ethercat.health.advice import IT_TELLS
from bota_ethercat.program.arguments import EXAMPLES, Parser, number, whole
from bota_ethercat.program.command import command
from ethercat_server import programs
from ethercat_server.tool import settings
from tests.clients.recordings import frame, write
from tests.ended import completed, run_here
from tests.served_simulation import served
from tests.simulation import more_if_long

ROOT: Final = Path(__file__).parent.parent
SCRIPTS: Final[dict[str, str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
PROGRAMS: Final = {name: entry for name, entry in SCRIPTS.items() if not name.startswith("bridge-")}
CLIENTS: Final = [name for name, entry in PROGRAMS.items() if entry.startswith("bota_clients.")]
PATHS: Final = os.pathsep.join(str(ROOT / folder) for folder in (".", "protocol", "clients"))
EXTRA: Final = ("jinja2", "mcap", "numpy", "rich", "textual", "zstandard")

INTERRUPTED: Final = """
import os, sys
def interrupt(event, arguments):
    if event == "import" and arguments[0] == {at!r} or event == {at!r}:
        os.kill(os.getpid(), {number})
sys.addaudithook(interrupt)
sys.stdin.isatty = sys.stdout.isatty = lambda: True
sys.argv = ["program", *{arguments!r}.split()]
from {package} import {entry}
sys.exit({entry}())
"""


def interrupted(name: str, number: int, at: str, arguments: str) -> tuple[int, str, str]:
    """A process, which gets the signal where it imports a module, or at an audit event."""
    package, _, entry = PROGRAMS[name].partition(":")
    script = INTERRUPTED.format(at=at, number=number, arguments=arguments, package=package, entry=entry)
    done = completed(sys.executable, "-c", script, env={**os.environ, "TERM": "xterm"})
    return done.returncode, done.stderr, done.stdout


def unread(name: str, *arguments: str, full: bool = False) -> tuple[int, str]:
    """Exit code and standard error of a program whose output nobody reads any more, or no disk takes."""
    read, write = os.pipe()
    os.close(read)
    if full:
        os.close(write)
        write = os.open("/dev/full", os.O_WRONLY)
    package, _, entry = PROGRAMS[name].partition(":")
    script = f"import sys; sys.argv[0] = {name!r}; from {package} import {entry}; sys.exit({entry}())"
    try:
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments],
            env={key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"},
            stdout=write, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    finally:
        os.close(write)
    return done.returncode, done.stderr


@pytest.mark.parametrize("name", PROGRAMS)
def test_nobody_reads_the_output(name: str) -> None:
    assert unread(name, "--help") == (1, "")


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("ethercat-server", "--help"), ("ethercat-sensor", "filters --loop 500"),
     ("ethercat-sensor", "filters --loop 500 --json")],
)  # fmt: skip
def test_a_full_disk_is_one_sentence(name: str, arguments: str) -> None:
    said = f"{name}: the output cannot be written: No space left on device\n"
    assert unread(name, *arguments.split(), full=True) == (1, said)


def test_nobody_reads_what_the_virtual_sensor_answers(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sensor:
        sensor.bind(path := str(tmp_path / "control"))

        def answer() -> None:
            _, asker = sensor.recvfrom(100)
            sensor.sendto(b"ok " + b"." * 100_000, asker)

        thread = threading.Thread(target=answer)
        thread.start()
        assert unread("ethercat-virtual-sensor", "--control", path, "--send", "stats") == (1, "")
        thread.join()


# Of each program, what it does where a server streams on `port`; what it writes is in `out`.
CLOSED: Final = {
    "ethercat-server": ["--help", "virtual abc"],
    "ethercat-virtual-sensor": ["--help", "--control {out}/none --send stats"],
    "ethercat-sensor": [
        "adapters", "filters --loop 500", "read :{port} rate", "tare :{port}", "save :{port}",
        "apply :{port} --set chop=on", "apply :{port} --set chop=off --json", "snapshot {out}/s.json :{port}",
    ],
    "ethercat-doctor": ["--help", "no-such --json"],
    "ethercat-export": ["{given}/run.mcap {out}/run.csv"],
    "ethercat-identify": ["{given}/tool.yaml --bota {out}/tool.json"],
    "ethercat-record": ["{out}/run.mcap --server :{port} --for 0.2s"],
    "ethercat-replay": ["--help", "{out}/none.mcap"],
    "ethercat-report": ["{given}/run.mcap -o {out}/run.html"],
    "ethercat-monitor": ["--json --seconds 1 --server :{port}"],
    "bridge-client": ["--help", "--ros-args -p sensor:=-1"],
    "bridge-check-subscription": ["--help", "a --for 0"],
}  # fmt: skip


@pytest.mark.parametrize("closing", more_if_long(["<&- >&- 2>&-"], ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"]))
@pytest.mark.parametrize("name", SCRIPTS)
def test_closed_standard_streams_change_nothing_of_what_is_done(
    name: str, closing: str, tmp_path: Path
) -> None:
    """Real processes, whose descriptors 0 to 2 are free for whatever is opened first."""
    (given := tmp_path / "given").mkdir()
    (given / "tool.yaml").write_text("tool_mass: 1.0\ntool_center_of_mass: [0.0, 0.0, 0.1]\n")
    write(given / "run.mcap", [frame(number) for number in range(400)])
    with served() as server:
        for row in CLOSED[name]:
            ends = []
            for how in ("", closing):
                (out := tmp_path / f"{CLOSED[name].index(row)}{bool(how)}").mkdir()
                arguments = row.format(port=server.port, given=given, out=out).split()
                program = Path(sys.executable).with_name(name)
                done = completed("sh", "-c", f'exec "$@" {how}', "sh", program, *arguments)
                assert "Traceback" not in done.stdout + done.stderr, (row, how, done.stderr)
                ends.append((done.returncode, sorted(path.name for path in out.iterdir())))
            assert ends[1:] == ends[:1], row


def test_what_is_opened_for_closed_streams_is_for_children_too() -> None:
    child = "subprocess.run(['sh', '-c', 'echo; echo >&2; cat'], check=True)"
    script = (
        f"import subprocess; from bota_ethercat.program.start import open_streams; open_streams(); {child}"
    )
    assert completed("sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", sys.executable, "-c", script).returncode == 0


def test_limits_of_numbers_are_allowed() -> None:
    assert [number(1, 32)(text) for text in ("1", "32")] == [1, 32]
    assert [whole(1, 32)(text) for text in ("1", "0x20")] == [1, 32]
    for text in ("0", "33"):
        for parse in (number(1, 32), whole(1, 32)):
            with pytest.raises(argparse.ArgumentTypeError, match="from 1 to 32"):
                parse(text)


@pytest.mark.parametrize("number", more_if_long([signal.SIGINT], [signal.SIGINT, signal.SIGTERM]))
@pytest.mark.parametrize(
    ("name", "module", "arguments"),
    [
        ("ethercat-sensor", "argparse", "--help"),
        ("ethercat-doctor", "ethercat_server.daemon.options", "--help"),
        ("ethercat-report", "jinja2", "run.mcap"),
        ("ethercat-monitor", "bota_clients.monitor.screen", "--once"),
        ("ethercat-monitor", "textual.app", ""),
        ("ethercat-server", "ethercat_server.process.logs", "--help"),
    ],
)
def test_a_signal_while_it_is_imported_is_no_traceback(
    name: str, module: str, arguments: str, number: signal.Signals
) -> None:
    """Its default ends the program."""
    assert interrupted(name, number, module, arguments) == (-number, "", "")


FIRST: Final = (
    r"(bota_clients|ethercat_server)(\.programs)?|bota_ethercat(\.program(\.start)?)?|__future__|signal"
)


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_answers_signals_before_it_imports_anything(name: str) -> None:
    """But the way to what sees to that. The signal comes with the first other module."""
    package, _, entry = PROGRAMS[name].partition(":")
    script = f"""
import os, re, signal, sys, threading  # threading: what Python imports to end
def interrupt(event, arguments):
    if event == "import" and not re.fullmatch({FIRST!r}, arguments[0]):
        sys.stdout.write(arguments[0] + " ")
        sys.stdout.flush()
        os.kill(os.getpid(), signal.SIGINT)
sys.modules.pop("typing", None)
sys.addaudithook(interrupt)
sys.argv = ["program"]
from {package} import {entry}
sys.exit({entry}())
"""
    done = completed(sys.executable, "-S", "-c", script, env={**os.environ, "PYTHONPATH": PATHS})
    assert (done.returncode, done.stderr, len(done.stdout.split())) == (-signal.SIGINT, "", 1)


@pytest.mark.parametrize("nohup", [False, True])
def test_a_lost_terminal_stops_a_program_after_the_change_it_makes(nohup: bool) -> None:
    script = f"""
import os, signal
from bota_ethercat.program.signals import interrupt_on_signals, signals_held_back
signal.signal(signal.SIGHUP, signal.{"SIG_IGN" if nohup else "SIG_DFL"})
interrupt_on_signals()
try:
    with signals_held_back():
        os.kill(os.getpid(), signal.SIGHUP)
        print("changed", end="")
except KeyboardInterrupt:
    print(" stopped", end="")
"""
    done = completed(sys.executable, "-c", script)
    assert (done.returncode, done.stdout) == (0, "changed" if nohup else "changed stopped")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_interfaces_are_listed_is_no_traceback(number: int) -> None:
    code, said, found = interrupted("ethercat-sensor", number, "socket.__new__", "find")
    assert (code, said, found) == (1, "ethercat-sensor: stopped\n", "")


def main_of(name: str, monkeypatch: pytest.MonkeyPatch) -> Callable[[Sequence[str]], int]:
    """What runs once a program has started."""
    package, _, entry = PROGRAMS[name].partition(":")
    started: list[str] = []
    monkeypatch.setattr(f"{package}.run", started.append)
    getattr(importlib.import_module(package), entry)()
    main: Callable[[Sequence[str]], int] = importlib.import_module(started[0]).main
    return main


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def start(_: str) -> int:
        raise ModuleNotFoundError("No module named 'pysoem'", name="pysoem")

    monkeypatch.setattr("bota_ethercat.program.start.run", start)
    monkeypatch.setattr(sys, "argv", ["/opt/bin/ethercat-server"])
    assert programs.server() == 1
    sentence = "ethercat-server: pysoem is missing: this needs Linux and 'pip install .' there\n"
    assert capsys.readouterr().err == sentence
    monkeypatch.setitem(sys.modules, "bota_clients.identify.program", None)
    assert identify(["x.mcap"]) == 1
    sentence = "ethercat-identify: bota_clients is not installed: in this project's folder run "
    assert capsys.readouterr().err.startswith(sentence)


@pytest.mark.parametrize("name", ["ethercat-sensor", "ethercat-doctor", "ethercat-record", "ethercat-replay"])
def test_every_option_is_documented(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options = set(re.findall(r"--[a-z][a-z-]+", run_here(main_of(name, monkeypatch), "--help").out))
    text = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    assert not {option for option in options - {"--help", "--version"} if option not in text}


@pytest.mark.parametrize("name", PROGRAMS)
def test_help_begins_with_three_examples_that_are_understood(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = main_of(name, monkeypatch)
    head, *rows, end, usage = run_here(main, "--help").out.splitlines()[:6]
    assert (head, end, usage.split()[:2]) == ("examples:", "", ["usage:", name])

    def only_once(parse: Callable[..., Any]) -> Callable[..., Any]:
        def parsed(self: Parser, *given: Any) -> Any:
            found = parse(self, *given)
            if name != "ethercat-sensor" or self.prog != name:  # it parses the subcommand's name first
                raise SystemExit(42)
            return found

        return parsed

    for method in ("parse_args", "parse_intermixed_args"):
        monkeypatch.setattr(Parser, method, only_once(getattr(Parser, method)))
    for row in rows:
        _, *arguments = shlex.split(row.removeprefix("sudo "), comments=True)
        assert run_here(main, *arguments).code == 42, row


def test_a_command_in_a_message_works_as_it_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From pip's folder, which nobody has on PATH, and by links, which sudo finds too."""
    bin_, on_path = tmp_path / "a b" / "bin", tmp_path / "on_path"
    for folder in (bin_, on_path):
        folder.mkdir(parents=True)
    for name in ("ethercat-doctor", "ethercat-monitor"):
        (bin_ / name).touch(0o755)
    monkeypatch.setattr(sys, "argv", [str(bin_ / "ethercat-monitor")])
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    monkeypatch.setenv("PATH", str(on_path))
    monkeypatch.setattr("bota_ethercat.program.command._SUDO_PATH", "/none")
    assert command("sudo ethercat-doctor ens5") == f"sudo '{bin_}/ethercat-doctor' ens5"
    assert command("ethercat-doctor a.trace") == f"'{bin_}/ethercat-doctor' a.trace"
    assert command("ethercat-none") == "ethercat-none"
    (on_path / "ethercat-doctor").symlink_to(bin_ / "ethercat-doctor")
    assert command("ethercat-doctor a.trace") == "ethercat-doctor a.trace"
    assert command("sudo ethercat-doctor ens5") == f"sudo '{bin_}/ethercat-doctor' ens5"
    monkeypatch.setattr("bota_ethercat.program.command._SUDO_PATH", str(on_path))
    assert command("sudo ethercat-doctor ens5") == "sudo ethercat-doctor ens5"
    assert f"'{bin_}/ethercat-monitor' --once" in Parser("ethercat-monitor", "", "").format_help()


def test_no_message_has_a_command_that_only_works_on_path() -> None:
    """Beside docstrings, and what a program's own --help says of itself."""
    names = "|".join(SCRIPTS)
    bare = re.compile(rf"(sudo |')({names})\b(?!@)|^({names}) [a-z-]")
    found, known = list[str](), {EXAMPLES, settings._FORMAT, IT_TELLS}
    of_help = ("command", "Parser", "_Parser", "add")
    for folder in ("protocol", "ethercat_server", "ros2_bridge", "clients/bota_clients"):
        for path in (ROOT / folder).rglob("*.py"):
            nodes = [*ast.walk(ast.parse(path.read_text()))]
            told = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
            for call in nodes:
                if isinstance(call, ast.Call) and ast.unparse(call.func) in of_help:
                    told |= {id(part) for part in ast.walk(call)}
            found += [
                f"{path}:{node.lineno}: {node.value}" for node in nodes
                if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told
                and node.value not in known and bare.search(node.value)
            ]  # fmt: skip
    assert found == []


def test_help_needs_nothing_of_the_extra() -> None:
    """A process, in which none of it can be imported."""
    script = f"""
import importlib, sys
sys.modules.update(dict.fromkeys({EXTRA!r}))
for name, entry in {[(name, PROGRAMS[name]) for name in CLIENTS]!r}:
    package, _, entry = entry.partition(":")
    for sys.argv in ([name, "--help"], [name, "--version"]):
        try:
            print(getattr(importlib.import_module(package), entry)())
        except SystemExit as ended:
            assert ended.code == 0, name
"""
    done = completed(sys.executable, "-c", script)
    assert (done.returncode, done.stderr) == (0, "")
    for name in CLIENTS:
        assert f"usage: {name}" in done.stdout
