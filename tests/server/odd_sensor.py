"""A virtual sensor that is wrong in one way: `odd_sensor.py WAY IFACE ...`, for tests of what is refused.

The tables are changed before the virtual sensor is imported, so that it works them out as its own.
"""

from __future__ import annotations

import dataclasses
import struct
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from ethercat_server.sensor import dictionary
from protocol import pdo, settings

if TYPE_CHECKING:
    from ethercat_server.virtual_sensor.firmware.al import AlState


def change_default(address: tuple[int, int], value: int) -> None:
    rows = [
        dataclasses.replace(row, default=value) if row.address == address else row
        for row in dictionary.OBJECTS
    ]
    dictionary.OBJECTS = tuple(rows)  # type: ignore[misc]
    dictionary.BY_ADDRESS.update({row.address: row for row in rows})  # type: ignore[attr-defined]


def odd_size() -> None:
    """65 bytes of process data: a quarter of a quaternion."""
    layout = pdo.PdoLayout(pdo.PDO_FIELDS[:19])
    # The measurement gives the 18 values of 61 bytes; the rest stays empty.
    layout.struct = struct.Struct("<" + "".join(f.type.value for f in layout.fields[:18]) + "4x")
    pdo.LAYOUTS[layout.size] = layout


def wrong_rate() -> None:
    """A sampling rate that the SINC length does not imply."""
    settings.sampling_rate_hz = lambda sinc_length: 500


def other_vendor() -> None:
    dictionary.VENDOR_ID = 0xDEAD  # type: ignore[misc]
    change_default((0x1018, 1), 0xDEAD)


def other_product() -> None:
    dictionary.PRODUCT_CODE = 7  # type: ignore[misc]
    change_default((0x1018, 2), 7)


def fewer_objects() -> None:
    """No coordinate system and no inertia compensation."""
    missing = {"coordinate_system", "inertia_compensation"}
    dictionary.OBJECTS = tuple(row for row in dictionary.OBJECTS if row.setting not in missing)  # type: ignore[misc]
    for name in missing:
        row = dictionary.BY_SETTING.pop(name)  # type: ignore[attr-defined]
        dictionary.BY_ADDRESS.pop(row.address)  # type: ignore[attr-defined]


def refusing() -> None:
    """Refuses the SINC length 128, which is written last, and one offset."""
    from ethercat_server.ethercat.slave.abort_codes import AbortCode
    from ethercat_server.virtual_sensor.firmware import dictionary

    check = dictionary.Dictionary.check_write
    write = dictionary.Dictionary.write
    refused = {(0x8006, 1): b"\x80\0", (0x8000, 5): struct.pack("<f", 0.5)}

    def refuse(self: dictionary.Dictionary, index: int, subindex: int, data: bytes, state: AlState) -> None:
        check(self, self.entry(index, subindex), len(data), state)
        if refused.get((index, subindex)) == data:
            raise dictionary.SdoAbortError(AbortCode.INVALID_VALUE)
        write(self, index, subindex, data, state)

    dictionary.Dictionary.write = refuse  # type: ignore[method-assign]


FOREIGN_LACKS = frozenset({0x1009, 0x1018, 0x2000, 0x7000, 0x8000, 0x8001, 0x8006, 0x8010, 0x8030})


def foreign() -> None:
    """No sensor of Bota's, which has only some of the objects."""
    from ethercat_server.ethercat.slave.abort_codes import AbortCode
    from ethercat_server.virtual_sensor.firmware import dictionary

    other_vendor()
    read = dictionary.Dictionary.read

    def read_some(self: dictionary.Dictionary, index: int, subindex: int) -> bytes:
        if index in FOREIGN_LACKS:
            raise dictionary.SdoAbortError(AbortCode.NO_OBJECT)
        return read(self, index, subindex)

    dictionary.Dictionary.read = read_some  # type: ignore[method-assign]


def change_eeprom(change: Callable[[bytes], bytes]) -> None:
    from ethercat_server.virtual_sensor.esc import sii
    from ethercat_server.virtual_sensor.firmware import firmware

    build = sii.build_image
    firmware.build_image = lambda *values: change(build(*values))  # type: ignore[attr-defined]


def latin() -> None:
    """A name in the EEPROM that is no UTF-8."""
    change_eeprom(lambda image: image.replace(b"BFT-", b"K\xfch-"))


def latin_foreign() -> None:
    """The same of another vendor's."""
    other_vendor()
    latin()


def no_mailbox() -> None:
    """No mailbox at all, as a simple slave."""
    from ethercat_server.virtual_sensor.firmware import firmware

    change_eeprom(lambda image: image[:0x30] + bytes(10) + image[0x3A:])
    firmware.Firmware._mailbox_fault = lambda self: 0  # type: ignore[method-assign]


def stays_below(state: int) -> Callable[[], None]:
    """Does not go to `state` when it is told to, and says so."""

    def change() -> None:
        from ethercat_server.virtual_sensor.firmware.al import AlStateMachine

        request = AlStateMachine.request

        def ignore(self: AlStateMachine, control: int) -> None:
            if control & 0x0F == state:
                print("ignored", flush=True)
            else:
                request(self, control)

        AlStateMachine.request = ignore  # type: ignore[method-assign]

    return change


WAYS = {
    "below PREOP": stays_below(2),
    "below SAFEOP": stays_below(4),
    "below OP": stays_below(8),
    "foreign": foreign,
    "latin": latin,
    "latin foreign": latin_foreign,
    "mailbox": no_mailbox,
    "size": odd_size,
    "rate": wrong_rate,
    "vendor": other_vendor,
    "product": other_product,
    "fewer": fewer_objects,
    "refusing": refusing,
}

if __name__ == "__main__":
    WAYS[sys.argv[1]]()
    from ethercat_server.virtual_sensor import cli

    sys.exit(cli.main(sys.argv[2:]))
