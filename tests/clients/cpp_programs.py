"""Builds the C++ programs of these tests with g++, and runs them."""

from __future__ import annotations

import atexit
import functools
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from tests.server.running import PATIENCE_S, wait_until

ROOT: Final = Path(__file__).parents[2]
CLIENT: Final = ROOT / "clients" / "cpp"
SOURCES: Final = Path(__file__).parent / "cpp"
GXX: Final = shutil.which("g++")
needs_gxx: Final = pytest.mark.skipif(GXX is None, reason="no g++ here: sudo apt install g++")

patient: Final = pytest.mark.timeout(300)
"""The first test of a program waits for g++, which may take its time on a busy machine."""

STRICT: Final = ("-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
SANITIZED: Final = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
COUNTING: Final = ("-O0", "-DCOUNT_ALLOCATIONS")

BUILD_TIMEOUT_S: Final = 280.0
Reading = dict[str, Any]


@functools.cache
def build(source: Path, flags: Sequence[str], compiler: str = "g++") -> Path:
    """The program made of `source`; every warning is an error."""
    folder = tempfile.mkdtemp(prefix="ethercat-cpp-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    program = Path(folder) / source.stem
    command = [compiler, *STRICT, *flags, f"-I{CLIENT / 'include'}", str(source), "-o", str(program)]
    made = subprocess.run(command, check=False, capture_output=True, text=True, timeout=BUILD_TIMEOUT_S)
    assert made.returncode == 0, f"{' '.join(command)}\n{made.stderr}"
    return program


class Driver:
    """tests/clients/cpp/driver.cpp: a C++ client that does what it is told."""

    def __init__(self, port: int, flags: Sequence[str] = SANITIZED, /, **options: object) -> None:
        words = [f"{name}={value}" for name, value in options.items()]
        self.process = subprocess.Popen(
            [build(SOURCES / "driver.cpp", tuple(flags)), "host=127.0.0.1", f"port={port}", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def begin(self, *words: object) -> None:
        """Give a command; `answer` has what comes of it."""
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

    def connect(self) -> Driver:
        told = self.do("connect", int(PATIENCE_S * 1000))
        assert told["ok"], told
        return self

    def latest(self, place: int = 0) -> Reading:
        reading: Reading = self.do("latest", place)
        return reading

    def info(self, place: int = 0) -> dict[str, Any]:
        told: dict[str, Any] = self.do("info", place)
        return told

    def until(self, condition: Callable[[Reading], bool], what: str) -> Reading:
        """Ask for the latest until it is so; every reading until then must hold what all must hold."""
        last: Reading = {}

        def so() -> bool:
            last.update(self.latest())
            check(last)
            return condition(last)

        wait_until(so, what)
        return last

    def close(self) -> int:
        """End it; the exit code, which is not 0 if a sanitizer found something."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        try:
            return self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()
        finally:
            self.process.stdout.close()


@contextmanager
def driver(port: int, flags: Sequence[str] = SANITIZED, /, **options: object) -> Iterator[Driver]:
    """A driver that ends with 0, whatever it met."""
    running = Driver(port, flags, **options)
    try:
        yield running
    except BaseException:
        running.close()
        raise
    assert running.close() == 0


def check(reading: Reading) -> None:
    """What holds of every reading."""
    if reading["fresh"]:
        assert reading["has_sample"]
    if reading["is_new"]:
        assert reading["has_sample"]
    assert reading["fresh"] == (reading["condition"] == "fresh")
