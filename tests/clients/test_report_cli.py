"""`ethercat-report` as people call it: from a file, from a server, and with what cannot be."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from bota_clients.program import missing
from bota_clients.report import cli, program, subjects
from bota_clients.report.subjects import Received
from bota_ethercat.framing import DataFlag, DataMessage
from tests.clients.recordings import writer
from tests.clients.report_capture import undrawn
from tests.clients.simulated import STARTED_AT_NS, described, simulate
from tests.server.running import PATIENCE_S, free_port
from tests.simulated_links import simulated_bus, simulated_server

SINC, SPLIT = 128, 600


def describe(*rows: object) -> dict[str, object]:
    return {"reply": "describe", "ok": True, "protocol": 1, "sensors": list(rows)}


def record(path: Path, frames: Sequence[DataMessage], *rows: object, end: bool = True) -> Path:
    made = writer(path)
    made.describe(STARTED_AT_NS, describe(*rows))
    for number, frame in enumerate(frames):
        made.frame(frame)
        if number % 1000 == 999:
            made.flush()
    if end:
        made.finish({})
    return path


@pytest.fixture(autouse=True)
def no_plots() -> Iterator[None]:
    """They are tested with the page."""
    with undrawn():
        yield


@pytest.fixture(scope="module")
def frames() -> tuple[DataMessage, ...]:
    return simulate(6, sinc_length=SINC, seed=21)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, frames: tuple[DataMessage, ...]) -> Path:
    return record(tmp_path_factory.mktemp("recorded") / "cell.mcap", frames, described(SINC))


def ended(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, output and errors."""
    try:
        code = cli.main([str(argument) for argument in arguments])
    except SystemExit as exit_:
        code = int(str(exit_.code))
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return code, said.out, said.err


