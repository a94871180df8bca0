"""For all tests: isolation of runs and workers, seeds of random tests, the summary of what was not tested."""

from __future__ import annotations

import atexit
import gc
import os
import random
import re
import shutil
import signal
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from scripts.chain import loopback_up
from tests.ended_with_the_run import end_all_with_this_process
from tests.exception_cycles import no_exception_cycles

_DOMAINS = 101
"""ROS domains whose ports every system leaves free."""
_OPERATORS = {"and", "or"}


def _choose_domain() -> None:
    """A ROS domain for each of pytest's workers, whatever the run's is."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    base = int(os.environ.get("ROS_DOMAIN_ID") or random.randrange(_DOMAINS))
    os.environ["ROS_DOMAIN_ID"] = str((base + worker * (_DOMAINS // 3)) % _DOMAINS)


_choose_domain()
end_all_with_this_process()
# Programs started here have the signals of a shell's, also where nohup ignores this one.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
# The servers started here stay the user that the tests are, whose files they read.
os.environ.pop("SUDO_UID", None)
# And what they keep of virtual sensors is nobody's.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="ethercat-state-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)
# Nor do they use the server that this user has chosen.
os.environ["BOTA_SERVER"] = "localhost:12001"
# NumPy's threads spin while they wait for each other: with one the same takes half of the CPU time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# A tenth of the time goes into looking for cycles among what was imported and collected, which all stays.
gc.set_threshold(20_000, 10, 10)
if "TEST_NAMESPACE" in os.environ:  # scripts/test made a network namespace, in which loopback is down
    loopback_up()
# Without a deadline: how long an example takes is no property of the code, the machine may be busy.
settings.register_profile("fixed", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("fresh", deadline=None, print_blob=True, max_examples=300)
settings.load_profile("fresh" if "TEST_SEED" in os.environ else "fixed")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-k WORD`, skip the files in which the word does not occur: importing all takes seconds."""
    expression = config.option.keyword
    if not re.fullmatch(r"[\w\s()]+", expression) or "not" in expression.split():
        return None
    words = set(re.findall(r"\w+", expression.lower())) - _OPERATORS
    if collection_path.suffix != ".py" or not words:
        return None
    text = str(collection_path).lower() + collection_path.read_text(encoding="utf-8").lower()
    return not any(word in text for word in words) or None


@pytest.fixture(autouse=True)
def _no_exception_cycles() -> Iterator[None]:
    with no_exception_cycles():
        yield


@pytest.fixture(autouse=True)
def _no_blocked_signals() -> Iterator[None]:
    """What a test left blocked, all programs that later tests start would inherit."""
    yield
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    assert not blocked, f"left blocked: {blocked}"


def pytest_collection_finish() -> None:
    gc.freeze()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what was not tested on this machine, and what to install for it."""
    reasons: defaultdict[str, int] = defaultdict(int)
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reasons[reason.removeprefix("Skipped: ")] += 1
    if "TEST_NO_NAMESPACE" in os.environ:
        terminalreporter.write_line(f"not isolated from other programs: {os.environ['TEST_NO_NAMESPACE']}")
    if reasons:
        terminalreporter.section("not tested here")
    for reason, count in sorted(reasons.items(), key=lambda item: -item[1]):
        terminalreporter.write_line(f"{count:4} test{'s' if count > 1 else ' '}: {reason}")
