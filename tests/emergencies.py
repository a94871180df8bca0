"""The virtual sensor's command `emergency CODE [REGISTER [HEX]]`, where it has none of its own."""

from __future__ import annotations

import struct
from typing import Any

from ethercat_server.virtual_sensor.faults import table
from ethercat_server.virtual_sensor.faults.command import Call, FaultCommand


def report(call: Call) -> None:
    """Put a CoE emergency before all that waits in the mailbox."""
    code, register, data = (*call.arguments, *("0", "")[len(call.arguments) - 1 :])
    body = struct.pack("<HHB5s", 1 << 12, int(code, 0), int(register, 0), bytes.fromhex(data))
    mailbox: Any = call.life.mailbox
    mailbox._replies.appendleft(struct.pack("<HHBB", len(body), 0, 0, 3) + body)
    mailbox.work()


def install() -> None:
    """Have the command."""
    table._BY_NAME.setdefault("emergency", FaultCommand("emergency", "emergency", (1, 2, 3), "", report))
