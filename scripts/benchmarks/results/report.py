"""The benchmark's table: a row for each figure, this project beside the polling design and the floor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table

_POINTS: Final = {"p50": "p50", "p99": "p99", "p999": "p99.9"}
_NONE: Final = "-"


class Row(NamedTuple):
    """A line of the table; one with a name only is a heading."""

    name: str
    project: str = ""
    polling: str = ""
    floor: str = ""
    project_by_floor: str = ""
    polling_by_project: str = ""


def print_configuration(result: Mapping[str, Any], console: Console) -> None:
    """One configuration as a table."""
    table = Table(title=title(result), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for name in ("this", "polling", "floor", "this/floor", "polling/this"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows(result):
        if len(list(filter(None, row))) == 1:
            table.add_section()
            table.add_row(f"[bold]{row.name}[/bold]")
        else:
            table.add_row(f"  {row.name}", *row[1:])
    console.print(table)


def title(configuration: Mapping[str, Any]) -> str:
    """What a configuration is called."""
    sensors = configuration["sensors"]
    return f"{configuration['rate_hz']} Hz, {sensors} virtual sensor{'s' * (sensors > 1)}"


def rows(result: Mapping[str, Any]) -> list[Row]:
    """The table's rows, headings and all."""
    found = [Row("Up to a TCP client"), *_counts(result, "tcp")]
    found += _points("age", result, ("tcp", "age_us"), ("age_us",))
    found += [
        _figure("stamp error, p50, µs", result, ("tcp", "stamp_error_us", "p50")),
        _figure("absolute stamp error, p99, µs", result, ("tcp", "stamp_error_us", "p99_absolute")),
        _figure(
            "hand-out to client, p50, µs", result, ("tcp", "hand_out_to_client_us"), ("loopback_us", "p50")
        ),
    ]
    if get(result, "project", "ros") is not None:
        found += [Row("Up to a ROS subscriber"), *_counts(result, "ros")]
        found += _points("age", result, ("ros", "age_us"))
    found.append(Row("The server's loop"))
    found += _points("wake-up lateness", result, ("tcp", "server", "wake_us"), ("wake_us",))
    found += _points("exchange", result, ("tcp", "server", "exchange_us"), ("exchange_us",))
    found += [
        Row("Resources"),
        _figure("CPU of the server, %", result, ("tcp", "cpu_percent", "server")),
        _figure("memory of the server, MB", result, ("tcp", "rss_mb", "server")),
    ]
    for name in sorted(get(result, "project", "ros", "cpu_percent") or {}):
        if name.startswith("node"):
            found.append(_figure(f"CPU of the {name}, %", result, ("ros", "cpu_percent", name)))
            found.append(_figure(f"memory of the {name}, MB", result, ("ros", "rss_mb", name)))
    found.append(_figure("CPU of the TCP client, %", result, ("tcp", "cpu_percent", "client")))
    if get(result, "project", "ros") is not None:
        found.append(_figure("CPU of the subscriber, %", result, ("ros", "cpu_percent", "subscriber")))
    found.append(_figure("CPU of the virtual sensor, %", result, ("tcp", "cpu_percent", "sensor")))
    found.append(_figure("CPU of all else (TCP), %", result, ("tcp", "cpu_percent", "everything else")))
    if get(result, "project", "ros") is not None:
        others = ("ros", "cpu_percent", "everything else")
        found.append(_figure("CPU of all else (ROS), %", result, others))
    return found


def get(content: Any, *path: str) -> Any:
    """What is there in nested tables; None where anything is missing."""
    for key in path:
        if not isinstance(content, Mapping):
            return None
        content = content.get(key)
    return content


def _counts(result: Mapping[str, Any], chain: str) -> list[Row]:
    found = []
    for key, name in (
        ("made", "samples made"),
        ("lost", "lost"),
        ("lost_in_stops", "  during stalls of the machine"),
        ("repeated", "repeated"),
        ("machine_stops", "stalls of the machine"),
    ):
        texts = []
        for program in ("project", "polling"):
            value, made = get(result, program, chain, key), get(result, program, chain, "made")
            if value is None:
                texts.append(_NONE)
            elif key in {"lost", "repeated"} and value:
                texts.append(f"{value} ({value / made:.2%})")
            else:
                texts.append(str(value))
        found.append(Row(name, *texts))
    return found


def _points(
    name: str, result: Mapping[str, Any], path: tuple[str, ...], floor: tuple[str, ...] | None = None
) -> list[Row]:
    return [
        _figure(f"{name}, {text}, µs", result, (*path, point), (*floor, point) if floor else None)
        for point, text in _POINTS.items()
    ]


def _figure(
    name: str, result: Mapping[str, Any], path: tuple[str, ...], floor: tuple[str, ...] | None = None
) -> Row:
    project, polling = get(result, "project", *path), get(result, "polling", *path)
    least = get(result, "floor", *floor) if floor else None
    return Row(
        name, _text(project), _text(polling), _text(least) if floor else "",
        _ratio(project, least), _ratio(polling, project) if "error" not in name else "",
    )  # fmt: skip


def _text(value: float | None) -> str:
    return _NONE if value is None else f"{value:.1f}"


def _ratio(value: float | None, unit: float | None) -> str:
    return f"{value / unit:.1f}" if value is not None and unit is not None and unit > 0 else ""
