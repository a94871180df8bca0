"""The figures of docs/benchmark.md, between its two comments: a run can renew them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from scripts.benchmarks.results.report import NONE, Row, count, figure, get, headings, programs, title
from scripts.demonstration.child import DemoError

_BETWEEN: Final = re.compile(r"(<!-- measured[^>]*-->\n).*(<!-- end -->)", re.DOTALL)


def renew(path: Path, content: Mapping[str, Any]) -> None:
    """Put what was measured into the page. DemoError if the page has no place for it."""
    text, found = _BETWEEN.subn(
        lambda match: match[1] + measured(content) + match[2], path.read_text(encoding="utf-8")
    )
    if not found:
        raise DemoError(f"{path} has no part between <!-- measured --> and <!-- end -->")
    path.write_text(text, encoding="utf-8")


def measured(content: Mapping[str, Any]) -> str:
    """The answer, the table of the first configuration, and one line for each of them."""
    first = content["configurations"][0]
    machine = content["machine"]
    idle = "with" if content["idle_states"] else "without"
    where = (
        f"{content['date'][:10]}, {machine['cpus_used']} CPUs, Linux {machine['kernel'].split('-')[0]}, "
        f"Python {machine['python']}, {idle} idle states; a hypervisor took {content['stolen_percent']} % of "
        "the time meanwhile."
    )
    return "\n\n".join([answer(first), main_table(first), summary(content["configurations"]), where]) + "\n"


def answer(result: Mapping[str, Any]) -> str:
    """What a person wants to know, in a sentence."""

    def age(program: str) -> str:
        ages = result[program]["tcp"]["age_us"]
        return f"{ages['p50']:,.0f} µs (p99 {ages['p99']:,.0f})"

    others = {
        "yardstick": "a bare C program",
        "driver": "Bota's driver",
        "polling": "polling at a fixed rate",
    }
    beside = "; ".join(f"{text}: {age(name)}" for name, text in others.items() if result.get(name))
    text = f"**Your controller gets a sample {age('project')} after it was measured.**"
    return f"{text} {beside[:1].upper()}{beside[1:]}." if beside else text


def main_table(result: Mapping[str, Any]) -> str:
    """What matters of one configuration."""
    lost = [count(get(result, name, "tcp"), "lost") for name in programs(result)]
    stalls = [count(get(result, name, "tcp"), "lost_in_stops") for name in programs(result)]
    losses = [f"{a}, in stalls {b}" if a not in {"0", NONE} else a for a, b in zip(lost, stalls, strict=True)]
    if "ratio" in result:
        losses.insert(2, "")
    lines = [
        Row("lost", tuple(losses)),
        figure("age p50, µs", result, "tcp", "age_us", "p50"),
        figure("age p99, µs", result, "tcp", "age_us", "p99"),
        figure("age p99.9, µs", result, "tcp", "age_us", "p999"),
        figure("age at a C client p50, µs", result, "c", "age_us", "p50"),
        figure("age at a C client p99, µs", result, "c", "age_us", "p99"),
        figure("stamp error p99, µs", result, "tcp", "stamp_error_us", "p99_absolute"),
        figure("CPU, %", result, "tcp", "cpu_percent", "server"),
        figure("age at a ROS subscriber p50, µs", result, "ros", "age_us", "p50"),
        figure("age at a ROS subscriber p99, µs", result, "ros", "age_us", "p99"),
    ]
    return table([title(result), *headings(result)], [row for row in lines if {*row.cells} - {NONE, ""}])


def summary(results: Sequence[Mapping[str, Any]]) -> str:
    """All configurations: this project, and by the C program."""
    lines = []
    for result in results:
        tcp = result["project"]["tcp"]
        names = ("age_p50", "age_p99", "cpu")
        ratio = {name: get(result, "ratio", "tcp", name, "median") or NONE for name in names}
        lines.append(
            Row(
                title(result),
                (
                    f"{tcp['lost']} of {tcp['made']}",
                    f"{tcp['age_us']['p50']:.0f} / {tcp['age_us']['p99']:.0f}",
                    f"{ratio['age_p50']} / {ratio['age_p99']}",
                    f"{tcp['cpu_percent']['server']:.1f}",
                    f"{ratio['cpu']}",
                ),
            )
        )
    heads = ["this project", "lost", "age p50 / p99, µs", "/ C", "CPU, %", "/ C"]
    return table(heads, lines)


def table(head: Sequence[str], rows: Sequence[Row]) -> str:
    """Markdown."""
    cells = [head, ["---"] * len(head), *([row.name, *row.cells] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)
