"""How old samples are beside endless loops: when the server hands them out, at a TCP client, and in `wrench`
at a ROS 2 subscriber, each with ordinary and with real-time scheduling.
"""

from __future__ import annotations

import sys
from typing import Final

from scripts.benchmarks.chain import PORT, Chain, Figures, Setup
from scripts.benchmarks.modes.mode import Mode, losses, points

PRIORITY: Final = 40  # of the client, or of node and subscriber: the default of the node's `rt_priority`


def measure(setup: Setup, loops: int) -> list[Figures]:
    """A row for each kind of client and of scheduling."""
    rows = []
    for client in ("TCP", "wrench")[: 1 + setup.ros]:
        for how, priority in (("ordinary", 0), ("real-time", PRIORITY))[: 1 + bool(setup.priority)]:
            name = f"{client}, {how}"
            with Chain(setup, f"{name}, beside {loops} loops") as chain:
                link = chain.server(chain.bus())
                if client == "wrench":
                    chain.node(f"rt_priority:={priority}")
                    recorder = chain.recorder("ros", "--rt-priority", priority)
                else:
                    recorder = chain.recorder("tcp", "--port", PORT, "--rt-priority", priority)
                for number in range(loops):
                    chain.start(f"loop-{number}", sys.executable, "-c", "while True: pass", watch=False)
                usage = chain.record(recorder)
                status = link.ask("status")
                link.close()
                figures, _ = chain.figures(recorder, usage)
            about = {"rate_hz": setup.rate_hz, "loops": loops, "chain": name}
            rows.append({**about, **figures, "hand_out_us": status["sensors"][0]["age_us"]})
    return rows


MODE: Final = Mode(
    "only ages beside N endless loops, ordinary and real-time",
    measure,
    {
        "beside loops": lambda row: f"{row['rate_hz']} Hz, {row['loops']} loops: {row['chain']}",
        "lost (in stalls)": losses,
        "handed out, µs": lambda row: points(row["hand_out_us"]),
        "on arrival, µs": lambda row: points(row["age_us"]),
    },
    argument={"type": int, "choices": range(1, 65), "metavar": "N"},
    page=4,
)
