"""Pauses, stray stamps, restarts, and what is out of order or there twice: all programs use the rest."""

from __future__ import annotations

import functools
import itertools
import random
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from bota_clients.export import dataset
from bota_clients.export.cli import main as export
from bota_clients.identify.cli import main as identify
from bota_clients.recording.columns import columns
from bota_clients.recording.mcap_writer import DiskFile
from bota_clients.recording.order import TimeAxis, longest_order
from bota_clients.recording.reader import open_recording
from bota_clients.recording.writer import RecordingWriter
from bota_clients.report.checks import Examination
from bota_clients.report.cli import main as report
from bota_clients.report.series import of_recording
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.settings import start_up_defaults
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.quantities import Payload
from tests.bridge.test_soak import size
from tests.clients.bags import imu, write_bag
from tests.clients.recordings import START_NS, describe, frame, write
from tests.clients.test_identify import felt_frames
from tests.compensation import motion
from tests.ended import Result, run_here

SECOND: Final = 10**9
HOURS, YEARS = 36_000 * SECOND, 3 * 366 * 86_400 * SECOND
SETTINGS: Final[dict[str, Any]] = {**start_up_defaults(), "sinc_length": 512}
RATE_HZ, SECONDS = 100, 24
HALF: Final = RATE_HZ * SECONDS // 2
TOOL: Final = Payload(1.5, (0.05, -0.03, 0.07), (0.009, 0.011, 0.006, 0.001, -0.002, 0.001))
OFFSET_S: Final = 17
Frames = list[DataMessage]


@functools.cache
def moving() -> tuple[Frames, motion.Array]:
    """The tool turns freely; and its angular rates."""
    felt = motion.filtered(motion.turned(3), TOOL, SECONDS, SETTINGS)
    return felt_frames(felt), felt.rate


def moved(frames: Frames, rows: slice, ns: int, wall_ns: int | None = None) -> Frames:
    """The stamps of these rows later: of both clocks, or of each by its own."""
    for row in range(*rows.indices(len(frames))):
        stamp_ns = frames[row].stamp_ns + (ns if wall_ns is None else wall_ns)
        frames[row] = frames[row]._replace(stamp_ns=stamp_ns, monotonic_ns=frames[row].monotonic_ns + ns)
    return frames


def reordered(frames: Frames) -> Frames:
    """One comes late, one early, one twice."""
    early, late = frames.pop(HALF + 40), frames.pop(HALF - 40)
    return [*frames[:200], frames[199], *frames[200:HALF], early, late, *frames[HALF:]]


