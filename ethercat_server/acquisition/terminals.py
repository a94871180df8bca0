"""Terminals: slaves beside the sensors whose inputs are read because the configuration names them.

Each has a datagram of its own in the exchange, and so a working counter, and a frame for each exchange, which
is handed out after the samples. It goes to OP, and back there, while sensors stream. Without terminals
nothing in here runs.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.framing import MessageType, encode_data
from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.acquisition.recovery import restore_station
from ethercat_server.acquisition.stream import INVALID, REPEATED, OutgoingFrame
from ethercat_server.acquisition.terminal_choice import parsed
from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import Steps, repeat
from ethercat_server.ethercat.exchange import Exchange
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.controller import SlaveController
from ethercat_server.sensor.scan import Slave

_UNASSIGNED: Final = 0xFF  # sync manager of a PDO that is not assigned by default
# By the number of a data type in the SII (ETG.1020); others are unsigned.
_LETTERS: Final = {**dict.fromkeys((0x02, 0x03, 0x04, 0x10, *range(0x12, 0x16)), "i"), 0x08: "f", 0x11: "f"}
_BOOL: Final = 0x01
_ASSIGNMENTS: Final = 0x1C10  # object with the PDOs of the first sync manager; those of the others follow
_MOST_ENTRIES: Final = 256  # so that a reply with all of them is not too long
_LOOK_EVERY_S: Final = 0.1
_KIND: Final = int(MessageType.TERMINAL)

log = logging.getLogger(__name__)


class Terminal:
    """One terminal, by its SII, which has no units.

    Attributes:
        slave: as it was found.
        size: bytes of its process data.
        row: its part of the `describe` reply; kept up to date.
        steps: keep it in OP, without end.
    """

    def __init__(self, number: int, slave: Slave) -> None:
        """BusError if it has outputs, which nobody would write, or no inputs."""
        self._inputs: list[tuple[int, int, int, int]] = []  # sync manager, its start, bytes, control
        layout: list[dict[str, Any]] = []
        bits, content = 0, slave.sii or dict[str, Any](sync_managers=(), tx_pdos=(), rx_pdos=())
        outputs = [pdo for pdo in content["rx_pdos"] if pdo["sync_manager"] != _UNASSIGNED and pdo["entries"]]
        for manager, row in enumerate(content["sync_managers"][: reg.MOST_SYNC_MANAGERS]):
            outputs += [row] if row["kind"] == "outputs" and row["size"] else []
            begin = bits
            for pdo in content["tx_pdos"]:
                for entry in pdo["entries"] if pdo["sync_manager"] == manager else ():
                    if entry["index"]:  # else it is padding
                        layout.append(_described(pdo["name"], entry, bits, layout))
                    bits += entry["bits"]
            if size := (bits - begin + 7) // 8:
                self._inputs.append((manager, row["start"], size, row["control"]))
                bits = begin + 8 * size
        if outputs or not layout:
            why = "outputs, which nobody would write" if outputs else "no inputs by its SII"
            raise BusError(f"{slave} cannot be a terminal: it has {why}; do not name it")
        self.slave, self.size = slave, bits // 8
        self.row = {"terminal": number, **slave.as_json(), "pdo_size": self.size, "layout": layout}
        self._number, self._sequence = number, 0
        self._streams = self._was_valid = False
        self._newest, self._newest_ns = b"", 0  # valid process data, and when it was new

    def __str__(self) -> str:
        return f"terminal {self._number} ({self.slave.name} at position {self.slave.position})"

    def start(self, bus: Bus, number: int) -> None:
        """Begin to take it to OP; as a slave on the bus it has this number."""
        assert self.slave.sii is not None
        mailboxes = [self.slave.sii["mailboxes"][way] for way in ("out", "in")]
        self._bus, self._controller = bus, SlaveController(bus, number, mailboxes, name=str(self))
        self._controller.attempts = 1
        bus.terminals.append((self._controller, self.slave.status.state))
        self.steps = self._keep_in_op()

    def make_frame(
        self, exchange: Exchange, start: int, end: int, stamps: tuple[int, int]
    ) -> tuple[bytes, int, int] | None:
        """The frame for an exchange, its flags and when its data was new; None before it had valid data.

        `stamps` by CLOCK_REALTIME and CLOCK_MONOTONIC. REPEATED: the same data as before. INVALID: it did not
        take part, or is not in OP.
        """
        wkc, before, flags = int.from_bytes(exchange.frame[end : end + 2], "little"), self._newest, 0
        if wkc == 1 and self._streams:
            self._newest = exchange.frame[start:end]
            if self._was_valid and self._newest == before:
                flags = REPEATED
        elif before:
            flags = REPEATED | INVALID
        else:
            return None
        self._was_valid = not flags & INVALID
        head = self._sequence, *stamps, self._number, flags, wkc
        self._sequence += 1
        if not flags:
            self._newest_ns = exchange.back_ns
        return encode_data(*head, self._newest, _KIND), flags, self._newest_ns

    def _keep_in_op(self) -> Steps[None]:
        controller, said = self._controller, ""
        while True:
            try:
                yield from self._enter_op()
                log.info("%s is in OP", self)
                self._streams, self.row["state"], said = True, "OP", ""
                while (status := (yield from repeat(2, controller.status))) and status.is_op:
                    yield _LOOK_EVERY_S
                raise BusError(
                    f"{self} is lost: " + (f"it is in {status}" if status else "it does not answer")
                )
            except BusError as error:
                if str(error) != said:
                    log.warning("%s", error)
                self._streams, self.row["state"], said = False, "LOST", str(error)
            yield _LOOK_EVERY_S

    def _enter_op(self) -> Steps[None]:
        controller, kind = self._controller, (self.row["vendor"], self.row["product"])
        where = self._bus, controller.number, self.slave.position
        status = yield from controller.status()
        if status is None and (yield from restore_station(*where, lambda *found: found == kind)):
            status = yield from controller.status()
        if status is None:
            raise BusError(f"{self} does not answer: check cable and power")
        if not status.is_above_preop:
            yield from controller.enter_preop()
            for manager, _, size, _ in self._inputs if self.slave.has_coe else ():
                if (yield from controller.mapped_size(_ASSIGNMENTS + manager, size)) != size:
                    raise BusError(f"{self} maps other PDOs than its SII says: power it off and on")
            yield from controller.map_inputs(self._bus.terminal_areas[self._number].start, self._inputs)
            yield from controller.go(AlState.SAFEOP)
        yield from controller.go(AlState.OP)


def _described(pdo: str, entry: dict[str, Any], at: int, others: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The part of a layout that is an entry; its name is none of the others'."""
    bits = entry["bits"]
    name = f"{pdo} {entry['name']}".strip()
    if not name or any(other["name"] == name for other in others):
        name = f"{name} 0x{entry['index']:04X}:{entry['subindex']}".strip()
    kind = "bool" if entry["type"] == _BOOL else f"{_LETTERS.get(entry['type'], 'u')}{bits}"
    return {"name": name, "type": kind, "bit_offset": at, "bit_length": bits}


