"""The benchmark's table: a row for each figure, this project beside the note's design and the floor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console
from rich.table import Table

_CLIENTS: Final = (("tcp", "TCP client"), ("ros", "ROS subscriber"))
_POINTS: Final = ("p50", "p99", "p999")
_POINT_NAMES: Final = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}
_NONE: Final = "-"


def print_configuration(result: Mapping[str, Any], console: Console) -> None:
    """One configuration as a table."""
    title = f"{result['rate_hz']} Hz, {result['sensors']} virtual sensor{'s' * (result['sensors'] > 1)}"
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("", min_width=30)
    for name in ("this project", "note's design", "floor", "this/floor", "note/this"):
        table.add_column(name, justify="right")
    for row in rows(result):
        if row is None:
            table.add_section()
        else:
            table.add_row(*row)
    console.print(table)


def rows(result: Mapping[str, Any]) -> list[tuple[str, ...] | None]:
    """The table's rows; None where a line is drawn."""
    found: list[tuple[str, ...] | None] = []
    for chain, client in _CLIENTS:
        if get(result, "project", chain) is None:
            continue
        for key, name in (
            ("made", "Samples made"),
            ("lost", "lost"),
            ("lost_in_stops", "  of them in machine stops"),
            ("repeated", "repeated"),
            ("machine_stops", "Machine stops"),
        ):
            found.append(_counts(f"{name}, {client}", result, chain, key))
        found += [
            _figure(f"Age at {client}, {_POINT_NAMES[point]}, µs", result, (chain, "age_us", point),
                    floor=("age_us", point) if chain == "tcp" else None)
            for point in _POINTS
        ]  # fmt: skip
        found.append(None)
    for key, name in (("p50", "p50"), ("p99_absolute", "p99 of its size")):
        found.append(_figure(f"Error of the stamp, {name}, µs", result, ("tcp", "stamp_error_us", key)))
    found.append(
        _figure("Hand-out to TCP client, p50, µs", result, ("tcp", "hand_out_to_client_us"),
                floor=("loopback_us", "p50"))
    )  # fmt: skip
    for key, name in (("wake_us", "Late at waking"), ("exchange_us", "Exchange")):
        found += [
            _figure(
                f"{name}, {_POINT_NAMES[point]}, µs",
                result,
                ("tcp", "server", key, point),
                floor=(key, point),
            )
            for point in _POINTS
        ]
    found.append(None)
    found += [
        _figure("CPU of server, %", result, ("tcp", "cpu_percent", "server")),
        _figure("CPU of virtual sensor, %", result, ("tcp", "cpu_percent", "sensor")),
        _figure("Memory of server, MB", result, ("tcp", "rss_mb", "server")),
    ]
    for node in sorted(get(result, "project", "ros", "cpu_percent") or {}):
        if node.startswith("node"):
            found.append(_figure(f"CPU of {node}, %", result, ("ros", "cpu_percent", node)))
            found.append(_figure(f"Memory of {node}, MB", result, ("ros", "rss_mb", node)))
    return found


def get(content: Any, *path: str) -> Any:
    """What is there in nested tables; None where anything is missing."""
    for key in path:
        if not isinstance(content, Mapping):
            return None
        content = content.get(key)
    return content


def _counts(name: str, result: Mapping[str, Any], chain: str, key: str) -> tuple[str, ...]:
    texts = []
    for program in ("project", "note"):
        value, made = get(result, program, chain, key), get(result, program, chain, "made")
        if value is None:
            texts.append(_NONE)
        elif key in {"lost", "repeated"} and value:
            texts.append(f"{value} ({value / made:.2%})")
        else:
            texts.append(str(value))
    return (name, *texts, "", "", "")


def _figure(
    name: str, result: Mapping[str, Any], path: tuple[str, ...], floor: tuple[str, ...] | None = None
) -> tuple[str, ...]:
    project, note = get(result, "project", *path), get(result, "note", *path)
    least = get(result, "floor", *floor) if floor else None
    return (name, _text(project), _text(note), _text(least), _ratio(project, least), _ratio(note, project))


def _text(value: float | None) -> str:
    return _NONE if value is None else f"{value:.1f}"


def _ratio(value: float | None, unit: float | None) -> str:
    return f"{value / unit:.1f}" if value is not None and unit is not None and unit > 0 else ""
