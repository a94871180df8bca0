"""One sensor: identity, settings, state."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any, Final, NamedTuple

from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue, rate_divisor
from ethercat_server.ethercat.clock import Clock, Deadline

# How long Bota's own driver lets a sensor settle: new filter settings, and the data after entering OP.
SETTLING_S: Final = 0.5
SETTLING_SAMPLES: Final = 8  # at the lowest rates: how many samples the filters take, and a new offset
_MODEL_NAME: Final = re.compile(r"BFT-[A-Z]{4}-ECAT-M8")


class Identity(NamedTuple):
    """The sensor's identity, read over SDO."""

    name: str
    serial: int
    hardware: str
    firmware: str

    def __str__(self) -> str:
        """As a person names it."""
        return f"{self.name} with serial {self.serial}"


class FoundSensor(NamedTuple):
    """A sensor that was found."""

    number: int
    identity: Identity

    def __str__(self) -> str:
        """Its description in messages."""
        return f"sensor {self.number}: {self.identity.name}, serial {self.identity.serial}"

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {"sensor": self.number, **self.identity._asdict()}


class SensorState(Enum):
    """The state of a sensor; `Sensor.enter` changes it."""

    SETTING_UP = auto()
    STREAMING = auto()
    CHANGING = auto()  # out of OP to have its settings changed
    REVERTING = auto()  # the change failed: it gets its former settings back
    LOST = auto()
    REFUSED = auto()  # another sensor is connected at its position

    @property
    def reported(self) -> str:
        """What `describe` says."""
        return {"STREAMING": "OP", "LOST": "LOST", "REFUSED": "REFUSED"}.get(self.name, "PREOP")


_S = SensorState
_TRANSITIONS: Final = {
    _S.SETTING_UP: {_S.STREAMING},
    _S.STREAMING: {_S.CHANGING, _S.LOST},
    _S.CHANGING: {_S.STREAMING, _S.REVERTING, _S.LOST, _S.REFUSED},
    _S.REVERTING: {_S.STREAMING, _S.LOST, _S.REFUSED},
    _S.LOST: {_S.STREAMING, _S.REFUSED},
    _S.REFUSED: {_S.STREAMING, _S.REFUSED},
}


@dataclass(slots=True)
class Sensor:
    """One sensor on the bus, as found and set up."""

    number: int  # among the sensors, from 0
    identity: Identity
    # The settings to be in force; written again when the sensor has lost them.
    wanted: dict[str, SettingValue]
    asked: frozenset[str] = frozenset()  # those among them that a user set: these must exist
    position: int = 0  # among all slaves on the wire, from 0
    pdo_size: int = 0
    rate_hz: int = 0
    state: SensorState = SensorState.SETTING_UP
    # The settings in force; `set_in_force` changes them.
    settings: dict[str, SettingValue] = field(default_factory=dict)
    # What each of them means; computed once, not for each reply.
    meaning: dict[str, str] = field(default_factory=dict)
    # The delay of each channel by its filters; likewise.
    delay_ms: dict[str, float | None] = field(default_factory=dict)
    # The force/torque offset in force; written again when the sensor has lost it. None: it has none.
    offset: tuple[float, ...] | None = None
    # Whether it is in force for certain: not while another one is being written.
    offset_is_certain: bool = True
    # The SINC length is a guess from a rate that CHOP may have divided: not to be written for no reason.
    sinc_guessed: bool = False
    settled_at: Deadline | None = None  # when its data will have settled; see `settle`
    # A change was interrupted: neither the former settings nor the wanted ones are in force for certain.
    change_interrupted: bool = False

    @property
    def streams(self) -> bool:
        """Whether its process data is its own: it is in OP and answers."""
        return self.state is SensorState.STREAMING

    def settle(self, clock: Clock) -> None:
        """It has entered OP, so its data is settling. Samples are streamed at once; averaging waits."""
        self.settled_at = Deadline(clock, max(SETTLING_S, SETTLING_SAMPLES * self.period_ns * 1e-9))

    @property
    def settling(self) -> bool:
        """Whether it streams data that has not settled."""
        return self.streams and self.settled_at is not None and not self.settled_at.passed

    def enter(self, state: SensorState) -> None:
        """Go to another state; AssertionError for an impossible transition."""
        if state not in _TRANSITIONS[self.state]:
            raise AssertionError(f"{self.state.name} -> {state.name}")
        self.state = state

    @property
    def period_ns(self) -> float:
        """Nominal sample period; 0x8011 rounds the rate to whole Hz, so it follows from the SINC length."""
        length = self.wanted["sinc_length"]
        divisor = rate_divisor(length, self.rate_hz, self.wanted.get("chop")) or 1
        return 1e9 * length * divisor / BASE_SAMPLING_RATE_HZ

    def set_in_force(self, settings: Mapping[str, SettingValue]) -> None:
        """These settings are in force now."""
        self.settings = dict(settings)
        self.delay_ms = delays_ms(settings, self.rate_hz)
        chop = settings.get("chop")
        self.meaning = {
            name: value_meaning(name, value, self.rate_hz, chop) for name, value in settings.items()
        }

    @property
    def reported_offset(self) -> list[float] | None:
        """The force/torque offset as messages carry it; None if it is not certain, or no numbers."""
        offset = self.offset if self.offset_is_certain else None
        return list(offset) if offset is not None and all(map(math.isfinite, offset)) else None

    def as_message(self) -> dict[str, Any]:
        """The part of replies and events about a change."""
        return {
            "settings": dict(self.settings),
            "rate_hz": self.rate_hz,
            "delay_ms": self.delay_ms,
            "offset": self.reported_offset,
        }

    def describe(self) -> dict[str, Any]:
        """The sensor's part of the `describe` reply."""
        return {
            "sensor": self.number,
            "position": self.position,
            **self.identity._asdict(),
            "pdo_size": self.pdo_size,
            "state": self.state.reported,
            "settling": self.settling,
            "meaning": self.meaning,
            **self.as_message(),
        }


def is_known_model(name: str) -> bool:
    """Whether `name` is that of a Gen-0 EtherCAT model."""
    return _MODEL_NAME.fullmatch(name) is not None
