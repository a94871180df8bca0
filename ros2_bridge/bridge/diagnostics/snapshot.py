"""What the diagnostics judge, as it is at one moment; and how to look into the server's replies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from bridge.diagnostics.compensation_state import CompensationState
from bridge.stream.frame_selector import FrameCounts
from bridge.stream.link import SensorInfo
from bridge.stream.watch import Flags
from protocol.health.judge import Observation, emergency

SLOW_ANSWER_S: Final = 2.0
"""A server that owes an answer for this time is stopped or overloaded."""


class Snapshot(NamedTuple):
    """What is known at one moment. "New" is since the last regular report."""

    sensor: int
    address: str
    connected: bool
    problem: str
    is_reachable: bool
    """Whether there is a server there, connected or not."""
    connection_s: float
    """How long there has been, or has not been, a connection."""
    connects: int
    new_connects: int
    info: SensorInfo | None
    lost: str | None
    silent_s: float
    """Since the last new sample, or since the connection was made."""
    rate_hz: float | None
    """Measured; None while that is not possible yet."""
    expected_hz: float
    age_us: tuple[float, float] | None
    """p50 and p99; None without samples or where the server's clock is another machine's."""
    counts: FrameCounts
    new: FrameCounts
    not_finite: int
    new_not_finite: int
    flags: Flags
    temperature: float | None
    server: Mapping[str, Any]
    """The latest `status` reply of this connection; empty if there is none yet."""
    new_server: ServerCounts
    answer_s: float
    """How long the server has owed an answer; 0 if it owes none."""
    settings: Mapping[str, object] = {}
    """The sensor's settings, as far as they are known."""
    saturated: int = 0
    new_saturated: int = 0
    """Samples whose force or torque was saturated."""
    compensation: CompensationState = CompensationState()
    new_withheld: int = 0
    """Samples that could not be compensated."""

    @property
    def observation(self) -> Observation:
        """The same as every judge of a stream wants it."""
        mode = mapping(self.server_row.get("clock")).get("mode")
        return Observation(
            seconds=1.0,
            samples=self.new.new,
            lost=max(self.new.missing, self.new_server.lost_samples),
            repeated=self.new.repeated,
            invalid=self.new.invalid,
            silent_s=self.silent_s,
            rate_hz=self.rate_hz,
            nominal_hz=self.expected_hz,
            age_p99_us=None if self.age_us is None else self.age_us[1],
            # The node checks those that it publishes, the server all.
            not_finite=max(self.new_not_finite, self.new_server.not_finite),
            warnings=self.flags.warnings,
            force_torque_saturated=self.flags.force_torque_saturated,
            acceleration_saturated=self.flags.acceleration_saturated,
            angular_rate_saturated=self.flags.angular_rate_saturated,
            temperature=self.temperature,
            locked=None if mode is None else mode == "locked",
            recoveries=self.new_server.recoveries,
            missed_deadlines=self.new_server.missed_deadlines,
            reconnects=self.new_connects if self.connects > 1 else 0,
            is_lost=self.lost is not None,
            state="?" if self.info is None else self.info.state,
            server_silent=self.answer_s > SLOW_ANSWER_S / 2,
            emergency=emergency(self.server_row.get("emergency")),
            settings=self.settings,
        )

    @property
    def server_row(self) -> Mapping[str, Any]:
        """Our sensor's row of `server`; empty if it has none."""
        return row_of(self.server.get("sensors"), self.sensor)


def mapping(value: object) -> Mapping[str, Any]:
    """`value` if it is a JSON object, else an empty one: the server's word is not trusted to have a form."""
    return value if isinstance(value, dict) else {}


def row_of(rows: object, position: int) -> Mapping[str, Any]:
    """The object at `position` of a JSON list; empty if there is none."""
    return mapping(rows[position] if isinstance(rows, list) and position < len(rows) else None)


class ServerCounts(NamedTuple):
    """What the server itself has counted, of our sensor or at all, by the names in `status`."""

    lost_samples: int = 0
    not_finite: int = 0
    recoveries: int = 0
    missed_deadlines: int = 0

    @classmethod
    def of(cls, status: Mapping[str, Any], position: int) -> ServerCounts:
        """Those in a `status` reply; 0 for what it does not say."""
        row = {**status, **row_of(status.get("sensors"), position)}
        return cls(*(value if type(value := row.get(name)) is int else 0 for name in cls._fields))

    def since(self, then: ServerCounts | None) -> ServerCounts:
        """What was added since `then`, if that is known."""
        if then is None:
            return ServerCounts()
        return ServerCounts(*(max(now - before, 0) for now, before in zip(self, then, strict=True)))
