"""Shows other users the server, where they may read neither the checkout nor the Python that runs it."""

from __future__ import annotations

import atexit
import functools
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import pytest

from tests.server.as_another_user import NO_OTHER_USER

_PACKAGES: Final = ("ethercat_server", "bota_ethercat", "pyroute2", "pysoem")
"""The server and all that it needs."""

PYTHON: Final = Path(sys.executable).resolve()
"""The one that the virtual environment was made with: the environment is a part of the checkout."""

_SHOW: Final = """
set -e
stage=$1 hidden=$2 shown=$3
shift 3
mount --bind "$shown" "$stage"
mount -t tmpfs -o mode=755 tmpfs "$hidden"
mkdir -p "$shown"
mount --bind "$stage" "$shown"
cd /
exec "$@"
"""
"""Shows a directory that lies in one which only root may enter, such as /root, to everybody: in a mount
namespace of its own, at its own path."""


def temporary() -> Path:
    """An empty directory that everybody may enter: pytest's, and perhaps TMPDIR, are its owner's only."""
    made = Path(tempfile.mkdtemp(prefix="ethercat-readable-", dir="/tmp"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    made.chmod(0o755)
    return made


@functools.cache
def copy() -> Path:
    """A directory with the server and what it needs, readable for everybody, as an installed one is."""
    made = temporary()
    for name in _PACKAGES:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        subprocess.run(["cp", "-a", Path(spec.origin).parent, made], check=True)
    subprocess.run(["chmod", "-R", "u=rwX,go=rX", made], check=True)
    return made


def python_prefix() -> Path:
    """The directory that Python and its library are in."""
    return Path(sys.base_prefix).resolve()


def _closed(path: Path) -> Path | None:
    """The outermost directory on the way to `path` that not everybody may enter."""
    for parent in reversed([path, *path.parents]):
        if not parent.stat().st_mode & 0o001:
            return parent
    return None


@functools.cache
def under() -> tuple[str, ...]:
    """A command that becomes the one behind it, which finds the copy and may read Python as any user.

    What it starts is to be run with `PYTHON`.
    """
    found = ("env", f"--chdir={copy()}", f"PYTHONPATH={copy()}", "PYTHONDONTWRITEBYTECODE=1")
    shown = python_prefix()
    hidden = _closed(shown)
    if hidden is None:
        return found
    return ("unshare", "--mount", "sh", "-c", _SHOW, "sh", str(temporary()), str(hidden), str(shown), *found)


def need(*command: str) -> None:
    """Skip where `under` and `command`, such as `setpriv ...`, can start nothing at all."""
    tried = subprocess.run([*under(), *command, "true"], check=False, capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(NO_OTHER_USER or f"no other user can be started (run it as root): {tried.stderr.strip()}")
