"""What the sampling clocks make of the real traces in this folder: one line of figures for each."""

from __future__ import annotations

import gzip
import json
from collections import Counter
from pathlib import Path
from typing import Final

from ethercat_server.sampling.replay import Trace
from ethercat_server.sampling.trace import RecordKind

FOLDER: Final = Path(__file__).parent
NAMES: Final = ("quiet", "loops", "slow", "stalls", "lies", "unplugged")
DECISIONS: Final = FOLDER / "decisions.json"


def trace(name: str) -> Trace:
    return Trace(gzip.decompress((FOLDER / f"{name}.trace.gz").read_bytes()))


def decisions(name: str) -> dict[str, int]:
    """Counts of samples and exchanges; ages of samples in µs."""
    steps = list(trace(name).replay(anew=True))
    kinds = Counter(step.record.kind for step in steps)
    new = [step for step in steps if step.record.kind is RecordKind.FRESH]
    ages = sorted(
        step.record.sent_ns + step.record.duration_ns - step.instant_ns for step in new if step.locked
    )
    return {
        "samples": len(new),
        "polls_without_sample": kinds[RecordKind.READ],
        "invalid": kinds[RecordKind.INVALID],
        "lost": sum(max(0, step.steps - 1) for step in new),
        "put_right": sum(step.steps < 1 for step in new),
        "uncertain": sum(step.uncertain for step in new),
        "not_followed": sum(not step.locked for step in new),
        "by_events": sum(step.by_events for step in new),
        "age_p50_us": round(ages[len(ages) // 2] / 1e3),
        "age_p99_us": round(ages[len(ages) * 99 // 100] / 1e3),
    }


if __name__ == "__main__":
    DECISIONS.write_text(json.dumps({name: decisions(name) for name in NAMES}, indent=1) + "\n")
