"""`ethercat-report` as people call it, and with what cannot be."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import pytest

from bota_clients.report import cli, page, plots
from bota_ethercat.framing import DataFlag, DataMessage
from tests.clients.recordings import write
from tests.clients.simulated import simulate
from tests.descriptions import description, sensor_row
from tests.ended import Result, run_here

SINC, SPLIT = 128, 600


Frames = Sequence[DataMessage]


def reconfigured(row: dict[str, Any]) -> dict[str, object]:
    return {"event": "reconfigured", "sensor": 0, "settings": row["settings"]}


@pytest.fixture(autouse=True)
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are tested with the page."""
    monkeypatch.setattr(plots, "draw", lambda *_: None)


SENSOR: Final = description(sensor_row(sinc_length=SINC))


class Report:
    """The program with one recording: what it prints, and the page."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.path, self.out = folder, folder / "cell.mcap", folder / "cell.html"

    def run(self, *arguments: object) -> Result:
        return run_here(cli.main, *arguments)

    def of(self, *items: Frames | dict[str, object], **options: Any) -> tuple[int, str]:
        """Exit code and output with a recording of these."""
        self.record(*items, **options)
        return self.run(self.path)[:2]

    def record(self, *items: Frames | dict[str, object], **options: Any) -> None:
        """Frames, descriptions and events, in this order."""
        write(self.path, chain(*([item] if isinstance(item, dict) else item for item in items)), **options)

    def again(self, *options: object) -> Result:
        return self.run(self.path, "--force", *options)

    def lacks(self, *words: str) -> list[str]:
        """Those that are not in the page."""
        page = self.out.read_text()
        return [each for each in words if each not in page]


@pytest.fixture
def report(tmp_path: Path) -> Report:
    return Report(tmp_path)


def frames() -> tuple[DataMessage, ...]:
    return simulate(6, sinc_length=SINC, seed=21)


def number(frames: Frames) -> str:
    return f"{len(frames):,} samples".replace(",", " ")


def test_a_recording_becomes_a_page_beside_it(report: Report) -> None:
    report.record(SENSOR, frames())
    code, out, err = report.run(report.path, "--note", "cell 3 <b>")
    assert (code, err) == (0, f"ethercat-report: the report is in {report.out}\n")
    assert out == "Sensor 0 (BFT-SENS-ECAT-M8, serial 100): Good. All checks passed.\n"
    assert "`" not in report.out.read_text()
    words = "cell.mcap", "100", "1.3.8", "2026-01-01 00:00:00 UTC", "cell 3 &lt;b&gt;", "✓ Good"
    assert report.lacks(*words) == []
    assert not list(report.folder.glob(".*")), "nothing is left behind"


@pytest.mark.parametrize(("command", "code", "word"), [("warn 0x20", 0, "look"), ("warn 0x40", 1, "trouble")])
def test_the_exit_code_is_the_verdict(report: Report, command: str, code: int, word: str) -> None:
    report.of(description(sensor_row(sinc_length=256)), simulate(6, command, seed=3, sinc_length=256))
    found, said, _ = report.again("--json")
    [sensor] = json.loads(said)
    assert (found, sensor["verdict"]) == (code, word)
    bad = [check["check"] for check in sensor["checks"] if check["outcome"] != "good"]
    noise = ["Noise of force and torque", "Noise of the IMU"]  # which is not to be had of a faulty sensor
    assert bad == ([] if word == "look" else noise) + ["Warnings"]


def test_too_short_a_recording_is_not_conclusive(report: Report) -> None:
    code, out = report.of(SENSOR, frames()[:500])
    assert (code, "Not conclusive" in out, "Record for at least 10 s" in out) == (0, True, True)


def test_the_longest_stretch_of_the_same_settings_counts(report: Report) -> None:
    # When it was received says nothing about when a sample was taken: the clocks differ, and it came late.
    before = description(sensor_row(sinc_length=256, fir=True))
    code, _ = report.of(
        before, frames()[:SPLIT], reconfigured(SENSOR["sensors"][0]), frames()[SPLIT:], SENSOR
    )
    assert code == 0, "the settings are those that were in force"
    words = "The settings were changed 1 time while", "reconfigured (1)", number(frames()[SPLIT:])
    assert report.lacks(*words) == []


def test_a_change_of_settings_is_no_fault_of_the_sensor(report: Report) -> None:
    changing = len(frames()) - 20  # 50 ms, in which the sensor is not in OP
    lost = [frame._replace(flags=DataFlag.INVALID) for frame in frames()[changing:]]
    later = 10**9 + frames()[-1].stamp_ns - frames()[0].stamp_ns
    after = [
        frame._replace(stamp_ns=frame.stamp_ns + later, monotonic_ns=frame.monotonic_ns + later)
        for frame in simulate(3, sinc_length=256, seed=4)
    ]
    after[0] = after[0]._replace(flags=DataFlag.GAP)
    other = sensor_row(sinc_length=256)
    code, out = report.of(
        SENSOR, frames()[:changing], lost, reconfigured(other), after[:10], description(other), after[10:]
    )
    assert (code, "Good" in out) == (0, True)
    assert report.lacks("The settings were changed 1 time while", number(frames()[:changing])) == []


def test_what_took_a_sensor_off_the_bus_is_what_the_server_said(report: Report) -> None:
    sent = [*frames()]
    sent[1000:1100] = [frame._replace(flags=DataFlag.INVALID) for frame in sent[1000:1100]]
    report.of(SENSOR, sent)
    assert report.lacks("Check its cable and power.") == []
    lost: dict[str, object] = {
        "event": "sensor_lost", "sensor": 0, "reason": "it left OP",
        "message": "sensor 0 is lost: it left OP: this computer stood still for 300 ms",
    }  # fmt: skip
    report.record(SENSOR, sent[:1000], {**lost, "sensor": 1, "message": "another"}, lost, sent[1000:])
    report.again()
    words = "Check its cable", "another", f"The server said: {lost['message']}."
    assert report.lacks(*words) == [*words[:2]]


def test_a_sensor_that_was_exchanged_is_not_taken_for_the_other(report: Report) -> None:
    new = description({**sensor_row(sinc_length=SINC), "serial": 99, "firmware": "2.0.0"})
    code, out = report.of(SENSOR, frames()[:SPLIT], new, frames()[SPLIT:])
    assert (code, "serial 99): Good" in out) == (0, True)
    words = (
        "The sensor was exchanged while",
        "serial 100, firmware 1.3.8;",
        "2.0.0",
        number(frames()[SPLIT:]),
    )
    assert report.lacks(*words, "The settings were changed") == ["The settings were changed"]


def test_a_sensor_that_was_not_to_be_recorded_is_not_judged(report: Report) -> None:
    rows = [sensor_row(position, sinc_length=SINC) for position in (0, 1, 2)]
    code, out = report.of(description(*rows), frames(), sensors="0 4")
    assert (code, out.count("serial")) == (0, 1)
    assert report.lacks("Not recorded, because others were chosen: sensor 1 and 2.") == []


def test_a_recording_that_was_cut_off_is_reported_on_as_far_as_it_goes(report: Report) -> None:
    code, out = report.of(SENSOR, frames(), end=None)
    assert code == 0
    for said in (out, report.out.read_text(), report.again("--json")[1]):
        assert "The recording was cut off (it has no footer" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "required"),
        ("localhost:1", "record its stream first"),
        ("a.mcap -o a.mcap", "would overwrite the recording"),
    ],
)
def test_wrong_usage(report: Report, arguments: str, words: str) -> None:
    code, _, err = report.run(*arguments.split())
    assert (code, words in err) == (2, True)


def test_what_cannot_be_read_or_written_is_said_in_a_sentence(report: Report) -> None:
    report.record(SENSOR, frames())
    text, kept = report.folder / "text.mcap", report.folder / "kept.html"
    text.write_text("no recording")
    kept.mkdir()
    nowhere = report.folder / "no" / "r.html"
    for arguments in (
        [report.folder / "no.mcap"], [text], [report.folder], [report.path, "-o", nowhere],
        [report.path, "-o", kept],
    ):  # fmt: skip
        code, out, err = report.run(*arguments)
        assert (code, out) == (1, "")
        assert re.fullmatch(r"ethercat-report: [^\n]+\n", err)
    assert not list(report.folder.glob(".*")), "nothing half-written is left"
    _, _, err = report.run(report.path, "-o", text)
    assert "text.mcap exists: choose another name, or use --force" in err
    assert text.read_text() == "no recording"


def test_ctrl_c_leaves_nothing(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    report.record(SENSOR, frames())
    monkeypatch.setattr(page, "render", interrupted)
    assert report.run(report.path) == (1, "", "ethercat-report: stopped: nothing was written\n")
    assert list(report.folder.iterdir()) == [report.path]
