"""Who may change something: root, the server's own user, the one who ran sudo, and those named at start.

Names are looked up when they are given, never while the bus runs: a directory service may take its time.
"""

from __future__ import annotations

import grp
import os
import pwd
from collections.abc import Iterable

from ethercat_server.errors import UsageError


def controlling_uids(users: Iterable[str], groups: Iterable[str]) -> frozenset[int]:
    """The users who may control the server; UsageError names a user or group that does not exist."""
    found = {0, os.geteuid()}
    sudo_uid = os.environ.get("SUDO_UID", "")
    if sudo_uid.isdecimal():
        found.add(int(sudo_uid))
    for name in users:
        found.add(_uid(name, f"--control-user {name}"))
    for name in groups:
        found |= _members(name)
    return frozenset(found)


def _uid(name: str, asked: str) -> int:
    try:
        return int(name) if name.isdecimal() else pwd.getpwnam(name).pw_uid
    except KeyError:
        raise UsageError(f"{asked}: there is no such user on this machine") from None


def _members(name: str) -> set[int]:
    try:
        group = grp.getgrgid(int(name)) if name.isdecimal() else grp.getgrnam(name)
    except KeyError:
        raise UsageError(f"--control-group {name}: there is no such group on this machine") from None
    found = {user.pw_uid for user in pwd.getpwall() if user.pw_gid == group.gr_gid}
    for member in group.gr_mem:
        try:
            found.add(pwd.getpwnam(member).pw_uid)
        except KeyError:
            continue  # listed, but gone
    return found