def test_a_recording_becomes_a_page_beside_it(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = ended(capsys, recording, "--note", "cell 3 <b>")
    assert (code, err) == (0, f"ethercat-report: the report is in {recording.with_suffix('.html')}\n")
    assert out == ("Sensor 0 (BFT-SENS-ECAT-M8, serial 4711): Good. All checks passed.\n")
    page = recording.with_suffix(".html").read_text()
    assert "`" not in page
    for words in ("cell.mcap", "4711", "1.3.8", "2026-01-01 00:00:00 UTC", "cell 3 &lt;b&gt;", "✓ Good"):
        assert words in page
    assert not list(recording.parent.glob(".*")), "nothing is left behind"


MADE = """
import sys, types, bota_clients.report
outcome = types.SimpleNamespace(words="Healthy", exit_code=0)
bota_clients.report.program = types.SimpleNamespace(make=lambda *_: outcome)
from bota_clients.report.cli import main
sys.exit(main())
"""
"""The program, but what takes long has been done."""


def test_a_reader_that_has_enough_is_no_traceback() -> None:
    """A process, because Python flushes its output at the very end."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing) as broken:
        done = subprocess.run(
            [sys.executable, "-c", MADE, "a.mcap", "-o", "r.html"],
            stdout=broken, stderr=subprocess.PIPE, text=True, check=False, timeout=PATIENCE_S,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "ethercat-report: the report is in r.html\n")


@pytest.mark.parametrize(
    ("command", "code", "word"),
    [("warn 0x20", 0, "look"), ("warn 0x40", 1, "trouble")],
)
def test_the_exit_code_is_the_verdict(
    command: str, code: int, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = record(tmp_path / "bad.mcap", simulate(6, command, seed=3, sinc_length=256), described(256))
    out = tmp_path / "r.html"
    found, said, _ = ended(capsys, made, "-o", out, "--json")
    assert found == code
    [sensor] = json.loads(said)
    assert sensor["verdict"] == word
    assert [check["check"] for check in sensor["checks"] if check["outcome"] != "good"] == ["Warnings"]
    assert out.exists()


def test_too_short_a_recording_is_not_conclusive(
    frames: tuple[DataMessage, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = record(tmp_path / "short.mcap", frames[:500], described(SINC))
    code, out, _ = ended(capsys, made)
    assert code == 0
    assert "Not conclusive" in out
    assert "Record for at least 10 s" in out


def test_the_longest_stretch_of_the_same_settings_counts(
    frames: tuple[DataMessage, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = writer(tmp_path / "changed.mcap")
    other = described(256, fir=True)
    made.describe(STARTED_AT_NS, describe(other))
    event = {"event": "reconfigured", "sensor": 0, "settings": described(SINC)["settings"]}
    for frame in frames[:SPLIT]:
        made.frame(frame)
    # When it was received says nothing about when a sample was taken: the clocks differ, and it came late.
    made.event(frames[SPLIT + 60].stamp_ns, event)
    for frame in frames[SPLIT:]:
        made.frame(frame)
    made.describe(frames[-1].stamp_ns, describe(described(SINC)))
    made.finish({})
    code, _, _ = ended(capsys, tmp_path / "changed.mcap", "-o", tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert code == 0, "the settings are those that were in force"
    assert "The settings were changed 1 time while" in page
    assert "reconfigured (1)" in page
    assert f"{len(frames) - SPLIT:,} samples".replace(",", " ") in page


def test_a_change_of_settings_is_no_fault_of_the_sensor(
    frames: tuple[DataMessage, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = writer(tmp_path / "changed.mcap")
    made.describe(STARTED_AT_NS, describe(described(SINC)))
    changing = len(frames) - 20  # 50 ms, in which the sensor is not in OP
    for number, frame in enumerate(frames):
        made.frame(frame if number < changing else frame._replace(flags=DataFlag.INVALID))
    other = described(256)
    made.event(frames[-1].stamp_ns, {"event": "reconfigured", "sensor": 0, "settings": other["settings"]})
    later = 10**9 + frames[-1].stamp_ns - frames[0].stamp_ns
    for number, frame in enumerate(simulate(3, sinc_length=256, seed=4)):
        moved = frame.stamp_ns + later, frame.monotonic_ns + later
        made.frame(
            frame._replace(stamp_ns=moved[0], monotonic_ns=moved[1], flags=0 if number else DataFlag.GAP)
        )
        if number == 10:
            made.describe(moved[0], describe(other))
    made.finish({})
    code, out, _ = ended(capsys, tmp_path / "changed.mcap", "-o", tmp_path / "r.html")
    assert (code, "Good" in out) == (0, True)
    page = (tmp_path / "r.html").read_text()
    assert "The settings were changed 1 time while" in page
    assert f"{changing:,} samples".replace(",", " ") in page


def test_a_sensor_that_was_exchanged_is_not_taken_for_the_other(
    frames: tuple[DataMessage, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = writer(tmp_path / "swapped.mcap")
    made.describe(STARTED_AT_NS, describe(described(SINC)))
    for frame in frames[:SPLIT]:
        made.frame(frame)
    made.describe(frames[SPLIT].stamp_ns, describe({**described(SINC), "serial": 99, "firmware": "2.0.0"}))
    for frame in frames[SPLIT:]:
        made.frame(frame)
    made.finish({})
    path, page = tmp_path / "swapped.mcap", tmp_path / "r.html"
    code, out, _ = ended(capsys, path, "-o", page)
    assert (code, "serial 99): Good" in out) == (0, True)
    for words in ("The sensor was exchanged while", "serial 4711, firmware 1.3.8;", "2.0.0"):
        assert words in page.read_text()
    assert f"{len(frames) - SPLIT:,} samples".replace(",", " ") in page.read_text()
    assert "The settings were changed" not in page.read_text()
    _, out, _ = ended(capsys, path, "-o", page, "--force", "--sensor", "serial:4711")
    assert "serial 4711): Not conclusive" in out
    assert f"{SPLIT} samples" in page.read_text()
    _, _, err = ended(capsys, path, "-o", page, "--force", "--sensor", "serial:7")
    assert "serial 4711), 0 (BFT-SENS-ECAT-M8, serial 99)" in err


def test_a_sensor_that_was_not_to_be_recorded_is_not_judged(
    frames: tuple[DataMessage, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, page = tmp_path / "one.mcap", tmp_path / "r.html"
    made = writer(path, sensors="0 4")
    rows = [{**described(SINC), "sensor": position, "serial": 100 + position} for position in (0, 1, 2)]
    made.describe(STARTED_AT_NS, describe(*rows))
    for frame in frames:
        made.frame(frame)
    made.finish({})
    code, out, _ = ended(capsys, path, "-o", page)
    assert (code, out.count("serial")) == (0, 1)
    assert "Not recorded, because others were chosen: sensor 1 and 2." in page.read_text()
    code, _, err = ended(capsys, path, "-o", page, "--force", "--sensor", "1")
    assert (code, "has no sensor 1: it has 0 (BFT-SENS-ECAT-M8, serial 100)\n" in err) == (1, True)


def test_a_recording_that_was_cut_off_is_reported_on_as_far_as_it_goes(
    frames: tuple[DataMessage, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = record(tmp_path / "cut.mcap", frames, described(SINC), end=False)
    code, out, _ = ended(capsys, made)
    assert code == 0
    for said in (out, made.with_suffix(".html").read_text(), ended(capsys, made, "--json", "--force")[1]):
        assert "The recording was cut off: it has no footer" in said


def test_sensors_are_chosen_by_place_serial_or_name(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.html"
    code, _, err = ended(capsys, recording, "-o", out, "--sensor", "serial:9")
    assert (code, out.exists()) == (1, False)
    assert "has no sensor serial:9: it has 0 (BFT-SENS-ECAT-M8, serial 4711)" in err
    assert ended(capsys, recording, "-o", out, "--sensor", "serial:4711")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["localhost:12001"], "is a server's address, no recording: write --server localhost:12001"),
        (["a.mcap", "--server", "localhost:1"], "give a recording, or --server"),
        (["a.mcap", "--seconds", "5"], "--seconds is for listening"),
        (["--server", "localhost:x"], "HOST:PORT"),
        (["--server", "localhost", "--seconds", "0"], "from 1 to"),
        (["--server", "localhost", "--seconds", "nan"], "from 1 to"),
        (["a.mcap", "-o", "a.mcap"], "would overwrite the recording"),
        (["a.mcap", "--sensor", ""], "must be"),
    ],
)
def test_wrong_usage(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = ended(capsys, *arguments)
    assert code == 2
    assert words in err


def test_what_cannot_be_read_or_written_is_said_in_a_sentence(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("no recording")
    for arguments in (
        [tmp_path / "no.mcap"],
        [text],
        [tmp_path],
        [recording, "-o", tmp_path / "no" / "r.html"],
    ):
        code, out, err = ended(capsys, *arguments)
        assert (code, out) == (1, "")
        assert re.fullmatch(r"ethercat-report: [^\n]+\n", err)
    kept = tmp_path / "kept.html"
    kept.mkdir()
    assert ended(capsys, recording, "-o", kept)[0] == 1
    assert not list(tmp_path.glob(".*")), "nothing half-written is left"
    assert "text.mcap exists: choose another name, or use --force" in ended(capsys, recording, "-o", text)[2]
    assert text.read_text() == "no recording"


def test_no_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = ended(capsys, "--server", f"localhost:{free_port()}", "-o", tmp_path / "r.html")
    assert code == 1
    assert "start ethercat-server" in err


def test_ctrl_c_leaves_nothing(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(program, "render", interrupted)
    code, _, err = ended(capsys, recording, "-o", tmp_path / "r.html")
    assert (code, err) == (1, "ethercat-report: stopped: no report was written\n")
    assert not list(tmp_path.iterdir())


def test_what_is_not_installed_is_said(recording: Path) -> None:
    script = (
        "import sys; sys.modules['matplotlib'] = None; "
        "from bota_clients.report.cli import main; "
        f"sys.exit(main([{str(recording)!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert missing("matplotlib") in done.stderr
    assert "Traceback" not in done.stderr


def test_received_frames_are_told_apart_by_sensor(frames: tuple[DataMessage, ...]) -> None:
    received = Received()
    received.all.extend([frames[0], frames[1]._replace(sensor=1), frames[2]])
    assert [frame.sequence for frame in received.frames(0)] == [frames[0].sequence, frames[2].sequence]
    assert len(list(received.frames())) == 3


def test_a_live_sensor_is_reported_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "live.html"
    with simulated_bus("--sinc", "512") as bus, simulated_server(bus) as server:
        monkeypatch.setattr(subjects, "time", SimpleNamespace(monotonic=lambda: bus.clock.now_ns * 1e-9))
        code, said, err = ended(capsys, "--server", server.address, "--seconds", "5", "-o", out, "--json")
        assert code == 0, err
        [sensor] = json.loads(said)
        assert sensor["source"] == server.address
        assert {check["outcome"] for check in sensor["checks"]} == {"good"}
        assert "BFT-SENS-ECAT-M8" in out.read_text()
        code, _, err = ended(capsys, "--server", server.address, "--sensor", "7", "-o", tmp_path / "no.html")
    assert code == 1
    assert "has no sensor 7: it has 0 (BFT-SENS-ECAT-M8" in err
