"""The virtual sensor as a process, with commands for what pysoem has to get along with.

`ignore STATE` makes it stay below this AL state, of which it says `ignored`; `report INDEX SUBINDEX BEFORE
AFTER` puts so many emergencies before and after the next answer about this object. What is no matter of
pysoem is in memory: see `tests.tool.odd_firmware`.
"""

from __future__ import annotations

import functools
import struct
import sys

from ethercat_server.virtual_sensor import cli, faults
from ethercat_server.virtual_sensor.application import Application
from ethercat_server.virtual_sensor.fault import Fault
from ethercat_server.virtual_sensor.faults import Call

al_control = Application.al_control


def ignore(_call: Call, state: int) -> None:
    def request_or_ignore(self: Application, control: int) -> None:
        if control & 0x0F == state:
            print("ignored", flush=True)
        else:
            al_control(self, control)

    Application.al_control = request_or_ignore  # type: ignore[method-assign]


def report(call: Call, index: int, subindex: int, before: int, after: int) -> None:
    mailbox, emergency = call.application.mailbox, struct.pack("<HHB5s", 1 << 12, 0x4210, 1, b"12345")
    answer = mailbox._coe

    def report_and_answer(request: bytes, room: int) -> list[bytes]:
        nonlocal before, after
        if struct.unpack_from("<HB", request, 3) != (index, subindex):
            return answer(request, room)
        reported = [emergency] * before + answer(request, room) + [emergency] * after
        before = after = 0
        return reported

    mailbox._coe = report_and_answer


NUMBER = functools.partial(int, base=0)
faults.BY_NAME["ignore"] = Fault("ignore STATE", "", ignore, (NUMBER,))
faults.BY_NAME["report"] = Fault("report INDEX SUBINDEX BEFORE AFTER", "", report, (NUMBER,) * 4)

if __name__ == "__main__":
    sys.exit(cli.main())
