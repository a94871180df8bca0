"""Commands that start a program as another user with given capabilities, as the unit does."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

NOBODY: Final = 65534


def with_capabilities(capabilities: Iterable[str]) -> list[str]:
    """A command that becomes the one behind it: another user, no right beyond `capabilities`."""
    given = ",".join(["-all", *(f"+{name.removeprefix('CAP_').lower()}" for name in capabilities)])
    return [
        "prlimit", "--memlock=65536", "--rtprio=0",
        "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--no-new-privs",
        f"--inh-caps={given}", f"--ambient-caps={given}", f"--bounding-set={given}",
    ]  # fmt: skip
