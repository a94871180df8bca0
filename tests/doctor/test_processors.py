"""Rights, and the processors, on made-up machines."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor.finding import CannotLookError
from ethercat_server.doctor.machine import as_list, processor_list
from tests.doctor.made_up import CPUS, Files, looks, machine, only

NO_RIGHTS = {"/proc/self/status": "CapEff:\t0000000000000000\n"}


def test_capabilities(tmp_path: Path) -> None:
    assert only("capabilities", machine(tmp_path / "a")).level is Level.GOOD
    none = only("capabilities", machine(tmp_path / "b", NO_RIGHTS))
    assert none.level is Level.NOTE
    assert none.values["missing"] == ["CAP_NET_ADMIN", "CAP_NET_RAW", "CAP_IPC_LOCK", "CAP_SYS_NICE"]
    assert none.commands == ("sudo ethercat-doctor ens5",)
    some = only("capabilities", machine(tmp_path / "c", {"/proc/self/status": f"CapEff:\t{3 << 12:016x}\n"}))
    assert "less steady cycle" in some.why
    with pytest.raises(CannotLookError):
        only("capabilities", machine(tmp_path / "d", {"/proc/self/status": "Name: x\n"}))


def test_limits_matter_only_without_the_capabilities(tmp_path: Path) -> None:
    assert only("limits", machine(tmp_path / "a")).level is Level.GOOD
    found = only("limits", machine(tmp_path / "b", NO_RIGHTS))
    assert (found.level, found.found) == (Level.NOTE, "rtprio 0 and memlock 8192 KiB")
    assert "rtprio 99" in found.commands[0]
    enough = "Max locked memory  unlimited unlimited bytes\nMax realtime priority 99 99\n"
    assert (
        only("limits", machine(tmp_path / "c", {**NO_RIGHTS, "/proc/self/limits": enough})).level
        is Level.GOOD
    )


def test_governors(tmp_path: Path) -> None:
    assert only("governor", machine(tmp_path / "a")).level is Level.GOOD
    mixed = only("governor", machine(tmp_path / "b", {f"{CPUS}/cpu2/cpufreq/scaling_governor": "powersave"}))
    assert (mixed.level, mixed.found) == (Level.LOOK, "performance on 3, powersave on 1")
    assert mixed.commands == (f"echo performance | sudo tee {CPUS}/cpu*/cpufreq/scaling_governor",)
    none = {f"{CPUS}/cpu{n}/cpufreq/scaling_governor": None for n in range(4)}
    assert only("governor", machine(tmp_path / "c", none)).values == {"governors": []}


DEEP: Files = {
    f"{CPUS}/cpu1/cpuidle/state2/latency": "40", f"{CPUS}/cpu1/cpuidle/state2/name": "C3",
    f"{CPUS}/cpu1/cpuidle/state3/latency": "170", f"{CPUS}/cpu1/cpuidle/state3/name": "C8",
}  # fmt: skip


def test_idle_states(tmp_path: Path) -> None:
    light = only("idle states", machine(tmp_path / "a"))
    assert (light.level, light.values["latency_us"]) == (Level.GOOD, 2)
    deep = only("idle states", machine(tmp_path / "b", DEEP))
    assert (deep.level, deep.found) == (Level.LOOK, "C8, 170 µs to wake")
    assert deep.commands == tuple(f"echo 1 | sudo tee {CPUS}/cpu*/cpuidle/state{n}/disable" for n in (2, 3))
    disabled = {**DEEP, f"{CPUS}/cpu1/cpuidle/state3/disable": "1"}
    assert only("idle states", machine(tmp_path / "c", disabled)).level is Level.NOTE


def test_a_program_that_holds_the_latency_keeps_the_processors_awake(tmp_path: Path) -> None:
    held: Files = {**DEEP, "/dev/cpu_dma_latency": struct.pack("=i", 0)}
    found = only("idle states", machine(tmp_path / "a", held))
    assert (found.level, found.values["limit_us"], found.values["latency_us"]) == (Level.GOOD, 0, 0)
    usual: Files = {**DEEP, "/dev/cpu_dma_latency": struct.pack("=i", 2_000_000_000)}
    assert only("idle states", machine(tmp_path / "b", usual)).level is Level.LOOK
    cut: Files = {**DEEP, "/dev/cpu_dma_latency": b"\0"}
    assert only("idle states", machine(tmp_path / "c", cut)).level is Level.LOOK


def test_isolation(tmp_path: Path) -> None:
    apart = only("isolation", machine(tmp_path / "a"))
    assert (apart.level, apart.values["isolated"]) == (Level.GOOD, [3])
    none = only(
        "isolation", machine(tmp_path / "b", {f"{CPUS}/isolated": "\n", f"{CPUS}/nohz_full": "(null)\n"})
    )
    assert none.level is Level.NOTE
    assert "isolcpus=managed_irq,domain,3" in none.why
    assert none.values["nohz_full"] == ""
    sibling = only(
        "isolation", machine(tmp_path / "c", {f"{CPUS}/cpu3/topology/thread_siblings_list": "1,3"})
    )
    assert sibling.level is Level.NOTE
    assert "1 shares a core" in sibling.found
    single = only("isolation", machine(tmp_path / "d", {f"{CPUS}/online": "0"}))
    assert single.level is Level.LOOK


@pytest.mark.parametrize(
    ("files", "named"),
    [
        ({"/proc/cpuinfo": "flags\t: fpu hypervisor sse\n"}, "Dell Inc."),
        ({"/sys/hypervisor/type": "xen\n"}, "xen"),
        ({"/sys/class/dmi/id/product_name": "KVM Virtual Machine\n"}, "KVM Virtual Machine"),
    ],
)
def test_virtual_machines(tmp_path: Path, files: dict[str, str], named: str) -> None:
    found = only("virtualization", machine(tmp_path, files))
    assert found.level is Level.LOOK
    assert named in found.found


@pytest.mark.parametrize(
    ("files", "named"),
    [
        ({"/proc/1/environ": "PATH=/bin\0container=lxc\0"}, "lxc"),
        ({"/run/systemd/container": "systemd-nspawn\n"}, "systemd-nspawn"),
        ({"/.dockerenv": ""}, "docker"),
    ],
)
def test_containers(tmp_path: Path, files: dict[str, str], named: str) -> None:
    found = only("virtualization", machine(tmp_path, files))
    assert (found.level, found.values["container"]) == (Level.NOTE, named)


def test_a_container_in_a_virtual_machine_is_both(tmp_path: Path) -> None:
    both = machine(tmp_path, {"/.dockerenv": "", "/proc/cpuinfo": "flags : hypervisor\n"})
    assert [finding.level for finding in looks("virtualization", both)] == [Level.NOTE, Level.LOOK]
    assert only("virtualization", machine(tmp_path / "own")).level is Level.GOOD


def test_lists_of_processors() -> None:
    assert processor_list("0-2,5\n") == [0, 1, 2, 5]
    assert processor_list("") == []
    assert as_list([5, 0, 2, 1, 1]) == "0-2,5"
    assert as_list([]) == ""
    for text in ("x", "1-", "-1", "0-99999999999"):
        with pytest.raises(CannotLookError):
            processor_list(text)
