"""The public names: what docs/stability.md promises to keep, as the code has it.

python -m tests.public_names    writes them into public_names.txt
"""

from __future__ import annotations

import argparse
import inspect
import re
import tomllib
from pathlib import Path
from typing import Final

import bota_ethercat
from bota_ethercat import client, errors
from bota_ethercat.control import ACTIONS, ErrorCode, Event
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import Sample
from bota_ethercat.settings import SETTINGS
from bota_ethercat_bridge.parameters.table import PARAMETERS

ROOT: Final = Path(__file__).parent.parent
LIST: Final = Path(__file__).with_suffix(".txt")
CPP: Final = ROOT / "clients/cpp/include/bota_ethercat"
HARDWARE: Final = ROOT / "clients/ros2_control/include/bota_ethercat_hardware"
CPP_FUNCTIONS: Final = {"choose_server", "make_real_time", "monotonic_now_ns", "parse_server", "to_string"}
CPP_TYPES: Final = {
    "Channel", "Client", "Condition", "Control", "Counters", "Description", "Felt", "Frame",
    "ImuUnits", "Options", "Reading", "Reconnect", "Sample", "Scheduling", "SensorInfo", "StreamCounts",
    "Subscription", "TareResult", "World",
}  # fmt: skip
"""What docs/cpp.md and docs/world.md tell of; the headers have further names."""


def python() -> set[str]:
    modules = {"bota_ethercat": bota_ethercat, "bota_ethercat.client": client}
    names = {f"{module}.{name}" for module, each in modules.items() for name in each.__all__}
    classes = [each for name in client.__all__ if inspect.isclass(each := getattr(client, name))]
    for each in [*classes, Sample]:
        inherited = {name for base in (tuple, int, Exception) for name in dir(base)}
        members = {*dir(each), *getattr(each, "__annotations__", ())} - inherited
        names |= {f"{each.__name__}.{name}" for name in members if name[0] != "_"}
    return names | {f"bota_ethercat.errors.{name}" for name in dir(errors) if name.endswith("Error")}


def cpp() -> set[str]:
    text = "".join(re.sub(r"//.*", "", path.read_text()) for path in sorted(CPP.glob("*.hpp")))
    names = {name for name in CPP_FUNCTIONS if re.search(rf"^inline .*\b{name}\(", text, re.M)}
    names |= set(re.findall(r"^inline constexpr .*\b(k(?!MaxJson)\w+) =", text, re.M))
    declared = re.findall(
        r"^(enum class|class|struct) (\w+)[^;{]*(\{[^\n]*\}|\{\n.*?^\});", text, re.M | re.S
    )
    for kind, name, body in declared:
        if name not in CPP_TYPES:
            continue
        public = body[1:-1].partition("private:")[0].replace("= {}", "")
        while (shorter := re.sub(r"\{[^{}]*\}", ";", public)) != public:  # without what functions do
            public = shorter
        parts = re.split("," if kind == "enum class" else ";", public.replace("public:", ""))
        members = {found[1] for part in parts if (found := re.search(r"(\w+)\s*(?=[(=\[]|$)", part.strip()))}
        names |= {name, *(f"{name}::{member}" for member in members - {name, "operator"})}
    return names


def wire() -> set[str]:
    names = {f"{action} {key}".strip() for action, row in ACTIONS.items() for key in ("", *row.parameters)}
    names |= {f"error {code}" for code in ErrorCode} | {f"event {event}" for event in Event}
    return names | {f"flag {flag.name}" for flag in DataFlag} | {f"setting {each}" for each in SETTINGS}


def hardware() -> set[str]:
    rows = re.findall(r'^    \{"([\w.]+)", "', (HARDWARE / "parameters.hpp").read_text(), re.M)
    (signals,) = re.findall(r"kSignals = \{(.*?)\};", (HARDWARE / "sensor_loop.hpp").read_text(), re.S)
    return {f"parameter {row}" for row in rows} | {
        f"state {each}" for each in re.findall(r'"(\S+)"', signals)
    }


def programs() -> set[str]:
    return set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"])


def public_names() -> list[str]:
    """All but ROS topics and services, which a node that runs has."""
    kinds = {
        "Python": python(), "C++": cpp(), "wire": wire(), "ros2_control": hardware(), "program": programs(),
        "parameter": {row.name for row in PARAMETERS},
    }  # fmt: skip
    return sorted(f"{kind}: {name}" for kind, names in kinds.items() for name in names)


def listed(*, ros: bool) -> list[str]:
    """What public_names.txt has, of topics and services or of all others."""
    return [line for line in LIST.read_text().splitlines() if line.startswith("ROS: ") is ros]


if __name__ == "__main__":
    argparse.ArgumentParser(prog="tests.public_names", description=__doc__).parse_args()
    LIST.write_text("".join(f"{line}\n" for line in sorted([*public_names(), *listed(ros=True)])))
