"""What the demo measures and how it judges."""

from __future__ import annotations

import math
import re

import pytest

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import SampleDecoder, encode
from scripts.demonstration import program
from scripts.demonstration.measure import Measurement, verdict
from scripts.demonstration.program import Screen, print_summary

PERIOD_NS = 1_250_000


def frame(number: int, flags: int = 0) -> DataMessage:
    data = encode(61, {"force.x": number, "acceleration.z": 1.0})
    return DataMessage(number, 0, number * PERIOD_NS, 0, flags, 3, data)


def values(number: int) -> list[float]:
    return SampleDecoder(61).decode(frame(number).process_data).array


def measured(count: int = 801) -> Measurement:
    measurement = Measurement(800.0)
    for number in range(count):
        measurement.take_frame(frame(number))
        measurement.take_message(values(number), number * PERIOD_NS + 400_000)
    return measurement


def test_a_good_run_and_another_after_it() -> None:
    measurement = Measurement(800.0)
    for run in range(2):
        measurement.begin()
        for number in range(801 * run, 801 * run + 801):
            measurement.take_frame(frame(number))
            measurement.take_message(values(number), number * PERIOD_NS + 400_000)
        summary = measurement.summary()
        assert (summary.messages, summary.lost, summary.repeated, summary.rate_hz) == (801, 0, 0, 800.0)
        assert summary.age_ms == [0.4, 0.4]
        assert verdict(summary, 800) is None


def test_a_message_is_not_judged_before_its_sample_has_come_or_if_that_was_withheld() -> None:
    measurement = measured()
    measurement.take_message(values(801), 801 * PERIOD_NS + 100_000)
    measurement.take_frame(frame(801))
    assert (measurement.messages, measurement.age_ns) == (802, 100_000)
    measurement.take_message(values(802), 802 * PERIOD_NS + 100_000)
    for number in range(802, 900):  # this process was held up
        measurement.take_frame(frame(number))
    assert (measurement.messages, measurement.summary().all_decoded_right) == (803, True)
    measurement.take_message(values(900), 900 * PERIOD_NS + 100_000)
    for number in range(901, 999):
        measurement.take_frame(frame(number, DataFlag.GAP if number == 901 else 0))
    assert (measurement.messages, measurement.summary().all_decoded_right) == (804, True)


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([values(802)], None),
        ([values(800)], "1 messages came twice"),
        ([[1.5] * 12], "no sample"),
        ([[math.inf] * 12], "not finite"),
    ],
)
def test_each_fault_is_found(messages: list[list[float]], words: str | None) -> None:
    measurement = measured()
    for number in range(801, 830):
        measurement.take_frame(frame(number))
    for message in messages:
        measurement.take_message(message, 810 * PERIOD_NS)
    measurement.take_message(values(829), 829 * PERIOD_NS)
    summary = measurement.summary()
    assert words in str(verdict(summary, 800)) if words else verdict(summary, 800) is None
    assert summary.lost == (27 if words is None else 28)


def test_the_rate_is_judged_and_what_came_before_is_lost_too() -> None:
    assert "800.0 messages/s" in str(verdict(measured().summary(), 1600))
    assert "nothing" in str(verdict(Measurement(800.0).summary(), 800))
    gap = measured()
    gap.take_frame(frame(805, DataFlag.GAP))
    assert gap.summary().lost_before == 4


def test_the_live_figure_of_what_is_lost_is_the_summarys(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    measurement = measured()
    measurement.take_frame(frame(805, DataFlag.GAP))
    measurement.take_frame(frame(806))
    measurement.take_message(values(806), 806 * PERIOD_NS)
    sensor = {"name": "BFT-SENS-ECAT-M8", "serial": 1, "rate_hz": 800}
    Screen(sensor).show(measurement)
    assert "lost 5 " in capsys.readouterr().out
    print_summary(measurement.summary(), sensor)
    shown = capsys.readouterr().out
    assert re.search(r"Lost +│ +5 ", shown)
    assert max(map(len, shown.splitlines())) <= 80, "the terminal would break words"
    assert "Samples are missing" in shown


@pytest.mark.parametrize("text", ["abc", "", "0.1", "nan", "inf"])
def test_a_wrong_time_is_refused(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["demo", "--seconds", text])
    with pytest.raises(SystemExit):
        program._demo()
    assert "must be a number of seconds from 0.5" in capsys.readouterr().err
