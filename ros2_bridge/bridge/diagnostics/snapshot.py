"""What the diagnostics judge, as it is at one moment; and how to look into the server's replies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from bridge.diagnostics.compensation_state import CompensationState
from bridge.stream.connection import SensorInfo
from bridge.stream.frame_selector import FrameCounts
from bridge.stream.watch import Flags


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
    new_server_lost: int
    answer_s: float
    """How long the server has owed an answer; 0 if it owes none."""
    compensation: CompensationState = CompensationState()
    new_withheld: int = 0
    """Samples that could not be compensated."""

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


def server_lost(status: Mapping[str, Any], position: int) -> int:
    """The samples that a `status` reply says the server itself has lost."""
    lost = row_of(status.get("sensors"), position).get("lost_samples")
    return lost if type(lost) is int else 0
