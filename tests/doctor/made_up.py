"""Made-up machines: a tree of files in place of /proc and /sys, and facts about an interface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ethercat_server.access.adapters import Adapter
from ethercat_server.doctor.machine import Host
from ethercat_server.doctor.report import CannotLookError
from ethercat_server.ethercat.nic import Routes

CPUS = "/sys/devices/system/cpu"
CARD = Adapter("ens5", ifindex=7)
Facts = Mapping[str, Any]
FACTS: Facts = {
    "link": CARD,
    "names": ("lo", "ens5"),
    "routes": Routes(),
    "settings": (100, "full"),
    "driver": ("e1000e", "0000:00:1f.6"),
    "coalescing": {"rx_coalesce_usecs": 0, "tx_coalesce_usecs": 0, "use_adaptive_rx_coalesce": 0},
    "EEE": (False, False),
    "between": [""],
    "receivers": [],
}
Files = Mapping[str, str | bytes | None]
GOOD: Files = {
    "/proc/version": "Linux version 6.12.0-rt-amd64 (x@y) #1 SMP PREEMPT_RT Debian",
    "/proc/cmdline": "quiet isolcpus=3",
    "/proc/self/status": "Name:\tpython\nCapEff:\t000001ffffffffff\n",
    "/sys/kernel/realtime": "1\n",
    f"{CPUS}/online": "0-3\n",
    **{f"{CPUS}/cpu{n}/cpufreq/scaling_governor": "performance\n" for n in range(4)},
    **{f"{CPUS}/cpu{n}/cpuidle/state0/latency": "0\n" for n in range(4)},
    **{f"{CPUS}/cpu{n}/cpuidle/state1/latency": "2\n" for n in range(4)},
    **{f"{CPUS}/cpu{n}/cpuidle/state1/name": "C1\n" for n in range(4)},
}
"""Nothing to mend."""


def write(root: Path, files: Files) -> None:
    for name, content in files.items():
        if content is not None:
            path = root / name.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.encode() if isinstance(content, str) else content)


def machine(root: Path, files: Files | None = None, facts: Facts = FACTS) -> Host:
    """The good machine but for these files (None: not there), which are below `root`, and facts."""
    write(root, {**GOOD, **(files or {})})
    return Host("ens5", facts=dict(facts), root=root)


def but(**changes: Any) -> Facts:
    """The good facts but for these: changes of the link; a sentence is why one is unknown."""
    if isinstance(changes.get("link"), dict):
        changes["link"] = replace(CARD, **changes["link"])
    unknown = {name: CannotLookError(why) for name, why in changes.items() if isinstance(why, str)}
    return {**FACTS, **changes, **unknown}
