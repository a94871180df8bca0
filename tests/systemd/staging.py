"""Installs the service below a temporary directory, and reads the unit files."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
UNITS = ROOT / "systemd"
SERVER_UNIT = UNITS / "ethercat-server@.service"
BRIDGE_UNIT = UNITS / "ethercat-bridge.service"
CAPABILITIES = ("CAP_NET_RAW", "CAP_NET_ADMIN", "CAP_SYS_NICE", "CAP_IPC_LOCK")


def need_systemd() -> None:
    """Skip where systemd's tools are missing; fail where everything is meant to be checked."""
    missing = [name for name in ("systemd-analyze", "systemd-escape") if shutil.which(name) is None]
    if not missing:
        return
    reason = f"{' and '.join(missing)} missing: sudo apt install systemd (it need not be running)"
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def values(unit: Path, key: str) -> list[str]:
    """What follows `key=` in a unit file, one entry a line."""
    lines = unit.read_text().splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(key + "=")]


def install_service(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(ROOT / "scripts" / "install-service"), *arguments], check=False, capture_output=True, text=True
    )


class Stage:
    """A root directory to install into, with programs that do nothing in the place of the real ones."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.prefix = path / "opt" / "ethercat-server"
        for program in (
            self.prefix / "bin" / "ethercat-server",
            self.prefix / "bridge" / "bin" / "bridge-client",
        ):
            program.parent.mkdir(parents=True, exist_ok=True)
            program.write_text("#!/bin/sh\n")
            program.chmod(0o755)

    def run(self, *arguments: str) -> str:
        """What install-service says; it must succeed."""
        done = install_service("--root", str(self.path), *arguments)
        assert done.returncode == 0, done.stderr
        return done.stderr

    def install(self, *arguments: str) -> str:
        return self.run("--keep-environment", *arguments)

    def files(self) -> dict[str, str]:
        """Every installed file outside the virtual environment, with its content."""
        return {
            f"/{path.relative_to(self.path)}": path.read_text()
            for path in sorted(self.path.rglob("*"))
            if path.is_file() and self.prefix not in path.parents
        }


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    need_systemd()
    return Stage(tmp_path / "stage")
