"""CoE, CAN objects over EtherCAT: SDO transfers by single datagrams, abort codes, emergency messages.

Transfers are `Steps`. Emergencies are counted, the last one is kept, and they are logged and reported, at one
bounded rate.

Sources: ETG.1000.6 (abort codes: table "SDO Abort Codes"), CiA 301.
"""

from __future__ import annotations

import logging
import struct
from collections import defaultdict
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple, Protocol, Self

from ethercat_server.errors import BusError, SdoAbortError, SetUpError
from ethercat_server.ethercat.clock import Clock, Deadline
from ethercat_server.ethercat.datagrams import Registers, Steps, T

log = logging.getLogger(__name__)

_HEADER: Final = struct.Struct("<HHBB")
_TYPE_COE: Final = 3
_SDO_HEADER: Final = struct.Struct("<HBHB")
_COE_SDO_REQUEST: Final = 2
_COE_SDO_RESPONSE: Final = 3
_UPLOAD: Final = 0x40
_DOWNLOAD: Final = 0x20
_DOWNLOADED: Final = 0x60
_COMMAND_MASK: Final = 0xE0
_EXPEDITED: Final = 0x03
_SIZE_GIVEN: Final = 0x01
_ABORT: Final = 0x80
_LONGEST_EXPEDITED: Final = 4
_SIZE_BYTES: Final = 4  # the size goes before what is longer
_PROBED: Final = 0x1000, 0  # the device type, which every CoE slave has
_DROPPED_S: Final = 0.02  # without an answer at first, then twice as long, until the probe is sent again
_IN_STEP_S: Final = 0.1  # after an answer: another master may use the mailbox meanwhile
_ANSWER_S: Final = 0.7  # until the request is sent again
_TRANSFER_S: Final = 2.1  # in all: a short loss of frames is not an error


class Sdo(Protocol):
    """Access to one slave's object dictionary."""

    @property
    def clock(self) -> Clock:
        """The clock of the bus."""

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """Upload an object; SdoAbortError if the sensor refuses, BusError if it does not answer."""

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """Download an object; raises as `read`."""


