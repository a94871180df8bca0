"""docs/sensor-tool.md says what the tables say, and shows every subcommand."""

from __future__ import annotations

from pathlib import Path

from ethercat_server.sensor.objects.dictionary import BY_SETTING
from ethercat_server.tool.cli import COMMANDS
from protocol.sensor.filters import FORCE_TORQUE_FILTERS
from protocol.sensor.meaning import value_meaning
from protocol.settings import SETTINGS

DOCS = (Path(__file__).parent.parent.parent / "docs" / "sensor-tool.md").read_text()


def said(meanings: dict[str, str]) -> list[str]:
    """A line for each value; what all of them end with is said once, at the end."""
    parts = [meaning.split(", ") for meaning in meanings.values()]
    shared = 0
    while shared + 1 < min(map(len, parts)) and len({each[-1 - shared] for each in parts}) == 1:
        shared += 1
    if not shared:
        return [f"{value}: {meaning}" for value, meaning in meanings.items()]
    lines = [f"{value}: {', '.join(each[:-shared])}" for value, each in zip(meanings, parts, strict=True)]
    return [*lines, f"all: {', '.join(parts[0][-shared:])}"]


def settings_table() -> list[str]:
    """The rows of the table of settings, in Markdown."""
    rows = []
    for name, setting in SETTINGS.items():
        entry = BY_SETTING[name]
        if name == "sinc_length":
            values = list(FORCE_TORQUE_FILTERS)
        else:
            values = [True, False] if setting.is_bool else list(setting.choices or ())
        default = "left alone" if setting.default is None else str(setting.default).lower()
        meanings = "<br>".join(said({str(value).lower(): value_meaning(name, value) for value in values}))
        address = f"0x{entry.index:04X}:{entry.subindex}"
        states = ", ".join(entry.access.write_states)
        rows.append(f"| `{name}` | {address} | {states} | {default} | {meanings} |")
    return rows


def test_the_table_of_settings_is_the_datas() -> None:
    table = settings_table()
    assert [row for row in table if row not in DOCS] == [], "\n".join(table)


def test_every_subcommand_is_shown() -> None:
    for name in COMMANDS:
        assert f"$ ethercat-sensor {name}" in DOCS
