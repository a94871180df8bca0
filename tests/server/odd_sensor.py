"""The virtual sensor as a process, with two commands for what pysoem has to get along with.

`ignore STATE` makes it stay below this AL state, of which it says `ignored`; `eeprom latin|no-mailbox|ok`
changes its EEPROM. What is no matter of pysoem is in memory: see `tests.tool.odd_firmware`.
"""

from __future__ import annotations

import sys

from ethercat_server.virtual_sensor import cli
from ethercat_server.virtual_sensor.faults import table
from ethercat_server.virtual_sensor.faults.command import Call, FaultCommand
from ethercat_server.virtual_sensor.firmware.layout import sensor_device
from ethercat_server.virtual_sensor.slave.al import AlStateMachine
from ethercat_server.virtual_sensor.slave.image import build_image
from protocol.pdo import LAYOUTS

request = AlStateMachine.request


def ignore(call: Call) -> None:
    state = int(call.arguments[0])

    def request_or_ignore(self: AlStateMachine, control: int) -> None:
        if control & 0x0F == state:
            print("ignored", flush=True)
        else:
            request(self, control)

    AlStateMachine.request = request_or_ignore  # type: ignore[method-assign]


def eeprom(call: Call) -> None:
    options, way = call.sensor.options, call.arguments[0]
    image = build_image(sensor_device(options.model, options.serial, min(LAYOUTS)))
    if way == "latin":  # a name that is no UTF-8
        image = image.replace(b"BFT-", b"K\xfch-")
    elif way == "no-mailbox":  # as a simple slave
        image = image[:0x30] + bytes(10) + image[0x3A:]
    call.life.esc.sii.image = image
    call.life.al._mailbox_fault = (lambda: 0) if way == "no-mailbox" else call.life._mailbox_fault


for name, run in (("ignore", ignore), ("eeprom", eeprom)):
    table._BY_NAME[name] = FaultCommand(name, name, (1,), "", run)

if __name__ == "__main__":
    sys.exit(cli.main())
