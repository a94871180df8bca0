"""The figures of docs/benchmark.md, between comments that name them: one run can renew all of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from scripts.benchmarks.modes.cards import SERVERS, Card
from scripts.benchmarks.modes.load import points
from scripts.benchmarks.results.report import NONE, Row, count, figure, get, headings, programs, title
from scripts.demonstration.child import DemoError

_BLOCK: Final = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def check(path: Path) -> None:
    """DemoError if the page cannot be renewed."""
    found = [match[2] for match in _BLOCK.finditer(path.read_text(encoding="utf-8"))]
    if sorted(found) != sorted(BLOCKS):
        raise DemoError(
            f"{path} must have <!-- measured: NAME --> and <!-- end --> once for each of {', '.join(BLOCKS)}"
        )


def renew(path: Path, content: Mapping[str, Any]) -> None:
    """Put what was measured into the page. DemoError if it has not one place for each part."""
    check(path)

    def measured(match: re.Match[str]) -> str:
        there = match[2] == "comparison" or match[2] in content
        figures = BLOCKS[match[2]](content) if there else "Not measured: there was no ROS 2."
        return f"{match[1]}{figures}\n{match[3]}"

    path.write_text(_BLOCK.sub(measured, path.read_text(encoding="utf-8")), encoding="utf-8")


def comparison(content: Mapping[str, Any]) -> str:
    """The answer, the table of the first configuration, and one line for each of them."""
    first = content["configurations"][0]
    machine = content["machine"]
    idle = "with" if content["idle_states"] else "without"
    where = (
        f"All figures on this page are of one run: {content['date'][:10]}, {machine['cpus_used']} CPUs, "
        f"Linux {machine['kernel'].split('-')[0]}, Python {machine['python']}, {idle} idle states. "
        f"A hypervisor took {content['stolen_percent']} % of the time meanwhile."
    )
    return "\n\n".join([answer(first), main_table(first), summary(content["configurations"]), where])


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


def load(content: Mapping[str, Any]) -> str:
    """Ages beside endless loops."""
    found = content["load"]
    lines = [
        Row(
            name,
            (f"{row['lost']} ({row['lost_in_stops']})", points(row["hand_out_us"]), points(row["age_us"])),
        )
        for name, row in found["chains"].items()
    ]
    beside = f"{found['rate_hz']} Hz beside {found['loops']} loops"
    return table([beside, "lost (in stalls)", "handed out, µs", "on arrival, µs"], lines)


def node(content: Mapping[str, Any]) -> str:
    """What the node adds, and how old a message is that comes after everybody had to wait."""
    rates = content["node"]["rates"]
    ages = content["node"]["first_message_age_us"]

    def line(name: str, text: Callable[[Mapping[str, Any]], str]) -> Row:
        return Row(name, tuple(text(rate) for rate in rates))

    def ages_at(rate: Mapping[str, Any], where: str) -> str:
        found = [f"{age:.0f}" for age in rate[f"{where}_age_us"].values()]
        return " / ".join(found[:2])

    lines = [
        line(
            "lost / repeated / decoded wrongly",
            lambda rate: (
                f"{rate['lost']} / {rate['repeated']} / {rate['decoded_wrongly']} of {rate['samples']}"
            ),
        ),
        line("age at a subscriber p50 / p99, µs", lambda rate: ages_at(rate, "ros")),
        line("the same samples at a TCP client, µs", lambda rate: ages_at(rate, "tcp")),
        line("CPU with one topic / all, %", lambda rate: " / ".join(
            f"{rate[topics]['cpu_percent']:.1f}" for topics in ("one", "all"))),
        line("memory, MB", lambda rate: f"{rate['all']['rss_mb']:.0f}"),
    ]  # fmt: skip
    waits = "; ".join(f"{name}: {max(each) / 1000:.1f} ms" for name, each in ages.items())
    heads = ["the node", *(f"{rate['rate_hz']} Hz" for rate in rates)]
    return f"{table(heads, lines)}\n\nAge of the first message after a wait, at most: {waits}."


def slow_cards(content: Mapping[str, Any]) -> str:
    """Slow network cards: the server, and the same with one exchange at a time in parentheses."""
    found: dict[str, dict[str, Mapping[str, Any]]] = {}
    for each in content["cards"]:
        found.setdefault(f"{each['rate_hz']} Hz, {Card(**each['card'])}", {})[each["server"]] = each
    ours, other = SERVERS
    lines = []
    for name, by in found.items():
        this, one = by[ours], by[other]
        error = this["stamp_error_us"]
        lines.append(
            Row(
                name,
                (
                    f"{this['lost_percent']:g} ({one['lost_percent']:g})",
                    f"{this['age_us']['p50']:.0f} ({one['age_us']['p50']:.0f})",
                    f"{abs(error['p50']):.0f} / {error['p99_absolute']:.0f}",
                ),
            )
        )
    heads = ["rate, round trip", f"lost, % ({other})", "age p50, µs", "stamp error p50 / p99, µs"]
    return table(heads, lines)


BLOCKS: Final[dict[str, Callable[[Mapping[str, Any]], str]]] = {
    "comparison": comparison,
    "load": load,
    "node": node,
    "cards": slow_cards,
}
"""By name in the page, and in what was measured."""


def table(head: Sequence[str], rows: Sequence[Row]) -> str:
    """Markdown."""
    cells = [head, ["---"] * len(head), *([row.name, *row.cells] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)
