"""What the commands of EtherCAT datagrams do to a slave: addressing, copying, the working counter.

Source: ETG.1000.4. A successful read counts 1, a write 1, and in a read-write command a read 1 and a write 2.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from ethercat_server.ethercat.wire import BYTE_NS, Command, Datagram
from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.esc.controller import Esc

_U16 = struct.Struct("<H")
_LOGICAL = frozenset({Command.LRD, Command.LWR, Command.LRW})
_READS = frozenset({Command.APRD, Command.FPRD, Command.BRD})
_WRITES = frozenset({Command.APWR, Command.FPWR, Command.BWR})
_AUTO_INCREMENT = frozenset({Command.APRD, Command.APWR, Command.APRW, Command.ARMW})
_BROADCAST = frozenset({Command.BRD, Command.BWR, Command.BRW})
_ONE_BY_POSITION = frozenset({Command.APRD, Command.APWR, Command.APRW})
_ONE_BY_STATION = frozenset({Command.FPRD, Command.FPWR, Command.FPRW})
_READ_MULTIPLE_WRITE = frozenset({Command.ARMW, Command.FRMW})
_KNOWN = frozenset(Command) - {Command.NOP}
_PLANS_KEPT: Final = 64
_FPRD: Final = int(Command.FPRD)
_STATION_ADDRESS: Final = reg.STATION_ADDRESS
_EVENT_MASK: Final = reg.EVENT_MASK


def pass_through(escs: Sequence[Esc], frame: bytearray, datagram: Datagram) -> None:
    """Process one datagram in place as it passes these slaves, in their order.

    Those that it is not meant for only show their events, if they have a mask for them.
    """
    command, at = datagram.command, datagram.header + 2
    if command in _ONE_BY_STATION:
        low = frame[at]  # which suffices to pass nearly all others
        for esc in escs:
            memory = esc.memory
            if memory[_EVENT_MASK] or memory[_EVENT_MASK + 1]:
                execute(esc, frame, datagram)
            elif memory[_STATION_ADDRESS] == low and memory[_STATION_ADDRESS + 1] == frame[at + 1]:
                if command == _FPRD:
                    _read(esc, frame, datagram)
                else:
                    execute(esc, frame, datagram)
    elif command in _ONE_BY_POSITION:
        first = datagram.adp
        for number, esc in enumerate(escs, first):
            memory = esc.memory
            if not number & 0xFFFF or memory[reg.EVENT_MASK] or memory[reg.EVENT_MASK + 1]:
                _U16.pack_into(frame, at, number & 0xFFFF)
                execute(esc, frame, datagram)
        _U16.pack_into(frame, at, (first + len(escs)) & 0xFFFF)
    else:
        for esc in escs:
            execute(esc, frame, datagram)


def _read(esc: Esc, frame: bytearray, datagram: Datagram) -> None:
    """Process an FPRD for this slave, which shows no events: the same as `execute`, in less time."""
    start, end = datagram.data, datagram.end
    read = esc.read(datagram.ado, frame[start:end])
    if read is not None:
        frame[start:end] = read
        _U16.pack_into(frame, end, (_U16.unpack_from(frame, end)[0] + 1) & 0xFFFF)


def execute(esc: Esc, frame: bytearray, datagram: Datagram) -> None:
    """Process one datagram in place as it passes one slave."""
    command = datagram.command
    if command in _LOGICAL:
        counted = _logical(esc, frame, datagram)
    elif command in _KNOWN:
        counted = _physical(esc, frame, datagram)
    else:
        return
    mask = _U16.unpack_from(esc.memory, reg.EVENT_MASK)[0]
    if mask and (events := esc.events & mask):
        at = datagram.data - 2
        _U16.pack_into(frame, at, _U16.unpack_from(frame, at)[0] | events)
    if counted:
        at = datagram.end
        _U16.pack_into(frame, at, (_U16.unpack_from(frame, at)[0] + counted) & 0xFFFF)


def _physical(esc: Esc, frame: bytearray, datagram: Datagram) -> int:
    command, address = datagram.command, datagram.ado
    position_or_station = _U16.unpack_from(frame, datagram.header + 2)[0]
    if command in _AUTO_INCREMENT or command in _BROADCAST:
        # Every slave counts it up; the one it reaches as 0 is meant.
        _U16.pack_into(frame, datagram.header + 2, (position_or_station + 1) & 0xFFFF)
        meant = command in _BROADCAST or position_or_station == 0
    else:
        meant = position_or_station == _U16.unpack_from(esc.memory, reg.STATION_ADDRESS)[0]
    reads, writes = command not in _WRITES, command not in _READS
    if command in _READ_MULTIPLE_WRITE:
        reads, writes = meant, not meant
    elif not meant:
        return 0
    start, end = datagram.data, datagram.end
    incoming = bytes(frame[start:end])
    counted = 0
    if reads:
        read = esc.read(address, incoming)
        if read is not None:
            counted = 1
            if command in _BROADCAST:
                read = bytes(a | b for a, b in zip(read, incoming, strict=True))
            frame[start:end] = read
    if writes and esc.write(address, incoming):
        counted += 2 if reads else 1
    return counted


def _logical(esc: Esc, frame: bytearray, datagram: Datagram) -> int:
    address = datagram.ado << 16 | datagram.adp
    key = (address, datagram.length)
    if datagram.command == Command.LRW and not esc.has_lrw:
        return 0
    plan = esc.plans.get(key)
    if plan is None:
        plan = [
            (fmmu, *overlap)
            for fmmu in esc.fmmus
            if (overlap := fmmu.overlap(address, datagram.length)) is not None
        ]
        if len(esc.plans) >= _PLANS_KEPT:
            esc.plans.clear()
        esc.plans[key] = plan
    read = written = False
    base = datagram.data
    incoming = bytes(frame[base : datagram.end])
    reads, writes = datagram.command != Command.LWR, datagram.command != Command.LRD
    for fmmu, offset, length, at in plan:
        start, end = base + offset, base + offset + length
        esc.into_ns = (start - datagram.header) * BYTE_NS
        if writes and fmmu.writes:
            data = incoming[offset : offset + length]
            if fmmu.bitwise:
                data = fmmu.insert(data, bytes(esc.memory[at : at + fmmu.span(length)]))
            written |= esc.write(at, data)
        if reads and fmmu.reads:
            if fmmu.bitwise:
                current = esc.read(at, bytes(fmmu.span(length)))
                if current is not None:
                    frame[start:end] = fmmu.extract(current, bytes(frame[start:end]))
                    read = True
            else:
                current = esc.read(at, frame[start:end])
                if current is not None:
                    frame[start:end] = current
                    read = True
    esc.into_ns = 0
    return read + (2 * written if datagram.command == Command.LRW else written)