class AbortCode(IntEnum):
    """Reason why a slave aborted an SDO transfer."""

    meaning: str

    def __new__(cls, code: int, meaning: str) -> Self:
        """A code with its meaning, which completes the sentence "the sensor refused: ..."."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.meaning = meaning
        return member

    TOGGLE_NOT_CHANGED = 0x05030000, "the toggle bit did not alternate"
    TIMEOUT = 0x05040000, "the SDO protocol timed out"
    UNKNOWN_COMMAND = 0x05040001, "the command specifier is invalid or unknown"
    OUT_OF_MEMORY = 0x05040005, "out of memory"
    UNSUPPORTED_ACCESS = 0x06010000, "unsupported access to an object"
    WRITE_ONLY = 0x06010001, "the object is write-only"
    READ_ONLY = 0x06010002, "the object is read-only"
    SUBINDEX_0_NOT_ZERO = 0x06010003, "sub-index 0 must be set to 0 before the sub-indices are written"
    NO_COMPLETE_ACCESS = 0x06010004, "complete access is not supported for entries of variable length"
    LONGER_THAN_MAILBOX = 0x06010005, "the object is longer than the mailbox"
    MAPPED_TO_RXPDO = 0x06010006, "the object is mapped to an RxPDO, so it cannot be written"
    NO_OBJECT = 0x06020000, "the object does not exist"
    NOT_MAPPABLE = 0x06040041, "the object cannot be mapped to a PDO"
    MAPPING_TOO_LONG = 0x06040042, "the mapped objects exceed the length of the PDO"
    PARAMETERS_INCOMPATIBLE = 0x06040043, "the parameters are incompatible"
    DEVICE_INCOMPATIBLE = 0x06040047, "the device is incompatible"
    HARDWARE_ERROR = 0x06060000, "access failed because of a hardware error"
    LENGTH_MISMATCH = 0x06070010, "the data type or length does not match"
    TOO_LONG = 0x06070012, "the data is too long"
    TOO_SHORT = 0x06070013, "the data is too short"
    NO_SUBINDEX = 0x06090011, "the sub-index does not exist"
    INVALID_VALUE = 0x06090030, "the value is out of range"
    TOO_HIGH = 0x06090031, "the value is too high"
    TOO_LOW = 0x06090032, "the value is too low"
    MAXIMUM_BELOW_MINIMUM = 0x06090036, "the maximum is less than the minimum"
    GENERAL = 0x08000000, "general error"
    CANNOT_STORE = 0x08000020, "the data cannot be transferred or stored"
    LOCAL_CONTROL = 0x08000021, "the data cannot be transferred or stored because of local control"
    NOT_IN_THIS_STATE = 0x08000022, "the data cannot be transferred or stored in the present state"
    NO_DICTIONARY = 0x08000023, "there is no object dictionary"


def abort_meaning(code: int) -> str:
    """The meaning of an abort code."""
    known = next((row for row in AbortCode if row == code), None)
    return known.meaning if known else "a reason that the standard does not define"


_EMERGENCY: Final = struct.Struct("<HHB")  # CoE header, error code, error register; manufacturer data follow
_COE_EMERGENCY: Final = 1
_DATA_SIZE: Final = 5
_CLASS_MASK: Final = 0xFF00
_TELL_AGAIN_NS: Final = 10_000_000_000  # for the same code, if no other one came in between
_TELL_EVERY_NS: Final = 1_000_000_000
_TELL_AT_ONCE: Final = 5  # of one sensor, and then one each `_TELL_EVERY_NS`

# By error code without its lower byte; what is not here belongs to the class of its first digit.
ERROR_CLASSES: Final[dict[int, str]] = {
    0x0000: "error reset, or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x3000: "voltage",
    0x4000: "temperature",
    0x5000: "hardware of the device",
    0x6000: "software of the device",
    0x7000: "additional modules",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8200: "protocol error",
    0x9000: "external error",
    0xA000: "change of the AL state failed",
    0xF000: "additional functions",
    0xFF00: "device-specific",
}


class Emergency(NamedTuple):
    """One emergency message."""

    code: int
    register: int  # the error register, object 0x1001
    data: bytes  # at most five bytes of the manufacturer's

    @classmethod
    def parse(cls, body: bytes) -> Self | None:
        """From a CoE message, without the mailbox header; None if it is not an emergency."""
        if len(body) < _EMERGENCY.size:
            return None
        header, code, register = _EMERGENCY.unpack_from(body)
        if header >> 12 != _COE_EMERGENCY:
            return None
        return cls(code, register, body[_EMERGENCY.size : _EMERGENCY.size + _DATA_SIZE])

    @property
    def is_reset(self) -> bool:
        """Whether it says that an error is over."""
        return not self.code & _CLASS_MASK

    @property
    def text(self) -> str:
        """The class of its error code in words."""
        known = ERROR_CLASSES.get(self.code & _CLASS_MASK) or ERROR_CLASSES.get(self.code & 0xF000)
        return known or "of no class that CiA 301 defines"

    def __str__(self) -> str:
        data = self.data.hex() or "none"
        return f"emergency 0x{self.code:04X} ({self.text}), error register 0x{self.register:02X}, data {data}"

    def as_json(self) -> dict[str, Any]:
        """The keys by which clients get it."""
        return {"code": self.code, "text": self.text, "register": self.register, "data": self.data.hex()}


class _OfSensor:
    """The emergencies of one sensor."""

    def __init__(self) -> None:
        self.count = 0
        self.last: Emergency | None = None
        self.at_ns = 0
        self.told = (-1, 0)  # the last code that was reported, and when
        self.told_until_ns = 0  # a leaky bucket: one report each `_TELL_EVERY_NS`


class Emergencies:
    """The emergencies of all sensors."""

    def __init__(self, clock: Clock) -> None:
        self._raw_ns = clock.raw_ns
        self._sensors: defaultdict[int, _OfSensor] = defaultdict(_OfSensor)
        # Called at a bounded rate: number of the sensor, emergency, how many the sensor has sent.
        self.tell: Callable[[int, Emergency, int], None] = lambda _number, _emergency, _count: None

    def note(self, number: int, emergency: Emergency) -> None:
        """Record an emergency of the sensor `number`."""
        sensor, now_ns = self._sensors[number], self._raw_ns()
        sensor.count += 1
        sensor.last, sensor.at_ns = emergency, now_ns
        if self._is_to_be_told(sensor, emergency.code, now_ns):
            level = logging.INFO if emergency.is_reset else logging.WARNING
            log.log(level, "sensor %d reports %s", number, emergency)
            self.tell(number, emergency, sensor.count)

    def _is_to_be_told(self, sensor: _OfSensor, code: int, now_ns: int) -> bool:
        told_code, told_ns = sensor.told
        if code == told_code and now_ns - told_ns < _TELL_AGAIN_NS:
            return False
        if sensor.told_until_ns - now_ns > (_TELL_AT_ONCE - 1) * _TELL_EVERY_NS:
            return False
        sensor.told_until_ns = max(sensor.told_until_ns, now_ns) + _TELL_EVERY_NS
        sensor.told = (code, now_ns)
        return True

    def status(self, number: int) -> dict[str, Any]:
        """The sensor's part of the `status` reply."""
        sensor = self._sensors[number]
        last: dict[str, Any] | None = None
        if sensor.last is not None:
            ago_s = round((self._raw_ns() - sensor.at_ns) * 1e-9, 3)
            last = {**sensor.last.as_json(), "ago_s": ago_s}
        return {"emergencies": sensor.count, "emergency": last}


