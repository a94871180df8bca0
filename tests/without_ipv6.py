"""Becomes a command whose processes get no IPv6 socket, as of a service with RestrictAddressFamilies=AF_INET,
where `localhost` has both its addresses all the same. For root.

usage: without_ipv6.py COMMAND ...
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import socket
import struct
import sys
import tempfile

NUMBER = {"x86_64": 41, "aarch64": 198}[platform.machine()]  # of the system call `socket`
SET_NO_NEW_PRIVS, SET_SECCOMP, FILTER = 38, 22, 2
LOAD, EQUALS, RETURN = 0x20, 0x15, 0x06
ALLOW, FAIL = 0x7FFF0000, 0x00050000
NEW_MOUNTS, RECURSIVE, PRIVATE, BIND = 0x20000, 0x4000, 1 << 18, 0x1000
PROGRAM = [  # of seccomp(2): operation, steps over if so and if not, operand
    (LOAD, 0, 0, 0),
    (EQUALS, 0, 3, NUMBER),
    (LOAD, 0, 0, 16),  # the call's first argument
    (EQUALS, 0, 1, socket.AF_INET6),
    (RETURN, 0, 0, FAIL | errno.EAFNOSUPPORT),
    (RETURN, 0, 0, ALLOW),
]

if __name__ == "__main__":
    libc = ctypes.CDLL(None, use_errno=True)
    with tempfile.NamedTemporaryFile() as hosts:
        hosts.write(b"127.0.0.1 localhost\n::1 localhost\n")
        hosts.flush()
        private = None, b"/", None, RECURSIVE | PRIVATE, None
        over = hosts.name.encode(), b"/etc/hosts", None, BIND, None
        if libc.unshare(NEW_MOUNTS) or libc.mount(*private) or libc.mount(*over):
            raise OSError(ctypes.get_errno(), "mount")
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *row) for row in PROGRAM))
    program = ctypes.create_string_buffer(struct.pack("@HP", len(PROGRAM), ctypes.addressof(code)))
    for call in ((SET_NO_NEW_PRIVS, 1, 0, 0, 0), (SET_SECCOMP, FILTER, program, 0, 0)):
        if libc.prctl(*call):
            raise OSError(ctypes.get_errno(), "prctl")
    os.execvp(sys.argv[1], sys.argv[1:])
