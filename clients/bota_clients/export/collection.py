"""What `ethercat-export RECORDING ... FOLDER/` does: a data set of many recordings by serial and day.

    FOLDER/serial=1234/day=2026-11-29/run-0a1b2c3d.parquet

A file a sensor of a recording; its name has the first digits of a hash of the recording's beginning, so that
recordings of one name in several folders stay apart. What is there and unchanged is not written again.
"""

from __future__ import annotations

import argparse
import glob
import hashlib
import itertools
import json
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_clients.errors import NothingAskedForError, RecordingError
from bota_clients.export.cli import PROGRAM
from bota_clients.export.dataset import GROUP, about, arrow_of, in_chunks, windows_for, write_parquet
from bota_clients.export.samples import MOST_LOST, in_part, samples_of
from bota_clients.export.windows import read_tool
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.program import interrupt_on_signals, say
from bota_clients.progress import progress, switch_off
from bota_clients.recording.asked import Asked
from bota_clients.recording.reader import Recording, open_recording
from bota_ethercat.errors import FileError, ProtocolError
from bota_ethercat.program.version import VERSION
from bota_ethercat.text.untrusted import visible

_BEGINNING: Final = 1024  # bytes that tell recordings apart
_SOURCE: Final = "bota_ethercat_source"


class Done(NamedTuple):
    """What became of a recording."""

    rows: int
    is_unchanged: bool = False
    why: str = ""  # it is not in the data set, a sentence


