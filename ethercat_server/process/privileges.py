"""Gives up root, once everything that needs it is done: no byte from a client is read as root."""

from __future__ import annotations

import contextlib
import ctypes
import os
import pwd
from pathlib import Path
from typing import Final, NamedTuple

from ethercat_server.errors import ServerError, UsageError

_PR_SET_NO_NEW_PRIVS: Final = 38


class User(NamedTuple):
    """A user to become."""

    uid: int
    gid: int
    name: str  # empty for one that this machine does not know

    def __str__(self) -> str:
        return self.name or f"uid {self.uid}"


def user_to_become(name: str | None) -> User | None:
    """The user of this name or number; without one, who ran sudo. None to remain as it is.

    UsageError if there is no such user, or this process is neither that user nor root.
    """
    if name is None:
        return _who_ran_sudo() if os.geteuid() == 0 else None
    try:
        found = pwd.getpwuid(int(name)) if name.isdecimal() else pwd.getpwnam(name)
    except (KeyError, OverflowError, ValueError):
        raise UsageError(f"--user {name}: there is no such user on this machine") from None
    if found.pw_uid == os.geteuid():
        return None
    if os.geteuid() != 0:
        raise UsageError(f"--user {name}: only root can become another user; use sudo, or leave it out")
    return User(found.pw_uid, found.pw_gid, found.pw_name)


def _who_ran_sudo() -> User | None:
    uid, gid = (os.environ.get(name, "") for name in ("SUDO_UID", "SUDO_GID"))
    if not uid.isdecimal() or not gid.isdecimal() or int(uid) == 0:
        return None
    try:
        name = pwd.getpwuid(int(uid)).pw_name
    except (KeyError, OverflowError):
        name = ""
    return User(int(uid), int(gid), name)


def forbid_new_privileges() -> None:
    """This thread, and those and the processes that it starts from now on, gain none by executing a file."""
    ctypes.CDLL(None).prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)


def become(user: User) -> None:
    """Become `user`, with its groups and no capability, in all threads; ServerError if that is refused.

    Open files, locked memory and scheduling are kept.
    """
    try:
        if user.name:
            os.initgroups(user.name, user.gid)
        else:
            os.setgroups([])
        os.setresgid(user.gid, user.gid, user.gid)
        os.setresuid(user.uid, user.uid, user.uid)
        with contextlib.suppress(KeyError):  # where its files are
            os.environ["HOME"] = pwd.getpwuid(user.uid).pw_dir
    except (OSError, OverflowError) as error:
        why = error.strerror if isinstance(error, OSError) else "there is no such user"
        raise ServerError(f"cannot become user {user}: {why}; '--user root' stays root") from None
    forbid_new_privileges()
    if kept := _capabilities():
        raise ServerError(f"cannot give up the capabilities {kept:#x}: '--user root' keeps them all")


def _capabilities() -> int:
    """Those that this process has or could take."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    rows = dict(line.split(":", 1) for line in lines if line.startswith("Cap"))
    return int(rows["CapPrm"], 16) | int(rows["CapEff"], 16)