AFTER, ONE = slice(HALF, None), slice(HALF, HALF + 1)
RESTARTED: Final = "the server's machine was restarted 1 time meanwhile, and time goes on by its wall clock"
# What is done to the frames, what is said of it, and of how many samples no use is made.
CHANGES: Final[dict[str, tuple[Callable[[Frames], Frames], str, int]]] = {
    "a pause of an hour": (lambda frames: moved(frames, AFTER, HOURS // 10), "", 0),
    "a pause of ten hours": (lambda frames: moved(frames, AFTER, HOURS), "", 0),
    "a pause of years": (lambda frames: moved(frames, AFTER, YEARS), "", 0),
    "a stamp of years later": (lambda frames: moved(frames, ONE, YEARS), "1 sample out of order left out", 1),
    "a stamp that is no time": (
        lambda frames: moved(frames, ONE, (1 << 64) - 10**12, 0), "1 sample out of order left out", 1,
    ),
    "a stamp of 1970": (
        lambda frames: moved(frames, ONE, -frames[HALF].monotonic_ns), "1 sample out of order left out", 1,
    ),
    "restarted": (lambda frames: moved(frames, AFTER, -11 * SECOND, 60 * SECOND), RESTARTED, 0),
    "restarted without a clock": (lambda frames: moved(frames, AFTER, -11 * SECOND, -HOURS), RESTARTED, 0),
    "reordered": (reordered, "3 samples out of order left out", 2),
}  # fmt: skip


class Made:
    """A recording, a table of frames and a bag in a folder."""

    def __init__(self, folder: Path, change: Callable[[Frames], Frames]) -> None:
        first, rates = moving()
        self.frames = change([*first])
        self.folder, self.recording = folder, folder / "run.mcap"
        row = describe(0, **SETTINGS)
        row["sensors"][0]["rate_hz"] = RATE_HZ
        write(self.recording, [row, *self.frames])
        turned = {id(frame.process_data): rate for frame, rate in zip(first, rates.tolist(), strict=True)}
        self.messages = [
            imu(each.stamp_ns - OFFSET_S * SECOND, turned[id(each.process_data)]) for each in self.frames
        ]

    def run(self, program: str, *arguments: object) -> tuple[Result, int]:
        """A program to its end, and the most memory that it took."""
        main = {"identify": identify, "export": export, "report": report}[program]
        tracemalloc.start()
        try:
            return run_here(main, *arguments), tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    def everything(self) -> dict[str, tuple[Result, int]]:
        """Each program with it."""
        bag, out = write_bag(self.folder / "bag", "/imu", self.messages[::2]), self.folder / "out.npz"
        table = self.folder / "frames.csv"
        table.write_text("\n".join(["timestamp", *(str(each.stamp_ns) for each in self.frames[40:-40:3])]))
        found = {
            "identify": self.run("identify", self.recording, "--json"),
            "delay": self.run("identify", "delay", self.recording, "--json"),
            "csv": self.run("export", self.recording),
            "ros": self.run("export", self.recording, "--ros", self.folder / "ros.mcap"),
            "npz": self.run("export", self.recording, self.folder / "all.npz"),
            "fps": self.run("export", self.recording, self.folder / "fps.npz", "--fps", 30),
            "at": self.run("export", self.recording, out, "--at", table, "--window", 4),
            "align": self.run("export", "align", self.recording, bag, "--topic", "/imu"),
        }
        if self.frames[-1].stamp_ns < self.frames[0].stamp_ns:  # the robot's clock does not show that
            del found["align"]
        return found


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Result, int]]:
    return Made(tmp_path_factory.mktemp("usual"), lambda frames: frames).everything()


@pytest.mark.parametrize("what", CHANGES)
def test_what_lies_between_the_samples_costs_nothing_and_changes_nothing(
    tmp_path: Path, usual: dict[str, tuple[Result, int]], what: str
) -> None:
    change, said, unused = CHANGES[what]
    made = Made(tmp_path, change)
    found = made.everything()
    for name, (ended, peak) in found.items():
        assert ended.code == 0, (name, ended.err)
        assert peak < usual[name][1] + (32 << 20), name  # as of a gap's rows, of which there is a limit
        assert said in ended.err, (name, ended.err)
        assert ("restarted" in ended.err) == ("restarted" in said), (name, ended.err)
        assert ("out of order" in ended.err) == ("out of order" in said) or name == "align", name
    tool = found["identify"][0].json
    assert tool["tool_mass"] == pytest.approx(TOOL.mass, abs=tool["tool_mass_interval"])
    assert tool["tool_inertia"] == pytest.approx(TOOL.inertia, abs=max(tool["tool_inertia_interval"]))
    delay, expected = (each["delay"][0].json["lag_ms"] for each in (found, usual))
    assert delay == pytest.approx(expected, abs=0.3)
    if "align" in found:
        assert found["align"][0].json["offset_ms"] == pytest.approx(OFFSET_S * 1e3, abs=10)
        assert found["align"][0].json["interval_ms"] < 1
    rows = np.load(tmp_path / "all.npz")
    assert (np.diff(rows["monotonic_ns"]) > 0).all()
    assert (
        rows["valid"].sum()
        == len(moving()[0]) - unused
        == len((tmp_path / "run.csv").read_text().splitlines()[1:])
    )
    windows = np.load(tmp_path / "fps.npz")
    assert len(windows["stamp_ns"]) == pytest.approx(SECONDS * 30, abs=40)
    assert windows["force_torque_valid"].mean() > 0.9


