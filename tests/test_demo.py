"""What the demo shows, and how it judges."""

from __future__ import annotations

import math
import os
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from scripts.demonstration import program
from scripts.demonstration.program import Shown
from tests.ended import completed

PERIOD_NS, AGE_NS = 1_250_000, 400_000


def arrive(shown: Shown, *numbers: int, late_ns: int = 0, value: float = 1.0) -> Shown:
    """Messages of the samples with these numbers, each 0.4 ms old."""
    for number in numbers:
        sec, nanosec = divmod(10**18 + number * PERIOD_NS, 10**9)
        x_y_z = SimpleNamespace(x=value, y=-2.0, z=0.5)
        message: Any = SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec)),
            wrench=SimpleNamespace(force=x_y_z, torque=x_y_z),
        )
        at_ns = number * PERIOD_NS + AGE_NS + late_ns
        shown.take(message, 10**18 + at_ns - late_ns, at_ns)
    return shown


def told(shown: Shown, number: int, count: int) -> None:
    """The node has published so many messages, up to that of this sample."""
    said = {"stamp_ns": 10**18 + number * PERIOD_NS, "count": count, "rate_hz": 800.0}
    values = [SimpleNamespace(key=key, value=str(value)) for key, value in said.items()]
    shown.published(SimpleNamespace(status=[SimpleNamespace(name="/wrench", values=values)]))


def test_a_line_is_of_the_messages_since_the_last_and_says_when_none_came() -> None:
    shown = arrive(Shown(), *range(801))
    assert shown.line() == (
        "  800.0 Hz  lost 0, missing 0  age 0.40 ms  N +1.00 -2.00 +0.50  Nm +1.00 -2.00 +0.50"
    )
    assert shown.line() == "    0.0 Hz  lost 0, missing 0  nothing arrived"
    assert arrive(shown, 802, 804).line().startswith("  400.0 Hz")


def test_the_summary_tells_what_was_lost_on_the_way_and_what_was_never_published() -> None:
    shown = arrive(Shown(), *range(10))
    told(shown, 5, 100)
    arrive(shown, *range(10, 20), *range(25, 801))  # five are missing, of which the node published two
    told(shown, 30, 122)
    arrive(shown, 801)
    assert shown.verdict(800.0) is None
    rate, *sentences = shown.summary(800.0)
    assert rate == f"{796e3 / 801 / 1.25:.1f} messages/s arrived, of the sensor's 800 samples/s"
    assert sentences == [
        "received 797, lost 2, missing 5",
        "age p50 0.4 ms, p99 0.4 ms, longest 0.4 ms",
        "the queue was too short for a pause of this process: raise the depth to 100",
        "3 samples were not published: see the node's /diagnostics",
        "other programs had the processors for some time: docs/tuning.md helps",
    ]


@pytest.mark.parametrize(
    ("numbers", "value", "words"),
    [
        ([], 1.0, "nothing arrived on the ROS topic"),
        (range(800), math.inf, "a message held a number that is not finite"),
        (range(0, 800, 2), 1.0, "400.0 messages/s arrived and the sensor makes 800 samples/s"),
        (range(0, 800), 1.0, None),
    ],
)
def test_what_is_wrong_is_one_sentence(numbers: list[int], value: float, words: str | None) -> None:
    assert arrive(Shown(), *numbers, value=value).verdict(800.0) == words


def test_a_pause_is_no_fault_and_is_told() -> None:
    """As of a laptop that slept."""
    shown = arrive(arrive(Shown(), *range(801)), *range(801, 1602), late_ns=30 * 10**9)
    assert shown.rate.hz == pytest.approx(800)
    assert shown.verdict(800.0) is None
    assert "for 30 s no message came; the rate is that of the rest" in shown.summary(800.0)


@pytest.mark.parametrize("text", ["abc", "", "0.1", "nan", "inf"])
def test_a_wrong_time_is_refused(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["demo", "--seconds", text])
    with pytest.raises(SystemExit):
        program._demo()
    assert "must be a number of seconds from 0.5" in capsys.readouterr().err


@pytest.mark.parametrize("closed", ["", "<&-", ">&-", "<&- >&- 2>&-"])
def test_it_runs_with_closed_streams_and_without_unicode(closed: str) -> None:
    script = (
        "import sys; from scripts.chain import stoppable; "
        "run = lambda: print(chr(178), sys.stdin.isatty(), flush=True) or 5; "
        "sys.exit(stoppable(run, 'demo', '', 0))"
    )
    ascii_only = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = completed("sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", script, env=ascii_only)
    assert (done.returncode, done.stderr) == (5, "")
    assert done.stdout == ("" if ">" in closed else "\\xb2 False\n")
