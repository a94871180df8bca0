"""A data set of many recordings: by serial and day, completed when run again, bad recordings named."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import dataset, parquet

from bota_clients import progress
from bota_clients.export import batches, collection, table
from bota_clients.export.cli import main
from tests.clients.recordings import START_NS, describe, frame, record, write
from tests.ended import run_here

DAY_NS = 86_400 * 10**9


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    """Of one sensor, of two, of the next day, and of one name in another folder."""
    paths = [tmp_path / name for name in ("one.mcap", "two.mcap", "later.mcap", "more/one.mcap")]
    paths[3].parent.mkdir()
    later = [frame(n)._replace(stamp_ns=START_NS + DAY_NS + n * 1_250_000) for n in range(40)]
    record(paths[0], map(frame, range(100)))
    record(paths[1], (frame(n, sensor=n % 2) for n in range(60)), sensors=(0, 1))
    record(paths[2], later)
    write(paths[3], [describe(0), *map(frame, range(7, 30))])
    return paths


def data_set(*arguments: object, code: int = 0) -> str:
    ended = run_here(main, *arguments)
    assert ended.code == code, ended.err
    return ended.err


def test_many_recordings_are_one_data_set(runs: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "data"
    assert "rows of 4 recordings written" in data_set(*runs, f"{folder}/")
    found = dataset.dataset(folder, partitioning="hive").to_table().to_pylist()
    where = {(row["serial"], str(row["day"]), row["recording"]) for row in found}
    assert where == {
        (100, "2023-11-14", "one.mcap"), (100, "2023-11-14", "two.mcap"), (101, "2023-11-14", "two.mcap"),
        (100, "2023-11-15", "later.mcap"),
    }  # fmt: skip
    assert len([*folder.rglob("*.parquet")]) == 5
    for number, path in enumerate(folder.rglob("*.parquet")):
        alone = parquet.read_table(path, partitioning=None)
        assert b"settings" in alone.schema.metadata[b"bota_ethercat"], number


def test_what_is_unchanged_is_left_and_what_is_bad_is_named(runs: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "data"
    data_set(*runs[:2], f"{folder}/")
    made = {path: path.stat().st_mtime_ns for path in folder.rglob("*.parquet")}
    runs[2].write_bytes(b"no MCAP")
    record(runs[1], (frame(n, sensor=n % 2) for n in range(50)), sensors=(0, 1))
    said = data_set(runs[2], *runs[:2], tmp_path / "none.mcap", folder, code=1).splitlines()
    assert said[0].endswith("98 rows of 1 recording written; 1 unchanged")
    assert [str(runs[2]) in said[1], "none.mcap" in said[2], len(said)] == [True, True, 3]
    again = {path: path.stat().st_mtime_ns for path in folder.rglob("*.parquet")}
    assert len(again) == len(made) == 3
    assert len(again.items() - made.items()) == 2, "of one recording no two states are there"
    assert "1 unchanged" in data_set(runs[0], folder)
    assert "100 rows of 1 recording written" in data_set(runs[0], folder, "--force")
    assert not [*folder.glob(".unfinished*")]


def test_of_what_has_nothing_in_a_part_nothing_is_left(runs: list[Path], tmp_path: Path) -> None:
    """Of the whole, which is there from before."""
    folder = tmp_path / "data"
    data_set(*runs[:2], f"{folder}/")
    said = data_set(*runs[:2], folder, "--from", "0.1", code=1)
    assert f"{runs[1]} has nothing from 0.1" in said
    assert {row["recording"] for row in dataset.dataset(folder).to_table().to_pylist()} == {"one.mcap"}


def test_a_name_in_another_encoding_is_no_obstacle(runs: list[Path], tmp_path: Path) -> None:
    """As of a file from another machine."""
    other = runs[0].rename(tmp_path / os.fsdecode(b"caf\xe9.mcap"))
    assert "140 rows of 2 recordings written" in data_set(other, runs[2], f"{tmp_path}/data/")
    assert table(other)["recording"][0].as_py() == "caf?.mcap"
    assert "2 unchanged" in data_set(other, runs[2], f"{tmp_path}/data/")
    out = other.with_suffix(".parquet")
    assert f"{out} cannot be written: its name is not UTF-8" in data_set(runs[2], out, code=1)
    said = data_set(*runs[2:], other.with_suffix(""), code=1)
    assert f"{runs[2]} cannot be exported: the name of {other.with_suffix('')} is not UTF-8" in said


def test_until_it_is_complete_no_reader_finds_it(
    runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Polars would fail at what a process that was killed has left."""
    seen, tables_of = list[Path](), collection.tables_of

    def watched(*arguments: Any) -> Iterator[Any]:
        for each in tables_of(*arguments):
            yield each
            seen.extend((tmp_path / "data").rglob("*.parquet"))

    monkeypatch.setattr(collection, "tables_of", watched)
    data_set(runs[1], f"{tmp_path}/data/")
    assert (seen, len([*(tmp_path / "data").rglob("*.parquet")])) == ([], 2)


def test_ctrl_c_leaves_what_is_complete_and_says_so(
    runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if it killed a process that was writing."""

    def interrupted(waiting: Any) -> Iterator[Any]:
        first, *_ = as_completed(waiting)
        yield first
        [unfinished] = (tmp_path / "data").glob(".unfinished-*")
        (unfinished / "left").write_text("")
        raise KeyboardInterrupt

    monkeypatch.setattr(collection, "as_completed", interrupted)
    said = data_set(*runs, f"{tmp_path}/data/", code=1)
    assert said == "ethercat-export: stopped after 1 of 4 recordings: run it again for the others\n"
    assert {path.name.partition("=")[0] for path in (tmp_path / "data").iterdir()} == {"serial"}


@pytest.mark.parametrize("wrong", [["--all"], ["--fps", "30"], ["--mcap", "x.mcap"]])
def test_a_data_set_has_all_samples(runs: list[Path], tmp_path: Path, wrong: list[str]) -> None:
    assert "a data set has all samples" in data_set(*runs[:2], tmp_path / "data", *wrong, code=2)
    assert "name is that of a folder" in data_set(*runs[:2], tmp_path / "a.parquet", code=2)


def test_a_table_is_what_the_data_set_has(runs: list[Path], tmp_path: Path) -> None:
    data_set(runs[0], f"{tmp_path}/data/")
    [path] = (tmp_path / "data").rglob("*.parquet")
    found = table(runs[0])
    assert str(found.to_pydict()) == str(parquet.read_table(path, partitioning=None).to_pydict())
    assert sum(len(each) for each in batches(str(runs[0]), 0)) == len(found) == 100


class Terminal:
    """Standard error that is one."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None: ...

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("after_s", [0.0, 3600.0])
def test_long_work_shows_how_far_it_is(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch, after_s: float
) -> None:
    """Only once it is long."""
    terminal: Any = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(progress, "_AFTER_S", after_s)
    monkeypatch.setattr(progress, "_OFF", [])
    monkeypatch.setitem(os.environ, "TERM", "xterm")
    assert main([str(runs[0]), "--force"]) == 0
    assert ("100%" in terminal.text) == (after_s == 0.0)
    assert np.array_equal(table(runs[0])["sequence"].to_numpy(), range(100))
