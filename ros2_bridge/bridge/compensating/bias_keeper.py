"""The bias across restarts, kept by serial number, and across changes of the sensor's own offset."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

from bridge.parameters.table import AUTO, Parameters
from bridge.stream.link import Link
from ft_compensation.bias import BiasRamp, Taken
from ft_compensation.quantities import NO_WRENCH, Wrench, wrench_text
from ft_compensation.store import CompensationStore, Stored, StoreError, default_directory

FROM_PARAMETER: Final = "parameter"


class Beginning(NamedTuple):
    """The bias to put in force at once."""

    bias: Wrench
    origin: str  # where it comes from
    is_one: bool  # whether there is a bias: a zero that was not measured is none
    taken: Taken = Taken()


class BiasKeeper:
    """The files, and the sensor that the bias in force is for; for the executor's thread."""

    def __init__(self, log: Any) -> None:
        self.serial: str | None = None  # of that sensor, for any thread; None until there was one
        self.problem = ""  # why the bias could not be kept or read, a sentence; empty if it could
        self._log = log

    def keep(self, ramp: BiasRamp, parameters: Parameters, offset: Wrench | None) -> None:
        """Store the bias that `ramp` leads to, for the connected sensor, if enabled.

        `offset` is the sensor's own at that time, None if it is unknown, or if there is no bias.
        """
        if not parameters.bias_keep:
            self.problem = ""
        if not parameters.bias_keep or self.serial is None:
            return
        bias, taken = ramp.target, ramp.taken
        try:
            path = _store(parameters).save(
                _number(self.serial), bias, taken.payload, offset, taken.specific_force
            )
        except StoreError as error:
            self._say_not_kept(str(error))
            return
        self.problem = ""
        self._log.info(f"the bias is kept in {path}")

    def take(
        self,
        serial: str,
        bias: Wrench,
        origin: str,
        parameters: Parameters,
        offset: Wrench | None,
    ) -> Beginning | None:
        """Another sensor was connected, with its own `offset`; `bias` from `origin` is in force. None: keep
        it."""
        is_first, self.serial = self.serial is None, serial
        self.problem = ""
        stored = None
        try:
            if parameters.bias_keep:
                stored = self._load(serial, parameters, offset)
        except StoreError as error:
            self._say_not_kept(str(error))
        if stored is None:
            if is_first or origin == FROM_PARAMETER:
                return None
            self._log.warning(
                f"another sensor is there now, serial number {serial}: the bias was the other's and is "
                "zero now; tare"
            )
            return Beginning(NO_WRENCH, FROM_PARAMETER, is_one=False)
        if is_first and bias not in (NO_WRENCH, stored.bias):
            self._log.warning(
                f"the stored bias of the sensor with serial number {serial} is not used, because the "
                "parameter bias is given, and is overwritten"
            )
            return None
        before = Taken(stored.payload or parameters.payload, stored.specific_force)
        self._log.info(f"the sensor with serial number {serial} has the bias that was kept at {stored.saved}")
        change, taken = before.weighed(parameters.payload)
        if warning := taken.warning(change, parameters.payload):
            self._log.warning(warning)
        is_one = stored.bias != NO_WRENCH or stored.offset is not None
        return Beginning(stored.bias.plus(change), f"kept since {stored.saved}", is_one, taken)

    def _load(self, serial: str, parameters: Parameters, offset: Wrench | None) -> Stored | None:
        """What was stored, with the bias shifted to the sensor's current `offset`; StoreError."""
        stored = _store(parameters).load(_number(serial))
        is_none = stored is not None and stored.offset is None and stored.bias == NO_WRENCH
        if stored is None or is_none or stored.offset == offset:
            return stored
        if stored.offset is None or offset is None:
            raise StoreError(
                f"the stored bias of the sensor with serial number {serial} is not used, because it is "
                "unknown whether the sensor's own offset has changed since: tare"
            )
        change = offset.plus(stored.offset, -1.0)
        self._log.info(
            f"the own offset of the sensor with serial number {serial} has changed by "
            f"{wrench_text(change)} since its bias was stored: the bias is shifted by the change"
        )
        return stored._replace(bias=stored.bias.plus(change))

    def _say_not_kept(self, problem: str) -> None:
        self.problem = problem
        self._log.warning(problem)


def directory_of(parameter: str) -> Path:
    """The directory that the parameter `bias_directory` means. StoreError if there is none."""
    return default_directory() if parameter == AUTO else expand(parameter, "bias_directory")


def expand(path: str, parameter: str) -> Path:
    """A path that may begin with ~. StoreError if there is no home directory."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise StoreError(f"there is no home directory for {path}: give {parameter} in full") from None


def _store(parameters: Parameters) -> CompensationStore:
    return CompensationStore(directory_of(parameters.bias_directory))


def _number(serial: str) -> int:
    if not (serial.isascii() and serial.isdigit()):
        raise StoreError(f"the sensor's serial number is {serial!r}, not a number: its bias cannot be kept")
    return int(serial)


class OwnOffset:
    """The offset (object 0x8000) that the sensor itself adds to every sample, and how it affects the bias.

    Follows what the server reports; used by the executor's thread and the reader's.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        # The offset that the bias was taken with; None if it was never known.
        self.of_bias: Wrench | None = None
        self._appeared = False  # whether the offset became known only after the bias was taken
        # Whether there is a bias. Zero may be one: what a tare finds where the sensor reads nothing.
        self.has_bias = False

    @property
    def now(self) -> Wrench | None:
        """The sensor's current offset; None if unknown."""
        offset = self._link.info.offset
        return None if offset is None else Wrench.of(offset)

    @property
    def to_keep(self) -> Wrench | None:
        """`of_bias`; None where there is no bias, which goes with any offset."""
        return self.of_bias if self.has_bias else None

    def begin(self, bias: Wrench, *, is_measured: bool = False) -> Wrench | None:
        """`bias` goes with the current offset, which is returned. Zero is no bias, unless it was measured."""
        self.has_bias = is_measured or bias != NO_WRENCH
        self.of_bias, self._appeared = self.now, False
        return self.of_bias

    def follow(self) -> Wrench | None:
        """The shift of the bias that the current offset requires, once; None: no shift."""
        now, before = self.now, self.of_bias
        if now is None or now == before:
            return None
        self.of_bias = now
        if not self.has_bias:
            return None
        self._appeared = self._appeared or before is None
        return None if before is None else now.plus(before, -1.0)

    def doubt(self) -> str:
        """Why the bias may no longer fit the sensor, a sentence; empty if it does."""
        if not self.has_bias or not self._link.is_connected:
            return ""
        if self._appeared:
            return "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"
        if self.of_bias is not None and self._link.info.offset is None:
            return "the sensor's own offset is no longer known: the bias may be wrong, tare"
        return ""
