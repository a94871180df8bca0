"""What the demo shows: a live table on a terminal, else a line a second; and the summary at the end."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Final

from rich.console import Console
from rich.live import Live
from rich.table import Table

from scripts.demonstration.measure import Measurement, Summary, explanation

_ROWS: Final = (
    ("Force", "force", "N", 2),
    ("Torque", "torque", "Nm", 3),
    ("Acceleration", "acceleration", "m/s²", 3),
    ("Angular rate", "angular_rate", "rad/s", 4),
)

_TABLE_WIDTH: Final = 66
"""A narrower terminal gets a line a second: a number that is cut off is a wrong one."""


class Screen:
    """Shows the measurement as it grows."""

    def __init__(self, sensor: Mapping[str, Any]) -> None:
        self._title = f"{sensor['name']}, serial {sensor['serial']}, {sensor['rate_hz']} Hz, virtual"
        console = Console()
        fits = console.is_terminal and not console.is_dumb_terminal and console.width >= _TABLE_WIDTH
        self._live = Live(console=console, auto_refresh=False) if fits else None
        self.period_s = 0.25 if self._live else 1.0
        self._messages = 0
        self._at_s = time.monotonic()
        self._rate_hz = 0.0

    def __enter__(self) -> Screen:
        """Begin to show."""
        if self._live is not None:
            self._live.__enter__()
        else:
            print(self._title, flush=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the last state standing."""
        if self._live is not None:
            self._live.__exit__(kind, value, trace)

    def show(self, measurement: Measurement) -> None:
        """Show the state now; hold the measurement's lock."""
        now_s = time.monotonic()
        if now_s - self._at_s >= 0.9:
            self._rate_hz = (measurement.messages - self._messages) / (now_s - self._at_s)
            self._messages, self._at_s = measurement.messages, now_s
        if self._live is not None:
            self._live.update(self._table(measurement), refresh=True)
        else:
            print(f"{self._rate_hz:7.1f} Hz  {self._line(measurement)}", flush=True)

    def _line(self, measurement: Measurement) -> str:
        sample = measurement.latest
        assert sample is not None
        vectors = "  ".join(
            f"{unit} {' '.join(f'{v:+.{digits}f}' for v in getattr(sample, name))}"
            for _, name, unit, digits in _ROWS
        )
        return (
            f"age {measurement.age_ns / 1e6:.2f} ms  lost {measurement.lost + measurement.lost_before}  "
            f"repeated {measurement.repeated}  {vectors}"
        )

    def _table(self, measurement: Measurement) -> Table:
        sample = measurement.latest
        assert sample is not None
        table = Table(title=self._title, title_justify="left")
        table.add_column("", min_width=22)
        for axis in "xyz":
            table.add_column(axis, justify="right", min_width=10)
        for name, vector, unit, digits in _ROWS:
            table.add_row(f"{name}, {unit}", *(f"{v:+.{digits}f}" for v in getattr(sample, vector)))
        table.add_section()
        table.add_row("Messages a second", f"{self._rate_hz:.1f}", "", "")
        table.add_row("Age at the subscriber", f"{measurement.age_ns / 1e6:.2f} ms", "", "")
        lost = measurement.lost + measurement.lost_before
        table.add_row("Lost, repeated", str(lost), str(measurement.repeated), "")
        table.caption = "Ctrl-C ends it"
        return table


def print_summary(summary: Summary, sensor: Mapping[str, Any]) -> None:
    """The figures of the whole run."""
    table = Table(title="What arrived on the ROS topic", title_justify="left", show_header=False)
    table.add_column(min_width=34)
    table.add_column(justify="right", min_width=12)
    for name, value in (
        ("Messages", str(summary.messages)),
        ("Mean rate", f"{summary.rate_hz:.1f} Hz"),
        ("Sensor's own rate", f"{sensor['rate_hz']} Hz"),
        ("Lost", str(summary.lost + summary.lost_before)),
        ("  before or withheld (GAP)", str(summary.lost_before)),
        ("  between server and subscriber", str(summary.lost)),
        ("  of both, while the machine stopped", str(summary.lost_in_stops)),
        ("Repeated", str(summary.repeated)),
        ("Age at the subscriber, p50", f"{summary.age_p50_ms:.2f} ms"),
        ("Age at the subscriber, p99", f"{summary.age_p99_ms:.2f} ms"),
        ("Age at a TCP client, p50", f"{summary.tcp_age_p50_ms:.2f} ms"),
        ("Age at a TCP client, p99", f"{summary.tcp_age_p99_ms:.2f} ms"),
        ("All finite", _yes(summary.all_finite)),
        ("All decoded right", _yes(summary.all_decoded_right)),
    ):
        table.add_row(name, value)
    Console().print(table)
    if (why := explanation(summary)) is not None:
        say(why)


def _yes(fact: bool) -> str:
    return "yes" if fact else "NO"


def say(text: str) -> None:
    """Print sentences, broken between words."""
    Console(highlight=False, markup=False).print(text)
