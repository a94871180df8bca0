"""The names of a recording's files, and when it is time for the next."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bota_clients.errors import DiskError
from bota_clients.record.recorder import Parts
from bota_clients.recording.disk import DiskFile


def parts(
    path: Path, *, size: int | None = None, seconds: float | None = None, overwrite: bool = False
) -> Parts:
    return Parts(path, size=size, seconds=seconds, overwrite=overwrite)


def test_one_file_has_the_name_it_was_given(tmp_path: Path) -> None:
    made = parts(tmp_path / "a.mcap")
    made.open().close()
    assert [path.name for path in made.made] == ["a.mcap"]
    assert not made.is_full(10**12)


def test_a_row_of_files_is_numbered_and_full_by_size(tmp_path: Path) -> None:
    made = parts(tmp_path / "a.mcap", size=1000)
    for _ in range(3):
        made.open().close()
    assert [path.name for path in made.made] == ["a_0.mcap", "a_1.mcap", "a_2.mcap"]
    assert not made.is_full(999)
    assert made.is_full(1000)


def test_a_row_is_not_mixed_with_an_older_one(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / f"a_{number}.mcap").write_text("old")
    (tmp_path / "a_b.mcap").write_text("other")
    with pytest.raises(DiskError, match="exists"):
        parts(tmp_path / "a.mcap", size=1000).check()
    made = parts(tmp_path / "a.mcap", size=1000, overwrite=True)
    made.check()
    made.open().close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_0.mcap", "a_b.mcap"]


def test_a_row_that_is_being_written_is_not_replaced(tmp_path: Path) -> None:
    first = parts(tmp_path / "a.mcap", size=1000)
    first.open().close()
    writing = first.open()
    with pytest.raises(DiskError, match=r"a_1.mcap .* another ethercat-record is writing to it"):
        parts(tmp_path / "a.mcap", size=1000, overwrite=True).open()
    assert [path.exists() for path in first.made] == [True, True], "none is gone"
    writing.close()
    parts(tmp_path / "a.mcap", size=1000, overwrite=True).open().close()
    assert [path.exists() for path in first.made] == [True, False]


def test_what_the_disk_does_not_take_is_taken_off_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = DiskFile(tmp_path / "a", overwrite=False)
    disk.write(b"first")
    disk.flush()
    real, room = os.write, 3

    def full(fd: int, data: bytes) -> int:
        nonlocal room
        if not room:
            raise OSError(28, "No space left on device")
        count, room = min(room, len(data)), 0
        return int(real(fd, data[:count]))

    disk.write(b"second")
    monkeypatch.setattr("os.write", full)
    with pytest.raises(DiskError, match="No space left"):
        disk.flush()
    monkeypatch.undo()
    disk.close()
    assert (tmp_path / "a").read_bytes() == b"first"
