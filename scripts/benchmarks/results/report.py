"""The benchmark's table: a row for each figure, a column for each program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table

from scripts.benchmarks.comparison import RATIOS

COLUMNS: Final = {"project": "this", "yardstick": "bare C", "driver": "Bota's driver", "polling": "polling"}
BY_C: Final = "this / C"
_POINTS: Final = {"p50": "p50", "p99": "p99", "p999": "p99.9"}
NONE: Final = "-"


class Row(NamedTuple):
    """A line of the table; one without cells is a heading."""

    name: str
    cells: tuple[str, ...] = ()


def print_configuration(result: Mapping[str, Any], console: Console) -> None:
    """One configuration as a table, and why a column is not there."""
    table = Table(title=title(result), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    table.collapse_padding = True
    table.add_column("", no_wrap=True)
    for name in headings(result):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows(result):
        if row.cells:
            table.add_row(f"  {row.name}", *row.cells)
        else:
            table.add_section()
            table.add_row(f"[bold]{row.name}[/bold]")
    console.print(table)
    for name, why in result.get("missing", {}).items():
        console.print(f"no column '{COLUMNS[name]}': {why}", soft_wrap=True)


def title(configuration: Mapping[str, Any]) -> str:
    """What a configuration is called."""
    sensors = configuration["sensors"]
    return f"{configuration['rate_hz']} Hz, {sensors} virtual sensor{'s' * (sensors > 1)}"


def programs(result: Mapping[str, Any]) -> list[str]:
    """What was measured, in the order of the columns."""
    return [name for name in COLUMNS if result.get(name)]


def headings(result: Mapping[str, Any]) -> list[str]:
    """The columns' names; the ratio is behind the two that it is of."""
    found = [COLUMNS[name] for name in programs(result)]
    if "ratio" in result:
        found.insert(2, BY_C)
    return found


def rows(result: Mapping[str, Any]) -> list[Row]:
    """The table's rows, headings and all."""
    found = [Row("Up to a TCP client"), *_counts(result, "tcp"), *_points("age", result, "tcp", "age_us")]
    if get(result, "project", "c") is not None:
        found += _points("age at the C client", result, "c", "age_us")
    found += [
        figure("stamp error, p50, µs", result, "tcp", "stamp_error_us", "p50"),
        figure("absolute stamp error, p99, µs", result, "tcp", "stamp_error_us", "p99_absolute"),
        figure("hand-out to client, p50, µs", result, "tcp", "hand_out_to_client_us"),
    ]
    with_ros = get(result, "project", "ros") is not None
    if with_ros:
        found += [Row("Up to a ROS subscriber"), *_counts(result, "ros")]
        found += _points("age", result, "ros", "age_us")
    found.append(Row("The loop"))
    found += _points("wake-up lateness", result, "tcp", "server", "wake_us")
    found += _points("exchange", result, "tcp", "server", "exchange_us")
    found += [
        Row("Resources"),
        figure("CPU, %", result, "tcp", "cpu_percent", "server"),
        figure("memory, MB", result, "tcp", "rss_mb", "server"),
        figure("CPU of the TCP client, %", result, "tcp", "cpu_percent", "client"),
    ]
    if with_ros:
        for name in sorted(name for name in result["project"]["ros"]["cpu_percent"] if name[:4] == "node"):
            found.append(figure(f"CPU of the {name}, %", result, "ros", "cpu_percent", name))
            found.append(figure(f"memory of the {name}, MB", result, "ros", "rss_mb", name))
        found.append(figure("CPU of the subscriber, %", result, "ros", "cpu_percent", "subscriber"))
    found += [
        figure("CPU of the virtual sensor, %", result, "tcp", "cpu_percent", "sensor"),
        figure("CPU of all else, %", result, "tcp", "cpu_percent", "everything else"),
        figure("stolen by a hypervisor, %", result, "tcp", "stolen_percent"),
    ]
    return found


def get(content: Any, *path: str) -> Any:
    """What is there in nested tables; None where anything is missing."""
    for key in path:
        if not isinstance(content, Mapping):
            return None
        content = content.get(key)
    return content


def figure(name: str, result: Mapping[str, Any], *path: str) -> Row:
    """A row of one figure of each program."""
    values = [get(result, program, *path) for program in programs(result)]
    return _row(
        name,
        result,
        [NONE if value is None else f"{value:.{1 if value < 100 else 0}f}" for value in values],
        path,
    )


def _row(name: str, result: Mapping[str, Any], cells: list[str], path: tuple[str, ...] = ()) -> Row:
    if "ratio" in result:
        ratios = result["ratio"].get(path[0] if path else None, {})
        found = [f"{ratios[name]['median']:.2f}" for name, of in RATIOS.items() if ratios and path[1:] == of]
        cells[2:2] = found or [""]
    return Row(name, tuple(cells))


def _points(name: str, result: Mapping[str, Any], *path: str) -> list[Row]:
    return [figure(f"{name}, {text}, µs", result, *path, point) for point, text in _POINTS.items()]


def _counts(result: Mapping[str, Any], chain: str) -> list[Row]:
    return [
        _row(name, result, [count(get(result, program, chain), key) for program in programs(result)])
        for key, name in (
            ("made", "samples made"),
            ("lost", "lost"),
            ("lost_in_stops", "  during stalls of the machine"),
            ("repeated", "repeated"),
            ("machine_stops", "stalls of the machine"),
        )
    ]


def count(figures: Mapping[str, Any] | None, key: str) -> str:
    """A number of samples, of those made."""
    if figures is None or key not in figures:
        return NONE
    value = figures[key]
    return f"{value} ({value / figures['made']:.1%})" if key in {"lost", "repeated"} and value else str(value)
