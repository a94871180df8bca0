"""Streams of one server with their truth: what every program that reads one must find, sample by sample.

A tool of known weight hangs still on the sensor, and a known contact acts on it, so that the compensated
wrench is known whatever else happens. The truth is written here by who makes the stream; no code of the
product is asked for it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, cast

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import encode
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import sampling_rate_hz
from bota_ethercat.text.json_text import JsonObject
from bota_ft_compensation.quantities import Wrench
from tests.compensation.making import BIAS, TOOL, load
from tests.descriptions import description, sensor_row

PERIOD_NS: Final = 10_000_000  # at SINC 512
BEGIN_NS: Final = 1_000_000_000_000
EPOCH_NS: Final = 1_700_000_000_000_000_000
UP: Final = (0.6, 0.0, 0.8)
OFFSET: Final = (0.5, -0.25, 2.0, 0.01, 0.02, -0.03)  # the sensor's own, with which the bias was measured
SETTINGS: Final = {"sinc_length": 512, "fir": False}
FIELDS: Final = [f"{name}.{axis}" for name in ("force", "torque", "acceleration") for axis in "xyz"]
Six = tuple[float, ...]
_WARNINGS: Final = {0: 1, 1: 1, 2: 1, 3: 2, 4: 1, 6: 2}  # usability of the compensated wrench by warning bit


class Truth(NamedTuple):
    """Of one new sample."""

    usability: int  # of the compensated wrench: 0 usable, 1 saturated, 2 faulty
    force_torque: int  # the same of what was measured
    wrench: Six | None  # what the contact makes, N and Nm; None: it cannot be known
    offset: Six
    sinc_length: int
    rate_hz: float
    is_certain: bool = True  # False: of a time before an offset was told, in which no live program can know


class End(NamedTuple):
    """The connection ends, and another is made."""

    description: JsonObject


class At(NamedTuple):
    at_ns: int  # when the server sends it, by CLOCK_MONOTONIC of who plays it
    item: DataMessage | JsonObject | End


class Stream:
    """Writes a stream and its truth while time passes."""

    def __init__(self, **row: Any) -> None:
        self.now_ns, self.clock_ns, self.sequence = BEGIN_NS, 0, 100
        self.offset: Six = OFFSET
        self.settings: dict[str, Any] = {**SETTINGS, **row.pop("settings", {})}
        self.contact: Six = (0.0,) * 6
        self.begin, self.size = self.describe() | {"boot_id": "one"}, 61
        self.items: list[At] = []
        self.truth: dict[int, Truth] = {}  # by stamp

    @property
    def rate_hz(self) -> int:
        return sampling_rate_hz(self.settings["sinc_length"])

    @property
    def in_force(self) -> JsonObject:
        settings = dict(self.settings)
        delay_ms = delays_ms(settings, self.rate_hz)
        return {"settings": settings, "rate_hz": self.rate_hz, "offset": [*self.offset], "delay_ms": delay_ms}

    def describe(self, **row: Any) -> JsonObject:
        rows = [sensor_row(sensor) | self.in_force | row for sensor in range(2)]
        return description(*copy.deepcopy(rows))

    def put(self, item: JsonObject | End) -> None:
        self.items.append(At(self.now_ns, item))

    def reply(self, described: JsonObject) -> None:
        """To a request that another thread of the client has made."""
        self.put({**described, "reply": "describe", "ok": True, "id": -1})

    def event(self, name: str, sensor: int = 0, **keys: Any) -> None:
        self.put({"event": name, "sensor": sensor, **copy.deepcopy(keys)})

    def reconfigure(self, **settings: Any) -> None:
        self.settings |= settings
        self.event("reconfigured", **self.in_force)

    def set_offset(self, *offset: float, is_sudden: bool = True, is_change: bool = True) -> None:
        """The server tells it once it is written; what came shortly before may have part of it."""
        if is_sudden:
            self.change_offset(*offset)
        self.event("offset_changed", offset=offset)
        self.is_told = True
        if is_change:
            self._hidden_until_ns = max(self.truth) - EPOCH_NS + 2 * self.period_ns

    def write_offset(self, *offset: float) -> None:
        """As the server does it, which says before that it will; a sample between any two of the numbers."""
        self.event("offset_changed", offset=None)
        self.is_told, before = False, self.offset
        for written in range(len(offset) + 1):
            self.offset = offset[:written] + before[written:]
            self.send(known=False)
        self.set_offset(*offset, is_sudden=False, is_change=offset != before)

    def change_offset(self, *offset: float) -> None:
        self.offset = offset
        since_ns = max(self.truth) - 26 * self.period_ns
        self.truth |= {at: now._replace(is_certain=False) for at, now in self.truth.items() if at > since_ns}

    _hidden_until_ns, is_told = 0, True

    @property
    def period_ns(self) -> int:
        return round(1e9 / self.rate_hz)

    def data(self, sensor: int = 0, **values: Any) -> bytes:
        weight_and_bias = load(UP, TOOL, BIAS.plus(Wrench.of(OFFSET), -1.0)).values
        parts = weight_and_bias, self.contact, (0.0,) * 6 if sensor else self.offset
        measured = [sum(each) for each in zip(*parts, strict=True)]
        known = dict(zip(FIELDS, [*measured, *UP], strict=True)) | {
            "temperature": 30.0,
            **values,
        }
        return encode(self.size, known)

    def send(  # `values`: of fields of the process data
        self, count: int = 1, flags: int = 0, usability: int = 0, sensor: int = 0, lost: int = 0,
        known: bool = True, force_torque: int | None = None, **values: Any,
    ) -> None:  # fmt: skip
        """Frames of sensor 0; `sensor` 1 sends one of its own behind each."""
        for number in range(count):
            self.now_ns += self.period_ns * (1 + (lost if not number else 0))
            moment, self.sequence = self.now_ns - self.clock_ns, self.sequence + 1
            frame = DataMessage(
                self.sequence, EPOCH_NS + self.now_ns, moment, 0, flags, 3, self.data(**values)
            )
            self.items.append(At(self.now_ns, frame))
            if sensor:
                other = frame._replace(sensor=1, flags=0, process_data=self.data(1))
                self.items.append(At(self.now_ns, other))
            if not flags & (DataFlag.REPEATED | DataFlag.INVALID):
                is_known = known and self.now_ns > self._hidden_until_ns
                self.truth[frame.stamp_ns] = Truth(
                    usability, usability if force_torque is None else force_torque,
                    self.contact if is_known else None, self.offset if self.is_told else (),
                    self.settings["sinc_length"], self.rate_hz,
                )  # fmt: skip
            flags &= ~DataFlag.GAP

    def connect_anew(self, boot_id: str = "one", **row: Any) -> None:
        self.put(End(self.describe(**row) | {"boot_id": boot_id}))
        self.now_ns += 1_500_000_000


def _of(field: str, value: float) -> Any:
    return {field: value}


def plain(s: Stream) -> None:
    s.send(40)
    s.contact = (3.0, -2.0, -12.0, 0.1, 0.2, -0.3)
    s.send(30)
    s.contact = (0.0,) * 6
    s.send(10)


def other_filter(s: Stream) -> None:
    s.send(30)
    s.reconfigure(acceleration_filter=2)
    s.send(30)


def other_rate(s: Stream) -> None:
    s.send(30)
    s.reconfigure(sinc_length=1024)
    s.send(20)
    s.reconfigure(sinc_length=256)
    s.send(60)


def offset(s: Stream) -> None:
    s.send(40)
    s.set_offset(9.0, 8.0, -7.0, 0.3, 0.2, 0.1)
    s.contact = (0.0, 4.0, 0.0, 0.0, 0.0, 0.1)
    s.send(40)
    s.set_offset(*(0.0,) * 6)
    s.send(40)


def offset_in_a_gap(s: Stream) -> None:
    s.send(40)
    s.set_offset(9.0, 8.0, -7.0, 0.3, 0.2, 0.1)
    s.send(40, DataFlag.GAP, lost=5)


def offset_written(s: Stream) -> None:
    """Twice, and once where the same is written again."""
    s.send(40)
    s.write_offset(9.0, 8.0, -7.0, 0.3, 0.2, 0.1)
    s.contact = (0.0, 4.0, 0.0, 0.0, 0.0, 0.1)
    s.send(1)
    s.write_offset(*(0.0,) * 6)
    s.send(20)
    s.write_offset(*(0.0,) * 6)
    s.send(20)


def offset_no_longer_known(s: Stream) -> None:
    s.send(40)
    s.event("sensor_back", **(s.in_force | {"offset": None}))
    s.is_told = False
    s.send(20, known=False)
    s.event("sensor_back", **s.in_force)
    s.is_told = True
    s.send(20)


def description_crosses(s: Stream) -> None:
    """The reply was made before the event, and arrives before it."""
    s.send(30)
    old = s.describe()
    s.settings["sinc_length"] = 1024
    s.reply(old)
    s.event("reconfigured", **s.in_force)
    s.send(30)


def description_follows(s: Stream) -> None:
    s.send(30)
    s.reconfigure(sinc_length=1024)
    s.reply(s.describe())
    s.send(30)


def warning_bits(s: Stream) -> None:
    s.send(10)
    for bit in range(32):
        usability = _WARNINGS.get(bit, 0)
        s.send(1, usability=usability, force_torque=0 if bit in (1, 2) else usability, warnings=1 << bit)
        s.send(2)


def saturation_fields(s: Stream) -> None:
    s.send(10)
    for name in ("force_torque_saturated", "acceleration_saturated", "angular_rate_saturated"):
        for bit in (0, 2):
            s.send(1, usability=1, force_torque=int(name.startswith("force")), **_of(name, 1 << bit))
            s.send(2)
    s.send(1, usability=2, warnings=9, force_torque_saturated=1)
    s.send(2, status=5)


def not_finite(s: Stream) -> None:
    s.send(10)
    for name in ("force.x", "torque.z"):
        s.send(1, usability=2, **_of(name, math.nan))
        s.send(2)
        s.send(1, usability=2, **_of(name, -math.inf))
        s.send(2)
    s.send(1, temperature=math.nan)
    s.send(2)


def stuck(s: Stream) -> None:
    s.send(20)
    s.send(20, DataFlag.REPEATED)
    s.send(20, DataFlag.GAP)


def silent_bus(s: Stream) -> None:
    s.send(20)
    s.send(5, DataFlag.INVALID)
    s.send(20, DataFlag.GAP)


def gaps(s: Stream) -> None:
    s.send(20)
    for lost in (1, 2, 7, 40):
        s.send(20, DataFlag.GAP, lost=lost)


def lost_and_back(s: Stream) -> None:
    s.send(20)
    s.event("sensor_lost", message="sensor 0 is lost: no power")
    s.send(10, DataFlag.INVALID)
    s.event("sensor_back", lost_s=0.1, **s.in_force)
    s.send(40, DataFlag.GAP)


def lost_without_a_word_of_its_return(s: Stream) -> None:
    s.send(20)
    s.event("sensor_lost")
    s.send(10, DataFlag.INVALID)
    s.send(30, DataFlag.GAP)


def back_with_another_offset(s: Stream) -> None:
    s.send(40)
    s.event("sensor_lost")
    s.send(40, DataFlag.INVALID)
    s.change_offset(*(0.0,) * 6)
    s.event("sensor_back", **s.in_force)
    s.send(40, DataFlag.GAP)


def another_connection(s: Stream) -> None:
    s.send(30)
    s.connect_anew()
    s.send(30)


def another_connection_with_another_offset(s: Stream) -> None:
    s.send(30)
    s.change_offset(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    s.connect_anew()
    s.send(30)


def another_connection_with_other_settings(s: Stream) -> None:
    s.send(30)
    s.settings |= {"sinc_length": 256}
    s.connect_anew()
    s.send(60)


def server_restarted(s: Stream) -> None:
    s.send(30)
    s.connect_anew()
    s.sequence = 0
    s.send(30)


def two_sensors(s: Stream) -> None:
    s.send(20, sensor=1)
    s.event("sensor_lost", sensor=1)
    s.send(10)
    s.event("sensor_back", sensor=1, **(s.in_force | {"offset": [7.0] * 6, "rate_hz": 400}))
    s.event("offset_changed", sensor=1, offset=[9.0] * 6)
    s.send(20, sensor=1)


def counts(s: Stream) -> None:
    s.send(30)
    s.reconfigure(calibration_matrix=False)
    s.send(20, known=False)
    s.reconfigure(calibration_matrix=True)
    s.send(30)


def compensated_by_the_sensor(s: Stream) -> None:
    s.send(20)
    s.reconfigure(inertia_compensation=True)
    s.send(20, known=False)


def configured_frame(s: Stream) -> None:
    s.send(20)
    s.reconfigure(coordinate_system=True)
    s.send(20, known=False)
    s.reconfigure(coordinate_system=False)
    s.send(20)


def imu_off(s: Stream) -> None:
    s.send(20)
    s.reconfigure(imu_active=0)
    s.send(20, known=False, **cast(Any, dict.fromkeys(FIELDS[6:], 0.0)))
    s.reconfigure(imu_active=1)
    s.send(20)


def larger_process_data(s: Stream) -> None:
    s.send(20)
    s.connect_anew(pdo_size=77)
    s.size = 77
    s.send(30)


def events_of_no_consequence(s: Stream) -> None:
    s.send(20)
    s.event("emergency", code=0x1000, text="", register=0, data="")
    s.event("unheard_of", settings={"sinc_length": 32}, rate_hz=1600, offset=[5.0] * 6)
    s.put({"event": "reconfigured", "settings": {"sinc_length": 32}})
    s.send(20)


STORIES: Final[Sequence[Callable[[Stream], None]]] = (
    plain, other_filter, other_rate, offset, offset_in_a_gap, offset_written, offset_no_longer_known,
    description_crosses, description_follows,
    warning_bits, saturation_fields, not_finite, stuck, silent_bus, gaps, lost_and_back,
    lost_without_a_word_of_its_return, back_with_another_offset, another_connection,
    another_connection_with_another_offset, another_connection_with_other_settings, server_restarted,
    two_sensors, counts, compensated_by_the_sensor, configured_frame, imu_off, larger_process_data,
    events_of_no_consequence,
)  # fmt: skip


def make(story: Callable[[Stream], None]) -> Stream:
    made = Stream()
    story(made)
    return made


STREAMS: Final[Mapping[str, Stream]] = {story.__name__: make(story) for story in STORIES}
TOOL_PARAMETERS: Final[JsonObject] = {
    "tool_mass": TOOL.mass, "tool_center_of_gravity": [*TOOL.center],
    "bias": [*BIAS.values], "sensor_offset": [*OFFSET],
}  # fmt: skip
