"""A file that is written whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from bota_ethercat.errors import FileError
from bota_ethercat.program.new_file import NewFile


def write(path: Path, text: str) -> None:
    with NewFile(path, force=True) as file:
        file.write(text)
        file.finish()


def test_the_old_file_stays_until_the_new_one_is_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, order = tmp_path / "file", list[str]()
    fsync, replace = os.fsync, Path.replace

    def flush(descriptor: int) -> None:
        order.append("directory" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def rename(self: Path, target: Path) -> Path:
        order.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(Path, "replace", rename)
    write(path, "old")
    assert order == ["file", "rename", "directory"]

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(FileError, match="cannot be written: No space left on device"):
        write(path, "new")
    assert [(each, each.read_text()) for each in tmp_path.iterdir()] == [(path, "old")]
