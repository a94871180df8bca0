"""Preemption, tick, clock source, real-time throttling and groups on made-up machines."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor.finding import CannotLookError
from tests.doctor.made_up import Files, machine, only

SWITCH = "/sys/kernel/debug/sched/preempt"
SOURCES = "/sys/devices/system/clocksource/clocksource0"
ORDINARY = {
    "/sys/kernel/realtime": None, "/proc/version": "Linux version 6.1.0-amd64 #1 SMP PREEMPT_DYNAMIC",
    "/proc/config.gz": None,
}  # fmt: skip


def config(*options: str) -> bytes:
    return gzip.compress("".join(f"CONFIG_{option}\n" for option in options).encode())


def test_a_real_time_kernel_is_known_by_its_mark_or_its_version(tmp_path: Path) -> None:
    assert only("preemption", machine(tmp_path / "a")).level is Level.GOOD
    marked = machine(tmp_path / "b", {"/proc/version": "Linux version 5.15"})
    assert only("preemption", marked).values == {"model": "rt"}
    assert only("preemption", machine(tmp_path / "c", {"/sys/kernel/realtime": None})).level is Level.GOOD


@pytest.mark.parametrize(
    ("switch", "model", "level"),
    [
        ("none voluntary (full)", "full", Level.NOTE),
        ("none voluntary full (lazy)", "lazy", Level.NOTE),
        ("none (voluntary) full", "voluntary", Level.LOOK),
        ("(none) voluntary full", "none", Level.LOOK),
    ],
)
def test_what_is_in_force_decides(tmp_path: Path, switch: str, model: str, level: Level) -> None:
    found = only("preemption", machine(tmp_path, {**ORDINARY, SWITCH: switch}))
    assert (found.level, found.values["model"], found.values["certain"]) == (level, model, True)
    if level is Level.LOOK:
        assert found.commands == (f"echo full | sudo tee {SWITCH}",)


def test_where_the_switch_is_hidden_the_command_line_or_the_build_tells(tmp_path: Path) -> None:
    asked = machine(tmp_path / "a", {**ORDINARY, "/proc/cmdline": "preempt=none"})
    assert only("preemption", asked).values == {"model": "none", "dynamic": True, "certain": True}
    built: Files = {**ORDINARY, "/proc/config.gz": config("PREEMPT_DYNAMIC=y", "PREEMPT_VOLUNTARY=y")}
    found = only("preemption", machine(tmp_path / "b", built))
    assert found.values == {"model": "voluntary", "dynamic": True, "certain": False}
    assert "cannot be read" in found.found
    assert found.commands[0] == "sudo mount -t debugfs none /sys/kernel/debug"


def test_a_kernel_that_cannot_be_switched_has_to_be_another(tmp_path: Path) -> None:
    files = {
        **ORDINARY, "/proc/version": "Linux version 6.1 #1 SMP", "/boot/config-6.12.0-rt-amd64":
        "CONFIG_PREEMPT_VOLUNTARY=y\n", "/etc/os-release": 'NAME="Ubuntu"\nID=ubuntu\n',
    }  # fmt: skip
    found = only("preemption", machine(tmp_path / "a", files))
    assert (found.level, found.values["certain"]) == (Level.LOOK, True)
    assert "pro enable realtime-kernel" in found.commands[0]
    files["/etc/os-release"] = "ID=debian\n"
    assert only("preemption", machine(tmp_path / "b", files)).commands == (
        "sudo apt install linux-image-rt-amd64",
    )
    old = {**files, "/proc/version": "Linux version 5.4 #1 SMP PREEMPT", "/boot/config-6.12.0-rt-amd64": None}
    assert only("preemption", machine(tmp_path / "c", old)).values["model"] == "full"


def test_a_tick_matters_only_without_fine_timers(tmp_path: Path) -> None:
    fine = only("tick", machine(tmp_path / "a"))
    assert (fine.level, fine.values["hz"]) == (Level.GOOD, 1000)
    coarse = only("tick", machine(tmp_path / "b", timer_resolution_s=0.004))
    assert coarse.level is Level.TROUBLE
    assert "4 ms" in coarse.found
    assert only("tick", machine(tmp_path / "c", {"/proc/config.gz": b"no gzip"})).values["hz"] is None


def test_clock_sources(tmp_path: Path) -> None:
    assert only("clock source", machine(tmp_path / "a")).level is Level.GOOD
    slow = only("clock source", machine(tmp_path / "b", {f"{SOURCES}/current_clocksource": "hpet"}))
    assert slow.level is Level.LOOK
    assert slow.commands == (f"echo tsc | sudo tee {SOURCES}/current_clocksource",)
    files = {f"{SOURCES}/current_clocksource": "hpet", f"{SOURCES}/available_clocksource": "hpet acpi_pm"}
    assert only("clock source", machine(tmp_path / "c", files)).level is Level.NOTE


@pytest.mark.parametrize(
    ("runtime", "level", "share"),
    [
        ("950000", Level.GOOD, "95 %"),
        ("-1", Level.NOTE, "off"),
        ("0", Level.TROUBLE, "0 %"),
        ("100000", Level.TROUBLE, "10 %"),
    ],
)
def test_throttling(tmp_path: Path, runtime: str, level: Level, share: str) -> None:
    found = only("real-time throttling", machine(tmp_path, {"/proc/sys/kernel/sched_rt_runtime_us": runtime}))
    assert (found.level, share in found.found) == (level, True)
    assert found.commands == (
        () if level is Level.GOOD else ("sudo sysctl kernel.sched_rt_runtime_us=950000",)
    )


def test_real_time_groups(tmp_path: Path) -> None:
    assert only("real-time groups", machine(tmp_path / "a")).level is Level.GOOD
    grouped: Files = {"/proc/config.gz": config("RT_GROUP_SCHED=y")}
    assert only("real-time groups", machine(tmp_path / "b", grouped)).level is Level.NOTE
    switched_off: Files = {**grouped, "/proc/cmdline": "rt_group_sched=0"}
    assert only("real-time groups", machine(tmp_path / "c", switched_off)).level is Level.GOOD
    by_default = {"/proc/config.gz": config("RT_GROUP_SCHED=y", "RT_GROUP_SCHED_DEFAULT_DISABLED=y")}
    assert only("real-time groups", machine(tmp_path / "d", by_default)).level is Level.GOOD
    with pytest.raises(CannotLookError, match="config"):
        only("real-time groups", machine(tmp_path / "e", {"/proc/config.gz": None}))
