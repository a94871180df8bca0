"""Bias and payload kept across restarts."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from ft_compensation.quantities import Payload, Wrench
from ft_compensation.store import CompensationStore, StoreError, default_directory
from tests.compensation.making import BIAS, TOOL

SERIAL = 4711


@pytest.fixture
def store(tmp_path: Path) -> CompensationStore:
    return CompensationStore(tmp_path / "new" / "folder")


def test_what_is_saved_is_loaded(store: CompensationStore) -> None:
    assert store.load(SERIAL) is None
    for kept in ((BIAS, None, None, None), (BIAS, TOOL, None, None), (BIAS, TOOL, BIAS, (0.0, 3.0, -9.0))):
        store.save(SERIAL, *kept)
        stored = store.load(SERIAL)
        assert stored is not None
        assert stored[:2] + stored[3:] == kept
    assert store.load(SERIAL + 1) is None, "every sensor has a file of its own"


def test_what_is_none_is_not_written_and_nothing_is_left_behind(store: CompensationStore) -> None:
    with pytest.raises(ValueError, match="finite"):
        store.save(SERIAL, Wrench((float("nan"), 0.0, 0.0), (0.0, 0.0, 0.0)), Payload())
    assert not store.directory.exists()
    for _ in range(3):
        path = store.save(SERIAL, BIAS, TOOL)
    assert list(store.directory.iterdir()) == [path]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_failed_write_leaves_the_old_file(
    store: CompensationStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.save(SERIAL, BIAS)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match="cannot be written: No space left on device"):
        store.save(SERIAL, Wrench.of([9] * 6))
    monkeypatch.undo()
    stored = store.load(SERIAL)
    assert stored is not None
    assert stored.bias == BIAS
    assert len(list(store.directory.iterdir())) == 1


def test_the_file_is_flushed_before_renaming(
    store: CompensationStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def flushed(descriptor: int) -> None:
        order.append("directory" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def renamed(self: Path, target: Path) -> Path:
        order.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", flushed)
    monkeypatch.setattr(Path, "replace", renamed)
    store.save(SERIAL, BIAS)
    assert order == ["file", "rename", "directory"]


def whole(**changed: Any) -> dict[str, Any]:
    content = {
        "format": "bota-ethercat-bridge compensation",
        "version": 1,
        "serial": SERIAL,
        "saved": "2026-01-01T00:00:00+00:00",
        "bias": [0.0] * 6,
    }
    return content | changed


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it is not whole"),
        (b"\xff\xfe\x00", "it is not whole"),
        (json.dumps(whole()).encode()[:-10], "it is not whole"),
        (b"[" * 60_000, "it is not whole"),
        (b" " * 70_000, "too large"),
        (b"[1, 2]", "another program wrote it"),
        (b'{"format": "x"}', "another program wrote it"),
        (json.dumps(whole(version=2)).encode(), "it has version 2"),
        (json.dumps(whole(serial=5)).encode(), "it belongs to sensor 5, not 4711"),
        (json.dumps(whole(bias=[1, 2])).encode(), "a wrench is 6 finite numbers"),
        (json.dumps(whole(bias=[float("nan")] * 6)).encode(), "a wrench is 6 finite numbers"),
        (json.dumps(whole(bias=[10**400] * 6)).encode(), "a wrench is 6 finite numbers"),
        (json.dumps(whole(bias=None)).encode(), "a wrench is 6 finite numbers"),
        (json.dumps(whole(tool_mass=-1, tool_center_of_gravity=[0, 0, 0])).encode(), "cannot be negative"),
        (json.dumps(whole(tool_mass=1)).encode(), "a center of gravity is 3 finite numbers"),
        (json.dumps(whole(specific_force=[0, 0])).encode(), "a specific force is 3 finite numbers"),
    ],
)
def test_a_damaged_file_is_one_sentence(store: CompensationStore, content: bytes, message: str) -> None:
    store.directory.mkdir(parents=True)
    store.path(SERIAL).write_bytes(content)
    with pytest.raises(StoreError, match=message) as caught:
        store.load(SERIAL)
    assert str(store.path(SERIAL)) in str(caught.value)
    assert "\n" not in str(caught.value)
    store.save(SERIAL, BIAS)  # and it can be replaced
    assert store.load(SERIAL) is not None


def test_what_cannot_be_read_or_written_is_one_sentence(store: CompensationStore, tmp_path: Path) -> None:
    store.path(SERIAL).mkdir(parents=True)
    with pytest.raises(StoreError, match="cannot be read: Is a directory"):
        store.load(SERIAL)
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        CompensationStore(tmp_path / "file" / "folder").save(SERIAL, BIAS)


def test_the_default_directory_is_xdgs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_directory() == tmp_path / "bota-ethercat-bridge"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for ignored in ("", "relative/path"):
        monkeypatch.setenv("XDG_STATE_HOME", ignored)
        assert default_directory() == tmp_path / "home" / ".local" / "state" / "bota-ethercat-bridge"
