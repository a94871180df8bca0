"""What shells complete of the programs, in the shells of this machine, and their man pages."""

from __future__ import annotations

import os
import pty
import re
import shutil
import signal
import tomllib
from pathlib import Path
from typing import Any, Final

import pytest

from scripts import completions
from tests.ended import completed
from tests.ros_package.package_files import ROOT

PYPROJECTS: Final = ("pyproject.toml", "clients/pyproject.toml")
# Starts the shell with what is below the folder, and a program that says its arguments.
SHELLS: Final = {
    "bash": ("bash --norc --noprofile", "source {share}/bash-completion/completions/{name}; "
             "{name}() {{ echo \"got $* .\"; }}"),
    "zsh": ("zsh -f", "fpath=({share}/zsh/site-functions $fpath); autoload -Uz compinit; compinit -D -u; "
            "{name}() {{ echo \"got $* .\"; }}"),
    "fish": ("fish --no-config", "set -p fish_complete_path {share}/fish/vendor_completions.d; "
             "function {name}; echo got $argv .; end"),
}  # fmt: skip


def project(path: str) -> dict[str, Any]:
    return tomllib.loads((ROOT / path).read_text())


@pytest.fixture(scope="module")
def share(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("completions")
    shutil.copy(ROOT / "pyproject.toml", folder)
    completions.write(folder)
    return folder / "share"


def typed(shell: str, share: Path, line: str) -> str:
    """What the program got whose command line was typed into an interactive shell."""
    command, start = SHELLS[shell]
    start = start.format(share=share, name=line.split(maxsplit=1)[0])
    pid, terminal = pty.fork()
    if pid == 0:
        environment = {"PATH": os.environ["PATH"], "TERM": "dumb", "HOME": str(share)}
        os.execvpe("env", ["env", *command.split(), "-i"], environment)
    shown = ""
    with os.fdopen(terminal, "r+b", buffering=0) as user:

        def shown_until(text: str) -> str:
            nonlocal shown
            while text not in shown:
                shown += user.read(4096).decode()
            before, _, shown = shown.partition(text)
            return before

        user.write(f"{start}; echo rea''dy\n".encode())
        shown_until("ready")
        user.write(f"{line}\t\n".encode())
        shown_until("got ")
        arguments = shown_until(" .")
        os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return arguments


@pytest.mark.parametrize("shell", [name for name in SHELLS if shutil.which(name)])
@pytest.mark.parametrize(
    ("line", "completed"),
    [
        ("ethercat-server --rt-p", "--rt-priority"),
        ("ethercat-sensor filt", "filters"),
        ("ethercat-sensor apply --conf", "apply --config"),
        ("ethercat-virtual-sensor --signal pos", "--signal poses"),
    ],
)
def test_a_shell_completes(share: Path, shell: str, line: str, completed: str) -> None:
    assert typed(shell, share, line).split() == completed.split()


def test_every_option_of_every_program_is_completed_and_in_its_man_page(share: Path) -> None:
    scripts = project("pyproject.toml")["project"]["scripts"]
    programs = {name: entry for name, entry in scripts.items() if not name.startswith(completions.OF_ROS)}
    for kind, place in completions.PLACES.items():
        folder = (share / place).parent
        assert {path.name for path in folder.iterdir()} == {
            Path(place.format(name)).name for name in programs
        }
        for name, entry in programs.items():
            text = (share / place.format(name)).read_text().replace("\\", "")
            options = re.findall(r"^  (--[a-z-]+)", completions.parser_of(entry).format_help(), re.M)
            assert options
            for option in options:  # fish has them without the dashes
                assert option.removeprefix("--") in text, (kind, name, option)


@pytest.mark.skipif(not shutil.which("groff"), reason="there is no groff on this machine")
def test_groff_reads_the_man_pages_without_a_warning(share: Path) -> None:
    for path in sorted(share.glob("man/man1/*")):
        options = ("-man", "-Kutf8", "-Tutf8", "-P-cbou", "-ww")
        done = completed("groff", *options, path, check=True)
        assert (done.stderr, "NAME" in done.stdout) == ("", True)


def test_wheels_have_the_files_where_they_are_written() -> None:
    for path in PYPROJECTS:
        data_files = project(path)["tool"]["setuptools"]["data-files"]
        for place in completions.PLACES.values():
            folder = f"share/{Path(place).parent}"
            assert data_files[folder] == [f"{folder}/*"]
