"""docs/sensor-tool.md shows every setting with its object, and every subcommand."""

from __future__ import annotations

from pathlib import Path

from bota_ethercat.settings import SETTINGS
from ethercat_server.sensor.objects.dictionary import BY_SETTING
from ethercat_server.tool.cli import COMMANDS

DOCS = (Path(__file__).parents[2] / "docs" / "sensor-tool.md").read_text()


def test_every_setting_and_subcommand_is_shown() -> None:
    for name, setting in SETTINGS.items():
        entry = BY_SETTING[name]
        states = ", ".join(entry.access.write_states)
        default = "left alone" if setting.default is None else str(setting.default).lower()
        assert f"\n| `{name}` | 0x{entry.index:04X}:{entry.subindex} | {states} | {default} |" in DOCS
    assert not [name for name in COMMANDS if f"$ ethercat-sensor {name}" not in DOCS]