@pytest.mark.parametrize("set_back_s", [0.0, 0.5, 3600.0])
def test_rows_and_messages_that_are_in_no_order_are_left_out_and_counted(
    tmp_path: Path, set_back_s: float
) -> None:
    """One late, one early, one twice; the server's clock may be set back at the same time."""
    set_back = round(set_back_s * SECOND)
    made = Made(tmp_path, lambda frames: moved(frames, AFTER, 0, -set_back))
    rows = [each.stamp_ns for each in made.frames[40:-40:4]]
    given = [*rows[:50], rows[70], *rows[50:100], rows[99], *rows[100:150], rows[120], *rows[150:]]
    table, bag = tmp_path / "frames.csv", write_bag(tmp_path / "bag", "/t", [imu(stamp) for stamp in given])
    table.write_text("\n".join(["timestamp", *map(str, given)]))
    for name, *at in ("a.npz", table), ("b.npz", bag, "--topic", "/t"):
        ended = run_here(export, made.recording, tmp_path / name, "--at", *at)
        assert ended.code == 0, ended.err
        said = "windows of 32 samples; 3 frames left out, not later than the row before"
        assert ended.err == f"ethercat-export: {tmp_path / name}: {said}\n"
        assert np.load(tmp_path / name)["stamp_ns"].tolist() == rows
    with table.open("a") as file:
        file.write(f"\n{made.frames[-1].stamp_ns + SECOND}")
    ended = run_here(export, made.recording, tmp_path / "c.npz", "--at", table, "--strict")
    assert f"row {len(given)} of {table} (counted from 0) is of" in ended.err
    bag = write_bag(
        tmp_path / "imu", "/imu", [*made.messages[:9], *made.messages[8:900], *made.messages[890:]]
    )
    ended = run_here(export, "align", made.recording, bag, "--topic", "/imu")
    assert set_back or (ended.json["left_out"] == 11 and "11 messages left out" in ended.err)


def test_the_most_are_kept() -> None:
    """Compared with all choices, of rows that may be at several places."""
    draw = random.Random(1)
    for _ in range(300):
        rows = [draw.sample(range(9), draw.randint(0, 3)) for _ in range(6)]
        most = 0
        for chosen in itertools.product(*([None, *row] for row in rows)):
            taken = [place for place in chosen if place is not None]
            if all(after > before for before, after in itertools.pairwise(taken)):
                most = max(most, len(taken))
        kept = longest_order(rows)
        assert kept.sum() == most, rows
        assert longest_order(row for row, is_kept in zip(rows, kept, strict=True) if is_kept).all()


def again(count: int) -> Iterator[DataMessage]:
    """So many frames of the same motion."""
    first = moving()[0]
    for number in range(count):
        frame, moment_ns = first[number % len(first)], number * SECOND // RATE_HZ
        yield frame._replace(sequence=number, stamp_ns=START_NS + moment_ns, monotonic_ns=moment_ns)


def examine(path: Path) -> None:
    """What a report does before it draws."""
    for subject in of_recording(path, ImuUnits.G_DPS):
        Examination(subject)