class MailboxSdo:
    """The mailboxes of slave `number`.

    There is one object for each slave, because the slave drops a message that reuses the last counter.
    Emergencies that arrive among the answers are recorded.
    """

    def __init__(
        self,
        bus: Registers,
        number: int,
        areas: Sequence[tuple[int, int]],
        emergencies: Emergencies | None = None,
        name: str = "",
    ) -> None:
        """`areas`: offset and size of the mailbox to the slave, and of the one from it."""
        self._bus, self._number, self._emergencies = bus, number, emergencies
        self._name = name or f"sensor {number}"
        self.clock = bus.clock
        (self._out, self._out_size), (self._in, self._in_size) = areas
        self._counter = 0
        self._in_use = False
        # Until when it is certain that the slave takes the next counter, and that no late answer comes.
        self._in_step: Deadline | None = None

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        command, rest = yield from self._transfer(index, subindex, _UPLOAD, b"")
        if command & 0x02:  # expedited; bit 0: the size is given
            return rest[: 4 - (command >> 2 & 3)] if command & 0x01 else rest[:4]
        size = int.from_bytes(rest[:4], "little")
        if size > len(rest) - 4:
            raise BusError(
                self._unanswered("reading", index, subindex, f"its {size} bytes do not fit the mailbox")
            )
        return rest[4 : 4 + size]

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`; at most what fits the mailbox in one piece."""
        most = self._out_size - _HEADER.size - _SDO_HEADER.size - _SIZE_BYTES
        if not 0 < len(data) <= most:
            raise BusError(
                f"object 0x{index:04X}:{subindex} of {self._name} cannot be written: 1 to {most} "
                f"bytes fit its mailbox, not {len(data)}"
            )
        if len(data) <= _LONGEST_EXPEDITED:
            command = _DOWNLOAD | _EXPEDITED | (_LONGEST_EXPEDITED - len(data)) << 2
        else:
            command, data = _DOWNLOAD | _SIZE_GIVEN, struct.pack("<I", len(data)) + data
        yield from self._transfer(index, subindex, command, data)

    def poll_mailbox(self) -> Steps[None]:
        """Read a message if one is there, unless a transfer is under way, which reads them itself."""
        if not self._in_use:
            yield from self._alone(self._receive())

    def drain(self, most: int) -> Steps[None]:
        """Discard the messages that are there, at most `most`."""
        for _ in range(most):
            if (yield from self._receive()) == b"":
                return

    def _transfer(self, index: int, subindex: int, command: int, data: bytes) -> Steps[tuple[int, bytes]]:
        while self._in_use:
            yield None
        return (yield from self._alone(self._ask(index, subindex, command, data)))

    def _alone(self, steps: Steps[T]) -> Steps[T]:
        self._in_use = True
        try:
            return (yield from steps)
        finally:
            self._in_use = False

    def fall_out_of_step(self) -> None:
        """To be called when another user of the mailbox has counted on."""
        self._in_step = None

    def _ask(self, index: int, subindex: int, command: int, data: bytes) -> Steps[tuple[int, bytes]]:
        """The answer to a request, which is sent once the mailbox is in step.

        A slave that drops a request because of its counter looks like a slow one, where a write must not be
        repeated. So an object that never changes is read first. Of two such requests with different counters
        one is answered; answers come in order, so none from before comes after that.
        """
        doing, expected = ("reading", _UPLOAD) if command == _UPLOAD else ("writing", _DOWNLOADED)
        give_up, patience_s = Deadline(self.clock, _TRANSFER_S), _DROPPED_S
        probe, wanted, sent = (*_PROBED, _UPLOAD), (index, subindex, expected), False
        while not give_up.passed:
            if self._in_step is not None and not self._in_step.passed:
                sent = True
                found = yield from self._exchange(_request(command, index, subindex, data), _ANSWER_S, wanted)
            else:
                self._in_step, awaited = None, (probe, wanted) if sent else (probe,)
                found = yield from self._exchange(_request(_UPLOAD, *_PROBED), patience_s, *awaited)
                patience_s = min(2 * patience_s, _ANSWER_S)
            if found is None:
                self._in_step = None
                continue
            which, answer = found
            if which == probe or self._in_step is not None:
                self._in_step = Deadline(self.clock, _IN_STEP_S)
            if which != wanted:
                continue
            if answer[0] == _ABORT:
                code = int.from_bytes(answer[1][:4], "little")
                raise SdoAbortError(
                    f"{self._name} refused {doing} object 0x{index:04X}:{subindex}: "
                    f"{abort_meaning(code)} (abort 0x{code:08X})",
                    code,
                )
            return answer
        raise SetUpError(self._unanswered(doing, index, subindex, "no answer"))

    def _exchange(
        self, body: bytes, seconds: float, *awaited: tuple[int, int, int]
    ) -> Steps[tuple[tuple[int, int, int], tuple[int, bytes]] | None]:
        """Send a request; which of the awaited answers (see `_answer`) comes first, and that.

        None if none comes, or a datagram was lost.
        """
        was_sent = yield from self._put(body)
        deadline = Deadline(self.clock, seconds)
        while True:
            yield None
            if (message := (yield from self._receive())) is None:
                return None
            for which in awaited:
                if (answer := _answer(message, *which)) is not None:
                    return which, answer
            if not was_sent or deadline.passed:
                return None

    def _put(self, body: bytes) -> Steps[bool]:
        """Send a CoE message; False if that failed, and the next one has its counter: if the slave has got it
        after all, it drops that one.
        """
        counter = max(2, self._counter + 1 & 7)  # SOEM's mapping begins with 1
        header = _HEADER.pack(len(body), 0, 0, _TYPE_COE | counter << 4)
        message = (header + body).ljust(self._out_size, b"\0")
        if done := (yield from self._bus.write_register(self._number, self._out, message)):
            self._counter = counter
        return done

    def _receive(self) -> Steps[bytes | None]:
        """The CoE message that is there, or the header of one of another protocol; empty if none is.

        None if the datagram that may have emptied the mailbox is lost. The controller does not execute a read
        of an empty mailbox, so its status need not be read first.
        """
        message = yield from self._bus.read_register(self._number, self._in, self._in_size)
        if not message:
            return message
        length, _, _, kind = _HEADER.unpack_from(message)
        if kind & 0x0F != _TYPE_COE or not length:
            return message[: _HEADER.size]
        body = message[_HEADER.size : _HEADER.size + length]
        if self._emergencies is not None and (emergency := Emergency.parse(body)) is not None:
            self._emergencies.note(self._number, emergency)
        return body

    def _unanswered(self, doing: str, index: int, subindex: int, what: str) -> str:
        return f"{self._name} did not answer {doing} object 0x{index:04X}:{subindex}: {what}"


def _request(command: int, index: int, subindex: int, data: bytes = b"") -> bytes:
    return _SDO_HEADER.pack(_COE_SDO_REQUEST << 12, command, index, subindex) + data.ljust(4, b"\0")


def _answer(body: bytes, index: int, subindex: int, expected: int) -> tuple[int, bytes] | None:
    """Command and data of the answer if that is it.

    Others are dropped, such as the late answer to another command about the same object.
    """
    if len(body) < _SDO_HEADER.size + 4:
        return None
    coe, command, its_index, its_subindex = _SDO_HEADER.unpack_from(body)
    is_sdo = coe >> 12 == _COE_SDO_RESPONSE or (coe >> 12 == _COE_SDO_REQUEST and command == _ABORT)
    if not is_sdo or (its_index, its_subindex) != (index, subindex):
        return None
    if command != _ABORT and command & _COMMAND_MASK != expected:
        return None
    return command, body[_SDO_HEADER.size :]