def find_terminals(slaves: Sequence[Slave], choices: Sequence[str]) -> list[Terminal]:
    """The chosen ones of the slaves beside the sensors; BusError if one is absent, or cannot be one."""
    for choice in choices:
        if not any(_matches(slave, choice) for slave in slaves):
            there = ", ".join(map(str, slaves)) or "sensors only"
            raise BusError(f"no terminal {choice} is on the bus ({there}): connect it, or do not name it")
    chosen = [slave for slave in slaves if any(_matches(slave, choice) for choice in choices)]
    found = [Terminal(number, slave) for number, slave in enumerate(chosen)]
    if sum(len(terminal.row["layout"]) for terminal in found) > _MOST_ENTRIES:
        raise BusError(f"the terminals have more than {_MOST_ENTRIES} PDO entries together: name fewer")
    return found


def _matches(slave: Slave, choice: str) -> bool:
    (kind, position), row = parsed(choice), slave.as_json()
    return kind in (None, (row["vendor"], row["product"])) and position in ("", str(slave.position))


class CycleWithTerminals(Cycle):
    """The loop where terminals are read, too, whose frames are numbered after those of the sensors."""

    terminals: Sequence[Terminal] = ()
    _newest_ns = 0  # when the newest exchange that was taken was sent

    def _hand_out(self, exchange: Exchange, since_ns: int) -> None:
        super()._hand_out(exchange, since_ns)
        if exchange.sent_ns < self._newest_ns:  # overtaken
            return
        self._newest_ns = exchange.sent_ns
        back_ns, made = self._stamps.monotonic_ns(exchange.back_ns), list[OutgoingFrame]()
        stamps = back_ns + self._stamps.realtime_ns, back_ns
        for number, start, end in self._bus.process_data.terminals[exchange.which]:
            if frame := self.terminals[number].make_frame(exchange, start, end, stamps):
                made.append((frame[0], len(self._streams) + number, *frame[1:]))
        if made:
            self._hub.publish(made, exchange.back_ns)
