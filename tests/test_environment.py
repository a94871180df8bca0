"""What scripts/environment says while it installs, and what the demo needs no more of."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

import pytest

from tests.ended import completed
from tests.rights import NOBODY, needs_another_user
from tests.server.running import needs_bus, wait_until

ROOT: Final = Path(__file__).parent.parent
PIP: Final = """
echo 'Collecting numpy<3,>=1.26 (from bota)'; echo '  Downloading https://example.org/numpy-2.4.whl (6.6 kB)'
until [ -e "$1/seen" ]; do sleep 0.02; done
"""


def run(script: str, folder: Path, *before: str) -> tuple[int, str]:
    source = f'source "{ROOT}/scripts/environment"; filling={folder} every=0.05\n'
    done = completed(*before, "bash", "-c", source + script, "demo", folder)
    return done.returncode, done.stderr


def test_it_says_what_it_installs_how_much_there_is_and_how_long(tmp_path: Path) -> None:
    (tmp_path / "pip").write_text(PIP)
    script = """
say() { printf '%s\n' "$*" >&2; [[ $* != *numpy* ]] || touch "$filling/seen"; }
quietly bash "$1/pip" "$1"
"""
    code, said = run(script, tmp_path)
    assert code == 0
    line = said.splitlines()[-1]
    assert re.fullmatch(rf"\d+ s, \d+ MB in {tmp_path} \(numpy\)", line), said


def test_what_is_stopped_leaves_no_process(tmp_path: Path) -> None:
    """`python -m venv` starts another, which would go on to fill the folder that the next run removes."""
    script = """
runs() { kill -0 "$child" 2>/dev/null; }
trap 'stop_installer; read -r child <"$filling/child"; while runs; do sleep 0.02; done; exit 7' TERM
(until [ -s "$1/child" ]; do sleep 0.02; done; kill $$) &
quietly bash -c 'sleep 600 & echo $! >"$0/child"; wait' "$1"
"""
    assert run(script, tmp_path) == (7, "")


def test_an_activated_environment_does_not_make_the_next_one(tmp_path: Path) -> None:
    """It may be .venv, which is removed first."""
    (tmp_path / "python3").symlink_to(sys.executable)
    code, said = run(f'PATH="{tmp_path}:$PATH"; find_python >&2', tmp_path)
    assert (code, said) == (0, f"{Path(sys.executable).resolve()}\n")


# With a wrong argument, which nothing of it is done for either; what scripts/test gets is pytest's.
SCRIPTS: Final = {
    "scripts/benchmark": "--colour", "scripts/demo": "--colour", "scripts/install-service": "--colour",
    "scripts/lock": "x", "scripts/release": "--colour", "scripts/test": "",
    "scripts/try-ros2-control": "--colour",
    "-m scripts.completions": "--colour", "-m scripts.ros_packages": "--colour", "-m tests.public_names": "x",
}  # fmt: skip


def test_every_script_is_known() -> None:
    made = completed("git", "ls-files", "scripts", cwd=ROOT).stdout.split()
    programs = {
        path if "." not in path else f"-m {path[:-3].replace('/', '.')}"
        for path in made
        if path.count("/") == 1 and (
            (ROOT / path).read_bytes().startswith(b"#!")
            or ('if __name__ == "__main__"' in (ROOT / path).read_text() and "test_" not in path)
        )
    }  # fmt: skip
    assert programs | {"-m tests.public_names"} == set(SCRIPTS)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One without an environment."""
    folder = tmp_path_factory.mktemp("checkout")
    for path in completed("git", "ls-files", "-co", "--exclude-standard", cwd=ROOT).stdout.splitlines():
        if (ROOT / path).is_file():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, folder / path)
    return folder


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_and_wrong_arguments_do_nothing(name: str, checkout: Path) -> None:
    def state() -> list[tuple[Path, int]]:
        return sorted((path, path.stat().st_mtime_ns) for path in checkout.rglob("*"))

    before = state()
    command = [sys.executable, "-B", *name.split()] if name.startswith("-") else [checkout / name]
    environment = {**os.environ, "PYTHONPATH": f"{checkout}:{checkout}/protocol:{checkout}/ros2_bridge"}
    for arguments in (["--help"], ["-h"], *([word] for word in SCRIPTS[name].split())):
        done = completed(*command, *arguments, cwd=checkout, env=environment, timeout=20)
        is_help = arguments[0] in ("--help", "-h")
        assert done.returncode == (0 if is_help else 2), done.stderr
        assert ("usage: " in done.stdout) == is_help, done.stdout
        assert bool(done.stderr) != is_help
    assert state() == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--seconds abc", "--seconds: 'abc': it must be a number of seconds: see --help"),
        ("--no-ros --seconds=", "--seconds: '': it must be a number of seconds: see --help"),
        ("--seconds 2 --colour", "unknown argument '--colour': see --help"),
    ],
)
def test_the_demo_knows_its_arguments_before_it_installs(arguments: str, words: str) -> None:
    done = completed(ROOT / "scripts/demo", *arguments.split())
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"demo: {words}\n")


