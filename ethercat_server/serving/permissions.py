"""Who may connect and who may control: root, the server's own user, the user who ran sudo, and those named.

Names are looked up when they are read, never in the loop: a directory service can take seconds.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Final

from ethercat_server.errors import UsageError
from ethercat_server.serving.connection import Connection

MAX_CLIENTS: Final = 64
# Clients among them that must be of users who may control, so that the others cannot use all of them up.
RESERVED_FOR_CONTROL: Final = 16
MAX_CLIENTS_PER_USER: Final = 16  # clients of one user who may not control
# Clients of those users that must be the first of theirs: the bridge's is such a user.
RESERVED_FOR_THE_FIRST: Final = 16


class Permissions:
    """What the server allows whom.

    Attributes:
        control_uids: users who may configure, tare, write objects and shut the server down.
        names: of this machine's users, by their numbers.
    """

    def __init__(
        self, users: Iterable[str] = (), groups: Iterable[str] = (), own_uid: int | None = None
    ) -> None:
        """Root, the user `own_uid` that the server becomes (None: is), who ran sudo, and the named ones.

        UsageError names an unknown user or group.
        """
        self.control_uids = _controlling_uids(users, groups)
        if own_uid is not None or hasattr(os, "geteuid"):  # not on Windows, where recordings are replayed
            self.control_uids |= {os.geteuid() if own_uid is None else own_uid}
        self.names: Mapping[int, str] = _local_names()

    def have_room(self, uid: int | None, clients: Collection[Connection]) -> bool:
        """Whether the user `uid` may connect once more beside these clients."""
        if uid in self.control_uids:
            return len(clients) < MAX_CLIENTS
        of_this_user = sum(client.uid == uid for client in clients)
        reserved = RESERVED_FOR_CONTROL + (RESERVED_FOR_THE_FIRST if of_this_user else 0)
        return of_this_user < MAX_CLIENTS_PER_USER and len(clients) < MAX_CLIENTS - reserved

    def dispensable(self, uid: int | None, clients: Collection[Connection]) -> Connection | None:
        """The connection to close so that the user `uid` may connect, where there is no room; None for none.

        One that does nothing, of those who have most and at least two more than this user.
        """
        counts = Counter(client.uid for client in clients if client.uid not in self.control_uids)
        for holder, count in counts.most_common():
            if count < counts[uid] + 2:
                break
            for client in clients:
                if client.uid == holder and client.is_idle:
                    return client
        return None

    def name(self, uid: int) -> str:
        """The user's name and number, for messages; looked up before the loop."""
        return f"{self.names[uid]} (uid {uid})" if uid in self.names else f"uid {uid}"

    def may_control(self, client: Connection) -> bool:
        """Whether the user at the other end may control; an unknown user may not."""
        return client.find_uid() in self.control_uids


def _controlling_uids(users: Iterable[str], groups: Iterable[str]) -> frozenset[int]:
    found = {0}
    sudo_uid = os.environ.get("SUDO_UID", "")
    if sudo_uid.isdecimal():
        found.add(int(sudo_uid))
    for name in users:
        found.add(_uid(name, f"--control-user {name}"))
    for name in groups:
        found |= _members(name)
    return frozenset(found)


def _local_names() -> dict[int, str]:
    """The names of this machine's own users: no directory service is asked."""
    try:
        rows = [line.split(":") for line in Path("/etc/passwd").read_text(errors="replace").splitlines()]
    except OSError:
        return {}
    return {int(row[2]): row[0] for row in rows if len(row) > 2 and row[2].isdecimal()}


def _uid(name: str, option: str) -> int:
    try:
        import pwd  # noqa: PLC0415 - Windows, where recordings are replayed, has none

        return int(name) if name.isdecimal() else pwd.getpwnam(name).pw_uid
    except (KeyError, ImportError):
        raise UsageError(f"{option}: there is no such user on this machine") from None


def _members(name: str) -> set[int]:
    try:
        import grp  # noqa: PLC0415
        import pwd  # noqa: PLC0415

        group = grp.getgrgid(int(name)) if name.isdecimal() else grp.getgrnam(name)
    except (KeyError, ImportError):
        raise UsageError(f"--control-group {name}: there is no such group on this machine") from None
    found = {user.pw_uid for user in pwd.getpwall() if user.pw_gid == group.gr_gid}
    for member in group.gr_mem:
        try:
            found.add(pwd.getpwnam(member).pw_uid)
        except KeyError:
            continue  # still listed, but deleted
    return found
