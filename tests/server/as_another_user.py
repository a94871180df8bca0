"""Becomes the user `nobody`: helper processes of the tests are started with `python -m` and then call this.

What a process needs of the library must be loaded before: the interpreter may be one that only root can read.
"""

from __future__ import annotations

import os
import pwd
from pathlib import Path

NOBODY = pwd.getpwnam("nobody")


def why_no_other_user() -> str | None:
    """Why this process cannot become another user; None if it can."""
    if os.geteuid() != 0:
        return "it takes a second user id: run scripts/test as root"
    for line in Path("/proc/self/uid_map").read_text(encoding="ascii").splitlines():
        first, _, count = map(int, line.split())
        if first <= NOBODY.pw_uid < first + count:
            return None
    return "it takes a second user id: run scripts/test as root, or install uidmap and fill in /etc/subuid"


NO_OTHER_USER = why_no_other_user()


def become_nobody() -> None:
    """For good. Does nothing where this process is not root's and so is a stranger to nobody."""
    "x".encode("idna")  # what connecting by name loads
    if NO_OTHER_USER is None:
        os.setgroups([])
        os.setgid(NOBODY.pw_gid)
        os.setuid(NOBODY.pw_uid)
