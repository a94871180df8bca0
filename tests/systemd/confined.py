"""Commands that start a program as another user with given capabilities, as the unit does."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from tests.systemd.staging import ROOT

NOBODY: Final = 65534

_SHOW: Final = """
set -e
stage=$1 hidden=$2 shown=$3
shift 3
mount -t tmpfs -o mode=755 tmpfs "$stage"
for path in $shown; do mkdir -p "$stage$path"; mount --bind "$path" "$stage$path"; done
for path in $hidden; do mount -t tmpfs -o mode=755 tmpfs "$path"; done
for path in $shown; do mkdir -p "$path"; mount --bind "$stage$path" "$path"; done
cd /
exec "$@"
"""
"""Shows directories that lie in one which only root may enter, such as /root, to everybody: in a mount
namespace of its own, at their own paths, so that nothing has to be copied or moved."""


def needed() -> Iterator[Path]:
    """The directories that Python and the checkout are in."""
    for path in {Path(sys.base_prefix), Path(sys.prefix), ROOT}:
        yield path.resolve()


def closed(path: Path) -> Path | None:
    """The outermost directory on the way to `path` that not everybody may enter."""
    for parent in reversed([path, *path.parents]):
        if not parent.stat().st_mode & 0o001:
            return parent
    return None


def readable_for_all(stage: Path) -> list[str]:
    """A command that becomes the one behind it, with Python and the checkout readable for everybody."""
    shown = [path for path in needed() if closed(path)]
    if not shown:
        return []
    hidden = {str(closed(path)) for path in shown}
    stage.mkdir()
    words = (str(stage), " ".join(sorted(hidden)), " ".join(map(str, sorted(shown))))
    return ["unshare", "--mount", "sh", "-c", _SHOW, "sh", *words]


def with_capabilities(capabilities: Iterable[str]) -> list[str]:
    """A command that becomes the one behind it: another user, no right beyond `capabilities`."""
    given = ",".join(["-all", *(f"+{name.removeprefix('CAP_').lower()}" for name in capabilities)])
    return [
        "prlimit", "--memlock=65536", "--rtprio=0", "env", f"PYTHONPATH={ROOT}", "PYTHONDONTWRITEBYTECODE=1",
        "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--no-new-privs",
        f"--inh-caps={given}", f"--ambient-caps={given}", f"--bounding-set={given}",
    ]  # fmt: skip
