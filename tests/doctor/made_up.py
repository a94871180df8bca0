"""Made-up machines: a tree of files in place of /proc and /sys, and facts about an interface."""

from __future__ import annotations

import atexit
import functools
import gzip
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor.finding import Finding
from ethercat_server.doctor.machine import InterfaceFacts, Link, Machine
from ethercat_server.doctor.machine_checks import CHECKS
from ethercat_server.ethercat.nic import Routes

CPUS = "/sys/devices/system/cpu"
CARD = Link(index=7, parent="0000:00:1f.6", counters={"rx_packets": 100}, carrier_changes=2)
FACTS = InterfaceFacts(
    link=CARD,
    names=("lo", "ens5"),
    routes=Routes(),
    settings=(100, "full"),
    driver=("e1000e", "0000:00:1f.6"),
    coalescing={"rx_coalesce_usecs": 0, "tx_coalesce_usecs": 0, "use_adaptive_rx_coalesce": 0},
    offloads={"generic-receive-offload": False, "tcp-segmentation-offload": False},
    eee=(False, False),
)
LIMITS = """Limit                     Soft Limit           Hard Limit           Units
Max locked memory         8388608              8388608              bytes
Max realtime priority     0                    0
"""
Files = Mapping[str, str | bytes | None]
GOOD: Files = {
    "/proc/version": "Linux version 6.12.0-rt-amd64 (x@y) #1 SMP PREEMPT_RT Debian",
    "/proc/cmdline": "quiet isolcpus=3",
    "/proc/config.gz": gzip.compress(
        b"CONFIG_HZ=1000\nCONFIG_PREEMPT_RT=y\n# CONFIG_RT_GROUP_SCHED is not set\n"
    ),
    "/proc/sys/kernel/sched_rt_runtime_us": "950000\n",
    "/proc/sys/kernel/sched_rt_period_us": "1000000\n",
    "/proc/self/status": "Name:\tpython\nCapEff:\t000001ffffffffff\n",
    "/proc/self/limits": LIMITS,
    "/proc/self/net/packet": "sk RefCnt Type Proto Iface R Rmem User Inode\n",
    "/proc/cpuinfo": "flags\t\t: fpu vme de\n",
    "/proc/interrupts": " 0: 9 IO-APIC timer\n 130: 1 2 IR-PCI-MSI-0000:00:1f.6 0-edge ens5\n 131: 7 xhci\n",
    "/proc/irq/130/smp_affinity_list": "0-3\n",
    "/proc/irq/130/effective_affinity_list": "3\n",
    "/proc/77/comm": "irq/130-ens5\n",
    "/proc/77/stat": "77 (irq/130-ens5) S " + " ".join(["0"] * 36) + " 85 1 0\n",
    "/sys/kernel/realtime": "1\n",
    "/sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
    "/sys/devices/system/clocksource/clocksource0/available_clocksource": "tsc hpet acpi_pm\n",
    f"{CPUS}/online": "0-3\n",
    f"{CPUS}/isolated": "3\n",
    f"{CPUS}/nohz_full": "3\n",
    f"{CPUS}/cpu3/topology/thread_siblings_list": "3\n",
    **{f"{CPUS}/cpu{n}/cpufreq/scaling_governor": "performance\n" for n in range(4)},
    **{f"{CPUS}/cpu{n}/cpuidle/state0/latency": "0\n" for n in range(4)},
    **{f"{CPUS}/cpu{n}/cpuidle/state1/latency": "2\n" for n in range(4)},
    **{f"{CPUS}/cpu{n}/cpuidle/state1/name": "C1\n" for n in range(4)},
    "/sys/class/dmi/id/sys_vendor": "Dell Inc.\n",
}
"""Nothing to mend."""


def write(root: Path, files: Files) -> None:
    for name, content in files.items():
        if content is not None:
            path = root / name.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.encode() if isinstance(content, str) else content)


@functools.cache
def good_root() -> Path:
    """The good machine's files, written once."""
    root = Path(tempfile.mkdtemp(prefix="ethercat-machine-"))
    atexit.register(shutil.rmtree, root)
    write(root, GOOD)
    return root


@dataclass
class MadeUp(Machine):
    """Its files are those below `root`, and where there is none, the good machine's."""

    gone: frozenset[str] = frozenset()
    """Files that are not there."""

    def path(self, name: str) -> Path:
        own = super().path(name)
        return own if os.path.lexists(own) or name in self.gone else good_root() / name.lstrip("/")

    def names(self, name: str) -> list[str]:
        good = [
            file.removeprefix(f"{name}/") for file in GOOD.keys() - self.gone if file.startswith(f"{name}/")
        ]
        return sorted({*super().names(name), *(file.partition("/")[0] for file in good)})


def machine(
    root: Path,
    files: Files | None = None,
    facts: InterfaceFacts = FACTS,
    **more: Any,
) -> Machine:
    """The good machine but for these files (None: not there), which are below `root`, and facts."""
    files = files or {}
    write(root, files)
    gone = frozenset(name for name, content in files.items() if content is None)
    return MadeUp("ens5", facts=facts, root=root, release="6.12.0-rt-amd64", gone=gone, **more)


def but(**changes: Any) -> InterfaceFacts:
    """The good facts but for these; `link` takes the changes of the link."""
    if isinstance(changes.get("link"), dict):
        changes["link"] = replace(CARD, **changes["link"])
    return replace(FACTS, **changes)


def looks(name: str, subject: Machine) -> Iterator[Finding]:
    """What a check finds, without the net that catches its faults."""
    (check,) = (check for check in CHECKS if check.name == name)
    return check.look(subject)


def only(name: str, subject: Machine) -> Finding:
    """The same for a check with one finding. A warning says why it matters, and what is bad too."""
    (finding,) = looks(name, subject)
    if finding.level >= Level.NOTE:
        assert finding.why
    return finding
