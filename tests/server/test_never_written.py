"""0x2000, the factory calibration, cannot be written by any path; the virtual sensor counts every attempt."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from bota_ethercat.sensor.sdo_types import SDO_TYPE_NAMES
from ethercat_server.sensor.objects.dictionary import FACTORY_CALIBRATION
from tests.server.bench import Bench
from tests.simulated_links import SimulatedServer, simulated_bus, simulated_server
from tests.simulation import Client
from tests.tool.running import tool_here

WAYS_TO_SAY_IT: tuple[Any, ...] = (0x2000, "0x2000", "8192", "0X2000", "0x02000", "08192", " 8192 ", "8_192")
VALUES = {"string": "x", "bool": True}


def refused(asking: Client, **keys: object) -> str:
    reply = asking.ask("sdo_write", **keys)
    assert reply["ok"] is False, reply
    code: str = reply["error"]["code"]
    return code


def test_the_control_channel_writes_none_of_it() -> None:
    bench = Bench()
    asking = bench.asking
    before = [asking.ask("sdo_read", index=0x2000, subindex=sub)["hex"] for sub in range(58)]
    for subindex in range(256):
        assert refused(asking, index=FACTORY_CALIBRATION, subindex=subindex, hex="00000000") == "denied"
    for kind in SDO_TYPE_NAMES:
        value = VALUES.get(kind, 1)
        assert refused(asking, index=FACTORY_CALIBRATION, subindex=1, type=kind, value=value) == "denied"
    for index in WAYS_TO_SAY_IT:
        assert refused(asking, index=index, subindex=1, hex="00" * 4) in {"denied", "bad_request"}
    for keys in (
        {"index": FACTORY_CALIBRATION, "subindex": 0, "hex": "00" * 112},  # all of it at once
        {"index": FACTORY_CALIBRATION, "subindex": 0, "hex": "00", "complete_access": True},
        {"index": FACTORY_CALIBRATION + 0x10000, "subindex": 1, "hex": "00" * 4},
        {"index": 8192.0, "subindex": 1, "hex": "00" * 4},
        {"name": "Calibration 1", "hex": "00" * 4},
        {"index": 0x8000, "name": "Calibration 1", "hex": "00" * 4},
    ):
        assert refused(asking, **keys) in {"denied", "bad_request"}
    for name in ("Calibration 1", "0x2000:1", "0x2000"):
        reply = asking.ask("configure", settings={name: 1})
        assert reply["error"]["code"] == "bad_request"
    assert before == [asking.ask("sdo_read", index=0x2000, subindex=sub)["hex"] for sub in range(58)]
    assert bench.stats()["calibration_writes"] == 0


def test_no_command_of_the_tool_writes_it(tmp_path: Path) -> None:
    """`simulated_bus` sees to it that none did."""
    address, path = ("--server", SimulatedServer.address), tmp_path / "a.json"
    with simulated_bus("--signal", "rest") as bus, simulated_server(bus):
        tool_here("snapshot", *address, path)
        content = json.loads(path.read_text())
        for row in content["objects"]:
            if row["index"] == "0x2000":
                row["hex"] = "00000000"
        path.write_text(json.dumps(content))
        assert "nothing to restore" in tool_here("restore", *address, path).out
        assert "no setting" in tool_here("apply", *address, "--set", "0x2000:1=1", code=2).err
        tool_here("read", *address, "Calibration")
        tool_here("tare", *address, "--samples", 20)
        tool_here("save", *address)


def test_every_path_to_a_sensor_that_writes_is_guarded() -> None:
    """Whoever takes an `Sdo` wraps it, or only identifies with it; to map process data, objects are read."""
    root = Path(__file__).parents[2] / "ethercat_server"
    for path in root.rglob("*.py"):
        if path.is_relative_to(root / "ethercat") or path.is_relative_to(root / "virtual_sensor"):
            assert ".sdo.write(" not in path.read_text(), path
            continue
        for used in re.findall(r"^.*\b(?:MailboxSdo\(|_ServerSdo\(|slaves\[.*\]\.sdo\b|slave\.sdo\b).*$",
                               path.read_text(), re.MULTILINE):  # fmt: skip
            assert "GuardedSdo(" in used or "identify(" in used or ".sdo.look(" in used, f"{path}: {used}"