def test_without_a_network_it_is_one_sentence(tmp_path: Path) -> None:
    """Nothing listens at that port; pip tries once more, in place of five times."""
    pip = '"$venv/bin/python" -m pip install --retries 1 --index-url http://127.0.0.1:9 --target "$1" no-such'
    assert run(f'every=3600; quietly {pip} || fail "$why"', tmp_path) == (
        1,
        "demo: pip cannot reach the Python package index: connect this machine to the network, "
        "or set PIP_INDEX_URL\n",
    )


@pytest.mark.parametrize("retried", ["", "Retrying (Retry(total=3, connect=None)) after a failure"])
def test_what_failed_is_shown(retried: str, tmp_path: Path) -> None:
    """Also where the network was away and came back."""
    script = f'quietly bash -c \'echo "{retried}"; echo no gcc >&2; exit 3\' || fail "$why"'
    code, said = run(script, tmp_path)
    assert (code, said.splitlines()) == (
        1,
        [retried, "no gcc", "demo: pip could not install the packages: see above"],
    )


@pytest.mark.parametrize("function", ["make_environment", "make_owners_environment"])
def test_a_checkout_that_cannot_be_written_to_is_one_sentence(function: str, tmp_path: Path) -> None:
    """Not even by root, nor where another user made the lock."""
    code, said = run(f"SUDO_USER= lock=/proc/.venv.lock; {function} demo", tmp_path)
    sentence = f"demo: {ROOT} cannot be written to, where .venv is to be: make it yours, or copy it\n"
    assert (code, said) == (1, sentence)


@needs_another_user
@pytest.mark.parametrize("restricted", ["1", "0"])
def test_without_a_namespace_nothing_is_downloaded(restricted: str, tmp_path: Path) -> None:
    (tmp_path / "restricted").write_text(restricted)
    script = "restricted=$1/restricted; unshare() { return 1; }; quietly() { say downloads; }; "
    user, reads = NOBODY.pw_uid, "+dac_read_search"
    nobody = "setpriv", f"--reuid={user}", f"--inh-caps={reads}", f"--ambient-caps={reads}"
    code, said = run(script + "make_owners_environment ros", tmp_path, *nobody)
    assert code == 1
    assert said.startswith("demo: this kernel lets only root make namespaces: run it as root (sudo demo ")
    assert ("AppArmor" in said) == (restricted == "1")
    assert "downloads" not in said


def test_a_full_disk_is_told_before_anything_is_downloaded(tmp_path: Path) -> None:
    script = (
        "df() { printf '%s\\n' header 'disk 1000 500 120 80% /'; }; new_environment() { mkdir -p $venv; }\n"
    )
    code, said = run(script + f"venv={tmp_path}/.venv lock={tmp_path}/lock; make_environment ros", tmp_path)
    assert (code, said.splitlines()[-1]) == (
        1, f"demo: {tmp_path}/.venv needs up to 400 MB, and 120 MB are free there: "
        "free some, or clone to another disk",
    )  # fmt: skip


def test_the_demo_needs_no_tools_of_developers() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = re.findall(r"\bextra=(\w+)", (ROOT / "scripts/demo").read_text())
    with_ros, without = ({re.split(r"[\[=<>]", line)[0] for line in extras[extra]} for extra in asked)
    assert with_ros == {"ros-rclpy", "ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "numpy"}
    assert without == {"mcap", "rich", "textual", "zstandard"}
    assert {*extras["monitor"]} < {*extras["client"]}


@needs_bus
@pytest.mark.bus
def test_the_demo_without_ros_ends_with_what_the_monitor_knows_and_leaves_nothing(tmp_path: Path) -> None:
    """Where numpy and rclpy cannot be imported."""
    blocked = tmp_path / "blocked"
    for name in ("numpy", "rclpy"):
        (blocked / name).mkdir(parents=True)
        (blocked / name / "__init__.py").write_text("raise ImportError(__name__)")
    own = tmp_path / "own"
    own.mkdir()
    paths = os.pathsep.join(map(str, (blocked, *sys.path[1:])))
    command = ("unshare", "--net", sys.executable, "-m", "scripts.demonstration.monitor", "--seconds", "0.5")
    environment = {**os.environ, "PYTHONPATH": paths, "DEMO_DIRECTORY": str(own)}
    ended = completed(*command, cwd=ROOT, timeout=100, env=environment)
    assert "of 800 Hz" in ended.stdout, ended
    assert "BFT-SENS-ECAT-M8" in ended.stdout
    assert ended.returncode == ("\nTrouble: " in ended.stdout)
    assert not own.exists()


RUN: Final = """
import subprocess, time
from tests.ended_with_the_run import end_all_with_this_process
end_all_with_this_process()
for _ in range(2):
    print(subprocess.Popen(("sleep", "600"), start_new_session=True).pid, flush=True)
    end_all_with_this_process()  # as a worker of pytest does
time.sleep(600)
"""


def test_a_run_that_is_killed_leaves_nothing_behind() -> None:
    with subprocess.Popen((sys.executable, "-c", RUN), cwd=ROOT, stdout=subprocess.PIPE, text=True) as killed:
        assert killed.stdout is not None
        started = [Path("/proc", killed.stdout.readline().strip(), "cwd") for _ in range(2)]
        assert all(process.exists() for process in started)
        killed.kill()
    wait_until(lambda: not any(process.exists() for process in started), "all that it started to be gone")
