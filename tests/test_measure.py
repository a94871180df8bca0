"""What the demo measures and how it judges."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, cast

import pytest

from bota_ethercat.client import Connected, Disconnected
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import encode
from scripts.demonstration import measure, program
from scripts.demonstration.measure import Measurement, verdict

PERIOD_NS = 1_250_000


def frame(number: int, flags: int = 0) -> DataMessage:
    return DataMessage(number, 10**18 + number * PERIOD_NS, number * PERIOD_NS, 0, flags, 3, encode(61, {}))


def message(measurement: Measurement, number: int, value: float = 1.0) -> None:
    """Of the sample with this number, 0.4 ms later."""
    stamp_ns = frame(number).stamp_ns
    measurement.add_message(stamp_ns, [value] * 6, stamp_ns + 400_000)


def measured(first: int = 0, count: int = 801) -> Measurement:
    measurement = Measurement(800.0)
    for number in range(first, first + count):
        measurement.add_frame(frame(number))
        message(measurement, number)
    return measurement


def test_a_good_run_of_which_the_last_sample_has_not_come_yet() -> None:
    measurement = measured(100)
    message(measurement, 901)
    summary = measurement.summary()
    assert (summary.messages, summary.lost, summary.repeated, summary.unknown) == (802, 0, 0, 0)
    assert summary.rate_hz == pytest.approx(800)
    assert summary.age_ms == [0.4, 0.4]
    assert verdict(summary, 800) is None
    measurement.begin()
    assert "nothing" in str(verdict(measurement.summary(), 800))


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([(802, 1.0)], None),
        ([(800, 1.0)], "1 messages came twice"),
        ([(802.5, 1.0)], "no sample"),
        ([(802, math.inf)], "not finite"),
    ],
)
def test_each_fault_is_found(messages: list[tuple[int, float]], words: str | None) -> None:
    measurement = measured()
    for number in range(801, 830):
        measurement.add_frame(frame(number))
    for number, value in messages:
        measurement.add_message(10**18 + round(number * PERIOD_NS), [value] * 6, 10**18 + 810 * PERIOD_NS)
    message(measurement, 829)
    summary = measurement.summary()
    assert words in str(verdict(summary, 800)) if words else verdict(summary, 800) is None
    assert summary.lost == (27 if messages[0][0] == 802 else 28)


def test_what_was_withheld_from_the_servers_client_may_be_a_message_and_is_lost_before() -> None:
    measurement = measured()
    message(measurement, 802)
    measurement.add_frame(frame(805, DataFlag.GAP))
    summary = measurement.summary()
    assert (summary.lost_before, summary.unknown, verdict(summary, 800)) == (4, 0, None)
    assert "800.0 messages/s" in str(verdict(measured().summary(), 1600))


def test_the_live_figure_of_what_is_lost_is_the_summarys(
    capsys: pytest.CaptureFixture[str],
) -> None:
    measurement = measured()
    for each in (frame(805, DataFlag.GAP), frame(806)):
        measurement.add_frame(each)
    message(measurement, 806)
    program.show(measurement)
    assert re.match(r" *\d+\.\d Hz  age 0\.40 ms  lost 5  repeated 0  N \+0", capsys.readouterr().out)
    program.print_summary(measurement.summary(), {"rate_hz": 800})
    shown = capsys.readouterr().out
    assert re.search(r"Lost +5\n", shown)
    assert "Samples are missing" in shown


@pytest.mark.parametrize("text", ["abc", "", "0.1", "nan", "inf"])
def test_a_wrong_time_is_refused(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["demo", "--seconds", text])
    with pytest.raises(SystemExit):
        program._demo()
    assert "must be a number of seconds from 0.5" in capsys.readouterr().err


def test_a_connection_that_ends_is_told_and_what_comes_meanwhile_is_not_compared() -> None:
    measurement, told = measured(), deque[str]()
    for number in range(801, 900):
        message(measurement, number)

    class Ended:
        """A client of a server that closes the connection once."""

        turns: Iterator[list[object]] = iter(
            [
                [Connected({}, False, ())],
                [Disconnected("the server closed it", True, True)],
                [Disconnected("refused", True, False)],
                [Connected({}, True, ()), *map(frame, range(900, 950))],
            ]
        )

        def poll_all(self, _: float) -> Sequence[object]:
            if (turn := next(self.turns, None)) is None:
                raise ConnectionFailedError("closed")
            return turn

    program.receive(cast("Any", Ended()), measurement, told)
    for number in range(900, 949):
        message(measurement, number)
    assert [re.sub(r"[(:;].*", "", each) for each in told] == [
        "the connection to the server ended ", "connected again"
    ]  # fmt: skip
    found = measurement.summary()
    assert (found.messages, found.lost, found.lost_before, found.unknown, found.repeated) == (949, 0, 0, 0, 0)


def test_what_came_before_the_first_of_the_other_is_not_lost() -> None:
    measurement = Measurement(800.0)
    for number in range(100):
        measurement.add_frame(frame(number))
    for number in range(50, 100):
        message(measurement, number)
    assert measurement.summary().lost == 0


def test_a_clock_that_is_set_back_and_a_pause_are_no_fault() -> None:
    measurement = measured()
    for number in range(801, 1601):
        moved = frame(number)._replace(stamp_ns=frame(number).stamp_ns - 5 * 10**8)
        measurement.add_frame(moved)
        measurement.add_message(moved.stamp_ns, [1.0] * 6, moved.stamp_ns + 400_000 + 30 * 10**9)
    found = measurement.summary()
    assert (found.lost, found.unknown, found.repeated) == (0, 0, 0)
    assert found.rate_hz == pytest.approx(800)
    assert found.paused_s == pytest.approx(29.5, abs=0.01)
    assert verdict(found, 800) is None


def test_a_topic_that_falls_silent_or_is_another_streams_is_found_in_fixed_memory() -> None:
    measurement = Measurement(800.0)
    for number in range(40_000):
        measurement.add_frame(frame(number))
    assert measurement.summary().lost == 0
    measurement = measured()
    for number in range(801, 40_000):
        measurement.add_frame(frame(number))
    assert measurement.summary().lost == 40_000 - 801 - measure._MOST_WAITING
    measurement = measured()
    for number in range(801, 40_000):
        measurement.add_frame(frame(number))
        message(measurement, number + 0.5)  # type: ignore[arg-type]
    assert "no sample" in str(verdict(measurement.summary(), 800))


def test_the_line_is_of_the_messages_since_the_last_and_says_when_samples_stop(
    capsys: pytest.CaptureFixture[str],
) -> None:
    measurement = measured()
    program.show(measurement)
    program.show(measurement)
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("  800.0 Hz")
    assert "no samples" not in first
    assert second.startswith("    0.0 Hz")
    assert second.endswith("no samples from the server")
    message(measurement, 801)
    message(measurement, 802)
    program.show(measurement)
    assert capsys.readouterr().out.startswith("  800.0 Hz  age 0.40 ms")
