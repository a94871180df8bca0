"""Privileges of this user, which a server started the same way would have."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import Any, Final

from ethercat_server.doctor.finding import Finding, note, ok
from ethercat_server.doctor.machine.machine import Machine

_NEEDED: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}
_WANTED: Final = {14: "CAP_IPC_LOCK", 23: "CAP_SYS_NICE"}
_ENOUGH_MEMORY: Final = 256 << 20
"""Upper bound for the bytes that the server locks."""
_LIMITS_FILE: Final = "/etc/security/limits.d/90-ethercat-server.conf"


def capabilities(machine: Machine) -> Iterator[Finding]:
    """The capabilities that the server's raw socket and its scheduling need."""
    missing = [name for bit, name in (_NEEDED | _WANTED).items() if not machine.has_capability(bit)]
    held = [name for name in (_NEEDED | _WANTED).values() if name not in missing]
    values: dict[str, Any] = {"missing": missing, "held": held}
    if not missing:
        yield ok(f"all four: {', '.join(held)}", **values)
        return
    needed = [name for name in _NEEDED.values() if name in missing]
    without = "could not open the interface" if needed else "would have a less steady cycle"
    yield note(
        f"missing: {', '.join(missing)}",
        f"a server started by this user {without}, and the doctor can check less; the service has all four",
        f"sudo ethercat-doctor {shlex.quote(machine.asked or machine.ifname)}", **values,
    )  # fmt: skip


def limits(machine: Machine) -> Iterator[Finding]:
    """Real-time priority and locked memory, where they do not come with a capability."""
    text = machine.text("/proc/self/limits")
    priority, memory = _limit(text, "Max realtime priority"), _limit(text, "Max locked memory")
    lacking = []
    if not machine.has_capability(23) and priority is not None and priority < machine.rt_priority:
        lacking.append(f"rtprio {priority}")
    if not machine.has_capability(14) and memory is not None and memory < _ENOUGH_MEMORY:
        lacking.append(f"memlock {memory // 1024} KiB")
    values: dict[str, Any] = {"rtprio": priority, "memlock_bytes": memory}
    if not lacking:
        yield ok("real-time priority and locked memory are allowed", **values)
        return
    yield note(
        " and ".join(lacking),
        "a server of this user has ordinary scheduling, or memory that may be paged out: log in again "
        "afterwards, or use the service or sudo",
        f'printf \'%s - rtprio 99\\n%s - memlock unlimited\\n\' "$USER" "$USER" | sudo tee {_LIMITS_FILE}',
        **values,
    )


def _limit(text: str, name: str) -> int | None:
    """The soft limit in /proc/self/limits; None if there is none."""
    found = re.search(rf"^{name}\s+(\d+)", text, re.MULTILINE)
    return int(found[1]) if found else None