def tables_of(options: argparse.Namespace, recording: Recording, sensor: int | None) -> Iterator[Any]:
    """Tables of some 100,000 samples of a sensor of an open recording, as in the data set; RecordingError."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`

    chosen = choose(recording, sensor)
    windows = windows_for(options, recording, chosen, MOST_LOST)
    said = about(options, recording, chosen, windows.tool)
    blocks = in_part(recording, windows, samples_of(recording, windows, chosen.sensor))
    for block in in_chunks(blocks, GROUP):
        rows = arrow_of(block, said)
        numbers, name = pa.repeat(pa.scalar(0, pa.int32()), len(rows)), visible(recording.path.name)
        yield rows.append_column("recording", pa.DictionaryArray.from_arrays(numbers, [name]))


def _source(path: Path, options: argparse.Namespace) -> tuple[str, str]:
    """The name of its files, and of what they are made, which is the same if they need not be made again."""
    with path.open("rb") as file:
        digest = hashlib.sha256(file.read(_BEGINNING)).hexdigest()[:8]
        found = os.fstat(file.fileno())
    tool = options.tool and hashlib.sha256(options.tool.read_bytes()).hexdigest()
    made_of = [found.st_size, found.st_mtime_ns, tool, options.imu_units.value, options.sensor, VERSION]
    made_of += [*Asked.of(options)]
    return f"{visible(path.stem)}-{digest}.parquet", json.dumps(made_of)


def _there(folder: Path, path: Path, name: str) -> dict[Path, Any]:
    """Files in the data set of a recording, or of another that had this path, and of what they are made."""
    from pyarrow import parquet  # noqa: PLC0415 - of the extra `dataset`

    found = dict[Path, Any]()
    for file in folder.glob(f"serial=*/day=*/{glob.escape(visible(path.stem))}-????????.parquet"):
        source = json.loads((parquet.read_metadata(file).metadata or {}).get(_SOURCE.encode(), "{}"))
        if file.name == name or source.get("path") == str(path.resolve()):
            found[file] = source
    return found


def add(path: Path, options: argparse.Namespace, unfinished: str) -> Done:
    """Write the samples of a recording into the data set, from a folder in which they become complete."""
    folder: Path = options.output
    try:
        name, made_of = _source(path, options)
        there = _there(folder, path, name)
        of = [(each.get("of"), each.get("files")) for each in there.values()]
        if of and not options.force and {*of} == {(made_of, len(of))}:
            return Done(0, is_unchanged=True)
        rows, made = 0, list[Path]()
        own = tempfile.TemporaryDirectory(dir=unfinished, ignore_cleanup_errors=True)
        with open_recording(path, Asked.of(options)) as recording, own as beside:
            sensors = [each.sensor for each in recording.sensors if each.frames]
            if options.sensor is not None:
                sensors = [choose(recording, options.sensor).sensor]
            if not sensors:
                raise RecordingError(f"{path} has no samples")
            source = json.dumps({"path": str(path.resolve()), "of": made_of, "files": len(sensors)})
            for sensor in sensors:
                tables = tables_of(options, recording, sensor)
                first = next(tables)
                day = next(each.as_py() for each in first["stamp_utc"].cast("date32") if each.is_valid)
                serial = choose(recording, sensor).info.serial
                made.append(Path(f"serial={serial}", f"day={day}", name))
                # No name that data/**/*.parquet finds, if this process is killed.
                target = Path(beside, str(len(made)))
                rows += write_parquet(target, itertools.chain([first], tables), {_SOURCE: source})
            for number, each in enumerate(made, 1):
                (folder / each).parent.mkdir(parents=True, exist_ok=True)
                Path(beside, str(number)).replace(folder / each)
            for each in {*there} - {folder / new for new in made}:
                each.unlink()
    except NothingAskedForError as error:
        for each in there:
            each.unlink()
        return Done(0, why=str(error))
    except (RecordingError, ProtocolError) as error:
        return Done(0, why=str(error))
    except OSError as error:
        return Done(0, why=f"{path} cannot be exported: {error.strerror or error}")
    except UnicodeEncodeError:  # by pyarrow
        return Done(0, why=f"{path} cannot be exported: the name of {folder} is not UTF-8")
    return Done(rows)


def _add_all(paths: list[Path], options: argparse.Namespace, beside: str) -> list[tuple[Path, Done]]:
    """What became of each."""
    found, workers = list[tuple[Path, Done]](), min(os.cpu_count() or 1, len(paths))
    if workers < 2:
        return [(path, add(path, options, beside)) for path in paths]
    with (
        progress(f"{len(paths)} recordings", len(paths)) as reach,
        ProcessPoolExecutor(workers, get_context("spawn"), switch_off) as pool,
    ):
        waiting = {pool.submit(add, path, options, beside): path for path in paths}
        try:
            for each in as_completed(waiting):
                found.append((waiting[each], each.result()))
                reach(len(found))
        except BaseException as error:
            pool.shutdown(cancel_futures=True)
            if isinstance(error, KeyboardInterrupt):
                done = f"stopped after {len(found)} of {len(paths)} recordings"
                raise RecordingError(f"{done}: run it again for the others") from None
            raise
    return found


def run(options: argparse.Namespace) -> int:
    """Write or complete the data set, with as many processes as processors; bad recordings are named."""
    interrupt_on_signals()
    folder: Path = options.output
    if options.tool:
        read_tool(options.tool)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Of this process: Ctrl-C kills those that work for it.
        unfinished = tempfile.TemporaryDirectory(
            prefix=".unfinished-", dir=folder, ignore_cleanup_errors=True
        )
    except OSError as error:
        raise FileError(f"{folder} cannot be written: {error.strerror or error}") from None
    with unfinished as beside:
        found = _add_all(options.recordings, options, beside)
    paths = options.recordings
    bad = [done.why for path, done in sorted(found) if done.why]
    unchanged = sum(done.is_unchanged for _, done in found)
    rows = count(sum(done.rows for _, done in found), "row")
    say(PROGRAM, f"{folder}: {rows} of {count(len(paths) - unchanged - len(bad), 'recording')} written"
        f"{f'; {unchanged} unchanged' if unchanged else ''}")  # fmt: skip
    for why in bad:
        say(PROGRAM, why)
    return int(bool(bad))
