"""Builds the C++ programs of these tests with g++, and runs them."""

from __future__ import annotations

import atexit
import fcntl
import functools
import hashlib
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from bota_ethercat.framing import encode_data
from bota_ethercat.pdo import encode
from tests.server.running import PATIENCE_S

ROOT: Final = Path(__file__).parents[2]
CLIENT: Final = ROOT / "clients" / "cpp"
INCLUDE: Final = CLIENT / "include"
HEADERS: Final = sorted(INCLUDE.rglob("*.hpp"))
SOURCES: Final = Path(__file__).parent / "cpp"
GXX: Final = shutil.which("g++")
needs_gxx: Final = pytest.mark.skipif(GXX is None, reason="no g++ here: sudo apt install g++")

patient: Final = pytest.mark.timeout(300)
"""The first test of a program waits for g++, which may take its time on a busy machine."""

STRICT: Final = ("-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
SANITIZED: Final = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
# Not sanitized, which takes six times as long: it is about what the compiler makes of NaN. With the runtime
# of ASan, which counts what is allocated.
FAST: Final = ("-O2", "-ffast-math", "-Wl,--push-state,--no-as-needed", "-lasan", "-Wl,--pop-state")
# System calls that the driver counts, and the clock, which it can set.
WRAPPED: Final = (
    "socket", "connect", "close", "poll", "ppoll", "setsockopt", "getsockopt", "send", "recv",
    "clock_gettime",
)  # fmt: skip

KEPT_S: Final = 7 * 86400.0
"""Age from which a program that was built for other contents is deleted."""
Reading = dict[str, Any]


@functools.cache
def _folder() -> Path:
    """Where programs are built: kept between runs, for all workers, if pytest's cache can be written."""
    kept = ROOT / ".pytest_cache" / "cpp"
    try:
        kept.mkdir(parents=True, exist_ok=True)
        (kept / "lock").touch()
    except OSError:
        made = tempfile.mkdtemp(prefix="ethercat-cpp-")
        atexit.register(shutil.rmtree, made, ignore_errors=True)
        return Path(made)
    return kept


@functools.cache
def build(source: Path, flags: Sequence[str], others: Sequence[Path] = (), compiler: str = "g++") -> Path:
    """The program made of `source` and `others`, built once for their contents; every warning is an error."""
    digest = hashlib.sha256(repr((compiler, STRICT, flags)).encode())
    folders = (INCLUDE, source.parent, *(Path(flag[2:]) for flag in flags if flag.startswith("-I")))
    headers = (header for folder in folders for header in sorted(folder.rglob("*.hpp")))
    for path in (source, *others, *headers):
        digest.update(path.read_bytes())
    program = _folder() / f"{source.stem}-{digest.hexdigest()[:16]}"
    with (_folder() / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one of the workers builds it, the others wait
        if not program.exists():
            for old in _folder().glob(f"{source.stem}-*"):
                if old.stat().st_mtime < time.time() - KEPT_S:
                    old.unlink()
            unfinished = program.with_suffix(".new")
            sources = [str(path) for path in (source, *others)]
            command = [compiler, *STRICT, *flags, f"-I{INCLUDE}", *sources, "-o", str(unfinished)]
            made = subprocess.run(command, check=False, capture_output=True, text=True, timeout=280.0)
            assert made.returncode == 0, f"{' '.join(command)}\n{made.stderr}"
            unfinished.rename(program)
    return program


def driver_program(flags: Sequence[str] = SANITIZED) -> Path:
    """tests/clients/cpp/driver.cpp: one program for all tests, because g++ takes seconds."""
    return build(SOURCES / "driver.cpp", (*flags, *(f"-Wl,--wrap={name}" for name in WRAPPED)))


_idle: list[subprocess.Popen[str]] = []
"""Drivers that wait for the next test."""


class Commanded:
    """A program that a test commands: a line in for each command, and a line of JSON out."""

    process: subprocess.Popen[str]

    def begin(self, *words: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(" ".join(map(str, words)) + "\n")
        self.process.stdin.flush()

    def answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"the program ended with {self.process.wait(10)}"
        return json.loads(line)

    def do(self, *words: object) -> Any:
        self.begin(*words)
        return self.answer()


class Driver(Commanded):
    """A C++ client that a test commands: tests/clients/cpp/driver.cpp, a process for many tests."""

    def __init__(self, port: int, process: subprocess.Popen[str] | None = None, **options: object) -> None:
        self.process = process or (_idle.pop() if _idle else start_driver())
        self.begin("new", "host=127.0.0.1", f"port={port}", *(f"{k}={v}" for k, v in options.items()))

    def connect(self) -> Driver:
        told = self.do("connect", int(PATIENCE_S * 1000))
        assert told["ok"], told
        return self

    def latest(self, position: int = 0) -> Reading:
        reading: Reading = self.do("latest", position)
        assert reading["fresh"] == (reading["condition"] == "fresh")
        assert reading["has_sample"] or not (reading["fresh"] or reading["is_new"])
        return reading

    def info(self) -> dict[str, Any]:
        told: dict[str, Any] = self.do("info")
        return told


def start_driver(*inside: str, flags: Sequence[str] = SANITIZED) -> subprocess.Popen[str]:
    command = [*inside, str(driver_program(flags))]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def end_driver(process: subprocess.Popen[str]) -> int:
    """The exit code, which is not 0 if a sanitizer found something."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        return process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
    finally:
        process.stdout.close()


@contextmanager
def driver(port: int, /, **options: object) -> Iterator[Driver]:
    """A driver with a new client. A module that uses it ends with `assert_no_faults`."""
    running = Driver(port, None, **options)
    try:
        yield running
        running.do("close")
    except BaseException:
        end_driver(running.process)
        raise
    _idle.append(running.process)


def assert_no_faults() -> None:
    while _idle:
        assert end_driver(_idle.pop()) == 0


def frame(
    sequence: int, flags: int = 0, *, sensor: int = 0, age_s: float = 0.0, size: int = 61, **values: float
) -> bytes:
    """A DATA message; its force along x is its number. `values` by name, with `__` for the dot."""
    # A machine that has been up for less than `age_s` has no such instant yet.
    time.sleep(max(0.0, age_s - time.monotonic()))
    instant = time.monotonic_ns() - int(age_s * 1e9)
    data = encode(size, {"force.x": sequence, **{k.replace("__", "."): v for k, v in values.items()}})
    return encode_data(sequence, 5, instant, sensor, flags, 3, data)