@pytest.mark.parametrize("program", [
    examine,
    lambda path: run_here(identify, path, "--json"),
    lambda path: run_here(identify, "delay", path, "--json"),
    lambda path: run_here(export, path, path.with_suffix(".npz"), "--force"),
    lambda path: run_here(export, path, "--mcap", path.with_suffix(".whole.mcap"), "--force"),
])  # fmt: skip
def test_memory_does_not_grow_with_the_length(
    tmp_path: Path, program: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    peaks, path = [], tmp_path / "run.mcap"
    monkeypatch.setattr(dataset, "GROUP", 4096)
    for seconds in (200, 800):
        row = describe(0, **SETTINGS)
        row["sensors"][0]["rate_hz"] = RATE_HZ
        write(path, itertools.chain([row], again(RATE_HZ * seconds)))
        tracemalloc.start()
        program(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # More by buffers that were not full; the samples would take 30 MB.
    assert peaks[1] < max(1.1 * peaks[0], peaks[0] + (4 << 20))


def test_of_a_chunk_little_is_kept_by_who_writes_it_and_who_reads_it(tmp_path: Path) -> None:
    """Two and a half come every second."""
    kept = []
    for count in (200, 1200):
        path = tmp_path / f"{count}.mcap"
        writer = RecordingWriter(disk := DiskFile(path, overwrite=False), "test", {})
        for each in again(count):
            writer.frame(each)
            writer.flush()
        written = size(writer)
        writer.finish({})
        disk.close()
        with open_recording(path) as recording:
            kept.append((written, size(recording)))
    (written, read), (more_written, more_read) = kept
    assert more_written - written < 1000
    assert more_read - read < 1000 * 30


@pytest.mark.parametrize(
    ("seconds", "wall", "places", "restarts"),
    [
        pytest.param((5, 6, 7, 8), (0, 1, 2, 3), (5, 6, 7, 8), 0, id="in order"),
        pytest.param((5, 9, 2, 3, 4), (0, 4, 7, 8, 9), (5, 9, 12, 13, 14), 1, id="restarted"),
        pytest.param((5, 9, 2, 3), (0, 4, 4, 5), (5, 9, 10, 11), 1, id="a second has passed at least"),
        pytest.param((5, 9, 2, 3), (0, 4, -7, -6), (5, 9, 10, 11), 1, id="whatever the wall clock says"),
        pytest.param((5, 9, 2, 9, 10), (0, 4, 7, 8, 9), (5, 9, 12, 19, 20), 1, id="not after it: no stray"),
        pytest.param((5, 9, 2, 10, 11), (0, 4, 4, 5, 6), (5, 9, 10, 10, 11), 0, id="it was a stray"),
        pytest.param((5, 9, 2, 1, 2), (0, 4, 6, 7, 8), (5, 9, 11, 10, 11), 1, id="once only"),
        pytest.param((5, 99, 6, 7), (0, 1, 2, 3), (5, 99, 6, 7), 0, id="one too late is no restart"),
        pytest.param((5, 99, 5, 6), (0, 1, 9, 10), (5, 99, 107, 108), 1, id="unless it falls to before it"),
        pytest.param((5, 6, 5, 6), (0, 1, 2, 3), (5, 6, 5, 6), 0, id="a second is none"),
        pytest.param((5, 9, 1, 8, 0, 1), (0, 4, 5, 12, 14, 15), (5, 9, 10, 17, 19, 20), 2, id="twice"),
    ],
)
def test_where_frames_are_on_the_axis_however_they_come(
    seconds: Sequence[int], wall: Sequence[int], places: Sequence[int], restarts: int
) -> None:
    times, stamps = np.array(seconds) * SECOND, np.array(wall) * SECOND
    for cuts in itertools.product((False, True), repeat=len(times) - 1):
        axis, edges = TimeAxis(), [0, *np.flatnonzero(cuts) + 1, len(times)]
        parts = [slice(*edge) for edge in itertools.pairwise([0, *edges])]
        found = np.concatenate([axis.places(times[part], stamps[part]) for part in parts])
        assert (found / SECOND).tolist() == list(places), cuts
        assert axis.restarts == restarts


def test_a_recording_in_parts_has_the_samples_that_are_later_than_all_before() -> None:
    """Of three batches: REPEATED frames are kept and are none."""
    axis, kept = TimeAxis(), list[list[int]]()
    for numbers in ((1, 2, 9), (8, 10, 10, 12, 11, 13), (5, 6), (13, 14)):
        made = columns([frame(each, flags=DataFlag.REPEATED * (each == 2)) for each in numbers])
        kept += [batch.sequence.tolist() for _, batch in axis.batches([(InForce(SensorInfo()), made)])]
    assert kept == [[1, 2, 9], [10, 11, 13], [14]]
    assert (axis.left_out, axis.restarts) == (6, 0)
    assert axis.said == ["6 samples out of order left out"]
