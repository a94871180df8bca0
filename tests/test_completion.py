"""Every program's options: in the documentation, and in a shell that completes with `--print-completion`."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
from typing import Final

import pytest

from tests.ended import run_here
from tests.test_programs import PROGRAMS, ROOT

pytest.importorskip("shtab", reason="shtab is missing: pip install shtab")

COMPLETED: Final = {
    "ethercat-server --s": ["--set", "--stall-timeout"],
    "ethercat-sensor ta": ["tare"],
    "ethercat-virtual-sensor --pdo 7": ["77"],
    "ethercat-monitor --on": ["--once"],
}
COMPLETE: Final = """
complete_line() {
    local COMP_WORDS=($1) COMPREPLY=()
    [[ $1 != *" " ]] || COMP_WORDS+=("")
    local COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    "_shtab_${COMP_WORDS[0]//-/_}" 2>/dev/null
    echo "${COMPREPLY[@]}"
}
"""


def printed(name: str, *arguments: str) -> str:
    """What a program prints with these arguments."""
    package, _, entry = PROGRAMS[name].partition(":")
    started: list[str] = []
    module = importlib.import_module(package)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "run", started.append)
        getattr(module, entry)()
    ended = run_here(importlib.import_module(started[0]).main, *arguments)
    assert ended.code == 0, ended.err
    return ended.out


@pytest.mark.parametrize("name", ["ethercat-sensor", "ethercat-doctor", "ethercat-record", "ethercat-replay"])
def test_every_option_is_documented(name: str) -> None:
    options = set(re.findall(r"--[a-z][a-z-]+", printed(name, "--help")))
    text = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    assert not {option for option in options - {"--help", "--version"} if option not in text}


def test_a_shell_completes_with_what_is_printed() -> None:
    if (bash := shutil.which("bash")) is None:
        pytest.skip("bash is missing")
    lines = "\n".join(f"complete_line {line!r}" for line in COMPLETED)
    script = "\n".join(printed(name, "--print-completion", "bash") for name in PROGRAMS) + COMPLETE + lines
    done = subprocess.run([bash, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    found = dict(zip(COMPLETED, map(str.split, done.stdout.splitlines()), strict=True))
    assert found == COMPLETED


def test_without_shtab_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    ended = run_here(importlib.import_module("bota_clients.monitor.cli").main, "--print-completion", "bash")
    assert ended.code == 1
    assert ended.err.endswith(f"shtab is not installed: {sys.executable} -m pip install shtab\n")
