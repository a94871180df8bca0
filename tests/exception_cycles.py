"""Finds exceptions that keep themselves alive: such as are in a variable of a frame of their own traceback.

The server's loop runs without a garbage collector, so what it is made of is looked at.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType, TracebackType

_ROOT = Path(__file__).parents[1]
_PACKAGES = tuple(f"{_ROOT / name}/" for name in ("ethercat_server", "protocol"))
# Where a collector runs: what ended a client or a program is kept, once.
_EXCEPT = tuple(
    f"{_ROOT / name}/"
    for name in (
        *(f"ethercat_server/{room}" for room in ("access", "doctor", "tool")),
        "protocol/bota_ethercat/client",
    )
)


@contextlib.contextmanager
def no_exception_cycles() -> Iterator[None]:
    """AssertionError names the lines of the product that made such a cycle within."""
    gc.freeze()  # what there is by now need not be looked through
    was_on = gc.isenabled()
    gc.disable()
    found = list[str]()
    try:
        yield
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        found += exception_cycles(gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.collect()
        if was_on:
            gc.enable()
    assert not found, f"exceptions keep themselves alive, and no collector runs in the loop: {found}"


def exception_cycles(garbage: Iterable[object]) -> list[str]:
    """Where the tracebacks in `garbage` are that are reached from their own frames, not by way of others'."""
    members = {id(each): each for each in garbage}
    found = set[str]()
    for traceback in list(members.values()):
        # By type: isinstance asks a weak proxy for what may be gone.
        if type(traceback) is TracebackType and _is_product(traceback.tb_frame):
            seen, waiting = set[int](), [traceback.tb_frame]
            while waiting:
                each: object = waiting.pop()
                for next_one in gc.get_referents(each):
                    if next_one is traceback:
                        code = traceback.tb_frame.f_code
                        found.add(f"{Path(code.co_filename).relative_to(_ROOT)}:{traceback.tb_lineno}")
                        waiting.clear()
                        break
                    if id(next_one) in members and id(next_one) not in seen and not _is_others(next_one):
                        seen.add(id(next_one))
                        waiting.append(next_one)
    return sorted(found)


def _is_product(frame: FrameType) -> bool:
    name = frame.f_code.co_filename
    return name.startswith(_PACKAGES) and not name.startswith(_EXCEPT)


def _is_others(each: object) -> bool:
    return type(each) is FrameType and not _is_product(each)
