"""The virtual sensor as a process, with commands for what pysoem has to get along with.

`ignore STATE` makes it stay below this AL state, of which it says `ignored`; `report INDEX SUBINDEX BEFORE
AFTER` puts so many emergencies before and after the next answer about this object. What is no matter of
pysoem is in memory: see `tests.tool.odd_firmware`.
"""

from __future__ import annotations

import struct
import sys

from ethercat_server.virtual_sensor import cli
from ethercat_server.virtual_sensor.faults import table
from ethercat_server.virtual_sensor.faults.command import Call, FaultCommand
from ethercat_server.virtual_sensor.slave.al import AlStateMachine

request = AlStateMachine.request


def ignore(call: Call) -> None:
    state = int(call.arguments[0])

    def request_or_ignore(self: AlStateMachine, control: int) -> None:
        if control & 0x0F == state:
            print("ignored", flush=True)
        else:
            request(self, control)

    AlStateMachine.request = request_or_ignore  # type: ignore[method-assign]


def report(call: Call) -> None:
    index, subindex, before, after = (int(text, 0) for text in call.arguments)
    mailbox, emergency = call.life.mailbox, struct.pack("<HHB5s", 1 << 12, 0x4210, 1, b"12345")
    answer = mailbox._coe

    def report_and_answer(request: bytes, room: int) -> list[bytes]:
        nonlocal before, after
        if struct.unpack_from("<HB", request, 3) != (index, subindex):
            return answer(request, room)
        reported = [emergency] * before + answer(request, room) + [emergency] * after
        before = after = 0
        return reported

    mailbox._coe = report_and_answer


for name, run in (("ignore", ignore), ("report", report)):
    table._BY_NAME[name] = FaultCommand(name, name, (1, 4), "", run)

if __name__ == "__main__":
    sys.exit(cli.main())
