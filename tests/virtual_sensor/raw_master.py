"""A small EtherCAT master over a `Bus` in memory: no sockets, its own clock."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from ethercat_server.ethercat import wire
from ethercat_server.ethercat.slave.registers import FMMU_LAYOUT
from ethercat_server.ethercat.slave.registers import pack_sync_manager as sync_manager
from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.bus import SlaveChain
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import SensorOptions, SlaveOptions

MAILBOX = 128
INIT, PREOP, BOOT, SAFEOP, OP = 1, 2, 3, 4, 8
ACK = 0x10


def fmmu(logical: int, length: int, physical: int, kind: int) -> bytes:
    return FMMU_LAYOUT.pack(logical, length, 0, 7, physical, 0, kind, 1)


class Abort(Exception):  # noqa: N818
    def __init__(self, code: int) -> None:
        super().__init__(hex(code))
        self.code = code


class RawMaster:
    """Time passes only by `wait`; each exchange takes one microsecond."""

    def __init__(self, *slaves: SlaveOptions, start: int = 5_000_000_123) -> None:
        self.now = start
        self.bus = SlaveChain(slaves or (SensorOptions(),), start)
        self.count = len(slaves) or 1
        self.mailbox_counter = 0
        self.pdo_size = self.bus.sensors[0].options.pdo_size if self.bus.sensors else 0

    def wait(self, ns: int) -> None:
        self.now += ns
        self.bus.idle(self.now)

    def frame(self, *datagrams: tuple[int, int, int, bytes]) -> list[tuple[bytes, int]] | None:
        """Data and working counter of each datagram; None if the frame did not come back."""
        frame = wire.build(*datagrams)
        size = len(frame)
        self.now += 1000
        if not self.bus.process(frame, size, self.now):
            return None
        assert len(frame) == size
        assert frame[6] & 2
        return [
            (bytes(frame[d.data : d.end]), int.from_bytes(frame[d.end : d.end + 2], "little"))
            for d in wire.parse(frame, size)
        ]

    def one(self, command: int, adp: int, ado: int, data: bytes) -> tuple[bytes, int]:
        answer = self.frame((command, adp, ado, data))
        assert answer is not None
        return answer[0]

    def read(self, register: int, length: int, position: int = 0) -> bytes:
        data, counter = self.one(Command.APRD, -position, register, bytes(length))
        assert counter == 1
        return data

    def read16(self, register: int, position: int = 0) -> int:
        return int.from_bytes(self.read(register, 2, position), "little")

    def write(self, register: int, data: bytes, position: int = 0) -> int:
        return self.one(Command.APWR, -position, register, data)[1]

    def request(self, state: int, position: int = 0) -> tuple[int, int]:
        """Ask for a state; returns AL status and AL status code."""
        assert self.write(0x0120, struct.pack("<H", state), position) == 1
        return self.read16(0x0130, position), self.read16(0x0134, position)

    def set_up_mailbox(self, position: int = 0) -> None:
        managers = sync_manager(0x1000, MAILBOX, 0x26) + sync_manager(0x1080, MAILBOX, 0x22)
        assert self.write(0x0800, managers, position) == 1

    def set_up_process_data(self, position: int = 0, logical: int = 0) -> None:
        managers = sync_manager(0x1100, 1, 0x64) + sync_manager(0x1180, self.pdo_size, 0x20)
        assert self.write(0x0810, managers, position) == 1
        units = fmmu(logical, 1, 0x1100, 2) + fmmu(logical + 1, self.pdo_size, 0x1180, 1)
        assert self.write(0x0600, units, position) == 1

    def go(self, state: int) -> RawMaster:
        """Take every slave to `state`, the ordinary way."""
        for position in range(self.count):
            self.set_up_mailbox(position)
            steps = [s for s in (PREOP, SAFEOP, OP) if s <= state]
            for step in steps:
                if step == SAFEOP:
                    self.set_up_process_data(position, position * (self.pdo_size + 1))
                assert self.request(step, position) == (step, 0)
        return self

    def cycle(self, output: int = 0) -> tuple[bytes, int]:
        """One LRW over all slaves: all data, working counter."""
        return self.one(Command.LRW, 0, 0, (bytes([output]) + bytes(self.pdo_size)) * self.count)

    def inputs(self, position: int = 0) -> bytes:
        data, _ = self.cycle()
        start = position * (self.pdo_size + 1) + 1
        return data[start : start + self.pdo_size]

    def send_mailbox(self, kind: int, body: bytes, counter: int | None = None, position: int = 0) -> int:
        if counter is None:
            self.mailbox_counter = self.mailbox_counter % 7 + 1
            counter = self.mailbox_counter
        message = struct.pack("<HHBB", len(body), 0, 0, kind | counter << 4) + body
        return self.write(0x1000, message.ljust(MAILBOX, b"\0"), position)

    def mailbox_full(self, position: int = 0) -> bool:
        return bool(self.read(0x080D, 1, position)[0] & 8)

    def fetch_mailbox(self, position: int = 0) -> tuple[int, bytes] | None:
        """Type and body of the reply that waits; None if there is none."""
        data, counter = self.one(Command.APRD, -position, 0x1080, bytes(MAILBOX))
        if counter == 0:
            return None
        length, _, _, kind = struct.unpack_from("<HHBB", data)
        return kind & 0x0F, data[6 : 6 + length]

    def coe(self, request: bytes, position: int = 0) -> bytes:
        """A CoE request and its reply, without the CoE header."""
        assert self.send_mailbox(3, struct.pack("<H", 2 << 12) + request, position=position) == 1
        reply = self.fetch_mailbox(position)
        assert reply is not None
        kind, body = reply
        assert kind == 3
        if body[2] == 0x80:
            assert body[1] >> 4 == 2, "an abort is coded as an SDO request"
            raise Abort(struct.unpack_from("<I", body, 6)[0])
        assert body[1] >> 4 == 3
        return body[2:]

    def upload(self, index: int, subindex: int, position: int = 0) -> bytes:
        reply = self.coe(struct.pack("<BHBI", 0x40, index, subindex, 0), position=position)
        assert struct.unpack_from("<HB", reply, 1) == (index, subindex)
        if reply[0] & 2:
            return reply[4 : 8 - (reply[0] >> 2 & 3)]
        size = struct.unpack_from("<I", reply, 4)[0]
        assert len(reply) == 8 + size
        return reply[8:]

    def download(self, index: int, subindex: int, data: bytes, position: int = 0) -> None:
        if 0 < len(data) <= 4:
            command = 0x23 | (4 - len(data)) << 2
            request = struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0")
        else:
            request = struct.pack("<BHBI", 0x21, index, subindex, len(data)) + data
        reply = self.coe(request, position=position)
        assert reply[0] == 0x60

    def information(self, operation: int, body: bytes) -> list[bytes]:
        """Every fragment of the answer to an SDO Information request, from the operation byte on."""
        assert self.send_mailbox(3, struct.pack("<HBBH", 8 << 12, operation, 0, 0) + body) == 1
        found: list[bytes] = []
        while (reply := self.fetch_mailbox()) is not None:
            assert reply[0] == 3
            found.append(reply[1][2:])
        return found


def do(master: RawMaster, *lines: str) -> str:
    """Give fault commands, which are executed; what the last one answers."""
    for line in lines:
        answer = obey(master.bus, line)
        assert answer.split()[0] == "ok", answer
    return answer[3:]


def chain(count: int, **each: object) -> Sequence[SensorOptions]:
    return [SensorOptions(serial=n + 1, **each) for n in range(count)]  # type: ignore[arg-type]
