"""The lock that keeps two masters of this project from opening one interface: a byte of a file for each.

The file is root's, or the service's, so that no other user can take it. The kernel knows which process has
it, and releases it with the process. The root of a user namespace may not write it, and takes an abstract
socket of its network namespace instead.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import stat
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from ethercat_server.errors import InterfaceError

DIRECTORY: Final = Path("/run/ethercat-server")  # RuntimeDirectory= of the service, which then owns it
_FILE: Final = "lock"
_NAME: Final = "\0ethercat-server/ifindex/{}"
_INDEX_BITS: Final = 31
_NAMESPACE: Final = 0xFFFFFFFF
_FLOCK: Final = struct.Struct("@hhqqi0q")  # type, whence, start, length, process


@contextlib.contextmanager
def locked(ifname: str, index: int) -> Iterator[None]:
    """Within it no other process has the lock of the interface `index`; InterfaceError if one has it.

    For one interface at a time: closing the file releases all locks that this process has on it.
    """
    try:
        file = _open(DIRECTORY)
    except OSError:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as name:
            try:
                name.bind(_NAME.format(index))
            except OSError:
                raise in_use(ifname) from None
            yield
        return
    try:
        place = (_network_namespace() & _NAMESPACE) << _INDEX_BITS | index
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
        except OSError:
            raise in_use(ifname, _owner(file, place)) from None
        yield
    finally:
        os.close(file)


def in_use(ifname: str, process: int = 0) -> InterfaceError:
    """The error to be raised; `process` has the interface, 0 if that is not known."""
    who = "another EtherCAT master"
    if process > 0:
        with contextlib.suppress(OSError):  # it has just ended
            name = Path(f"/proc/{process}/comm").read_text(encoding="utf-8", errors="replace").strip()
            who += f", process {process} ({name})"
    return InterfaceError(f"{ifname} is in use by {who}: stop that one first")


def _network_namespace() -> int:
    return Path("/proc/self/ns/net").stat().st_ino


def _open(directory: Path) -> int:
    """The open lock file in `directory`; OSError if it cannot be had, or others could replace it."""
    with contextlib.suppress(FileExistsError):
        directory.mkdir(mode=0o755)
    folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        owned = os.fstat(folder)
        if owned.st_mode & 0o022:
            raise PermissionError(f"{directory} is writable for others")
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
        file = os.open(_FILE, flags, 0o600, dir_fd=folder)
    finally:
        os.close(folder)
    try:
        made = os.fstat(file)
        if not stat.S_ISREG(made.st_mode) or made.st_nlink != 1:
            raise PermissionError(f"{directory / _FILE} is not a file of its own")
        if made.st_uid == os.geteuid() != owned.st_uid:
            os.fchown(file, owned.st_uid, owned.st_gid)  # root made it first: the service needs it too
    except OSError:
        os.close(file)
        raise
    return file


def _owner(file: int, place: int) -> int:
    """The process that has the lock; 0 if there is none any more, or none that is visible."""
    asked = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, place, 1, 0)
    try:
        kind, _, _, _, process = _FLOCK.unpack(fcntl.fcntl(file, fcntl.F_GETLK, asked))
    except OSError:
        return 0
    return 0 if kind == fcntl.F_UNLCK else int(process)
