"""Real-time scheduling in C++: granted, and refused in the words of the Python client."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable

from tests.clients.cpp_programs import SOURCES, build, needs_gxx, patient
from tests.limited import limited, needs_root, skip_if_forbidden

pytestmark = [needs_gxx, patient]


def run(priority: int, cpu: int, limit: Callable[[], None] | None = None) -> tuple[list[int], str]:
    program = build(SOURCES / "real_time.cpp", ())
    command = [str(program), str(priority), str(cpu)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, preexec_fn=limit).stdout
    numbers, refused = said.splitlines()
    skip_if_forbidden(refused)
    return [int(number) for number in numbers.split()], refused


@needs_root
def test_granted() -> None:
    cpu = min(os.sched_getaffinity(0))
    assert run(40, cpu) == ([os.SCHED_FIFO, 40, 40, cpu, 1], "")


def test_refused() -> None:
    numbers, refused = run(40, 9999, limited())
    assert numbers[:4] == [os.SCHED_OTHER, 0, 0, -1]
    assert refused.startswith(
        "CPU 9999; SCHED_FIFO 40 ('rtprio 40' in a file in /etc/security/limits.d, LimitRTPRIO=40 in a "
        "service's unit)"
    )
