"""Becomes the user `nobody`: helper processes of the tests are started with `python -m` and then call this.

What a process needs of the library must be loaded before: the interpreter may be one that only root can read.
"""

from __future__ import annotations

import os
import pwd

NOBODY = pwd.getpwnam("nobody")


def become_nobody() -> None:
    """For good. Does nothing where this process is not root's and so is a stranger to nobody."""
    "x".encode("idna")  # what connecting by name loads
    if os.geteuid() == 0:
        os.setgroups([])
        os.setgid(NOBODY.pw_gid)
        os.setuid(NOBODY.pw_uid)
